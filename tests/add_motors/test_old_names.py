"""Tests of models and runs with names of families that no longer exist: refused, by that name."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import pytest

import codrl_mj
from codrl_mj.actuators import DCMotorActuator, family_id
from codrl_mj.cli import main
from codrl_mj.physics import motors
from codrl_mj.runs.files import with_digest
from tests.add_motors.models import arm

RUNS = Path(__file__).parents[1] / "fixtures" / "runs"
OLD_CLASS = "codrl_mj.actuators.current_loop:Actuator"
OLD_NUMBER = 843097
"""The number that models of the paper's actuator had while its class was called `Actuator`."""


def test_a_model_with_an_old_number_is_refused_by_the_number():
    xml = Path(codrl_mj.user_code.asset_path("cartpole.xml")).read_text()
    number = str(family_id(DCMotorActuator))
    assert number in xml
    model = mujoco.MjModel.from_xml_string(xml.replace(number, str(OLD_NUMBER)))
    with pytest.raises(ValueError, match=rf"family {OLD_NUMBER} .*earlier version.*build it again"):
        motors(model)


def test_a_model_with_an_old_class_is_refused_by_its_name(tmp_path):
    xml = codrl_mj.add_motors(arm(), {".*": DCMotorActuator()}).to_xml()
    new_class = f"{DCMotorActuator.__module__}:{DCMotorActuator.__qualname__}"
    assert new_class in xml
    program = "import sys, mujoco, codrl_mj; mujoco.MjModel.from_xml_string(sys.stdin.read())"
    outcome = subprocess.run(
        [sys.executable, "-c", program],
        input=xml.replace(new_class, OLD_CLASS),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert outcome.returncode == 1
    assert f"its family '{OLD_CLASS}' is not loaded" in outcome.stderr


def test_a_run_with_an_old_class_is_refused_by_its_name(tmp_path, capsys):
    run = shutil.copytree(RUNS / "cartpole", tmp_path / "run")
    config = json.loads((run / "config.json").read_text())
    config["train"]["env"]["actuator"]["family"] = OLD_CLASS
    del config["sha256"]
    (run / "config.json").write_text(json.dumps(with_digest(config)))
    assert main(["evaluate", str(run), "--trust"]) == 2
    assert OLD_CLASS in " ".join(capsys.readouterr().err.split())
