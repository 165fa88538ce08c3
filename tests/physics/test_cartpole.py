"""CartPole with both physics, and its model, against the installed Gymnasium."""

import gymnasium
import mujoco
import numpy as np
import pytest

from codrl_mj.actuators import IDEAL
from codrl_mj.engine import motors
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, SimulationConfig
from codrl_mj.tasks import TASKS, named_actuator
from codrl_mj.user_code import asset_path

TASK = TASKS["cartpole"]
every_physics = pytest.mark.parametrize("physics", [MujocoPhysics, AnalyticPhysics])
every_integrator = pytest.mark.parametrize("integrator", ["euler", "semi-implicit"])


def _gymnasiums_step(integrator, timestep):
    """Return Gymnasium's step of that duration, as a function of state and force."""
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
def test_integration_steps_equal_short_steps_of_gymnasium(physics, integrator, inner_steps):
    simulation = physics(SimulationConfig(TASK, [IDEAL], inner_steps, integrator))
    step = _gymnasiums_step(integrator, 0.02 / inner_steps)
    generator = np.random.default_rng(0)
    high = np.array([2.4, 5.0, np.pi, 10.0])
    for state, force in zip(
        generator.uniform(-high, high, (2000, 4)), generator.uniform(-10, 10, 2000), strict=True
    ):
        simulation.reset(state)
        simulation.step(force)
        for _ in range(inner_steps):
            state = step(state, force)
        np.testing.assert_allclose(
            simulation.state, state, rtol=0, atol=1e-12 if inner_steps == 1 else 1e-11
        )


def test_the_model_has_gymnasiums_inertias_and_the_papers_actuator():
    env = gymnasium.make("CartPole-v1").unwrapped
    model = mujoco.MjModel.from_xml_path(str(asset_path("cartpole.xml")))
    assert model.body("cart").mass == env.masscart
    assert model.body("pole").mass == env.masspole
    assert model.body("pole").ipos[2] == env.length
    assert model.body("pole").inertia[0] == pytest.approx(
        env.masspole * (2 * env.length) ** 2 / 12, rel=1e-15
    )
    assert -model.opt.gravity[2] == env.gravity
    for end, sign in (("left_end", -1), ("right_end", 1)):
        assert model.geom(end).pos[0] == sign * env.x_threshold
    (actuator,) = motors(model).values()
    assert actuator.controller == named_actuator("paper", "cartpole").controller
    assert actuator.motor.arm_radius == pytest.approx(0.15, rel=1e-15)
    np.testing.assert_allclose(model.actuator_ctrlrange[0], [-1.5, 1.5], rtol=1e-15)
    assert model.opt.timestep == TASK.step_duration
