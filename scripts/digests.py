"""Digests of results that a change of the code's structure must leave as they are, bit for bit.

They are written on two commits and compared with `--compare`. They cover trajectories of every task
through every actuator, command and disturbance, and through off-the-shelf motors; trajectories of
third-party environments; the final weights of short trainings of every agent; parameters that are
identified from simulated and real logs; every preset's configuration; and the worst value of every
check of the quick certificate. They may depend on the machine and on the packages' versions.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete
from safetensors.numpy import load_file

import codrl_mj
from codrl_mj import Uniform
from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Ideal, Motor, Supply
from codrl_mj.agents import AGENTS
from codrl_mj.agents.presets import SETTINGS
from codrl_mj.envs.config import EnvConfig
from codrl_mj.identify import identify, read_log
from codrl_mj.identify.synthetic import Excitation, Load, Sampler, Sensor, simulate
from codrl_mj.runs.files import read_json, write_json
from codrl_mj.sizing import find_drive
from codrl_mj.tasks import PAPER_TASKS, find_task, named_actuator
from codrl_mj.training import TrainConfig, train

TASKS = {task.name: task for task in PAPER_TASKS}
EVERY = TASKS | {"furuta": find_task("furuta")}

_COMMAND = {"command_delay": 0.027, "command_quantum": 0.3, "command_rate": 1.5}
_PULSE = {"pulse_force": 0.7, "pulse_duration": 0.13, "pulse_interval": 0.4}
_MOTOR = {"current_noise": 0.05, "current_bias": -0.02, "supply_resistance": 0.7}
_JOINT = {"joint_damping": 0.03, "joint_friction": 0.02}
DISTURBANCES: dict[str, dict[str, float]] = {
    **{name: {name: value} for name, value in (_COMMAND | _MOTOR | _JOINT).items()},
    "pulse": _PULSE,
    "most": _COMMAND | _PULSE | _MOTOR,
    "low_voltage": {},
}
"""Name -> fields; `supply_resistance` and `most` are tested at `low_voltage`.

At a low voltage limit the voltage saturates.
"""
LOW_VOLTAGE = ("supply_resistance", "most", "low_voltage")


def disturbed(name: str, task: str, actuator: str = "paper") -> dict[str, Any]:
    """Return the arguments of `gymnasium.make` for a disturbance.

    Only this function knows how disturbances are spelled, so that old commits need one change.

    Args:
        name: one of `DISTURBANCES`.
        task: the task's name.
        actuator: a named actuator.
    """
    fields = DISTURBANCES[name]
    joint = {
        field.removeprefix("joint_"): value for field, value in fields.items() if field in _JOINT
    }
    sensor = {
        field: value
        for field, value in fields.items()
        if field in ("current_noise", "current_bias")
    }
    others = {field: value for field, value in fields.items() if field not in _JOINT | _MOTOR}
    arguments: dict[str, Any] = {"actuator": actuator, "disturbances": others, "joint": joint}
    nominal = named_actuator(actuator, task)
    if not isinstance(nominal, Ideal):
        limit = {"max_voltage": 0.5} if name in LOW_VOLTAGE else {}
        controller = dataclasses.replace(nominal.controller, **sensor, **limit)
        supply = (
            Supply(resistance=fields["supply_resistance"])
            if "supply_resistance" in fields
            else None
        )
        arguments["actuator"] = dataclasses.replace(nominal, controller=controller, supply=supply)
    return arguments


ACTUATORS = ("ideal", "paper", "weak", "weaker", "open_loop")
_WINDING = Motor(
    resistance=1.3, inductance=0.2, torque_constant=0.9, back_emf_constant=0.8, arm_radius=0.7
)
_GAINS = CurrentLoop(kp=1.0, ki=2.0, kd=0.01, kff=0.5, bemf_compensation=False, substeps=3)
CUSTOM = DCMotorActuator(
    _WINDING, dataclasses.replace(_GAINS, integral_leak=0.1, derivative_time_constant=0.02)
)
"""Actuator with no neutral value in any field."""
STEPS, LIMIT, HOLD = 200, 50, 10
"""Steps of a trajectory, maximum steps of an episode, and steps for which an action is held."""
_CAR = {"low": -1.2, "high": 0.6}
STARTS = {
    "pendulum": {"y_init": 8.0},
    "acrobot": {"low": -2.0, "high": 2.0},
    "mountain_car": _CAR,
    "mountain_car_continuous": _CAR,
}
"""Task -> reset options that lead to speed limits, walls and goals."""
LEVELS = {"current": (-0.6, 0.2, 0.6), "voltage": (-24.0, 1.0, 24.0)}
"""Command -> levels [A or V] of discrete tasks."""
RANDOMIZE = {"motor.inductance": Uniform(0.05, 0.2), "model.gravity": Uniform(0.8, 1.2)}
SIGNALS = ("desired_force", "actual_force", "current", "reference_current", "voltage", "saturated")
Entries = Iterator[tuple[str, str]]


def digest(arrays: list[np.ndarray]) -> str:
    """Return the first digits of the SHA-256 of arrays' bytes."""
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()[:16]


