"""Tests of the certificate: its checks pass and can fail, and its files and errors are right."""

import importlib
import inspect
import json
import math
import re
import subprocess
import sys

import gymnasium
import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import IDEAL, DCMotorActuator, Lag, TorqueSpeed
from codrl_mj.cli import main
from codrl_mj.physics import (
    AnalyticPhysics,
    MujocoPhysics,
    SimulationConfig,
    SimulationDivergedError,
    needed_callbacks,
)
from codrl_mj.physics.variation import bare_model
from codrl_mj.tasks import TASKS
from codrl_mj.validation import (
    GROUPS,
    MUTATIONS,
    Certificate,
    Check,
    MutationResult,
    Skipped,
    dynamics,
    execution,
    trajectories,
    try_mutations,
    validate,
    validate_model,
)
from codrl_mj.validation.compare import differences
from codrl_mj.validation.mutations import compile_edited, undetected_checks, wrong_loop, wrong_model
from codrl_mj.validation.table import TABLE, Case, evaluate_cases
from codrl_mj.validation.trajectories import Growth
from codrl_mj.viz.pages import certificate as page
from tests.add_motors.models import ACTUATORS, INTEGRATORS, LOOP, arm, behind_plugin
from tests.conftest import REPRESENTATIVES
from tests.engine.models import FULL, add_motor, changed, controls, rotor, rotor_spec, trajectory
from tests.tasks.faces import REBUILT
from tests.validation.test_convergence_checks import RATE, ideal, with_motor
from tests.validation.test_energy_checks import STEPS, orders
from tests.validation.test_motor_checks import EVERY
from tests.viz.pages.parsed import ParsedPage, check_self_contained

SHORT_GROUPS = ("dynamics", "trajectories", "execution")


SELECTED = (*REPRESENTATIVES, "furuta")
OTHERS = tuple(task for task in TASKS if task not in SELECTED)


@pytest.fixture(scope="module")
def certificate():
    """Run the quick certificate of the selected tasks."""
    return validate(SELECTED, quick=True)


def make_check(**fields):
    return Check(
        **(
            {
                "name": "name",
                "oracle": "oracle",
                "tolerance": 1.0,
                "samples": 1,
                "worst": 0.0,
                "group": "dynamics",
            }
            | fields
        )
    )


# -- it passes -------------------------------------------------------------------------------------


def test_the_quick_certificate_passes(certificate):
    failed = [
        (check.group, check.task, check.name, check.worst)
        for check in certificate.checks
        if not check.passed
    ]
    assert failed == []
    assert certificate.passed
    assert certificate.quick


def test_single_steps_of_every_task_pass():
    certificate = validate(quick=True, groups=["dynamics"])
    assert certificate.passed
    assert certificate.subject == "all tasks"
    assert {check.task for check in certificate.checks} == set(TASKS)


@pytest.fixture(scope="module")
def other_certificate():
    """Run the quick certificate of the other tasks, without the motor's group."""
    return validate(OTHERS, quick=True, groups=[group for group in GROUPS if group != "motor"])


@pytest.mark.matrix
def test_the_quick_certificate_of_the_other_tasks_passes(other_certificate):
    assert [
        (check.group, check.task, check.name, check.worst)
        for check in other_certificate.checks
        if not check.passed
    ] == []
    check_coverage(other_certificate, OTHERS)


for module in (*GROUPS, "own_model"):
    importlib.import_module(f"codrl_mj.validation.{module}")


def checks_of(certificate, row):
    """Return the certificate's checks of a row of the table."""
    name = re.compile(re.sub(r"\\{[^}]*\\}", ".+", re.escape(row.name)))
    return [
        check
        for check in certificate.checks
        if check.group == row.group and name.fullmatch(check.name)
    ]


@pytest.mark.parametrize("row", TABLE, ids=[f"{row.group}, {row.name}" for row in TABLE])
def test_every_row_of_the_table_is_in_the_certificate_and_passes(certificate, row):
    checks = checks_of(certificate, row)
    assert checks
    assert [check for check in checks if not check.passed] == []
    assert row.tolerance in {check.tolerance for check in checks}
    assert row.unit in {check.unit for check in checks}


