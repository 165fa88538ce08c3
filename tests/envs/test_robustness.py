"""Divergence is reported, never hidden; and no actuator parts MuJoCo from Gymnasium's dynamics."""

import dataclasses

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from codrl_mj.actuators import Actuator, CurrentLoop, Motor, spectral_radius
from codrl_mj.envs import ActuatedEnv
from codrl_mj.physics import PHYSICS, SimulationDivergedError
from codrl_mj.tasks import TASKS
from tests.actuators.strategies import between, zero_or
from tests.matrix import but
from tests.tasks.faces import REBUILT

every_task = pytest.mark.parametrize("task", TASKS)
WILD = Actuator(Motor(), CurrentLoop(kp=1000.0, max_voltage=float("inf")))
pytestmark = pytest.mark.filterwarnings("ignore:overflow encountered", "ignore:invalid value encountered")


def _constant_action(env):
    space = env.action_space
    return np.int64(space.n - 1) if hasattr(space, "n") else space.high


# -- divergence ---------------------------------------------------------------------------------------------


@every_task
@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize("command", ["force", "voltage"])
def test_a_diverging_simulation_raises_with_task_and_entry_and_is_not_reset(
    task, physics, command, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # the engine writes a log
    actuator, options = WILD, {"inner_steps": 1}
    if command == "voltage":  # a winding too fast for the step: |1 - R dt/L| = 1e4 dt - 1
        actuator = Actuator(Motor(inductance=1e-4), CurrentLoop(max_voltage=10.0))
        options |= {"action": "voltage"} | ({"levels": (-1, 0, 1)} if hasattr(TASKS[task].action_space, "n") else {})
    env = ActuatedEnv(task, actuator=actuator, physics=physics, allow_unstable=True, **options)
    env.reset(seed=0)
    action, clocks = _constant_action(env), []

    def run():
        for _ in range(500):
            if physics == "mujoco":
                clocks.append(env.data.time)
            env.step(action)

    with pytest.raises(SimulationDivergedError) as diverged:
        run()
    name = TASKS[task].state_names
    assert str(diverged.value).startswith(f"{task}: the simulation diverged at t = ")
    assert any(entry in str(diverged.value) for entry in name)
    if physics == "mujoco":
        clocks.append(env.data.time)  # never back at 0
        np.testing.assert_allclose(np.diff(clocks), env.task.step_duration, rtol=1e-9)
        assert env.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET
    # it stays diverged until it is reset, and is as new after that
    with pytest.raises(SimulationDivergedError):
        env.step(action)
    fresh = ActuatedEnv(task, actuator=actuator, physics=physics, allow_unstable=True, **options)
    np.testing.assert_array_equal(env.reset(seed=1)[0], fresh.reset(seed=1)[0])
    env.physics.step(1e-3)
    fresh.physics.step(1e-3)
    np.testing.assert_array_equal(env.state, fresh.state)


@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize(
    ("task", "entry", "value"),
    [(task, entry, np.nan) for task in REBUILT for entry in (0, -1)]
    + [("cartpole", entry, value) for entry in range(4) for value in (np.inf, -np.inf, 1e11)],
)
def test_a_state_that_is_no_number_is_reported_at_the_next_step(task, entry, value, physics, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the engine writes a log
    env = ActuatedEnv(task, actuator="default", physics=physics)
    env.reset(seed=0)
    state = env.state
    state[entry] = value
    env.physics.reset(state)
    with pytest.raises(SimulationDivergedError, match=f"^{task}: "):
        env.step(_constant_action(env))


@every_task
@pytest.mark.parametrize("value", [np.inf, -np.inf, 1e11])
@pytest.mark.parametrize("entry", [0, -1])
def test_a_lost_state_is_not_brought_back_within_the_tasks_bounds(task, entry, value, tmp_path, monkeypatch):
    """A wall, a speed limit or a wrapped angle would make it look like any other."""
    monkeypatch.chdir(tmp_path)  # the engine writes a log
    env = ActuatedEnv(task, actuator="default")
    env.reset(seed=0)
    state = env.state
    state[entry] = value
    env.physics.reset(state)
    with pytest.raises(SimulationDivergedError, match=f"^{task}: "):
        env.step(_constant_action(env))


# -- any actuator -------------------------------------------------------------------------------------------

_motors = st.builds(
    Motor,
    resistance=between(0.2, 5),
    inductance=between(0.02, 1),
    torque_constant=between(0.1, 2),
    back_emf_constant=zero_or(0.05, 2),
    arm_radius=between(0.1, 2),
)
_loops = st.builds(
    CurrentLoop,
    kp=zero_or(0.01, 10),
    ki=zero_or(0.01, 20),
    kd=zero_or(1e-6, 0.05),
    kff=zero_or(0.01, 2),
    max_voltage=between(0.5, 50) | st.just(float("inf")),
    bemf_compensation=st.booleans(),
    substeps=st.integers(1, 8),
    integral_leak=zero_or(0.01, 10),
    derivative_time_constant=zero_or(1e-3, 0.1),
)


@pytest.mark.parametrize("task", but(["pendulum"], [*REBUILT]))
@settings(max_examples=40)
@given(motor=_motors, loop=_loops, seed=st.integers(0, 2**31), command=st.sampled_from(["force", "current", "voltage"]))
def test_both_physics_agree_on_any_actuator_from_any_start(task, motor, loop, seed, command):
    """Fifty steps under random actions: states relative to their size within 1e-9, chaotic Acrobot's within 1e-6."""
    actuator, definition = Actuator(motor, loop), TASKS[task]
    options = {"actuator": actuator, "action": command}
    if command == "voltage":
        assume(np.isfinite(loop.max_voltage))
    if command != "force" and hasattr(definition.action_space, "n"):
        largest = definition.max_force * motor.arm_radius / motor.torque_constant
        limit = largest if command == "current" else loop.max_voltage
        options["levels"] = (-limit, -0.3 * limit, 0.0, limit)
    dt = definition.step_duration / definition.motor_inner_steps
    simulated = actuator
    if command == "voltage":
        simulated = dataclasses.replace(actuator, controller=CurrentLoop(kp=0.0, substeps=loop.substeps))
    assume(spectral_radius(simulated, dt) < 1.0)  # an unstable loop multiplies rounding errors without bound
    both = [ActuatedEnv(task, physics=physics, **options) for physics in PHYSICS]
    for env in both:
        env.reset(seed=seed)
    np.testing.assert_array_equal(*(env.state for env in both))
    generator, space = np.random.default_rng(seed), both[0].action_space
    tolerance = 1e-6 if task == "acrobot" else 1e-9
    for step in range(50):
        action = generator.integers(space.n) if hasattr(space, "n") else generator.uniform(space.low, space.high)
        results = [env.step(action) for env in both]
        states = np.array([env.state for env in both])
        scale = max(1.0, np.abs(states).max())
        np.testing.assert_allclose(*states, rtol=0, atol=tolerance * scale, err_msg=f"step {step}")
        signals = np.array([list(map(float, result[-1].values()))[:5] for result in results])
        scale = max(1.0, np.abs(signals).max())
        np.testing.assert_allclose(*signals, rtol=0, atol=10 * tolerance * scale, err_msg=f"step {step}")
