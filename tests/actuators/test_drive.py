"""Drive: exact winding, closed form against stepping, margins, anti-windup, bench measurements."""

import dataclasses
import math

import control
import mujoco
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import codrl_mj
from codrl_mj.actuators import Drive, GearMotor, Inputs, SampledLoop, Supply, parameters_type
from codrl_mj.actuators.sampled import designed_gains, run_samples, solve_designed_loop
from codrl_mj.actuators.sampled_loop import DEFAULT_BANDWIDTH

# R [ohm], L [H], K [N*m/A], V [V] of maxon EC45 flat and DCX22L, Faulhaber 1331T, T-motor AK80-6,
# QUBE-Servo 2 and PMG-132.
WINDINGS = {
    "ec45": (0.464, 0.322e-3, 25.1e-3, 24.0),
    "dcx22l": (0.168, 0.018e-3, 6.95e-3, 9.0),
    "1331t": (2.83, 70e-6, 5.35e-3, 6.0),
    "ak80-6": (0.170, 57e-6, 0.091, 24.0),
    "qube": (8.4, 1.16e-3, 0.042, 18.0),
    "pmg132": (0.016, 19e-6, 0.165, 60.0),
}
RATES = (10e3, 20e3, 40e3)
every_winding = pytest.mark.parametrize("name", WINDINGS)


def drive(name, rate=20e3, **loop):
    resistance, inductance, constant, voltage = WINDINGS[name]
    return Drive(
        GearMotor(resistance, inductance, constant, constant, rotor_inertia=1e-6),
        SampledLoop(rate, **loop),
        Supply(voltage),
    )


def responses(actuator, timestep, torques, speeds):
    """Return states, torques and signals of steps under held torques and speeds at the rotor."""
    parameters, state = (
        parameters_type(Drive)(*actuator.parameter_values),
        actuator.State(*[0.0] * 9),
    )
    steps = []
    for torque, speed in zip(torques, speeds, strict=True):
        state, delivered, signals = actuator.advance(
            parameters, timestep, state, Inputs(torque, 0.0, speed, 0.0, 0.0)
        )
        steps.append((state, delivered, signals))
    return steps


def limits_of(signals):
    """Return the names of the limits reached in a step, consistent with `saturated`."""
    met = [
        name
        for name in ("voltage", "current", "temperature")
        if getattr(signals, f"{name}_saturated")
    ]
    assert signals.saturated == float(bool(met))
    return " ".join(met)


@pytest.mark.parametrize("compensated", [True, False])
@every_winding
def test_the_winding_is_exact_and_the_delivered_torque_is_the_mean(name, compensated):
    """Compare with the matrix exponential of current and charge, sample by sample."""
    resistance, inductance, constant, voltage = WINDINGS[name]
    actuator, timestep, rng = (
        drive(name, bemf_compensation=compensated),
        0.002,
        np.random.default_rng(0),
    )
    torques = rng.uniform(-2, 2, 20) * constant * voltage / resistance
    speeds = rng.uniform(-1, 1, 20) * voltage / constant
    kp, ki = designed_gains(
        resistance, inductance, 1 / 20e3, 2 * math.pi * DEFAULT_BANDWIDTH * 20e3
    )
    a, b = -resistance / inductance, 1 / inductance
    # The states are current, charge and voltage.
    exact = expm(np.array([[a, 0, b], [1, 0, 0], [0, 0, 0]]) / 20e3)
    current, integral = 0.0, 0.0
    steps = zip(
        responses(actuator, timestep, torques, speeds), torques, constant * speeds, strict=True
    )
    for (state, delivered, signals), torque, back_emf in steps:
        charge, volts = 0.0, 0.0
        for _ in range(40):
            error = torque / constant - current
            command = kp * error + ki * (integral + error) + back_emf * compensated
            applied = min(max(command, -voltage), voltage)
            integral += error + (applied - command) / (kp + ki)
            current, charge, _ = exact @ (current, charge, applied - back_emf)
            volts += applied
        scale = voltage / resistance
        assert abs(state.current - current) < 1e-12 * scale
        assert abs(delivered - constant * charge / timestep) < 1e-12 * constant * scale
        assert abs(signals.current - charge / timestep) < 1e-12 * scale
        assert abs(signals.voltage - volts / 40) < 1e-12 * voltage


