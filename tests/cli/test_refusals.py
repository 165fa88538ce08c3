"""Bad input is reported in one line and changes nothing."""

import shutil
from pathlib import Path

import pytest

from codrl_mj.cli import main
from tests.cli.lines import TINY, assert_refused, copy_policy_only, folder_contents
from tests.matrix import matrix_params

REFUSED = [
    (
        "",
        (
            "codrl-mj needs a verb: try codrl-mj motor list, or codrl-mj train cartpole first;"
            " verbs are train,"
        ),
    ),
    ("", "board, validate; codrl-mj --help describes them"),
    ("trian cartpole", "unknown verb 'trian': did you mean 'train'? verbs are train, evaluate,"),
    ("motor", "codrl-mj motor needs a verb: verbs are list, new, show,"),
    ("motor lst", "unknown verb 'lst': did you mean 'list'? verbs are list, new, show,"),
    ("motor show", "codrl-mj motor show needs NAME;"),
    ("motor show maxon-ec45", "did you mean 'maxon-ec45-flat-339285' or 'maxon-ec45-flat-50w'?"),
    ("motor list --sort stal", "--sort stal: did you mean 'stall_torque'? must be one of"),
    ("identify check", "codrl-mj identify check needs --columns;"),
    ("train", "codrl-mj train needs TASK; codrl-mj train --help says more"),
    (
        "train pendulm --agent sac",
        "'pendulm': did you mean 'pendulum'? It can also be your own as module:NAME",
    ),
    ("train pendulm", "name an environment of Gymnasium by its id, such as HalfCheetah-v5"),
    ("render pendulm", "no run configuration at pendulm/config.json: did you mean 'pendulum'?"),
    (
        "train CartPole-v1",
        "has no MuJoCo model built from XML, and so no motors: use this package's task 'cartpole'",
    ),
    ("train cartpole more", "unexpected 'more': codrl-mj train --help"),
    ("train cartpole --seed", "--seed needs a value: a whole number"),
    ("train cartpole --seed two", "--seed two: must be a whole number"),
    (
        "train pendulum --actuator.supply.voltage 12V",
        "--voltage/--actuator.supply.voltage 12V: must be",
    ),
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
    (
        "train cartpole --actuator ../up/nope.py:X",
        "nope.py: there is no such file; must be FILE.py:NAME",
    ),
    (
        "train cartpole --num-envs 1e12 --agent dqn --out run",
        "num_envs = 1000000000000: takes about 3e+06 GB of",
    ),
    (
        "train InvertedPendulum-v5 --num-envs 1e9",
        "num_envs = 1000000000: takes about 2e+05 GB of memory, but",
    ),
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
    (
        "evaluate nowhere --actuator weaker --episodes 100",
        "no run configuration at nowhere/config.json",
    ),
    ("render nowhere --out balance.mp4", "nowhere/config.json"),
    ("render cartpole --camera drone", "cameras are fixed, close"),
    ("render cartpole --width 641", "width = 641: must be even"),
    ("render cartpole --height 0", "height = 0: must be >= 80"),
    ("render cartpole --out film.avi", "unknown format '.avi'"),
    ("render furuta --trajectory a.csv", "the suffix is '.csv', must be .npz"),
    ("replay furuta --out a.mp4", "the suffix is '.mp4', must be .html"),
    ("advise re25 Hopper-v5", "The study covers pendulum, cartpole"),
    ("advise re25 Hopper-v5", "--measure 10"),
    *(
        (f"{verb} RUN {flag}{value}", f"{text}{flag}{end}")
        for verb in ("evaluate", "render")
        for flag, value in (
            ("--env.action", " current"),
            ("--env.levels", " -1 1"),
            ("--env.observe-actuator", ""),
        )
        for text, end in (("", " = "), ("omit ", ""))
    ),
]
REFUSED_FLAGS = {
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
REFUSED_BY_TRAIN = [
    (f"train cartpole {flags}", message) for flags, message in REFUSED_FLAGS.items()
]
REFUSED_FOR_RUNS = [
    (f"{verb} RUN {flags}", message)
    for flags, message in REFUSED_FLAGS.items()
    for verb in ("evaluate", "render")
]


@pytest.mark.parametrize(
    ("line", "message"),
    [*REFUSED, *REFUSED_BY_TRAIN, *matrix_params(REFUSED_FOR_RUNS[:6], REFUSED_FOR_RUNS)],
)
def test_a_refused_line_prints_one_line_and_changes_nothing(capsys, trained, line, message):
    before = folder_contents(trained)
    assert message in assert_refused(capsys, line.replace("RUN", str(trained)))
    assert folder_contents(trained) == before


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
def test_unwritable_outputs_are_refused_before_anything_is_computed(capsys, line):
    Path("file").touch()
    for path in ("file", "/proc/nowhere"):
        error = assert_refused(capsys, line.format(path))
        assert "cannot write to" in error
        assert Path(path).name in error


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
def test_a_damaged_file_in_a_run_folder_is_named(capsys, trained, verb, file, content):
    shutil.copytree(trained, "foreign")
    (
        Path("foreign", file).unlink()
        if content is None
        else Path("foreign", file).write_bytes(content)
    )
    assert file in assert_refused(capsys, f"{verb} foreign")


def test_a_policy_for_another_task_is_refused(capsys, trained):
    copy_policy_only(trained)
    assert "observation_space: the policy was trained with" in assert_refused(
        capsys, "evaluate alone --task pendulum"
    )


def interrupt_verb(*_, **__):
    raise KeyboardInterrupt


def interrupt_in_a_library(*_):
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt:
        raise ImportError("initialisation of a library failed")  # noqa: B904


@pytest.mark.parametrize(
    ("line", "function", "interrupt"),
    [
        ("validate cartpole --out certificate", "validation.validate", interrupt_verb),
        ("runs", "runs.summaries.find_runs", interrupt_in_a_library),
    ],
)
def test_an_interrupted_verb_exits_with_130_and_leaves_nothing(
    monkeypatch, tmp_path, capsys, line, function, interrupt
):
    monkeypatch.setattr(f"codrl_mj.{function}", interrupt)
    assert main(line.split()) == 130
    assert (
        capsys.readouterr().err == "codrl-mj: stopped: the same command starts from the beginning\n"
    )
    assert list(tmp_path.iterdir()) == []


def test_an_unexpected_error_is_one_line_and_has_a_traceback_on_request(capsys, monkeypatch):
    monkeypatch.setattr("codrl_mj.runs.summaries.find_runs", lambda _: {}["absent"])
    assert (
        assert_refused(capsys, "runs")
        == "codrl-mj: error: KeyError: 'absent' (--traceback shows where)\n"
    )
    assert main(["runs", "--traceback"]) == 2
    traced = capsys.readouterr().err
    assert traced.startswith("Traceback (most recent call last):")
    assert traced.endswith("codrl-mj: error: KeyError: 'absent' (--traceback shows where)\n")
