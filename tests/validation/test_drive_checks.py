"""Tests of the oracles of off-the-shelf motors against hand-written equations."""

import dataclasses
import math

import numpy as np
import pytest

from codrl_mj.actuators import Drive, GearMotor
from codrl_mj.tasks import PAPER_TASKS, TASKS
from codrl_mj.validation.motor_catalogue import (
    TASK_MOTORS,
    DriveOracle,
    JointOracle,
    drive_checks,
    task_drive,
)

ROTOR = GearMotor(
    rotor_inertia=0.02, viscous_friction=0.3, coulomb_friction=0.4, gear_ratio=2.0, arm_radius=0.8
)
# Inertia and damping scale with (n/r)^2, friction with n/r.
ARMATURE, DAMPING, FRICTION = 0.02 * 6.25, 0.3 * 6.25, 0.4 * 2.5


def accelerations(task, state, force, inertia):
    """Return the accelerations of all speeds, with `inertia` added to the driven joint."""
    # The pendulum is a rod of 1 kg and 1 m under 10 m/s^2.
    if task == "pendulum":
        return np.array([(5.0 * math.sin(state[0]) + force) / (1.0 / 3.0 + inertia)])
    if task == "mountain_car":
        return np.array([(force - 2.5 * math.cos(3.0 * state[0])) / (1000.0 + inertia)])
    # The cart has 1 kg, its rod 0.1 kg and 1 m.
    sine, cosine = math.sin(state[2]), math.cos(state[2])
    matrix = [[1.1 + inertia, 0.05 * cosine], [0.05 * cosine, 0.1 / 3.0]]
    return np.linalg.solve(matrix, [force + 0.05 * state[3] ** 2 * sine, 0.05 * 9.8 * sine])


@pytest.mark.parametrize(
    ("task", "state", "integrator"),
    [
        ("pendulum", (0.7, 1.5), "semi-implicit"),
        ("mountain_car", (-0.4, -0.05), "semi-implicit"),
        ("cartpole", (0.1, 1.2, 0.5, -0.8), "euler"),
        ("cartpole", (0.1, -1.2, 0.5, -0.8), "semi-implicit"),
    ],
)
def test_oracle_equals_mass_matrices_with_a_rotor(task, state, integrator):
    """Check sliding joints; a semi-implicit step has the damping of the new speed."""
    definition, step = TASKS[task], 1e-3
    after = JointOracle(definition, Drive(ROTOR), step, integrator).step(np.array(state), 0.6)
    speeds = list(definition.qvel)
    sliding = 0.6 - DAMPING * state[1] - math.copysign(FRICTION, state[1])
    implicit = step * DAMPING if integrator == "semi-implicit" else 0.0
    expected = accelerations(task, state, sliding, ARMATURE + implicit)
    np.testing.assert_allclose(
        (after[speeds] - np.array(state)[speeds]) / step, expected, rtol=1e-9
    )


def test_oracle_holds_a_force_below_the_friction():
    pendulum, state = TASKS["pendulum"], np.array([math.pi, 0.0])
    mechanics = JointOracle(pendulum, Drive(ROTOR), 0.05, "semi-implicit")
    for _ in range(40):
        state = mechanics.step(state, 0.9)
    assert abs(state[0] - math.pi) < 0.05
    for _ in range(40):
        state = mechanics.step(state, 2.0)
    assert abs(state[0] - math.pi) > 0.15


def test_drive_oracle_settles_at_the_command_or_at_the_voltage_limit():
    actuator = Drive()
    oracle = DriveOracle(actuator, 0.01)
    torques = [oracle.torque(0.05, 100.0) for _ in range(3)]
    assert torques[-1] == pytest.approx(0.05, rel=1e-9)
    saturated = [oracle.torque(10.0, 100.0) for _ in range(3)]
    assert saturated[-1] == pytest.approx(0.042 * (24.0 - 0.042 * 100.0) / 8.4, rel=1e-9)
    lossy = DriveOracle(
        dataclasses.replace(
            actuator, motor=dataclasses.replace(actuator.motor, gear_efficiency=0.8)
        ),
        0.01,
    )
    assert [lossy.torque(0.05, 100.0) for _ in range(3)][-1] == pytest.approx(0.04, rel=1e-9)


def test_every_task_has_a_drive_and_they_cover_inertia_damping_and_friction():
    assert TASK_MOTORS.keys() == {task.name for task in PAPER_TASKS}
    drives = [task_drive(name) for name in TASK_MOTORS]
    assert len({name for name, *_ in TASK_MOTORS.values()}) == len(TASK_MOTORS)
    assert all(any(drive.additions[entry] > 0.0 for drive in drives) for entry in range(3))


def test_wrong_oracle_fails_only_the_comparison_with_it(monkeypatch):
    """Check that a torque error of 0.1 % fails; the comparison of two engine loops passes."""
    torque = DriveOracle.torque
    monkeypatch.setattr(DriveOracle, "torque", lambda self, *inputs: 1.001 * torque(self, *inputs))
    assert [check.passed for check in drive_checks(quick=True)] == [False, True]
