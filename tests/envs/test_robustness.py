"""Divergence is always reported; and MuJoCo agrees with Gymnasium's dynamics for any actuator."""

import ctypes
import dataclasses

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor, spectral_radius
from codrl_mj.engine import CallbackInUseError
from codrl_mj.envs import ActuatedEnv, ActuatedVectorEnv
from codrl_mj.physics import PHYSICS, SimulationDivergedError
from codrl_mj.tasks import TASKS
from tests.actuators.strategies import between, zero_or
from tests.conformance.episodes import assert_same, random_actions
from tests.envs.vectors import MODES, batched
from tests.matrix import matrix_params
from tests.tasks.faces import REBUILT

every_task = pytest.mark.parametrize("task", TASKS)
WILD = DCMotorActuator(Motor(), CurrentLoop(kp=1000.0, max_voltage=float("inf")))
pytestmark = pytest.mark.filterwarnings(
    "ignore:overflow encountered", "ignore:invalid value encountered"
)


@pytest.fixture(autouse=True)
def _logs_of_the_engine(tmp_path, monkeypatch):
    """Run each test in its own folder, because the engine writes a log into the present one."""
    monkeypatch.chdir(tmp_path)


def _constant_action(env):
    """Return the largest action."""
    space = env.action_space
    return np.int64(space.n - 1) if hasattr(space, "n") else space.high


# -- divergence -----------------------------------------------------------------------------------


@every_task
@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize("command", ["force", "voltage"])
def test_divergence_raises_with_task_and_entry_and_does_not_reset(task, physics, command):
    actuator, options = WILD, {"inner_steps": 1}
    if command == "voltage":
        # The winding is too fast for the step: |1 - R dt/L| = 1e4 dt - 1.
        actuator = DCMotorActuator(Motor(inductance=1e-4), CurrentLoop(max_voltage=10.0))
        options |= {"action": "voltage"} | (
            {"levels": (-1, 0, 1)} if hasattr(TASKS[task].action_space, "n") else {}
        )
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
        # The engine must not have reset the time to 0.
        clocks.append(env.data.time)
        np.testing.assert_allclose(np.diff(clocks), env.task.step_duration, rtol=1e-9)
        assert env.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET
    # It stays diverged until it is reset, and then is like a new one.
    with pytest.raises(SimulationDivergedError):
        env.step(action)
    fresh = ActuatedEnv(task, actuator=actuator, physics=physics, allow_unstable=True, **options)
    np.testing.assert_array_equal(env.reset(seed=1)[0], fresh.reset(seed=1)[0])
    env.physics.step(1e-3)
    fresh.physics.step(1e-3)
    np.testing.assert_array_equal(env.state, fresh.state)


BEYOND = (np.inf, -np.inf, 1e11, 1e300)


@pytest.mark.parametrize(
    ("task", "physics", "value"),
    [
        *((task, "mujoco", value) for task in TASKS for value in (np.nan, *BEYOND)),
        *((task, "analytic", np.nan) for task in REBUILT),
        # Gymnasium's other equations clip such values.
        *(("cartpole", "analytic", value) for value in BEYOND),
    ],
)
def test_an_invalid_state_raises_at_the_next_step_until_a_reset(task, physics, value):
    """Check states that walls, speed limits or wrapped angles would otherwise hide."""
    env = ActuatedEnv(task, "default", physics)
    action = _constant_action(env)
    for entry in range(len(TASKS[task].state_names)):
        env.reset(seed=0)
        state = env.state
        state[entry] = value
        env.physics.reset(state)
        with pytest.raises(SimulationDivergedError, match=f"^{task}: the simulation diverged"):
            env.step(action)
    assert np.isfinite(env.reset(seed=0)[0]).all()
    assert np.isfinite(env.step(action)[0]).all()


@every_task
@pytest.mark.parametrize("mode", MODES)
def test_a_diverged_environment_is_named_and_the_others_continue_after_its_reset(task, mode):
    # The other episodes end in the step of the divergence, or at the end of the test.
    limit = 3 if mode == "NextStep" else 6
    env, control = (batched(task, 3, mode, max_episode_steps=limit).unwrapped for _ in range(2))
    actions = random_actions(env, np.random.default_rng(0))
    for each_env in (env, control):
        each_env.reset(seed=0)
        each_env.step(actions)
    lost_state = env.snapshot()
    lost_state["physics"][1] = np.nan
    env.restore(lost_state)
    # The error repeats until the environment is reset.
    for _ in range(2):
        with pytest.raises(
            SimulationDivergedError,
            match=rf"^{task}: 1 of 3 simulations diverged; environment 1 at t",
        ):
            env.step(actions)
        control.step(actions)
    for each_env in (env, control):
        each_env.reset(seed=[None, 7, None], options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(env.state, control.state)
    for _ in range(3):
        assert_same(env.step(actions), control.step(actions))


def test_raises_if_another_callback_is_installed_at_construction_or_reset(bare_engine):
    other_callback = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(lambda *_: None)
    env = ActuatedVectorEnv(2, "pendulum")
    env.reset(seed=0)
    mujoco.set_mjcb_control(None)
    mujoco.set_mjcb_control(other_callback)
    with pytest.raises(CallbackInUseError, match="mjcb_control is already set"):
        ActuatedVectorEnv(2, "pendulum")
    with pytest.raises(CallbackInUseError, match="mjcb_control is already set"):
        env.reset(seed=0)
    mujoco.set_mjcb_control(None)
    assert_same(env.reset(seed=0), ActuatedVectorEnv(2, "pendulum").reset(seed=0))


# -- any actuator ---------------------------------------------------------------------------------

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


@pytest.mark.parametrize("task", matrix_params(["pendulum"], [*REBUILT]))
@settings(max_examples=40)
@given(
    motor=_motors,
    loop=_loops,
    seed=st.integers(0, 2**31),
    command=st.sampled_from(["force", "current", "voltage"]),
)
def test_both_physics_agree_on_any_actuator_from_any_start(task, motor, loop, seed, command):
    """Compare fifty random steps; the tolerance is 1e-9 of the states, 1e-6 for acrobots."""
    actuator, definition = DCMotorActuator(motor, loop), TASKS[task]
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
        simulated = dataclasses.replace(
            actuator, controller=CurrentLoop(kp=0.0, substeps=loop.substeps)
        )
    # An unstable loop would multiply rounding errors without bound.
    assume(spectral_radius(simulated, dt) < 1.0)
    envs = [ActuatedEnv(task, physics=physics, **options) for physics in PHYSICS]
    for env in envs:
        env.reset(seed=seed)
    np.testing.assert_array_equal(*(env.state for env in envs))
    generator, space = np.random.default_rng(seed), envs[0].action_space
    tolerance = 1e-6 if task == "acrobot" else 1e-9
    for step in range(50):
        action = (
            generator.integers(space.n)
            if hasattr(space, "n")
            else generator.uniform(space.low, space.high)
        )
        results = [env.step(action) for env in envs]
        states = np.array([env.state for env in envs])
        scale = max(1.0, np.abs(states).max())
        np.testing.assert_allclose(*states, rtol=0, atol=tolerance * scale, err_msg=f"step {step}")
        signals = np.array([list(map(float, result[-1].values()))[:5] for result in results])
        scale = max(1.0, np.abs(signals).max())
        np.testing.assert_allclose(
            *signals, rtol=0, atol=10 * tolerance * scale, err_msg=f"step {step}"
        )
