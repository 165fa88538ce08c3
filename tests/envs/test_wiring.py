"""Every parameter of the actuator affects the task: pairs with and without it, against an oracle.

The oracle is the reference motor (`tests.reference`) and Gymnasium's own step: if a connection is
missing in the environment, one side of its pair differs from the oracle, and both sides are equal.
"""

import functools

import numpy as np
import pytest

from codrl_mj.envs import ActuatedEnv
from codrl_mj.physics import PHYSICS
from codrl_mj.tasks import TASKS
from tests.conformance.environments import commanded
from tests.engine.models import FULL, changed
from tests.reference import MotorSimulation
from tests.tasks.faces import REBUILT, actions, desired_force, every_rebuilt

SPEED = {
    "pendulum": 1,
    "cartpole": 1,
    "acrobot": 3,
    "mountain_car": 1,
    "mountain_car_continuous": 1,
}
STEPS = {
    "pendulum": 60,
    "cartpole": 40,
    "acrobot": 15,
    "mountain_car": 30,
    "mountain_car_continuous": 30,
}
SUPPLY = {
    "pendulum": 4.0,
    "cartpole": 10.0,
    "acrobot": 2.0,
    "mountain_car": 0.6,
    "mountain_car_continuous": 0.6,
}
"""Supply voltage [V] at which each task saturates sometimes."""

TRACE = (
    "desired_force",
    "actual_force",
    "current",
    "reference_current",
    "voltage",
    "saturated",
    "speed",
)

# Parameter -> changes that remove it, and changes that both sides of the pair have.
OFF = {
    "back_emf_constant": ({"back_emf_constant": 0.0}, {"bemf_compensation": False}),
    "bemf_compensation": ({"bemf_compensation": False}, {"back_emf_constant": 2.0}),
    "max_voltage": ({"max_voltage": np.inf}, {}),
    "kp": ({"kp": 0.0}, {}),
    "ki": ({"ki": 0.0}, {}),
    "kd": ({"kd": 0.0}, {"kd": 0.02}),
    "kff": ({"kff": 0.0}, {}),
    "integral_leak": ({"integral_leak": 0.0}, {"integral_leak": 5.0}),
    "derivative_time_constant": (
        {"derivative_time_constant": 0.0},
        {"kd": 0.03, "derivative_time_constant": 0.05},
    ),
    "substeps": ({"substeps": 1}, {}),
    "arm_radius": ({"arm_radius": 1.0}, {}),
    "torque_constant": ({"torque_constant": 1.0}, {}),
    "resistance": ({"resistance": 1.0}, {}),
    "inductance": ({"inductance": 0.3}, {}),
}


@functools.cache
def _episode(task, physics, integrator, actuator):
    """Return traces of all integration steps under random actions: environment, and oracle."""
    env, driver = (
        ActuatedEnv(task, actuator, physics, integrator=integrator),
        TASKS[task].reference_env(),
    )
    env.reset(seed=0)
    env.action_space.seed(0)
    motor, state = MotorSimulation(actuator), env.state
    constants, limit = actuator.motor, actuator.controller.max_voltage
    dt = env.task.step_duration / env.task.motor_inner_steps
    rows, expected = [], []
    for _ in range(STEPS[task]):
        action = env.action_space.sample()
        env.step(action)
        desired = desired_force(task, action)
        for row in env.trace[:, 0]:
            delivered = motor.step(dt, desired, state[SPEED[task]])
            state = np.array(driver(state, delivered, dt, integrator))
            reference = desired * constants.arm_radius / constants.torque_constant
            ends = abs(motor.voltage) >= limit, state[SPEED[task]]
            expected.append([desired, delivered, motor.current, reference, motor.voltage, *ends])
            rows.append(row)
        np.testing.assert_allclose(env.state, state, rtol=0, atol=1e-10)
    assert env.trace_names == TRACE
    results, oracle = np.array(rows), np.array(expected)
    np.testing.assert_array_equal(results[:, 0], oracle[:, 0])
    np.testing.assert_allclose(
        results[:, 1] * constants.arm_radius, constants.torque_constant * results[:, 2], rtol=1e-12
    )
    return results, oracle


@pytest.mark.parametrize(
    ("task", "integrator"), [(task, name) for task in REBUILT for name in TASKS[task].integrators]
)
@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize("feature", OFF)
def test_a_parameter_has_an_effect_and_matches_the_reference_with_and_without_it(
    task, integrator, physics, feature
):
    without, common = OFF[feature]
    actuator_with = changed(FULL, **{"inductance": 0.2, "max_voltage": SUPPLY[task], **common})
    runs = []
    for actuator in (actuator_with, changed(actuator_with, **without)):
        rows, expected = _episode(task, physics, integrator, actuator)
        np.testing.assert_allclose(rows, expected, rtol=1e-9, atol=1e-9)
        runs.append(rows)
    differences = np.abs(runs[0] - runs[1])
    assert differences[:, TRACE.index("actual_force")].max() > 1e-3
    assert differences[:, TRACE.index("speed")].max() > 1e-7


@every_rebuilt
def test_the_pairs_saturate_at_times(task):
    """Check the pairs of supply and compensation, which need both kinds of steps."""
    actuator = changed(FULL, inductance=0.2, max_voltage=SUPPLY[task])
    rows = _episode(task, "mujoco", TASKS[task].integrators[0], actuator)[0]
    voltages = np.abs(rows[:, TRACE.index("voltage")])
    assert (voltages == SUPPLY[task]).any()
    assert (voltages < SUPPLY[task]).any()


@every_rebuilt
@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
def test_a_motor_s_reference_current_is_that_of_the_desired_force(task, physics):
    env = ActuatedEnv(task, physics=physics, **commanded(task, "force"))
    env.reset(seed=0)
    for action in actions(task, 0, 10):
        info = env.step(action)[-1]
        assert abs(info["desired_force"]) <= TASKS[task].max_force
        # The arm is 0.5, the torque constant 0.8.
        assert info["reference_current"] == pytest.approx(info["desired_force"] * 0.5 / 0.8)


@every_rebuilt
def test_mujoco_model_and_data_are_attributes_and_analytic_physics_raises(task):
    env = ActuatedEnv(task)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert env.data.time == pytest.approx(env.task.step_duration)
    assert env.model.opt.timestep == pytest.approx(
        env.task.step_duration / env.task.motor_inner_steps
    )
    np.testing.assert_array_equal(env.state[list(env.task.qpos)], env.data.qpos)
    np.testing.assert_array_equal(env.state[list(env.task.qvel)], env.data.qvel)
    with pytest.raises(AttributeError, match="AnalyticPhysics has no MuJoCo model or data"):
        _ = ActuatedEnv(task, physics="analytic").model
