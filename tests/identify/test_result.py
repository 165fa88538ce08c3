"""Results of an identification: the actuator's file, refusals, intervals and the command line."""

import dataclasses
import json

import numpy as np
import pytest
import tyro
import yaml

from codrl_mj.actuators import Drive, identified_ranges, resolve
from codrl_mj.cli import main
from codrl_mj.cli.environments import build_env_config
from codrl_mj.cli.train import train_verb
from codrl_mj.envs.config import EnvConfig
from codrl_mj.identify.identify import check_arguments, identify, predict_missing
from codrl_mj.identify.log import replace_signal
from codrl_mj.identify.result import Estimate, Identified
from tests.identify import bench

KNOWN = {"inductance": 1e-3, "rotor_inertia": 2e-5}


def make_identified(*estimates, base=None):
    """Return a result with some estimates."""
    return Identified(("a", "b"), "free", "coulomb", "current", {}, estimates, (), (), (), base)


def motor(**changes):
    """Return a result that makes an actuator, with other estimates for some names."""
    estimates = {
        "resistance": Estimate("resistance", 1.2, 1.1, 1.3, "identified"),
        "back_emf_constant": Estimate("back_emf_constant", 0.05, 0.049, 0.051, "identified"),
        "torque_constant": Estimate("torque_constant", 0.05, 0.049, 0.051, "identified"),
        "coulomb_friction": Estimate("coulomb_friction", 1e-3, 0.0, 2e-3, "identified"),
        "inertia": Estimate("inertia", 3e-4, 2e-4, 4e-4, "identified"),
    }
    estimates |= {
        name: Estimate(name, value, value, value, "given") for name, value in KNOWN.items()
    }
    return make_identified(*{**estimates, **changes}.values())


def test_the_written_file_has_the_actuator_and_its_intervals(tmp_path):
    written = motor().write(tmp_path)
    drive = resolve(str(written[0]), None, "a test")
    assert isinstance(drive, Drive)
    assert (drive.motor.resistance, drive.motor.inductance, drive.motor.coulomb_friction) == (
        1.2,
        1e-3,
        1e-3,
    )
    assert identified_ranges(written[0]) == {
        "motor.resistance": "loguniform(1.1, 1.3)",
        **{f"motor.{side}_constant": "loguniform(0.049, 0.051)" for side in ("back_emf", "torque")},
        "motor.coulomb_friction": "uniform(0.0, 0.002)",
    }
    assert json.loads(written[1].read_text())["estimates"][0]["high"] == 1.3


@pytest.mark.parametrize("status", ["ratio", "unidentifiable", "refused"])
def test_an_unidentified_parameter_is_refused_until_it_is_known(tmp_path, status):
    result = motor(resistance=Estimate("resistance", 1.2, 0.1, 9.0, status, "its interval is wide"))
    with pytest.raises(
        ValueError, match=f"resistance is {status}: its interval is wide. Give it with --known"
    ):
        result.actuator()
    motor().write(tmp_path)
    assert result.write(tmp_path) == [tmp_path / "result.json"]
    # The actuator of the earlier fit is removed.
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]
    assert (
        f"resistance is {status}" in json.loads((tmp_path / "result.json").read_text())["problem"]
    )
    with pytest.raises(FileNotFoundError):
        resolve(str(tmp_path / "actuator.yaml"), None, "a test")
    assert (
        motor(resistance=Estimate("resistance", 1.2, 1.2, 1.2, "given")).actuator().motor.resistance
        == 1.2
    )


def test_missing_parameters_are_requested_or_taken_from_a_base():
    friction = Estimate("coulomb_friction", 1e-3, 5e-4, 2e-3, "identified")
    with pytest.raises(ValueError, match=r"resistance, .*: these logs do not determine them"):
        make_identified(friction).actuator()
    whole = make_identified(friction, base=Drive().as_mapping()).actuator()
    assert whole == Drive().replaced({"motor.coulomb_friction": 1e-3})


@pytest.mark.parametrize(
    "known", [pytest.param({}, marks=pytest.mark.matrix), {"gear_ratio": 20.0}]
)
def test_a_motor_with_a_gear_is_identified_at_its_rotor(known):
    """A kE of 1 V*s/rad at the output is 0.05 at the rotor with a gear ratio of 20.

    Known parameters override the gear ratio of the base.
    """
    base = Drive().replaced({"motor.gear_ratio": 20.0 if not known else 1.0}).as_mapping()
    log = bench.motor_log("sine", 2000)
    log = replace_signal(log, "position", log.signals["position"] / 20.0)
    result = identify([log], "free", {**known, "load_inertia": 0.0}, base=base)
    assert (result["gear_ratio"].value, result["gear_ratio"].status) == (20.0, "given")
    assert result["back_emf_constant"].value == pytest.approx(bench.CONSTANT, rel=0.01)
    assert result["rotor_inertia"].value == pytest.approx(bench.INERTIA, rel=0.05)


def test_all_refused_and_all_missing_parameters_are_named_together():
    bad = {
        name: Estimate(name, 1.0, 0.1, 9.0, "refused", "wide")
        for name in ("resistance", "coulomb_friction")
    }
    problem = motor(**bad).problem()
    assert problem.endswith("Give them with --known resistance=VALUE coulomb_friction=VALUE")
    # An unexplained log is a problem even if every single parameter looks good.
    for whole in (motor(**bad), motor()):
        lost = dataclasses.replace(whole, unexplained=0.89).problem()
        assert "leaves 89% of a log's variation" in lost
        assert "--known" not in lost
    none = make_identified(Estimate("resistance", 1.0, 0.9, 1.1, "identified")).problem()
    assert (
        "inductance, torque_constant, back_emf_constant, rotor_inertia: these logs do not determine"
        " them" in none
    )
    assert "load_inertia=VALUE, 0 for a motor without load" in none


