"""Run the controller of a real rotary pendulum in our simulation, under the targets of its log.

The logs are those of *Closed-Loop Koopman Operator Approximation* (Dahdah and Forbes, arXiv
2303.15318): a QUBE-Servo that a known controller balances at 500 Hz while its targets change. The
table compares how far arm and rod spread about their targets on the rig and in the simulation.

    python scripts/qube_loop.py episodes_00_23.npz
"""

import argparse
import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np

import codrl_mj
from codrl_mj.boundary import Argument
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.tasks import TASKS, Task

STEP = 0.002  # s, of the controller
RUNS = range(2, 24, 4)
FIRST_ROW = 2000  # targets begin to change here
MAX_VOLTAGE = 10.0
MAX_ROD = 1.0  # rad; beyond it the rod has fallen
# Derivatives are filtered: d[k] = DECAY d[k-1] + RATE (e[k] - e[k-1]).
DECAY, RATE = 1.0 / (1.0 + 50.0 / 500.0), 50.0 / (1.0 + 50.0 / 500.0)
PROPORTIONAL, DERIVATIVE = np.array([6.0, 30.0]), np.array([1.8, 2.5])  # V/rad, V*s/rad
TORQUE_PER_VOLT = 0.042 / 8.4  # N*m/V, kT/R of the manual
MODELS: dict[str, dict[str, Argument]] = {
    "ideal torque, kT/R of the manual": {"actuator": "ideal"},
    "the manual's motor and rig": {
        "action": "voltage",
        "actuator": {"name": "default", "supply": {"voltage": MAX_VOLTAGE}},
    },
}
"""Name of a row -> arguments of `codrl_mj.make`."""


class Targets(NamedTuple):
    """Targets of arm and rod [rad], (n, 2), and the voltage that is added [V], (n,)."""

    angles: np.ndarray
    feedforward: np.ndarray


class Spread(NamedTuple):
    """Standard deviations of arm and rod about their targets [rad], and of the voltage [V]."""

    arm: float
    rod: float
    voltage: float


def spread(angles: np.ndarray, volts: np.ndarray, targets: Targets) -> Spread:
    """Return the spread of logged or simulated angles (n, 2) while the targets change."""
    arm = (angles - targets.angles[: len(angles)])[FIRST_ROW:, 0]
    rod, voltage = angles[FIRST_ROW:, 1], volts[FIRST_ROW:]
    return Spread(*(float(np.std(values)) for values in (arm, rod, voltage)))


def fast_task() -> Task:
    """Return Furuta with steps of the controller's period, and without time limit."""
    return dataclasses.replace(
        TASKS["furuta"],
        name="furuta_500hz",
        env_id="codrl_mj/Furuta500Hz-v0",
        step_duration=STEP,
        motor_inner_steps=4,
        ideal_inner_steps=4,
        max_episode_steps=None,
    )


def make_rig(settings: dict[str, Argument]) -> ActuatedEnv:
    """Make the environment of a model: Furuta at the controller's rate."""
    env = codrl_mj.make(EnvConfig(fast_task()), **settings).unwrapped
    assert isinstance(env, ActuatedEnv)
    return env


def balance(env: ActuatedEnv, targets: Targets, resolution: float) -> tuple[np.ndarray, np.ndarray]:
    """Balance the rod, and return the measured angles (k, 2) and voltages (k,) until it falls."""
    env.reset(seed=0)
    env.physics.reset(np.zeros(4))
    errors, rates = np.zeros(2), np.zeros(2)
    angles, volts = np.empty((len(targets.feedforward), 2)), np.empty(len(targets.feedforward))
    takes_volts = env.setup.config.action == "voltage"
    for row, feedforward in enumerate(targets.feedforward):
        # The rig counts the rod's angle clockwise.
        state = env.physics.state[:2] * [1.0, -1.0]
        angles[row] = np.round(state / resolution) * resolution
        if abs(angles[row, 1]) > MAX_ROD:
            return angles[:row], volts[:row]
        new_errors = targets.angles[row] - angles[row]
        rates = DECAY * rates + RATE * (new_errors - errors)
        errors = new_errors
        command = feedforward - PROPORTIONAL @ errors - DERIVATIVE @ rates
        volts[row] = np.clip(command, -MAX_VOLTAGE, MAX_VOLTAGE)
        env.step(np.array([volts[row] * (1.0 if takes_volts else TORQUE_PER_VOLT)], np.float32))
    return angles, volts


def row(name: str, spreads: list[Spread], falls: list[float]) -> str:
    """Return a row of the table: mean spreads of the runs that did not fall."""
    cells = ["-"] * 3
    if spreads:
        arm, rod, voltage = np.mean(spreads, axis=0)
        cells = [f"{1e3 * arm:.0f}", f"{1e3 * rod:.1f}", f"{voltage:.2f}"]
    fallen = f"{len(falls)} of {len(RUNS)}" + (f", at {min(falls):.1f} s" if falls else "")
    return f"| {name} | {fallen} | {' | '.join(cells)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", type=Path, help="episodes_00_23.npz")
    parser.add_argument("--actuator", help="file of an actuator for a further row")
    parser.add_argument(
        "--rig", nargs="*", default=[], metavar="NAME=VALUE", help="Furuta's options"
    )
    parser.add_argument("--delay", type=float, default=0.0, help="of its command [s]")
    arguments = parser.parse_args()
    models = dict(MODELS)
    if arguments.actuator:
        models[arguments.actuator] = {
            "action": "voltage",
            "actuator": arguments.actuator,
            "disturbances": {"command_delay": arguments.delay},
            **{name: float(value) for name, value in (pair.split("=") for pair in arguments.rig)},
        }
    data = np.load(arguments.logs)
    resolution = float(data["rad_per_count"])
    targets = {
        run: Targets(
            np.column_stack([data["target_theta"][run], data["target_alpha"][run]]),
            data["feedforward"][run],
        )
        for run in RUNS
    }
    print("| model | falls | arm [mrad] | rod [mrad] | voltage [V] |")
    print("| --- | --- | ---: | ---: | ---: |")
    measured = [
        spread(
            resolution * np.column_stack([data["theta_count"][run], data["alpha_count"][run]]),
            data["plant_input"][run],
            targets[run],
        )
        for run in RUNS
    ]
    print(row("measured", measured, []))
    for name, settings in models.items():
        env = make_rig(settings)
        spreads, falls = [], []
        for run in RUNS:
            angles, volts = balance(env, targets[run], resolution)
            if len(angles) < len(targets[run].feedforward):
                falls.append(len(angles) * STEP)
            else:
                spreads.append(spread(angles, volts, targets[run]))
        print(row(name, spreads, falls), flush=True)


if __name__ == "__main__":
    main()