def test_every_check_belongs_to_a_row_of_the_table(certificate):
    checks_of_rows = {id(check) for row in TABLE for check in checks_of(certificate, row)}
    assert checks_of_rows == {id(check) for check in certificate.checks}


def test_every_group_has_checks_with_unique_names_and_descriptions(certificate):
    assert {check.group for check in certificate.checks} == set(GROUPS)
    for task in SELECTED:
        assert set(GROUPS) - {"motor"} <= {
            check.group for check in certificate.checks if check.task == task
        }
    keys = [(check.group, check.task, check.name) for check in certificate.checks]
    assert len(set(keys)) == len(keys)
    for check in certificate.checks:
        assert check.oracle
        assert check.where
        assert check.samples > 0
        assert check.unit


def check_coverage(certificate, tasks):
    def names(group, task):
        return {
            check.name for check in certificate.checks if (check.group, check.task) == (group, task)
        }

    for task in tasks:
        assert names("convergence", task) == ideal(task) | with_motor(task) | {RATE}
        assert names("energy", task) == {STEPS} | orders(task, "electrical", "mechanical", "whole")


def test_every_integrator_and_motor_has_checks(certificate):
    check_coverage(certificate, SELECTED)
    assert {
        check.name for check in certificate.checks if (check.group, check.task) == ("motor", "")
    } == EVERY


def test_tolerances_are_the_documented_ones(certificate):
    for check in certificate.checks:
        if check.group == "dynamics":
            assert check.tolerance == 1e-12
        if check.group == "trajectories" and "rounding" not in check.name:
            assert check.tolerance == 1e-9
        if check.group == "execution":
            assert check.tolerance == 0.0
        if "order" in check.name:
            assert check.tolerance <= 0.1


@pytest.mark.matrix
def test_full_form_has_the_same_checks_with_more_samples(certificate):
    quick = {
        check.name: check.samples
        for check in certificate.checks
        if (check.group, check.task) == ("dynamics", "cartpole")
    }
    whole = {
        check.name: check.samples for check in validate("cartpole", groups=["dynamics"]).checks
    }
    assert whole.keys() == quick.keys()
    assert all(whole[name] > quick[name] for name in whole)


def test_validation_is_deterministic():
    first, second = (validate("cartpole", quick=True, groups=["dynamics"]).checks for _ in range(2))
    assert first == second


def test_progress_callback_gets_each_part():
    parts = []
    validate(
        ["cartpole", "pendulum"],
        quick=True,
        groups=["execution", "dynamics"],
        on_part=lambda *part: parts.append(part),
    )
    assert [name for _, _, name in parts] == [
        "dynamics, cartpole",
        "dynamics, pendulum",
        "execution, cartpole",
        "execution, pendulum",
        "done",
    ]
    assert parts[-1][:2] == (4, 4)


# -- it can fail -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def caught():
    """Run the checks of one task and of the motor with every fault."""
    return try_mutations("pendulum")


@pytest.mark.matrix
def test_every_fault_is_caught_far_beyond_the_tolerance(caught):
    names = {mutation.name for mutation in MUTATIONS if "pendulum" in mutation.tasks}
    assert {outcome.mutation for outcome in caught} == names
    assert len(names) >= len(MUTATIONS) - 1
    assert [(outcome.mutation, outcome.task) for outcome in caught if not outcome.failed] == []
    assert min(outcome.clearest_failure.tolerance_ratio for outcome in caught) > 5


@pytest.mark.matrix
def test_every_check_is_failed_by_some_fault(certificate, caught):
    checks = [check for check in certificate.checks if check.task in ("pendulum", "")]
    assert [
        (check.group, check.task, check.name) for check in undetected_checks(checks, caught)
    ] == []


