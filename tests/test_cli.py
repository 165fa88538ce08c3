"""The command line: it teaches, it does what it says, and bad input costs one line and leaves nothing."""

import dataclasses
import importlib
import json
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium
import imageio
import numpy as np
import pytest

import codrl_mj
from codrl_mj import register
from codrl_mj.actuators import NAMED, CurrentLoop, Ideal, Lag, Motor, Supply
from codrl_mj.agents.presets import ELSEWHERE, PRESETS
from codrl_mj.cli import VERBS, find_verb, main
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import evaluate, run_episodes
from codrl_mj.runs.policies import load_policy
from codrl_mj.tasks import TASKS, find_task, named_actuator
from codrl_mj.training import TrainConfig, folder, load_config
from tests.matrix import but

PROGRAM = Path(sys.executable).with_name("codrl-mj")
TINY = ["--total-steps", "500", "--num-envs", "2", "--agent", "ppo"]
TINY += ["--agent.rollout-steps", "256", "--agent.batch-size", "64", "--agent.epochs", "1", "--agent.hidden", "8"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Every test runs in an empty folder."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A tiny run of CartPole through the actuator `weaker`."""
    out = tmp_path_factory.mktemp("trained") / "run"
    assert main(["train", "cartpole", "--actuator", "weaker", *TINY, "--out", str(out)]) == 0
    return out


def command(line, **options):
    arguments = [str(PROGRAM), *line.split()]
    return subprocess.run(arguments, capture_output=True, text=True, timeout=120, check=False, **options)


def helped(capsys, *verb):
    """The help text as one line, without its frame."""
    with pytest.raises(SystemExit) as done:
        main([*verb, "--help"])
    assert done.value.code == 0
    return " ".join(capsys.readouterr().out.translate(str.maketrans("│╭╮╰╯─", "      ")).split())


def refused(capsys, *arguments):
    """The one line that bad input costs; nothing is written."""
    before = sorted(Path.cwd().rglob("*"))
    assert main(list(arguments)) == 2
    error = capsys.readouterr().err
    assert error.startswith("codrl-mj: error: ")
    assert error.count("\n") == 1
    assert "Traceback" not in error
    assert sorted(Path.cwd().rglob("*")) == before
    return error


# -- help ---------------------------------------------------------------------------------------------------


def test_the_help_lists_every_verb_with_an_example(capsys):
    text = helped(capsys)
    for verb in ("train", "evaluate", "render", "validate"):
        assert f"• {verb}" in text
        assert f"Example: codrl-mj {verb}" in text


@pytest.mark.parametrize("verb", ["train", "evaluate", "render"])
def test_the_help_explains_every_named_actuator_and_every_field_with_its_unit(capsys, verb):
    text = helped(capsys, verb)
    for name, (description, _) in NAMED.items():
        assert f"{name}: {description}" in text
    for part, kind in (("motor", Motor), ("controller", CurrentLoop), ("supply", Supply)):
        for field in dataclasses.fields(kind):
            assert f"--actuator.{part}.{field.name.replace('_', '-')}" in text
    for unit in ("[ohm]", "[H]", "[N*m/A]", "[V*s/rad]", "[m]", "[V/A]", "[V/(A*s)]", "[V*s/A]", "[1/s]", "[s]"):
        assert unit in text
    for field in dataclasses.fields(EnvConfig):
        if field.name not in ("task", "actuator", "options"):
            assert f"--env.{field.name.replace('_', '-')}" in text
    assert "--env.center-radius" in text
    assert "--seed" in text
    assert "--out" in text


@pytest.mark.parametrize(
    ("agent", "task", "settings"),
    [
        (agent, task if task != ELSEWHERE else "InvertedPendulum-v5", name)
        for (agent, task), named in PRESETS.items()
        for name in named
    ],
)
def test_the_help_shows_every_default_of_the_agent_on_the_task(capsys, agent, task, settings):
    text = helped(capsys, "train", task, "--agent", agent, "--settings", settings)
    config = TrainConfig.preset(task, agent, settings)
    values = {f"--agent.{field.name}": getattr(config.agent, field.name) for field in dataclasses.fields(config.agent)}
    values |= {f"--{name}": getattr(config, name) for name in ("seed", "total_steps", "total_episodes", "num_envs")}
    values["--env.max_episode_steps"] = config.env.max_episode_steps
    if isinstance(config.env, EnvConfig):
        values["--env.center_radius"] = config.env.as_mapping()["options"].get("center_radius")
    for name, value in values.items():
        *_, flag = re.split(rf" {name.replace('_', '-')}(?![\w-])", text)  # the last one: before may be examples
        default = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
        assert flag.partition("(default: ")[2].startswith(f"{default})"), name


@pytest.mark.parametrize("verb", ["train", "validate"])
def test_the_help_lists_every_task(capsys, verb):
    assert "{" + ",".join(TASKS) + "}" in helped(capsys, verb)


def test_the_examples_in_the_help_are_understood(capsys):
    train, evaluate, render, validate = (helped(capsys, verb) for verb in ("train", "evaluate", "render", "validate"))
    assert "codrl-mj train cartpole --actuator weaker --env.center-radius 0.1 --out runs/through-weaker" in train
    assert "codrl-mj evaluate runs/cartpole-ppo-ideal-0 --actuator weaker --episodes 100" in evaluate
    assert "codrl-mj render runs/cartpole-ppo-weaker-0 --out balance.mp4" in render
    assert "codrl-mj validate cartpole --out certificate" in validate
    assert "codrl-mj validate --model robot.xml" in validate
    # the examples' flags parse: what is missing is the run folder
    for line in (
        "evaluate runs/cartpole-ppo-ideal-0 --actuator weaker --episodes 100",
        "render runs/cartpole-ppo-weaker-0 --out balance.mp4",
    ):
        assert "no run configuration at runs/cartpole-ppo-" in refused(capsys, *line.split())


# -- train, evaluate, render --------------------------------------------------------------------------------


def test_training_leaves_a_run_folder_and_says_what_is_next(capsys, tmp_path):
    assert main(["train", "cartpole", "--actuator", "ideal", "--seed", "3", *TINY]) == 0
    out = tmp_path / "runs" / "cartpole-ppo-ideal-3"
    assert load_config(out).actuator == Ideal()
    assert (load_config(out).seed, load_config(out).total_steps, load_config(out).num_envs) == (3, 500, 2)
    assert load_config(out).agent.hidden == (8,)
    assert "next: codrl-mj evaluate runs/cartpole-ppo-ideal-3" in capsys.readouterr().out


def test_fields_are_set_over_the_named_actuator(tmp_path):
    flags = "--actuator weaker --actuator.controller.kp 0.3 --actuator.motor.inductance 0.07 --env.center-radius 0.1"
    more = "--actuator.controller.max-voltage inf --actuator.controller.bemf-compensation False --env.inner-steps 2"
    more += " --env.sutton-barto-reward True"
    assert main(["train", "cartpole", *flags.split(), *more.split(), *TINY, "--out", "run"]) == 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())["train"]["env"]
    weaker = named_actuator("weaker", "cartpole").as_mapping()
    assert config["actuator"]["controller"] == weaker["controller"] | {
        "kp": 0.3,
        "max_voltage": math.inf,
        "bemf_compensation": False,
    }
    assert config["actuator"]["motor"] == weaker["motor"] | {"inductance": 0.07}
    assert config["options"] == {"center_radius": 0.1, "sutton_barto_reward": True}
    assert config["inner_steps"] == 2