def trajectory(
    task: str,
    num_envs: int | None,
    arguments: dict[str, Any],
    signal_names: tuple[str, ...] = SIGNALS,
    steps: int = STEPS,
) -> str:
    """Return the digest of everything that an environment returns under random actions.

    Args:
        task: the task's name.
        num_envs: number of environments of the vector environment; None for a single one.
        arguments: arguments of the environment.
        signal_names: names of the info's signals.
        steps: number of steps.
    """
    size: tuple[int, ...] = () if num_envs is None else (num_envs,)
    env: Any
    if num_envs is None:
        single = {"max_episode_steps": LIMIT, "disable_env_checker": True} | arguments
        env = gymnasium.make(EVERY[task].env_id, **single)
    else:
        vector = {"max_episode_steps": LIMIT, "num_threads": 1} | arguments
        env = gymnasium.make_vec(EVERY[task].env_id, num_envs, "vector_entry_point", **vector)
    space = env.action_space if num_envs is None else env.single_action_space
    generator, options = np.random.default_rng(1), STARTS.get(task)
    observation, _ = env.reset(seed=2, options=options)
    arrays = [observation, env.unwrapped.state]
    for step in range(steps):
        if step % HOLD == 0 and isinstance(space, Discrete):
            action = generator.integers(space.n, size=size)
        elif step % HOLD == 0:
            action = generator.uniform(space.low, space.high, (*size, *space.shape)).astype(
                np.float32
            )
        observation, reward, terminated, truncated, info = env.step(action)
        # A step in which every environment was reset has no signals.
        signals = [info.get(name, np.zeros(size)) for name in signal_names]
        arrays += [observation, reward, terminated, env.unwrapped.state, *signals]
        if num_envs is None and (terminated or truncated):
            observation, _ = env.reset(options=options)
            arrays += [observation, env.unwrapped.state]
    env.close()
    return digest([np.asarray(array, dtype=np.float64) for array in arrays])


