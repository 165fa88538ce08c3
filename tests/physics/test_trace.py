"""Trace of the integration steps in an environment step: saturation, and the ideal actuator.

`tests/envs/test_wiring.py` compares it row by row with the reference motor.
"""

import numpy as np
import pytest

from codrl_mj.actuators import IDEAL, CurrentLoop, DCMotorActuator, Motor, Supply
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, SimulationConfig
from codrl_mj.tasks import TASKS

DESIRED, ACTUAL, CURRENT, REFERENCE, VOLTAGE, SATURATED, SPEED = range(7)
TASK = TASKS["cartpole"]
every_kind = pytest.mark.parametrize("kind", [MujocoPhysics, AnalyticPhysics])


def _rows(kind, actuator):
    """Return the traces of twenty steps under random forces, stacked, and the forces."""
    physics, forces, rows = (
        kind(SimulationConfig(TASK, [actuator], 3, "euler")),
        np.random.default_rng(0).uniform(-10, 10, 20),
        [],
    )
    for force in forces:
        physics.step(float(force))
        rows.append(physics.trace[:, 0].copy())
    return np.concatenate(rows), np.repeat(forces, 3)


@every_kind
def test_an_ideal_actuator_delivers_the_desired_force_without_a_current(kind):
    rows, forces = _rows(kind, IDEAL)
    np.testing.assert_array_equal(rows[:, DESIRED], forces)
    np.testing.assert_array_equal(rows[:, ACTUAL], forces)
    np.testing.assert_array_equal(rows[:, CURRENT : SATURATED + 1], 0.0)
    assert (rows[:, SPEED] != 0.0).all()


@every_kind
def test_integration_steps_at_the_voltage_limit_are_marked(kind):
    limit, supply_resistance = 2.0, 0.8
    loop = CurrentLoop(kp=2.0, max_voltage=limit)
    rows, _ = _rows(
        kind, DCMotorActuator(Motor(arm_radius=0.15), loop, Supply(resistance=supply_resistance))
    )
    # The supply drops with the current at the start of the step.
    before = np.append(0.0, rows[:-1, CURRENT])
    available = limit - supply_resistance * np.abs(before)
    expected = np.abs(rows[:, VOLTAGE]) >= available * (1 - 1e-12)
    np.testing.assert_array_equal(rows[:, SATURATED].astype(bool), expected)
    assert 0 < expected.sum() < len(expected)
