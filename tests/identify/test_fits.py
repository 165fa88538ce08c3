"""Fits of motors that are known, and what cannot be told of them."""

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
SWUNG = {"inertia": 0.19, "mgl": 3.6, "coulomb_friction": 0.15}


def near(found, truth, most=np.inf):
    """Each of these is within its interval, and off by less than a share of itself."""
    for name, value in truth.items():
        assert found[name].low <= value <= found[name].high, found[name]
        assert abs(found[name].value - value) < most * value or most == np.inf, found[name]


def statuses(found, names=None):
    return {one.status for one in found.estimates if names is None or one.name in names}


@pytest.fixture(scope="module")
def motor():
    return identify([bench.motor_log(step=2.0 * np.pi / 4096)], "free", {"load_inertia": 0.0})


def test_a_motor_is_identified_from_voltage_current_and_position(motor):
    assert statuses(motor, {*MOTOR, "rotor_inertia", "torque_constant"}) == {"identified"}
    for name, most in zip(MOTOR, (0.02, 0.1, 0.02, 0.05), strict=True):
        near(motor, {name: MOTOR[name]}, most)
    assert motor["rotor_inertia"].value == pytest.approx(motor["inertia"].value)


def test_friction_is_known_as_a_whole_where_its_parts_are_rough_and_can_be_trained_with(motor):
    """All of it is viscous, and 2 s of one log do not tell it from Coulomb friction."""
    coulomb, viscous, whole = (
        motor[name] for name in ("coulomb_friction", "viscous_friction", "friction_torque")
    )
    assert whole.status == "identified"
    speed = (whole.value - coulomb.value) / viscous.value
    assert whole.low <= bench.VISCOUS * speed <= whole.high < 1.1 * whole.value
    assert coulomb.status == viscous.status == "rough"
    assert viscous.high > 1.1 * viscous.value
    assert motor.actuator().motor.viscous_friction == viscous.value
    assert motor.intervals()["motor.viscous_friction"] == (viscous.low, viscous.high)
    near(motor, {"coulomb_friction": 0.0, "viscous_friction": bench.VISCOUS})


def test_a_locked_rotor_tells_resistance_and_inductance_and_nothing_else():
    found = identify([bench.motor_log("locked", duration=2.5)])
    assert [one.name for one in found.estimates] == list(WINDING)
    near(found, WINDING, 0.02)
    assert "back_emf_constant" in found.problem() or "torque_constant" in found.problem()


def test_a_slow_sine_tells_no_inductance():
    found = identify([bench.motor_log("sine", rate=1000)], "free")
    assert found["inductance"].status in ("unidentifiable", "refused")
    assert found["resistance"].status == found["back_emf_constant"].status == "identified"
    assert found["resistance"].value == pytest.approx(bench.RESISTANCE, rel=0.02)
    assert "--known inductance" in found.problem()


@pytest.mark.matrix
@pytest.mark.parametrize("rows", [1, 6])
def test_a_late_voltage_is_found_late(rows):
    """And half the rate is that of the voltage in time: no cause of doubt."""
    log = bench.motor_log("locked", duration=2.5)
    late = np.append(
        log.signals["voltage"][rows:], np.zeros(rows)
    )  # the log's voltage comes some rows early
    found = identify([replace_signal(log, "voltage", late)])
    assert found.delays["winding"] == rows
    assert statuses(found, WINDING) == {"identified"}
    assert found["inductance"].value == pytest.approx(bench.INDUCTANCE, rel=0.02)
    assert found["resistance"].causes["half_rate"] < 1e-3 * bench.RESISTANCE


