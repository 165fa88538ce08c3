"""Help of the command line, and results of its verbs."""

import dataclasses
import json
import math
import re
import shutil
from pathlib import Path

import imageio
import numpy as np
import pytest

from codrl_mj.actuators import NAMED, CurrentLoop, Motor, Supply
from codrl_mj.agents.presets import OTHER_ENV, PRESETS
from codrl_mj.cli import VERBS, find_verb, main
from codrl_mj.envs.config import EnvConfig, find_source
from codrl_mj.evaluation import evaluate, run_episodes
from codrl_mj.runs.policies import load_policy
from codrl_mj.tasks import TASKS, named_actuator
from codrl_mj.training import TrainConfig, load_config
from tests.cli.lines import SMALL_FILM, TINY, copy_policy_only, help_text, read_json, run_ok

# -- help -----------------------------------------------------------------------------------------

HELP_FRAGMENTS = {
    "": [
        f"{prefix}{verb}"
        for verb in ("train", "evaluate", "render", "validate")
        for prefix in ("• ", "Example: codrl-mj ")
    ],
    "train": [
        f"{{{','.join(TASKS)}}}",
        "cartpole --actuator weaker --env.center-radius 0.1 --out runs/through-weaker",
    ],
    "evaluate": ["codrl-mj evaluate runs/cartpole-ppo-ideal-0 --actuator weaker --episodes 100"],
    "render": ["codrl-mj render runs/cartpole-ppo-weaker-0 --out balance.mp4"],
    "validate": [
        f"{{{','.join(TASKS)}}}",
        "validate cartpole --out certificate",
        "validate --model robot.xml",
    ],
}


@pytest.mark.parametrize("verb", HELP_FRAGMENTS)
def test_the_help_lists_verbs_and_tasks_and_gives_examples(capsys, verb):
    text = help_text(capsys, *verb.split())
    assert [fragment for fragment in HELP_FRAGMENTS[verb] if fragment not in text] == []


@pytest.mark.parametrize("verb", ["train", "evaluate", "render"])
def test_the_help_explains_every_named_actuator_and_every_field_with_its_unit(capsys, verb):
    text = help_text(capsys, verb)
    for name, (description, _) in NAMED.items():
        assert f"{name}: {description}" in text
    for part, kind in (("motor", Motor), ("controller", CurrentLoop), ("supply", Supply)):
        for field in dataclasses.fields(kind):
            assert f"--actuator.{part}.{field.name.replace('_', '-')}" in text
    for unit in (
        "[ohm]",
        "[H]",
        "[N*m/A]",
        "[V*s/rad]",
        "[m]",
        "[V/A]",
        "[V/(A*s)]",
        "[V*s/A]",
        "[1/s]",
        "[s]",
    ):
        assert unit in text
    names = {*find_source("cartpole").fields} - {"task", "actuator", "options"}
    for flag in (
        *(f"env.{name.replace('_', '-')}" for name in names),
        "env.center-radius",
        "seed",
        "out",
    ):
        assert f"--{flag}" in text


@pytest.mark.parametrize(
    ("agent", "task", "settings"),
    [
        (agent, task if task != OTHER_ENV else "InvertedPendulum-v5", name)
        for (agent, task), named in PRESETS.items()
        for name in named
    ],
)
def test_the_help_shows_every_default_of_the_agent(capsys, agent, task, settings):
    text = help_text(capsys, "train", task, "--agent", agent, "--settings", settings)
    config = TrainConfig.preset(task, agent, settings)
    values = {
        f"--agent.{field.name}": getattr(config.agent, field.name)
        for field in dataclasses.fields(config.agent)
    }
    values |= {
        f"--{name}": getattr(config, name)
        for name in ("seed", "total_steps", "total_episodes", "num_envs")
    }
    values["--env.max_episode_steps"] = config.env.max_episode_steps
    if isinstance(config.env, EnvConfig):
        values["--env.center_radius"] = config.env.as_mapping()["options"].get("center_radius")
    for name, value in values.items():
        *_, flag = re.split(
            rf" {name.replace('_', '-')}(?![\w-])", text
        )  # the last one: before may be examples
        default = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
        assert flag.partition("(default: ")[2].startswith(f"{default})"), name