@pytest.mark.slow
def test_every_check_of_every_task_is_failed_by_some_fault(certificate, other_certificate):
    outcomes = try_mutations()
    assert [(outcome.mutation, outcome.task) for outcome in outcomes if not outcome.failed] == []
    all_checks = (*certificate.checks, *other_certificate.checks)
    # Faults are made only in these tasks.
    checks = [check for check in all_checks if check.task in ("", *REBUILT)]
    assert undetected_checks(checks, outcomes) == []


@pytest.mark.matrix
def test_faults_are_undone(caught):
    assert validate("cartpole", quick=True, groups=SHORT_GROUPS).passed


def functions():
    """Return all loaded functions of the package by (id of their owner, name)."""
    modules = [module for name, module in sys.modules.items() if name.startswith("codrl_mj")]
    classes = [
        value for module in modules for value in vars(module).values() if isinstance(value, type)
    ]
    return {
        (id(owner), name): value
        for owner in [*modules, *classes]
        for name, value in vars(owner).items()
        if callable(value)
        and not isinstance(value, type)
        and (getattr(value, "__module__", None) or "").startswith("codrl_mj")
    }


@pytest.mark.matrix
def test_wrong_function_has_the_signature_of_the_right_one():
    """Check that a fault's function fails a check because of the fault, not of its call."""
    replacing = set()
    for mutation in MUTATIONS:
        before = functions()
        with mutation.apply():
            during = functions()
        for key, right in before.items():
            if (wrong := during[key]) is not right:
                replacing.add(mutation.name)
                names = list(inspect.signature(right).parameters)
                # `bind` raises a TypeError if the arguments do not fit.
                inspect.signature(wrong).bind(*names)
                inspect.signature(wrong).bind(**dict.fromkeys(names))
    assert replacing >= {
        "a stale command",
        "the other Euler integrator",
        "a reset that leaves the motor running",
    }
    assert replacing >= {
        "bounds that are not kept",
        "a mass off by 0.1 %",
        "kp and ki swapped, everywhere",
    }


def test_fault_is_undone_after_an_error():
    fault = next(mutation for mutation in MUTATIONS if mutation.name == "a stale command")
    step = MujocoPhysics.step

    def fail():
        with fault.apply():
            assert MujocoPhysics.step is not step
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert MujocoPhysics.step is step


def test_wrong_loop_is_undone_after_an_error(installed):
    model, inputs = rotor(), controls(20)
    right, advance = trajectory(model, inputs), vars(DCMotorActuator)["advance"]

    def fail():
        with wrong_loop(("- parameters.resistance", "+ parameters.resistance"), everywhere=True):
            assert not np.array_equal(trajectory(model, inputs), right)
            assert vars(DCMotorActuator)["advance"] is not advance
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    np.testing.assert_array_equal(trajectory(model, inputs), right)
    assert vars(DCMotorActuator)["advance"] is advance


def test_edit_of_a_missing_text_is_an_error():
    with pytest.raises(ValueError, match="occurs 0 times"):
        compile_edited(sys.modules["codrl_mj.actuators.current_loop"], [("no such text", "")])


def test_oracle_is_the_installed_gymnasium(monkeypatch):
    step = gymnasium.envs.classic_control.CartPoleEnv.step

    def shifted(self, action):
        result = step(self, action)
        self.state = np.array([*self.state[:3], self.state[3] + 1e-6])
        return result

    monkeypatch.setattr(gymnasium.envs.classic_control.CartPoleEnv, "step", shifted)
    assert not any(
        check.passed
        for check in validate("cartpole", quick=True, groups=["dynamics", "trajectories"]).checks
    )


# -- infinities and NaN -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("worst", "passed"),
    [(0.0, True), (1e-12, True), (1.0001e-12, False), (math.inf, False), (math.nan, False)],
)
def test_check_passes_up_to_its_tolerance_and_never_with_nan(worst, passed):
    check = make_check(worst=worst, tolerance=1e-12)
    assert check.passed is passed
    assert (check.tolerance_ratio > 1) is not passed


def worst_of(*cases):
    check = evaluate_cases(Check("name", "oracle", 1.0), {}, [Case(*case) for case in cases])
    return check.worst, check.where


