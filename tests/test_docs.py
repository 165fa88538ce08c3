"""What the pages tell a reader to type works as it stands: Python, commands, links."""

import contextlib
import csv
import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest

from codrl_mj import cli
from codrl_mj.agents import PPOConfig
from codrl_mj.envs.config import EnvConfig
from codrl_mj.study.trials import Grid
from codrl_mj.tasks import pendulum
from codrl_mj.training import TrainConfig, train
from tests.matrix import matrix_params
from tests.published import published_folder

ROOT = Path(__file__).parent.parent
PAGES = {
    str(path.relative_to(ROOT)): path.read_text()
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    if "results" not in path.parts and ("reference" not in path.parts or path.name == "python.md")
}
"""What is written by hand; `make docs` writes the other pages of the reference, from the code."""
NOT_CLONED = {"docs/reference/settings.md", "docs/reference/command_line.md"}
"""What it writes: such pages are in no clone."""
TUTORIALS = {"docs/tutorial_log_to_policy.md", "docs/tutorial_datasheet_to_board.md"}
"""Pages whose commands have tests of their own, which follow them."""
OF_THEIR_OWN = ("own_robot", "training", "other_agents", "randomization")
ELSEWHERE = {"README.md", *TUTORIALS, *(f"docs/{name}.md" for name in OF_THEIR_OWN)}
"""Pages whose Python has tests of its own, which look at what comes out."""
WITH_PYTHON = [
    name for name, text in PAGES.items() if "```python" in text and name not in ELSEWHERE
]
LONG = {
    f"docs/{name}.md" for name in ("actuators", "foreign", "identify", "motors", "see", "studies")
}
"""What takes more than three seconds even so."""
COMMANDS = [
    pytest.param(
        name, command.replace("\\\n", ""), marks=pytest.mark.matrix if name != "README.md" else []
    )
    for name, text in PAGES.items()
    if name not in TUTORIALS
    for command in re.findall(r"^(?:\$ )?codrl-mj ((?:.*\\\n)*.*)$", text, re.MULTILINE)
    if not re.search(r"\b(?:NAME|LOG|RUN)\b", command)  # a form, not an example
]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run folder, after one rollout."""
    out = tmp_path_factory.mktemp("runs") / "mine"
    agent = PPOConfig(rollout_steps=64, batch_size=64, epochs=1)
    train(
        TrainConfig(
            EnvConfig("cartpole"), agent, total_steps=64, num_envs=1, evaluation_episodes=1
        ),
        out,
    )
    return out


@pytest.fixture(autouse=True)
def folder_of_a_reader(trained, tmp_path, monkeypatch):
    """An empty folder, but for the files that pages speak of."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    Path("examples").symlink_to(ROOT / "examples")
    Path("half_cheetah.xml").symlink_to(
        Path(gymnasium.__file__).parent / "envs/mujoco/assets/half_cheetah.xml"
    )
    for file, page, block in (
        ("my_motor.toml", "motors", "toml\n(.*?)"),
        ("car.yaml", "training", "yaml\n(.*?)"),
        ("my_gearbox.py", "actuators", "python\n(import dataclasses\n.*?)"),
    ):
        Path(file).write_text(re.search(f"```{block}```", PAGES[f"docs/{page}.md"], re.DOTALL)[1])
    for own in (ROOT / "examples/own_robot").glob("ball*"):
        shutil.copy(own, ".")
    Path("motor").mkdir()
    Path("motor/actuator.yaml").write_text("family: lag")
    Path("runs").mkdir()
    for run in ("mine", "through"):
        Path("runs", run).symlink_to(trained)
    yield
    for own in ("my_gearbox", "ball_and_beam"):
        sys.modules.pop(own, None)