def test_the_short_help_has_every_flag_and_half_the_lines(capsys):
    long = help_text(capsys, "train", "pendulum")
    with pytest.raises(SystemExit):
        main(["train", "pendulum", "-h"])
    short = capsys.readouterr().out
    assert set(re.findall(r" --[a-z][\w.-]+", long)) <= set(
        re.findall(r" --[a-z][\w.-]+", f" {short} --actuators ")
    )
    assert "--help-verbose" in short
    assert short.count("\n") < 164  # --help prints 329 lines


@pytest.mark.parametrize("verb", [verb for verb in VERBS if hasattr(find_verb(verb), "as_json")])
def test_verbs_with_numbers_have_json(capsys, verb):
    assert "--json Print only JSON" in help_text(capsys, *verb.split())


# -- train, evaluate, render ----------------------------------------------------------------------


def test_training_writes_a_run_folder_with_the_overridden_actuator_fields(capsys):
    loop = "--actuator.controller.kp 0.3 --actuator.controller.max-voltage inf"
    more = "--actuator.controller.bemf-compensation False --actuator.motor.inductance 0.07"
    env = "--env.center-radius 0.1 --env.inner-steps 2 --env.sutton-barto-reward True"
    run_ok(f"train cartpole --actuator weaker --seed 3 {loop} {more} {env} {TINY}")
    assert "next: codrl-mj evaluate runs/cartpole-ppo-weaker-3" in capsys.readouterr().out
    config = load_config(Path("runs/cartpole-ppo-weaker-3"))
    assert (config.seed, config.total_steps, config.num_envs, config.agent.hidden) == (
        3,
        500,
        2,
        (8,),
    )
    assert (config.env.options.center_radius, config.env.options.sutton_barto_reward) == (0.1, True)
    assert config.env.inner_steps == 2
    changed = {"kp": 0.3, "max_voltage": math.inf, "bemf_compensation": False}
    changed = {f"controller.{name}": value for name, value in changed.items()} | {
        "motor.inductance": 0.07
    }
    assert config.actuator == named_actuator("weaker", "cartpole").replaced(changed)


def test_evaluation_equals_the_packages_and_piped_output_has_no_colors(
    capsys, trained, monkeypatch
):
    capsys.readouterr()
    monkeypatch.setenv("TERM", "xterm-256color")
    run_ok(f"evaluate {trained} --episodes 7 --seed 5 --out a/result.json")
    result = read_json("a/result.json")
    make = EnvConfig("cartpole", "weaker").build
    totals = [episode.total for episode in run_episodes(load_policy(trained), make, 7, seed=5)]
    assert result["returns"]["mean"] == pytest.approx(np.mean(totals), rel=1e-12)
    assert result["returns"] == result["length"]  # 1 a step
    assert result["episodes"] == 7
    text, errors = capsys.readouterr()
    assert not {"\x1b", "━"} & {*text, *errors}
    assert f"{np.mean(totals):.1f}" in text
    assert f"{result['tracking_rms']:.3g} N·m" in text


def test_each_policy_is_evaluated_in_the_environment_of_its_training(trained):
    shutil.copytree(trained, Path("other", trained.name))
    config = Path("other", trained.name, "config.json")
    content = read_json(config)
    content["train"]["env"]["actuator"] = "paper"
    content.pop("sha256", None)
    config.write_text(json.dumps(content))
    both = {str(trained): "weaker", str(config.parent): "paper"}
    run_ok(f"evaluate {' '.join(both)} --episodes 3 --out both.json")
    results = read_json("both.json")
    assert list(results) == [
        f"{Path(run).parent.name}/{trained.name} on {motor}" for run, motor in both.items()
    ]
    for path, result in zip(both, results.values(), strict=True):
        run_ok(f"evaluate {path} --episodes 3 --out one.json")
        assert read_json("one.json") == result
    assert len({json.dumps(run["conditions"]) for run in results.values()}) == 2