def test_worst_case_is_the_largest_or_the_first_nan():
    worst, description = worst_of((0.5, "a"), (0.2, "b"), (math.nan, "c"), (7.0, "d"))
    assert math.isnan(worst)
    assert description == "c"
    assert worst_of((1.0, "a"), (3.0, "b"), (3.0, "c")) == (3.0, "b")
    assert worst_of((math.inf, "a"), (math.nan, "b"), (2.0, "c"))[1] == "b"


def test_worst_entry_of_an_array_is_described_by_its_index():
    assert worst_of((np.array([[0.1, 0.2], [0.9, 0.4]]), "at {}".format), (0.5, "b")) == (
        0.9,
        "at 2",
    )
    assert math.isnan(worst_of((np.array([0.1, math.nan, math.inf]), "at {}".format))[0])
    assert worst_of((np.zeros(3), "at {}".format)) == (0.0, "everywhere: there is no difference")
    assert worst_of((0.0, "at the end")) == (0.0, "at the end")
    assert worst_of() == (0.0, "everywhere: there is no difference")


@pytest.mark.parametrize("call", [1, 7, 200])
def test_single_nan_fails_the_check(monkeypatch, call):
    step, calls = MujocoPhysics.step, iter(range(1, 10**6))

    def broken(self, desired_force):
        signals = step(self, desired_force)
        if next(calls) == call:
            self.data.qpos[0] = np.nan
        return signals

    monkeypatch.setattr(MujocoPhysics, "step", broken)
    check, *_ = dynamics.one_step(
        TASKS["cartpole"], TASKS["cartpole"].reference_states, "euler", quick=True
    )
    assert math.isnan(check.worst)
    assert not check.passed
    assert "x [m] from" in check.where


def test_diverging_run_is_a_failed_check_with_the_step(monkeypatch):
    step, calls = MujocoPhysics.step, iter(range(1, 10**6))

    def diverging(self, desired_force):
        if next(calls) == 5:
            raise SimulationDivergedError("it diverged")
        return step(self, desired_force)

    monkeypatch.setattr(MujocoPhysics, "step", diverging)
    for check in trajectories.whole_runs(
        TASKS["cartpole"], "ideal", "euler", range(1), 20, motor=""
    ):
        assert check.worst == math.inf
        assert check.where == "step 5 of seed 0: it diverged"


def test_arithmetic_error_in_a_group_is_a_failed_check(monkeypatch):
    def broken(task, quick):
        raise ZeroDivisionError("by zero")
        yield

    monkeypatch.setattr(dynamics, "checks", broken)
    (check,) = validate("cartpole", groups=["dynamics"]).checks
    assert not check.passed
    assert "ZeroDivisionError" in check.where


def test_missing_library_skips_the_group_with_a_reason(monkeypatch):
    def needing(task, quick):
        raise ModuleNotFoundError("No module named 'control'")
        yield

    monkeypatch.setattr(dynamics, "checks", needing)
    result = validate("cartpole", groups=["dynamics"])
    assert not result.passed
    assert "No module named 'control'" in result.skipped[0].reason


def test_certificate_without_checks_does_not_pass():
    assert not Certificate("nothing", (), (), False, 0.0).passed


# -- measurements -------------------------------------------------------------------------------


def test_angles_are_compared_on_the_circle_only_where_both_were_wrapped():
    acrobot = TASKS["acrobot"]
    ours, oracle = np.array([np.pi, 0.0, 1.0, 0.0]), np.array([-np.pi, 0.0, 1.0, 0.0])
    assert differences(acrobot, ours, oracle).max() < 1e-15
    # An angle that is not wrapped at all is not a rounding error.
    ours[0] = 3 * np.pi
    assert differences(acrobot, ours, oracle).max() > 1
    assert differences(TASKS["pendulum"], np.array([np.pi, 0.0]), np.array([-np.pi, 0.0])).max() > 1


