"""Commanding the current or the voltage instead of the force, and observing the actuator."""

import copy
import math
import re

import gymnasium
import mujoco
import numpy as np
import pytest

from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor, Supply
from codrl_mj.envs import ActuatedEnv
from codrl_mj.physics import PHYSICS
from codrl_mj.tasks import TASKS
from codrl_mj.user_code import asset_path
from tests.conformance.environments import COMMAND_LIMITS, MOTOR, commanded
from tests.conformance.episodes import assert_same, plain
from tests.engine.models import changed
from tests.tasks.faces import every_rebuilt

DISCRETE = ("cartpole", "acrobot", "mountain_car")
CONTINUOUS = ("pendulum", "mountain_car_continuous")
SPEED = {
    "pendulum": 1,
    "cartpole": 1,
    "acrobot": 3,
    "mountain_car": 1,
    "mountain_car_continuous": 1,
}

every_task = pytest.mark.parametrize("task", TASKS)
every_command = pytest.mark.parametrize("command", ["current", "voltage"])
every_physics = pytest.mark.parametrize("physics", PHYSICS)


def make(task, command="force", **options):
    """Make an environment, and reset it."""
    env = ActuatedEnv(task, **commanded(task, command) | options)
    env.reset(seed=0)
    return env


def command_of_action(env, action):
    """Return the current or voltage of an action."""
    levels = env.setup.config.levels
    return float(action[0]) if levels is None else float(levels[action])