def test_a_policy_is_evaluated_on_other_actuators_and_with_sampled_actions(trained):
    conditions = {name: f"--actuator {name}" for name in ("as-trained", "weaker", "ideal", "paper")}
    conditions |= {"starved": "--actuator.controller.max-voltage 0.2", "sampled": "--stochastic"}
    for name, flags in conditions.items():
        run_ok(f"evaluate {trained} --episodes 4 {flags} --out {name}.json")
    results = {name: read_json(f"{name}.json") for name in conditions}
    assert results["as-trained"] == results["weaker"]
    assert results["ideal"]["tracking_rms"] == 0.0
    assert results["ideal"]["peak_voltage"] is None
    assert 0 < results["paper"]["tracking_rms"] < results["weaker"]["tracking_rms"]
    assert results["starved"]["peak_voltage"] == 0.2
    assert results["starved"]["saturated_percent"] > 50
    assert (
        results["sampled"]["returns"] != results["weaker"]["returns"]
    )  # the others are of the most likely actions


def test_a_run_is_evaluated_and_filmed_in_the_environment_of_its_training():
    levels = "--env.action voltage --env.levels -3 3 --env.observe-actuator"
    env = f"{levels} --env.disturbances.command-delay 0.1"
    run_ok(f"train cartpole --actuator paper {env} {TINY} --out volts")
    copy_policy_only(Path("volts"))
    for subject in ("volts", f"volts {env}", f"alone --task cartpole --actuator paper {env}"):
        run_ok(f"evaluate {subject} --episodes 2 --out {len(subject)}.json")
    first, *others = (path.read_text() for path in Path().glob("*.json"))
    assert others == [first] * 2
    expected = evaluate(load_policy(Path("volts")), load_config(Path("volts")).evaluation_env, 2)
    assert json.loads(first) == json.loads(json.dumps(expected.as_mapping()))
    assert expected.peak_voltage == 3.0
    run_ok("evaluate volts --episodes 2 --env.disturbances.command-delay 0 --out at_once.json")
    assert read_json("at_once.json")["returns"] != json.loads(first)["returns"]
    # The first command arrives after five steps.
    longer_film = SMALL_FILM.replace("steps 2", "steps 8")
    for subject in ("volts", f"cartpole {levels}"):
        run_ok(f"render {subject} --out film.gif {longer_film}")


def test_a_run_can_be_filmed_and_a_task_with_random_actions(capsys, trained):
    run_ok(f"render {trained} --out film.mp4 --width 200 --height 120")
    with imageio.get_reader("film.mp4") as reader:
        assert reader.get_meta_data()["codec"] == "h264"
        assert reader.get_meta_data()["size"][0] == 200
    assert "wrote film.mp4" in capsys.readouterr().out
    run_ok(f"render pendulum --out film.gif {SMALL_FILM} --seed 2 --camera fixed")
    assert Path("film.gif").read_bytes().startswith(b"GIF89a")


# -- for other programs ---------------------------------------------------------------------------