def test_growth_near_an_unstable_equilibrium_is_its_eigenvalue():
    """Compare an upright pendulum with the larger eigenvalue of the semi-implicit map."""
    task = TASKS["pendulum"]
    run = AnalyticPhysics(SimulationConfig(task, [IDEAL], 1, "semi-implicit"))
    growth = Growth(task, run, seed=0)
    for _ in range(100):
        run.step(0.0)
        growth.follow(0.0)
    # 3 g / (2 l) = 15 1/s^2 for Gymnasium's rod.
    pull = 15.0 * task.step_duration
    matrix = np.array([[1 + pull * task.step_duration, task.step_duration], [pull, 1.0]])
    expected = math.log(np.abs(np.linalg.eigvals(matrix)).max()) / task.step_duration
    exponent, _ = np.polyfit(task.step_duration * np.arange(81), growth.logarithms[20:], 1)
    assert exponent == pytest.approx(expected, rel=1e-3)
    assert growth.rounding[-1] > 1e-16 * math.exp(expected * 4.0)


def test_grid_and_edges_reach_the_bounds():
    for task in TASKS.values():
        states = dynamics.grid(task.reference_states.bounds, 5)
        assert len(states) == 5 ** len(task.state_names)
        assert states.max(axis=0).tolist() == list(task.reference_states.bounds)
    assert {-1.2, 0.6} <= set(TASKS["mountain_car"].reference_states.edges[0])
    assert math.pi in TASKS["acrobot"].reference_states.edges[0]


def test_bits_are_compared_and_not_values():
    assert execution.differs(np.array([0.0]), np.array([-0.0])).tolist() == [True]
    assert execution.differs(np.array([np.nan]), np.array([np.nan])).tolist() == [False]


# -- a custom model --------------------------------------------------------------------------

TWO_MOTORS = """
<mujoco><option timestep="0.005"/><worldbody><geom type="plane" size="5 5 .1"/>
<body pos="0 0 1"><joint name="a" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 .5" size=".05"/>
<body pos="0 0 .5"><joint name="b" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 .4" size=".04"/></body></body>
<body pos="1 0 0.2"><freejoint/><geom type="box" size=".1 .1 .1"/></body></worldbody><actuator>
<general name="left" joint="a" gear="10" dyntype="user" actdim="14" gainprm="0" biastype="user"
 ctrllimited="true" ctrlrange="-1 1"
 user="250700 268401 814523 1 0.1 1 1 4.3 1 1e-6 0.6 24 1 1 0 0 0 0 inf 0"/>
<position name="foreign" joint="a" kp="1"/>
<general name="right" joint="b" gear="5" dyntype="user" actdim="14" gainprm="0" biastype="user"
 ctrllimited="true" ctrlrange="-1 1"
 user="250700 268401 814523 1 0.1 1 1 4.3 1 1e-6 0.6 2 0 4 0.1 0.01 0 0 inf 0"/>
</actuator></mujoco>
"""


def test_custom_model_passes_what_applies_and_skips_the_rest():
    result = validate_model(mujoco.MjModel.from_xml_string(TWO_MOTORS), "two motors", quick=True)
    assert result.passed
    names = {check.name for check in result.checks}
    assert {"stable: left", "stable: right", "steps: left", "steps: right"} <= names
    assert {
        "batched, 1 thread",
        "batched, 2 threads",
        "copied",
        "restored",
        "forward passes",
    } <= names
    assert {skip.group for skip in result.skipped} >= {
        "dynamics",
        "trajectories",
        "convergence",
        "energy",
    }
    assert any("foreign" in skip.name and "not motors" in skip.reason for skip in result.skipped)
    assert all(check.task == "two motors" for check in result.checks)


@pytest.mark.matrix
def test_every_check_of_a_custom_model_can_fail():
    model, failed = rotor(), set()
    with wrong_loop(("+ parameters.ki * integral", "- parameters.ki * integral")):
        failed |= {
            check.name for check in validate_model(model, quick=True).checks if not check.passed
        }
    for mutation in MUTATIONS:
        if mutation.name in (
            "a motor that runs in every forward pass",
            "a current that simulations share",
        ):
            with mutation.apply():
                failed |= {
                    check.name
                    for check in validate_model(model, quick=True).checks
                    if not check.passed
                }
    unstable = rotor(changed(FULL, kp=1000.0))
    failed |= {
        check.name for check in validate_model(unstable, quick=True).checks if not check.passed
    }
    assert failed == {check.name for check in validate_model(model, quick=True).checks}


