"""Fits of known motors, and parameters that their logs cannot determine."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from codrl_mj.identify import Log, identify, uncertainty
from codrl_mj.identify.estimate import Fit
from codrl_mj.identify.identify import separate_logs
from codrl_mj.identify.log import has_motion, replace_signal
from tests.identify import bench, draws

WINDING = {"resistance": bench.RESISTANCE, "inductance": bench.INDUCTANCE}
MOTOR = {**WINDING, "back_emf_constant": bench.CONSTANT, "inertia": bench.INERTIA}
PENDULUM = {"inertia": 0.19, "mgl": 3.6, "coulomb_friction": 0.15}


def assert_near(result, truth, max_error=np.inf):
    """Assert that intervals contain the true values, and that relative errors are limited."""
    for name, value in truth.items():
        assert result[name].low <= value <= result[name].high, result[name]
        assert abs(result[name].value - value) < max_error * value or max_error == np.inf, result[
            name
        ]


def statuses(result, names=None):
    """Return the set of statuses of some or all parameters."""
    return {
        estimate.status for estimate in result.estimates if names is None or estimate.name in names
    }


@pytest.fixture(scope="module")
def motor():
    return identify([bench.motor_log(step=2.0 * np.pi / 4096)], "free", {"load_inertia": 0.0})


def test_a_motor_is_identified_from_voltage_current_and_position(motor):
    assert statuses(motor, {*MOTOR, "rotor_inertia", "torque_constant"}) == {"identified"}
    for name, max_error in zip(MOTOR, (0.02, 0.1, 0.02, 0.05), strict=True):
        assert_near(motor, {name: MOTOR[name]}, max_error)
    assert motor["rotor_inertia"].value == pytest.approx(motor["inertia"].value)


def test_the_sum_of_friction_is_identified_while_its_kinds_are_rough(motor):
    """All friction is viscous, but 2 s of a log do not distinguish it from Coulomb friction."""
    coulomb, viscous, total = (
        motor[name] for name in ("coulomb_friction", "viscous_friction", "friction_torque")
    )
    assert total.status == "identified"
    speed = (total.value - coulomb.value) / viscous.value
    assert total.low <= bench.VISCOUS * speed <= total.high < 1.1 * total.value
    assert coulomb.status == viscous.status == "rough"
    assert viscous.high > 1.1 * viscous.value
    assert motor.actuator().motor.viscous_friction == viscous.value
    assert motor.intervals()["motor.viscous_friction"] == (viscous.low, viscous.high)
    assert_near(motor, {"coulomb_friction": 0.0, "viscous_friction": bench.VISCOUS})


def test_a_locked_rotor_shows_only_resistance_and_inductance():
    result = identify([bench.motor_log("locked", duration=2.5)])
    assert [estimate.name for estimate in result.estimates] == list(WINDING)
    assert_near(result, WINDING, 0.02)
    assert "back_emf_constant" in result.problem() or "torque_constant" in result.problem()


def test_a_slow_sine_does_not_show_the_inductance():
    result = identify([bench.motor_log("sine", rate=1000)], "free")
    assert result["inductance"].status in ("unidentifiable", "refused")
    assert result["resistance"].status == result["back_emf_constant"].status == "identified"
    assert result["resistance"].value == pytest.approx(bench.RESISTANCE, rel=0.02)
    assert "--known inductance" in result.problem()


@pytest.mark.matrix
@pytest.mark.parametrize("rows", [1, 6])
def test_a_delay_of_the_voltage_is_identified(rows):
    """The delay is removed before the fit at half the rate, which then agrees."""
    log = bench.motor_log("locked", duration=2.5)
    # The voltage is logged some rows too early.
    late = np.append(log.signals["voltage"][rows:], np.zeros(rows))
    result = identify([replace_signal(log, "voltage", late)])
    assert result.delays["winding"] == rows
    assert statuses(result, WINDING) == {"identified"}
    assert result["inductance"].value == pytest.approx(bench.INDUCTANCE, rel=0.02)
    assert result["resistance"].causes["half_rate"] < 1e-3 * bench.RESISTANCE


def held_log(rows):
    """Return an exact log of a locked winding under a voltage that is held for rows of 1 ms."""
    random, decay = np.random.default_rng(0), np.exp(-bench.RESISTANCE / bench.INDUCTANCE * 1e-3)
    volts, current = 3.0 * np.repeat(random.choice([-1.0, 1.0], 3000 // rows), rows), np.zeros(3000)
    for row in range(2999):
        current[row + 1] = volts[row] / bench.RESISTANCE * (1.0 - decay) + decay * current[row]
    current += 0.02 * random.standard_normal(3000)
    return Log("held", 1e-3 * np.arange(3000), {"voltage": volts, "current": current})


def test_a_voltage_held_until_the_next_row_counts_as_a_mean():
    """The voltage changes at every third row, so that pairs of rows may have two voltages."""
    result = identify([held_log(3)])
    assert result.delays["winding"] == 0
    assert result["resistance"].status == "identified"
    assert result["resistance"].value == pytest.approx(bench.RESISTANCE, rel=0.005)


@pytest.mark.matrix
def test_an_instantaneous_voltage_is_delayed_by_half_a_row():
    result = identify([bench.motor_log("locked", duration=2.5, mean=False, clock=1.65e-3)])
    assert result.delays["winding"] == -0.5
    assert_near(result, WINDING)


def test_outliers_and_dropped_rows_do_not_bias_the_fit():
    log, random = bench.motor_log("locked", duration=1.5), np.random.default_rng(1)
    signals = {**log.signals, "current": log.signals["current"].copy()}
    signals["current"][random.choice(len(log.time), 35, replace=False)] += 40.0
    rows = np.sort(random.choice(len(log.time), round(0.95 * len(log.time)), replace=False))
    result = identify(
        [Log("spoilt", log.time[rows], {name: values[rows] for name, values in signals.items()})]
    )
    assert result["resistance"].value == pytest.approx(bench.RESISTANCE, rel=0.02)
    assert result["inductance"].value == pytest.approx(bench.INDUCTANCE, rel=0.1)


@pytest.fixture(scope="module")
def swings():
    return [bench.mujoco_pendulum(0, 6.0), bench.mujoco_pendulum(1, 3.0)]


def test_mujocos_pendulum_is_identified(swings):
    first, second = swings
    copy = dataclasses.replace(first, name="copy", time=first.time + 3.0)
    result = identify([first, copy, second], "pendulum", friction="auto", held_out=[second])
    assert_near(result, PENDULUM, 0.05)
    assert_near(result, {"viscous_friction": 0.01})
    assert statuses(result) == {"identified"}
    assert result.held_out[0].open_loop < 0.01
    assert [log.log for log in result.fitted] == ["swing0"]
    assert result.warnings == (
        "log copy is there twice, as swing0: it counts once",
        "log swing1 is held out: it is only predicted, not fitted",
    )
    assert result.friction == "coulomb"
    assert "needs 3 logs that move, and there is 1" in result.friction_reason


@pytest.mark.matrix
def test_the_friction_with_the_best_predictions_is_chosen_and_reported():
    """Three logs are from a gear that loses a third of the torque, three from a lossless gear."""
    logs = [bench.geared_pendulum(0.67, seed) for seed in range(3)]
    result = identify(logs, "pendulum", friction="auto")
    assert result.friction == "load"
    assert result.friction_reason.startswith(
        "friction: load, by the mean errors on the logs left out [rad]: coulomb"
    )
    assert_near(result, {"gear_efficiency": 0.67}, 0.1)
    plain = identify(
        [bench.mujoco_pendulum(seed, 3.0) for seed in range(3)], "pendulum", friction="auto"
    )
    assert plain.friction == "coulomb"
    assert "load" in plain.friction_reason


@pytest.mark.parametrize(
    ("fitted", "held_out", "expected"),
    [
        ("aba", "", ("ab", "")),
        ("abc", "c", ("ab", "c")),
        ("ab", "cc", ("ab", "c")),
        ("ab", "c", ("ab", "c")),
    ],
)
def test_duplicate_logs_count_once_with_any_name(fitted, held_out, expected):
    """Copies have other names, and their time may begin at another value."""
    time = np.arange(50) * 1e-2
    values = {name: np.random.default_rng(seed).normal(size=50) for seed, name in enumerate("abc")}

    def logs(names):
        return [
            Log(f"{name}{k}", time + k, {"current": values[name]}) for k, name in enumerate(names)
        ]

    to_fit, predicted, notes = separate_logs(logs(fitted), logs(held_out))
    assert tuple("".join(log.name[0] for log in group) for group in (to_fit, predicted)) == expected
    assert len(notes) == len(fitted + held_out) - len("".join(expected))


def test_raises_if_all_logs_are_held_out(swings):
    with pytest.raises(ValueError, match="swing0, swing1: all of them are also held out"):
        identify(swings, "pendulum", held_out=swings)


def test_a_free_swing_with_known_weight_determines_the_inertia():
    """The swing is from scipy without torque: mgl/J is 64.1 1/s^2, and damping/J is 0.3 1/s."""
    time = np.arange(0.0, 3.0, 2e-3)
    swing = solve_ivp(
        lambda _, y: (y[1], -64.1 * np.sin(y[0]) - 0.3 * y[1]),
        (0.0, 3.0),
        (1.0, 0.0),
        "RK45",
        time,
        rtol=1e-9,
    )
    signals = {"position": np.round(swing.y[0] / 1e-3) * 1e-3, "torque": np.zeros(len(time))}
    result = identify([Log("free", time, signals, {"position": 1e-3})], "pendulum", {"mgl": 3.6})
    assert_near(result, {"inertia": 3.6 / 64.1, "viscous_friction": 0.3 * 3.6 / 64.1}, 0.02)
    assert result["inertia"].status == "identified"


@pytest.mark.matrix
def test_without_a_known_mass_the_torque_gain_is_only_a_ratio(swings):
    result = identify(swings[:1], "pendulum", estimated=["torque_gain"])
    assert statuses(result, {"torque_gain", "inertia", "mgl"}) == {"ratio"}
    assert "inertia by" in result["torque_gain"].why


@pytest.mark.matrix
def test_with_a_known_mass_the_torque_gain_is_identified(swings):
    gain, log = 1.25, swings[0]
    result = identify(
        [replace_signal(log, "torque", log.signals["torque"] / gain)],
        "pendulum",
        {"mgl": 3.6},
        estimated=["torque_gain"],
    )
    assert result["torque_gain"].status == "identified"
    assert result["torque_gain"].value == pytest.approx(gain, rel=0.02)


@pytest.mark.matrix
def test_a_velocity_alone_is_enough():
    """The log begins where the pendulum hangs; the velocity has steps of 0.02 rad/s."""
    log = bench.mujoco_pendulum(1, 6.0, step=1e-9)
    velocity = np.round(np.gradient(log.signals["position"], log.time) / 0.02) * 0.02
    result = identify(
        [Log("b", log.time, {"velocity": velocity, "torque": log.signals["torque"]})], "pendulum"
    )
    assert statuses(result) <= {"identified", "rough"}
    assert_near(result, PENDULUM, 0.02)


def test_noise_of_a_velocity_is_no_motion(swings):
    time, random = swings[0].time, np.random.default_rng(0)
    assert not has_motion(
        Log("held", time, {"velocity": np.round(random.standard_normal(len(time)))})
    )
    assert has_motion(
        Log("turned", time, {"velocity": np.gradient(swings[0].signals["position"], time)})
    )
    assert not has_motion(Log("nothing", time, {"torque": swings[0].signals["torque"]}))


@pytest.mark.matrix
def test_an_additional_torque_does_not_change_the_winding():
    log = bench.motor_log(step=2.0 * np.pi / 4096)
    result = identify(
        [replace_signal(log, "torque", bench.CONSTANT * log.signals["current"])], "free"
    )
    assert result["torque_constant"].why == "taken as the back-EMF constant"
    assert_near(result, {"resistance": bench.RESISTANCE, "back_emf_constant": bench.CONSTANT})
    assert_near(result, {"inductance": bench.INDUCTANCE}, 0.01)


@pytest.mark.matrix
def test_a_torque_constant_that_differs_from_the_back_emf_constant_needs_a_known_mass():
    """The current is 0.8 times the torque, and the back-EMF equals the speed: kT = 1.25, kE = 1."""
    log = bench.mujoco_pendulum(0, 6.0)
    torque, speed = log.signals["torque"], np.gradient(log.signals["position"], log.time)
    current = torque / 1.25
    volts = 2.0 * current + speed + 1e-3 * np.gradient(current, log.time)
    signals = {"position": log.signals["position"], "current": current, "voltage": volts}
    log_under_voltage = Log("b", log.time, signals, log.resolution)
    result = identify([log_under_voltage], "pendulum", {"mgl": 3.6}, estimated=["torque_constant"])
    assert result["torque_constant"].value == pytest.approx(1.25, rel=0.01)
    assert result["back_emf_constant"].value == pytest.approx(1.0, rel=0.02)


@pytest.mark.matrix
def test_an_efficiency_below_its_bound_is_refused():
    log = bench.geared_pendulum(0.2)
    assert identify([log], "pendulum", friction="load")["gear_efficiency"].status == "refused"


@pytest.mark.parametrize("draw", [5, 6, 9])
def test_the_interval_covers_the_bias_by_a_voltage_that_changes_between_rows(draw):
    """The bias at 1 kHz is 3 to 5 % for L/R of 0.3 to 1 ms; no fit of fewer rows shows it."""
    log, truth = draws.make_log(draw, "locked_prbs", 1000.0), draws.random_motor(draw).resistance
    result = identify([log])["resistance"]
    assert result.value > 1.02 * truth
    assert result.low < truth < result.high
    share = result.high / result.value - 1.0
    assert result.status == (
        "identified" if share <= 0.05 else "rough" if share <= 0.3 else "refused"
    )


def test_a_shaft_under_a_voltage_can_estimate_the_back_emf_constant():
    motor, log = (
        draws.random_motor(3),
        draws.select_signals(draws.make_log(3), "voltage", "position"),
    )
    names = "resistance", "torque_constant", "coulomb_friction", "viscous_friction"
    known = {name: getattr(motor, name) for name in names}
    result = identify([log], "free", known, estimated=["back_emf_constant"])["back_emf_constant"]
    assert result.status == "identified"
    assert result.value == pytest.approx(motor.back_emf_constant, rel=1e-3)


def test_half_widths_are_accurate_for_very_different_standard_errors():
    """Two independent parameters have standard errors of 1e-6 and 0.05."""
    random, rows = np.random.default_rng(0), 1000
    jacobian = np.zeros((2 * rows, 2))
    jacobian[:rows, 0], jacobian[rows:, 1] = 1e6 / np.sqrt(rows), 20.0 / np.sqrt(rows)
    residuals = random.standard_normal(2 * rows)
    segment = SimpleNamespace(block=0, log=0)
    fit = Fit(
        SimpleNamespace(names=("a", "b")),
        (segment,),
        np.ones(2),
        1e9,
        (residuals,),
        (jacobian,),
        (np.zeros(1),),
    )
    result = uncertainty.resampled_half_widths(fit, np.ones(2), np.eye(2), 0)["curvature"]
    np.testing.assert_allclose(result, [1.96e-6, 1.96 * 0.05], rtol=0.05)


@pytest.mark.matrix
def test_a_voltage_without_current_determines_only_a_ratio_of_constants(swings):
    """With V = torque and no back-EMF, a motor with kT = kE = k has k/R = 1 at any k."""
    log = swings[0]
    signals = {"position": log.signals["position"], "voltage": log.signals["torque"]}
    log_under_voltage = Log(log.name, log.time, signals, log.resolution)
    result = identify([log_under_voltage], "pendulum", {"mgl": 3.6})
    assert statuses(result, {"torque_constant", "resistance"}) <= {"ratio", "refused"}
    assert result["torque_constant"].value / result["resistance"].value == pytest.approx(
        1.0, rel=0.05
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "pendulum, free or load"),
        ({"known": {"mgl": -1.0}}, r"mgl = -1.0: must be from 0"),
        ({"rig": "pendulum", "known": {"inertja": 1.0}}, r"did you mean known\.inertia"),
        ({"rig": "pendulum", "known": {"friction_torque": 1.0}}, r"known\.friction_torque"),
        (
            {"rig": "pendulum", "estimated": ["rotor_inertia"]},
            r"shaft driven by a torque estimated\.rotor_inertia",
        ),
        (
            {"rig": "pendulum", "known": {"mgl": 3.6}, "estimated": ["mgl"]},
            "mgl: must not be both known and estimated",
        ),
        ({"rig": "pendulum", "segment": 0.0}, r"segment = 0.0: must be >= 0.05"),
        ({"logs": [], "rig": "free"}, "none was given"),
        ({"logs": ["still"], "rig": "free"}, "nothing can be identified"),
        ({"logs": ["slow"], "rig": "pendulum"}, r"a row every 0.1 s, must be at most 0.05 s"),
        (
            {"logs": ["swing0", "velocity"], "rig": "pendulum"},
            r"different motions \(swing0: position; velocity: velocity\)",
        ),
    ],
)
def test_invalid_input_raises_an_error_with_a_remedy(swings, arguments, message):
    log, *_ = swings
    position, torque = log.signals["position"], log.signals["torque"]
    logs = {
        "swing0": log,
        "still": Log("still", log.time, {"position": position}),
        "slow": log.slice_rows(slice(None, None, 50)),
        "velocity": Log("velocity", log.time, {"velocity": position, "torque": torque}),
    }
    with pytest.raises(ValueError, match=message):
        identify(**arguments | {"logs": [logs[name] for name in arguments.get("logs", ["swing0"])]})


@pytest.mark.matrix
def test_intervals_contain_the_truth_in_nineteen_of_twenty_draws():
    counts = dict.fromkeys(WINDING, 0)
    for seed in range(20):
        result = identify([bench.motor_log("locked", 2000, 2.5, seed=seed)], seed=seed)
        assert statuses(result, WINDING) == {"identified"}
        for name, value in WINDING.items():
            counts[name] += result[name].low <= value <= result[name].high
    assert min(counts.values()) >= 19


@pytest.mark.matrix
def test_random_friction_is_identified_within_five_percent():
    random = np.random.default_rng(2)
    for seed in range(3):
        coulomb, viscous = random.uniform(0.05, 0.3), random.uniform(0.01, 0.05)
        logs = [
            bench.mujoco_pendulum(2 * seed + offset, 6.0, coulomb, viscous) for offset in (0, 1)
        ]
        assert_near(
            identify(logs, "pendulum"),
            {"coulomb_friction": coulomb, "viscous_friction": viscous},
            0.05,
        )
