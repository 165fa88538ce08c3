"""CartPole in MuJoCo against the installed Gymnasium, with and without a motor."""

from types import SimpleNamespace

import gymnasium
import mujoco
import numpy as np
import pytest

from codrl_mj.actuators import IDEAL, NAMED, Actuator, CurrentLoop, Motor
from codrl_mj.own_code import asset_path
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, Plant, SimulationDivergedError, motors, trace_names
from codrl_mj.tasks import TASKS, named_actuator
from tests.reference import MotorSimulation

TASK = TASKS["cartpole"]
INTEGRATORS = ("euler", "semi-implicit")
WITH_MOTOR = [name for name in NAMED if name != "ideal"]


def _gymnasium(integrator, timestep=0.02):
    env = gymnasium.make("CartPole-v1").unwrapped
    env.kinematics_integrator, env.tau = integrator, timestep
    return env


def _gymnasium_step(env, state, force):
    env.state, env.force_mag, env.steps_beyond_terminated = np.array(state), force, None
    env.step(1)
    return np.array(env.state)


def _step(physics, force):
    """Step, and say what the actuator did."""
    physics.step(force)
    return SimpleNamespace(**dict(zip(trace_names(physics.plant.family), physics.trace[-1, 0].tolist(), strict=True)))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_one_step_is_gymnasiums_from_two_thousand_states_under_as_many_forces(integrator):
    generator = np.random.default_rng(0)
    high = np.array([2.4, 5.0, np.pi, 10.0])
    states = generator.uniform(-high, high, (2000, 4))
    forces = generator.uniform(-10.0, 10.0, 2000)
    physics, env = MujocoPhysics(Plant(TASK, [IDEAL], 1, integrator)), _gymnasium(integrator)
    found, expected = np.empty_like(states), np.empty_like(states)
    for index, (state, force) in enumerate(zip(states, forces, strict=True)):
        physics.reset(state)
        physics.step(force)
        found[index] = physics.state
        expected[index] = _gymnasium_step(env, state, force)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    assert np.abs(expected - states).max() > 0.1


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_the_two_integrators_are_not_the_same(integrator):
    other = INTEGRATORS[1 - INTEGRATORS.index(integrator)]
    one, two = MujocoPhysics(Plant(TASK, [IDEAL], 1, integrator)), MujocoPhysics(Plant(TASK, [IDEAL], 1, other))
    for physics in (one, two):
        physics.reset(np.array([0.0, 0.0, 0.1, 0.0]))
        physics.step(10.0)
    assert abs(one.state[0] - two.state[0]) > 1e-3  # dt^2 times the acceleration


@pytest.mark.parametrize("physics", [MujocoPhysics, AnalyticPhysics])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_inner_steps_are_gymnasium_steps_of_a_fraction_of_the_time(physics, integrator):
    simulation, env = physics(Plant(TASK, [IDEAL], 5, integrator)), _gymnasium(integrator, 0.004)
    state = np.array([0.1, -0.2, 0.05, 0.3])
    simulation.reset(state)
    for force in np.random.default_rng(1).uniform(-10, 10, 50):
        simulation.step(force)
        for _ in range(5):
            state = _gymnasium_step(env, state, force)
        np.testing.assert_allclose(simulation.state, state, rtol=0, atol=1e-11)


@pytest.mark.parametrize("physics", [MujocoPhysics, AnalyticPhysics])
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("inner_steps", [1, 4])
@pytest.mark.parametrize("name", WITH_MOTOR)
def test_the_motor_in_the_loop_is_the_reference_driving_gymnasium(physics, integrator, inner_steps, name):
    """The whole chain by hand: the reference motor turns desired into delivered force, Gymnasium moves."""
    actuator = named_actuator(name, "cartpole")
    simulation = physics(Plant(TASK, [actuator], inner_steps, integrator))
    env, motor = _gymnasium(integrator, 0.02 / inner_steps), MotorSimulation(actuator)
    state = np.array([0.01, -0.02, 0.03, 0.04])
    simulation.reset(state)
    for step in range(100):
        desired = 10.0 if state[2] + 0.5 * state[3] > 0 else -10.0
        signals = _step(simulation, desired)
        for _ in range(inner_steps):
            delivered = motor.step(0.02 / inner_steps, desired, state[1])
            state = _gymnasium_step(env, state, delivered)
        np.testing.assert_allclose(simulation.state, state, rtol=0, atol=1e-10, err_msg=f"step {step}")
        assert signals.desired_force == desired
        assert signals.actual_force == pytest.approx(delivered, abs=1e-9)
        assert signals.current == pytest.approx(motor.current, abs=1e-9)
        assert signals.voltage == pytest.approx(motor.voltage, abs=1e-9)
        assert signals.reference_current == pytest.approx(desired * 0.15, rel=1e-14)
        assert signals.saturated == (abs(motor.voltage) >= 24.0)


