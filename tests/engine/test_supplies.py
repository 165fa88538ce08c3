"""Drives that share a supply: against a stiff integration, energy, both backends and batches."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from codrl_mj import engine
from codrl_mj.actuators import (
    Drive,
    GearMotor,
    SampledLoop,
    ServoFriction,
    SharedDrive,
    SharedSupply,
    SharedVoltageDrive,
    Supply,
    UnstableError,
)
from codrl_mj.engine.families import SLOT_HEADER_SIZE
from codrl_mj.engine.specs import add_motors
from codrl_mj.engine.supplies import CURRENT, REQUESTED, WORK_SIZE, bus_voltage
from codrl_mj.validation import validate_model
from tests.engine.models import add_motor

SAMPLE_RATE, TIMESTEP = 20e3, 1e-3
RESISTANCES = 0.6, 1.0, 1.5, 0.8
INDUCTANCES = 1e-3, 2e-3, 0.7e-3, 1.2e-3
CONSTANTS = 0.05, 0.1, 0.08, 0.06


def motor_of(n, supply, family=SharedDrive, **loop):
    """Return the n-th of four unequal motors."""
    motor = GearMotor(
        resistance=RESISTANCES[n],
        inductance=INDUCTANCES[n],
        torque_constant=CONSTANTS[n],
        back_emf_constant=CONSTANTS[n],
    )
    return family(motor, SampledLoop(SAMPLE_RATE, **loop), supply)


def wheels(motors, callback=False, integrator="Euler"):
    """Return a model of heavy wheels, whose speed hardly changes, each with a motor."""
    bodies = "".join(
        f'<body pos="0 {n} 0"><joint name="w{n}" axis="0 1 0"/>'
        '<inertial pos="0 0 0" mass="1" diaginertia="1e12 1e12 1e12"/></body>'
        for n in range(len(motors))
    )
    actuators = "".join(f'<motor name="w{n}" joint="w{n}"/>' for n in range(len(motors)))
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option gravity="0 0 0" timestep="{TIMESTEP}" integrator="{integrator}"/>'
        f"<worldbody>{bodies}</worldbody>"
        f"<actuator>{'' if callback else actuators}</actuator></mujoco>"
    )
    if not callback:
        return add_motors(spec, {f"w{n}": motor for n, motor in enumerate(motors)}).compile()
    for n, motor in enumerate(motors):
        add_motor(spec, f"w{n}", motor, name=f"w{n}")
    return spec.compile()


def run(model, torques, speeds, steps=10):
    """Return the data after some steps, and the signals of each step."""
    data = mujoco.MjData(model)
    data.ctrl[:], data.qvel[:] = torques, speeds
    table = []
    for _ in range(steps):
        mujoco.mj_step(model, data)
        table.append(engine.signals(model, data))
    return data, {name: np.array([row[name] for row in table]) for name in table[0]}


def voltage_by_search(source, resistance, requested, currents):
    """Return the largest solution of the supply's equation, by a search from above."""

    def excess(voltage):
        powers = [
            np.clip(w, -voltage, voltage) * i for w, i in zip(requested, currents, strict=True)
        ]
        return source - resistance * sum(powers) / voltage - voltage

    grid = np.geomspace(source + resistance * np.abs(currents).sum() + 1.0, 1e-3, 20001)
    crossings = np.flatnonzero(excess(grid) >= 0.0)
    if not crossings.size:
        return 0.0
    return brentq(excess, grid[crossings[0]], grid[crossings[0] - 1], xtol=1e-13, rtol=1e-14)


def integrated(motors, commands, speeds, supply, steps):
    """Return currents and energies [J] of a stiff integration of all windings.

    The energies are those of source, its resistance, windings and mechanical work, per step.
    """
    resistances, inductances, constants = (
        np.array(values[: len(motors)]) for values in (RESISTANCES, INDUCTANCES, CONSTANTS)
    )
    back_emf, state, energies = constants * speeds, np.zeros(len(motors) + 4), []
    for sample in range(steps * round(TIMESTEP * SAMPLE_RATE)):
        initial = state[: len(motors)].copy()
        voltage = voltage_by_search(supply.voltage, supply.resistance, commands, initial)
        applied = np.clip(commands, -voltage, voltage)

        def rates(_, values, applied=applied, voltage=voltage):
            currents = values[: len(motors)]
            drawn = (applied * currents).sum() / voltage
            return np.array(
                [
                    *((applied - back_emf - resistances * currents) / inductances),
                    supply.voltage * drawn,
                    (supply.voltage - voltage) * drawn,
                    (resistances * currents**2).sum(),
                    (back_emf * currents).sum(),
                ]
            )

        state = solve_ivp(
            rates, (0.0, 1.0 / SAMPLE_RATE), state, method="Radau", rtol=1e-12, atol=1e-13
        ).y[:, -1]
        if (sample + 1) % round(TIMESTEP * SAMPLE_RATE) == 0:
            energies.append(state[len(motors) :].copy())
    return state[: len(motors)], np.diff([np.zeros(4), *energies], axis=0)


