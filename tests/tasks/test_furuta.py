"""Furuta: mechanics against Lagrange's equations by computer algebra, motor, and environments."""

import functools
import math

import gymnasium
import mujoco
import numpy as np
import pytest
import sympy

from codrl_mj import make_sb3_vec_env
from codrl_mj.actuators import IDEAL, NAMED, Drive
from codrl_mj.catalogue import motor_entry
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import run_episodes, summarize
from codrl_mj.physics import MujocoPhysics, SimulationConfig
from codrl_mj.sizing.scripted import Scripted, observe_state
from codrl_mj.tasks import TASKS, resolve_actuators
from codrl_mj.tasks.furuta import MAX_TORQUE, ReferenceEnv
from tests.envs.vectors import batched
from tests.matrix import matrix_params

TASK = TASKS["furuta"]
ROTOR = 4e-6
# The manual's numbers; the damping is that of quanser_robots.
NUMBERS = {
    "arm_mass": 0.095,
    "arm_length": 0.085,
    "rod_mass": 0.024,
    "rod_length": 0.129,
    "radius": 0.00475,
    "hub": 0.6e-6,
    "c": 5e-6,
    "d": 1e-6,
    "gravity": 9.81,
}
every_actuator = pytest.mark.parametrize("actuator", ["default", "ideal"])


@functools.cache
def lagrange():
    """Return the accelerations of arm and rod, from positions and rotations of their parts only.

    The rod is integrated over its length: without the theorem of parallel axes, and with no moment
    of inertia other than that of its axis.
    """
    theta, alpha, w, v, a1, a2, torque, s = sympy.symbols("theta alpha w v a1 a2 torque s")
    arm_mass, arm, mass, rod, r, hub, c, d, g = symbols = sympy.symbols(list(NUMBERS))
    angles, speeds, accelerations = (
        sympy.Matrix([theta, alpha]),
        sympy.Matrix([w, v]),
        sympy.Matrix([a1, a2]),
    )
    outwards = sympy.Matrix([sympy.cos(theta), sympy.sin(theta), 0])
    across = sympy.Matrix([-sympy.sin(theta), sympy.cos(theta), 0])
    up = sympy.Matrix([0, 0, 1])
    along = sympy.cos(alpha) * up - sympy.sin(alpha) * across  # the rod, from its hinge
    turning = w * up + v * outwards

    def kinetic(point, density, length):
        moving = point.jacobian(angles) * speeds
        return sympy.integrate(sympy.expand(density * moving.dot(moving) / 2), (s, 0, length))

    energy = kinetic(s * outwards, arm_mass / arm, arm) + kinetic(
        arm * outwards + s * along, mass / rod, rod
    )
    energy += hub * w**2 / 2 + mass * r**2 / 2 * turning.dot(along) ** 2 / 2
    lagrangian = energy - mass * g * rod / 2 * sympy.cos(alpha)
    momenta = sympy.Matrix([lagrangian.diff(speed) for speed in speeds])
    rates = momenta.jacobian(angles) * speeds + momenta.jacobian(speeds) * accelerations
    forces = sympy.Matrix([torque - c * w, -d * v])
    equations = rates - sympy.Matrix([lagrangian.diff(angle) for angle in angles]) - forces
    matrix, rest = sympy.linear_eq_to_matrix(list(equations), [a1, a2])
    return sympy.lambdify([theta, alpha, w, v, torque, *symbols], [matrix, rest], "numpy")


def accelerations(state, torque, **changed):
    matrix, rest = lagrange()(*state, torque, *(NUMBERS | changed).values())
    return np.linalg.solve(np.array(matrix, float), np.array(rest, float)[:, 0])


def states(count, seed=0):
    return np.random.default_rng(seed).uniform([-3, -7, -30, -40], [3, 7, 30, 40], (count, 4))


def max_error(actual, expected):
    return (np.abs(actual - expected) / np.maximum(1.0, np.abs(expected))).max()


