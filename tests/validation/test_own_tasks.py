"""Tests of the certificate of custom tasks: skipped checks, and the cause of failed ones."""

import dataclasses
import itertools

import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import CurrentLoop, DCMotorActuator
from codrl_mj.tasks.reference_env import ReferenceStates
from codrl_mj.validation import validate, validate_model
from codrl_mj.validation.mutations import wrong_model
from codrl_mj.validation.table import REPORT
from tests.add_motors.models import arm

XML = """
<mujoco>
  <option timestep="0.001" integrator="RK4"/>
  <worldbody>
    <body pos="0 0 .2">
      <joint name="shaft" axis="0 0 1" damping="1e-5"/>
      <geom type="capsule" fromto="0 0 0 .11 0 0" size=".005" mass=".04"/>
      <body name="rod" pos=".11 0 0">
        <joint name="hinge" axis="1 0 0" damping="1e-6"/>
        <geom type="capsule" fromto="0 0 0 0 0 .16" size=".004" mass=".03"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="shaft"/></actuator>
</mujoco>
"""
"""A small Furuta pendulum with measured parameters; 0.8 N m turn it through a radian in 30 ms."""
COUNT = itertools.count()
GENTLE = ReferenceStates(
    bounds=(3.0,) * 4,
    edges=((3.0,),) * 4,
    start=(0.02, 3.1, 0.01, -0.02),
    steps=3,
    balanced_steps=1,
)
"""A short run with errors that show an order at coarse steps: cheaper than the default run."""


def furuta(folder, changes=(), **fields):
    """Register a task of the model, with parts of the model's text replaced."""
    text = XML
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    number = next(COUNT)
    (path := folder / f"furuta{number}.xml").write_text(text)
    defaults = {
        "name": f"own_furuta{number}",
        "env_id": f"own/Furuta{number}-v0",
        "asset": str(path),
        "max_force": 0.8,
        "step_duration": 0.02,
        "motor_inner_steps": 20,
        "ideal_inner_steps": 20,
        "max_episode_steps": 250,
        "integrators": ("rk4",),
        "state_names": ("arm [rad]", "rod [rad]", "arm_dot [rad/s]", "rod_dot [rad/s]"),
        "observation_names": ("arm", "rod"),
        "initial_bounds": bounds,
        "initial_state": start,
        "observation": observation,
        "reward": reward,
        "terminated": terminated,
    }
    return codrl_mj.register(codrl_mj.Task(**defaults | fields))


def bounds(options):
    return np.array([-0.05, 3.09, -0.05, -0.05]), np.array([0.05, 3.19, 0.05, 0.05])


def start(draws):
    return draws[0], draws[1], draws[2], draws[3]


def observation(state):
    return state[0], state[1]


def reward(state, force, next_state, options):
    return -next_state[1]


def terminated(state):
    return np.abs(state[0]) > 9.0


def certify(task):
    return validate(task.name, quick=True, groups=("convergence", "energy"))


RUBBING = ('damping="1e-6"', 'damping="1e-6" frictionloss="1e-4"')
ALL = {"convergence: all checks", "energy: the balances of a whole run"}
TWO = {f"energy: order, {name} balance, rk4" for name in ("mechanical", "whole")}
CASES = {
    # Feature of the model -> changes of its text and of the task, skipped checks, and the reason.
    "tiny damping": ((), {}, set(), ""),
    "none": ((('damping="1e-5"', ""), ('damping="1e-6"', "")), {}, set(), ""),
    "Euler": (((' integrator="RK4"', ""),), {"integrators": ("euler",)}, set(), ""),
    "friction": ((RUBBING,), {}, ALL, "friction or another constraint acts in the run"),
    "gravity compensation": (
        (('<body name="rod"', '<body name="rod" gravcomp="1"'),),
        {"reference_states": GENTLE},
        TWO,
        "the model has gravity compensation, whose energy is in no balance: remove it",
    ),
    "another actuator": (
        (("</actuator>", '<position joint="hinge" kp="0.1"/></actuator>'),),
        {"reference_states": GENTLE},
        TWO,
        "the model has actuators besides the task's motors, whose energy is in no balance",
    ),
    "quadratic drag": (
        (('timestep="0.001"', 'timestep="0.001" density="1000" viscosity="0.001"'),),
        {},
        {"convergence: order, rk4, ideal actuator"},
        (
            "textbook steps: slope .*, where 4 was promised: the run is too violent for these"
            " steps, or not smooth"
        ),
    ),
}


@pytest.mark.parametrize(("changes", "fields", "skipped", "reason"), CASES.values(), ids=CASES)
def test_checks_that_do_not_apply_to_a_custom_model_are_skipped(
    tmp_path, changes, fields, skipped, reason
):
    certificate = certify(furuta(tmp_path, changes, **fields))
    assert certificate.passed, [check.where for check in certificate.checks if not check.passed]
    reasons = {
        f"{skip.group}: {skip.name}": skip.reason
        for skip in certificate.skipped
        if "equations of motion" not in skip.name
    }
    assert reasons.keys() == skipped
    for text in reasons.values():
        with pytest.raises(ValueError, match=reason):
            raise ValueError(text)


def test_fault_of_the_package_in_a_custom_task_is_reported_as_such(tmp_path):
    task = furuta(tmp_path, reference_states=GENTLE)
    assert certify(task).passed
    with wrong_model(("timestep", None, 1.001)):
        certificate = certify(task)
    failed = {check.name: check.fault for check in certificate.checks if not check.passed}
    assert (
        "textbook steps of the same size have this order: " + REPORT
        in failed["order, rk4, ideal actuator"]
    )
    assert "gentler run in Task.reference_states" in failed["order, mechanical balance, rk4"]


def test_unstable_motor_is_reported_as_the_users_fault():
    unstable = DCMotorActuator(controller=CurrentLoop(kp=200.0))
    model = codrl_mj.add_motors(
        arm("implicitfast"), {".*": unstable}, allow_unstable=True
    ).compile()
    checks = validate_model(model, quick=True).checks
    failed = [check.fault for check in checks if check.name.startswith("stable: ")]
    assert (
        failed
        == [
            "your model or motor is not stable at this step: shorten the step, or slow down the"
            " motor's loop"
        ]
        * 2
    )


def test_failures_of_built_in_tasks_are_the_packages_fault():
    with wrong_model(("body_mass", -1, 1.001)):
        certificate = validate("pendulum", quick=True, groups=("dynamics",))
    assert {check.fault for check in certificate.checks if not check.passed} == {REPORT}
    assert {check.fault for check in certificate.checks if check.passed} <= {""}
    assert REPORT in str(certificate.as_mapping()["checks"])
    assert "fault" in {field.name for field in dataclasses.fields(certificate.checks[0])}
