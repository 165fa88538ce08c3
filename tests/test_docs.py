"""Python, commands and links of the pages work as they are printed."""

import collections
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
"""Pages written by hand. `make docs` generates the other pages of the reference from the code."""
NOT_CLONED = {"docs/reference/settings.md", "docs/reference/command_line.md"}
"""Generated pages, which are not in a clone."""
TUTORIALS = {
    "docs/tutorial_log_to_policy.md",
    "docs/tutorial_datasheet_to_board.md",
    "docs/train_elsewhere.md",
}
"""Pages whose commands have their own tests."""
TESTED_SEPARATELY = ("own_robot", "training", "other_agents", "randomization")
WITH_OTHER_TESTS = {"README.md", *TUTORIALS, *(f"docs/{name}.md" for name in TESTED_SEPARATELY)}
"""Pages whose Python has its own tests, which check the results."""
WITH_PYTHON = [
    name for name, text in PAGES.items() if "```python" in text and name not in WITH_OTHER_TESTS
]
SLOW_PAGES = {
    f"docs/{name}.md"
    for name in (
        "actuators",
        "external_envs",
        "identify",
        "identify_servo",
        "motors",
        "see",
        "studies",
    )
}
"""Pages that take more than three seconds even in short form."""
COMMANDS = [
    pytest.param(
        name, command.replace("\\\n", ""), marks=pytest.mark.matrix if name != "README.md" else []
    )
    for name, text in PAGES.items()
    if name not in TUTORIALS
    for command in re.findall(r"^(?:\$ )?codrl-mj ((?:.*\\\n)*.*)$", text, re.MULTILINE)
    if not re.search(r"\b(?:NAME|LOG|RUN)\b", command)  # a template, not an example
]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Return a run folder after one rollout."""
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
def reader_folder(trained, tmp_path, monkeypatch):
    """Run each test in a folder with only the files that the pages mention."""
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
    for name in (ROOT / "examples/own_robot").glob("ball*"):
        shutil.copy(name, ".")
    Path("motor").mkdir()
    Path("motor/actuator.yaml").write_text("family: lag")
    Path("runs").mkdir()
    for run in ("mine", "through"):
        Path("runs", run).symlink_to(trained)
    yield
    for name in ("my_gearbox", "ball_and_beam"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    "page", matrix_params([name for name in WITH_PYTHON if name not in SLOW_PAGES], WITH_PYTHON)
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_python_of_a_page_runs(page, monkeypatch):
    if log_set := re.search("data/bench_logs/(\\w+)", PAGES[page]):
        Path("data").symlink_to(published_folder(log_set[1]).parents[1])
    monkeypatch.setattr(Grid, "compute", lambda *_: None)  # hours
    namespace = {}
    for block in re.findall(r"```python\n(.*?)```", PAGES[page], re.DOTALL):
        block = block.replace("episodes=100", "episodes=1")  # what takes a reader minutes
        # Blocks run one after the other in one namespace, as a reader would run them.
        exec(compile(block, page, "exec"), namespace)
    for name in ("env", "envs"):
        if name in namespace and hasattr(namespace[name], "close"):
            namespace[name].close()


@pytest.mark.parametrize(("page", "command"), COMMANDS)
def test_a_command_of_a_page_is_parsed(page, command, monkeypatch):
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
"""Verb -> flags that shorten a command to seconds."""
NEEDING_MORE = (
    r"identify|data |view|validate (--model|--mutations|--out)|validate"
    r" *(#.*)?$|.*policies/theirs|.*model.zip"
    "|board run|.*--backend ray|.*motor/actuator.yaml" + ("" if shutil.which("cc") else "|board")
)
"""Commands that need logs, a browser, a cluster, a compiler, third-party files or minutes: they are
only parsed.
"""
RUNNER = """
import json, runpy, sys
from gymnasium.envs.registration import registry
from codrl_mj.tasks import TASKS
paths, ours = list(sys.path), set(TASKS)
for line in json.load(sys.stdin):
    # Undo the effects of the previous command, except compiled code.
    sys.argv, sys.path[:] = [sys.argv[0], *line], paths
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
"""Program that runs command lines like a shell, but in one process, so that numba compiles only
once.
"""


