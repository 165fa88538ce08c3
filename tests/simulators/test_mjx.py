"""Motors in MJX move robots as in our engine, and the step has derivatives.

MJX compiles for 10 to 40 s a model, so that one compiled motion serves several checks.
"""

import re
from pathlib import Path

import numpy as np
import pytest

from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Drive, Inputs, Motor, parameters_type
from codrl_mj.arrays import advance, prepare_model
from tests.arrays.cases import FAMILIES, case, errors, errors_of, python_results
from tests.arrays.gearbox import Gearbox
from tests.arrays.models import (
    CATALOGUE_MOTOR,
    STEPS,
    cheetah,
    our_motion,
    pendulum,
    square_waves,
    two_joints,
    with_our_motors,
)
from tests.arrays.runs import rounded, run_arrays

jax = pytest.importorskip("jax", reason="NOT RUN: JAX is not installed: make simulators")
mjx = pytest.importorskip("mujoco.mjx", reason="NOT RUN: no MJX: make simulators")
# The module imports JAX.
from codrl_mj.arrays.mjx import MJXMotors  # noqa: E402

jnp = jax.numpy
NUM = 10_000
REPOSITORY = Path(__file__).parents[2]
TOLERANCE = {"Euler": 1e-5, "RK4": 5e-5}
"""Largest difference of a joint's angle over 500 steps [rad], which turns by more than 10 rad."""
pytestmark = [
    pytest.mark.filterwarnings("ignore:the model", "ignore:compiler attribute"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


@pytest.mark.parametrize("name", FAMILIES)
def test_random_actuators_in_double_equal_python(name):
    with jax.enable_x64(True):
        results = run_arrays(case(name, NUM), jnp, jnp.asarray, jax.jit)
    assert errors(name, NUM, results).max() < 1e-11


@pytest.mark.parametrize("name", FAMILIES)
def test_torques_of_random_actuators_in_float32_are_accurate(name):
    actuators = rounded(case(name, NUM))
    results = run_arrays(actuators, jnp, lambda x: jnp.asarray(x, jnp.float32), jax.jit)
    assert results.dtype == np.float32
    error = errors_of(actuators, python_results(actuators), results)
    torque = error[:, actuators.state.shape[1]]
    print(name, "float32: torque p99.9", np.quantile(torque, 0.999), "max", torque.max())
    assert np.quantile(torque, 0.999) < 3e-5
    # The error of a flag that differs is infinite.
    assert np.isfinite(error).all()


class Simulation:
    """Model of MJX with motors, whose motion is compiled once.

    Without actuators the model moves by `mjx.step` alone.
    """

    def __init__(self, spec, actuators, **options):  # noqa: D107
        self.motors = MJXMotors(prepare_model(spec, actuators), **options) if actuators else None
        self.model = mjx.put_model(self.motors.model if self.motors else spec.copy().compile())
        self.run = jax.jit(jax.vmap(self._move))

    def _move(self, start, commands, is_reset, noise_keys, parameters):
        at_rest = mjx.make_data(self.model).replace(qpos=start)

        def step(carry, inputs):
            (data, state), (command, reset) = carry, inputs
            data = jax.tree.map(lambda new, old: jnp.where(reset, new, old), at_rest, data)
            if self.motors is None:
                data = mjx.step(self.model, data.replace(ctrl=command))
                return (data, state), (data.qpos, ())
            state = self.motors.reset(state, reset)
            data, state, signals = self.motors.step(self.model, data, state, command, parameters)
            return (data, state), (data.qpos, signals)

        state = None if self.motors is None else self.motors.init(noise_keys)
        return jax.lax.scan(step, (at_rest, state), (commands, is_reset))[1]

    def move(self, commands, starts=None, is_reset=None, noise_keys=None, parameters=None):
        """Return positions, shape (steps, worlds, nq), and signals, shape (steps, worlds, ...)."""
        num_steps, num_worlds = commands.shape[:2]
        if starts is None:
            starts = np.tile(np.asarray(self.model.qpos0), (num_worlds, 1))
        resets = np.zeros((num_worlds, num_steps), dtype=bool) if is_reset is None else is_reset
        num_motors = len(self.motors.init().noise_keys) if self.motors else 0
        keys = np.zeros((num_worlds, num_motors)) if noise_keys is None else noise_keys
        if parameters is None and self.motors:
            nominal = self.motors.parameters()
            parameters = jax.tree.map(lambda x: jnp.tile(x, (num_worlds, 1)), nominal)
        arrays = map(jnp.asarray, (starts, np.swapaxes(commands, 0, 1), resets, keys))
        results = self.run(*arrays, parameters)
        return jax.tree.map(lambda array: np.swapaxes(np.asarray(array), 0, 1), results)


@pytest.mark.parametrize("integrator", TOLERANCE)
def test_a_catalogue_motor_moves_a_pendulum_as_in_our_engine(integrator):
    spec, actuators = pendulum(integrator), {"hinge": CATALOGUE_MOTOR}
    commands = square_waves(STEPS, 2)
    ours = our_motion([with_our_motors(spec, actuators)] * 2, commands)
    positions, signals = Simulation(spec, actuators).move(commands)
    gap = np.abs(positions - ours)
    print(integrator, "pendulum: largest gaps", gap.max(axis=(0, 2)), "range", np.ptp(ours))
    assert positions.dtype == np.float32
    assert np.ptp(ours) > 10.0
    assert gap.max() < TOLERANCE[integrator]
    drive = signals["drive"]
    assert drive.temperature.shape == (STEPS, 2, 1)
    assert (np.diff(drive.temperature[-100:, :, 0], axis=0).mean(axis=0) > 0.0).all()
    assert 0.0 < drive.saturated.mean() < 1.0


def test_resets_draws_and_a_custom_family_agree_with_our_engine():
    num, spec = 6, two_joints(first='position name="first" joint="a" kp="6" forcerange="-3 3"')
    actuators = {"first": CATALOGUE_MOTOR, "second": Gearbox()}
    simulation = Simulation(
        spec,
        actuators,
        randomize={
            "first:motor.resistance": "uniform(0.7, 1.3)",
            "second:efficiency": "uniform(0.6, 0.9)",
        },
    )
    drawn = simulation.motors.draw(np.random.default_rng(1), num)
    (resistance,), (efficiency,) = (values.values() for values in drawn.values())
    assert resistance.shape == efficiency.shape == (num, 1)
    assert len({*np.asarray(resistance)[:, 0]}) == num
    commands = square_waves(400, num, 2) * [0.6, 0.2]
    is_reset = np.zeros((num, 400), dtype=bool)
    is_reset[::2, 200] = True
    models = [
        with_our_motors(
            spec,
            {
                "first": CATALOGUE_MOTOR.replaced(
                    {"motor.resistance": float(resistance[world, 0])}
                ),
                "second": Gearbox(efficiency=float(efficiency[world, 0])),
            },
        )
        for world in range(num)
    ]
    worlds = np.arange(0, num, 2)
    ours = our_motion(models, commands, reset_at=200, reset_worlds=worlds)
    positions, _ = simulation.move(commands, is_reset=is_reset, parameters=drawn)
    gap = np.abs(positions - ours)
    print("resets, draws and a custom family: largest gap", gap.max(), "range", np.ptp(ours))
    assert gap.max() < 3e-4
    assert np.abs(ours - our_motion(models, commands))[:, worlds].max() > 0.1
    assert np.abs(ours[:150, 0] - our_motion(models[1:2], commands[:150, :1])[:, 0]).max() > 1e-3


REAR = CATALOGUE_MOTOR.replaced({"motor.gear_ratio": 4.0, "motor.gear_efficiency": 0.9})
FRONT = REAR.replaced({"motor.gear_ratio": 2.0, "controller.delayed": True})
CHEETAH_MOTORS = {"b.*": REAR, "f.*": FRONT}
IN_THE_AIR = 120
"""Number of steps before the first cheetah touches the floor."""


def cheetah_gaps(actuators, num_worlds=64, num_steps=300):
    """Return the largest gap in each step and world [rad, m], shape (steps, worlds)."""
    spec = cheetah()
    commands = 0.5 * square_waves(num_steps, num_worlds, 6)
    model = with_our_motors(spec, actuators)
    starts = np.zeros((num_worlds, model.nq))
    generator = np.random.default_rng(0)
    starts[:, 1] = 0.3
    starts[:, 3:] = generator.uniform(-0.1, 0.1, (num_worlds, 6)).astype(np.float32)
    ours = our_motion([model] * num_worlds, commands, starts)
    theirs, _ = Simulation(spec, actuators).move(commands, starts)
    return np.abs(ours - theirs).max(axis=2)


def test_motors_move_a_cheetah_in_double_as_in_our_engine():
    with jax.enable_x64(True):
        gaps = cheetah_gaps(CHEETAH_MOTORS)
    print("cheetah in double: median", np.median(gaps[-1]), "largest gap", gaps[-1].max())
    assert gaps[:IN_THE_AIR].max() < 1e-14
    assert np.median(gaps[-1]) < 1e-13
    # MJX's solver of contacts stops elsewhere than MuJoCo's.
    assert gaps[-1].max() < 1e-7


def test_motors_add_no_error_to_a_cheetah_in_float32():
    with_motors, without = cheetah_gaps(CHEETAH_MOTORS), cheetah_gaps({})
    for label, gaps in (("with motors", with_motors), ("without", without)):
        print(
            *("cheetah", label, "in the air: largest gap", gaps[:IN_THE_AIR].max()),
            *("after 300 steps: median", np.median(gaps[-1]), "largest gap", gaps[-1].max()),
        )
    assert with_motors[:IN_THE_AIR].max() <= without[:IN_THE_AIR].max()
    assert np.median(with_motors[-1]) <= np.median(without[-1])
    # Contacts amplify the rounding of float32 in a few worlds. The largest gap is that of another
    # world with other motions, and says nothing about motors: the test in double does.
    assert with_motors[-1].max() < 5e-5


NOISY = DCMotorActuator(Motor(arm_radius=1.0), CurrentLoop(current_noise=0.05), supply=None)


def test_noise_depends_on_the_key_and_begins_again_at_a_reset():
    motors = MJXMotors(prepare_model(pendulum(), {"motor": NOISY}))
    model = mjx.put_model(motors.model)
    data = mjx.make_data(model)
    forces = jax.jit(lambda state: motors.forces(model, data, state, jnp.zeros(1)))
    first, same, different = (motors.init(jnp.array([key])) for key in (7, 7, 8))
    currents = []
    for _ in range(3):
        results = [forces(state) for state in (first, same, different)]
        first, same, different = (result.state for result in results)
        currents.append([float(r.signals["current_loop"].current[0]) for r in results])
    table = np.array(currents)
    np.testing.assert_array_equal(table[:, 0], table[:, 1])
    assert (table[:, 0] != table[:, 2]).all()
    again = forces(motors.reset(first, True))
    assert again.signals["current_loop"].current[0] == table[0, 0]
    new_key = motors.reset(first, True, jnp.array([8]))
    assert forces(new_key).signals["current_loop"].current[0] == table[0, 2]
    batch = jax.tree.map(lambda *x: jnp.stack(x), first, different)
    after = motors.reset(batch, jnp.array([True, False]))
    assert after.steps.tolist() == [0, 3]
    assert after.families["current_loop"].current[0, 0] == 0.0
    assert (
        after.families["current_loop"].current[1, 0] == different.families["current_loop"].current
    )


PATHS = ("motor.resistance", "motor.torque_constant", "supply.voltage")


def test_derivatives_of_a_motion_equal_differences():
    # MJX has no reverse mode through its constraints, such as friction.
    motor = CATALOGUE_MOTOR.replaced({"motor.coulomb_friction": 0.0, "supply.voltage": 6.0})
    robot = prepare_model(pendulum(), {"motor": motor})
    with jax.enable_x64(True):
        motors = MJXMotors(robot, varying=PATHS, max_iterations=4)
        model = mjx.put_model(motors.model)
        nominal = motors.parameters()["drive"]
        commands = 4.0 * jnp.sign(jnp.sin(jnp.arange(60) / 8.0 + 0.1))[:, jnp.newaxis]

        def final_angle(factors):
            drive = {
                path: value * factor
                for (path, value), factor in zip(nominal.items(), factors[:-1], strict=True)
            }

            def step(carry, command):
                result = motors.step(model, *carry, command * factors[-1], {"drive": drive})
                return (result.data, result.state), result.signals["drive"].saturated[0]

            start = mjx.make_data(model), motors.init()
            (data, _), saturated = jax.lax.scan(step, start, commands)
            return data.qpos[0], saturated

        factors = jnp.ones(len(PATHS) + 1)
        function = jax.jit(final_angle)
        _, saturated = function(factors)
        assert 0.0 < saturated.mean() < 1.0
        changes = 1e-5 * jnp.eye(len(factors))
        differences = [
            (function(factors + change)[0] - function(factors - change)[0]) / 2e-5
            for change in changes
        ]
        forward = jax.jit(jax.jacfwd(lambda factors: final_angle(factors)[0]))(factors)
        backward = jax.jit(jax.grad(lambda factors: final_angle(factors)[0]))(factors)
    print("derivatives", forward, backward, differences)
    assert np.abs(differences).min() > 1e-4
    np.testing.assert_allclose(forward, differences, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(backward, differences, rtol=1e-6, atol=1e-8)


def drive_torque(resistance, actuator, max_iterations):
    """Return the torque of a drive at rest after a step at a speed."""
    values = parameters_type(Drive)(*map(float, actuator.parameter_values))
    state = Drive.State(*[0.0] * len(Drive.State._fields))
    inputs = Inputs(0.2, 0.0, 30.0, 0.0, 0.0, 1e-4)
    parameters = values._replace(resistance=resistance)
    return advance(Drive, jnp, parameters, 0.002, state, inputs, max_iterations).torque


def test_a_loop_that_exceeds_its_limit_has_no_result_instead_of_a_wrong_one():
    delayed = CATALOGUE_MOTOR.replaced({"controller.delayed": True})
    assert delayed.controller.sample_rate * 0.002 == 40.0
    with jax.enable_x64(True):
        resistance = jnp.array([delayed.motor.resistance])
        results = {
            limit: jax.jit(lambda r, n=limit: drive_torque(r, delayed, n))(resistance)
            for limit in (None, 40, 39)
        }
        derivative = jax.jit(jax.grad(lambda r: drive_torque(r, delayed, 40)[0]))(resistance)
        difference = (
            drive_torque(resistance + 1e-6, delayed, None)
            - drive_torque(resistance - 1e-6, delayed, None)
        ) / 2e-6
    assert np.isnan(results[39]).all()
    np.testing.assert_allclose(results[40], results[None], rtol=1e-13)
    np.testing.assert_allclose(derivative, difference, rtol=1e-6)


def test_parameters_that_change_the_joint_cannot_vary():
    robot = prepare_model(pendulum(), {"motor": CATALOGUE_MOTOR})
    for path in ("motor.gear_ratio", "motor.rotor_inertia"):
        with pytest.raises(ValueError, match=f"varying: {path}: it also changes the motor's arm"):
            MJXMotors(robot, varying=(path,))
    with pytest.raises(ValueError, match=r"unknown parameter .*motor\.resistence"):
        MJXMotors(robot, varying=("motor.resistence",))
    motors = MJXMotors(robot)
    model = mjx.put_model(motors.model)
    arguments = model, mjx.make_data(model), motors.init(), jnp.zeros(1)
    values = {"drive": {"motor.resistance": jnp.ones(1)}}
    with pytest.raises(ValueError, match=r"unknown varying parameter .*motor\.resistance"):
        motors.forces(*arguments, values)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_example_of_the_page_runs(tmp_path, monkeypatch):
    page = (REPOSITORY / "docs" / "arrays.md").read_text().partition("## Motors in MJX")[2]
    (example,) = re.findall(r"```py\n(.*?)```", page.partition("\n## ")[0], re.DOTALL)
    monkeypatch.chdir(tmp_path)
    spec = pendulum()
    spec.compile()
    (tmp_path / "robot.xml").write_text(spec.to_xml())
    namespace = {}
    exec(example, namespace)
    temperature = np.asarray(namespace["signals"]["drive"].temperature)
    assert temperature.shape == (64, 1)
    # Each world has another resistance, and most motors are at their voltage limit.
    assert len({*namespace["signals"]["drive"].current[:, 0].tolist()}) > 50