@pytest.mark.parametrize(
    ("commands", "speeds"),
    [
        pytest.param([30.0, 3.0], [20.0, 100.0], id="two, one braking"),
        pytest.param([30.0, -20.0, 4.0, 1.0], [10.0, -20.0, 120.0, 60.0], id="four, two braking"),
    ],
)
def test_currents_and_energy_are_those_of_a_stiff_integration(commands, speeds):
    supply, steps = SharedSupply(12.0, 0.15), 3
    motors = [motor_of(n, supply, SharedVoltageDrive) for n in range(len(commands))]
    data, signals = run(
        wheels(motors), np.array(commands) * CONSTANTS[: len(motors)], speeds, steps
    )
    currents, energies = integrated(motors, np.array(commands), np.array(speeds), supply, steps)
    # `advance` has committed the state, whose first entry is the current.
    starts = data.model.plugin_stateadr[data.model.actuator_plugin] + SLOT_HEADER_SIZE
    np.testing.assert_allclose(data.plugin_state[starts], currents, rtol=0, atol=1e-9)
    work = signals["electrical_power"] - signals["copper_loss"]
    stored = 0.5 * (np.array(INDUCTANCES[: len(motors)]) * currents**2).sum()
    source, lost, heat, moved = energies.sum(axis=0)
    assert source == pytest.approx(lost + heat + moved + stored, rel=1e-9)
    ours = supply.voltage * signals["supply_current"][:, 0] * TIMESTEP
    np.testing.assert_allclose(ours, energies[:, 0], rtol=1e-9)
    drawn = signals["electrical_power"].sum(axis=1) * TIMESTEP
    np.testing.assert_allclose(ours - drawn, energies[:, 1], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        signals["copper_loss"].sum(axis=1) * TIMESTEP, energies[:, 2], rtol=1e-9
    )
    assert work.sum() * TIMESTEP == pytest.approx(moved + stored, rel=1e-9)
    # Some motors brake: their power is negative, and the others use it.
    assert signals["electrical_power"][-1].min() < 0.0 < signals["electrical_power"][-1].max()


def test_the_voltage_is_the_largest_solution_for_random_motors():
    random = np.random.default_rng(0)
    kinds = set()
    for _ in range(100):
        count = int(random.integers(1, 6))
        requested, currents = random.normal(0.0, 10.0, count), random.normal(0.0, 8.0, count)
        source, resistance = random.uniform(5.0, 20.0), random.uniform(0.01, 1.0)
        work = np.zeros(WORK_SIZE * count)
        work[REQUESTED::WORK_SIZE], work[CURRENT::WORK_SIZE] = requested, currents
        voltage = bus_voltage.py_func(work, WORK_SIZE, count, source, resistance, True)
        expected = voltage_by_search(source, resistance, requested, currents)
        assert voltage == pytest.approx(expected, rel=1e-9, abs=1e-9)
        kinds |= {int((abs(requested) > voltage).sum()), "rise" if voltage > source else "sag"}
        blocked = bus_voltage.py_func(work, WORK_SIZE, count, source, resistance, False)
        assert blocked == min(voltage, source)
    assert {0, 1, 2, "rise", "sag"} <= kinds


def test_stalled_motors_share_the_current_of_one_source():
    for pulling in (1, 2, 4):
        motors = [motor_of(1, SharedSupply(12.0, 0.5), max_current=20.0) for _ in range(4)]
        torques = [2.0] * pulling + [0.0] * (4 - pulling)
        _, signals = run(wheels(motors), torques, 0.0, steps=40)
        expected = 12.0 / (1.0 + 0.5 * pulling)
        np.testing.assert_allclose(signals["current"][-1, :pulling], expected, rtol=1e-6)
        np.testing.assert_allclose(signals["supply_current"][-1], pulling * expected, rtol=1e-6)
        np.testing.assert_allclose(signals["supply_voltage"][-1], expected, rtol=1e-6)


def test_a_driving_motor_alone_has_the_bits_of_its_own_supply():
    single, shared = motor_of(1, Supply(12.0, 0.5), Drive), motor_of(1, SharedSupply(12.0, 0.5))
    for torque in (0.3, 2.0):
        results = [run(wheels([motor]), torque, 20.0, steps=20)[1] for motor in (single, shared)]
        for name in Drive.Signals._fields:
            np.testing.assert_array_equal(results[0][name], results[1][name], err_msg=name)


