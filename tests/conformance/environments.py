"""Table of environments: tasks and third-party environments through every interface."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import gymnasium
import pytest
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

import codrl_mj
from codrl_mj import Choice, LogUniform, Uniform, suite
from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor
from codrl_mj.envs import ActuatedEnv
from codrl_mj.physics.variation import bare_model, variable_names
from codrl_mj.tasks import TASKS, named_actuator
from tests.disturbances.everything import MOST, RUBBED, imperfect
from tests.engine.models import FULL, changed
from tests.envs.rig import RigEnv
from tests.external_envs.models import V5, BareEnv

COUNT, LIMITED = 3, {"max_episode_steps": 11}
MOTOR = changed(FULL, inductance=0.2, substeps=3)
"""A motor whose every constant differs from 1, slow enough for the longest step, 0.05 s."""
COMMAND_LIMITS = {
    task: {"current": TASKS[task].max_force * 0.5 / 0.8, "voltage": 4.0} for task in TASKS
}
"""Largest command by task and kind, for `MOTOR`: arm 0.5, kT 0.8 N m/A, 4 V."""
DRIVE = {
    # The range includes unstable gains on every task; such draws are rejected.
    "controller.kp": LogUniform(0.3, 15.0),
    "motor.inductance": Uniform(0.05, 0.2),
    "motor.torque_constant": Uniform(0.5, 1.5),
    "motor.arm_radius": Uniform(0.2, 1.2),
    "controller.max_voltage": Choice([3.0, 12.0, math.inf]),
    "controller.substeps": Choice([1, 2, 3]),
    "controller.bemf_compensation": Choice([True, False]),
}
"""Randomized fields of the motor."""
NOISY = DCMotorActuator(
    Motor(resistance=1.0, inductance=0.05, torque_constant=0.8, back_emf_constant=0.01),
    CurrentLoop(kp=0.5, ki=2.0, max_voltage=4.0, substeps=2, current_noise=0.1),
)
MAXON = {".*": "maxon-ec45-flat-50w"}
PULSES = {"pulse_force": 0.5, "pulse_duration": 0.03, "pulse_interval": 0.1}
EVERYTHING = {
    "observe_actuator": True,
    "randomize": {
        ".*": {
            "motor.resistance": "uniform(0.5, 1.5)",
            "motor.back_emf_constant": "uniform(0, 0.02)",
        },
        "model.gravity": "uniform(0.8, 1.2)",
    },
    "disturbances": {"command_delay": 0.07, "command_rate": 20.0} | PULSES,
    "allow_unstable": True,
    "max_episode_steps": 40,
}
"""Arguments of a third-party environment with `NOISY` motors."""
FURUTA = {
    "current": {"actuator": "default", "action": "current", "observe_actuator": True},
    "voltage": {
        "actuator": "default",
        "action": "voltage",
        "disturbances": {"command_delay": 0.004},
    },
    "randomized": {
        "actuator": "default",
        "randomize": {
            "motor.resistance": Uniform(6.0, 9.0),
            "model.length.rod": Uniform(0.8, 1.2),
            "model.length.arm": Uniform(0.8, 1.2),
        },
        "disturbances": {**MOST, "command_delay": 0.004, "pulse_force": 0.001},
        "observe_actuator": True,
    },
}
"""Arguments by setup for the motor of the Furuta pendulum, which is a drive."""


# -- arguments of tasks ---------------------------------------------------------------------------


def commanded(task, command):
    """Return arguments for a command of `MOTOR`; discrete tasks get four uneven levels."""
    options = {"actuator": MOTOR, "action": command}
    if command != "force" and isinstance(TASKS[task].action_space, gymnasium.spaces.Discrete):
        limit = COMMAND_LIMITS[task][command]
        options["levels"] = (-limit, -limit / 3, limit / 7, limit)
    return options


def scales(task):
    """Return a distribution for each scale factor of a task's model."""
    return {
        name: Uniform(0.6, 1.7)
        for name in variable_names(bare_model(task))
        if "damping" not in name
    }


