"""Pages of the environments agree with the code."""

import dataclasses
import inspect
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from PIL import Image

import environment_pages
import page_pictures_tasks
from codrl_mj.envs import ActuatedEnv
from codrl_mj.envs.config import EnvConfig, find_source
from codrl_mj.tasks import TASKS
from tests.tasks.faces import every_rebuilt

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "docs" / "environments"
SECTIONS = (
    "Description",
    "Observation space",
    "Action space",
    "Reward",
    "Start",
    "End",
    "Arguments",
)
MORE = {"furuta": ("What to expect", "Where the numbers come from")}
"""Task -> sections that only its page has, at its end."""

every_task = pytest.mark.parametrize("task", TASKS)


def _section(task, title):
    page = (FOLDER / f"{task}.md").read_text()
    return re.search(rf"^## {title}\n\n(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)[1]


def _table(text):
    """Return the cells of the first Markdown table, without its header."""
    rows = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows[2:]]


def _facts(task):
    return {row[0]: row[1] for row in _table((FOLDER / f"{task}.md").read_text())}


# -- generated pages ------------------------------------------------------------------------------


def test_the_pages_are_generated_from_the_code_and_complete():
    pages = environment_pages.pages()
    assert pages.keys() == {"README.md", "arguments.md"} | {f"{task}.md" for task in TASKS}
    assert {path.name for path in FOLDER.glob("*.md")} == pages.keys()
    for name, text in pages.items():
        assert (FOLDER / name).read_text() == text, (
            f"docs/environments/{name} is stale: run make docs"
        )


@pytest.mark.matrix
def test_make_docs_writes_them(tmp_path):
    command = [
        sys.executable,
        str(ROOT / "scripts" / "environment_pages.py"),
        "--out",
        str(tmp_path),
    ]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    for path in FOLDER.glob("*.md"):
        assert (tmp_path / path.name).read_text() == path.read_text()
    assert re.search(
        r"^docs: .*\n\t.*scripts/environment_pages\.py$",
        (ROOT / "Makefile").read_text(),
        re.MULTILINE,
    )


def test_the_index_links_to_every_page():
    links = dict(re.findall(r"\[(.*?)\]\((.*?)\)", (FOLDER / "README.md").read_text()))
    expected = {task.env_id.removeprefix("codrl_mj/"): f"{name}.md" for name, task in TASKS.items()}
    assert links == expected | {"the same arguments": "arguments.md"}


@every_task
def test_every_page_has_a_short_film_and_the_same_sections(task):
    assert set(page_pictures_tasks.SCENES) == set(TASKS)
    page = (FOLDER / f"{task}.md").read_text()
    assert re.findall(r"^## (.*)$", page, re.MULTILINE) == [*SECTIONS, *MORE.get(task, ())]
    (shown,) = re.findall(r"!\[.*?\]\((.*?)\)", page)
    assert f"environments/{shown}" in page_pictures_tasks.PICTURES
    assert (FOLDER / shown).stat().st_size < 400_000
    with Image.open(FOLDER / shown) as film:
        assert 240 <= film.width <= 320
        durations = []
        for frame in range(film.n_frames):
            film.seek(frame)
            film.load()
            durations.append(film.info["duration"])
    assert 2000 < sum(durations[:-1]) < 4000  # ms, and the last one stands still


def test_an_undocumented_argument_is_refused(monkeypatch):
    def fewer(self, task, actuator="paper"):  # noqa: D417
        """Build.

        Args:
            task: the task.
        """

    monkeypatch.setattr(environment_pages.ActuatedEnv, "__init__", fewer)
    with pytest.raises(ValueError, match="ActuatedEnv documents task but takes actuator"):
        environment_pages.common_arguments()


# -- content --------------------------------------------------------------------------------------


@every_task
def test_every_argument_and_option_is_in_the_page_with_its_default(task):
    rows = {
        row[0].strip("`"): row[1].strip("`")
        for row in _table((FOLDER / "arguments.md").read_text())
    }
    assert "(arguments.md)" in _section(task, "Arguments")
    known = find_source(task).fields
    fields = {
        field.name: repr(field.default)
        for field in dataclasses.fields(EnvConfig)[1:]  # without the task
        if field.name in known
    }
    parameters = dict(
        list(inspect.signature(ActuatedEnv).parameters.items())[1:-1]
    )  # and without **arguments
    expected = {name: repr(parameter.default) for name, parameter in parameters.items()} | fields
    assert expected.pop("options") == "None"
    assert rows == {name: re.sub(r"\(.*\)$", "()", default) for name, default in expected.items()}
    assert re.findall(r"`(\w+)`", _facts(task)["options of its own"]) == list(
        TASKS[task].options._fields
    )
    for option in TASKS[task].options._fields:
        assert f"`{option}`" in _section(task, "Arguments")


def _number(text):
    text = re.sub(r"\(.*\)", "", text).strip()
    return float(text.removesuffix("pi")) * np.pi if text.endswith("pi") else float(text)


@every_task
def test_the_observation_table_agrees_with_the_space(task):
    rows, space = _table(_section(task, "Observation space")), TASKS[task].observation_space
    assert [int(row[0]) for row in rows] == list(range(space.shape[0]))
    assert [row[1].split("`")[1] for row in rows] == list(TASKS[task].observation_names)
    np.testing.assert_allclose([_number(row[2]) for row in rows], space.low, rtol=1e-4)
    np.testing.assert_allclose([_number(row[3]) for row in rows], space.high, rtol=1e-4)
    assert all(len(row) == 5 for row in rows)


@every_task
def test_the_action_space_is_named(task):
    space = TASKS[task].action_space
    text = _section(task, "Action space")
    if isinstance(space, gymnasium.spaces.Discrete):
        assert f"`Discrete({space.n})`" in text
        assert all(
            re.search(rf"(?<![\d.]){force:g}(?![\d.])", text) for force in TASKS[task].forces
        )
    else:
        assert f"`Box({space.low[0]:g}, {space.high[0]:g}, (1,), float32)`" in text
    assert _facts(task)["action space"] == f"`{space}`"


@every_rebuilt
def test_the_time_limit_is_the_registered_one_and_gymnasiums(task):
    ours, theirs = gymnasium.spec(TASKS[task].env_id), gymnasium.spec(TASKS[task].gymnasium_id)
    assert ours.max_episode_steps == theirs.max_episode_steps == TASKS[task].max_episode_steps
    assert ours.reward_threshold == theirs.reward_threshold == TASKS[task].reward_threshold
    steps, seconds = re.search(
        r"[Tt]runcated\safter\s(\d+)\ssteps\s\(([\d.]+)\ss\)", _section(task, "End")
    ).groups()
    assert int(steps) == ours.max_episode_steps
    assert float(seconds) == pytest.approx(int(steps) * TASKS[task].step_duration)
    facts = _facts(task)
    assert facts["time limit"] == f"{steps} steps"
    if theirs.reward_threshold is not None:
        assert facts["solved at"] == f"a return of {theirs.reward_threshold:g}"


@every_task
def test_the_number_of_integration_steps_is_that_of_the_environment(task):
    facts = _facts(task)
    with_motor, without = map(int, re.findall(r"\d+", facts["integration steps in it"]))
    for actuator, count in (("default", with_motor), ("ideal", without)):
        env = ActuatedEnv(task, actuator)
        assert env.physics.simulation.inner_steps == count
        assert env.model.opt.timestep == pytest.approx(
            float(facts["environment step"].split()[0]) / count
        )
