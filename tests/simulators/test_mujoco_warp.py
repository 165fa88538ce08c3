"""Motors in mujoco_warp move robots as in our engine."""

import mujoco
import numpy as np
import pytest

from codrl_mj.actuators import DCMotorActuator
from codrl_mj.arrays.models import prepare_model
from tests.arrays.gearbox import Gearbox
from tests.arrays.models import (
    CATALOGUE_MOTOR,
    STEPS,
    cheetah,
    our_motion,
    pendulum,
    servo,
    square_waves,
    two_joints,
    with_our_motors,
)

wp = pytest.importorskip("warp", reason="NOT RUN: Warp is not installed: make simulators")
mjw = pytest.importorskip("mujoco_warp", reason="NOT RUN: no mujoco_warp: make simulators")
# The module imports Warp.
from codrl_mj.arrays.mujoco_warp import attach_motors  # noqa: E402

wp.config.quiet = True
INTEGRATORS = ("Euler", "implicitfast", "RK4")
TOLERANCE = {"Euler": 1e-5, "implicitfast": 1e-5, "RK4": 5e-5}
"""Largest difference of a joint's angle over 500 steps [rad], which turns by more than 10 rad."""
pytestmark = [
    pytest.mark.filterwarnings("ignore:the model", "ignore:compiler attribute"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


class Simulation:
    """Worlds of mujoco_warp with motors."""

    def __init__(self, spec, actuators, num_worlds=1, **options):  # noqa: D107
        self.robot = prepare_model(spec, actuators)
        compiled = self.robot.spec.compile()
        self.model = mjw.put_model(compiled)
        self.data = mjw.make_data(compiled, nworld=num_worlds)
        self.motors = None
        if actuators:
            self.motors = attach_motors(self.robot, self.model, self.data, **options)

    def move(self, commands, starts=None, before_step=None):
        """Return the positions, shape (steps, worlds, nq)."""
        if starts is not None:
            self.data.qpos.assign(starts.astype(np.float32))
        positions = []
        for step, rows in enumerate(commands):
            if before_step:
                before_step(step)
            self.data.ctrl.assign(rows.astype(np.float32))
            mjw.step(self.model, self.data)
            positions.append(self.data.qpos.numpy().copy())
        return np.array(positions)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_catalogue_motor_moves_a_pendulum_as_in_our_engine(integrator):
    spec, actuators = pendulum(integrator), {"hinge": CATALOGUE_MOTOR}
    commands = square_waves(STEPS, 2)
    ours = our_motion([with_our_motors(spec, actuators)] * 2, commands)
    gap = np.abs(Simulation(spec, actuators, 2).move(commands) - ours)
    print(integrator, "pendulum: largest gap", gap.max(), "range", np.ptp(ours))
    assert np.ptp(ours) > 10.0
    assert gap.max() < TOLERANCE[integrator]


OTHERS = {
    "torque_speed and ideal": ({"first": "torque_speed", "second": "ideal"}, None),
    "drive behind a position actuator": (
        {"first": CATALOGUE_MOTOR, "second": CATALOGUE_MOTOR},
        'position name="first" joint="a" kp="6" kv="0.3" forcerange="-3 3"',
    ),
    "servo and custom family": ({"first": servo(), "second": Gearbox()}, None),
    "current loop and lag": ({"first": "current_loop", "second": "lag"}, None),
}


def two_joint_commands(num_worlds):
    return square_waves(400, num_worlds, 2) * [0.6, 0.2]


@pytest.mark.parametrize(
    ("case", "integrator"),
    [
        *((case, "Euler") for case in OTHERS),
        # With these, the integrator uses derivatives, or computes forces several times a step.
        ("drive behind a position actuator", "implicitfast"),
        ("drive behind a position actuator", "RK4"),
        ("current loop and lag", "RK4"),
    ],
)
def test_families_move_two_joints_as_in_our_engine(case, integrator):
    actuators, first = OTHERS[case]
    spec = two_joints(integrator, first) if first else two_joints(integrator)
    commands = two_joint_commands(1)
    ours = our_motion([with_our_motors(spec, actuators)], commands)
    gap = np.abs(Simulation(spec, actuators).move(commands) - ours)
    print(integrator, case, "largest gap", gap.max(), "range", np.ptp(ours))
    assert gap.max() < 3e-4


def test_a_joints_limit_of_forces_limits_motors():
    spec, actuators = two_joints(joint='actuatorfrcrange="-1 1"'), {"first": CATALOGUE_MOTOR}
    commands = two_joint_commands(1)
    limited, free = (
        our_motion([with_our_motors(model, actuators)], commands) for model in (spec, two_joints())
    )
    gap = np.abs(Simulation(spec, actuators).move(commands) - limited)
    assert gap.max() < 3e-4 < np.abs(limited - free).max()


def cheetah_gaps(actuators, num_worlds=64, num_steps=300):
    """Return the largest gap in each world after the last step [rad, m]."""
    spec = cheetah()
    commands = 0.5 * square_waves(num_steps, num_worlds, 6)
    model = with_our_motors(spec, actuators)
    starts = np.zeros((num_worlds, model.nq))
    generator = np.random.default_rng(0)
    starts[:, 1] = 0.3
    starts[:, 3:] = generator.uniform(-0.1, 0.1, (num_worlds, 6)).astype(np.float32)
    ours = our_motion([model] * num_worlds, commands, starts)
    theirs = Simulation(spec, actuators, num_worlds).move(commands, starts)
    return np.abs(ours - theirs)[-1].max(axis=1)


def test_motors_add_no_error_to_a_cheetah():
    rear = CATALOGUE_MOTOR.replaced({"motor.gear_ratio": 4.0, "motor.gear_efficiency": 0.9})
    front = rear.replaced({"motor.gear_ratio": 2.0, "controller.delayed": True})
    with_motors, without = cheetah_gaps({"b.*": rear, "f.*": front}), cheetah_gaps({})
    print("cheetah: median and largest gap with motors", np.median(with_motors), with_motors.max())
    print("cheetah: median and largest gap without", np.median(without), without.max())
    assert np.median(with_motors) <= np.median(without)
    assert with_motors.max() <= without.max()


def test_worlds_that_are_reset_begin_at_rest():
    spec, num = two_joints(), 6
    actuators = {"first": CATALOGUE_MOTOR, "second": "lag"}
    commands = two_joint_commands(num)
    simulation = Simulation(spec, actuators, num)
    mask = np.arange(num) % 2 == 0

    def reset(step):
        if step == 200:
            mjw.reset_data(simulation.model, simulation.data, reset=wp.array(mask, dtype=bool))

    worlds = np.flatnonzero(mask)
    models = [with_our_motors(spec, actuators)] * num
    ours = our_motion(models, commands, reset_at=200, reset_worlds=worlds)
    gap = np.abs(simulation.move(commands, before_step=reset) - ours)
    assert gap.max() < 3e-4
    assert np.abs(ours - our_motion(models, commands))[:, worlds].max() > 0.1


def test_reset_clears_the_motors_of_chosen_worlds_only():
    simulation = Simulation(pendulum(), {"motor": "lag"}, 3)
    simulation.move(np.full((50, 3, 1), 2.0))
    state = simulation.motors.groups[0].state("torque")
    before = state.numpy().copy()
    simulation.motors.reset([1])
    simulation.data.ctrl.fill_(0.0)
    mjw.step(simulation.model, simulation.data)
    after = state.numpy()
    assert after[1] == 0.0
    assert (after[[0, 2]] > 0.9 * before[[0, 2]]).all()
    simulation.motors.reset(wp.array([True, False, False], dtype=wp.bool))
    mjw.step(simulation.model, simulation.data)
    assert state.numpy()[0] == 0.0 < state.numpy()[2]


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_forward_between_steps_changes_nothing(integrator):
    spec, actuators = two_joints(integrator), {"first": CATALOGUE_MOTOR, "second": "lag"}
    commands = two_joint_commands(1)[:200]
    plain, interrupted = Simulation(spec, actuators), Simulation(spec, actuators)

    def forward(step):
        if step % 7 == 0:
            interrupted.data.ctrl.fill_(1.0)
            mjw.forward(interrupted.model, interrupted.data)

    np.testing.assert_array_equal(
        plain.move(commands), interrupted.move(commands, before_step=forward)
    )


def test_each_world_has_the_drawn_parameters_of_its_own():
    spec, num = two_joints(), 5
    actuators = {"first": CATALOGUE_MOTOR, "second": "lag"}
    randomize = {
        "first:motor.resistance": "uniform(0.7, 1.3)",
        "second": {"time_constant": "loguniform(0.01, 0.1)"},
    }
    simulation = Simulation(spec, actuators, num, randomize=randomize, seed=1)
    before = simulation.motors.parameter("motor.resistance").numpy().copy()
    values = simulation.motors.draw([2, 3])
    resistance = simulation.motors.parameter("motor.resistance").numpy()[:, 0]
    constants = simulation.motors.parameter("time_constant").numpy()[:, 0]
    np.testing.assert_array_equal(resistance[[0, 1, 4]], before[[0, 1, 4], 0])
    np.testing.assert_array_equal(resistance[[2, 3]], values["first:motor.resistance"])
    assert len({*resistance}) == num
    assert (np.abs(resistance - 1.0) < 0.3).all()
    models = [
        with_our_motors(
            spec,
            {
                "first": CATALOGUE_MOTOR.replaced({"motor.resistance": float(resistance[world])}),
                "second": {"family": "lag", "time_constant": float(constants[world])},
            },
        )
        for world in range(num)
    ]
    commands = two_joint_commands(num)
    ours = our_motion(models, commands)
    gap = np.abs(simulation.move(commands) - ours)
    print("drawn parameters: largest gap", gap.max())
    assert gap.max() < 3e-4 < np.abs(ours[:, 0] - ours[:, 1]).max()


def test_signals_and_parameters_are_views():
    simulation = Simulation(
        pendulum(), {"motor": CATALOGUE_MOTOR}, 2, varying=("motor.resistance",), per_world=True
    )
    current = simulation.motors.signal("current")
    simulation.move(np.full((3, 2, 1), 2.0))
    first = current.numpy().copy()
    simulation.motors.parameter("motor.resistance").fill_(20.0)
    simulation.move(np.full((3, 2, 1), 2.0))
    assert (np.abs(first) > 0.0).all()
    assert (current.numpy() < first).all()
    with pytest.raises(
        ValueError, match=r"motor.inductance: is a constant of the kernel: name it in"
    ):
        simulation.motors.parameter("motor.inductance")


def test_the_noise_of_a_sensor_differs_between_worlds():
    noisy = DCMotorActuator().replaced({"controller.current_noise": 0.1})
    currents = [
        Simulation(pendulum(), {"motor": noisy}, 2, seed=seed).move(np.ones((5, 2, 1)))[:, :, 0]
        for seed in (0, 0, 1)
    ]
    np.testing.assert_array_equal(currents[0], currents[1])
    assert (currents[0][-1] != currents[2][-1]).all()
    assert currents[0][-1, 0] != currents[0][-1, 1]


REFUSED = {
    "no actuator has such a name": {"third:time_constant": "uniform(0.1, 0.2)"},
    "unknown parameter tau": {"second:tau": "uniform(0.1, 0.2)"},
    "also changes the inertia": {"first:motor.gear_ratio": "uniform(10, 20)"},
    "it is the model's": {"model.gravity": "uniform(0.9, 1.1)"},
    "drawn by another pattern": {"second:gain": "uniform(0.9, 1.1)", "s.*:gain": "uniform(0.9, 1)"},
    "must be": {"second:gain": "uniform(0.9, 0.1)"},
    "1000 draws in a row are unstable.*Narrow the bounds": {
        "third.*:controller.kp": "uniform(1e4, 2e4)"
    },
}


@pytest.mark.parametrize("message", REFUSED)
def test_draws_that_cannot_be_are_refused(message):
    spec = two_joints()
    actuators = {"first": CATALOGUE_MOTOR, "second": "lag"}
    if "unstable" in message:
        spec.actuators[0].name = "third"
        actuators = {"third": "current_loop", "second": "lag"}
    with pytest.raises(ValueError, match=message):
        Simulation(spec, actuators, 4, randomize=REFUSED[message])


def test_unstable_draws_of_a_world_are_drawn_again():
    spec = pendulum()
    simulation = Simulation(
        spec, {"motor": "current_loop"}, 50, randomize={"controller.kp": "uniform(1, 200)"}
    )
    group = simulation.motors.groups[0]
    kp = group.parameter("controller.kp").numpy()[:, 0]
    actuator = group.actuators[0]
    for value in kp:
        actuator.replaced({"controller.kp": float(value)}).check(0.002)
    with pytest.raises(ValueError, match="unstable"):
        actuator.replaced({"controller.kp": 200.0}).check(0.002)


def test_bounds_with_unstable_servos_are_refused():
    with pytest.raises(ValueError, match=r"randomize: .*velocity_gain = 200: .*narrow the bounds"):
        Simulation(
            pendulum(), {"motor": servo()}, 2, randomize={"loop.velocity_gain": "uniform(1, 200)"}
        )


def test_a_model_of_another_robot_or_step_is_refused():
    robot = prepare_model(pendulum(), {"motor": "lag"})
    larger = two_joints().compile()
    with pytest.raises(ValueError, match=r"has 2 actuators, must be the compiled `robot.spec`"):
        attach_motors(robot, mjw.put_model(larger), mjw.make_data(larger))
    compiled = robot.spec.compile()
    compiled.opt.timestep = 0.001
    with pytest.raises(ValueError, match="set it in the spec before `prepare_model`"):
        attach_motors(robot, mjw.put_model(compiled), mjw.make_data(compiled))


def test_motors_in_float_are_close_to_those_in_double():
    commands = square_waves(STEPS, 1)
    double, single = (
        Simulation(pendulum(), {"motor": CATALOGUE_MOTOR}, real=real).move(commands)
        for real in ("double", "float")
    )
    print("float inside: largest gap", np.abs(double - single).max())
    assert 0.0 < np.abs(double - single).max() < 1e-4


def test_mjx_ignores_the_armature_of_an_actuator():
    """The pages say so; when this changes, they can be shortened."""
    jax = pytest.importorskip("jax", reason="NOT RUN: JAX is not installed: make simulators")
    mjx = pytest.importorskip("mujoco.mjx", reason="NOT RUN: no MJX: make simulators")
    spec = pendulum()
    spec.actuators[0].armature = 1.0
    compiled = spec.compile()
    ours = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, ours)
    model = mjx.put_model(compiled)

    @jax.jit
    def inertia_matrix(data):
        return mjx.full_m(model, mjx.crb(model, mjx.com_pos(model, mjx.kinematics(model, data))))

    assert ours.M[0] > 1.0 > 0.1 > float(inertia_matrix(mjx.make_data(model))[0, 0])