def arguments(task, setup, physics="mujoco"):
    """Return the arguments of a task's environment in one of `SETUPS`."""
    if setup in ("ideal", "default"):
        return {"actuator": setup}
    if not TASKS[task].paper:
        return FURUTA[setup]
    if setup in ("force", "current"):
        return commanded(task, setup) | {"observe_actuator": setup == "current"}
    if setup == "voltage":
        draws = {"motor.inductance": Uniform(0.15, 0.3)}
        return commanded(task, setup) | {"observe_actuator": True, "randomize": draws}
    return {
        "actuator": imperfect(named_actuator("paper", task).as_mapping()),
        "randomize": DRIVE | ({} if physics == "analytic" else scales(task)),
        "disturbances": MOST,
        "joint": None if physics == "analytic" else RUBBED,
        "observe_actuator": True,
    }


SETUPS = ("ideal", "default", "force", "current", "voltage", "randomized")


# -- table ----------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Environment:
    """One environment with one interface, and what it supports."""

    name: str
    make: Callable[[], Any]
    interface: str
    """`single` (Gymnasium), `vector` (Gymnasium), `sb3` or `dm_env`."""
    reference: Callable[[], Any] | None = None
    """Single environments for comparison: the one inside `dm_env`, or a loop over N of them."""
    original: Callable[[], gymnasium.Env] | None = None
    """The third-party environment without motors; None for a task."""
    source: Any = None
    """First argument of `codrl_mj.make`."""
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Other arguments of `codrl_mj.make`."""
    motors: int = 1
    is_task: bool = True
    is_seeded: bool = True
    """True if `reset` takes a seed."""
    has_snapshots: bool = True
    """True if a snapshot contains the whole state, so that the episode continues."""
    copies: str = "continue"
    """`continue`, `reset` (a copy must be reset first), or empty (there are no copies)."""
    saturates: bool = True
    """True if continuous actions outside the space act like those at its bounds."""
    is_quick: bool = False
    """True if `make test` runs it; `make check` runs all."""

    @property
    def is_observed(self):
        """Return True if sensors are appended to observations."""
        return self.options.get("observe_actuator", False)


def limited(create, env, **options):
    """Return an environment of a function of the package, with a short time limit."""
    return create(env, **{**LIMITED, **options})


def loop(env, mode, options):
    """Return Gymnasium's loop over single environments."""
    make = functools.partial(limited, codrl_mj.make, env, **options)
    mode = gymnasium.vector.AutoresetMode(mode)
    return gymnasium.vector.SyncVectorEnv([make] * COUNT, autoreset_mode=mode)


def sb3_loop(env, options):
    """Return Stable-Baselines3's loop over single environments."""
    make = functools.partial(limited, codrl_mj.make, env, **options)
    return DummyVecEnv([lambda: Monitor(make())] * COUNT)


def suite_env(env, **options):
    """Return an environment with the interface of dm_env."""
    if isinstance(env, str) and env in TASKS:
        return suite.load(env, **options)
    return suite.DmEnvironment(codrl_mj.make(env, **options))


INTERFACES = ("single", "dm_env", "sb3", "SameStep", "NextStep", "Disabled")