def test_evaluation_is_that_of_the_package(capsys, trained, tmp_path):
    assert main(["evaluate", str(trained), "--episodes", "7", "--seed", "5", "--out", "a/result.json"]) == 0
    result = json.loads((tmp_path / "a" / "result.json").read_text())
    make = EnvConfig("cartpole", "weaker").make
    totals = [episode.total for episode in run_episodes(load_policy(trained), make, 7, seed=5)]
    assert result["returns"]["mean"] == pytest.approx(np.mean(totals), rel=1e-12)
    assert result["returns"] == result["length"]  # 1 a step
    assert result["episodes"] == 7
    text = capsys.readouterr().out
    assert f"{np.mean(totals):.1f}" in text
    assert f"{result['tracking_rms']:.3g} N·m" in text


def test_several_policies_have_a_row_each_in_the_environment_of_their_own_training(capsys, trained, tmp_path):
    shutil.copytree(trained, tmp_path / "other" / trained.name)
    config = tmp_path / "other" / trained.name / "config.json"
    content = json.loads(config.read_text())
    content["train"]["env"]["actuator"] = "paper"
    content.pop("sha256", None)
    config.write_text(json.dumps(content))
    both = [str(trained), str(config.parent)]
    assert main(["evaluate", *both, "--episodes", "3", "--out", "both.json"]) == 0
    found = json.loads((tmp_path / "both.json").read_text())
    names = zip(both, ("weaker", "paper"), strict=True)
    assert list(found) == [f"{Path(one).parent.name}/{trained.name} on {motor}" for one, motor in names]
    for path, result in zip(both, found.values(), strict=True):
        assert main(["evaluate", path, "--episodes", "3", "--out", "one.json"]) == 0
        assert json.loads((tmp_path / "one.json").read_text()) == result
    assert len({json.dumps(one["conditions"]) for one in found.values()}) == 2
    assert "POLICY: none was given" in refused(capsys, "evaluate")


def test_what_the_study_does_not_know_is_advised_to_be_measured(capsys):
    said = refused(capsys, "advise", "re25", "Hopper-v5")
    assert "knows pendulum, cartpole" in said
    assert "--measure 5" in said


def test_a_policy_is_evaluated_on_any_actuator(trained, tmp_path):
    for name in ("as-trained", "weaker", "ideal", "paper"):
        assert main(["evaluate", str(trained), "--episodes", "4", "--actuator", name, "--out", f"{name}.json"]) == 0
    results = {path.stem: json.loads(path.read_text()) for path in tmp_path.glob("*.json")}
    assert results["as-trained"] == results["weaker"]
    assert results["ideal"]["tracking_rms"] == 0.0
    assert results["ideal"]["peak_voltage"] is None
    assert 0 < results["paper"]["tracking_rms"] < results["weaker"]["tracking_rms"]


