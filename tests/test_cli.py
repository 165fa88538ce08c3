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
from codrl_mj.actuators import NAMED, CurrentLoop, Lag, Motor, Supply
from codrl_mj.agents.presets import ELSEWHERE, PRESETS
from codrl_mj.cli import VERBS, find_verb, main
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import evaluate, run_episodes
from codrl_mj.runs.policies import load_policy
from codrl_mj.tasks import TASKS, find_task, named_actuator
from codrl_mj.training import TrainConfig, folder, load_config
from tests.matrix import but

PROGRAM = Path(sys.executable).with_name("codrl-mj")
TINY = (
    "--total-steps 500 --num-envs 2 --agent ppo "
    "--agent.rollout-steps 256 --agent.batch-size 64 --agent.epochs 1 --agent.hidden 8"
)
SMALL_FILM = "--width 200 --height 120 --env.max-episode-steps 2"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Every test runs in an empty folder."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A tiny run of CartPole through the actuator `weaker`."""
    out = tmp_path_factory.mktemp("trained") / "run"
    ran(f"train cartpole --actuator weaker {TINY} --out {out}")
    return out


def ran(line):
    assert main(line.split()) == 0


def read(name):
    return json.loads(Path(name).read_text())


def contents(folder):
    return {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")}


def helped(capsys, *verb):
    """The help text as one line, without its frame."""
    with pytest.raises(SystemExit) as done:
        main([*verb, "--help"])
    assert done.value.code == 0
    return " ".join(capsys.readouterr().out.translate(str.maketrans("│╭╮╰╯─", "      ")).split())


def refused(capsys, line):
    """The one line that bad input costs; nothing is written."""
    before = contents(Path.cwd())
    assert main(line.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith("codrl-mj: error: ")
    assert error.count("\n") == 1
    assert "Traceback" not in error
    assert contents(Path.cwd()) == before
    return error


# -- help ---------------------------------------------------------------------------------------------------

TAUGHT = {
    "": [
        f"{what}{verb}" for verb in ("train", "evaluate", "render", "validate") for what in ("• ", "Example: codrl-mj ")
    ],
    "train": [f"{{{','.join(TASKS)}}}", "cartpole --actuator weaker --env.center-radius 0.1 --out runs/through-weaker"],
    "evaluate": ["codrl-mj evaluate runs/cartpole-ppo-ideal-0 --actuator weaker --episodes 100"],
    "render": ["codrl-mj render runs/cartpole-ppo-weaker-0 --out balance.mp4"],
    "validate": [f"{{{','.join(TASKS)}}}", "validate cartpole --out certificate", "validate --model robot.xml"],
}


@pytest.mark.parametrize("verb", TAUGHT)
def test_the_help_lists_verbs_and_tasks_and_gives_examples(capsys, verb):
    text = helped(capsys, *verb.split())
    assert [one for one in TAUGHT[verb] if one not in text] == []


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
    names = {field.name for field in dataclasses.fields(EnvConfig)} - {"task", "actuator", "options"}
    for flag in (*(f"env.{name.replace('_', '-')}" for name in names), "env.center-radius", "seed", "out"):
        assert f"--{flag}" in text


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


def test_the_short_help_has_every_flag_and_half_the_lines(capsys):
    long = helped(capsys, "train", "pendulum")
    with pytest.raises(SystemExit):
        main(["train", "pendulum", "-h"])
    short = capsys.readouterr().out
    assert set(re.findall(r" --[a-z][\w.-]+", long)) <= set(re.findall(r" --[a-z][\w.-]+", f" {short} --actuators "))
    assert "--help-verbose" in short
    assert short.count("\n") < 130


@pytest.mark.parametrize("verb", [verb for verb in VERBS if hasattr(find_verb(verb), "as_json")])
def test_the_help_of_a_verb_with_numbers_has_json(capsys, verb):
    assert "--json Print JSON and nothing else" in helped(capsys, *verb.split())


# -- train, evaluate, render --------------------------------------------------------------------------------


def test_training_leaves_a_run_folder_whose_fields_are_set_over_the_named_actuator(capsys):
    loop = "--actuator.controller.kp 0.3 --actuator.controller.max-voltage inf"
    more = "--actuator.controller.bemf-compensation False --actuator.motor.inductance 0.07"
    env = "--env.center-radius 0.1 --env.inner-steps 2 --env.sutton-barto-reward True"
    ran(f"train cartpole --actuator weaker --seed 3 {loop} {more} {env} {TINY}")
    assert "next: codrl-mj evaluate runs/cartpole-ppo-weaker-3" in capsys.readouterr().out
    config = load_config(Path("runs/cartpole-ppo-weaker-3"))
    assert (config.seed, config.total_steps, config.num_envs, config.agent.hidden) == (3, 500, 2, (8,))
    assert (config.env.options.center_radius, config.env.options.sutton_barto_reward) == (0.1, True)
    assert config.env.inner_steps == 2
    changed = {"kp": 0.3, "max_voltage": math.inf, "bemf_compensation": False}
    changed = {f"controller.{name}": value for name, value in changed.items()} | {"motor.inductance": 0.07}
    assert config.actuator == named_actuator("weaker", "cartpole").replaced(changed)


def test_evaluation_is_that_of_the_package_and_a_file_gets_no_colours(capsys, trained, monkeypatch):
    capsys.readouterr()
    monkeypatch.setenv("TERM", "xterm-256color")
    ran(f"evaluate {trained} --episodes 7 --seed 5 --out a/result.json")
    result = read("a/result.json")
    make = EnvConfig("cartpole", "weaker").make
    totals = [episode.total for episode in run_episodes(load_policy(trained), make, 7, seed=5)]
    assert result["returns"]["mean"] == pytest.approx(np.mean(totals), rel=1e-12)
    assert result["returns"] == result["length"]  # 1 a step
    assert result["episodes"] == 7
    text, errors = capsys.readouterr()
    assert not {"\x1b", "━"} & {*text, *errors}
    assert f"{np.mean(totals):.1f}" in text
    assert f"{result['tracking_rms']:.3g} N·m" in text


def test_several_policies_have_a_row_each_in_the_environment_of_their_own_training(trained):
    shutil.copytree(trained, Path("other", trained.name))
    config = Path("other", trained.name, "config.json")
    content = read(config)
    content["train"]["env"]["actuator"] = "paper"
    content.pop("sha256", None)
    config.write_text(json.dumps(content))
    both = {str(trained): "weaker", str(config.parent): "paper"}
    ran(f"evaluate {' '.join(both)} --episodes 3 --out both.json")
    found = read("both.json")
    assert list(found) == [f"{Path(one).parent.name}/{trained.name} on {motor}" for one, motor in both.items()]
    for path, result in zip(both, found.values(), strict=True):
        ran(f"evaluate {path} --episodes 3 --out one.json")
        assert read("one.json") == result
    assert len({json.dumps(one["conditions"]) for one in found.values()}) == 2


def test_a_policy_is_evaluated_on_any_actuator_with_any_field_and_sampled_actions(trained):
    conditions = {name: f"--actuator {name}" for name in ("as-trained", "weaker", "ideal", "paper")}
    conditions |= {"starved": "--actuator.controller.max-voltage 0.2", "sampled": "--stochastic"}
    for name, flags in conditions.items():
        ran(f"evaluate {trained} --episodes 4 {flags} --out {name}.json")
    results = {name: read(f"{name}.json") for name in conditions}
    assert results["as-trained"] == results["weaker"]
    assert results["ideal"]["tracking_rms"] == 0.0
    assert results["ideal"]["peak_voltage"] is None
    assert 0 < results["paper"]["tracking_rms"] < results["weaker"]["tracking_rms"]
    assert results["starved"]["peak_voltage"] == 0.2
    assert results["starved"]["saturated_percent"] > 50
    assert results["sampled"]["returns"] != results["weaker"]["returns"]  # the others are of the most likely actions


def policy_alone(run):
    """Its policy in a folder `alone`, that says nothing of the run."""
    Path("alone").mkdir()
    for name in ("policy.json", "policy.safetensors"):
        shutil.copy(run / name, "alone")


def test_a_run_is_evaluated_and_filmed_in_the_environment_of_its_training():
    levels = "--env.action voltage --env.levels -3 3 --env.observe-actuator"
    env = f"{levels} --env.disturbances.command-delay 0.1"
    ran(f"train cartpole --actuator paper {env} {TINY} --out volts")
    policy_alone(Path("volts"))
    for subject in ("volts", f"volts {env}", f"alone --task cartpole --actuator paper {env}"):
        ran(f"evaluate {subject} --episodes 2 --out {len(subject)}.json")
    first, *others = (path.read_text() for path in Path().glob("*.json"))
    assert others == [first] * 2
    expected = evaluate(load_policy(Path("volts")), load_config(Path("volts")).evaluation_env, 2)
    assert json.loads(first) == json.loads(json.dumps(expected.as_mapping()))
    assert expected.peak_voltage == 3.0
    ran("evaluate volts --episodes 2 --env.disturbances.command-delay 0 --out at_once.json")
    assert read("at_once.json")["returns"] != json.loads(first)["returns"]
    for subject in ("volts", f"cartpole {levels}"):
        ran(f"render {subject} --out film.gif {SMALL_FILM}")


def test_a_run_can_be_filmed_and_a_task_with_random_actions(capsys, trained):
    ran(f"render {trained} --out film.mp4 --width 200 --height 120")
    with imageio.get_reader("film.mp4") as reader:
        assert reader.get_meta_data()["codec"] == "h264"
        assert reader.get_meta_data()["size"][0] == 200
    assert "wrote film.mp4" in capsys.readouterr().out
    ran(f"render pendulum --out film.gif {SMALL_FILM} --seed 2 --camera fixed")
    assert Path("film.gif").read_bytes().startswith(b"GIF89a")


# -- for other programs -------------------------------------------------------------------------------------

WITH_NUMBERS = [
    # a line, and a number in its JSON by the keys on the way there
    (f"train cartpole {TINY} --out mine", "best return"),
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


TO_COPY = "codrl-mj |--columns|^wrote |https://"


@pytest.mark.parametrize("line", BEHIND)
def test_80_columns_hold_every_line_but_one_to_copy(capsys, trained, monkeypatch, line):
    capsys.readouterr()
    monkeypatch.setenv("COLUMNS", "80")
    for one in line.split(";"):
        assert main(one.replace("RUN", str(trained)).split()) in (0, 1)
    printed = capsys.readouterr()
    assert printed.err == ""
    assert "\x1b" not in printed.out
    lines = map(str.rstrip, printed.out.splitlines())
    assert [text for text in lines if len(text) > 80 and not re.search(TO_COPY, text)] == []


# -- actuators of any family --------------------------------------------------------------------------------

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


@pytest.mark.parametrize("first", ["train cartpole", "evaluate RUN", "render RUN"])
def test_the_family_that_is_named_decides_on_the_flags(capsys, first, trained, own_family):
    for actuator, flags in {
        "lag": ("--actuator.time-constant", "--actuator.delay"),
        "torque_speed": ("--actuator.stall-torque", "--actuator.no-load-speed", "--actuator.max-torque"),
        "weaker": ("--actuator.motor.inductance", "--actuator.supply.resistance"),
        "own_family:Slow": ("--actuator.time-constant", "Half a second"),
    }.items():
        text = helped(capsys, *first.replace("RUN", str(trained)).split(), "--actuator", actuator)
        assert [flag for flag in flags if flag not in text] == []
        assert ("--actuator.motor" in text) == (actuator == "weaker")


def test_fields_of_a_family_are_set_by_its_flags():
    ran(f"train cartpole --actuator lag --actuator.time-constant 0.1 --actuator.delay 0.02 {TINY} --out run")
    assert load_config(Path("run")).actuator == Lag(0.1, 0.02)
    ran("evaluate run --episodes 1 --out e.json --actuator.delay 0.04")
    described = {"family": "lag", "time_constant": 0.1, "delay": 0.04, "gain": 1.0}
    assert read("e.json")["conditions"]["env"]["actuator"] == described
    Path("slow.yaml").write_text("{family: lag, time_constant: 0.3}")
    for subject in ("run", "pendulum --actuator slow.yaml"):
        ran(f"render {subject} --actuator.delay 0.05 --out film.gif {SMALL_FILM}")


def test_a_module_that_a_run_names_is_imported_only_on_trust(capsys, own_family):
    ran(f"train pendulum --actuator own_family:Slow {TINY} --out run")
    own_family()
    for line in ("evaluate run --episodes 1", "render run", "train --resume run", "train --config run/config.json"):
        assert "own_family:Slow': needs the module own_family" in refused(capsys, line)
    ran("runs . --out runs.json")
    assert [run["actuator"] for run in read("runs.json")["runs"]] == ["own_family:Slow"]
    assert not Path("executed").exists()
    ran("evaluate run --episodes 1 --trust --actuator.delay 0.05")
    assert Path("executed").exists()


def code_of(env):
    """What stands in a run folder of the code that it was made with."""
    importlib.invalidate_caches()
    folder._code_digest.cache_clear()
    code = folder.provenance(TrainConfig(env))["code"]
    folder._code_digest.cache_clear()
    return code


def test_the_source_of_a_family_is_part_of_what_a_run_was_made_with(own_family, tmp_path):
    digests = {code_of(EnvConfig("pendulum"))}
    for text in (OWN_FAMILY, OWN_FAMILY.replace("0.5", "0.6")):
        own_family()
        (tmp_path / "modules" / "own_family.py").write_text(text)
        digests.add(code_of(EnvConfig("pendulum", "own_family:Slow")))
    assert len(digests) == 3


def test_so_is_the_file_of_a_model_of_somebody_s_own(tmp_path):
    arm, path = find_task("tests.own_project.arm:TASK"), tmp_path / "arm.xml"
    path.touch()
    register(dataclasses.replace(arm, name="copied_arm", env_id="tests/CopiedArm-v0", asset=str(path)))
    own, foreign = EnvConfig("copied_arm", "lag"), EnvConfig("HalfCheetah-v5", options={"xml_file": str(path)})
    digests = set()
    model = (Path(gymnasium.__file__).parent / "envs/mujoco/assets/half_cheetah.xml").read_text()
    for text in (model, f"{model}<!-- changed -->"):
        path.write_text(text)
        digests |= {code_of(own), code_of(foreign)}
    assert len(digests) == 4


# -- bad input ----------------------------------------------------------------------------------------------

REFUSED = [
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
    ("train pendulm --agent sac", "'pendulm': did you mean 'pendulum'? It can be module:NAME of your own"),
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
    ("train cartpole --gear-ratio 20", "--gear-ratio: the actuator has no gear ratio; motors of codrl-mj motor list"),
    ("train cartpole --actuator nope:X --actuator.efficiency 1", "'nope:X': No module named 'nope'; must be module:"),
    ("train cartpole --actuator nope.py:X", "nope.py: there is no such file; must be FILE.py:NAME"),
    ("train cartpole --actuator ../up/nope.py:X", "nope.py: there is no such file; must be FILE.py:NAME"),
    ("train cartpole --num-envs 1e12 --agent dqn --out run", "num_envs = 1000000000000: takes about 3e+06 GB of"),
    ("train InvertedPendulum-v5 --num-envs 1e9", "num_envs = 1000000000: takes about 2e+05 GB of memory, of which"),
    ("view cartpole --port 99999", "--port 99999: must be from 1 to 65535"),
    ("train cartpole --total-steps 0", "total_steps = 0"),
    ("train cartpole --num-envs 0", "num_envs = 0"),
    ("train cartpole --num-envs 3", "multiple of num_envs = 3"),
    ("train cartpole --agent.gamma 1.5", "PPOConfig.gamma = 1.5"),
    ("train cartpole --agent.learning-rate inf", "PPOConfig.learning_rate = inf"),
    ("train cartpole --agent.batch-size 100", "multiple of batch_size = 100"),
    ("train pendulum --env.center-radius 0.1", "center_radius"),
    (f"train cartpole {TINY} --out RUN", "exists already"),
    ("evaluate", "POLICY: none was given"),
    ("evaluate RUN --episodes 0 --out result.json", "episodes = 0"),
    ("evaluate run --out .", "cannot write .: it is a folder"),
    ("evaluate nowhere --actuator weaker --episodes 100", "no run configuration at nowhere/config.json"),
    ("render nowhere --out balance.mp4", "nowhere/config.json"),
    ("render cartpole --camera drone", "cameras are fixed, close"),
    ("render cartpole --width 641", "width = 641: must be even"),
    ("render cartpole --height 0", "height = 0: must be >= 80"),
    ("render cartpole --out film.avi", "unknown format '.avi'"),
    ("render furuta --trajectory a.csv", "the suffix is '.csv', must be .npz"),
    ("replay furuta --out a.mp4", "the suffix is '.mp4', must be .html"),
    ("advise re25 Hopper-v5", "knows pendulum, cartpole"),
    ("advise re25 Hopper-v5", "--measure 5"),
    *(
        (f"{verb} RUN {flag}{value}", f"{text}{flag}{end}")
        for verb in ("evaluate", "render")
        for flag, value in (("--env.action", " current"), ("--env.levels", " -1 1"), ("--env.observe-actuator", ""))
        for text, end in (("", " = "), ("leave ", " out"))
    ),
]
EVERYWHERE = {
    "--actuator weakr": "did you mean 'weaker'",
    "--env.inner-steps 0": "inner_steps = 0",
    "--seed -1": "seed = -1",
    "--actuator.motor.inductance -0.1": "Motor.inductance = -0.1: must be a finite number > 0",
    "--actuator.motor.inductance nan": "Motor.inductance = nan: must be a finite number > 0",
    "--actuator.controller.substeps 0": "CurrentLoop.substeps = 0",
    "--actuator.controller.kp 100": "spectral radius",
    "--actuator ideal --actuator.controller.kp 1": "ideal actuator has no motor",
    "--env.integrator rk4": "integrator = 'rk4'",
    "--env.max-episode-steps 0": "max_episode_steps = 0",
    "--env.center-radius nan": "center_radius = nan",
}
OF_TRAINING = [(f"train cartpole {flags}", says) for flags, says in EVERYWHERE.items()]
OF_A_RUN = [(f"{verb} RUN {flags}", says) for flags, says in EVERYWHERE.items() for verb in ("evaluate", "render")]


@pytest.mark.parametrize(("line", "says"), [*REFUSED, *OF_TRAINING, *but(OF_A_RUN[:6], OF_A_RUN)])
def test_a_line_that_cannot_be_followed_costs_one_line(capsys, trained, line, says):
    before = contents(trained)
    assert says in refused(capsys, line.replace("RUN", str(trained)))
    assert contents(trained) == before


UNWRITABLE = """
train cartpole --out {}
train cartpole --out {}/run
evaluate run --out {}/e.json
runs . --out {}/r.json
render furuta --out {}/a.gif
render furuta --trajectory {}/a.npz
replay furuta --out {}/a.html
report run --out {}/a.html
motor show maxon-re65 --out {}
motor show maxon-re65 --html {}/a.html
motor design maxon-re65 --out {}
motor choose pendulum --out {}
identify plan maxon-re65 --out {}
identify simulate maxon-re65 --out {}/l.csv
identify log.csv --columns time=t:s --out {}
validate --out {}
"""


@pytest.mark.parametrize("line", UNWRITABLE.strip().split("\n"))
def test_what_cannot_be_written_is_refused_before_anything_is_computed(capsys, line):
    Path("file").touch()
    for place in ("file", "/proc/nowhere"):
        error = refused(capsys, line.format(place))
        assert "cannot write to" in error
        assert Path(place).name in error


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
def test_a_foreign_file_in_the_run_folder_is_named(capsys, trained, verb, file, content):
    shutil.copytree(trained, "foreign")
    Path("foreign", file).unlink() if content is None else Path("foreign", file).write_bytes(content)
    assert file in refused(capsys, f"{verb} foreign")


def test_a_policy_for_another_task_is_refused(capsys, trained):
    policy_alone(trained)
    assert "observation shape" in refused(capsys, "evaluate alone --task pendulum")


def stopped(*_, **__):
    raise KeyboardInterrupt


def stopped_in_a_library(*_):
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt:
        raise ImportError("initialisation of a library failed")  # noqa: B904


@pytest.mark.parametrize(
    ("line", "function", "how"),
    [
        ("validate cartpole --out certificate", "validation.validate", stopped),
        ("runs", "runs.summaries.find_runs", stopped_in_a_library),
    ],
)
def test_what_is_stopped_exits_with_130_and_leaves_nothing(monkeypatch, tmp_path, capsys, line, function, how):
    monkeypatch.setattr(f"codrl_mj.{function}", how)
    assert main(line.split()) == 130
    assert capsys.readouterr().err == "codrl-mj: stopped: the same command begins anew\n"
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_fault_of_the_input_is_one_line_and_whole_on_request(capsys, monkeypatch):
    monkeypatch.setattr("codrl_mj.runs.summaries.find_runs", lambda _: {}["absent"])
    assert refused(capsys, "runs") == "codrl-mj: error: KeyError: 'absent' (--traceback shows where)\n"
    assert main(["runs", "--traceback"]) == 2
    traced = capsys.readouterr().err
    assert traced.startswith("Traceback (most recent call last):")
    assert traced.endswith("codrl-mj: error: KeyError: 'absent' (--traceback shows where)\n")


# -- what is said -------------------------------------------------------------------------------------------


def test_numbers_are_understood_as_people_write_them(monkeypatch):
    given = []
    monkeypatch.setattr("codrl_mj.cli.train.Train.run", lambda self: given.append(self) or 0)
    motor = "--actuator maxon-re65 --gear-ratio 20:1 --voltage=12"
    ran(f"train pendulum --agent ppo {motor} --total-steps 1e5 --num-envs 64 --agent.hidden 1e1 8")
    assert (given[0].total_steps, given[0].num_envs, given[0].agent.hidden) == (100_000, 64, (10, 8))
    assert given[0].actuator_fields.motor.gear_ratio == 20.0
    assert given[0].actuator_fields.supply.voltage == 12.0


@pytest.mark.filterwarnings("always::UserWarning")
def test_draws_of_the_training_over_another_actuator_are_said(capsys):
    flags = "--agent.rollout-steps 64 --agent.batch-size 64 --total-steps 64 --num-envs 1 --evaluation-episodes 1"
    ran(f"train cartpole --env.randomize motor.inductance=uniform(0.09,0.11) {flags} --out drawn")
    capsys.readouterr()
    ran("evaluate drawn --episodes 1 --actuator weak")
    assert "motor.inductance of weak are drawn as in the training" in capsys.readouterr().err
    ran("evaluate drawn --episodes 1 --actuator weak --env.randomize None")
    ran("evaluate drawn --episodes 1")
    assert "drawn as in" not in capsys.readouterr().err


def test_training_says_first_what_is_assumed_of_the_motor(capsys, monkeypatch):
    monkeypatch.setattr("codrl_mj.training.train", lambda *_, **__: None)
    line = "train pendulum --actuator maxon-ec45-flat-339285 --out assumed"
    ran(line)
    assumed = "assumed, for none is given: supply.voltage = 24 V, controller.max_current = inf"
    assert capsys.readouterr().out.splitlines()[0] == assumed
    ran(f"{line} --actuator.supply.voltage 12 --actuator.controller.max-current 5")
    assert "assumed, for" not in capsys.readouterr().out


# -- as a program -------------------------------------------------------------------------------------------


def program(*words, **options):
    return subprocess.run(words, capture_output=True, text=True, timeout=120, check=False, **options)


@pytest.mark.parametrize("missing", but(["torch"], ["torch", "stable_baselines3", "safetensors", "matplotlib"]))
def test_a_missing_extra_is_named_before_anything_is_written(tmp_path, missing):
    """In a process of its own, where nothing has been imported yet."""
    code = f"import sys; sys.modules[{missing!r}] = None; from codrl_mj.cli import main; sys.exit(main(sys.argv[1:]))"
    done = program(sys.executable, "-c", code, *f"train cartpole {TINY} --out run".split())
    assert done.returncode == 2
    assert done.stderr.startswith("codrl-mj: error: ")
    assert "codrl-mj[all]" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_program_tells_its_version_and_refuses_bad_input_with_status_2_and_one_line(tmp_path):
    assert program(PROGRAM, "--version").stdout == f"codrl-mj {codrl_mj.__version__}\n"
    done = program(PROGRAM, "train", "cartpole", "--actuator", "weakr")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("codrl-mj: error: unknown actuator 'weakr'")
    assert list(tmp_path.iterdir()) == []


def test_the_program_ends_quietly_if_its_reader_has_enough():
    done = program("bash", "-c", f"{sys.executable} -m codrl_mj train pendulum --help | head -1")
    assert done.stdout.startswith("usage: codrl-mj train")
    assert done.stderr == ""


LOOKED_UP = """
import contextlib, sys
from codrl_mj import catalogue, cli
for words in ("--help", "motor list"):
    with contextlib.suppress(SystemExit):
        cli.main(words.split())
[catalogue.motor_entry(one) for one in catalogue.motor_names()]
heavy = "torch", "numba", "stable_baselines3", "scipy", "matplotlib", "imageio", "dm_control", "rich.progress", "pint"
print("loaded:", [name for name in heavy if name in sys.modules])
"""


def test_neither_the_help_nor_looking_a_motor_up_loads_anything_heavy():
    assert program(sys.executable, "-c", LOOKED_UP).stdout.splitlines()[-1] == "loaded: []"


STOPPED_AT_AN_IMPORT = """
import os, signal, sys
class Stop:
    def find_spec(self, name, *_):
        if name == 'tyro':
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Stop())
"""


@pytest.mark.parametrize("words", [[str(PROGRAM)], [sys.executable, "-m", "codrl_mj"]])
def test_ctrl_c_while_the_program_is_imported_is_one_line(words):
    """At its first import of a library, whatever that takes."""
    Path("sitecustomize.py").write_text(STOPPED_AT_AN_IMPORT)
    path = os.pathsep.join([str(Path.cwd()), *filter(None, sys.path)])
    done = program(*words, "--help", env=os.environ | {"PYTHONPATH": path})
    assert (done.returncode, done.stderr) == (130, "codrl-mj: stopped before anything was begun\n")
