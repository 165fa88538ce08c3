"""What users write for tasks and families is refused in one sentence where it is wrong, and never ends the process."""

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
from codrl_mj.cli.environments import environment
from codrl_mj.engine import load_family
from codrl_mj.engine.families import compiled_observe
from codrl_mj.envs.config import EnvConfig
from codrl_mj.external_envs import environments
from codrl_mj.physics.compiled_task import compiled_constrain, compiled_outcomes
from codrl_mj.user_code import read_yaml
from tests import slips
from tests.matrix import but

FOUND, FACES = None, ("single", "vector", "training")


def refused(act, begins=r"slips?\.py:\d+, in "):
    """Refused in one sentence that begins with a place or a name; returned."""
    with pytest.raises(ValueError, match=f"^({begins})") as caught:
        act()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def display_name(case):
    return str(case).partition(" at 0x")[0][:30]


@pytest.mark.parametrize(("field", "value"), slips.TASKS, ids=display_name)
def test_a_task_with_a_slip_is_refused_when_it_is_made(field, value):
    refused(lambda: slips.task(**{field: value}), r"slips?\.py:\d+, in |Task\.|unknown integrator")


@pytest.mark.parametrize(("part", "value"), slips.FAMILIES, ids=display_name)
def test_a_family_with_a_slip_is_refused_at_every_door_before_it_is_compiled(
    part, value, monkeypatch
):
    family = slips.family(**{part: value})
    monkeypatch.setattr(sys.modules[__name__], "FOUND", family)
    begins = r"slips?\.py:\d+, in |Slipped|unknown (signal SIGNAL_UNITS|field RANDOM)"
    doors = lambda: load_family(family), lambda: resolve(f"{__name__}:FOUND", None, "")
    assert len({refused(door, begins) for door in doors}) == 1


def test_a_family_that_is_no_dataclass_or_has_no_advance_is_refused():
    class Undecorated(codrl_mj.actuators.ActuatorModel):
        gain = slips.real(1.0)

    class Idle(codrl_mj.actuators.ActuatorModel):
        pass

    refused(
        lambda: load_family(Undecorated),
        "Undecorated: must be decorated with @dataclasses.dataclass",
    )
    refused(lambda: load_family(Idle), "Idle: has no `advance`")


NUMBA = (*slips.LATE[1:], *slips.LATE_FAMILIES)


@pytest.mark.parametrize(("name", "body"), but(NUMBA[::4], NUMBA), ids=display_name)
def test_what_only_numba_can_refuse_is_a_sentence_too(name, body):
    if name in slips.PARTS:
        family = slips.family(**{name: body})
        told = refused(lambda: (load_family(family), compiled_observe(family)))
    else:
        task = slips.late_task(name, body)
        given = task.constrain, task.state_names, task.qpos, task.qvel
        told = refused(lambda: (compiled_outcomes(task), compiled_constrain(*given)))
    assert f"in {name}: numba does not compile it: " in told or f"in {name}: returns " in told


def test_the_message_has_what_numba_says_of_it_and_where():
    task = slips.task(reward="x = next_state[0]\n    return float(np.linalg.norm(x))")
    told = refused(lambda: compiled_outcomes(task))
    assert (
        told
        == "slip.py:3, in reward: numba does not compile it: np.linalg.norm() only supported for"
        " array types"
    )


@pytest.mark.parametrize("called", ["plain(state)", "tests.slips.plain(state)"])
def test_functions_that_a_function_calls_are_found_by_their_names_or_their_package(called):
    terminated = compiled_outcomes(slips.task(terminated=called)).terminated
    assert [terminated(np.array([position, 0.0, 0.0])) for position in (0.5, 1.5)] == [False, True]