JSON_LINES = [
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


@pytest.mark.parametrize(("line", "keys"), JSON_LINES)
def test_json_is_the_only_output(capsys, trained, line, keys):
    words = [str(trained) if word == "RUN" else word for word in line.split()]
    assert main([*words, "--json"]) in (0, 1)
    printed, errors = capsys.readouterr()
    content = json.loads(printed)
    assert (printed, errors) == (json.dumps(content, indent=2) + "\n", "")
    assert '"unit' in printed  # of each number, or of all by their names
    for key in keys.split():
        content = content[int(key) if key.isdigit() else key]
    assert isinstance(content, float)


LOG = "log.csv --columns time=time:s,voltage=voltage:V,current=current:A,position=position:rad"
LOGGED = (
    "identify simulate maxon-ec45-flat-50w --out log.csv --amplitude 12 --inertia 1e-4 --duration 1"
)
NARROW_LINES = [
    # lines, separated by ;, the last of which is looked at
    *(line for line, _ in JSON_LINES),
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


COPYABLE = "codrl-mj |--columns|^wrote |https://"


@pytest.mark.parametrize("line", NARROW_LINES)
def test_output_fits_80_columns_except_lines_to_copy(capsys, trained, monkeypatch, line):
    capsys.readouterr()
    monkeypatch.setenv("COLUMNS", "80")
    for command in line.split(";"):
        assert main(command.replace("RUN", str(trained)).split()) in (0, 1)
    printed = capsys.readouterr()
    assert printed.err == ""
    assert "\x1b" not in printed.out
    lines = map(str.rstrip, printed.out.splitlines())
    assert [text for text in lines if len(text) > 80 and not re.search(COPYABLE, text)] == []


# -- messages -------------------------------------------------------------------------------------


def test_numbers_may_be_written_as_1e5_and_20_to_1(monkeypatch):
    verbs = []
    monkeypatch.setattr("codrl_mj.cli.train.Train.run", lambda self: verbs.append(self) or 0)
    motor = "--actuator maxon-re65 --gear-ratio 20:1 --voltage=12"
    run_ok(
        f"train pendulum --agent ppo {motor} --total-steps 1e5 --num-envs 64 --agent.hidden 1e1 8"
    )
    assert (verbs[0].total_steps, verbs[0].num_envs, verbs[0].agent.hidden) == (
        100_000,
        64,
        (10, 8),
    )
    assert verbs[0].actuator_fields.motor.gear_ratio == 20.0
    assert verbs[0].actuator_fields.supply.voltage == 12.0


@pytest.mark.filterwarnings("always::UserWarning")
def test_warns_if_another_actuator_is_randomized_as_in_the_training(capsys):
    flags = (
        "--agent.rollout-steps 64 --agent.batch-size 64 --total-steps 64 --num-envs 1"
        " --evaluation-episodes 1"
    )
    run_ok(
        f"train cartpole --env.randomize motor.inductance=uniform(0.09,0.11) {flags} --out drawn"
    )
    capsys.readouterr()
    run_ok("evaluate drawn --episodes 1 --actuator weak")
    assert (
        "motor.inductance of weak are drawn from the training's distributions"
        in capsys.readouterr().err
    )
    run_ok("evaluate drawn --episodes 1 --actuator weak --env.randomize None")
    run_ok("evaluate drawn --episodes 1")
    assert "are drawn from" not in capsys.readouterr().err


def test_training_prints_assumed_motor_values_first(capsys, monkeypatch):
    monkeypatch.setattr("codrl_mj.training.train", lambda *_, **__: None)
    line = "train pendulum --actuator maxon-ec45-flat-339285 --out assumed"
    run_ok(line)
    assumed = "assumed, because not specified: supply.voltage = 24 V, controller.max_current = inf"
    assert capsys.readouterr().out.splitlines()[0] == assumed
    run_ok(f"{line} --actuator.supply.voltage 12 --actuator.controller.max-current 5")
    assert "assumed, for" not in capsys.readouterr().out


@pytest.mark.filterwarnings("always:Disturbances.command_delay")
def test_a_warning_is_printed_once_however_many_environments_it_is_about(tmp_path, capsys):
    line = f"train furuta {TINY} --env.disturbances.command-delay 2"
    assert main([*line.split(), "--out", str(tmp_path / "late")]) == 0
    assert capsys.readouterr().err.count("a delay of 100 environment steps") == 1


def test_a_motor_is_written_as_c(capsys, tmp_path):
    out = tmp_path / "folder" / "motor.c"
    words = ["motor", "write", "maxon-ec45-flat-50w", "--gear-ratio", "20", "--as", "c"]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "double advance_actuator(" in text
    assert main([*words, "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"wrote {out}\n"
    assert out.read_text() == text
    assert main([*words[:3], "--gear-ratio", "10"]) == 0
    shorter = capsys.readouterr().out
    assert shorter != text
    # An existing file is replaced, and a folder is refused.
    assert main([*words[:3], "--gear-ratio", "10", "--out", str(out)]) == 0
    assert out.read_text() == shorter
    assert main([*words, "--out", str(out.parent)]) == 2
    assert "it is a folder: name a file" in capsys.readouterr().err