@pytest.mark.parametrize(
    "page", matrix_params([name for name in WITH_PYTHON if name not in LONG], WITH_PYTHON)
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_python_of_a_page_runs(page, monkeypatch):
    if "data/bench_logs/dfki_pendulum" in PAGES[page]:
        Path("data").symlink_to(published_folder("dfki_pendulum").parents[1])
    monkeypatch.setattr(Grid, "compute", lambda *_: None)  # hours
    namespace = {}
    for block in re.findall(r"```python\n(.*?)```", PAGES[page], re.DOTALL):
        block = block.replace("episodes=100", "episodes=1")  # what takes a reader minutes
        exec(compile(block, page, "exec"), namespace)  # one after the other, as a reader would
    for name in ("env", "envs"):
        if name in namespace and hasattr(namespace[name], "close"):
            namespace[name].close()


@pytest.mark.parametrize(("page", "command"), COMMANDS)
def test_a_command_of_a_page_is_understood(page, command, monkeypatch):
    parsed = []
    for verb in map(cli.find_verb, cli.VERBS):
        monkeypatch.setattr(verb, "run", lambda self: parsed.append(self) or 0)
    with contextlib.suppress(SystemExit):
        assert cli.main(shlex.split(command, comments=True)) == 0
    assert len(parsed) == 1


SHORTER = {
    "train": "--total-steps 300 --evaluation-episodes 1",
    "evaluate": "--episodes 1",
    "render": "--env.max-episode-steps 4 --width 160 --height 120",
    "report": "--no-film",
    "validate": "--quick",
}
"""Verb -> flags with which a command takes seconds."""
NEEDING_MORE = (
    r"identify|data |view|validate (--model|--mutations|--out)|validate"
    r" *(#.*)?$|.*policies/theirs|.*model.zip"
    "|board run|.*--backend ray|.*motor/actuator.yaml" + ("" if shutil.which("cc") else "|board")
)
"""Commands that need logs, a browser, a cluster, a compiler, others' files or minutes: they are only parsed."""
RUNNER = """
import json, runpy, sys
from gymnasium.envs.registration import registry
from codrl_mj.tasks import TASKS
paths, ours = list(sys.path), set(TASKS)
for line in json.load(sys.stdin):
    sys.argv, sys.path[:] = [sys.argv[0], *line], paths  # nothing is left of the command before but what is compiled
    for own in ("my_gearbox", "my_module", "ball_and_beam"):
        sys.modules.pop(own, None)
    for own in set(TASKS) - ours:
        registry.pop(TASKS.pop(own).env_id)
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    except SystemExit as done:
        if done.code:
            sys.exit(f"exit {done.code}: {line}")
"""
"""Runs command lines by the console script as a shell would, but in one process: numba compiles for all once."""


def shortened(command):
    words = shlex.split(command, comments=True)
    if "--measure" in words:  # minutes, and the last flag
        words = words[: words.index("--measure")]
    more = SHORTER.get(words[0], "") if "--resume" not in words else ""
    if "sarsa" in words:
        more = "--total-episodes 2 --evaluation-episodes 1"
    return words + more.split()  # the last one of a flag counts


RUN_ALL = {
    page: [command for name, command in (one.values for one in COMMANDS) if name == page]
    for page in dict.fromkeys(one.values[0] for one in COMMANDS)
}
RUN = {
    page: [one for one in lines if not re.match(NEEDING_MORE, one)]
    for page, lines in RUN_ALL.items()
}


def test_a_family_from_the_folder_of_a_reader_is_trained_through(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place != str(tmp_path)])
    for command in RUN["docs/actuators.md"]:
        assert cli.main(shortened(command)) == 0