def test_a_field_can_be_changed_on_the_actuator_trained_on(trained, tmp_path):
    line = ["evaluate", str(trained), "--episodes", "4", "--out"]
    assert main([*line, "starved.json", "--actuator.controller.max-voltage", "0.2"]) == 0
    starved = json.loads((tmp_path / "starved.json").read_text())
    assert starved["peak_voltage"] == 0.2
    assert starved["saturated_percent"] > 50


def test_commands_and_observations_are_those_of_the_training(capsys, tmp_path):
    levels = ["--env.action", "voltage", "--env.levels", "-3", "3", "--env.observe-actuator"]
    assert main(["train", "cartpole", "--actuator", "paper", *levels, *TINY, "--out", "volts"]) == 0
    assert main(["evaluate", "volts", "--episodes", "2", "--out", "result.json"]) == 0
    assert json.loads((tmp_path / "result.json").read_text())["peak_voltage"] == 3.0
    film = ["--out", "film.gif", "--width", "200", "--height", "120", "--env.max-episode-steps", "2"]
    assert main(["render", "volts", *film]) == 0
    assert main(["render", "cartpole", *levels, *film]) == 0
    assert main(["evaluate", "volts", *levels, "--episodes", "2", "--out", "said.json"]) == 0
    alone = tmp_path / "alone"  # without a run folder to say so, the flags do
    alone.mkdir()
    for name in ("policy.json", "policy.safetensors"):
        shutil.copy(tmp_path / "volts" / name, alone)
    flags = ["--task", "cartpole", "--actuator", "paper", *levels, "--episodes", "2", "--out", "alone.json"]
    assert main(["evaluate", "alone", *flags]) == 0
    results = [(tmp_path / f"{name}.json").read_text() for name in ("result", "said", "alone")]
    assert results == results[:1] * 3


@pytest.mark.parametrize("verb", ["evaluate", "render"])
@pytest.mark.parametrize("flags", ["--env.action current", "--env.levels -1 1", "--env.observe-actuator"])
def test_a_policy_commands_and_observes_nothing_but_what_it_was_trained_with(capsys, trained, verb, flags):
    error = refused(capsys, verb, str(trained), *flags.split())
    flag = flags.split()[0]
    assert f"{flag} = " in error
    assert f"leave {flag} out" in error


def test_a_run_is_evaluated_in_the_environment_of_its_training(tmp_path):
    assert main(["train", "cartpole", "--env.disturbances.command-delay", "0.1", *TINY, "--out", "late"]) == 0
    at_once = ["--env.disturbances.command-delay", "0"]
    assert main(["evaluate", "late", "--episodes", "3", "--out", "as_trained.json"]) == 0
    assert main(["evaluate", "late", "--episodes", "3", *at_once, "--out", "0.json"]) == 0
    found = [json.loads((tmp_path / name).read_text()) for name in ("as_trained.json", "0.json")]
    expected = evaluate(load_policy(tmp_path / "late"), load_config(tmp_path / "late").evaluation_env, 3)
    assert found[0] == json.loads(json.dumps(expected.as_mapping()))
    assert found[1] != found[0]


def test_sampled_actions_differ_from_the_most_likely(trained, tmp_path):
    assert main(["evaluate", str(trained), "--episodes", "5", "--out", "likely.json"]) == 0
    assert main(["evaluate", str(trained), "--episodes", "5", "--stochastic", "--out", "sampled.json"]) == 0
    assert (tmp_path / "likely.json").read_text() != (tmp_path / "sampled.json").read_text()


def test_a_run_can_be_filmed(capsys, trained, tmp_path):
    assert main(["render", str(trained), "--out", "film.mp4", "--width", "200", "--height", "120"]) == 0
    with imageio.get_reader(tmp_path / "film.mp4") as reader:
        assert reader.get_meta_data()["codec"] == "h264"
        assert reader.get_meta_data()["size"][0] == 200
    assert "wrote film.mp4" in capsys.readouterr().out


def test_a_task_can_be_filmed_with_random_actions_through_the_papers_motor(tmp_path):
    line = "render pendulum --env.max-episode-steps 3 --out film.gif --width 200 --height 120 --seed 2 --camera fixed"
    assert main(line.split()) == 0
    assert (tmp_path / "film.gif").read_bytes().startswith(b"GIF89a")


# -- for other programs -------------------------------------------------------------------------------------

WITH_NUMBERS = [
    # a line, and a number in its JSON by the keys on the way there
    (f"train cartpole {' '.join(TINY)} --out mine", "best return"),
    ("evaluate RUN --episodes 2", "returns mean"),
    ("runs RUN", "runs 0 evaluation_return"),
    ("runs --compare RUN RUN", "results seconds 1"),
    ("motor list", "motors 0 stall_torque"),
    ("motor show rev-neo --out pictures", "abilities 0 value"),
    ("motor design rev-neo", "phase_margin"),
    ("motor step rev-neo", "small settling_time"),
    ("motor feasible maxon-ec45-flat-50w pendulum --gear-ratio 20", "bounds 0 needed"),
    ("motor choose maxon-ec45-flat-50w pendulum --out chosen", "ranking 0 margin"),
    ("advise weak pendulum", "advice found lag"),
    ("identify plan maxon-ec45-flat-50w --duration 1", "best rate"),
]


