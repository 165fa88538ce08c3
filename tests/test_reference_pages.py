"""Generated reference pages are complete: every verb, every public name, every field."""

import dataclasses
import importlib
import re
import tomllib
from pathlib import Path

import pytest

import codrl_mj
import reference_pages
from codrl_mj import cli
from codrl_mj.actuators import Inputs
from codrl_mj.envs.config import EnvConfig
from codrl_mj.tasks import Task
from codrl_mj.training import TrainConfig

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def pages():
    """Return path below docs/reference -> text."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "100")
        return reference_pages.pages()


def test_every_verb_has_a_page_with_its_help(pages):
    for verb in {name.split()[0] for name in cli.VERBS}:
        assert f"usage: codrl-mj {verb}" in pages[f"command_line/{verb}.md"]
        # A verb without a docstring would show the comments of its source.
        assert not re.search(r"type: ignore|noqa", pages[f"command_line/{verb}.md"])
        assert re.search(
            rf"`{verb}`\]\(command_line/{verb}.md\) \| \w.+\.? \|", pages["command_line.md"]
        )
    assert "## identify simulate" in pages["command_line/identify.md"]
    assert "## motor feasible" in pages["command_line/motor.md"]


def test_every_package_with_public_names_has_a_page_with_each_of_them(pages):
    root = Path(codrl_mj.__file__).parent
    inits = [*root.glob("*/__init__.py"), *root.glob("viz/*/__init__.py")]
    packages = {"disturbances"} | {
        ".".join(path.parent.relative_to(root).parts)
        for path in inits
        if "__all__" in path.read_text()
    }
    assert packages == set(reference_pages.ROOMS)
    for package in packages:
        text = pages[f"rooms/{package}.md"]
        for name in importlib.import_module(f"codrl_mj.{package}").__all__:
            assert re.search(rf"^(::: codrl_mj\.\S+\.|\| `){name}\b", text, re.MULTILINE), (
                package,
                name,
            )


def test_every_public_name_of_the_package_is_on_the_first_page():
    text = (ROOT / "docs" / "reference" / "python.md").read_text()
    for name in set(codrl_mj.__all__) - {"__version__"}:
        assert re.search(rf"^::: codrl_mj\.\S*\.{name}$", text, re.MULTILINE), name


def test_every_field_of_a_setting_is_described(pages):
    text = pages["settings.md"]
    for kind in (EnvConfig, TrainConfig, Task):
        for field in dataclasses.fields(kind):
            assert re.search(rf"^\| `{field.name}` \| .+ \| \S.+ \|$", text, re.MULTILINE), (
                field.name
            )
    for name in Inputs._fields:
        assert re.search(rf"^\| `{name}` \| .+ \| \S.+ \|$", text, re.MULTILINE), name
    assert (
        "| `resistance` | `1.0` | ohm | a finite number > 0 | Winding resistance R [ohm], > 0."
        in text
    )
    assert "| `center_radius` | `inf` |" in text


def test_the_site_has_every_page_in_its_navigation(pages):
    nav = tomllib.loads((ROOT / "zensical.toml").read_text())["project"]["nav"]

    def paths_of(entry):
        if isinstance(entry, str):
            return [entry]
        return [
            path
            for item in (entry.values() if isinstance(entry, dict) else entry)
            for path in paths_of(item)
        ]

    paths = paths_of(nav)
    assert len(paths) == len(set(paths))
    assert {f"reference/{name}" for name in pages} < set(paths)
    checked_in = {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}
    parts = {
        f"results/{name}_conclusions.md" for name in ("actuators", "insurance", "reproduction")
    }
    assert checked_in - set(paths) <= parts
    ignored = {f"reference/{name}" for name in pages}
    assert set(paths) - ignored <= checked_in
