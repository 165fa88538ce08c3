"""Logs of a torque give a joint with friction, damping and armature, and no actuator."""

import pytest
import yaml

from codrl_mj import make
from codrl_mj.cli import main
from codrl_mj.disturbances import Joint
from codrl_mj.identify.identify import identify
from codrl_mj.identify.result import Estimate, Identified
from tests.identify import bench
from tests.identify.test_result import write_csv

COULOMB, VISCOUS, INERTIA, RATIO = 0.15, 0.01, 0.19, 6.0


def make_identified(friction="coulomb", unexplained=0.0, status="identified", driven_by="torque"):
    """Return the result of a fit of a geared joint."""
    estimates = (
        Estimate("gear_ratio", RATIO, RATIO, RATIO, "given"),
        Estimate("coulomb_friction", COULOMB / RATIO, 0.02, 0.03, status),
        Estimate("viscous_friction", VISCOUS / RATIO**2, 2e-4, 4e-4, "rough"),
        Estimate("rotor_inertia", INERTIA / RATIO**2, 5e-3, 6e-3, "identified"),
    )
    details = {"unexplained": unexplained}
    return Identified(
        ("a",), "free", friction, driven_by, {}, estimates, (), (), (), None, **details
    )


@pytest.mark.matrix
def test_a_torque_log_gives_a_joint_to_train_with(tmp_path, capsys):
    log = write_csv(tmp_path / "swing.csv", bench.mujoco_pendulum(1, 6.0))
    out = tmp_path / "motor"
    out.mkdir()
    # An actuator of an earlier fit would be mistaken for the result of this one.
    (out / "actuator.yaml").write_text("family: drive\n")
    line = f"identify {log} --columns time=t:s,position=position:rad,torque=torque:N*m"
    assert main([*line.split(), "--rig", "pendulum", "--out", str(out)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "there will be no actuator, only a joint.yaml" in text
    assert "torques determine a joint, but no motor: train with --actuator ideal" in text
    assert "--env.joint.friction 0.1" in text
    assert 'frictionloss="0.1' in text
    names = sorted(path.name for path in out.iterdir())
    assert names == ["joint.yaml", "report.html", "result.json"]
    joint = yaml.safe_load((out / "joint.yaml").read_text())
    assert joint["friction"] == pytest.approx(COULOMB, rel=0.05)
    assert joint["damping"] == pytest.approx(VISCOUS, rel=0.3)
    # The inertia may be that of the bodies in the model.
    assert joint["armature"] == 0.0
    env = make("pendulum", actuator="ideal", joint=joint).unwrapped
    assert env.model.dof_frictionloss[0] == joint["friction"]


def test_a_joint_has_the_values_at_the_output():
    assert vars(make_identified().joint()) == pytest.approx(
        vars(Joint(VISCOUS, COULOMB, INERTIA)), rel=1e-12
    )
    assert '<joint damping="0.01" frictionloss="0.15" armature="0.19"/>' in (
        make_identified().joint_text
    )


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"status": "refused"}, "coulomb_friction is refused"),
        ({"unexplained": 0.85}, "the fit leaves 85% of a log's variation unexplained"),
        ({"friction": "load"}, "fit it with --friction coulomb"),
        ({"driven_by": "current"}, "only logs of a torque determine a joint"),
    ],
)
def test_a_joint_that_logs_do_not_determine_is_refused(tmp_path, changes, problem):
    result = make_identified(**changes)
    assert problem in result.joint_problem()
    with pytest.raises(ValueError, match=problem):
        result.joint()
    (tmp_path / "joint.yaml").write_text("damping: 1.0\n")
    assert [path.name for path in result.write(tmp_path)] == ["result.json"]
    assert not (tmp_path / "joint.yaml").exists()


def test_a_known_motor_gives_an_actuator_instead():
    """A log that is all but exact: the electrical values are the datasheet's."""
    from codrl_mj.sizing import find_drive

    base = find_drive("maxon-ec45-flat-50w").as_mapping()
    known = {"inertia": INERTIA, "mgl": 3.6, "load_inertia": 0.1}
    known |= {"coulomb_friction": COULOMB, "viscous_friction": VISCOUS}
    result = identify([bench.mujoco_pendulum(1, 2.0)], "pendulum", known, base=base)
    assert result.problem() is None
    assert result.joint_text is None
    assert result.actuator().motor.coulomb_friction == COULOMB
