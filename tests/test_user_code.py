"""Mistakes in users' tasks and families give one sentence, and never end the process."""

import itertools
import math
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import resolve
from codrl_mj.cli import find_verb, main
from codrl_mj.cli.environments import build_env_config
from codrl_mj.engine import load_family
from codrl_mj.engine.families import compiled_observe
from codrl_mj.envs.config import EnvConfig
from codrl_mj.physics.compiled_task import compiled_constrain, compiled_outcomes
from codrl_mj.user_code import read_yaml
from tests import slips
from tests.matrix import matrix_params

FAMILY, FACES = None, ("single", "vector", "training")


def error_message(call, beginning=r"slips?\.py:\d+, in "):
    """Return the error of a call, one sentence that begins with a location or a name."""
    with pytest.raises(ValueError, match=f"^({beginning})") as error_info:
        call()
    assert "\n" not in str(error_info.value)
    return str(error_info.value)


def display_name(case):
    return str(case).partition(" at 0x")[0][:30]


@pytest.mark.parametrize(("field", "value"), slips.TASKS, ids=display_name)
def test_raises_for_a_task_with_a_mistake(field, value):
    error_message(
        lambda: slips.task(**{field: value}), r"slips?\.py:\d+, in |Task\.|unknown integrator"
    )


@pytest.mark.parametrize(("part", "value"), slips.FAMILIES, ids=display_name)
def test_raises_for_a_family_with_a_mistake_before_it_is_compiled(part, value, monkeypatch):
    family = slips.family(**{part: value})
    monkeypatch.setattr(sys.modules[__name__], "FAMILY", family)
    beginning = r"slips?\.py:\d+, in |Slipped|unknown (signal SIGNAL_UNITS|field RANDOM)"
    entry_points = lambda: load_family(family), lambda: resolve(f"{__name__}:FAMILY", None, "")
    assert len({error_message(entry_point, beginning) for entry_point in entry_points}) == 1


def test_raises_for_a_family_without_dataclass_or_advance():
    class Undecorated(codrl_mj.actuators.ActuatorModel):
        gain = slips.real(1.0)

    class Idle(codrl_mj.actuators.ActuatorModel):
        pass

    error_message(
        lambda: load_family(Undecorated),
        "Undecorated: must be decorated with @dataclasses.dataclass",
    )
    error_message(lambda: load_family(Idle), "Idle: has no `advance`")


NUMBA = (*slips.LATE[1:], *slips.LATE_FAMILIES)


@pytest.mark.parametrize(("name", "body"), matrix_params(NUMBA[::4], NUMBA), ids=display_name)
def test_errors_of_numba_become_one_sentence(name, body):
    if name in slips.PARTS:
        family = slips.family(**{name: body})
        message = error_message(lambda: (load_family(family), compiled_observe(family)))
    else:
        task = slips.late_task(name, body)
        constraint_arguments = task.constrain, task.state_names, task.qpos, task.qvel
        message = error_message(
            lambda: (compiled_outcomes(task), compiled_constrain(*constraint_arguments))
        )
    assert f"in {name}: numba cannot compile it: " in message or f"in {name}: returns " in message


def test_the_message_has_numbas_error_and_its_line():
    task = slips.task(reward="x = next_state[0]\n    return float(np.linalg.norm(x))")
    message = error_message(lambda: compiled_outcomes(task))
    assert (
        message
        == "slip.py:3, in reward: numba cannot compile it: np.linalg.norm() only supported for"
        " array types"
    )


@pytest.mark.parametrize("body", ["plain(state)", "tests.slips.plain(state)"])
def test_a_function_can_call_others_by_name_or_package(body):
    terminated = compiled_outcomes(slips.task(terminated=body)).terminated
    assert [terminated(np.array([position, 0.0, 0.0])) for position in (0.5, 1.5)] == [False, True]


@pytest.mark.parametrize(
    ("interface", "stride"),
    matrix_params([("vector", 4)], [("vector", 4), *((name, 1) for name in FACES)]),
)
def test_no_mistake_ends_the_process(interface, stride):
    program = [sys.executable, "-m", "tests.slips", interface, str(stride)]
    process = subprocess.run(program, capture_output=True, text=True, timeout=600, check=False)
    assert process.returncode == 0, process.stderr
    *messages, last_line = process.stdout.splitlines()
    assert last_line == "the sound one runs"
    assert len(messages) > 10 / stride
    assert all(line.startswith("refused") for line in messages)