@pytest.mark.parametrize(
    ("loop", "supply", "commanded"),
    [
        ({}, 0.0, False),
        ({"bemf_compensation": False}, 0.0, False),
        ({"anti_windup": "clamping", "delayed": True, "deadband": 0.3}, 0.5, False),
        ({"max_current": 0.4}, 0.0, False),
        ({}, 0.0, True),
    ],
    ids=["closed_form", "uncompensated", "stepped", "limited", "voltage"],
)
def test_the_electrical_power_is_heat_work_and_field_energy(loop, supply, commanded):
    """Compare power and R*i^2 within samples with scipy's, at voltages of single-sample steps."""
    resistance, inductance, constant, voltage = WINDINGS["qube"]
    actuator, samples, rng = drive("qube", **loop), 40, np.random.default_rng(2)
    actuator = dataclasses.replace(actuator, supply=Supply(voltage, supply))
    torques = (
        rng.uniform(-1.5, 1.5, 5) * constant * (voltage if commanded else voltage / resistance)
    )
    speeds = rng.uniform(-0.8, 0.8, 5) * voltage / constant
    actuator = actuator.commands()["voltage"].actuator if commanded else actuator
    long_steps = [step[2] for step in responses(actuator, samples / 20e3, torques, speeds)]
    short_steps = responses(
        actuator, 1 / 20e3, np.repeat(torques, samples), np.repeat(speeds, samples)
    )
    volts, starts = (
        [step[2].voltage for step in short_steps],
        np.append(0.0, [step[0].current for step in short_steps]),
    )
    energies = []
    for number, back_emf in enumerate(np.repeat(constant * speeds, samples)):

        def flow(_, y, u=volts[number], b=back_emf):
            return [(u - b - resistance * y[0]) / inductance, u * y[0], resistance * y[0] ** 2]

        solution = solve_ivp(
            flow, (0.0, 1 / 20e3), [starts[number], 0.0, 0.0], rtol=1e-12, atol=1e-15
        )
        energies.append(solution.y[1:, -1])
    drawn, heat = np.array(energies).reshape(5, samples, 2).sum(axis=1).T * 20e3 / samples
    watts = voltage**2 / resistance
    np.testing.assert_allclose(
        [step.electrical_power for step in long_steps], drawn, rtol=0, atol=1e-9 * watts
    )
    np.testing.assert_allclose(
        [step.copper_loss for step in long_steps], heat, rtol=0, atol=1e-9 * watts
    )
    moved = constant * speeds * [step.current for step in long_steps]
    field = np.diff(0.5 * inductance * starts[::samples] ** 2) * 20e3 / samples
    balance = [step.electrical_power - step.copper_loss for step in long_steps] - moved - field
    np.testing.assert_allclose(balance, 0.0, atol=1e-13 * watts)
    assert all(step.copper_loss >= resistance * step.current**2 for step in long_steps)


_share = st.floats(0.0, 1.0)