# -- the mechanics ---------------------------------------------------------------------------------


@every_actuator
def test_the_engines_accelerations_equal_lagranges(actuator):
    physics = MujocoPhysics(SimulationConfig(TASK, resolve_actuators(actuator, TASK), 10, "rk4"))
    model, data = physics.model, mujoco.MjData(physics.model)
    hub = NUMBERS["hub"] + (ROTOR if actuator == "default" else 0.0)
    generator = np.random.default_rng(1)
    for state, torque in zip(
        states(300), generator.uniform(-MAX_TORQUE, MAX_TORQUE, 300), strict=True
    ):
        data.qpos[:], data.qvel[:] = state[:2], state[2:]
        data.qfrc_applied[0] = torque
        mujoco.mj_forward(model, data)
        assert max_error(data.qacc, accelerations(state, torque, hub=hub)) < 1e-11


def test_the_closed_form_equals_lagranges_equations():
    twin = ReferenceEnv()
    for state in states(300, seed=2):
        assert max_error(twin.derivative(state, 0.05)[2:], accelerations(state, 0.05)) < 1e-11


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rod_length", 0.2),
        ("rod_mass", 0.05),
        ("arm_length", 0.17),
        ("arm_mass", 0.2),
        ("gravity", 1.62),
    ],
)
def test_accelerations_with_a_changed_number_equal_lagranges(name, value):
    env = gymnasium.make(TASK.env_id, actuator="ideal").unwrapped
    assert getattr(env, name) == pytest.approx(NUMBERS[name])
    setattr(env, name, value)
    for state in states(20, seed=3):
        env.data.qpos[:], env.data.qvel[:] = state[:2], state[2:]
        mujoco.mj_forward(env.model, env.data)
        assert max_error(env.data.qacc, accelerations(state, 0.0, **{name: value})) < 1e-10


def test_energy_is_conserved_without_damping():
    """As `docs/environments/furuta.md` states: 1e-7 of the rod's lift, 1 % with one inner step."""
    physics = {
        count: MujocoPhysics(SimulationConfig(TASK, [IDEAL], count, "rk4")) for count in (10, 1)
    }
    lost = {}
    for count, each in physics.items():
        each.model.dof_damping[:] = 0.0
        each.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
        each.reset(np.array([0.0, 0.14, 5.0, 0.0]))
        energies = []
        for _ in range(TASK.max_episode_steps):
            each.step(0.0)
            mujoco.mj_forward(each.model, each.data)
            energies.append(each.data.energy.sum())
        lost[count] = np.ptp(energies) / (
            NUMBERS["rod_mass"] * NUMBERS["gravity"] * NUMBERS["rod_length"]
        )
    assert lost[10] < 2e-7
    assert 1e-3 < lost[1] < 2e-2


# -- its motor -------------------------------------------------------------------------------------


def test_the_default_actuator_is_the_motor_of_the_catalog():
    motor = Drive.from_motor_parameters(motor_entry("quanser-qube-servo-2").parameters)
    assert (motor.supply.voltage, motor.controller.max_current) == (18.0, 2.0)
    assert motor.motor.torque_constant * motor.controller.max_current == pytest.approx(MAX_TORQUE)
    assert EnvConfig("furuta").actuator == motor
    assert gymnasium.make(TASK.env_id).unwrapped.actuator == motor
    assert batched("furuta", 2).unwrapped.setup.config.actuator == motor
    assert make_sb3_vec_env(TASK.env_id, 2).env.setup.config.actuator == motor
    weaker = EnvConfig("furuta", {"name": "default", "supply": {"voltage": 10.0}}).actuator
    assert (weaker.supply.voltage, weaker.motor) == (10.0, motor.motor)
    assert EnvConfig("pendulum").actuator == EnvConfig("pendulum", "paper").actuator


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *(
            (
                {"actuator": name},
                f"'{name}': is a variation of the paper's actuator, but furuta has no such actuator",
            )
            for name in NAMED
            if name != "ideal"
        ),
        (
            {"physics": "analytic"},
            r"the Drive's armature = 4e-06: the equations have no term for it",
        ),
    ],
)
def test_unsupported_arguments_raise(arguments, message):
    with pytest.raises(ValueError, match=message):
        gymnasium.make(TASK.env_id, **arguments)


