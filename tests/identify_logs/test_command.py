"""`codrl-mj identify check`, `plan` and `simulate`: what they print, write and refuse."""

import json
import shlex

import pytest

from codrl_mj.cli import main
from codrl_mj.identify.reading import read_log


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Every test runs in an empty folder."""
    monkeypatch.chdir(tmp_path)


def said(capsys, line, status=0):
    assert main(["identify", *shlex.split(line)]) == status
    out, error = capsys.readouterr()
    return out if status < 2 else error


def test_a_simulated_log_is_checked_by_the_columns_that_are_printed(capsys, tmp_path):
    told = said(
        capsys,
        "simulate maxon-ec45-flat-50w --out log.csv.gz --inertia 1e-4 --duration 1 --dropped 0.05"
        " --mean-voltage --sensor current:noise=0.1,delay=4e-4 position:resolution=0.00153398",
    )
    columns = told.partition("--columns ")[2].strip()
    log = read_log(tmp_path / "log.csv.gz", columns.strip("'"))
    assert log.mean_voltage
    assert 4600 < len(log.time) < 4900
    text = said(capsys, f"check log.csv.gz --columns {columns} --motor maxon-ec45-flat-50w")
    assert "dropped rows" in text
    assert "2 rows" in text  # by which the current is late
    assert "error" not in text


QUBE = "simulate quanser-qube-servo-2 --out log.csv --duration 1"
COLUMNS = "--columns time=time:s,voltage=voltage:V,current=current:A,position=position:rad"


def test_a_log_is_simulated_anew_checked_once_and_has_no_findings(capsys):
    for _ in range(2):
        said(capsys, f"{QUBE} --sensor current:noise=0.01")
    once = said(capsys, f"check log.csv {COLUMNS}")
    assert "no problems found" in once
    assert said(capsys, f"check log.csv log.csv {COLUMNS}") == once


def test_errors_are_an_exit_status_and_json(capsys):
    said(capsys, f"{QUBE} --sensor current:gain=-1")
    findings = json.loads(said(capsys, f"check log.csv {COLUMNS} --json", 1))
    assert [one["check"] for one in findings if one["severity"] == "error"] == ["sign"]
    assert {"log", "severity", "check", "row", "message", "remedy"} == findings[0].keys()


def test_columns_are_proposed_with_the_line_to_type_next(capsys):
    said(capsys, QUBE)
    text = said(capsys, "columns log.csv")
    assert "please check: current: no unit is stated: replace UNIT by A or mA" in text
    line = text.splitlines()[-1].removeprefix("codrl-mj identify ")
    assert "current=current:UNIT" in line
    assert line.endswith("--rig free --known load_inertia=0 --out motor")
    assert "current=current:UNIT: the unit is not filled in" in said(capsys, line, 2)
    units = ("current:A", "position:rad", "velocity:rad/s", "torque:N*m")
    for unit in units:
        line = line.replace(f"{unit.partition(':')[0]}:UNIT", unit)
    said(capsys, f"check {line.partition(' --rig')[0]} --rig free")
    columns = json.loads(said(capsys, "columns log.csv --json"))["columns"]
    assert columns.startswith("time=time:s,current=current:UNIT")
    columns = "time=time:s,current=current:A,voltage=voltage:V,position=position:rad"
    assert "rig is not given (--rig on the command line" in said(
        capsys, f"log.csv --columns {columns}", 2
    )


def test_a_plan_is_printed_and_its_excitation_written(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("codrl_mj.identify.plan.RATES", (1e3, 5e3))
    text = said(capsys, "plan maxon-ec45-flat-50w --inertia 1e-4 --duration 1 --out plan")
    assert "* play prbs" in text
    assert "viscous_friction, which the datasheet gives as 0" in text
    assert (tmp_path / "plan" / "excitation.csv").read_text().startswith("time,voltage\n")
    found = json.loads(said(capsys, "plan maxon-ec45-flat-50w --inertia 1e-4 --duration 1 --json"))
    assert found["best"]["excitation"]["kind"] == "prbs"
    assert found["best"]["rms_current"] <= 2.52  # the continuous current that maxon prints


@pytest.mark.parametrize(
    ("line", "says"),
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
def test_what_is_refused_says_why(capsys, tmp_path, line, says):
    assert says in said(capsys, line, 2)
    assert list(tmp_path.iterdir()) == []