def test_without_resistance_motors_do_not_see_each_other():
    torques, speeds = [0.3, -2.0, 0.1, 1.0], [5.0, 100.0, -30.0, 0.0]
    shared = [motor_of(n, SharedSupply(12.0)) for n in range(4)]
    separate = [motor_of(n, SharedSupply(12.0, number=n + 1)) for n in range(4)]
    ideal = [motor_of(n, Supply(12.0), Drive) for n in range(4)]
    results = [run(wheels(motors), torques, speeds)[1] for motors in (shared, separate, ideal)]
    for name in Drive.Signals._fields:
        np.testing.assert_array_equal(results[0][name], results[1][name], err_msg=name)
        # The drive's closed form rounds differently from its samples.
        np.testing.assert_allclose(results[0][name], results[2][name], rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_both_backends_and_batches_have_the_same_bits(integrator):
    torques, speeds = np.array([0.5, -0.3, 2.0, 0.1]), np.array([20.0, 90.0, 0.0, -40.0])
    motors = [motor_of(n, SharedSupply(12.0, 0.1, number=1 + n % 2)) for n in range(4)]
    models = [wheels(motors, callback, integrator) for callback in (False, True)]
    engine.load_family(SharedDrive)
    engine.install()
    try:
        (plugin, first), (callback, second) = [run(model, torques, speeds) for model in models]
        for name in SharedDrive.Signals._fields:
            np.testing.assert_array_equal(first[name], second[name], err_msg=name)
        np.testing.assert_array_equal(plugin.qvel, callback.qvel)
        for model, single in zip(models, (plugin, callback), strict=True):
            batch = Batch(model, nsim=3, nthread=2)
            batch.bind("ctrl").reshape(3, -1)[:] = torques
            batch.bind("qvel").reshape(3, -1)[:] = speeds
            for _ in range(10):
                batch.step()
            for name in ("qvel", "act", "plugin_state"):
                rows = batch.bind(name).reshape(3, -1)
                np.testing.assert_array_equal(rows, [getattr(single, name)] * 3)
    finally:
        engine.uninstall()


def test_a_source_that_does_not_recharge_stays_at_its_voltage():
    speeds, torques = [110.0, 10.0], [-0.2, 0.02]
    results = [
        run(
            wheels([motor_of(n, SharedSupply(12.0, 0.5, 1, flag)) for n in (1, 1)]), torques, speeds
        )
        for flag in (True, False)
    ]
    battery, rectifier = (signals for _, signals in results)
    assert battery["supply_voltage"].max() > 12.0
    assert battery["supply_current"].min() < 0.0
    assert rectifier["supply_voltage"].max() <= 12.0
    assert rectifier["supply_current"].min() == 0.0


def test_motors_of_a_supply_must_agree():
    with pytest.raises(ValueError, match=r"w1: supply\.voltage = 10\.0: must be 12\.0 as for w0"):
        wheels([motor_of(0, SharedSupply(12.0)), motor_of(1, SharedSupply(10.0))])
    fast = SharedDrive(motor_of(1, None).motor, SampledLoop(40e3), SharedSupply(12.0))
    with pytest.raises(ValueError, match=r"w1: controller\.sample_rate = 40000\.0: must be 20000"):
        wheels([motor_of(0, SharedSupply(12.0)), fast])
    supply = SharedSupply(12.0, 12.0)
    motors = [motor_of(n, supply) for n in range(4)]
    with pytest.raises(UnstableError, match="w0, w1, w2, w3: saturated together, they oscillate"):
        wheels(motors)
    with pytest.raises(ValueError, match=r"controller\.deadband = 0\.5: must be 0 on a shared"):
        motor_of(0, supply, deadband=0.5)
    with pytest.raises(ValueError, match="voltage = inf: must be finite"):
        SharedSupply(math.inf)


def test_the_certificate_runs_the_motors_of_a_supply_together():
    motors = [motor_of(n, SharedSupply(12.0, 0.1, number=1 + n % 2)) for n in range(4)]
    assert validate_model(wheels(motors), quick=True).passed
    # Alone in plain Python, each motor would see another supply.
    friction = ServoFriction(base=0.01, viscous=1e-4, load_motor=0.05, load_external=0.05)
    with_friction = [dataclasses.replace(motor, friction=friction) for motor in motors]
    assert validate_model(wheels(with_friction), quick=True).passed


def test_a_disabled_motor_takes_nothing_from_its_supply():
    motors = [motor_of(n, SharedSupply(12.0, 0.5)) for n in range(2)]
    model, remaining = wheels(motors), wheels(motors[1:])
    model.actuator_group[:] = 1, 2
    model.opt.disableactuator = 1 << 1
    _, both = run(model, 2.0, 20.0)
    _, single = run(remaining, 2.0, 20.0)
    for name in SharedDrive.Signals._fields:
        np.testing.assert_array_equal(both[name][:, 1:], single[name], err_msg=name)
    assert not both["current"][:, 0].any()