def test_integers_and_flags_are_accepted_as_numbers():
    """Check every function that returns several numbers, of one type or of several."""
    task = slips.task(
        initial_state="draws[0], 0, False, 0.5",
        observation="state[0] > 5.0, 1, np.float32(0.5)",
        constrain="state[0], 0, False, state[3]",
        reward="1",
    )
    codrl_mj.register(task)
    slips.run("single", task)
    envs = gymnasium.make_vec(
        task.env_id, 2, vectorization_mode="vector_entry_point", actuator="ideal"
    )
    np.testing.assert_array_equal(envs.reset(seed=0)[0], [[0.0, 1.0, 0.5]] * 2)
    assert envs.step(np.zeros((2, 1), np.float32))[1].tolist() == [1.0, 1.0]


SHOULDER, ARM = 'joint="shoulder"/', (slips.ROOT / "own_project" / "arm.xml").read_text()
MODELS = [
    # Text of the model, its replacement, and the error.
    ("RK4", "Euler", ": its <option> has integrator EULER, so Task.integrators cannot have rk4"),
    (SHOULDER, 'site="tip"/', ": actuator 'shoulder' must drive a hinge or a slide joint"),
    (
        'name="elbow" axis',
        'type="ball" name="elbow" axis',
        " has 5 positions and 4 velocities, but slip",
    ),
    ("<worldbody>", "<worldbdy>", ": XML parse error"),
    (SHOULDER, 'joint="shoulder" gear="5"/', ": actuator 'shoulder': leave out its gear; "),
    (
        SHOULDER,
        'joint="shoulder" forcerange="-1 1"/',
        ": actuator 'shoulder': leave out its forcerange",
    ),
    (
        SHOULDER,
        'joint="shoulder" delay="0.1" nsample="9"/',
        ": actuator 'shoulder': leave out its delay",
    ),
    (
        "<joint name",
        '<joint actuatorfrcrange="-1 1" name',
        ": .*leave out the actuatorfrcrange of joint 'shoulder'",
    ),
    (
        "<option",
        '<option actuatorgroupdisable="0"',
        ": actuator 'shoulder': leave out its group, which <option> dis",
    ),
]


@pytest.mark.parametrize(("original", "replacement", "message"), MODELS)
def test_a_models_joints_and_integrator_are_compared_with_the_task(
    tmp_path, original, replacement, message
):
    model = ARM.replace('<body name="upper">', '<body name="upper"><site name="tip"/>')
    path = tmp_path / "model.xml"
    path.write_text(model.replace(original, replacement, 1))
    task = codrl_mj.register(slips.task(asset=str(path)))
    error_message(lambda: gymnasium.make(task.env_id, actuator="ideal"), f"{path}{message}")


def test_raises_if_the_model_of_a_task_is_missing():
    with pytest.raises(FileNotFoundError, match=r"no model file /nowhere/arm\.xml"):
        slips.task(asset="/nowhere/arm.xml")


def test_the_speeds_of_a_task_follow_from_its_model():
    assert slips.task().speed_indices == (2,)
    assert slips.task(motors=("elbow",)).speed_indices == (3,)
    assert [
        task.speed_indices for task in codrl_mj.tasks.TASKS.values() if task.name == "acrobot"
    ] == [(3,)]


def reset(task, **options):
    gymnasium.make(f"codrl_mj/{task}-v0", actuator="ideal").reset(options=options)


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (
            codrl_mj.add_motors,
            ("arm.xml", {}),
            r"spec = 'arm\.xml': must be .* mujoco\.MjSpec\.from_file\('arm\.xml'\)",
        ),
        (
            lambda: reset("Pendulum", xinit=0.1),
            (),
            r"unknown reset option xinit; did you mean x_init\? known: x_init, y_",
        ),
        (
            lambda: reset("CartPole", low=0.0, hgih=0.1),
            (),
            r"unknown reset option hgih; did you mean high\?",
        ),
    ],
)
def test_functions_name_what_they_expect(function, arguments, message):
    error_message(lambda: function(*arguments), message)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        (
            "{a: 3e-4, b: -Infinity, c: 010, d: 0x1F, e: 1_000, f: .5, g: NaN2}",
            [3e-4, -math.inf, 10.0, 31, 1000, 0.5, "NaN2"],
        ),
        ("{a: 20:1, b: 12:30:45}", ["20:1", "12:30:45"]),  # 1201 and 45045 in YAML 1.1
        ("\ufeffa: µ\r\nb: yes", ["µ", True]),
    ],
)
def test_numbers_of_yaml_files_follow_yaml_1_2_and_json(tmp_path, text, values):
    file = tmp_path / "read.yaml"
    for encoding in ("utf-8", "utf-16"):
        file.write_bytes(text.encode(encoding))
        assert [*read_yaml(file).values()] == values