def _random(state, generator):
    return generator.choice([-10.0, 10.0])


def _bang_bang(state, generator):
    return 10.0 if state[2] + 0.5 * state[3] + 0.1 * state[0] + 0.2 * state[1] > 0 else -10.0


def _linear(state, generator):
    return float(np.clip(state @ (3.0, 5.0, 40.0, 10.0), -10.0, 10.0))


def episode_errors(actuator, policy, integrator="euler", inner_steps=1, steps=500):
    """Largest distance between both physics over an episode that no end interrupts; each acts on its own state."""
    both = [kind(Plant(TASK, [actuator], inner_steps, integrator)) for kind in (MujocoPhysics, AnalyticPhysics)]
    start, worst = np.random.default_rng(0).uniform(-0.05, 0.05, 4), 0.0
    generators = [np.random.default_rng(0) for _ in both]
    for physics in both:
        physics.reset(start)
    for _ in range(steps):
        one, two = (
            _step(physics, policy(physics.state, generator))
            for physics, generator in zip(both, generators, strict=True)
        )
        worst = max(worst, np.abs(both[0].state - both[1].state).max(), abs(one.actual_force - two.actual_force))
    return worst


# A bang-bang policy does not correct a rounding error before it is large enough to change an action; until then the
# upright pole multiplies it by exp(4/s * t), 1e5 in the three seconds that are compared.
@pytest.mark.parametrize(("policy", "steps"), [(_random, 500), (_linear, 500), (_bang_bang, 150)])
@pytest.mark.parametrize("name", NAMED)
def test_both_physics_agree_over_a_long_episode_with_every_actuator(name, policy, steps):
    assert episode_errors(named_actuator(name, "cartpole"), policy, steps=steps) <= 1e-9


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("inner_steps", [2, 5])
def test_both_physics_agree_with_inner_steps(integrator, inner_steps):
    assert episode_errors(named_actuator("paper", "cartpole"), _linear, integrator, inner_steps, steps=500) <= 1e-9


def test_saturation_is_reported():
    actuator = Actuator(Motor(arm_radius=0.15), CurrentLoop(kp=4.3, max_voltage=2.0))
    for kind in (MujocoPhysics, AnalyticPhysics):
        physics = kind(Plant(TASK, [actuator], 1, "euler"))
        physics.reset(np.zeros(4))
        first = _step(physics, 10.0)
        assert first.saturated
        assert first.voltage == 2.0
        for _ in range(20):
            last = _step(physics, 0.0)
        assert not last.saturated


# -- the asset ----------------------------------------------------------------------------------------------


def test_the_assets_own_actuator_is_the_paper_actuator_of_the_catalog():
    model = mujoco.MjModel.from_xml_path(str(asset_path("cartpole.xml")))
    (actuator,) = motors(model).values()
    paper = named_actuator("paper", "cartpole")
    assert actuator.controller == paper.controller
    assert actuator.motor.arm_radius == pytest.approx(0.15, rel=1e-15)
    np.testing.assert_allclose(model.actuator_ctrlrange[0], [-1.5, 1.5], rtol=1e-15)
    assert model.opt.timestep == TASK.step_duration


def test_the_assets_inertias_are_gymnasiums():
    env = gymnasium.make("CartPole-v1").unwrapped
    model = mujoco.MjModel.from_xml_path(str(asset_path("cartpole.xml")))
    assert model.body("cart").mass == env.masscart
    assert model.body("pole").mass == env.masspole
    assert model.body("pole").ipos[2] == env.length
    assert model.body("pole").inertia[0] == pytest.approx(env.masspole * (2 * env.length) ** 2 / 12, rel=1e-15)
    assert -model.opt.gravity[2] == env.gravity
    for end, sign in (("left_end", -1), ("right_end", 1)):
        assert model.geom(end).pos[0] == sign * env.x_threshold


# -- divergence ---------------------------------------------------------------------------------------------

UNSTABLE = Actuator(Motor(arm_radius=0.15), CurrentLoop(kp=100.0, max_voltage=float("inf")))


@pytest.mark.parametrize("kind", [MujocoPhysics, AnalyticPhysics])
@pytest.mark.filterwarnings("ignore:overflow encountered", "ignore:invalid value encountered")
def test_a_diverging_simulation_is_reported_with_task_time_and_entry_and_works_again_after_reset(
    kind, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # the engine writes a log
    physics = kind(Plant(TASK, [UNSTABLE], 1, "euler"))
    physics.reset(np.zeros(4))

    def run():
        for _ in range(500):
            physics.step(10.0)

    with pytest.raises(SimulationDivergedError, match=r"cartpole: .*diverged at t = [\d.]+ s: .*(x|theta).* = "):
        run()
    physics.reset(np.zeros(4))
    assert np.isfinite(_step(physics, 1.0).current)
    assert np.isfinite(physics.state).all()