@pytest.mark.parametrize(("line", "place"), WITH_NUMBERS)
def test_with_json_nothing_else_is_printed(capsys, trained, line, place):
    words = [str(trained) if word == "RUN" else word for word in line.split()]
    assert main([*words, "--json"]) in (0, 1)
    printed, errors = capsys.readouterr()
    found = json.loads(printed)
    assert (printed, errors) == (json.dumps(found, indent=2) + "\n", "")
    assert '"unit' in printed  # of each number, or of all by their names
    for key in place.split():
        found = found[int(key) if key.isdigit() else key]
    assert isinstance(found, float)


LOG = "log.csv --columns time=time:s,voltage=voltage:V,current=current:A,position=position:rad"
LOGGED = "identify simulate maxon-ec45-flat-50w --out log.csv --amplitude 12 --inertia 1e-4 --duration 1"
BEHIND = [
    # lines, separated by ;, the last of which is looked at
    *(line for line, _ in WITH_NUMBERS),
    "evaluate RUN RUN --episodes 2",
    "motor new my_motor.toml",
    "advise maxon-ec45-flat-50w pendulum --gear-ratio 20",
    "data",
    "cache",
    LOGGED,
    f"{LOGGED}; identify columns log.csv",
    f"{LOGGED}; identify check {LOG}",
    f"{LOGGED}; identify {LOG} --rig free --known load_inertia=1e-4 --out motor",
    "replay RUN --out run.html",
    "report RUN --no-film --out run.html",
    "export RUN --episodes 1",
]


@pytest.mark.parametrize("line", BEHIND)
def test_80_columns_hold_every_line_but_one_to_copy(capsys, request, monkeypatch, line):
    run = str(request.getfixturevalue("trained")) if "RUN" in line else ""
    capsys.readouterr()
    monkeypatch.setenv("COLUMNS", "80")
    for one in line.split(";"):
        assert main(one.replace("RUN", run).split()) in (0, 1)
    printed = capsys.readouterr()
    assert printed.err == ""
    assert "\x1b" not in printed.out
    wide = [text for text in map(str.rstrip, printed.out.splitlines()) if len(text) > 80]
    assert all(
        "codrl-mj " in text or "--columns" in text or text.startswith("wrote ") or "https://" in text for text in wide
    ), wide


@pytest.mark.parametrize("verb", [verb for verb in VERBS if hasattr(find_verb(verb), "as_json")])
def test_the_help_of_a_verb_with_numbers_has_json(capsys, verb):
    assert "--json Print JSON and nothing else" in helped(capsys, *verb.split())


def test_a_file_gets_neither_colours_nor_bars(capsys, trained, monkeypatch):
    capsys.readouterr()
    monkeypatch.setenv("TERM", "xterm-256color")
    assert main(["evaluate", str(trained), "--episodes", "2"]) == 0
    printed, errors = capsys.readouterr()
    assert errors == ""
    assert not {"\x1b", "━"} & {*printed}
    assert max(map(len, printed.splitlines())) <= 110


# -- actuators of any family --------------------------------------------------------------------------------

SHORT_FILM = ["--out", "film.gif", "--width", "160", "--height", "120", "--env.max-episode-steps", "2"]
OWN_FAMILY = """
import dataclasses
from pathlib import Path

from codrl_mj.actuators import Lag
from codrl_mj.fields import real

Path("executed").touch()


@dataclasses.dataclass(frozen=True)
class Slow(Lag):
    family = "slow"

    time_constant: float = real(0.5, least=0.0, unit="s")
    \"\"\"Half a second, if nothing else is said.\"\"\"
"""