def test_an_unknown_rotor_inertia_of_the_datasheet_is_not_zero():
    """The logs show only the total inertia: the load's or the rotor's has to be known."""
    estimates = [estimate for estimate in motor().estimates if estimate.name != "rotor_inertia"]
    bare = Drive().replaced({"motor.rotor_inertia": 0.0}).as_mapping()
    assert "--known load_inertia=VALUE" in make_identified(*estimates, base=bare).problem()
    with pytest.raises(ValueError, match="rotor_inertia is unknown"):
        make_identified(*estimates, base=bare).actuator()
    known = Estimate("rotor_inertia", 0.0, 0.0, 0.0, "given")
    assert make_identified(*estimates, known, base=bare).actuator().motor.rotor_inertia == 0.0
    whole = make_identified(*estimates, base=Drive().as_mapping())
    assert (
        whole.base_text
        == "not from these logs, but from the motor (--motor): rotor_inertia = 4e-06 kg*m^2, "
        "viscous_friction = 0 N*m*s/rad"
    )
    winding = make_identified(estimates[0], base=bare)
    assert winding.problem() is None


def test_the_supply_is_taken_from_the_logs_and_reported(tmp_path):
    result = dataclasses.replace(motor(), supply=5.02)
    assert resolve(str(result.write(tmp_path)[0]), None, "a test").voltage_limit == 5.02
    assert result.supply_text.startswith("supply 5.02 V: largest voltage of the logs")
    assert json.loads((tmp_path / "result.json").read_text())["supply"] == 5.02
    assert "assumed" in motor().supply_text


def test_a_missing_rig_and_missing_parameters_are_reported_before_the_fit():
    log = bench.motor_log("sine", duration=0.5)
    with pytest.raises(
        ValueError, match=r"--rig on the command line, rig= in Python.*pendulum, free or load"
    ):
        check_arguments([log])
    assert "rotor_inertia" in predict_missing([log], {}, None)
    assert "0 for a motor without load" in predict_missing([log], {}, None)
    assert (
        predict_missing([log], {"load_inertia": 0.0}, None)
        is predict_missing([log], {}, Drive().as_mapping())
        is None
    )


def test_only_files_of_identified_actuators_have_ranges(tmp_path):
    file = tmp_path / "drive.yaml"
    file.write_text(yaml.safe_dump(Drive().as_mapping()))
    with pytest.raises(ValueError, match="has no intervals"):
        identified_ranges(file)
    with pytest.raises(FileNotFoundError):
        identified_ranges(tmp_path / "none.yaml")


def write_csv(path, log):
    table = np.column_stack([log.time, *log.signals.values()])
    np.savetxt(path, table, delimiter=",", header=",".join(["t", *log.signals]), comments="")
    return str(path)


def test_the_command_line_identifies_and_randomizes_within_the_intervals(tmp_path, capsys):
    log = write_csv(tmp_path / "bench.csv", bench.motor_log("locked", 2000, 2.5))
    wrong = bench.motor_log("locked", 2000, 1.0)
    wrong = write_csv(
        tmp_path / "wrong.csv", replace_signal(wrong, "current", -wrong.signals["current"])
    )
    columns = "time=t:s,voltage=mean(voltage):V,current=current:A,position=position:rad"
    known = "torque_constant=0.05 back_emf_constant=0.05 rotor_inertia=2e-5"
    line, out = f"identify {log} --columns {columns} --known", tmp_path / "motor"
    assert main(f"{line} {known} --out {out} --holdout {wrong}".split()) == 0
    output = capsys.readouterr().out
    assert "the held-out log wrong has errors and is left out" in output
    assert "supply 3 V: largest voltage of the logs" in output
    assert "resistance" in output
    assert "identified" in output
    actuator = str(out / "actuator.yaml")
    fields = yaml.safe_load((out / "actuator.yaml").read_text())
    low, high = fields["identified"]["intervals"]["motor.resistance"]
    assert low < bench.RESISTANCE < high
    words = [
        "pendulum",
        "--actuator",
        actuator,
        "--env.randomize",
        "identified",
        "motor.inductance=uniform(1e-4,1e-3)",
    ]
    verb = tyro.cli(train_verb(words), args=words)
    config = build_env_config(verb, "pendulum", verb.actuator_name, EnvConfig("pendulum"))
    assert config.randomize[0] == "motor.inductance=uniform(0.0001, 0.001)"
    assert f"motor.resistance=loguniform({low!r}, {high!r})" in config.randomize
    words[2] = "weak"
    verb = tyro.cli(train_verb(words), args=words)
    with pytest.raises(ValueError, match="identified: needs the intervals of an actuator file"):
        build_env_config(verb, "pendulum", verb.actuator_name, EnvConfig("pendulum"))
    refused = tmp_path / "refused"
    assert main(f"{line} torque_constant=0.05 back_emf_constant=0.05 --out {refused}".split()) == 1
    assert "not to be used as an actuator: rotor_inertia" in capsys.readouterr().out
    assert sorted(path.name for path in refused.iterdir()) == ["report.html", "result.json"]
    assert main(f"{line} mgl".split()) == 2
    assert "must be NAME=NUMBER" in capsys.readouterr().err
