"""The two wheels of wheels/: their contents and metadata, and the use of the core alone."""

import email
import json
import pkgutil
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import codrl_mj
from codrl_mj import requirements
from tests.bare_environment import BareEnvironment

REPOSITORY = Path(__file__).parents[1]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
COPIED = ("codrl_mj", "assets", "wheels", "docs/results/actuators", "docs/results/insurance")
VERSION = "7.8.9"
"""Version that a single line of the copy has."""

pytestmark = pytest.mark.matrix


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    """Return name -> wheel: those of core and full, and the one of the project's own folder."""
    copy, out = tmp_path_factory.mktemp("copy"), tmp_path_factory.mktemp("wheels")
    for name in COPIED:
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPOSITORY / name, copy / name, symlinks=True, ignore=ignored)
    for name in ("README.md", "LICENSE", "pyproject.toml"):
        shutil.copy(REPOSITORY / name, copy)
    package = copy / "codrl_mj" / "__init__.py"
    package.write_text(re.sub('(?<=__version__ = ")[^"]+', VERSION, package.read_text()))
    folders = {"core": copy / "wheels/core", "full": copy / "wheels/full", "project": copy}
    for name, folder in folders.items():
        build = [sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", out / name]
        result = subprocess.run(
            [*build, folder], capture_output=True, text=True, timeout=240, check=False
        )
        assert result.returncode == 0, result.stdout + result.stderr
    return {name: zipfile.ZipFile(next((out / name).glob("*.whl"))) for name in folders}


def info(wheel, name):
    """Return a file of a wheel's metadata as text."""
    (file,) = (file for file in wheel.namelist() if file.endswith(f".dist-info/{name}"))
    return wheel.read(file).decode()


def metadata(wheel):
    return email.message_from_string(info(wheel, "METADATA"))


def required(wheel):
    """Return the requirements of a wheel as a set of comparable objects."""
    return set(map(Requirement, metadata(wheel).get_all("Requires-Dist")))


def code(wheel):
    """Return file -> content of a wheel, without its metadata."""
    return {name: wheel.read(name) for name in wheel.namelist() if ".dist-info/" not in name}


def test_the_core_has_the_files_of_the_project_s_wheel_and_the_other_wheel_has_none(wheels):
    assert len(code(wheels["core"])) > 250
    assert code(wheels["core"]) == code(wheels["project"])
    assert code(wheels["full"]) == {}
    assert info(wheels["core"], "entry_points.txt") == info(wheels["project"], "entry_points.txt")
    assert not [name for name in wheels["full"].namelist() if name.endswith("entry_points.txt")]


def test_one_line_sets_the_version_of_both_and_one_requires_the_other(wheels):
    for name, project in (("core", "codrl-mj-core"), ("full", "codrl-mj")):
        assert metadata(wheels[name])["Name"] == project
        assert metadata(wheels[name])["Version"] == VERSION
    pinned = Requirement(f"codrl-mj-core=={VERSION}")
    assert required(wheels["full"]) - required(wheels["project"]) == {pinned}
    assert required(wheels["project"]) < required(wheels["full"])
    assert not [text for text in required(wheels["core"]) if text.name.startswith("codrl")]


def test_the_full_wheel_has_the_other_fields_of_the_project(wheels):
    full, project = metadata(wheels["full"]), metadata(wheels["project"])
    changed = {"Requires-Dist", "Version"}
    assert {*full} == {*project}
    for field in {*full} - changed:
        assert full.get_all(field) == project.get_all(field)
    assert full.get_payload() == project.get_payload() != ""
    for wheel in wheels.values():
        assert info(wheel, "licenses/LICENSE") == (REPOSITORY / "LICENSE").read_text()


def test_the_core_requires_three_packages_in_the_versions_of_the_project(wheels):
    needed = {text for text in required(wheels["core"]) if text.marker is None}
    assert {text.name for text in needed} == {"numpy", "pint", "pyyaml"}
    assert needed < required(wheels["project"])
    extra = {text for text in required(wheels["core"]) if text.marker is not None}
    assert {(text.name, str(text.marker)) for text in extra} == {
        ("rich", 'extra == "cli"'),
        ("tyro", 'extra == "cli"'),
    }
    specifiers = {text.name: text.specifier for text in required(wheels["project"])}
    assert all(text.specifier == specifiers[text.name] for text in extra)


@pytest.fixture(scope="module")
def core(wheels, tmp_path_factory):
    """Return an environment with the core and only what it requires, without its extra."""
    environment = BareEnvironment(tmp_path_factory.mktemp("core"))
    environment.link(str(text) for text in required(wheels["core"]) if text.marker is None)
    process = environment.pip("install", "--no-index", "--no-deps", wheels["core"].filename)
    assert process.returncode == 0, process.stderr
    return environment


def test_without_its_extra_the_command_names_the_extra(core):
    process = core.run(program="codrl-mj")
    assert process.returncode == 2
    assert process.stdout == ""
    assert process.stderr == (
        "codrl-mj: error: tyro is not installed. The extra 'cli' installs it: pip install"
        " 'codrl-mj-core[cli]'\n"
    )


@pytest.mark.parametrize("packages", [["rich", "tyro"], ["rich", "tyro", "mujoco"]])
def test_the_core_offers_motors_and_back_ends_and_refuses_the_rest_with_the_remedy(core, packages):
    core.link(packages)
    shutil.copy(REPOSITORY / "tests" / "core_use.py", core.folder / "use.py")
    process = core.run("use.py")
    assert process.returncode == 0, process.stdout + process.stderr
    answer = json.loads(process.stdout.splitlines()[-1])
    assert Path(answer["file"]).is_relative_to(core.folder)
    assert "numba is not installed" in answer["message"]
    assert answer["message"].endswith("pip install codrl-mj")
    refused = {name.removeprefix("codrl_mj.") for name in answer["refused"]}
    assert {"engine.plugin", "envs.config", "factory", "training"} <= refused
    # Verbs that simulate are refused one by one.
    whole = requirements.CORE_PACKAGES - {"cli"}
    assert not [name for name in refused if name.partition(".")[0] in whole]
    offered = requirements.CORE_PACKAGES | requirements.CORE_MODULES
    modules = pkgutil.walk_packages(codrl_mj.__path__, "codrl_mj.")
    assert offered <= {module.name.removeprefix("codrl_mj.") for module in modules} - refused
