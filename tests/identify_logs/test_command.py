"""Output, files and errors of `codrl-mj identify check`, `plan`, `columns` and `simulate`."""

import json
import shlex

import pytest

from codrl_mj.cli import main
from codrl_mj.identify.reading import read_log


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path, monkeypatch):
    """Run every test in an empty folder."""
    monkeypatch.chdir(tmp_path)


def run_identify(capsys, line, status=0):
    """Run `codrl-mj identify`, and return its output, or its errors if the status is 2."""
    assert main(["identify", *shlex.split(line)]) == status
    out, error = capsys.readouterr()
    return out if status < 2 else error


def test_a_simulated_log_can_be_checked_with_the_printed_columns(capsys, tmp_path):
    output = run_identify(
        capsys,
        "simulate maxon-ec45-flat-50w --out log.csv.gz --inertia 1e-4 --duration 1 --dropped 0.05"
        " --mean-voltage --sensor current:noise=0.1,delay=4e-4 position:resolution=0.00153398",
    )
    columns = output.partition("--columns ")[2].strip()
    log = read_log(tmp_path / "log.csv.gz", columns.strip("'"))
    assert log.mean_voltage
    assert 4600 < len(log.time) < 4900
    text = run_identify(capsys, f"check log.csv.gz --columns {columns} --motor maxon-ec45-flat-50w")
    assert "dropped rows" in text
    # The current is delayed by 4e-4 s, which are 2 rows.
    assert "2 rows" in text
    assert "error" not in text


QUBE = "simulate quanser-qube-servo-2 --out log.csv --duration 1"
COLUMNS = "--columns time=time:s,voltage=voltage:V,current=current:A,position=position:rad"


def test_a_repeated_simulation_has_no_findings_and_is_checked_once(capsys):
    for _ in range(2):
        run_identify(capsys, f"{QUBE} --sensor current:noise=0.01")
    once = run_identify(capsys, f"check log.csv {COLUMNS}")
    assert "no problems found" in once
    assert run_identify(capsys, f"check log.csv log.csv {COLUMNS}") == once


def test_errors_set_the_exit_status_and_are_printed_as_json(capsys):
    run_identify(capsys, f"{QUBE} --sensor current:gain=-1")
    findings = json.loads(run_identify(capsys, f"check log.csv {COLUMNS} --json", 1))
    assert [finding["check"] for finding in findings if finding["severity"] == "error"] == ["sign"]
    assert {"log", "severity", "check", "row", "message", "remedy"} == findings[0].keys()


def test_proposed_columns_are_printed_with_the_next_command(capsys):
    run_identify(capsys, QUBE)
    text = run_identify(capsys, "columns log.csv")
    assert "please check: current: no unit is stated: replace UNIT by A or mA" in text
    line = text.splitlines()[-1].removeprefix("codrl-mj identify ")
    assert "current=current:UNIT" in line
    assert line.endswith("--rig RIG --out motor")
    assert "--rig RIG: must be one of" in run_identify(capsys, line, 2)
    line = line.replace("--rig RIG", "--rig free --known load_inertia=0")
    assert "current=current:UNIT: the unit is not filled in" in run_identify(capsys, line, 2)
    units = ("current:A", "position:rad", "velocity:rad/s", "torque:N*m")
    for unit in units:
        line = line.replace(f"{unit.partition(':')[0]}:UNIT", unit)
    run_identify(capsys, f"check {line.partition(' --rig')[0]} --rig free")
    columns = json.loads(run_identify(capsys, "columns log.csv --json"))["columns"]
    assert columns.startswith("time=time:s,current=current:UNIT")
    columns = "time=time:s,current=current:A,voltage=voltage:V,position=position:rad"
    assert "rig is not given (--rig on the command line" in run_identify(
        capsys, f"log.csv --columns {columns}", 2
    )


def test_a_plan_is_printed_and_its_excitation_written(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("codrl_mj.identify.plan.RATES", (1e3, 5e3))
    text = run_identify(capsys, "plan maxon-ec45-flat-50w --inertia 1e-4 --duration 1 --out plan")
    assert "* play prbs" in text
    assert "viscous_friction, which the datasheet gives as 0" in text
    assert (tmp_path / "plan" / "excitation.csv").read_text().startswith("time,voltage\n")
    result = json.loads(
        run_identify(capsys, "plan maxon-ec45-flat-50w --inertia 1e-4 --duration 1 --json")
    )
    assert result["best"]["excitation"]["kind"] == "prbs"
    # The datasheet has a continuous current of 2.52 A.
    assert result["best"]["rms_current"] <= 2.52


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("check nowhere.csv --columns time=t:s,current=i:A", "no log at nowhere.csv"),
        ("check --columns time=t:s,current=i:A", "no log is given"),
        ("plan maxon", "unknown"),
        ("plan maxon-ec45-flat-50w --duration 0.1", "log for longer"),
        ("simulate quanser-qube-servo-2 --out log.txt", "must end in .csv"),
        ("simulate quanser-qube-servo-2 --out .", "cannot write .: it is a folder: name a file"),
        (f"{QUBE} --sensor current:nois=1", "did you mean noise"),
        (f"{QUBE} --sensor current:noise=a", "SIGNAL:FIELD=NUMBER"),
        (f"{QUBE} --sensor currant:noise=1", "did you mean current"),
        (f"{QUBE} --sensor current:noise=1 current:bias=1", "current is given twice"),
        (f"{QUBE} --amplitude -19", "must be at most the supply's 18 V"),
        (f"{QUBE} --rate 0", "rate"),
    ],
)
def test_invalid_arguments_raise_an_error_with_the_reason(capsys, tmp_path, line, message):
    assert message in run_identify(capsys, line, 2)
    assert list(tmp_path.iterdir()) == []