@example("pmg132", 40e3, 0.349, 40, [(1.0, 1.0)] * 3, 10.0)
@example("1331t", 10e3, 1.0, 1, [(0.6, 0.2), (0.4, 0.9)], 1.0)
@given(
    st.sampled_from(sorted(WINDINGS)),
    st.sampled_from(RATES),
    st.sampled_from([0.262, 0.349]) | st.floats(0.01, 1.0),
    st.integers(1, 200),
    st.lists(st.tuples(_share, _share), min_size=1, max_size=8),
    st.sampled_from([0.1, 0.5, 1.0, 2.0, 10.0]),
)
def test_the_closed_form_equals_stepping(name, rate, bandwidth, samples, commands, amplitude):
    """Compare cases from never saturated to always saturated."""
    resistance, inductance, _, voltage = WINDINGS[name]
    x = resistance / rate / inductance
    kp, ki = designed_gains(resistance, inductance, 1 / rate, bandwidth * rate)
    parameters = parameters_type(Drive)(*drive(name, rate).parameter_values)
    current, integral, stepped, volts = 0.0, 0.0, 0.0, 0.0
    for reference, back_emf in commands:
        reference, back_emf = (
            (2 * share - 1) * amplitude * voltage for share in (reference, 0.4 * back_emf)
        )
        reference /= resistance
        limits = ((sign * voltage - back_emf) / resistance for sign in (-1, 1))
        current, integral, total, drawn, _ = solve_designed_loop(
            current, integral, reference, *limits, samples, x, bandwidth, -math.expm1(-x)
        )
        winding = (samples, resistance, math.exp(-x), -math.expm1(-x) / x)
        stepped, volts, _, expected, expected_drawn, _ = run_samples(
            parameters, stepped, volts, 0.0, reference, back_emf, back_emf, *winding, kp, ki
        )
        unit = voltage / resistance * max(1.0, amplitude)
        assert abs(current - stepped) <= 1e-13 * unit
        assert abs(integral - volts / resistance) <= 1e-13 * unit
        assert abs(total - expected) <= 1e-13 * unit * samples
        assert abs(drawn - expected_drawn) <= 1e-12 * unit**2 * samples


def loop_of(actuator, gains):
    """Return python-control's open loop of the current."""
    motor, time = actuator.motor, 1 / actuator.controller.sample_rate
    kp, ki = gains
    decay = math.exp(-motor.resistance * time / motor.inductance)
    winding = control.TransferFunction([(1 - decay) / motor.resistance], [1, -decay], time)
    pi = control.TransferFunction([kp + ki, -kp], [1, -1], time)
    return (
        pi
        * winding
        * control.TransferFunction([1], [1, 0] if actuator.controller.delayed else [1], time)
    )


@every_winding
def test_the_margins_match_the_design(name):
    """Check a phase margin of about 60 degrees with the delay, and the simulated response."""
    rate = 20e3
    actuator = drive(name, rate, delayed=True)
    motor = actuator.motor
    bandwidth = 2 * math.pi * DEFAULT_BANDWIDTH * rate
    computed = loop_of(
        actuator, designed_gains(motor.resistance, motor.inductance, 1 / rate, bandwidth)
    )
    gain_margin, phase_margin, *_ = control.margin(computed)
    assert 60 < phase_margin < 70
    assert 3.2 < gain_margin < 3.6
    closed = control.feedback(computed, 1)
    for share in (0.3, 1.0, 2.0):
        omega = share * bandwidth
        times = np.arange(400) / rate
        # With one sample per step, this is a frequency sweep of the loop itself.
        torques = 1e-3 * motor.torque_constant * np.sin(omega * times)
        currents = [
            step[0].current for step in responses(actuator, 1 / rate, torques, np.zeros(400))
        ]
        late = slice(200, None)
        basis = np.stack([np.sin(omega * times[late]), np.cos(omega * times[late])], axis=1)
        real, imaginary = np.linalg.lstsq(basis, np.array(currents)[late] / 1e-3, rcond=None)[0]
        # The state is that at the end of the step, one sample ahead.
        expected = closed(np.exp(1j * omega / rate)) * np.exp(1j * omega / rate)
        assert abs(complex(real, imaginary) - expected) < 1e-6


@pytest.mark.parametrize(
    ("anti_windup", "min_delay", "max_delay"),
    [("back_calculation", 0, 1), ("clamping", 0, 3), ("none", 15, 60)],
)
def test_recovery_after_saturation_depends_on_the_anti_windup(anti_windup, min_delay, max_delay):
    """Command a current beyond the voltage at this speed for 20 ms, then a possible one."""
    resistance, _, constant, voltage = WINDINGS["qube"]
    actuator, speed = drive("qube", anti_windup=anti_windup), 0.5 * voltage / constant
    amperes = voltage / resistance * np.array([0.9] * 400 + [0.2] * 2000)
    currents = np.array(
        [
            step[0].current
            for step in responses(actuator, 1 / 20e3, constant * amperes, [speed] * 2400)
        ]
    )
    wrong = np.abs(currents[400:] / amperes[400:] - 1.0) > 0.05
    assert min_delay <= np.flatnonzero(wrong)[-1] / 20 <= max_delay  # [ms]