@pytest.mark.parametrize(
    ("command", "unit"),
    matrix_params([("force", 1.0)], [("force", 1.0), ("current", 0.042), ("voltage", 0.042 / 8.4)]),
)
def test_a_command_is_delivered_through_the_winding(command, unit):
    """The arm is practically locked, so a voltage's current is u/R after a few L/R = 0.14 ms."""
    env = gymnasium.make(TASK.env_id, action=command, joint={"armature": 1e3})
    env.reset(seed=0, options={"low": 0.0, "high": 1e-12})
    action = 0.5 * env.action_space.high
    info = env.step(action)[4]
    assert info["actual_force"] == pytest.approx(float(action[0]) * unit, rel=1e-6)


def test_a_delayed_command_arrives_late():
    """Within a step the motor turns so little that its back-EMF is below a tenth of a volt."""
    env = gymnasium.make(TASK.env_id, action="voltage", disturbances={"command_delay": 0.02})
    env.reset(seed=0)
    forces = [env.step(np.ones(1, np.float32))[4]["actual_force"] for _ in range(2)]
    assert forces == pytest.approx([0.0, 0.042 / 8.4], rel=0.1, abs=1e-4)


# -- the task --------------------------------------------------------------------------------------


def test_reward_goal_and_end():
    upright, hanging = (0.0, 0.0, 0.0, 0.0), (0.0, math.pi, 0.0, 0.0)
    options = TASK.options()
    assert TASK.reward(hanging, 0.0, upright, options) == 1.0
    assert TASK.reward(upright, 0.0, hanging, options) == 0.0
    assert TASK.reward(upright, MAX_TORQUE, (2.0, 0.0, 0.0, 0.0), options) == pytest.approx(0.4)
    assert [
        bool(TASK.goal((0.0, angle, 0.0, 0.0))) for angle in (0.099, 2 * math.pi - 0.099, 0.101)
    ] == [1, 1, 0]
    assert [
        bool(TASK.terminated((angle, 0.0, 0.0, 0.0))) for angle in (2.0, -2.0, 2.001, -2.001)
    ] == [0, 0, 1, 1]


def test_episodes_start_hanging_within_the_reset_options():
    env = gymnasium.make(TASK.env_id)
    for options, bound in ((None, 0.05), ({"low": -0.5, "high": 0.5}, 0.5)):
        starts = []
        for seed in range(20):
            env.reset(seed=seed, options=options)
            starts.append(env.unwrapped.state - [0.0, math.pi, 0.0, 0.0])
        assert 0.8 * bound < np.abs(starts).max() <= bound


@every_actuator
def test_the_scripted_controller_swings_up_and_balances(actuator):
    episodes = run_episodes(
        Scripted(TASK), lambda: observe_state(EnvConfig("furuta", actuator).build()), 10, seed=0
    )
    assert summarize("furuta", episodes).success.mean == 1.0


def test_the_picture_follows_the_rod():
    """The orange rod is below the arm's end while it hangs, and above it when it is upright."""
    env = gymnasium.make(TASK.env_id, render_mode="rgb_array", width=160, height=160)
    env.reset(seed=0)
    heights = []
    for angle in (math.pi, 0.0):
        env.unwrapped.state = np.array([0.0, angle, 0.0, 0.0])
        red, _, blue = np.moveaxis(env.render().astype(int), -1, 0)
        rows, _ = np.nonzero(red - blue > 100)
        assert len(rows) > 100
        heights.append(rows.mean())
    assert heights[1] < 80 < heights[0]
    assert heights[0] - heights[1] > 30
