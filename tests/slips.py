"""Tasks and families with one error each.

`python -m tests.slips FACE N` runs every Nth error that only numba can find. It prints a line for
each, which says how it ended; a process that dies by a signal prints no further lines.
"""

import dataclasses
import itertools
import sys
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

import codrl_mj
import tests
from codrl_mj.fields import real
from codrl_mj.tasks.reference_env import ReferenceStates

ROOT, _NUMBERS = Path(__file__).parent, itertools.count()
STATE = "state[0], state[1], state[2], state[3]"
FUNCTIONS = {
    "initial_bounds": ("options", "np.full(4, -0.1), np.full(4, 0.1)"),
    "initial_state": ("draws", STATE.replace("state", "draws")),
    "observation": ("state", "state[0], np.sin(state[1]), state[2]"),
    "constrain": ("state, timestep", STATE),
    "reward": (
        "state, force, next_state, options",
        "1.0 - next_state[0] * next_state[0] - 0.1 * force * force",
    ),
    "terminated": ("state", "np.abs(state[0]) > 1.0"),
    "goal": ("state", "np.abs(state[1]) < 0.1"),
}
"""Function -> (arguments, result)."""


def plain(state: Any) -> Any:
    """Helper function that compiled functions find by its name."""
    return state[0] > 1.0


def function(name: str, arguments: str, body: str) -> Any:
    """Return a function of these arguments; its body is an expression or statements."""
    lines = body if "return" in body or "raise" in body else f"return {body}"
    namespace: dict[str, Any] = {
        "np": np,
        "plain": plain,
        "tests": tests,
        "State": State,
        "Signals": Signals,
    }
    exec(compile(f"def {name}({arguments}):\n    {lines}", "slip.py", "exec"), namespace)
    return namespace[name]


def task(**changes: Any) -> Any:
    """Return a task with other values of fields; functions are given as text."""
    number = next(_NUMBERS)
    fields: dict[str, Any] = {
        "name": f"slip{number}",
        "env_id": f"slips/Slip{number}-v0",
        "asset": str(ROOT / "own_project" / "arm.xml"),
        "max_force": 2.0,
        "step_duration": 0.02,
        "motor_inner_steps": 2,
        "max_episode_steps": 20,
        "integrators": ("rk4",),
        "motors": ("shoulder",),
        "state_names": ("a", "b", "a_dot", "b_dot"),
        "observation_names": ("x", "y", "z"),
        **{name: function(name, *source) for name, source in FUNCTIONS.items()},
    }
    for name, change in changes.items():
        text = isinstance(change, str) and name in FUNCTIONS
        fields[name] = function(name, FUNCTIONS[name][0], change) if text else change
    return codrl_mj.Task(**fields)


NUMBERS = (
    "()",
    "(1.0, 2.0, 3.0, 4.0, 5.0)",
    "[1.0] * 3",
    "np.zeros(3)",
    "1.0",
    "None",
    "'abc'",
    "((1.0,), 2.0, 3.0)",
)
NOT_ONE = (
    *("(1.0,)", "None", "'a'", "1j", "np.zeros(1)", "np.nan", "[1.0]", "unknown", "state[7]"),
    "raise KeyError('gone')",
)


class Undefaulted(NamedTuple):
    """Options without a default."""

    weight: float


class Worded(NamedTuple):
    """Options that are not numbers."""

    weight: str = "heavy"


def pairs(table: dict[str, tuple]) -> list[tuple[str, Any]]:
    """Return each field of a row with each of the row's values."""
    return [
        (field, value)
        for fields, values in table.items()
        for field in fields.split()
        for value in values
    ]