def test_the_gear_converts_torque_speed_inertia_and_friction():
    motor = GearMotor(
        rotor_inertia=2e-6, gear_ratio=10.0, coulomb_friction=1e-3, viscous_friction=1e-5
    )
    actuator = Drive(motor)
    assert actuator.arm_radius == 0.1
    np.testing.assert_allclose(actuator.additions, (2e-4, 1e-3, 1e-2))
    np.testing.assert_allclose(
        Drive(dataclasses.replace(motor, arm_radius=0.5)).additions, (8e-4, 4e-3, 2e-2)
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("inertia", "speed", "torque", "lost"),
    [
        (4e-6, 200.0, 0.01, 0.2 * 0.01),
        (4e-6, 200.0, -0.01, 0.25 * 0.01),
        (0.0, 200.0, 0.01, 0.2 * 0.01),
        # Near standstill friction only stops the rotor.
        (4e-6, 1e-3, 0.01, 4e-6 * 1e-3 / 0.01),
        *((inertia, 0.0, 0.01, 0.0) for inertia in (4e-6, 0.0)),
    ],
    ids=["driving", "driven", "driving and light", "nearly still", "still", "still and light"],
)
def test_a_gear_transmits_a_share_and_brakes_when_it_is_driven(inertia, speed, torque, lost, sign):
    lossy = Drive(GearMotor(gear_efficiency=0.8, rotor_inertia=inertia), supply=Supply(48.0))
    *_, (_, delivered, signals) = responses(lossy, 0.01, [sign * torque] * 5, [sign * speed] * 5)
    assert 0.042 * signals.current == pytest.approx(sign * torque, rel=1e-2)
    assert 0.042 * signals.current - delivered == pytest.approx(sign * lost, rel=1e-2, abs=1e-15)