def held_log(rows):
    """A locked winding under a voltage that holds for some rows of 1 ms, exactly."""
    random, decay = np.random.default_rng(0), np.exp(-bench.RESISTANCE / bench.INDUCTANCE * 1e-3)
    volts, current = 3.0 * np.repeat(random.choice([-1.0, 1.0], 3000 // rows), rows), np.zeros(3000)
    for row in range(2999):
        current[row + 1] = volts[row] / bench.RESISTANCE * (1.0 - decay) + decay * current[row]
    current += 0.02 * random.standard_normal(3000)
    return Log("held", 1e-3 * np.arange(3000), {"voltage": volts, "current": current})


def test_a_voltage_that_holds_until_the_next_row_is_its_mean_too():
    """It changes at every third row, so that of every second row some have two voltages."""
    found = identify([held_log(3)])
    assert found.delays["winding"] == 0
    assert found["resistance"].status == "identified"
    assert found["resistance"].value == pytest.approx(bench.RESISTANCE, rel=0.005)


@pytest.mark.matrix
def test_a_voltage_of_the_rows_times_is_found_to_be_half_a_row_late():
    found = identify([bench.motor_log("locked", duration=2.5, mean=False, clock=1.65e-3)])
    assert found.delays["winding"] == -0.5
    near(found, WINDING)


def test_outliers_and_dropped_rows_do_no_harm():
    log, random = bench.motor_log("locked", duration=1.5), np.random.default_rng(1)
    signals = {**log.signals, "current": log.signals["current"].copy()}
    signals["current"][random.choice(len(log.time), 35, replace=False)] += 40.0
    kept = np.sort(random.choice(len(log.time), round(0.95 * len(log.time)), replace=False))
    found = identify(
        [Log("spoilt", log.time[kept], {name: one[kept] for name, one in signals.items()})]
    )
    assert found["resistance"].value == pytest.approx(bench.RESISTANCE, rel=0.02)
    assert found["inductance"].value == pytest.approx(bench.INDUCTANCE, rel=0.1)


@pytest.fixture(scope="module")
def swings():
    return [bench.mujoco_pendulum(0, 6.0), bench.mujoco_pendulum(1, 3.0)]


def test_mujocos_pendulum_is_identified(swings):
    one, other = swings
    copy = dataclasses.replace(one, name="copy", time=one.time + 3.0)
    found = identify([one, copy, other], "pendulum", friction="auto", held_out=[other])
    near(found, SWUNG, 0.05)
    near(found, {"viscous_friction": 0.01})
    assert statuses(found) == {"identified"}
    assert found.held_out[0].open_loop < 0.01
    assert [log.log for log in found.fitted] == ["swing0"]
    assert found.warnings == (
        "log copy is there twice, as swing0: it counts once",
        "log swing1 is held out: it is only predicted, not fitted",
    )
    assert found.friction == "coulomb"
    assert "needs 3 logs that move, and there is 1" in found.friction_reason


@pytest.mark.matrix
def test_the_friction_that_predicts_best_is_chosen_and_is_said():
    """By three pendulums behind a gear that loses a third of the torque, and three that lose nothing."""
    logs = [bench.geared_pendulum(0.67, seed) for seed in range(3)]
    found = identify(logs, "pendulum", friction="auto")
    assert found.friction == "load"
    assert found.friction_reason.startswith(
        "friction: load, by the mean errors on the logs left out [rad]: coulomb"
    )
    near(found, {"gear_efficiency": 0.67}, 0.1)
    plain = identify(
        [bench.mujoco_pendulum(seed, 3.0) for seed in range(3)], "pendulum", friction="auto"
    )
    assert plain.friction == "coulomb"
    assert "load" in plain.friction_reason


@pytest.mark.parametrize(
    ("fitted", "held_out", "left"),
    [
        ("aba", "", ("ab", "")),
        ("abc", "c", ("ab", "c")),
        ("ab", "cc", ("ab", "c")),
        ("ab", "c", ("ab", "c")),
    ],
)
def test_each_measurement_counts_once_whatever_its_name(fitted, held_out, left):
    """Copies have other names, and a copy's time may begin elsewhere; one log more or less is another measurement."""
    time = np.arange(50) * 1e-2
    values = {
        name: np.random.default_rng(place).normal(size=50) for place, name in enumerate("abc")
    }

    def logs(names):
        return [
            Log(f"{name}{k}", time + k, {"current": values[name]}) for k, name in enumerate(names)
        ]

    kept, predicted, said = separate_logs(logs(fitted), logs(held_out))
    assert tuple("".join(log.name[0] for log in several) for several in (kept, predicted)) == left
    assert len(said) == len(fitted + held_out) - len("".join(left))


def test_logs_that_are_all_held_out_are_refused(swings):
    with pytest.raises(ValueError, match="swing0, swing1: all are held out, too"):
        identify(swings, "pendulum", held_out=swings)


def test_a_free_swing_of_a_known_weight_tells_its_inertia():
    """Without any torque, by scipy: mgl/J is 64.1 1/s^2, and the damping 0.3 1/s of J."""
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
    found = identify([Log("free", time, signals, {"position": 1e-3})], "pendulum", {"mgl": 3.6})
    near(found, {"inertia": 3.6 / 64.1, "viscous_friction": 0.3 * 3.6 / 64.1}, 0.02)
    assert found["inertia"].status == "identified"


@pytest.mark.matrix
def test_without_a_known_mass_a_torques_gain_is_not_told_apart(swings):
    found = identify(swings[:1], "pendulum", estimated=["torque_gain"])
    assert statuses(found, {"torque_gain", "inertia", "mgl"}) == {"ratio"}
    assert "inertia by" in found["torque_gain"].why


@pytest.mark.matrix
def test_with_a_known_mass_a_torques_gain_is_found(swings):
    gain, log = 1.25, swings[0]
    told = identify(
        [replace_signal(log, "torque", log.signals["torque"] / gain)],
        "pendulum",
        {"mgl": 3.6},
        estimated=["torque_gain"],
    )
    assert told["torque_gain"].status == "identified"
    assert told["torque_gain"].value == pytest.approx(gain, rel=0.02)


@pytest.mark.matrix
def test_a_velocity_alone_is_enough():
    """Of a log that begins where the pendulum hangs; steps of 0.02 rad/s."""
    log = bench.mujoco_pendulum(1, 6.0, step=1e-9)
    velocity = np.round(np.gradient(log.signals["position"], log.time) / 0.02) * 0.02
    found = identify(
        [Log("b", log.time, {"velocity": velocity, "torque": log.signals["torque"]})], "pendulum"
    )
    assert statuses(found) <= {"identified", "rough"}
    near(found, SWUNG, 0.02)


def test_noise_of_a_velocity_is_no_motion(swings):
    time, random = swings[0].time, np.random.default_rng(0)
    assert not has_motion(Log("held", time, {"velocity": np.round(random.standard_normal(len(time)))}))
    assert has_motion(
        Log("turned", time, {"velocity": np.gradient(swings[0].signals["position"], time)})
    )
    assert not has_motion(Log("nothing", time, {"torque": swings[0].signals["torque"]}))


@pytest.mark.matrix
def test_a_torque_that_is_logged_too_changes_nothing_of_the_winding():
    log = bench.motor_log(step=2.0 * np.pi / 4096)
    found = identify([replace_signal(log, "torque", bench.CONSTANT * log.signals["current"])], "free")
    assert found["torque_constant"].why == "taken as the back-EMF constant"
    near(found, {"resistance": bench.RESISTANCE, "back_emf_constant": bench.CONSTANT})
    near(found, {"inductance": bench.INDUCTANCE}, 0.01)


@pytest.mark.matrix
def test_a_torque_constant_beside_another_back_emf_constant_is_found_with_a_known_mass():
    """Of a current of 0.8 times what the torque is, whose voltage says 1: kT is 1.25 and kE 1."""
    log = bench.mujoco_pendulum(0, 6.0)
    torque, speed = log.signals["torque"], np.gradient(log.signals["position"], log.time)
    current = torque / 1.25
    volts = 2.0 * current + speed + 1e-3 * np.gradient(current, log.time)
    signals = {"position": log.signals["position"], "current": current, "voltage": volts}
    driven = Log("b", log.time, signals, log.resolution)
    found = identify([driven], "pendulum", {"mgl": 3.6}, estimated=["torque_constant"])
    assert found["torque_constant"].value == pytest.approx(1.25, rel=0.01)
    assert found["back_emf_constant"].value == pytest.approx(1.0, rel=0.02)


@pytest.mark.matrix
def test_a_gear_that_is_worse_than_its_bound_is_refused():
    log = bench.geared_pendulum(0.2)
    assert identify([log], "pendulum", friction="load")["gear_efficiency"].status == "refused"


@pytest.mark.parametrize("draw", [5, 6, 9])
def test_a_resistance_that_a_voltage_changing_within_the_rows_spoils_is_not_believed(draw):
    """By 3 to 5 %, at 1 kHz of an L/R of 0.3 to 1 ms, which no fit of fewer rows shows."""
    log, truth = draws.logged(draw, "locked_prbs", 1000.0), draws.motor_of(draw).resistance
    found = identify([log])["resistance"]
    assert found.value > 1.02 * truth
    assert found.low < truth < found.high
    share = found.high / found.value - 1.0
    assert found.status == (
        "identified" if share <= 0.05 else "rough" if share <= 0.3 else "refused"
    )


def test_a_back_emf_constant_can_be_asked_of_a_shaft_under_a_voltage():
    motor, log = draws.motor_of(3), draws.only(draws.logged(3), "voltage", "position")
    names = "resistance", "torque_constant", "coulomb_friction", "viscous_friction"
    known = {name: getattr(motor, name) for name in names}
    found = identify([log], "free", known, estimated=["back_emf_constant"])["back_emf_constant"]
    assert found.status == "identified"
    assert found.value == pytest.approx(motor.back_emf_constant, rel=1e-3)


def test_what_is_known_worst_is_not_lost_beside_what_is_known_best():
    """Two parameters of independent rows, known to 1e-6 and to 0.05: intervals are 1.96 times that."""
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
    found = uncertainty.resampled_half_widths(fit, np.ones(2), np.eye(2), 0)["curvature"]
    np.testing.assert_allclose(found, [1.96e-6, 1.96 * 0.05], rtol=0.05)


@pytest.mark.matrix
def test_a_voltage_alone_tells_the_constants_only_together(swings):
    """With V = torque and no back-EMF the voltage of a motor with kT = kE = k has k/R = 1 and nothing of k itself."""
    log = swings[0]
    signals = {"position": log.signals["position"], "voltage": log.signals["torque"]}
    driven = Log(log.name, log.time, signals, log.resolution)
    found = identify([driven], "pendulum", {"mgl": 3.6})
    assert statuses(found, {"torque_constant", "resistance"}) <= {"ratio", "refused"}
    assert found["torque_constant"].value / found["resistance"].value == pytest.approx(
        1.0, rel=0.05
    )


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({}, "pendulum, free or load"),
        ({"known": {"mgl": -1.0}}, r"mgl = -1.0: must be from 0"),
        ({"rig": "pendulum", "known": {"inertja": 1.0}}, r"did you mean known\.inertia"),
        ({"rig": "pendulum", "known": {"friction_torque": 1.0}}, r"known\.friction_torque"),
        (
            {"rig": "pendulum", "estimated": ["rotor_inertia"]},
            r"shaft under a torque estimated\.rotor_inertia",
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
            r"different things \(swing0: position; velocity: velocity\)",
        ),
    ],
)
def test_bad_input_says_what_to_do(swings, arguments, says):
    log, *_ = swings
    position, torque = log.signals["position"], log.signals["torque"]
    logs = {
        "swing0": log,
        "still": Log("still", log.time, {"position": position}),
        "slow": log.slice_rows(slice(None, None, 50)),
        "velocity": Log("velocity", log.time, {"velocity": position, "torque": torque}),
    }
    with pytest.raises(ValueError, match=says):
        identify(**arguments | {"logs": [logs[name] for name in arguments.get("logs", ["swing0"])]})


@pytest.mark.matrix
def test_intervals_hold_what_is_true_in_nineteen_of_twenty_draws():
    held = dict.fromkeys(WINDING, 0)
    for seed in range(20):
        found = identify([bench.motor_log("locked", 2000, 2.5, seed=seed)], seed=seed)
        assert statuses(found, WINDING) == {"identified"}
        for name, value in WINDING.items():
            held[name] += found[name].low <= value <= found[name].high
    assert min(held.values()) >= 19


@pytest.mark.matrix
def test_friction_is_found_within_five_percent_whatever_it_is():
    random = np.random.default_rng(2)
    for seed in range(3):
        coulomb, viscous = random.uniform(0.05, 0.3), random.uniform(0.01, 0.05)
        logs = [bench.mujoco_pendulum(2 * seed + place, 6.0, coulomb, viscous) for place in (0, 1)]
        near(
            identify(logs, "pendulum"),
            {"coulomb_friction": coulomb, "viscous_friction": viscous},
            0.05,
        )