@pytest.fixture
def own_family(tmp_path, monkeypatch):
    """A module of a user's with a family of actuators; a function that forgets having imported it."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "own_family.py").write_text(OWN_FAMILY)
    monkeypatch.syspath_prepend(str(tmp_path / "modules"))

    def forget():
        sys.modules.pop("own_family", None)
        (tmp_path / "executed").unlink(missing_ok=True)

    yield forget
    forget()


@pytest.mark.parametrize("verb", ["train", "evaluate", "render"])
def test_the_family_that_is_named_decides_on_the_flags(capsys, verb, trained, own_family):
    first = {"train": ["train", "cartpole"], "evaluate": ["evaluate", str(trained)], "render": ["render", str(trained)]}
    for actuator, flags in (
        ("lag", ("--actuator.time-constant", "--actuator.delay")),
        ("torque_speed", ("--actuator.stall-torque", "--actuator.no-load-speed", "--actuator.max-torque")),
        ("weaker", ("--actuator.motor.inductance", "--actuator.supply.resistance")),
        ("own_family:Slow", ("--actuator.time-constant", "Half a second")),
    ):
        text = helped(capsys, *first[verb], "--actuator", actuator)
        for flag in flags:
            assert flag in text
        assert ("--actuator.motor" in text) == (actuator == "weaker")


def test_fields_of_a_family_are_set_by_its_flags(tmp_path):
    flags = "--actuator lag --actuator.time-constant 0.1 --actuator.delay 0.02"
    assert main(["train", "cartpole", *flags.split(), *TINY]) == 0
    run = tmp_path / "runs" / "cartpole-ppo-lag-0"
    assert load_config(run).actuator == Lag(0.1, 0.02)
    for line in (["evaluate", str(run), "--episodes", "1", "--out", "e.json"], ["render", str(run), *SHORT_FILM]):
        assert main([*line, "--actuator.delay", "0.04"]) == 0
    described = json.loads(Path("e.json").read_text())["conditions"]["env"]["actuator"]
    assert described == {"family": "lag", "time_constant": 0.1, "delay": 0.04, "gain": 1.0}


def test_an_actuator_of_a_file_is_its_family_s(tmp_path):
    (tmp_path / "slow.yaml").write_text("{family: lag, time_constant: 0.3}")
    assert main(["render", "pendulum", "--actuator", "slow.yaml", "--actuator.delay", "0.05", *SHORT_FILM]) == 0


def test_a_module_that_a_run_names_is_imported_only_on_trust(capsys, own_family):
    assert main(["train", "pendulum", "--actuator", "own_family:Slow", *TINY, "--out", "run"]) == 0
    own_family()
    for line in ("evaluate run --episodes 1", "render run", "train --resume run", "train --config run/config.json"):
        assert "own_family:Slow': needs the module own_family" in refused(capsys, *line.split())
    assert main(["runs", ".", "--out", "runs.json"]) == 0
    assert [run["actuator"] for run in json.loads(Path("runs.json").read_text())["runs"]] == ["own_family:Slow"]
    assert not Path("executed").exists()
    assert main(["evaluate", "run", "--episodes", "1", "--trust", "--actuator.delay", "0.05"]) == 0
    assert Path("executed").exists()


def test_the_source_of_a_family_is_part_of_what_a_run_was_made_with(own_family, tmp_path):
    digests = []
    for text in (OWN_FAMILY, OWN_FAMILY.replace("0.5", "0.6")):
        own_family()
        (tmp_path / "modules" / "own_family.py").write_text(text)
        folder._code_digest.cache_clear()
        importlib.invalidate_caches()
        digests.append(folder.provenance(TrainConfig(EnvConfig("pendulum", "own_family:Slow")))["code"])
    folder._code_digest.cache_clear()
    assert len({*digests, folder.provenance(TrainConfig(EnvConfig("pendulum")))["code"]}) == 3


def test_so_is_the_file_of_a_model_of_somebody_s_own(tmp_path):
    arm, path = find_task("tests.own_project.arm:TASK"), tmp_path / "arm.xml"
    path.touch()
    register(dataclasses.replace(arm, name="copied_arm", env_id="tests/CopiedArm-v0", asset=str(path)))
    own, foreign = EnvConfig("copied_arm", "lag"), EnvConfig("HalfCheetah-v5", options={"xml_file": str(path)})
    digests = []
    model = (Path(gymnasium.__file__).parent / "envs/mujoco/assets/half_cheetah.xml").read_text()
    for text in (model, f"{model}<!-- changed -->"):
        path.write_text(text)
        folder._code_digest.cache_clear()
        digests += [folder.provenance(TrainConfig(env))["code"] for env in (own, foreign)]
    folder._code_digest.cache_clear()
    assert len(set(digests)) == 4


def test_a_task_and_an_agent_of_somebody_s_own_are_trained_by_where_they_are(capsys):
    task, agent = "tests.own_project.arm:TASK", "tests.own_project.a2c:A2CConfig"
    flags = "--agent.rollout-steps 16 --total-steps 64 --num-envs 2 --evaluation-episodes 1 --env.effort-weight 0.1"
    line = ["train", task, "--agent", agent, "--actuator", "lag", *flags.split(), "--out", "run"]
    assert main(line) == 0
    config = load_config(Path("run"), trust=True)
    assert (config.task, config.agent.rollout_steps, config.env.options.effort_weight) == (task, 16, 0.1)
    assert config.actuator == (Lag(), Lag())
    assert main(["evaluate", "run", "--trust", "--episodes", "1", "--env.effort-weight", "0.2"]) == 0
    assert main(["render", task, "--actuator", "lag", "--env.effort-weight", "0.2", *SHORT_FILM]) == 0


# -- exit status --------------------------------------------------------------------------------------------


def test_a_certificate_that_is_stopped_exits_with_130_and_leaves_nothing(monkeypatch, tmp_path):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("codrl_mj.validation.validate", interrupted)
    assert main(["validate", "cartpole", "--out", "certificate"]) == 130
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("", "codrl-mj needs a verb: try codrl-mj motor list, or codrl-mj train cartpole first; there are train,"),
        ("", "board, validate; codrl-mj --help says more"),
        ("trian cartpole", "unknown verb 'trian': did you mean 'train'? verbs are train, evaluate,"),
        ("motor", "codrl-mj motor needs a verb: there are list, new, show,"),
        ("motor lst", "unknown verb 'lst': did you mean 'list'? verbs are list, new, show,"),
        ("motor show", "codrl-mj motor show needs NAME;"),
        ("motor show maxon-ec45", "did you mean 'maxon-ec45-flat-339285' or 'maxon-ec45-flat-50w'?"),
        ("motor list --sort stal", "--sort stal: did you mean 'stall_torque'? must be one of"),
        ("identify check", "codrl-mj identify check needs --columns;"),
        ("train", "codrl-mj train needs TASK; codrl-mj train --help says more"),
        (
            "train pendulm --agent sac",
            "unknown task 'pendulm': did you mean 'pendulum'? It can be module:NAME of your own",
        ),
        ("train pendulm", "Gymnasium's goes by its id, such as HalfCheetah-v5"),
        ("render pendulm", "no run configuration at pendulm/config.json: did you mean 'pendulum'?"),
        ("train CartPole-v1", "has no MuJoCo model built from XML, and so no motors: take 'cartpole', our task"),
        ("train cartpole more", "unexpected 'more': codrl-mj train --help"),
        ("train cartpole --seed", "--seed needs a value: a whole number"),
        ("train cartpole --seed two", "--seed two: must be a whole number"),
        ("train cartpole --total-steps 1.5e0", "--total-steps 1.5: must be None or a whole number"),
        ("train cartpole --sed 3", "unknown flag --sed: did you mean '--seed'?"),
        ("train cartpole --kp 3", "unknown flag --kp: did you mean '--actuator.controller.kp'?"),
        ("train cartpole --agent pp", "--agent pp: did you mean 'ppo'? must be one of ppo, ddpg"),
        (
            "train cartpole --gear-ratio 20",
            "--gear-ratio: the actuator has no gear ratio; motors of codrl-mj motor list",
        ),
        (
            "train cartpole --actuator nope:X --actuator.efficiency 1",
            "'nope:X': No module named 'nope'; must be module:",
        ),
        ("train cartpole --actuator nope.py:X", "nope.py: there is no such file; must be FILE.py:NAME"),
        ("train cartpole --actuator ../up/nope.py:X", "nope.py: there is no such file; must be FILE.py:NAME"),
        ("train cartpole --num-envs 1e12 --agent dqn --out run", "num_envs = 1000000000000: takes about 3e+06 GB of"),
        ("train InvertedPendulum-v5 --num-envs 1e9", "num_envs = 1000000000: takes about 2e+05 GB of memory, of which"),
        ("view cartpole --port 99999", "--port 99999: must be from 1 to 65535"),
    ],
)
def test_a_line_that_is_not_understood_costs_one_line(capsys, line, expected):
    assert expected in refused(capsys, *line.split())


@pytest.mark.parametrize(
    "line",
    [
        *(
            "train cartpole --out {}",
            "evaluate run --out {}/e.json",
            "runs . --out {}/r.json",
            "render furuta --out {}/a.gif",
        ),
        *("render furuta --trajectory {}/a.npz", "replay furuta --out {}/a.html", "report run --out {}/a.html"),
        *(
            "motor show maxon-re65 --out {}",
            "motor show maxon-re65 --html {}/a.html",
            "motor design maxon-re65 --out {}",
        ),
        *(
            "motor choose pendulum --out {}",
            "identify plan maxon-re65 --out {}",
            "identify simulate maxon-re65 --out {}/l.csv",
        ),
        *("identify log.csv --columns time=t:s --out {}", "validate --out {}"),
    ],
)
def test_what_cannot_be_written_is_refused_before_anything_is_computed(capsys, tmp_path, line):
    (tmp_path / "file").touch()
    for place in ("file", "/proc/nowhere"):
        error = refused(capsys, *line.format(place).split())
        assert "cannot write to" in error
        assert Path(place).name in error


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("evaluate run --out .", "cannot write .: it is a folder"),
        ("replay furuta --out a.mp4", "the suffix is '.mp4', must be .html"),
        ("render furuta --trajectory a.csv", "the suffix is '.csv', must be .npz"),
    ],
)
def test_an_output_of_another_kind_is_refused(capsys, line, expected):
    assert expected in refused(capsys, *line.split())


def test_what_is_no_fault_of_the_input_is_one_line_and_whole_on_request(capsys, monkeypatch):
    monkeypatch.setattr("codrl_mj.runs.summaries.find_runs", lambda _: {}["absent"])
    assert refused(capsys, "runs") == "codrl-mj: error: KeyError: 'absent' (--traceback shows where)\n"
    assert main(["runs", "--traceback"]) == 2
    traced = capsys.readouterr().err
    assert traced.startswith("Traceback (most recent call last):")
    assert traced.endswith("codrl-mj: error: KeyError: 'absent' (--traceback shows where)\n")


def test_a_library_that_trips_over_ctrl_c_is_ctrl_c(capsys, monkeypatch):
    def imported(_):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            raise ImportError("initialisation of a library failed")  # noqa: B904

    monkeypatch.setattr("codrl_mj.runs.summaries.find_runs", imported)
    assert main(["runs"]) == 130
    assert capsys.readouterr().err == "codrl-mj: stopped: the same command begins anew\n"


def test_numbers_are_understood_as_people_write_them(monkeypatch):
    given = []
    monkeypatch.setattr("codrl_mj.cli.train.Train.run", lambda self: given.append(self) or 0)
    motor = "--actuator maxon-re65 --gear-ratio 20:1 --voltage=12 --total-steps 1e5 --num-envs 64 --agent.hidden 1e1 8"
    assert main(["train", "pendulum", "--agent", "ppo", *motor.split()]) == 0
    assert (given[0].total_steps, given[0].num_envs, given[0].agent.hidden) == (100_000, 64, (10, 8))
    assert given[0].actuator_fields.motor.gear_ratio == 20.0
    assert given[0].actuator_fields.supply.voltage == 12.0


def test_the_version_is_told(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"codrl-mj {codrl_mj.__version__}\n"


def test_the_short_help_has_every_flag_and_half_the_lines(capsys):
    long = helped(capsys, "train", "pendulum")
    with pytest.raises(SystemExit):
        main(["train", "pendulum", "-h"])
    short = capsys.readouterr().out
    assert set(re.findall(r" --[a-z][\w.-]+", long)) <= set(re.findall(r" --[a-z][\w.-]+", f" {short} --actuators "))
    assert "--help-verbose" in short
    assert short.count("\n") < 130


@pytest.mark.parametrize("missing", but(["torch"], ["torch", "stable_baselines3", "safetensors", "matplotlib"]))
def test_a_missing_extra_is_named_before_anything_is_written(tmp_path, missing):
    """In a process of its own, where nothing has been imported yet."""
    code = f"import sys; sys.modules[{missing!r}] = None; from codrl_mj.cli import main; sys.exit(main(sys.argv[1:]))"
    line = [sys.executable, "-c", code, "train", "cartpole", *TINY, "--out", "run"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("codrl-mj: error: ")
    assert "codrl-mj[all]" in done.stderr
    assert list(tmp_path.iterdir()) == []


# -- bad input ----------------------------------------------------------------------------------------------


BAD = [
    ("--actuator weakr", "did you mean 'weaker'"),
    ("--actuator.motor.inductance -0.1", "Motor.inductance = -0.1: must be a finite number > 0"),
    ("--actuator.motor.inductance nan", "Motor.inductance = nan: must be a finite number > 0"),
    ("--actuator.controller.substeps 0", "CurrentLoop.substeps = 0"),
    ("--actuator.controller.kp 100", "spectral radius"),
    ("--actuator ideal --actuator.controller.kp 1", "ideal actuator has no motor"),
    ("--env.inner-steps 0", "inner_steps = 0"),
    ("--env.integrator rk4", "integrator = 'rk4'"),
    ("--env.max-episode-steps 0", "max_episode_steps = 0"),
    ("--env.center-radius nan", "center_radius = nan"),
    ("--seed -1", "seed = -1"),
]


BAD_ANYWHERE = [(verb, *row) for row in BAD for verb in ("train", "evaluate", "render")]
OF_EACH = ("--actuator weakr", "--env.inner-steps 0", "--seed -1")


@pytest.mark.parametrize(
    ("verb", "flags", "expected"),
    but([row for row in BAD_ANYWHERE if row[0] == "train" or row[1] in OF_EACH], BAD_ANYWHERE),
)
def test_a_bad_actuator_environment_or_seed_is_refused(capsys, trained, verb, flags, expected):
    first = {"train": ["train", "cartpole"], "evaluate": ["evaluate", str(trained)], "render": ["render", str(trained)]}
    assert expected in refused(capsys, *first[verb], *flags.split())


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("--total-steps 0", "total_steps = 0"),
        ("--num-envs 0", "num_envs = 0"),
        ("--num-envs 3", "multiple of num_envs = 3"),
        ("--agent.gamma 1.5", "PPOConfig.gamma = 1.5"),
        ("--agent.learning-rate inf", "PPOConfig.learning_rate = inf"),
        ("--agent.batch-size 100", "multiple of batch_size = 100"),
    ],
)
def test_bad_training_settings_are_refused(capsys, flags, expected):
    assert expected in refused(capsys, "train", "cartpole", *flags.split(), "--out", "runs/run")


def test_an_option_of_another_task_is_refused(capsys):
    assert "center_radius" in refused(capsys, "train", "pendulum", "--env.center-radius", "0.1")


def test_an_existing_run_folder_is_refused(capsys, trained):
    before = {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()}
    assert "exists already" in refused(capsys, "train", "cartpole", *TINY, "--out", str(trained))
    assert {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("verb", ["evaluate", "render"])
def test_a_missing_run_folder_is_named(capsys, verb):
    assert "nowhere/config.json" in refused(capsys, verb, "nowhere")


@pytest.mark.parametrize("verb", ["evaluate", "render"])
@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("policy.json", b"{}"),
        ("policy.json", b'{"format": "codrl'),
        ("policy.safetensors", b"PK\x03\x04 not tensors"),
        ("policy.safetensors", None),
        ("config.json", b"[]"),
        ("config.json", b"{"),
    ],
)
def test_a_foreign_file_in_the_run_folder_is_named(capsys, trained, tmp_path, verb, file, content):
    run = tmp_path / "foreign"
    shutil.copytree(trained, run)
    (run / file).unlink()
    if content is not None:
        (run / file).write_bytes(content)
    assert file in refused(capsys, verb, str(run))


def test_a_policy_for_another_task_is_refused(capsys, trained, tmp_path):
    assert main(["train", "pendulum", *TINY, "--out", "pendulum"]) == 0
    capsys.readouterr()
    for name in ("policy.json", "policy.safetensors"):
        (tmp_path / "pendulum" / name).write_bytes((trained / name).read_bytes())
    assert "observation shape" in refused(capsys, "evaluate", "pendulum")


def test_zero_episodes_are_refused(capsys, trained):
    assert "episodes = 0" in refused(capsys, "evaluate", str(trained), "--episodes", "0", "--out", "result.json")


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("--camera drone", "cameras are fixed, close"),
        ("--width 641", "width = 641: must be even"),
        ("--height 0", "height = 0: must be >= 80"),
        ("--out film.avi", "unknown format '.avi'"),
    ],
)
def test_bad_film_settings_are_refused(capsys, flags, expected):
    line = ["render", "cartpole", "--env.max-episode-steps", "2", *flags.split()]
    assert expected in refused(capsys, *line)


@pytest.mark.parametrize("verb", ["render", "evaluate", "train"])
def test_an_output_that_cannot_be_written_is_named(capsys, trained, tmp_path, verb):
    (tmp_path / "file").write_text("in the way")
    lines = {
        "render": ["render", "cartpole", "--env.max-episode-steps", "2", "--out", "file/film.mp4"],
        "evaluate": ["evaluate", str(trained), "--episodes", "1", "--out", "file/result.json"],
        "train": ["train", "cartpole", *TINY, "--out", "file/run"],
    }
    assert "file" in refused(capsys, *lines[verb])


def test_a_verb_is_no_task_and_an_unknown_subject_is_no_run(capsys):
    assert "cartpol/config.json" in refused(capsys, "render", "cartpol")


# -- as a program -------------------------------------------------------------------------------------------


@pytest.mark.matrix
def test_the_program_trains_and_renders(tmp_path):
    for line in (
        "train cartpole --actuator weaker --out run " + " ".join(TINY),
        "render run --out film.mp4 --width 160 --height 80 --env.max-episode-steps 2",
    ):
        done = command(line, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        assert "wrote" in done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["film.mp4", "run"]


def test_the_program_ends_quietly_if_its_reader_has_enough():
    line = f"{sys.executable} -m codrl_mj train pendulum --help | head -1"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.startswith("usage: codrl-mj train")
    assert done.stderr == ""


def test_the_program_refuses_bad_input_with_status_2_and_one_line(tmp_path):
    done = command("train cartpole --actuator weakr", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("codrl-mj: error: unknown actuator 'weakr'")
    assert list(tmp_path.iterdir()) == []


def test_neither_the_help_nor_looking_a_motor_up_loads_anything_heavy():
    check = """