def test_the_current_limit_holds():
    actuator = drive("qube", max_current=0.3)
    steps = responses(actuator, 0.002, [1.0, -1.0, 0.042 * 0.2], [0.0] * 3)
    assert [step[2].reference_current for step in steps] == [0.3, -0.3, pytest.approx(0.2)]
    assert [limits_of(step[2]) for step in steps] == ["current", "current", ""]
    assert abs(steps[0][0].current) <= 0.3
    assert limits_of(responses(drive("qube"), 0.002, [1.0], [0.0])[0][2]) == "voltage"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: GearMotor(gear_ratio=0),
            r"GearMotor\.gear_ratio = 0: must be a finite number > 0",
        ),
        (
            lambda: SampledLoop(anti_windup="yes"),
            r"anti_windup = 'yes': must be one of back_calculation, clamping, none",
        ),
        (
            lambda: SampledLoop(10e3, bandwidth=5e3),
            r"bandwidth = 5000: must be <= 1591.55 Hz at sample_rate = 10000",
        ),
        (lambda: Drive(supply=24.0), r"Drive\.supply = 24\.0: must be a Supply"),
        (
            lambda: Drive().check(0.00123),
            r"has 24\.6 samples, must be a whole number; the nearest valid rate is 20325",
        ),
        (
            lambda: Drive(controller=SampledLoop(kp=500.0)).check(0.002),
            r"spectral radius .* Lower controller\.kp = 500",
        ),
        (lambda: Drive(supply=Supply(24.0, 1e4)).check(0.002), r"lower supply\.resistance"),
    ],
)
def test_raises_if_a_field_is_invalid(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_motor_is_made_from_a_datasheet():
    motor = GearMotor.from_datasheet(
        resistance="0.464 ohm",
        inductance="0.322 mH",
        torque_constant="25.1 mN*m/A",
        rotor_inertia="135 g*cm^2",
    )
    assert dataclasses.astuple(motor)[:5] == pytest.approx(
        (0.464, 0.322e-3, 0.0251, 0.0251, 1.35e-5), rel=1e-12
    )


# Name: gear ratio, rotor inertia, and a light load [kg*m^2]: with it, the speed cannot be held for
# 20 ms.
STIFF = {
    "dcx22l": (35.0, 9.37e-7, 2e-3),
    "ak80-6": (6.0, 6.07e-5, 2e-2),
    "1331t": (43.0, 0.71e-7, 2e-4),
}


def stiff(name, load_inertia):
    """Return a motor with a specified load inertia [kg*m^2]; 0 means that of the model."""
    resistance, inductance, constant, voltage = WINDINGS[name]
    ratio, inertia, _ = STIFF[name]
    motor = GearMotor(
        resistance,
        inductance,
        constant,
        constant,
        inertia,
        gear_ratio=ratio,
        load_inertia=load_inertia,
    )
    return Drive(motor, SampledLoop(20e3), Supply(voltage))


def links(name, timestep, count):
    """Return the spec of links at each other's ends, all as light as `STIFF` says for a motor."""
    spec = mujoco.MjSpec()
    spec.option.timestep, body = timestep, spec.worldbody
    for link in range(count):
        body = body.add_body(pos=[0.0, 0.0, -0.12 * link])
        body.explicitinertial, body.mass, body.inertia = True, 0.05, [STIFF[name][2] / count] * 3
        body.add_joint(name=f"joint{link}", axis=[0.0, 1.0, 0.0])
        actuator = spec.add_actuator(
            name=f"a{link}", target=f"joint{link}", trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        actuator.set_to_motor()
    return spec


def chain(name, timestep, loads, allow_unstable=False):
    """Return a compiled model of links whose motors have different load inertias."""
    actuators = {
        f"joint{link}": stiff(name, load_inertia) for link, load_inertia in enumerate(loads)
    }
    return codrl_mj.add_motors(
        links(name, timestep, len(loads)), actuators, allow_unstable
    ).compile()


def reversals(name, timestep, loads, allow_unstable=False):
    """Return the links' speeds [rad/s] under alternating commands, and the no-load speed."""
    resistance, _, constant, voltage = WINDINGS[name]
    ratio = STIFF[name][0]
    model = chain(name, timestep, loads, allow_unstable)
    data, speeds = mujoco.MjData(model), []
    for step in range(round(1.0 / timestep)):
        data.ctrl[:] = (
            (-1) ** int((step + 0.5) * timestep / 0.2)
            * 0.9
            * constant
            * ratio
            * voltage
            / resistance
        )
        mujoco.mj_step(model, data)
        speeds.append(data.qvel.copy())
    return np.array(speeds), voltage / (constant * ratio)


@pytest.mark.filterwarnings("ignore:motor.rotor_inertia")
@pytest.mark.parametrize("name", STIFF)
@pytest.mark.parametrize("is_specified", [False, True], ids=["by the model", "specified"])
def test_a_light_load_moves_as_in_short_steps(name, is_specified):
    load = STIFF[name][2] if is_specified else 0.0
    reference, fastest = reversals(name, 5e-5, [math.inf])
    held, _ = reversals(name, 0.02, [math.inf], allow_unstable=True)
    assert np.abs(held - reference[399::400]).mean() > 0.04 * fastest
    for timestep in (0.002, 0.01, 0.02):
        every = round(timestep / 5e-5)
        followed, _ = reversals(name, timestep, [load])
        assert np.abs(followed - reference[every - 1 :: every]).mean() < 0.02 * fastest


@pytest.mark.filterwarnings("ignore:motor.rotor_inertia")
@pytest.mark.parametrize("name", STIFF)
def test_an_arm_of_two_light_links_is_bounded_at_20_ms_and_accurate_at_2_ms(name):
    reference, fastest = reversals(name, 5e-5, [math.inf] * 2)
    followed, _ = reversals(name, 0.02, [0.0] * 2)
    assert np.abs(followed).max() < 2.0 * fastest
    assert np.abs(followed - reference[399::400]).mean() < 0.25 * fastest
    quick, _ = reversals(name, 0.002, [0.0] * 2)
    assert np.abs(quick - reference[39::40]).mean() < 0.02 * fastest


def test_raises_if_a_held_speed_is_unstable_and_warns_if_it_is_inaccurate():
    with pytest.raises(
        ValueError, match=r"^a0: .*by 2\.\d+ times its value.* leave motor.load_inertia 0"
    ):
        chain("dcx22l", 0.02, [math.inf])
    with pytest.warns(UserWarning, match=r"above 0\.5 the speed is inaccurate"):
        chain("1331t", 0.02, [math.inf])
    with pytest.warns(
        UserWarning, match=r"is 22\.4 times the time in which .* as many steps: shorten the step"
    ):
        chain("dcx22l", 0.2, [0.0])
    light = dataclasses.replace(
        Drive(), motor=GearMotor(rotor_inertia=0.0), controller=SampledLoop(500.0)
    )
    with pytest.raises(ValueError, match=r"raise controller\.sample_rate"):
        light.check_shaft(0.002, 1e-7)


def test_the_analytic_physics_checks_the_speed_held_over_a_step():
    """Check that MuJoCo predicts the speed within a step, while Gymnasium's equations hold it."""
    drive = Drive(
        GearMotor(0.315, 0.4e-3, 0.0203, 0.0203, 0.0, gear_ratio=120.0),
        SampledLoop(20e3),
        Supply(24.0),
    )
    # The rod's inertia is 1/3 kg*m^2.
    assert 0.05 * 120**2 * 0.0203**2 / (0.315 / 3) > 2
    codrl_mj.make("pendulum", drive, inner_steps=1).close()
    with pytest.raises(
        ValueError, match=r"speed is held for .*, must be < 2; .*, shorten the step"
    ):
        codrl_mj.make("pendulum", drive, inner_steps=1, physics="analytic")


def test_drives_on_the_same_joint_are_checked_together():
    """Check the sum: no drive reacts to the others within a step."""
    spec = links("dcx22l", 0.02, 1)
    spec.add_actuator(name="b", target="joint0", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_motor()
    motor = stiff("dcx22l", 0.0)
    codrl_mj.add_motors(spec, {"a0": motor})
    with pytest.raises(ValueError, match=r"held for 0\.02 s, .*, must be < 2; shorten the step"):
        codrl_mj.add_motors(spec, {"a0": motor, "b": motor})


def test_a_drive_forgets_its_estimate_while_it_is_switched_off():
    """Check that the motion in the meantime is not taken for an external acceleration."""
    model = chain("dcx22l", 0.01, [0.0])
    data, cleared = mujoco.MjData(model), mujoco.MjData(model)
    model.opt.disableactuator = 1
    data.qvel[:] = 5.0
    for _ in range(20):
        mujoco.mj_step(model, data)
    model.opt.disableactuator = 0
    cleared.qpos[:], cleared.qvel[:], cleared.time = data.qpos, data.qvel, data.time
    codrl_mj.engine.clear_motors(cleared)
    for each in (data, cleared):
        each.ctrl[:] = 0.3
        mujoco.mj_step(model, each)
    np.testing.assert_array_equal(data.qvel, cleared.qvel)
    np.testing.assert_array_equal(data.actuator_force, cleared.actuator_force)


def test_a_winding_much_faster_than_the_samples_has_finite_gains():
    """Check a case in which exp(R*T/L) overflows."""
    quick = Drive(
        GearMotor(resistance=20.0, inductance=1e-5), SampledLoop(1e3, delayed=True), Supply(24.0)
    )
    assert quick.check(0.002) is None
    state, *_ = responses(quick, 0.002, [0.042 * 0.5] * 200, [0.0] * 200)[-1]
    assert state.current == pytest.approx(0.5)
