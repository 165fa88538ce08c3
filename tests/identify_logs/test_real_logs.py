"""Checks of published logs of real motors (codrl-mj data), whose faults are known."""

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


def servo_log(index, columns=SERVO):
    """Return a log of a servo."""
    return read_log(published_folder("bam_xl330") / SERVO_LOGS[index], columns)


def pendulum_log(name, columns=PENDULUM):
    """Return a log of a pendulum."""
    return read_log(published_folder("dfki_pendulum") / f"{name}.csv", columns)


def faults(log):
    """Return the names of the checks that find an error or a warning."""
    return {finding.check for finding in check(log) if finding.severity != "info"}


@pytest.mark.parametrize("index", [0, 1])
def test_the_servos_speed_register_lags(index):
    assert 0.018 <= velocity_lag(servo_log(index)).lag <= 0.024
    assert "lag" in faults(servo_log(index))


def test_the_servos_signed_register_and_a_wrong_sign_of_its_voltage_are_found():
    (register_finding,) = [
        finding for finding in check(servo_log(0, PLAIN)) if finding.check == "register"
    ]
    assert register_finding.remedy == "write twos_complement(load, 16)"
    assert faults(servo_log(0)) == {"lag"}
    assert "sign" in faults(servo_log(0, SERVO.replace("voltage=", "voltage=-")))


def test_the_servos_file_has_constants_and_a_resolution_and_released_rows_are_left_out():
    log = servo_log(0)
    assert log.constants == {"mass": 0.49, "length": 0.1, "kp": 800.0, "vin": 7.4}
    assert log.resolution["position"] == pytest.approx(6.283185307 / 4096, rel=1e-6)
    assert log.signals["bus"].min() > 5.0
    assert len(servo_log(1).time) < 400 < 700


def test_only_the_bad_pendulum_log_has_findings():
    good, bad = pendulum_log("ddp"), pendulum_log("sysid")
    assert faults(good) == set()
    assert "torque" in faults(bad)
    assert good.resolution == pytest.approx(
        {"position": 2.914e-3, "velocity": 0.02198, "torque": 8.791e-3}, rel=1e-3
    )


def test_the_pendulums_torque_balance_agrees_with_fits():
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
def test_wrong_mappings_of_the_pendulum_give_errors(old, new):
    assert "error" in {
        finding.severity for finding in check(pendulum_log("ddp", PENDULUM.replace(old, new)))
    }