def variants(task: str, physics: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield names and arguments of a task's environments: all actuators, and single variations."""
    for actuator in ACTUATORS:
        yield actuator, {"actuator": actuator}
        for name in DISTURBANCES if actuator in ("ideal", "paper") else ():
            is_motor_disturbance = name in LOW_VOLTAGE or name in _MOTOR
            is_joint_disturbance = name in _JOINT
            # Analytic physics has no joint damping and friction.
            if (actuator == "paper" or not is_motor_disturbance) and (
                physics == "mujoco" or not is_joint_disturbance
            ):
                yield f"{actuator}/{name}", disturbed(name, task, actuator)
    for command, levels in LEVELS.items():
        discrete = isinstance(TASKS[task].action_space, Discrete)
        commanded = {"action": command, "levels": levels if discrete else None}
        yield f"paper/{command}", commanded
        yield f"custom/{command}", commanded | {"actuator": CUSTOM}
    yield "custom/force", {"actuator": CUSTOM}
    yield "paper/inner_steps", {"inner_steps": 25}
    if task == "cartpole":
        yield "paper/center_radius", {"center_radius": 0.02}
    for name, distribution in RANDOMIZE.items():
        if physics == "mujoco" or not name.startswith("model."):
            yield f"paper/{name}", {"randomize": {name: distribution}}


def trajectories() -> Entries:
    """Yield names and digests of trajectories."""
    for task, definition in TASKS.items():
        for physics in ("mujoco", "analytic"):
            for name, arguments in variants(task, physics):
                common = {
                    "physics": physics,
                    "observe_actuator": not name.startswith("ideal"),
                } | arguments
                for integrator in (
                    definition.integrators if name in ACTUATORS else definition.integrators[:1]
                ):
                    digested = trajectory(task, None, common | {"integrator": integrator})
                    yield f"trajectory/{task}/{physics}/{integrator}/{name}", digested
                if physics == "mujoco":
                    yield f"trajectory/{task}/vector/{name}", trajectory(task, 8, common)
        mixed = [named_actuator(name, task) for name in ACTUATORS[1:] * 2]
        yield f"trajectory/{task}/vector/mixed", trajectory(task, 8, {"actuator": mixed})
        arguments = {"randomize": RANDOMIZE, "autoreset_mode": "SameStep"}
        yield f"trajectory/{task}/vector/paper/randomize, same step", trajectory(task, 8, arguments)


TRAININGS: dict[str, dict[str, Any]] = {
    "ppo/cartpole/default": {"rollout_steps": 512},
    "ppo/cartpole/paper": {"rollout_steps": 512, "epochs": 10},
    "ppo/pendulum/default": {"rollout_steps": 512},
    "ddpg/pendulum/default": {"learning_starts": 100},
    "ddpg/pendulum/repaired": {"learning_starts": 100},
    "td3/pendulum/default": {"learning_starts": 100},
    "sac/pendulum/default": {"learning_starts": 100},
    "sac/mountain_car_continuous/default": {"learning_starts": 100},
    "dqn/acrobot/default": {"learning_starts": 100, "target_every": 4},
    "dqn/cartpole/default": {"learning_starts": 100, "train_every": 64},
    "sarsa/mountain_car/default": {},
    "sarsa/cartpole/default": {},
}
"""Agent, task and settings -> changed settings with which a short training learns."""


def weights(subject: str, num_envs: int, arguments: dict[str, Any]) -> str:
    """Return the digest of the policy after a short training.

    Args:
        subject: one of `TRAININGS`.
        num_envs: number of parallel environments.
        arguments: arguments of the environment.
    """
    agent, task, settings = subject.split("/")
    budget: dict[str, Any] = {
        "total_steps": {"ppo": 1024, "sarsa": 2000}.get(agent, 600),
        "total_episodes": None,
    }
    others: dict[str, Any] = {"seed": 3, "num_envs": num_envs, "evaluation_episodes": 1}
    config = TrainConfig.preset(task, agent, settings, **budget, **others)
    changes = dict(TRAININGS[subject])
    # None trains at the end of an episode, which only a single environment has.
    if num_envs > 1 and getattr(config.agent, "train_every", 1) is None:
        changes["train_every"] = 4
    env = EnvConfig(task, **arguments)
    config = dataclasses.replace(
        config, env=env, agent=dataclasses.replace(config.agent, **changes)
    )
    with tempfile.TemporaryDirectory() as folder:
        tensors = load_file(
            train(config, Path(folder) / "run", tensorboard=False) / "policy.safetensors"
        )
    return digest([tensors[name] for name in sorted(tensors)])


def trainings() -> Entries:
    """Yield names and digests of trained weights."""
    for subject in TRAININGS:
        for physics in ("mujoco", "analytic"):
            for num_envs in (1,) if subject.startswith("sarsa") else (1, 4):
                yield (
                    f"weights/{subject}/{physics}/{num_envs}",
                    weights(subject, num_envs, {"physics": physics}),
                )
    for subject, num_envs in (("ppo/cartpole/default", 4), ("sarsa/mountain_car/default", 1)):
        for name in ("current_noise", "supply_resistance", "pulse"):
            arguments = {"observe_actuator": True} | disturbed(name, subject.split("/")[1])
            yield f"weights/{subject}/{name}", weights(subject, num_envs, arguments)
        yield f"weights/{subject}/randomize", weights(subject, num_envs, {"randomize": RANDOMIZE})


def certificate() -> Entries:
    """Yield names of the quick certificate's checks, and their worst values."""
    for check in __import__("codrl_mj.validation").validation.validate(quick=True).checks:
        yield (
            f"certificate/{check.group}/{check.task or 'no task'}/{check.name}",
            repr(float(check.worst)),
        )


MOTORS = {
    "geared": {"name": "maxon-ec45-flat-50w", "motor": {"gear_ratio": 20}},
    "warm": {
        "name": "maxon-ec45-flat-50w",
        "motor": {"gear_ratio": 20, "max_temperature": 25.5},
        "supply": {"voltage": 6.0, "resistance": 0.5},
    },
    "lag": "lag",
    "torque_speed": "torque_speed",
    "servo": "servo",
    "pwm_servo": {"name": "feetech-sts3215-7v4", "family": "pwm_servo"},
}
"""Name -> actuator of a family other than the paper's."""
FAMILIES = ("HalfCheetah-v5", "Hopper-v5", "InvertedPendulum-v5")
"""Ids of third-party environments."""


def behind_motors() -> Entries:
    """Yield names and digests of our tasks' trajectories through other families, or "refused"."""
    for task in TASKS:
        for name, actuator in MOTORS.items():
            for num_envs in (None, 4):
                arguments = {"actuator": actuator, "allow_unstable": True}
                # A servo is refused if the angle wraps.
                arguments |= {"action": "position"} if "servo" in name else {}
                try:
                    digested = trajectory(task, num_envs, arguments, SIGNALS[:5], 60)
                except ValueError:
                    digested = "refused"
                yield f"motors/{task}/{'single' if num_envs is None else 'vector'}/{name}", digested


def rollout_digest(env: Any, steps: int = 60) -> str:
    """Return the digest of a third-party environment and its motors under random actions."""
    generator, space = np.random.default_rng(1), env.action_space
    arrays = [env.reset(seed=2)[0]]
    for _ in range(steps):
        action = generator.uniform(space.low, space.high).astype(space.dtype)
        observation, reward, terminated, truncated, info = env.step(action)
        arrays += [observation, reward, terminated, *(info.get(name, 0.0) for name in SIGNALS[:5])]
        if terminated or truncated:
            arrays.append(env.reset()[0])
    env.close()
    return digest([np.asarray(array, dtype=np.float64) for array in arrays])


def third_party_environments() -> Entries:
    """Yield names and digests of trajectories of Gymnasium's and dm_control's environments."""
    drive = {"name": "maxon-ec45-flat-50w", "motor": {"gear_ratio": 5}}
    variants: dict[str, dict[str, Any]] = {
        "ideal": {"actuator": {".*": "ideal"}},
        "lag": {"actuator": {".*": "lag"}},
        "drive": {"actuator": {".*": drive}, "observe_actuator": True},
        "current": {"actuator": {".*": drive}, "action": "current"},
        "delayed": {
            "actuator": {".*": drive},
            "disturbances": {"command_delay": 0.1, "command_quantum": 0.1},
        },
        "pulses": {"actuator": {".*": "lag"}, "disturbances": _PULSE},
        "drawn": {
            "actuator": {".*": drive},
            "randomize": {
                ".*": {"motor.resistance": "uniform(0.5, 2.0)"},
                "model.gravity": "uniform(0.8, 1.2)",
            },
        },
    }
    for env_id in FAMILIES:
        for name, arguments in variants.items():
            gym_env = codrl_mj.make(env_id, allow_unstable=True, **arguments)
            yield f"others/{env_id}/{name}", rollout_digest(gym_env)
    for name in ("ideal", "drive", "drawn"):
        dm_arguments: dict[str, Any] = {"randomize": None} | {
            key: variants[name][key] for key in variants[name] if key != "observe_actuator"
        }
        options: dict[str, Any] = {
            "task_kwargs": {"random": 1},
            "noise_seed": 3,
            "allow_unstable": True,
        }
        env = codrl_mj.make_dm_control(
            "cheetah/run", dm_arguments.pop("actuator"), **options, **dm_arguments
        )
        generator, arrays = np.random.default_rng(1), []
        env.reset()
        for _ in range(60):
            step = env.step(generator.uniform(-1.0, 1.0, 6))
            arrays += [*step.observation.values(), step.reward]
        yield (
            f"others/cheetah-run/{name}",
            digest([np.asarray(array, dtype=np.float64) for array in arrays]),
        )
    for name, fields in ("vector", {}), ("vector, observed and delayed", OBSERVED_AND_DELAYED):
        config = EnvConfig(
            "Hopper-v5", {".*": drive if fields else "lag"}, allow_unstable=True, **fields
        )
        vector = codrl_mj.make_sb3_vec_env(config, 2)
        vector.seed(3)
        arrays = [vector.reset()]
        for _ in range(60):
            arrays += vector.step(np.full((2, 3), 0.1, dtype=np.float32))[:2]
        yield (
            f"others/Hopper-v5/{name}",
            digest([np.asarray(array, dtype=np.float64) for array in arrays]),
        )


OBSERVED_AND_DELAYED: dict[str, Any] = {
    "observe_actuator": True,
    "disturbances": {"command_delay": 0.02},
}


def furuta() -> Entries:
    """Yield names and digests of trajectories of Furuta, which Gymnasium does not have."""
    kinds: dict[str, dict[str, Any]] = {
        **{
            name: {"actuator": actuator, "allow_unstable": True}
            for name, actuator in MOTORS.items()
            if name not in ("warm", "servo", "pwm_servo")
        },
        "default": {"observe_actuator": True},
        "analytic": {"physics": "analytic", "actuator": "ideal"},
        "current": {"action": "current"},
        "voltage": {"action": "voltage"},
        "delayed": {"disturbances": _COMMAND | _PULSE},
        "drawn": {
            "randomize": {"motor.resistance": Uniform(7.0, 9.0), "model.gravity": Uniform(0.9, 1.1)}
        },
    }
    for name, arguments in kinds.items():
        for num_envs in (None, 4) if name != "analytic" else (None,):
            digested = trajectory("furuta", num_envs, arguments, SIGNALS[:5], 120)
            yield f"furuta/{'single' if num_envs is None else 'vector'}/{name}", digested


def helps() -> Entries:
    """Yield digests of the help texts of every command, and of `train` for every task."""
    verbs = [
        [verb]
        for verb in (
            "train",
            "evaluate",
            "runs",
            "render",
            "replay",
            "view",
            "report",
            "advise",
            "validate",
        )
    ]
    verbs += [["train", task] for task in (*TASKS, "furuta", "HalfCheetah-v5")] + [["identify"]]
    verbs += [
        ["motor", verb] for verb in ("list", "show", "feasible", "choose", "design", "step", "new")
    ]
    for words in ([], *verbs):
        out = subprocess.run(
            [sys.executable, "-m", "codrl_mj", *words, "--help"], capture_output=True, check=False
        )
        yield (
            f"help/{' '.join(words) or 'codrl-mj'}",
            digest([np.frombuffer(out.stdout, dtype=np.uint8)]),
        )


def identified() -> Entries:
    """Yield parameters that are identified from simulated and real logs, with all digits."""
    drive = find_drive("maxon-ec45-flat-50w")
    prbs = Excitation("prbs", amplitude=4.0, duration=2.0)
    sensors = {"current": Sensor(noise=0.02), "position": Sensor(resolution=0.0015)}
    rigs: dict[str, tuple[Load, dict[str, float]]] = {
        "free": (Load(inertia=1e-4), {"load_inertia": 1e-4}),
        "pendulum": (Load(inertia=1e-3, gravity=0.05), {"mgl": 0.05}),
    }
    for rig, (load, known) in rigs.items():
        simulated = [
            simulate(drive, prbs, load, sensors, Sampler(mean_voltage=True), seed)
            for seed in (1, 2)
        ]
        logs = [
            dataclasses.replace(log, signals={name: log.signals[name] for name in LOGGED_SIGNALS})
            for log in simulated
        ]
        for estimate in identify(logs, rig, {"gear_ratio": 1.0, **known}).estimates:
            yield (
                f"identified/{rig}/{estimate.name}",
                f"{estimate.value!r} {estimate.low!r} {estimate.high!r} {estimate.status}",
            )

    columns = "time=time:s,position=position:rad,torque=torque:N*m"
    data_folder = Path(os.environ.get("CODRL_MJ_DATA", "data"))
    if not (data_folder / "bench_logs" / "dfki_pendulum").is_dir():
        # The real logs are optional: codrl-mj data dfki_pendulum downloads them.
        return
    real = [
        read_log(data_folder / "bench_logs" / "dfki_pendulum" / f"{name}.csv", columns)
        for name in ("ddp", "ilqr")
    ]
    for estimate in identify(real, "pendulum").estimates:
        yield (
            f"identified/real pendulum/{estimate.name}",
            f"{estimate.value!r} {estimate.low!r} {estimate.high!r} {estimate.status}",
        )


LOGGED_SIGNALS = ("voltage", "current", "position")


def configurations() -> Entries:
    """Yield the digest of every preset's mapping, whose hash names a run."""
    for task in TASKS:
        for agent in AGENTS:
            for settings in SETTINGS:
                try:
                    mapping = TrainConfig.preset(task, agent, settings).as_mapping()
                except ValueError:
                    continue
                text = json.dumps(mapping, sort_keys=True).encode()
                yield (
                    f"configuration/{task}/{agent}/{settings}",
                    hashlib.sha256(text).hexdigest()[:16],
                )


PARTS = {
    "trajectory": trajectories,
    "weights": trainings,
    "certificate": certificate,
    "motors": behind_motors,
    "furuta": furuta,
    "others": third_party_environments,
    "identified": identified,
    "configuration": configurations,
    "help": helps,
}


def compare(first: dict[str, str], second: dict[str, str]) -> int:
    """Print the entries that differ between two files; return their number."""
    names = sorted(first.keys() | second.keys())
    differing = [name for name in names if first.get(name) != second.get(name)]
    for name in differing:
        print(f"{name}: {first.get(name, 'absent')} and {second.get(name, 'absent')}")
    print(f"{len(differing)} of {len(names)} differ")
    return len(differing)


def main() -> int:
    """Compute digests, or compare two files of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=list(PARTS), help="only this part")
    parser.add_argument("--out", type=Path, help="JSON file for the digests")
    parser.add_argument(
        "--compare", type=Path, nargs=2, metavar="FILE", help="print the differences of two files"
    )
    options = parser.parse_args()
    parts = [options.only] if options.only else list(PARTS)
    if options.compare:
        files = [read_json(path, "file of digests") for path in options.compare]
        return int(
            compare(
                *({n: v for n, v in file.items() if n.split("/")[0] in parts} for file in files)
            )
            > 0
        )
    digests_by_name: dict[str, str] = {}
    for part in parts:
        start = time.perf_counter()
        for name, value in PARTS[part]():
            assert name not in digests_by_name, name
            digests_by_name[name] = value
            print(f"{name} {value}", flush=True)
        print(f"{part}: {time.perf_counter() - start:.0f} s", file=sys.stderr)
    if options.out is not None:
        write_json(options.out, dict(sorted(digests_by_name.items())))
    return 0


if __name__ == "__main__":
    sys.exit(main())