def test_raises_with_the_line_for_an_invalid_yaml_file(tmp_path):
    file = tmp_path / "read.yaml"
    for content, message in {
        b"a: 1\nb: \xb5m": (
            r"line 2 has the byte 0xb5 \(µ in Windows-1252\).*save the file as UTF-8"
        ),
        b"a:\n  b: 1\n  c: 2\n  b: 3": "line 4: b is given twice",
        b"[1, 2": "expected",
    }.items():
        file.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            read_yaml(file)


def test_an_actuator_file_names_modules_only_with_trust(tmp_path, monkeypatch, capsys):
    """Check that files are trusted less than the command line, because they come from elsewhere."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)

    def make_environment(verb):
        return int(
            build_env_config(verb, "cartpole", verb.actuator_name, EnvConfig("cartpole")) is None
        )

    monkeypatch.setattr(find_verb("evaluate"), "run", make_environment)
    Path("third_party.py").write_text(
        "open('executed', 'w').close()\nfrom codrl_mj.actuators import Lag as CustomLag\n"
    )
    Path("custom.yaml").write_text("family: third_party:CustomLag\n")
    Path("all.yaml").write_text("'.*': {family: 'third_party:CustomLag'}\n")
    for flags in (
        ["--actuator", "custom.yaml"],
        ["--actuators", ".*=custom.yaml"],
        ["--actuators", "all.yaml"],
    ):
        line = ["evaluate", "run", "--task", "cartpole", *flags]
        assert main(line) == 2
        assert "'third_party:CustomLag': needs the module third_party" in capsys.readouterr().err
        assert not Path("executed").exists()
        assert main([*line, "--trust"]) == 0
        Path("executed").unlink()
        sys.modules.pop("third_party")


LOCATED = itertools.count()


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("x = 1\n\ndef f(:\n", 3),  # Python's parser
        ("x = 1\n  y = 2\n", 2),
        ("import json\n\nx = json.loads('{')\n", 3),  # raised inside Python's own library
        ("import dataclasses\n\n\n@dataclasses.dataclass\nclass A:\n    x: list = []\n", 4),
        (
            "import scipy.linalg\n\nx = scipy.linalg.inv([[1.0, 2.0]])\n",
            3,
        ),  # inside an installed one
        ("import codrl_mj\n\nx = codrl_mj.EnvConfig('pendulm')\n", 3),  # inside ours
        ("def f():\n    return 1 / 0\n\n\nf()\n", 2),
    ],
)
@pytest.mark.parametrize("import_path", ["itself", "by another"])
def test_an_error_in_a_users_module_has_its_file_and_line(
    tmp_path, monkeypatch, text, line, import_path
):
    monkeypatch.syspath_prepend(tmp_path)
    name = f"located{next(LOCATED)}"
    (tmp_path / f"{name}.py").write_text(text)
    (tmp_path / f"by_{name}.py").write_text(f"import {name}\n")
    module = name if import_path == "itself" else f"by_{name}"
    message = error_message(lambda: codrl_mj.make(f"{module}:TASK"), f"'{module}:TASK': ")
    assert message.endswith(f"({tmp_path / f'{name}.py'}, line {line})")


class Winds(NamedTuple):
    """Options whose defaults are zero, negative, positive and a flag."""

    wind: float = 0.0
    slope: float = -0.5
    length: float = 2.0
    gusts: bool = False


def test_options_accept_their_defaults_and_values_of_the_same_kind():
    task = codrl_mj.register(slips.task(options=Winds))
    config = codrl_mj.EnvConfig(task.name, "ideal")
    for options in Winds()._asdict(), {"wind": -3.0, "slope": 0.0, "length": 1}:
        for env in codrl_mj.make(task.name, "ideal", **options), codrl_mj.make(config, **options):
            assert env.unwrapped.setup.config.options == Winds(**options)
    for options, expected in [
        ({"wind": np.nan}, "a finite number"),
        ({"slope": np.inf}, "a finite number"),
        ({"wind": True}, "a finite number"),
        ({"length": 0.0}, "a number > 0"),
        ({"gusts": 0}, "True or False"),
    ]:
        error_message(
            lambda options=options: codrl_mj.make(task.name, **options),
            rf"\w+ = .*: must be {expected}",
        )


def test_raises_for_an_option_whose_default_is_no_number():
    class Lost(NamedTuple):
        wind: float = float("nan")

    error_message(
        lambda: slips.task(options=Lost),
        "Task.options = .*a typing.NamedTuple of numbers and flags",
    )
