"""Damping and friction of the joint, against scipy's integration of the equations of motion."""

import gymnasium
import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from codrl_mj.actuators import IDEAL
from codrl_mj.disturbances import Joint
from codrl_mj.physics import MujocoPhysics, SimulationConfig
from codrl_mj.tasks import TASKS

START = np.array([2.0, 1.0])


def _pendulum(inner_steps, torque, **joint):
    physics = MujocoPhysics(
        SimulationConfig(
            TASKS["pendulum"], [IDEAL], inner_steps, "semi-implicit", joint=Joint(**joint)
        )
    )
    physics.reset(START)
    for _ in range(10):
        physics.step(torque)
    return physics.state


def _solved(torque, damping=0.0, friction=0.0):
    """Integrate th'' = 3 g/(2 l) sin(th) + 3/(m l^2) u, Gymnasium's, with g = 10, l = m = 1."""

    def rate(_, state):
        load = torque - damping * state[1] - friction * np.sign(state[1])
        return [state[1], 15.0 * np.sin(state[0]) + 3.0 * load]

    solution = solve_ivp(rate, (0, 0.5), START, rtol=1e-10, atol=1e-12)
    assert (solution.y[1] > 0.1).all()
    return solution.y[:, -1]


def test_damping_is_a_torque_opposite_to_the_speed():
    expected = _solved(0.5, damping=0.4)
    coarse_error, fine_error = (
        np.abs(_pendulum(steps, 0.5, damping=0.4) - expected).max() for steps in (250, 500)
    )
    assert fine_error < 1e-3
    # The error is of first order, as is the integrator.
    assert coarse_error / fine_error == pytest.approx(2.0, rel=0.1)
    assert np.abs(_solved(0.5) - expected).max() > 0.1


def test_friction_is_a_constant_torque_opposite_to_the_motion():
    expected = _solved(0.5, friction=0.3)
    assert np.abs(_pendulum(1000, 0.5, friction=0.3) - expected).max() < 2e-3
    assert np.abs(_solved(0.5) - expected).max() > 0.1


@pytest.mark.parametrize(("torque", "sticks"), [(0.9, True), (-0.9, True), (1.4, False)])
def test_friction_holds_smaller_torques(torque, sticks):
    physics = MujocoPhysics(
        SimulationConfig(TASKS["pendulum"], [IDEAL], 10, "semi-implicit", joint=Joint(friction=1.0))
    )
    physics.reset(np.array([np.pi, 0.0]))
    for _ in range(40):
        physics.step(torque)
    moved = abs(physics.state[0] - np.pi) > 0.01
    assert moved != sticks


def test_the_solver_is_off_without_friction_and_has_no_warm_start_with_it():
    flags = {
        name: gymnasium.make("codrl_mj/Pendulum-v0", joint=joint).unwrapped.model.opt.disableflags
        for name, joint in {
            "none": None,
            "damping": {"damping": 1.0},
            "friction": {"friction": 1.0},
        }.items()
    }
    constraint = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    assert flags["none"] & constraint
    assert flags["damping"] == flags["none"]
    assert not flags["friction"] & constraint
    assert flags["friction"] & int(mujoco.mjtDisableBit.mjDSBL_WARMSTART)


def test_the_explicit_integrator_stays_explicit():
    """Check CartPole: positions move by the old velocity, which also determines the damping."""
    damping, cartpole = 2.0, TASKS["cartpole"]
    damped = MujocoPhysics(
        SimulationConfig(
            cartpole, [IDEAL], 1, "euler", np.array([1e6]), joint=Joint(damping=damping)
        )
    )
    plain = MujocoPhysics(SimulationConfig(cartpole, [IDEAL], 1, "euler", np.array([1e6])))
    generator = np.random.default_rng(0)
    for _ in range(50):
        state, force = generator.normal(size=4), generator.normal() * 10
        damped.reset(state)
        plain.reset(state)
        damped.step(force)
        plain.step(force - damping * state[1])
        np.testing.assert_allclose(damped.state, plain.state, rtol=1e-12, atol=1e-12)
    rubbed = MujocoPhysics(
        SimulationConfig(cartpole, [IDEAL], 1, "euler", joint=Joint(damping=1.0, friction=1.0))
    )
    rubbed.reset(state)
    rubbed.step(3.0)
    np.testing.assert_array_equal(rubbed.state[[0, 2]], state[[0, 2]] + 0.02 * state[[1, 3]])


def test_armature_is_an_inertia_of_the_joint():
    """Check that the pendulum starts with tau/(m l^2/3 + I), plus the acceleration by gravity."""
    rotor, torque = 0.25, 1.5
    physics = MujocoPhysics(
        SimulationConfig(
            TASKS["pendulum"], [IDEAL], 4, "semi-implicit", joint=Joint(armature=rotor)
        )
    )
    physics.reset(np.zeros(2))
    physics.step(torque)
    timestep, speed, angle = 0.05 / 4, 0.0, 0.0
    for _ in range(4):
        speed += timestep * (torque + 5.0 * np.sin(angle)) / (1.0 / 3.0 + rotor)
        angle += timestep * speed
    np.testing.assert_allclose(physics.state, [angle, speed], rtol=1e-12)
