"""CartPole on both physics against the installed Gymnasium, with and without a motor."""

import gymnasium
import mujoco
import numpy as np
import pytest

from codrl_mj.actuators import IDEAL, NAMED
from codrl_mj.engine import motors
from codrl_mj.own_code import asset_path
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, Plant, trace_names
from codrl_mj.tasks import TASKS, named_actuator
from tests.reference import MotorSimulation

TASK = TASKS["cartpole"]
every_physics = pytest.mark.parametrize("physics", [MujocoPhysics, AnalyticPhysics])
every_integrator = pytest.mark.parametrize("integrator", ["euler", "semi-implicit"])


def _gymnasiums_step(integrator, timestep):
    """Gymnasium's step of that length, as a function of state and force."""
    env = gymnasium.make("CartPole-v1").unwrapped
    env.kinematics_integrator, env.tau = integrator, timestep

    def step(state, force):
        env.state, env.force_mag, env.steps_beyond_terminated = np.array(state), force, None
        env.step(1)
        return np.array(env.state)

    return step


@every_physics
@every_integrator
@pytest.mark.parametrize("inner_steps", [1, 5])
def test_steps_are_gymnasiums_of_a_fraction_of_the_time(physics, integrator, inner_steps):
    simulation = physics(Plant(TASK, [IDEAL], inner_steps, integrator))
    step = _gymnasiums_step(integrator, 0.02 / inner_steps)
    generator = np.random.default_rng(0)
    high = np.array([2.4, 5.0, np.pi, 10.0])
    for state, force in zip(generator.uniform(-high, high, (500, 4)), generator.uniform(-10, 10, 500), strict=True):
        simulation.reset(state)
        for _ in range(2):
            simulation.step(force)
            for _ in range(inner_steps):
                state = step(state, force)
        np.testing.assert_allclose(simulation.state, state, rtol=0, atol=1e-11)


@every_physics
@every_integrator
@pytest.mark.parametrize("inner_steps", [1, 4])
@pytest.mark.parametrize("name", [name for name in NAMED if name != "ideal"])
def test_the_motor_in_the_loop_is_the_reference_driving_gymnasium(physics, integrator, inner_steps, name):
    """The whole chain by hand: the reference motor turns desired into delivered force, Gymnasium moves."""
    actuator = named_actuator(name, "cartpole")
    simulation, motor = physics(Plant(TASK, [actuator], inner_steps, integrator)), MotorSimulation(actuator)
    step, names = _gymnasiums_step(integrator, 0.02 / inner_steps), trace_names(simulation.plant.family)
    state = np.array([0.01, -0.02, 0.03, 0.04])
    simulation.reset(state)
    for count in range(100):
        desired = 10.0 if state[2] + 0.5 * state[3] > 0 else -10.0
        simulation.step(desired)
        for _ in range(inner_steps):
            delivered = motor.step(0.02 / inner_steps, desired, state[1])
            state = step(state, delivered)
        np.testing.assert_allclose(simulation.state, state, rtol=0, atol=1e-10, err_msg=f"step {count}")
        signals = dict(zip(names, simulation.trace[-1, 0].tolist(), strict=True))
        assert signals["desired_force"] == desired
        assert signals["actual_force"] == pytest.approx(delivered, abs=1e-9)
        assert signals["current"] == pytest.approx(motor.current, abs=1e-9)
        assert signals["voltage"] == pytest.approx(motor.voltage, abs=1e-9)
        assert signals["reference_current"] == pytest.approx(desired * 0.15, rel=1e-14)
        assert signals["saturated"] == (abs(motor.voltage) >= 24.0)


def test_the_asset_has_gymnasiums_inertias_and_the_papers_actuator():
    env = gymnasium.make("CartPole-v1").unwrapped
    model = mujoco.MjModel.from_xml_path(str(asset_path("cartpole.xml")))
    assert model.body("cart").mass == env.masscart
    assert model.body("pole").mass == env.masspole
    assert model.body("pole").ipos[2] == env.length
    assert model.body("pole").inertia[0] == pytest.approx(env.masspole * (2 * env.length) ** 2 / 12, rel=1e-15)
    assert -model.opt.gravity[2] == env.gravity
    for end, sign in (("left_end", -1), ("right_end", 1)):
        assert model.geom(end).pos[0] == sign * env.x_threshold
    (actuator,) = motors(model).values()
    assert actuator.controller == named_actuator("paper", "cartpole").controller
    assert actuator.motor.arm_radius == pytest.approx(0.15, rel=1e-15)
    np.testing.assert_allclose(model.actuator_ctrlrange[0], [-1.5, 1.5], rtol=1e-15)
    assert model.opt.timestep == TASK.step_duration