TASKS = pairs(
    {
        "initial_state observation constrain": (
            *NUMBERS,
            "(1.0, 'a', 1.0, 1.0)",
            "np.nan, 1.0, 1.0",
        ),
        "reward terminated": NOT_ONE,
        "goal": (*NOT_ONE, "1.0 if state[0] > 0.0 else 0.0"),
        "initial_state": (
            "return (1.0, draws[1], 0.0, 0.0) if draws[0] > 0.0 else (0.0, draws[1], 0.0, 0.0)",
        ),
        "initial_bounds": (
            *(
                "np.zeros(4)",
                "np.zeros(3), np.zeros(4)",
                "np.ones(4), np.zeros(4)",
                "np.zeros(4), np.full(4, np.inf)",
            ),
            "0.0, 1.0",
        ),
        " ".join(FUNCTIONS): (3, "raise ValueError('mine')", lambda: 0.0),
        "observation reward terminated": (None,),
        "state_names observation_names motors": (
            (),
            ("a",) * 4,
            "abcd",
            ["a", "b", "c", "d"],
            (1, 2, 3, 4),
            None,
            3,
        ),
        "state_names": (("a", "b", "c"), ("a", "b", "c", "d", "e")),
        "observation_names": (("a",), ("a", "b"), ("a", "b", "c", "d")),
        "integrators": (("rk5",), (), "rk4", ("rk4", "rk4"), None),
        "step_duration": (0.0, -0.02, np.nan, np.inf, "0.02", None, True),
        "motor_inner_steps ideal_inner_steps": (0, -1, 2.0, "2", None, True),
        "max_episode_steps": (0, -1, 2.0, "2", True),
        "max_force": (0.0, -1.0, np.nan, np.inf, "2", None, (1.0, 1.0), ()),
        "forces": (
            (),
            (1.0, np.nan),
            ("a",),
            3.0,
            "ab",
            ((1.0, 2.0), (3.0, 4.0)),
            (1.0, (2.0,)),
            (-2.1, 2.0),
        ),
        "qpos": ((1,), (0, 4), (0, 0), (1, 0), ("a", "b"), 3, (0, 1, 2)),
        "wrapped": ((4,), (-1,), ("a",), 3),
        "observation_space": (
            *(Box(-1, 1, (count,)) for count in (2, 4)),
            Box(-1, 1, (3,), np.float64),
            Discrete(3),
            3,
        ),
        "action_space": (Box(-1, 1, (2,)), Discrete(3), 3),
        "options": (Undefaulted, Worded, dict, 3),
        "paper name env_id": (3,),
        "reference_states": (ReferenceStates((1.0,) * 4, ((0.0,),) * 4, (0.0,) * 3, 2, 1),),
        "goal_hold": (-1.0, np.nan, "1"),
    }
)
"""(field, invalid value): errors that are found when the task is created."""
LATE = pairs(
    {
        "initial_state": ("return tuple(draws)",),
        "observation constrain": (
            "return ({0}) if state[0] < 10.0 else ({0}, 1.0)",
            "return ({0}) if state[0] < 10.0 else None",
            "x = float(np.linalg.norm(state)); return {0}",
        ),
        "reward terminated": (
            "return 1.0 if state[0] < 10.0 else None",
            "return 1.0 if state[0] < 10.0 else 'a'",
            "return float(np.linalg.norm(state))",
            "return len(open.__name__)",
        ),
    }
)
"""(field, invalid function): errors that only numba finds; calls with plain numbers succeed."""


class State(NamedTuple):
    """State of a family."""

    a: float
    b: float


class Signals(NamedTuple):
    """Signals of a family."""

    heat: float


PARTS = {
    "advance": (
        "parameters, timestep, state, inputs",
        "State(state.a + 1.0, state.b), 0.5 * inputs.desired_torque, Signals(1.0)",
    ),
    "observe": ("parameters, timestep, signals, inputs", "(signals.heat, 1.0)"),
}


def family(**changes: Any) -> Any:
    """Return a family with other parts; functions are given as text."""
    parts: dict[str, Any] = {
        "State": State,
        "Signals": Signals,
        "OBSERVED": ("heat", "one"),
        "SIGNAL_UNITS": {"heat": "W"},
    }
    for name, (arguments, body) in PARTS.items():
        change = changes.pop(name, body)
        parts[name] = staticmethod(
            function(name, arguments, change) if isinstance(change, str) else change
        )
    gain = changes.pop("gain", real(1.0))
    slipped = type(
        "Slipped",
        (codrl_mj.actuators.ActuatorModel,),
        parts | changes | {"gain": gain, "__annotations__": {"gain": float}},
    )
    return dataclasses.dataclass(frozen=True)(slipped)


class One(NamedTuple):
    """One number."""

    a: float


class Three(NamedTuple):
    """Three numbers."""

    a: float
    b: float
    c: float


class Reserved(NamedTuple):
    """Signal that every family has."""

    speed: float


