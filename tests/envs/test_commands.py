"""Commanding the current or the voltage instead of the force, and observing the actuator."""

import copy
import math
import pickle
import re
import warnings

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3

from codrl_mj.actuators import Actuator, CurrentLoop, Motor, Supply
from codrl_mj.envs import ActuatedEnv
from codrl_mj.own_code import asset_path
from codrl_mj.physics import PHYSICS
from codrl_mj.tasks import TASKS
from tests.engine.models import FULL, changed
from tests.tasks.faces import every_rebuilt

DISCRETE = ("cartpole", "acrobot", "mountain_car")
CONTINUOUS = ("pendulum", "mountain_car_continuous")
SPEED = {"pendulum": 1, "cartpole": 1, "acrobot": 3, "mountain_car": 1, "mountain_car_continuous": 1}
COMMANDS = ("current", "voltage")
MOTOR = changed(FULL, inductance=0.2, substeps=3)
"""A motor whose every constant differs from 1, slow enough for the longest step, 0.05 s."""
LIMIT = {task: {"current": TASKS[task].max_force * 0.5 / 0.8, "voltage": 4.0} for task in TASKS}
"""Largest command by task and kind, for `MOTOR`: arm 0.5, kT 0.8 N m/A, 4 V."""

every_task = pytest.mark.parametrize("task", TASKS)
every_command = pytest.mark.parametrize("command", COMMANDS)
every_physics = pytest.mark.parametrize("physics", PHYSICS)


def make(task, command="force", **options):
    """The environment as a user makes it; discrete tasks get four uneven levels."""
    if command != "force" and task in DISCRETE:
        limit = LIMIT[task][command]
        options.setdefault("levels", (-limit, -limit / 3, limit / 7, limit))
    options.setdefault("actuator", MOTOR)
    return gymnasium.make(TASKS[task].env_id, disable_env_checker=True, action=command, **options)


def commanded(env, action):
    """The current or voltage that an action stands for."""
    levels = env.unwrapped.setup.config.levels
    return float(action[0]) if levels is None else float(levels[action])