@pytest.mark.matrix
@pytest.mark.parametrize("page", [page for page, lines in RUN.items() if lines])
def test_the_commands_of_a_page_run_as_typed(page, trained, tmp_path):
    """By the console script, in a folder that has what the page says to write, and the runs that it does not make."""
    text = " ".join(RUN[page])
    for run in set(re.findall(r"runs/\w+", text)) - set(re.findall(r"--out (runs/\w+)", text)):
        path = tmp_path / run
        if not path.exists():
            path.symlink_to(trained)
    for run in ("mine", "through"):
        if f"--out runs/{run}" in text:
            (tmp_path / "runs" / run).unlink(missing_ok=True)
    for file in (ROOT / "examples/own_robot").iterdir():
        if file.is_file():
            shutil.copy(file, tmp_path)
    shutil.copy(tmp_path / "ball_and_beam.py", tmp_path / "my_module.py")
    program = Path(sys.executable).with_name("codrl-mj")
    done = subprocess.run(
        [sys.executable, "-P", "-c", f"import sys; sys.argv = [{str(program)!r}]{RUNNER}"],
        input=json.dumps([shortened(command) for command in RUN[page]]),
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


def test_the_python_of_the_first_page_prints_what_a_weak_loop_does(capsys):
    (block,) = re.findall(r"```python\n(.*?)```", PAGES["README.md"], re.DOTALL)
    namespace = {}
    exec(compile(block, "README.md", "exec"), namespace)
    namespace["env"].close()
    *numbers, saturated = capsys.readouterr().out.split()
    desired, actual, current, voltage = map(float, numbers)
    assert desired == 10.0
    assert 0 < actual < desired  # its first step
    assert current > 0
    assert voltage > 0
    assert saturated == "False"


@pytest.mark.matrix
def test_the_first_page_identifies_a_motor_as_typed(tmp_path):
    """From logs of a motor on its own, whose columns have the names of that line."""
    program = [str(Path(sys.executable).with_name("codrl-mj"))]
    simulate = shlex.split(
        "identify simulate maxon-ec45-flat-50w --kind prbs --amplitude 4 --duration 2 --inertia"
        " 1e-5"
    )
    for number in ("1", "2"):
        log = tmp_path / f"swing{number}.csv"
        subprocess.run(
            [*program, *simulate, "--seed", number, "--out", str(log)],
            check=True,
            capture_output=True,
        )
        header, rows = log.read_text().split("\n", 1)
        for name, column in (("time", "t"), ("voltage", "u"), ("current", "i"), ("position", "q")):
            header = re.sub(rf"\b{name}\b", column, header)
        log.write_text(f"{header}\n{rows}")
    (line,) = [command for command in RUN_ALL["README.md"] if command.startswith("identify")]
    done = subprocess.run(
        [*program, *shlex.split(line)], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "not to be used" not in done.stdout
    assert (tmp_path / "motor" / "actuator.yaml").is_file()


@pytest.mark.parametrize("page", PAGES)
def test_a_page_links_to_what_exists(page):
    for link in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", PAGES[page]):
        if not link.startswith("http"):
            target = (ROOT / page).parent / link
            assert target.exists(), link
            assert str(target.resolve().relative_to(ROOT)) not in NOT_CLONED, link


TEXTS = ("*.py", "*.toml", "*.xml", "*.jinja", "*.md", "*.html", "*.js", "*.yml", "Makefile")
"""What may name a page: messages, help, docstrings, generated files."""


def test_every_page_that_code_assets_and_help_name_is_in_a_clone():
    folders = [ROOT / name for name in ("codrl_mj", "assets", "examples", "scripts")]
    files = [file for folder in folders for kind in TEXTS for file in folder.rglob(kind)]
    files += [
        ROOT / name
        for name in ("README.md", "CONTRIBUTING.md", "Makefile", "pyproject.toml", "zensical.toml")
    ]
    named = {
        page: file
        for file in files
        for page in re.findall(r"docs/[\w/]+\.md", file.read_text(errors="replace"))
    }
    assert "docs/motors.md" in named
    for page, file in named.items():
        assert (ROOT / page).is_file(), f"{file} names {page}"
        assert page not in NOT_CLONED, f"{file} names {page}"


def test_the_file_of_upright_tolerances_has_the_pendulum_s_own():
    with (ROOT / "docs/upright_tolerances.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    angle, speed, page = (
        f"{pendulum.GOAL_ANGLE:g} rad",
        f"{pendulum.GOAL_SPEED:g} rad/s",
        PAGES["docs/evaluation.md"],
    )
    assert "(upright_tolerances.csv)" in page
    assert f"within {angle} of upright and slower than {speed}" in page
    assert all(0.0 <= float(row[f"{angle}, {speed}"]) <= 1.0 for row in rows)
    assert len(rows) == 13


def test_of_the_papers_statements_as_many_are_confirmed_as_the_results_say():
    results = ROOT / "docs" / "results"
    with (results / "reproduction" / "claims.csv").open(newline="") as file:
        rows = [
            row
            for row in csv.DictReader(file)
            if row["source"] == "paper" and row["counted"] == "yes"
        ]
    sure, near = (sum(row["verdict"] == one for row in rows) for one in ("confirmed", "compatible"))
    said = (
        f"{len(rows)} statements {sure} are confirmed, and {near}, read off one run, compatible"
        " with ours."
    )
    assert said in PAGES["README.md"].replace("\n", " ")
    counted = f"**Of {len(rows)} statements: {sure} confirmed, {near} compatible, "
    assert counted in (results / "reproduction.md").read_text()