def sampled(env, steps):
    """Return random actions, each held for two steps."""
    space = copy.deepcopy(env.action_space)
    space.seed(0)
    return [action for _ in range(steps // 2) for action in [space.sample()] * 2]


# -- the current ----------------------------------------------------------------------------------


@every_task
@every_physics
def test_a_current_command_equals_the_force_command_of_its_torque(task, physics):
    env, by_force = make(task, "current", physics=physics), make(task, physics=physics)
    for action in sampled(env, 60):
        force = 0.8 * command_of_action(env, action) / 0.5
        if task in CONTINUOUS:
            info, expected = env.step(action)[-1], by_force.step(np.array([force]))[-1]
        else:
            # The task's own actions do not include every force.
            by_force.physics.step(force)
            expected = by_force.bank.signals(by_force.physics.trace[-1][0].tolist(), force)
            info = env.step(action)[-1]
        assert info["desired_force"] == pytest.approx(force, rel=1e-12)
        assert info["reference_current"] == pytest.approx(command_of_action(env, action), rel=1e-12)
        np.testing.assert_allclose(
            list(info.values()), list(expected.values()), rtol=1e-12, atol=1e-12
        )
        np.testing.assert_allclose(env.state, by_force.state, rtol=0, atol=1e-12)


@every_physics
@every_command
def test_the_highest_action_does_not_exceed_the_limit(physics, command):
    """In float32 the limits 0.6 A and 0.7 V are rounded up."""
    actuator = DCMotorActuator(Motor(arm_radius=0.3), CurrentLoop(max_voltage=0.7))
    env = make("pendulum", command, physics=physics, actuator=actuator)
    info = env.step(env.action_space.high)[-1]
    assert info["voltage"] <= 0.7
    if command == "current":
        assert info["desired_force"] <= 2.0


@pytest.mark.parametrize(
    ("task", "command", "actuator", "high"),
    [
        *(
            (task, command, MOTOR, COMMAND_LIMITS[task][command])
            for task in CONTINUOUS
            for command in ("current", "voltage")
        ),
        (
            "pendulum",
            "voltage",
            DCMotorActuator(controller=CurrentLoop(max_voltage=24.0), supply=Supply(12.0)),
            12.0,
        ),
        (
            "pendulum",
            "voltage",
            DCMotorActuator(controller=CurrentLoop(max_voltage=math.inf), supply=Supply(12.0)),
            12.0,
        ),
    ],
)
def test_the_action_space_ends_at_the_largest_command(task, command, actuator, high):
    space = make(task, command, actuator=actuator).action_space
    assert space == gymnasium.spaces.Box(np.float32([-high]), np.float32([high]))


# -- the voltage ----------------------------------------------------------------------------------


def winding(motor, dt, substeps, max_voltage, current, voltage, speed):
    """Integrate L di/dt = u - kE*omega - R*i by Euler at a constant speed; return the current."""
    u = min(max(voltage, -max_voltage), max_voltage)
    for _ in range(substeps):
        emf = motor.back_emf_constant * speed / motor.arm_radius
        current += (u - emf - motor.resistance * current) / motor.inductance * (dt / substeps)
    return current


@every_rebuilt
@every_physics
def test_a_voltage_drives_the_winding_and_the_winding_drives_the_task(task, physics):
    """Compare single steps with the winding and unmodified Gymnasium from the same state."""
    env, driver = make(task, "voltage", physics=physics), TASKS[task].reference_env()
    motor, loop = MOTOR.motor, MOTOR.controller
    inner, current = env.task.motor_inner_steps, 0.0
    dt = env.task.step_duration / inner
    max_motion = 0.0
    for action in sampled(env, 100):
        state, voltage = env.state, command_of_action(env, action)
        start = state.copy()
        for _ in range(inner):
            current = winding(
                motor, dt, loop.substeps, loop.max_voltage, current, voltage, state[SPEED[task]]
            )
            force = motor.torque_constant * current / motor.arm_radius
            state = np.array(driver(state, force, dt, env.setup.simulation.integrator))
        info = env.step(action)[-1]
        np.testing.assert_allclose(env.state, state, rtol=0, atol=1e-12)
        assert info["current"] == pytest.approx(current, rel=0, abs=1e-12)
        assert (
            info["desired_force"] == info["actual_force"] == pytest.approx(force, rel=0, abs=1e-12)
        )
        assert info["reference_current"] == info["current"]
        assert info["voltage"] == pytest.approx(voltage, rel=0, abs=1e-12)
        max_motion, current = max(max_motion, np.abs(state - start).max()), info["current"]
    assert max_motion > 1e-3


@every_rebuilt
@every_physics
def test_without_back_emf_the_current_equals_that_of_a_locked_rotor(task, physics):
    """Compare with I = V/R (1 - (1 - R dt/L)^n) after n electrical steps, for any motion."""
    env = make(task, "voltage", physics=physics, actuator=changed(MOTOR, back_emf_constant=0.0))
    inner = env.task.motor_inner_steps
    decay = 1.0 - 1.2 * env.task.step_duration / inner / 3 / 0.2
    action = env.action_space.n - 1 if task in DISCRETE else np.array([3.7])
    voltage = 4.0 if task in DISCRETE else 3.7
    for step in range(1, 20):
        info = env.step(action)[-1]
        assert info["current"] == pytest.approx(
            voltage / 1.2 * (1 - decay ** (3 * inner * step)), rel=1e-12
        )


def test_pendulum_under_voltages_is_mujocos_dcmotor():
    """Compare with MuJoCo's dcmotor, whose winding is exact over a step, while ours uses Euler.

    Both are the same map if L is replaced by R*dt/(1 - exp(-R*dt/L)).
    """
    r, inductance, k, arm, dt = 2.0, 0.1, 0.5, 0.4, 0.05
    spec = mujoco.MjSpec.from_file(str(asset_path("pendulum.xml")))
    spec.option.timestep = dt
    joint = spec.actuator("motor").target
    spec.delete(spec.actuator("motor"))
    driver = spec.add_actuator(
        trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint, gear=[1 / arm, 0, 0, 0, 0, 0]
    )
    driver.set_to_dcmotor(
        motorconst=[k, k],
        resistance=r,
        inductance=[inductance, 0.0],
        ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE),
    )
    native = spec.compile()
    data = mujoco.MjData(native)
    assert native.na == 1
    equivalent = r * dt / (1.0 - math.exp(-r * dt / inductance))
    motor = Motor(
        resistance=r, inductance=equivalent, torque_constant=k, back_emf_constant=k, arm_radius=arm
    )
    env = make("pendulum", "voltage", actuator=DCMotorActuator(motor, CurrentLoop(max_voltage=5.0)))
    env.physics.reset(np.array([2.5, 0.0]))
    data.qpos[:] = 2.5
    for voltage in np.repeat(np.random.default_rng(0).uniform(-5, 5, 20), 5):
        data.ctrl[:] = voltage
        mujoco.mj_step(native, data)
        info = env.step(np.array([voltage]))[-1]
        # The task limits the speed to 8 rad/s, the native model does not.
        assert abs(data.qvel[0]) < 8.0
        np.testing.assert_allclose(env.state, [data.qpos[0], data.qvel[0]], rtol=0, atol=1e-11)
        assert info["current"] == pytest.approx(data.act[0], rel=0, abs=1e-11)
    assert np.abs(data.act[0]) > 0.1


@every_task
@every_physics
def test_a_voltage_command_bypasses_the_controller_but_not_supply_and_substeps(task, physics):
    gains = {
        "kp": 0.3,
        "ki": 7.0,
        "kd": 0.01,
        "kff": 3.0,
        "integral_leak": 0.0,
        "derivative_time_constant": 0.2,
    }
    relevant_changes = [{"substeps": 1}, *([{"max_voltage": 3.0}] if task in CONTINUOUS else [])]
    actions, runs = sampled(make(task, "voltage"), 30), []
    for fields in ({}, {**gains, "bemf_compensation": False}, *relevant_changes):
        env = make(task, "voltage", physics=physics, actuator=changed(MOTOR, **fields))
        runs.append(plain([env.step(action) for action in actions]))
    assert_same(runs[1], runs[0])
    for other_run in runs[2:]:
        assert other_run[-1][-1]["current"] != runs[0][-1][-1]["current"]


def test_a_voltage_command_allows_an_unstable_loop_but_not_an_unstable_winding():
    wild = changed(MOTOR, kp=1000.0)
    with pytest.raises(ValueError, match="unstable"):
        make("pendulum", actuator=wild)
    make("pendulum", "voltage", actuator=wild)
    # |1 - R dt/L| = 2
    with pytest.raises(ValueError, match=r"unstable at a step of 0\.05 s"):
        make("pendulum", "voltage", actuator=DCMotorActuator(Motor(resistance=6.0)))


@pytest.mark.parametrize("task", CONTINUOUS)
@every_physics
def test_voltages_beyond_the_supply_saturate(task, physics):
    unlimited_env, limited_env = (make(task, "voltage", physics=physics) for _ in range(2))
    for voltage in (100.0, -np.inf, np.inf, 4.0):
        for _ in range(5):
            outcome, expected = (
                unlimited_env.step(np.array([voltage])),
                limited_env.step(np.array([np.clip(voltage, -4.0, 4.0)])),
            )
            np.testing.assert_array_equal(outcome[0], expected[0])
            assert outcome[-1] == expected[-1]
            assert outcome[-1]["voltage"] == pytest.approx(np.sign(voltage) * 4.0, rel=1e-15)


# -- levels ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", DISCRETE)
@every_command
@every_physics
def test_each_action_commands_its_level(task, command, physics):
    limit = COMMAND_LIMITS[task][command]
    levels = [limit, -0.4 * limit, 0.0, 0.1 * limit, -limit]
    env = make(task, command, physics=physics, levels=levels)
    assert env.action_space == gymnasium.spaces.Discrete(5)
    signal = {"current": "reference_current", "voltage": "voltage"}[command]
    for action, level in enumerate(levels):
        for kind in (int, np.int64):
            assert env.step(kind(action))[-1][signal] == pytest.approx(level, rel=1e-12, abs=1e-15)


def test_the_environment_copies_its_levels():
    levels = np.array([-1.0, 1.0])
    env = make("cartpole", "voltage", levels=levels)
    levels[:] = 0.0
    assert env.step(1)[-1]["voltage"] == pytest.approx(1.0)


BAD_LEVELS = [
    None,
    (),
    (1.0,),
    (0.0, math.nan),
    (0.0, math.inf),
    (0.0, 9.0),
    ((0.0, 1.0),),
    1.0,
    "ab",
    {"a": 1},
]


@pytest.mark.parametrize("task", DISCRETE)
@every_command
@pytest.mark.parametrize("levels", BAD_LEVELS, ids=repr)
def test_the_error_for_bad_levels_proposes_valid_ones(task, command, levels):
    actuator = changed(MOTOR, arm_radius=1 / 3, max_voltage=8 / 9)
    with pytest.raises(
        ValueError, match=re.escape(f"levels = {levels!r}: {task} has discrete actions")
    ) as error_info:
        make(task, command, actuator=actuator, levels=levels)
    proposed = re.search(r"such as levels=\((.*), 0, (.*)\)$", str(error_info.value))
    make(task, command, actuator=actuator, levels=(float(proposed[1]), 0.0, float(proposed[2])))
    assert float(proposed[2]) == pytest.approx(
        TASKS[task].max_force / 3 / 0.8 if command == "current" else 8 / 9
    )


def test_a_level_may_reach_the_limit_but_not_exceed_it():
    for command in ("current", "voltage"):
        limit = COMMAND_LIMITS["cartpole"][command]
        make("cartpole", command, levels=(-limit, limit))
        with pytest.raises(ValueError, match="levels"):
            make("cartpole", command, levels=(-limit, np.nextafter(limit, np.inf)))


FLOATS = [np.array([0.25], kind) for kind in (np.float64, np.float16, np.float32, np.longdouble)]
INTEGERS = [1, np.int64(1), np.int32(1), np.uint8(1), np.array(1), True]


@every_task
@pytest.mark.parametrize("command", ["force", "current", "voltage"])
def test_the_number_type_of_an_action_does_not_matter(task, command):
    runs = []
    for action in INTEGERS if task in DISCRETE else FLOATS:
        runs.append(plain(make(task, command).step(action)))
        assert_same(runs[-1], runs[0])


# -- observing ------------------------------------------------------------------------------------


@every_task
@every_physics
@pytest.mark.parametrize("command", ["force", "current", "voltage"])
def test_observed_currents_equal_those_in_the_info_and_are_0_after_a_reset(task, command, physics):
    env, unobserving = (
        make(task, command, physics=physics, observe_actuator=observes)
        for observes in (True, False)
    )
    space, task_space = env.observation_space, TASKS[task].observation_space
    size = task_space.shape[0]
    assert space.shape == (size + 2,)
    assert space.dtype == np.float32
    np.testing.assert_array_equal(space.low, [*task_space.low, -np.inf, -np.inf])
    np.testing.assert_array_equal(space.high, [*task_space.high, np.inf, np.inf])
    assert env.setup.observation_names == (
        *TASKS[task].observation_names,
        "current",
        "reference_current",
    )
    for seed in range(2):
        observation, _ = env.reset(seed=seed)
        np.testing.assert_array_equal(observation[:size], unobserving.reset(seed=seed)[0])
        np.testing.assert_array_equal(observation[size:], [0.0, 0.0])
        largest = 0.0
        for action in sampled(env, 10):
            outcome, expected = env.step(action), unobserving.step(action)
            np.testing.assert_array_equal(outcome[0][:size], expected[0])
            np.testing.assert_array_equal(
                outcome[0][size:],
                np.float32([outcome[-1]["current"], outcome[-1]["reference_current"]]),
            )
            assert outcome[1:] == expected[1:]
            assert outcome[0].dtype == np.float32
            assert outcome[0] in space
            largest = max(largest, abs(outcome[-1]["current"]))
        assert largest > 0.01