FAMILIES = pairs(
    {
        "advance": (
            *(
                "state",
                "inputs.desired_torque",
                "None",
                "state, 1.0",
                "1.0, 1.0, 1.0",
                "state, 1.0, Signals(1.0), 1.0",
            ),
            *(
                "(1.0,), 1.0, Signals(1.0)",
                "(1.0, 1.0, 1.0), 1.0, Signals(1.0)",
                "state, 1.0, ()",
                "state, 1.0, state",
            ),
            *(
                f"state, {torque}, Signals(1.0)"
                for torque in ("(1.0,)", "'a'", "1j", "None", "np.inf", "np.zeros(1)")
            ),
            *(f"State({value}), 1.0, Signals(1.0)" for value in ("np.nan, 0.0", "'a', 1.0")),
            *(f"{state}, 1.0, Signals(1.0)" for state in ("[1.0, 1.0]", "np.zeros(2)")),
            *(
                "state, inputs.torque_wanted, Signals(1.0)",
                "state, unknown, Signals(1.0)",
                "raise KeyError('gone')",
                3,
            ),
        ),
        "observe": (
            "()",
            "(1.0,)",
            "(1.0, 2.0, 3.0)",
            "1.0",
            "[1.0, 2.0]",
            "('a', 1.0)",
            "None",
            "unknown",
            3,
        ),
        "State": (One, Three, dict, 3),
        "Signals": (State, Three, Reserved, dict, 3),
        "OBSERVED": (("heat",), ("a", "b", "c")),
        "SIGNAL_UNITS": ({"haet": "W"},),
        "RANDOM": (("gian",),),
        "gain": ("much", dataclasses.field(), dataclasses.field(default=None)),
    }
)
LATE_FAMILIES = [
    ("advance", "x = float(np.linalg.norm(inputs.desired_torque)); return state, x, Signals(1.0)"),
    (
        "advance",
        "return (state, 1.0, Signals(1.0)) if state.a < 10.0 else ((1.0,), 1.0, Signals(1.0))",
    ),
    ("advance", "return (state, 1.0, Signals(1.0)) if state.a < 10.0 else None"),
    ("observe", "return (1.0, 2.0) if signals.heat < 10.0 else (1.0, 2.0, 3.0)"),
    ("observe", "return (1.0, float(np.linalg.norm(signals.heat)))"),
]


def late_task(field: str, body: str) -> Any:
    """Return a task of `LATE`."""
    return task(**{field: body.format(FUNCTIONS[field][1])})


def run(face: str, task_to_run: Any, actuator: Any = "ideal", **options: Any) -> None:
    """Create a task's environments and step them: a single one, several, or those for training."""
    if face == "single":
        env = gymnasium.make(
            task_to_run.env_id, actuator=actuator, disable_env_checker=True, **options
        )
        env.reset(seed=0)
        for _ in range(3):
            env.step(env.action_space.sample())
        from codrl_mj.envs.compiled import compiled_env

        if (parts := compiled_env(env.unwrapped)) is not None:
            parts.reset(env.unwrapped.np_random, parts.low, parts.high, parts.pointers)
    elif face == "vector":
        envs = gymnasium.make_vec(
            task_to_run.env_id,
            3,
            vectorization_mode="vector_entry_point",
            actuator=actuator,
            **options,
        )
        envs.reset(seed=0)
        for _ in range(3):
            envs.step(envs.action_space.sample())
    else:
        envs = codrl_mj.make_sb3_vec_env(
            codrl_mj.EnvConfig(task_to_run.name, actuator, **options), 2
        )
        envs.reset()
        envs.step(np.zeros((2, 1), np.float32))


def main(face: str, every: int) -> None:
    """Run every Nth late error; each must be refused."""
    sound = codrl_mj.register(task())
    for field, body in LATE[every // 2 :: every]:
        if face == "single" or field != "initial_state":
            report_outcome(
                field,
                body,
                lambda field=field, body=body: run(face, codrl_mj.register(late_task(field, body))),
            )
    for part, body in LATE_FAMILIES[every // 2 :: every]:
        report_outcome(
            part,
            body,
            lambda part=part, body=body: run(
                face, sound, family(**{part: body})(), observe_actuator=True
            ),
        )
    run(face, sound, family()(), observe_actuator=True)
    print("the sound one runs")


def report_outcome(name: str, body: str, act: Any) -> None:
    """Run an action and print how it ended."""
    try:
        act()
        print("RAN", name, body, flush=True)
    except ValueError as error:
        print("refused", name, "|", error, flush=True)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