def interfaces(name, env, options, quick, labels=INTERFACES, **supports):
    """Return the entries of one environment: single, as a vector, and with both adapters.

    Args:
        name: beginning of the entries' names.
        env: first argument of `codrl_mj.make`.
        options: its other arguments.
        quick: interfaces that `make test` runs.
        labels: interfaces that `make check` runs too.
        **supports: fields of the entries.
    """
    make_vec = functools.partial(codrl_mj.make_vec, num_envs=COUNT)
    make_sb3 = functools.partial(codrl_mj.make_sb3_vec_env, num_envs=COUNT)
    single = functools.partial(codrl_mj.make, env, **options)
    if supports.get("is_task", True):
        single = functools.partial(ActuatedEnv, env, **options)
    makers = {
        "single": ("single", single, None),
        "dm_env": (
            "dm_env",
            functools.partial(limited, suite_env, env, **options),
            functools.partial(limited, codrl_mj.make, env, **options),
        ),
        "sb3": (
            "sb3",
            functools.partial(limited, make_sb3, env, **options),
            functools.partial(sb3_loop, env, options),
        ),
    } | {
        mode: (
            "vector",
            functools.partial(limited, make_vec, env, autoreset_mode=mode, **options),
            functools.partial(loop, env, mode, options),
        )
        for mode in ("SameStep", "NextStep", "Disabled")
    }
    return [
        Environment(
            f"{name}-{label}",
            make,
            interface,
            reference,
            source=env,
            options=options,
            is_quick=label in quick,
            **supports,
        )
        for label, (interface, make, reference) in makers.items()
        if label in labels or label in quick
    ]


QUICK = {
    ("pendulum", "randomized", "mujoco"): ("single", "dm_env", "sb3", "NextStep"),
    ("pendulum", "randomized", "analytic"): ("single", "SameStep"),
    ("cartpole", "ideal", "mujoco"): ("single",),
    ("cartpole", "current", "mujoco"): ("single", "Disabled", "dm_env"),
    ("cartpole", "voltage", "analytic"): ("single", "sb3"),
    ("mountain_car", "default", "mujoco"): ("single",),
    ("furuta", "randomized", "mujoco"): ("single", "SameStep"),
}
"""Task, setup and physics -> interfaces that `make test` runs."""


def task_environments():
    """Yield the entries of all tasks on both physics."""
    for task, physics, setup in (
        (task, physics, setup)
        for task in TASKS
        for physics in ("mujoco", "analytic")
        for setup in SETUPS
    ):
        # The closed form of the Furuta pendulum has no rotor, which its own motor needs.
        if not TASKS[task].paper and (
            (physics == "analytic" and setup != "ideal") or setup == "force"
        ):
            continue
        options = arguments(task, setup, physics) | {"physics": physics}
        quick = QUICK.get((task, setup, physics), ())
        labels = ("single", "SameStep", "dm_env")
        # How vectors reset does not depend on the command, so the largest setup has all modes.
        if setup == "randomized":
            labels = INTERFACES
        elif physics == "analytic":
            labels = ("single", "SameStep")
        yield from interfaces(f"{task}-{physics}-{setup}", task, options, quick, labels)
    quick = ("single", "SameStep", "sb3", "dm_env")
    yield from interfaces("pendulum-bus_servo", "pendulum", BUS_SERVO, quick)


def limited_cheetah(**options):
    """Make a third-party environment by a function, with a time limit of its own."""
    return gymnasium.wrappers.TimeLimit(HalfCheetahEnv(**options), 500)


CHEETAH = "HalfCheetah-v5"
THIRD = {"is_task": False, "copies": "reset"}
TWO_KINDS = {"actuator": {"b.*": MAXON[".*"], "f.*": "lag"}, "observe_actuator": True}
LAG = {"actuator": {".*": "lag"}}
DRAWN_LAG = LAG | {"randomize": {"time_constant": "loguniform(0.01, 1)"}}
BUS_SERVO = {
    "actuator": {
        "name": "feetech-sts3215-7v4",
        "family": "pwm_servo",
        "loop": {"command_rate": 60.0, "command_jitter": 0.002, "max_velocity": 4.0},
    },
    "action": "position",
    "randomize": {"loop.command_delay": "uniform(0, 0.03)", "motor.resistance": "uniform(2, 4)"},
    "observe_actuator": True,
}
"""Arguments with a servo on a bus, whose delay is drawn at each reset."""
DRAWN_RIG = {
    "actuator": {"drive": "maxon-re65"},
    "randomize": {"motor.resistance": "uniform(0.1, 0.2)", "model.gravity": "uniform(0.9, 1.1)"},
    "disturbances": {"command_delay": 0.02},
    "options": {"target": 0.5},
}
FUNCTION = f"{__name__}:limited_cheetah"