def test_actuators_of_other_families_are_checked():
    spec = rotor_spec()
    add_motor(spec, "hinge", Lag(time_constant=0.03, delay=0.013), name="late")
    add_motor(spec, "hinge", TorqueSpeed(), name="line")
    result = validate_model(spec.compile(), quick=True)
    assert result.passed
    names = [
        check.name
        for check in result.checks
        if check.group == "motor" and "response" not in check.name
    ]
    assert names[:6] == [
        f"{check}: {name}" for check in ("stable", "steps") for name in ("motor", "late", "line")
    ]
    assert {skip.name for skip in result.skipped if "not a current loop" in skip.reason} == {
        "responses of late",
        "responses of line",
    }


SERVO = """
<mujoco><option timestep="0.005"/><worldbody><body><joint name="a" axis="0 1 0" damping="0.1"/>
<geom type="capsule" fromto="0 0 0 0 0 .5" size=".05"/></body></worldbody>
<actuator><position name="servo" joint="a" kp="3" kv="0.2" timeconst="0.02" gear="2"
 forcerange="-0.5 0.5"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_motors_with_the_plugin_have_the_same_checks(bare_engine, integrator):
    model = behind_plugin(
        arm(integrator), {"one": ACTUATORS["noisy_current_loop"], "two": ACTUATORS["custom"]}
    )
    result = validate_model(model, quick=True)
    assert [
        (check.name, check.worst, check.where) for check in result.checks if not check.passed
    ] == []
    assert {"steps: one", "steps: two", "stable: one", "step response", "restored"} <= {
        c.name for c in result.checks
    }
    assert needed_callbacks(model) == ()


def test_servo_with_a_motor_and_ideal_actuator_have_their_checks(bare_engine):
    servo = behind_plugin(mujoco.MjSpec.from_string(SERVO), {"servo": LOOP})
    assert validate_model(servo, quick=True).passed
    result = validate_model(behind_plugin(arm(), {"one": "lag", "two": "ideal"}), quick=True)
    assert result.passed
    assert [skip.name for skip in result.skipped if "ideal" in skip.reason] == ["steps: two"]


def test_wrong_motor_with_the_plugin_fails(bare_engine):
    model = behind_plugin(arm(), {"one": LOOP})
    with wrong_loop(("+ parameters.ki * integral", "- parameters.ki * integral")):
        failed = {
            check.name for check in validate_model(model, quick=True).checks if not check.passed
        }
    assert failed >= {"steps: one", "step response"}


def test_actuator_that_its_family_would_reject_is_not_stable():
    # A lag stores eight steps of 0.01 s.
    result = validate_model(rotor(Lag(delay=0.081)), quick=True)
    (check,) = (check for check in result.checks if not check.passed)
    assert (check.name, check.worst, check.unit) == ("stable: motor", math.inf, "instability")


def test_disabled_motor_is_skipped():
    spec = rotor_spec()
    add_motor(spec, "hinge", FULL, name="off", group=3)
    spec.option.disableactuator = 1 << 3
    result = validate_model(spec.compile(), quick=True)
    assert result.passed
    assert [skip.name for skip in result.skipped if "disabled" in skip.reason] == ["steps: off"]


def test_custom_model_is_not_changed():
    model = rotor()
    flags = model.opt.disableflags
    validate_model(model, quick=True)
    assert model.opt.disableflags == flags


# -- bad input -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tasks", "groups", "message"),
    [
        ("acrobat", None, "did you mean 'acrobot'"),
        ("acrobot", ["dynamic"], r"'dynamic'.*dynamics, trajectories"),
        ([], None, r"tasks = \[\].*must name at least one"),
        (None, [], r"groups = \[\].*must name at least one"),
    ],
)
def test_raises_for_an_unknown_or_empty_task_or_group(tasks, groups, message):
    with pytest.raises(ValueError, match=message):
        validate(tasks, groups=groups)


def test_mutation_does_not_share_cached_models():
    masses = [bare_model("pendulum").body_mass.sum()]
    with wrong_model(("body_mass", None, 2.0)):
        masses.append(bare_model("pendulum").body_mass.sum())
    assert [*masses, bare_model("pendulum").body_mass.sum()] == [
        masses[0],
        2.0 * masses[0],
        masses[0],
    ]


def test_raises_for_a_model_without_a_motor():
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
    with pytest.raises(
        ValueError,
        match=r"the model has no actuators .*URDF.*add one per joint.*codrl_mj.add_motors",
    ):
        validate_model(model)
    arm = '<body><joint name="j"/><geom size=".1"/></body>'
    plain = f'<mujoco><worldbody>{arm}</worldbody><actuator><motor joint="j"/></actuator></mujoco>'
    with pytest.raises(
        ValueError, match=r"no motor of codrl_mj among its 1 actuators.*codrl_mj.add_motors"
    ):
        validate_model(mujoco.MjModel.from_xml_string(plain))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["acrobat"], "unknown task 'acrobat': did you mean 'acrobot'?"),
        (["--model", "nowhere.xml"], "no model at nowhere.xml"),
        (["--model", "broken.xml"], "broken.xml: MuJoCo cannot compile this model: "),
        (["--model", "bare.xml"], "the model has no actuators"),
        (["--model", "bare.xml", "cartpole"], "--model"),
        (["cartpole", "--out", "bare.xml"], "cannot write to bare.xml"),
        (["cartpole", "--out", "bare.xml/certificate"], "bare.xml is not a folder"),
    ],
)
def test_bad_input_prints_one_line_and_writes_nothing(
    capsys, monkeypatch, tmp_path, arguments, expected
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bare.xml").write_text("<mujoco><worldbody/></mujoco>")
    (tmp_path / "broken.xml").write_text(
        "<mujoco><worldbody><body><joint/></body></worldbody></mujoco>"
    )
    assert main(["validate", *arguments]) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1
    assert "Traceback" not in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bare.xml", "broken.xml"]


# -- the files -------------------------------------------------------------------------------------


BAD = make_check(name="b <i>", group="motor", worst=math.nan, where="x < y & z", unit="A", task="")
SAMPLE = Certificate(
    "sample", (make_check(task="pendulum"), BAD), (Skipped("s", "why", "motor"),), True, 1.0
)


@pytest.mark.matrix
def test_page_is_well_formed_self_contained_and_complete(certificate, caught):
    text = page.html(certificate, caught)
    parsed = check_self_contained(text)
    assert set(GROUPS) <= set(parsed.ids)
    words = parsed.text
    for check in certificate.checks:
        assert " ".join(check.name.split()) in words
    for result in caught:
        assert result.mutation in words
    assert len(parsed.data) == sum(len(check.plots) for check in certificate.checks) > 20
    assert "✓ passed" in words
    assert "prefers-color-scheme: dark" in text
    assert len(text) < 10_000_000


def test_failure_is_at_the_top_and_marked_by_more_than_color():
    words = ParsedPage(page.html(SAMPLE)).text
    assert words.index("✗ 1 of 2 checks FAILED") < words.index("Checks of ")
    assert "b <i>" in words
    assert "x < y & z" in words
    assert words.count("✗ FAILED") == 1


def test_plots_have_titles_units_and_finite_curves(certificate):
    for check in certificate.checks:
        for plot in check.plots:
            assert plot.title
            assert "[" in plot.x_label, plot.title
            assert "[" in plot.y_label, plot.title
            for curve in plot.curves:
                assert len(curve.x) == len(curve.y) > 2
                assert np.isfinite(curve.y).all()


def test_json_has_the_verdict_and_every_number(tmp_path):
    json_file, html_file = page.write(
        SAMPLE, tmp_path / "new" / "folder", [MutationResult("m", "", (BAD,), 2)]
    )
    content = json.loads(json_file.read_text())
    assert content["verdict"] == "FAILED"
    assert [check["passed"] for check in content["checks"]] == [True, False]
    assert content["checks"][1]["worst"] == "nan"
    assert content["versions"]["mujoco"] == mujoco.__version__
    assert content["skipped"][0]["reason"] == "why"
    assert content["mutations"][0]["failed"] == ["motor: b <i>"]
    assert content["failed by no mutation"] == ["dynamics: pendulum: name"]
    assert sorted(path.name for path in html_file.parent.iterdir()) == [
        "certificate.html",
        "certificate.json",
    ]


def test_certificate_is_written_atomically(tmp_path, monkeypatch):
    page.write(SAMPLE, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr(page, "html", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        page.write(SAMPLE, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


# -- the command line ------------------------------------------------------------------------------


def test_command_prints_writes_and_exits_with_0(capsys, tmp_path):
    (tmp_path / "robot.xml").write_text(TWO_MOTORS)
    out = tmp_path / "out"
    assert (
        main(["validate", "--model", str(tmp_path / "robot.xml"), "--quick", "--out", str(out)])
        == 0
    )
    text = capsys.readouterr().out
    assert "steps: left" in text
    assert "not checked: dynamics" in text
    assert "passed: 13 of 13 checks" in text
    assert (out / "certificate.html").is_file()
    assert json.loads((out / "certificate.json").read_text())["verdict"] == "passed"


def test_command_takes_a_model_with_motors(capsys, bare_engine, tmp_path):
    spec = codrl_mj.add_motors(mujoco.MjSpec.from_string(SERVO), {"servo": LOOP})
    spec.compile()
    (tmp_path / "servo.xml").write_text(spec.to_xml())
    assert main(["validate", "--model", str(tmp_path / "servo.xml"), "--quick"]) == 0
    assert "steps: servo" in capsys.readouterr().out


@pytest.mark.parametrize("worst", [1.0, math.nan])
def test_command_exits_with_1_if_a_check_fails_and_still_writes(
    capsys, monkeypatch, tmp_path, worst
):
    bad = make_check(name="bad", worst=worst, tolerance=1e-12, where="theta", task="cartpole")
    wrong = Certificate("cartpole", (make_check(name="good", task="cartpole"), bad), (), False, 1.0)
    monkeypatch.setattr("codrl_mj.validation.validate", lambda *_, **__: wrong)
    assert main(["validate", "cartpole", "--out", str(tmp_path)]) == 1
    text = capsys.readouterr().out
    assert "bad, against oracle: FAILED at theta" in text
    assert "1 of 2 checks FAILED" in text
    assert json.loads((tmp_path / "certificate.json").read_text())["verdict"] == "FAILED"


@pytest.mark.parametrize(("missed", "status"), [(False, 0), (True, 1)])
def test_undetected_fault_fails_the_command(capsys, monkeypatch, missed, status):
    good, failed = make_check(task="cartpole"), make_check(task="cartpole", worst=7.0)
    monkeypatch.setattr(
        "codrl_mj.validation.validate", lambda *_, **__: Certificate("c", (good,), (), False, 1.0)
    )
    outcomes = [MutationResult("fault", "cartpole", (failed,), 1)] + [
        MutationResult("other", "cartpole", (), 1)
    ] * missed
    monkeypatch.setattr("codrl_mj.validation.try_mutations", lambda *_, **__: outcomes)
    assert main(["validate", "cartpole", "--mutations"]) == status
    assert ("MISSED" in capsys.readouterr().out) is missed
    assert main(["validate", "cartpole", "--mutations", "--json"]) == status
    content = json.loads(capsys.readouterr().out)
    assert content["checks"][0]["unit"] == good.unit
    assert [fault["failed"] == [] for fault in content["mutations"]] == [False] + [True] * missed


def test_import_of_the_command_line_needs_no_libraries_of_the_oracles():
    code = (
        "import sys, codrl_mj.cli.terminal; print([n for n in ('control', 'scipy', 'jinja2') if n"
        " in sys.modules])"
    )
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert "control" not in process.stdout
    assert "jinja2" not in process.stdout or "scipy" in process.stdout
