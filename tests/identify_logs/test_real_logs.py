"""Logs of real motors, made by others (codrl-mj data): what is known of them is found."""

import pytest

from codrl_mj.identify.balances import torque_balance, velocity_lag
from codrl_mj.identify.checks import check
from codrl_mj.identify.reading import read_log
from tests.published import published_folder

PENDULUM = "time=time:s,position=position:rad,velocity=velocity:rad/s,torque=torque:N*m"
SERVO = (
    "time=timestamp:s,position=position:rad,velocity=speed:rad/s,bus=input_volts:V,command=goal_position:rad,temperature=temp:degC,voltage=twos_complement(load,"
    " 16)/885*input_volts:V,only=torque_enable"
)
SERVO_LOGS = ["2026-01-15_10h30m10.json", "2026-01-15_10h28m49.json"]


PLAIN = SERVO.replace("twos_complement(load, 16)", "load")


def servo_log(place, columns=SERVO):
    return read_log(published_folder("bam_xl330") / SERVO_LOGS[place], columns)


def pendulum_log(name, columns=PENDULUM):
    return read_log(published_folder("dfki_pendulum") / f"{name}.csv", columns)


def kinds(log):
    return {one.check for one in check(log) if one.severity != "info"}


@pytest.mark.parametrize("place", [0, 1])
def test_the_servos_speed_register_lags(place):
    assert 0.018 <= velocity_lag(servo_log(place)).lag <= 0.024
    assert "lag" in kinds(servo_log(place))


def test_the_servos_load_register_has_a_sign_and_its_pendulum_tells_a_wrong_one():
    (found,) = [one for one in check(servo_log(0, PLAIN)) if one.check == "register"]
    assert found.remedy == "write twos_complement(load, 16)"
    assert kinds(servo_log(0)) == {"lag"}
    assert "sign" in kinds(servo_log(0, SERVO.replace("voltage=", "voltage=-")))


def test_the_servos_file_states_its_rig_and_its_resolution_and_the_released_servo_leaves_no_rows():
    log = servo_log(0)
    assert log.constants == {"mass": 0.49, "length": 0.1, "kp": 800.0, "vin": 7.4}
    assert log.resolution["position"] == pytest.approx(6.283185307 / 4096, rel=1e-6)
    assert log.signals["bus"].min() > 5.0
    assert len(servo_log(1).time) < 400 < 700


def test_the_good_pendulum_log_is_left_in_peace_and_the_bad_one_is_not():
    good, bad = pendulum_log("ddp"), pendulum_log("sysid")
    assert kinds(good) == set()
    assert "torque" in kinds(bad)
    assert good.resolution == pytest.approx(
        {"position": 2.914e-3, "velocity": 0.02198, "torque": 8.791e-3}, rel=1e-3
    )


def test_the_pendulums_balance_is_near_what_was_fitted_to_it():
    values = torque_balance(pendulum_log("ddp")).values
    assert values["inertia"] == pytest.approx(0.19, rel=0.1)
    assert values["gravity"] == pytest.approx(3.7, rel=0.1)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("torque=", "torque=-"),
        ("velocity=", "velocity=-"),
        ("position:rad", "position:deg"),
        ("time:s", "time:ms"),
    ],
)
def test_wrong_mappings_of_the_pendulum_are_errors(old, new):
    assert "error" in {
        one.severity for one in check(pendulum_log("ddp", PENDULUM.replace(old, new)))
    }