def sampled(env, steps, seed=0):
    """Random actions, each held for two steps."""
    space = copy.deepcopy(env.action_space)
    space.seed(seed)
    return [action for _ in range(steps // 2) for action in [space.sample()] * 2]


def rows(env, actions):
    """Everything that the steps return, flattened; ends do not interrupt."""
    found = []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        found.append(np.concatenate([observation, [reward, terminated, truncated], list(map(float, info.values()))]))
    return np.array(found)


# -- the current --------------------------------------------------------------------------------------------


@every_task
@every_physics
def test_a_current_is_the_force_that_it_makes(task, physics):
    env, by_force = make(task, "current", physics=physics).unwrapped, make(task, physics=physics).unwrapped
    env.reset(seed=0)
    by_force.reset(seed=0)
    for action in sampled(env, 60):
        force = 0.8 * commanded(env, action) / 0.5
        if task in CONTINUOUS:
            info, expected = env.step(action)[-1], by_force.step(np.array([force]))[-1]
        else:  # its own actions do not reach every force
            by_force.physics.step(force)
            expected = by_force.setup.signals(by_force.physics.trace[-1][0].tolist(), force)
            info = env.step(action)[-1]
        assert info["desired_force"] == pytest.approx(force, rel=1e-12)
        assert info["reference_current"] == pytest.approx(commanded(env, action), rel=1e-12)
        np.testing.assert_allclose(list(info.values()), list(expected.values()), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(env.state, by_force.state, rtol=0, atol=1e-12)


@pytest.mark.parametrize("task", CONTINUOUS)
def test_the_current_space_ends_at_the_current_of_the_largest_force(task):
    space = make(task, "current").action_space
    np.testing.assert_array_equal(space.high, np.float32([TASKS[task].max_force * 0.5 / 0.8]))
    np.testing.assert_array_equal(space.low, -space.high)
    assert space.shape == (1,)


@every_physics
@pytest.mark.parametrize("command", COMMANDS)
def test_the_end_of_the_space_asks_for_no_more_than_the_limit(physics, command):
    """In float32 the limits 0.6 A and 0.7 V are a little more than they are."""
    actuator = Actuator(Motor(arm_radius=0.3), CurrentLoop(max_voltage=0.7))
    env = make("pendulum", command, physics=physics, actuator=actuator)
    env.reset(seed=0)
    info = env.step(env.action_space.high)[-1]
    assert info["voltage"] <= 0.7
    if command == "current":
        assert info["desired_force"] <= 2.0


# -- the voltage --------------------------------------------------------------------------------------------


def winding(motor, dt, substeps, max_voltage, current, voltage, speed):
    """The current under a terminal voltage, the shaft's speed held: L di/dt = u - kE*omega - R*i, by Euler."""
    u = min(max(voltage, -max_voltage), max_voltage)
    for _ in range(substeps):
        emf = motor.back_emf_constant * speed / motor.arm_radius
        current += (u - emf - motor.resistance * current) / motor.inductance * (dt / substeps)
    return current


@every_rebuilt
@every_physics
def test_a_voltage_drives_the_winding_and_that_the_task(task, physics):
    """One environment step at a time from the state reached: winding and unmodified Gymnasium, by hand."""
    env, driver = make(task, "voltage", physics=physics).unwrapped, TASKS[task].twin()
    env.reset(seed=0)
    motor, loop = MOTOR.motor, MOTOR.controller
    inner, current = env.task.motor_inner_steps, 0.0
    dt = env.task.step_duration / inner
    moved = 0.0
    for action in sampled(env, 100):
        state, voltage = env.state, commanded(env, action)
        start = state.copy()
        for _ in range(inner):
            current = winding(motor, dt, loop.substeps, loop.max_voltage, current, voltage, state[SPEED[task]])
            force = motor.torque_constant * current / motor.arm_radius
            state = np.array(driver(state, force, dt, env.setup.plant.integrator))
        info = env.step(action)[-1]
        np.testing.assert_allclose(env.state, state, rtol=0, atol=1e-12)
        assert info["current"] == pytest.approx(current, rel=0, abs=1e-12)
        assert info["actual_force"] == pytest.approx(force, rel=0, abs=1e-12)
        assert info["voltage"] == pytest.approx(voltage, rel=0, abs=1e-12)
        moved, current = max(moved, np.abs(state - start).max()), info["current"]
    assert moved > 1e-3


@pytest.mark.parametrize("inner_steps", [1, 4])
def test_a_whole_episode_of_pendulum_under_voltages(inner_steps):
    """Nothing of ours in the oracle: Gymnasium's own step under float64 torques, from start to end."""
    env = make("pendulum", "voltage", inner_steps=inner_steps)
    env.reset(seed=3)
    reference = gymnasium.make("Pendulum-v1").unwrapped
    reference.reset(seed=3)
    reference.max_torque, reference.dt = np.inf, 0.05 / inner_steps
    current, dt = 0.0, 0.05 / inner_steps
    for voltage in np.repeat(np.random.default_rng(0).uniform(-4, 4, 40), 5):
        for _ in range(inner_steps):
            current = winding(MOTOR.motor, dt, 3, 4.0, current, voltage, reference.state[1])
            reference.step(np.array([0.8 * current / 0.5]))
        env.step(np.array([voltage]))
        np.testing.assert_allclose(env.unwrapped.state, reference.state, rtol=0, atol=1e-9)


@every_rebuilt
@every_physics
def test_without_back_emf_the_current_is_that_of_a_locked_winding(task, physics):
    """I = V/R (1 - (1 - R dt/L)^n) after n electrical steps, whatever the load does."""
    env = make(task, "voltage", physics=physics, actuator=changed(MOTOR, back_emf_constant=0.0)).unwrapped
    env.reset(seed=0)
    inner = env.task.motor_inner_steps
    decay = 1.0 - 1.2 * env.task.step_duration / inner / 3 / 0.2
    action = env.action_space.n - 1 if task in DISCRETE else np.array([3.7])
    voltage = 4.0 if task in DISCRETE else 3.7
    for step in range(1, 20):
        info = env.step(action)[-1]
        assert info["current"] == pytest.approx(voltage / 1.2 * (1 - decay ** (3 * inner * step)), rel=1e-12)


def test_pendulum_under_voltages_is_mujocos_dcmotor():
    """Its winding is exact over a step, ours Euler's: the same map with L replaced by R*dt/(1 - exp(-R*dt/L))."""
    r, inductance, k, arm, dt = 2.0, 0.1, 0.5, 0.4, 0.05
    spec = mujoco.MjSpec.from_file(str(asset_path("pendulum.xml")))
    spec.option.timestep = dt
    joint = spec.actuator("motor").target
    spec.delete(spec.actuator("motor"))
    driver = spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint, gear=[1 / arm, 0, 0, 0, 0, 0])
    driver.set_to_dcmotor(
        motorconst=[k, k], resistance=r, inductance=[inductance, 0.0], ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE)
    )
    native = spec.compile()
    data = mujoco.MjData(native)
    assert native.na == 1
    equivalent = r * dt / (1.0 - math.exp(-r * dt / inductance))
    motor = Motor(resistance=r, inductance=equivalent, torque_constant=k, back_emf_constant=k, arm_radius=arm)
    env = make("pendulum", "voltage", actuator=Actuator(motor, CurrentLoop(max_voltage=5.0)))
    env.reset(seed=0)
    env.unwrapped.physics.reset(np.array([2.5, 0.0]))
    data.qpos[:] = 2.5
    for voltage in np.repeat(np.random.default_rng(0).uniform(-5, 5, 20), 5):
        data.ctrl[:] = voltage
        mujoco.mj_step(native, data)
        info = env.step(np.array([voltage]))[-1]
        assert abs(data.qvel[0]) < 8.0  # the task's speed limit, which the native model has not
        np.testing.assert_allclose(env.unwrapped.state, [data.qpos[0], data.qvel[0]], rtol=0, atol=1e-11)
        assert info["current"] == pytest.approx(data.act[0], rel=0, abs=1e-11)
    assert np.abs(data.act[0]) > 0.1


@every_task
@every_physics
def test_under_voltages_the_controller_has_no_say(task, physics):
    gains = {"kp": 0.3, "ki": 7.0, "kd": 0.01, "kff": 3.0, "integral_leak": 0.0, "derivative_time_constant": 0.2}
    other = changed(MOTOR, **gains, bemf_compensation=False)
    one, two = make(task, "voltage", physics=physics), make(task, "voltage", physics=physics, actuator=other)
    actions = sampled(one, 30)
    np.testing.assert_array_equal(one.reset(seed=0)[0], two.reset(seed=0)[0])
    np.testing.assert_array_equal(rows(one, actions), rows(two, actions))


@pytest.mark.parametrize("field", ["max_voltage", "substeps"])
def test_under_voltages_supply_and_substeps_still_count(field):
    value = {"max_voltage": 3.0, "substeps": 1}[field]
    pair = [make("pendulum", "voltage", actuator=actuator) for actuator in (MOTOR, changed(MOTOR, **{field: value}))]
    states = []
    for env in pair:
        env.reset(seed=0)
        for _ in range(10):
            env.step(np.array([4.0]))
        states.append(env.unwrapped.state)
    assert np.abs(states[0] - states[1]).max() > 1e-3


def test_a_loop_that_would_be_unstable_does_not_hinder_voltages_and_an_unstable_winding_does():
    wild = changed(MOTOR, kp=1000.0)
    with pytest.raises(ValueError, match="unstable"):
        make("pendulum", actuator=wild)
    make("pendulum", "voltage", actuator=wild).reset(seed=0)
    with pytest.raises(ValueError, match=r"unstable at a step of 0\.05 s"):  # |1 - R dt/L| = 2
        make("pendulum", "voltage", actuator=Actuator(Motor(resistance=6.0)))


@every_task
@every_physics
def test_what_a_voltage_delivers_is_what_is_desired(task, physics):
    env = make(task, "voltage", physics=physics)
    env.reset(seed=0)
    for action in sampled(env, 20):
        info = env.step(action)[-1]
        assert info["desired_force"] == info["actual_force"] == pytest.approx(0.8 * info["current"] / 0.5, rel=1e-12)
        assert info["reference_current"] == info["current"]
        assert info["voltage"] == pytest.approx(commanded(env, action), rel=1e-12)


@pytest.mark.parametrize("task", CONTINUOUS)
@every_physics
def test_voltages_beyond_the_supply_saturate(task, physics):
    beyond, at = (make(task, "voltage", physics=physics) for _ in range(2))
    np.testing.assert_array_equal(beyond.action_space.high, np.float32([4.0]))
    beyond.reset(seed=0)
    at.reset(seed=0)
    for voltage in (100.0, -np.inf, np.inf, 4.0):
        for _ in range(5):
            found, expected = beyond.step(np.array([voltage])), at.step(np.array([np.clip(voltage, -4.0, 4.0)]))
            np.testing.assert_array_equal(found[0], expected[0])
            assert found[-1] == expected[-1]
            assert found[-1]["voltage"] == pytest.approx(np.sign(voltage) * 4.0, rel=1e-15)


# -- levels -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", DISCRETE)
@every_command
@every_physics
def test_each_action_commands_its_level(task, command, physics):
    limit = LIMIT[task][command]
    levels = [limit, -0.4 * limit, 0.0, 0.1 * limit, -limit]
    env = make(task, command, physics=physics, levels=levels)
    assert env.action_space == gymnasium.spaces.Discrete(5)
    signal = {"current": "reference_current", "voltage": "voltage"}[command]
    for action, level in enumerate(levels):
        env.reset(seed=0)
        for kind in (int, np.int64):
            assert env.step(kind(action))[-1][signal] == pytest.approx(level, rel=1e-12, abs=1e-15)


def test_the_table_is_the_environments_own():
    levels = np.array([-1.0, 1.0])
    env = make("cartpole", "voltage", levels=levels)
    levels[:] = 0.0
    env.reset(seed=0)
    assert env.step(1)[-1]["voltage"] == pytest.approx(1.0)


BAD_LEVELS = [None, (), (1.0,), (0.0, math.nan), (0.0, math.inf), (0.0, 9.0), ((0.0, 1.0),), 1.0, "ab", {"a": 1}]


@pytest.mark.parametrize("task", DISCRETE)
@every_command
@pytest.mark.parametrize("levels", BAD_LEVELS, ids=repr)
def test_a_bad_table_is_refused_with_one_that_works(task, command, levels):
    actuator = changed(MOTOR, arm_radius=1 / 3, max_voltage=8 / 9)
    with pytest.raises(ValueError, match=re.escape(f"levels = {levels!r}: {task} has discrete actions")) as refused:
        make(task, command, actuator=actuator, levels=levels)
    found = re.search(r"such as levels=\((.*), 0, (.*)\)$", str(refused.value))
    make(task, command, actuator=actuator, levels=(float(found[1]), 0.0, float(found[2])))
    assert float(found[2]) == pytest.approx(TASKS[task].max_force / 3 / 0.8 if command == "current" else 8 / 9)


def test_a_level_may_be_at_the_limit_and_no_further():
    for command in COMMANDS:
        limit = LIMIT["cartpole"][command]
        make("cartpole", command, levels=(-limit, limit))
        with pytest.raises(ValueError, match="levels"):
            make("cartpole", command, levels=(-limit, np.nextafter(limit, np.inf)))


# -- refusals -----------------------------------------------------------------------------------------------

REFUSED = {
    "command": ({"action": "torque"}, "action = 'torque': must be one of force, current, voltage"),
    "levels for a force": ({"levels": (0.0, 1.0)}, "only for action='current' and action='voltage'"),
    "levels for a box": (
        {"action": "voltage", "levels": (0.0, 1.0)},
        "only for tasks with discrete actions; pendulum's are continuous",
    ),
    "current of the ideal": (
        {"action": "current", "actuator": "ideal"},
        "the ideal actuator has no current to command",
    ),
    "voltage of none": ({"action": "voltage", "actuator": None}, "the ideal actuator has no voltage to command"),
    "observing the ideal": (
        {"observe_actuator": True, "actuator": "ideal"},
        "observe_actuator=True: the ideal actuator has no current to observe",
    ),
    "an infinite supply": (
        {"action": "voltage", "actuator": {"controller": {"max_voltage": math.inf}}},
        "action = 'voltage': needs a finite controller.max_voltage, it is inf",
    ),
}


def test_a_voltage_is_commanded_up_to_what_the_supply_has():
    for most in (24.0, math.inf):
        actuator = Actuator(controller=CurrentLoop(max_voltage=most), supply=Supply(12.0))
        assert ActuatedEnv("pendulum", actuator, action="voltage").action_space.high == 12.0


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_go_together_is_refused(case):
    options, message = REFUSED[case]
    with pytest.raises(ValueError, match=re.escape(message)):
        gymnasium.make(TASKS["pendulum"].env_id, **options)


NO_ACTION = {
    "box": [
        np.array([np.nan]),
        np.float32([np.nan]),
        np.array(0.5),
        np.zeros(2),
        np.zeros((1, 1)),
        np.array([1]),
        np.array([True]),
        np.array(["1"]),
        0.5,
        1,
        None,
    ],
    "table": [-1, 4, 0.5, 1.0, None, "0", np.array([0]), np.array([0.0]), np.nan],
}


@every_task
@every_command
def test_what_is_no_action_is_refused_and_changes_nothing(task, command):
    env = make(task, command).unwrapped
    env.reset(seed=0)
    state = env.state
    for action in NO_ACTION["table" if task in DISCRETE else "box"]:
        with pytest.raises(ValueError, match=r"^action = .*: not in (Box|Discrete)"):
            env.step(action)
        np.testing.assert_array_equal(env.state, state)
        assert env.data.time == 0.0


@pytest.mark.parametrize("task", CONTINUOUS)
@every_command
def test_every_floating_point_type_is_the_same_action(task, command):
    states = []
    for kind in (np.float16, np.float32, np.float64, np.longdouble):
        env = make(task, command)
        env.reset(seed=0)
        env.step(np.array([0.25], dtype=kind))
        states.append(env.unwrapped.state)
    np.testing.assert_array_equal(states[1:], states[:-1])


# -- observing ----------------------------------------------------------------------------------------------


@every_task
@every_physics
@pytest.mark.parametrize("command", ["force", *COMMANDS])
def test_observed_currents_are_those_of_the_info_and_zero_at_the_start(task, command, physics):
    env, blind = make(task, command, physics=physics, observe_actuator=True), make(task, command, physics=physics)
    space, plain = env.observation_space, TASKS[task].observation_space
    size = plain.shape[0]
    assert space.shape == (size + 2,)
    assert space.dtype == np.float32
    np.testing.assert_array_equal(space.low, [*plain.low, -np.inf, -np.inf])
    np.testing.assert_array_equal(space.high, [*plain.high, np.inf, np.inf])
    assert env.unwrapped.setup.observation_names == (
        *TASKS[task].observation_names,
        "current",
        "reference_current",
    )
    for seed in range(2):
        observation, _ = env.reset(seed=seed)
        np.testing.assert_array_equal(observation[:size], blind.reset(seed=seed)[0])
        np.testing.assert_array_equal(observation[size:], [0.0, 0.0])
        largest = 0.0
        for action in sampled(env, 10):
            found, expected = env.step(action), blind.step(action)
            np.testing.assert_array_equal(found[0][:size], expected[0])
            np.testing.assert_array_equal(
                found[0][size:], np.float32([found[-1]["current"], found[-1]["reference_current"]])
            )
            assert found[1:] == expected[1:]
            assert found[0].dtype == np.float32
            assert found[0] in space
            largest = max(largest, abs(found[-1]["current"]))
        assert largest > 0.01


# -- every combination --------------------------------------------------------------------------------------

FACES = [
    (command, observe) for command in ("force", *COMMANDS) for observe in (False, True) if observe or command != "force"
]
every_face = pytest.mark.parametrize(("command", "observe"), FACES)


class Blank(gymnasium.Env):
    """An environment with given spaces in which nothing happens: what a checker says of it, it says of its spaces."""

    def __init__(self, action_space, observation_space):  # noqa: D107
        self.action_space, self.observation_space = action_space, observation_space

    def _observation(self):
        return np.clip(np.zeros(self.observation_space.shape, np.float32), *self._bounds())

    def _bounds(self):
        return self.observation_space.low, self.observation_space.high

    def reset(self, *, seed=None, options=None):  # noqa: ARG002
        super().reset(seed=seed)
        return self._observation(), {}

    def step(self, action):  # noqa: ARG002
        return self._observation(), 0.0, False, False, {}


def _complaints(check, env):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check(env, skip_render_check=True)
    return {str(warning.message) for warning in caught}


@every_task
@every_physics
@every_face
@pytest.mark.parametrize("check", [check_env, check_env_sb3], ids=["gymnasium", "stable_baselines3"])
def test_the_checkers_complain_about_nothing_but_the_spaces(check, task, command, observe, physics):
    env = make(task, command, observe_actuator=observe, physics=physics).unwrapped
    assert _complaints(check, env) <= _complaints(check, Blank(env.action_space, env.observation_space))


@every_task
@every_face
def test_every_observation_of_thirty_episodes_is_in_the_space(task, command, observe):
    env = make(task, command, observe_actuator=observe, max_episode_steps=12)
    space = env.observation_space
    env.action_space.seed(0)
    for seed in range(30):
        observation, _ = env.reset(seed=seed)
        over = False
        while not over:
            assert observation in space
            observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
            over = terminated or truncated
        assert observation in space


@every_task
@every_face
@every_physics
def test_a_copy_made_mid_episode_continues_bit_for_bit(task, command, observe, physics):
    env = make(task, command, observe_actuator=observe, physics=physics)
    env.reset(seed=1)
    actions = sampled(env, 24)
    rows(env, actions[:11])
    twins = copy.deepcopy(env), pickle.loads(pickle.dumps(env))
    expected = rows(env, actions[11:])
    for twin in twins:
        np.testing.assert_array_equal(rows(twin, actions[11:]), expected)
        if physics == "mujoco":  # one model, the copy's own: changing it changes the copy
            model = twin.unwrapped.model
            assert model is twin.unwrapped.data.model
            assert model is not env.unwrapped.model


def test_the_default_command_is_the_force():
    for task in TASKS:
        env = gymnasium.make(TASKS[task].env_id)
        assert env.action_space == TASKS[task].action_space
        assert env.observation_space == TASKS[task].observation_space
        assert env.unwrapped.setup.config.action == "force"