import contextlib, sys
from codrl_mj import catalogue, cli
for words in ("--help", "motor list"):
    with contextlib.suppress(SystemExit):
        cli.main(words.split())
[catalogue.motor_entry(one) for one in catalogue.motor_names()]
heavy = "torch", "numba", "stable_baselines3", "scipy", "matplotlib", "imageio", "dm_control", "rich.progress", "pint"
print("loaded:", [name for name in heavy if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines()[-1] == "loaded: []"


@pytest.mark.filterwarnings("always::UserWarning")
def test_draws_of_the_training_over_another_actuator_are_said(capsys):
    line = ["train", "cartpole", "--env.randomize", "motor.inductance=uniform(0.09, 0.11)", "--out", "drawn"]
    flags = "--agent.rollout-steps 64 --agent.batch-size 64 --total-steps 64 --num-envs 1 --evaluation-episodes 1"
    assert main([*line, *flags.split()]) == 0
    capsys.readouterr()
    assert main(["evaluate", "drawn", "--episodes", "1", "--actuator", "weak"]) == 0
    assert "motor.inductance of weak are drawn as in the training" in capsys.readouterr().err
    assert main(["evaluate", "drawn", "--episodes", "1", "--actuator", "weak", "--env.randomize", "None"]) == 0
    assert main(["evaluate", "drawn", "--episodes", "1"]) == 0
    assert "drawn as in" not in capsys.readouterr().err


def test_training_says_first_what_is_assumed_of_the_motor(capsys, monkeypatch):
    monkeypatch.setattr("codrl_mj.training.train", lambda *_, **__: None)
    assert main(["train", "pendulum", "--actuator", "maxon-ec45-flat-339285", "--out", "assumed"]) == 0
    assumed = "assumed, for none is given: supply.voltage = 24 V, controller.max_current = inf"
    assert capsys.readouterr().out.splitlines()[0] == assumed
    flags = "--actuator.supply.voltage", "12", "--actuator.controller.max-current", "5"
    assert main(["train", "pendulum", "--actuator", "maxon-ec45-flat-339285", "--out", "assumed", *flags]) == 0
    assert "assumed, for" not in capsys.readouterr().out


@pytest.mark.parametrize("program", [[str(PROGRAM)], [sys.executable, "-m", "codrl_mj"]])
def test_ctrl_c_while_the_program_is_imported_is_one_line(program):
    """At its first import of a library, whatever that takes."""
    code = "import os, signal, sys\nclass Stop:\n    def find_spec(self, name, *_):\n"
    code += (
        "        if name == 'tyro':\n            os.kill(os.getpid(), signal.SIGINT)\nsys.meta_path.insert(0, Stop())\n"
    )
    Path("sitecustomize.py").write_text(code)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path.cwd()), *filter(None, sys.path)])}
    done = subprocess.run(
        [*program, "--help"], capture_output=True, text=True, timeout=60, check=False, env=environment
    )
    assert (done.returncode, done.stderr) == (130, "codrl-mj: stopped before anything was begun\n")