@pytest.mark.parametrize(
    ("face", "every"), but([("vector", 4)], [("vector", 4), *((one, 1) for one in FACES)])
)
def test_no_slip_ends_the_process(face, every):
    program = [sys.executable, "-m", "tests.slips", face, str(every)]
    done = subprocess.run(program, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    *told, last = done.stdout.splitlines()
    assert last == "the sound one runs"
    assert len(told) > 10 / every
    assert all(line.startswith("refused") for line in told)


def test_an_integer_or_a_flag_among_the_numbers_is_a_number():
    """In every function that returns several, of one kind of number or of many."""
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
    # what stands in the model, what takes its place, and what is said of it
    ("RK4", "Euler", ": its <option> has integrator EULER, so Task.integrators cannot have rk4"),
    (SHOULDER, 'site="tip"/', ": actuator 'shoulder' must drive a hinge or a slide joint"),
    (
        'name="elbow" axis',
        'type="ball" name="elbow" axis',
        " has 5 positions and 4 velocities, and slip",
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


@pytest.mark.parametrize(("good", "bad", "message"), MODELS)
def test_a_models_joints_and_integrator_are_compared_with_the_task(tmp_path, good, bad, message):
    model = ARM.replace('<body name="upper">', '<body name="upper"><site name="tip"/>')
    path = tmp_path / "model.xml"
    path.write_text(model.replace(good, bad, 1))
    task = codrl_mj.register(slips.task(asset=str(path)))
    refused(lambda: gymnasium.make(task.env_id, actuator="ideal"), f"{path}{message}")


def test_a_model_that_is_not_there_is_refused_when_the_task_is_made():
    with pytest.raises(FileNotFoundError, match=r"no model file /nowhere/arm\.xml"):
        slips.task(asset="/nowhere/arm.xml")


def test_the_speeds_of_a_task_follow_from_its_model():
    assert slips.task().speeds == (2,)
    assert slips.task(motors=("elbow",)).speeds == (3,)
    assert [task.speeds for task in codrl_mj.tasks.TASKS.values() if task.name == "acrobot"] == [
        (3,)
    ]


def reset(task, **options):
    gymnasium.make(f"codrl_mj/{task}-v0", actuator="ideal").reset(options=options)


@pytest.mark.parametrize(
    ("door", "given", "message"),
    [
        (
            codrl_mj.add_motors,
            ("arm.xml", {}),
            r"spec = 'arm\.xml': must be .* mujoco\.MjSpec\.from_file\('arm\.xml'\)",
        ),
        (
            environments.make,
            ("codrl_mj/Pendulum-v0", {}),
            r"codrl_mj/Pendulum-v0: .* gymnasium\.make\('codrl_mj/Pend",
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
def test_other_doors_say_what_they_want(door, given, message):
    refused(lambda: door(*given), message)


@pytest.mark.parametrize(
    ("text", "read"),
    [
        (
            "{a: 3e-4, b: -Infinity, c: 010, d: 0x1F, e: 1_000, f: .5, g: NaN2}",
            [3e-4, -math.inf, 10.0, 31, 1000, 0.5, "NaN2"],
        ),
        ("{a: 20:1, b: 12:30:45}", ["20:1", "12:30:45"]),  # 1201 and 45045 in YAML 1.1
        ("\ufeffa: µ\r\nb: yes", ["µ", True]),
    ],
)
def test_numbers_of_a_yaml_file_are_those_of_yaml_1_2_and_json(tmp_path, text, read):
    file = tmp_path / "read.yaml"
    for encoding in ("utf-8", "utf-16"):
        file.write_bytes(text.encode(encoding))
        assert [*read_yaml(file).values()] == read


def test_what_is_no_yaml_file_is_refused_with_its_line(tmp_path):
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
    """A file comes from elsewhere more often than the words of a command line."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)

    def made(verb):
        return int(environment(verb, "cartpole", verb.actuator_name, EnvConfig("cartpole")) is None)

    monkeypatch.setattr(find_verb("evaluate"), "run", made)
    Path("of_theirs.py").write_text(
        "open('executed', 'w').close()\nfrom codrl_mj.actuators import Lag as Theirs\n"
    )
    Path("theirs.yaml").write_text("family: of_theirs:Theirs\n")
    Path("all.yaml").write_text("'.*': {family: 'of_theirs:Theirs'}\n")
    for flags in (
        ["--actuator", "theirs.yaml"],
        ["--actuators", ".*=theirs.yaml"],
        ["--actuators", "all.yaml"],
    ):
        line = ["evaluate", "run", "--task", "cartpole", *flags]
        assert main(line) == 2
        assert "'of_theirs:Theirs': needs the module of_theirs" in capsys.readouterr().err
        assert not Path("executed").exists()
        assert main([*line, "--trust"]) == 0
        Path("executed").unlink()
        sys.modules.pop("of_theirs")


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
@pytest.mark.parametrize("imported", ["itself", "by another"])
def test_an_error_in_a_users_module_is_at_its_own_file_and_line(
    tmp_path, monkeypatch, text, line, imported
):
    monkeypatch.syspath_prepend(tmp_path)
    name = f"located{next(LOCATED)}"
    (tmp_path / f"{name}.py").write_text(text)
    (tmp_path / f"by_{name}.py").write_text(f"import {name}\n")
    module = name if imported == "itself" else f"by_{name}"
    told = refused(lambda: codrl_mj.make(f"{module}:TASK"), f"'{module}:TASK': ")
    assert told.endswith(f"({tmp_path / f'{name}.py'}, line {line})")


class Winds(NamedTuple):
    """Options whose defaults are zero, negative and positive."""

    wind: float = 0.0
    slope: float = -0.5
    length: float = 2.0
    gusts: bool = False


def test_an_option_takes_its_own_default_and_what_is_of_its_kind():
    task = codrl_mj.register(slips.task(options=Winds))
    config = codrl_mj.EnvConfig(task.name, "ideal")
    for given in Winds()._asdict(), {"wind": -3.0, "slope": 0.0, "length": 1}:
        for env in codrl_mj.make(task.name, "ideal", **given), codrl_mj.make(config, **given):
            assert env.unwrapped.setup.config.options == Winds(**given)
    for given, kind in [
        ({"wind": np.nan}, "a finite number"),
        ({"slope": np.inf}, "a finite number"),
        ({"wind": True}, "a finite number"),
        ({"length": 0.0}, "a number > 0"),
        ({"gusts": 0}, "True or False"),
    ]:
        refused(lambda given=given: codrl_mj.make(task.name, **given), rf"\w+ = .*: must be {kind}")


def test_a_default_that_is_no_number_is_refused_with_the_task():
    class Lost(NamedTuple):
        wind: float = float("nan")

    refused(
        lambda: slips.task(options=Lost),
        "Task.options = .*a typing.NamedTuple of numbers and flags",
    )