def third_party_environments():
    """Yield the entries of third-party environments, made by an id, a function and a source."""
    for name, env, options, quick, supports in (
        ("cheetah-two_kinds", CHEETAH, TWO_KINDS, ("single", "sb3"), {"motors": 6}),
        (
            "cheetah-current",
            CHEETAH,
            {"actuator": MAXON, "action": "current", "observe_actuator": True},
            (),
            {"motors": 6},
        ),
        (
            "cheetah-lag",
            CHEETAH,
            LAG | {"disturbances": {"command_rate": 5.0}, "max_episode_steps": 7},
            (),
            {"motors": 6},
        ),
        ("function-drawn", FUNCTION, DRAWN_LAG, ("single", "dm_env"), {"motors": 6}),
        (
            "cheetah-bus_servo",
            CHEETAH,
            BUS_SERVO | {"actuator": {".*": BUS_SERVO["actuator"]}},
            ("single",),
            {"motors": 6},
        ),
    ):
        original = functools.partial(gymnasium.make, CHEETAH)
        yield from interfaces(name, env, options, quick, original=original, **THIRD, **supports)
    # These store their state anywhere, so that a restored one can only start an episode.
    supports = THIRD | {"has_snapshots": False}
    original = functools.partial(RigEnv, 0.5)
    yield from interfaces(
        "source", "tests.envs.rig:RIG", DRAWN_RIG, ("single",), original=original, **supports
    )
    # The model of the bare environment limits only one of its two controls.
    supports |= {"motors": 2, "saturates": False}
    options = DRAWN_LAG | {"max_episode_steps": 9}
    yield from interfaces(
        "bare", f"{BareEnv.__module__}:BareEnv", options, ("single",), original=BareEnv, **supports
    )


def registered_environments():
    """Yield the entries of Gymnasium's MuJoCo environments, with ideal and with noisy motors."""
    for env_id in V5:
        motors = gymnasium.make(env_id).action_space.shape[0]
        for kind, options in {
            "ideal": {"actuator": {".*": "ideal"}},
            "noisy": {"actuator": {".*": NOISY}} | EVERYTHING,
        }.items():
            # Rewards of Ant depend on poses that lag one step behind.
            is_quick = kind == "noisy" and env_id in (CHEETAH, "InvertedPendulum-v5")
            yield Environment(
                f"{env_id}-{kind}",
                functools.partial(codrl_mj.make, env_id, **options),
                "single",
                original=functools.partial(gymnasium.make, env_id),
                source=env_id,
                options=options,
                motors=motors,
                # The limit of the command's rate acts before MuJoCo clips the command.
                saturates=kind == "ideal",
                is_quick=is_quick,
                **THIRD,
            )


DM_CONTROL = {
    "actuator": {".*": NOISY},
    "randomize": {"model.mass.torso": "uniform(0.5, 2.0)"},
}


def dm_control_cheetah(seed=1):
    """Make an environment of dm_control with noisy motors; imports dm_control on first use."""
    return codrl_mj.make_dm_control(
        "cheetah/run",
        DM_CONTROL["actuator"],
        randomize=DM_CONTROL["randomize"],
        noise_seed=seed,
        task_kwargs={"random": seed},
    )


ENVIRONMENTS = (
    *task_environments(),
    *third_party_environments(),
    *registered_environments(),
    Environment(
        "dm_control",
        dm_control_cheetah,
        "dm_env",
        options=DM_CONTROL,
        motors=6,
        is_task=False,
        is_seeded=False,
        has_snapshots=False,
        copies="",
        is_quick=True,
    ),
)


def every(contract, supports=lambda _: True):
    """Parametrize a contract over all environments that support it, with ids to select them by."""
    return pytest.mark.parametrize(
        "environment",
        [
            pytest.param(
                environment,
                id=f"{environment.name}-{contract}",
                marks=() if environment.is_quick else pytest.mark.matrix,
            )
            for environment in ENVIRONMENTS
            if supports(environment)
        ],
    )