def shortened(command):
    words = shlex.split(command, comments=True)
    if "--measure" in words:  # minutes, and the last flag
        words = words[: words.index("--measure")]
    more = SHORTER.get(words[0], "") if "--resume" not in words else ""
    if "sarsa" in words:
        more = "--total-episodes 2 --evaluation-episodes 1"
    return words + more.split()  # the last one of a flag counts


RUN_ALL = {
    page: [command for name, command in (param.values for param in COMMANDS) if name == page]
    for page in dict.fromkeys(param.values[0] for param in COMMANDS)
}
RUN = {
    page: [line for line in lines if not re.match(NEEDING_MORE, line)]
    for page, lines in RUN_ALL.items()
}


def test_a_family_in_the_readers_folder_can_be_trained(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path != str(tmp_path)])
    for command in RUN["docs/actuators.md"]:
        assert cli.main(shortened(command)) == 0


@pytest.mark.matrix
@pytest.mark.parametrize("page", [page for page, lines in RUN.items() if lines])
def test_the_commands_of_a_page_run_as_typed(page, trained, tmp_path):
    """Run the console script in a folder with the page's files and the runs that it uses."""
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
    result = subprocess.run(
        [sys.executable, "-P", "-c", f"import sys; sys.argv = [{str(program)!r}]{RUNNER}"],
        input=json.dumps([shortened(command) for command in RUN[page]]),
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-2000:]


def test_the_python_of_the_readme_prints_the_signals_of_a_weak_loop(capsys):
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
def test_the_readme_identifies_a_motor_as_typed(tmp_path):
    """Use logs of a motor without a load, with the column names of the command."""
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
    result = subprocess.run(
        [*program, *shlex.split(line)], capture_output=True, text=True, timeout=300, check=False
    )
    assert result.returncode == 0, result.stderr
    assert "not to be used" not in result.stdout
    assert (tmp_path / "motor" / "actuator.yaml").is_file()


@pytest.mark.parametrize("page", PAGES)
def test_all_links_of_a_page_exist(page):
    for link in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", PAGES[page]):
        if not link.startswith("http"):
            target = (ROOT / page).parent / link
            assert target.exists(), link
            assert str(target.resolve().relative_to(ROOT)) not in NOT_CLONED, link


def _anchors(text):
    """Return the anchors of a page's headings, as GitHub and the site's generator make them."""
    headings = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.M)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading) for heading in headings)
    return {re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("page", PAGES)
def test_all_links_to_a_section_exist(page):
    for target, anchor in re.findall(r"\]\(([^)#:]*)#([^)]+)\)", PAGES[page]):
        path = (ROOT / page).parent / target if target else ROOT / page
        if path.suffix == ".md":
            assert anchor in _anchors(path.read_text()), f"{target}#{anchor}"


TEXTS = ("*.py", "*.toml", "*.xml", "*.jinja", "*.md", "*.html", "*.js", "*.yml", "Makefile")
"""Files that may name a page: messages, help, docstrings, generated files."""


def test_every_page_named_by_code_is_in_a_clone():
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


def test_the_table_of_upright_tolerances_has_the_pendulums():
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


def test_the_front_pages_count_the_paper_s_statements_as_the_rows_do():
    results = ROOT / "docs" / "results"
    with (results / "reproduction" / "claims.csv").open(newline="") as file:
        outcomes = collections.Counter(
            row["verdict"]
            for row in csv.DictReader(file)
            if row["source"] == "paper" and row["counted"] == "yes"
        )
    verdicts = ("confirmed", "compatible", "open", "not confirmed")
    assert set(outcomes) <= set(verdicts)
    counted = ", ".join(
        f"{outcomes[verdict]} {verdict}" for verdict in verdicts if outcomes[verdict]
    )
    for page in ("README.md", "docs/reproduction.md", "docs/results/reproduction.md"):
        text = re.sub(r"\s+", " ", (ROOT / page).read_text())
        assert f"{outcomes.total()} statements: {counted}." in text, page
