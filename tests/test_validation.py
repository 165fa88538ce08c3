"""Cross-validation passes, and would not if anything were wrong: every mutation of the model fails a named check."""

import math

import gymnasium
import numpy as np
import pytest

from codrl_mj import TASKS
from codrl_mj.motor.parameters import BACK_EMF_CONSTANT, INDUCTANCE, MAX_VOLTAGE, TORQUE_CONSTANT
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, SimulationDivergedError, mujoco_single
from codrl_mj.validation import Check, validate
from codrl_mj.validation.checks import STATE_BOUNDS

SAMPLES, RUNS = 20, 1
ACTUATORS = ("ideal", "paper", "weaker", "starved")
HILLS = ("mountain_car", "mountain_car_continuous")


def failures(task):
    """What the names of the failed checks begin with or end with: `one step`, or the actuator of a whole run."""
    failed = set()
    for check in validate(task, SAMPLES, RUNS):
        if not check.passed:
            failed.add("one step" if check.name.startswith("one step") else check.name.split()[-2])
    return failed


def mutate(monkeypatch, change):
    """Every model is built with the change made to it."""
    build = mujoco_single.task_model

    def build_wrong(*arguments, **options):
        model = build(*arguments, **options)
        change(model)
        return model

    monkeypatch.setattr(mujoco_single, "task_model", build_wrong)


# -- it passes ----------------------------------------------------------------------------------------------


def test_every_task_can_be_validated():
    assert set(STATE_BOUNDS) == set(TASKS)


@pytest.mark.parametrize("task", list(TASKS))
def test_every_check_passes_and_says_what_it_compared(task):
    arrived = []
    checks = validate(task, samples=200, runs=2, on_check=arrived.append)
    integrators = TASKS[task].integrators
    assert [check.passed for check in checks] == [True] * 5 * len(integrators)
    assert checks == arrived
    for check in checks:
        assert TASKS[task].gymnasium_id in check.oracle
        assert 0 < check.worst <= check.tolerance
        assert check.where
        assert any(integrator in check.name for integrator in integrators)
        whole_run = not check.name.startswith("one step")
        assert check.tolerance == (1e-9 if whole_run else 1e-12)
        assert check.samples == (2 * int(check.name.split()[0]) if whole_run else 200)


def test_validation_repeats_itself():
    assert validate("cartpole", SAMPLES, RUNS) == validate("cartpole", SAMPLES, RUNS)


# -- it can fail --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", list(TASKS))
def test_a_mass_off_by_a_thousandth_fails_every_check(monkeypatch, task):
    def heavier(model):
        model.body_mass[-1] *= 1.001

    mutate(monkeypatch, heavier)
    assert failures(task) == {"one step", *ACTUATORS}


@pytest.mark.parametrize("task", [task for task in TASKS if task not in HILLS])
def test_gravity_off_by_a_thousandth_fails_every_check(monkeypatch, task):
    def heavier(model):
        model.opt.gravity[2] *= 1.001

    mutate(monkeypatch, heavier)
    assert failures(task) == {"one step", *ACTUATORS}


@pytest.mark.parametrize("task", HILLS)
@pytest.mark.parametrize("entry", [1, 2], ids=["gravity", "wavenumber"])
def test_a_hill_off_by_a_thousandth_fails_every_check(monkeypatch, task, entry):
    def steeper(model):
        model.jnt_user[0, entry] *= 1.001

    mutate(monkeypatch, steeper)
    assert failures(task) == {"one step", *ACTUATORS}


@pytest.mark.parametrize("task", list(TASKS))
def test_a_gear_off_by_a_hundredth_fails_every_check(monkeypatch, task):
    def longer(model):
        model.actuator_gear[0, 0] *= 1.01

    mutate(monkeypatch, longer)
    assert failures(task) == {"one step", *ACTUATORS}


@pytest.mark.parametrize("task", list(TASKS))
def test_a_time_step_off_by_a_thousandth_fails_every_check(monkeypatch, task):
    def slower(model):
        model.opt.timestep *= 1.001

    mutate(monkeypatch, slower)
    assert failures(task) == {"one step", *ACTUATORS}


@pytest.mark.parametrize("task", list(TASKS))
@pytest.mark.parametrize("parameter", [INDUCTANCE, TORQUE_CONSTANT], ids=["inductance", "torque constant"])
def test_a_motor_off_by_a_hundredth_fails_the_checks_with_a_motor(monkeypatch, task, parameter):
    def wrong(model):
        if model.nuser_actuator:
            model.actuator_user[0, parameter] *= 1.01

    mutate(monkeypatch, wrong)
    assert failures(task) == {"paper", "weaker", "starved"}


@pytest.mark.parametrize("task", list(TASKS))
@pytest.mark.parametrize(
    ("parameter", "factor"), [(BACK_EMF_CONSTANT, -1.0), (MAX_VOLTAGE, 0.99)], ids=["back-EMF sign", "voltage limit"]
)
def test_a_wrong_back_emf_or_voltage_limit_fails_the_checks_of_the_starved_motor(monkeypatch, task, parameter, factor):
    make = AnalyticPhysics.__init__

    def make_wrong(self, *arguments, **options):
        make(self, *arguments, **options)
        if self._parameters is not None:
            self._parameters[parameter] *= factor

    monkeypatch.setattr(AnalyticPhysics, "__init__", make_wrong)
    # the loop of the others cancels the back-EMF, unless the cart is so fast that 24 V do not suffice
    assert failures(task) - ({"paper", "weaker"} if task == "cartpole" else set()) == {"starved"}


@pytest.mark.parametrize("task", list(TASKS))
def test_a_command_that_is_a_step_late_fails_every_check(monkeypatch, task):
    step = MujocoPhysics.step

    def late(self, desired_force):
        force, self.waiting = getattr(self, "waiting", 0.0), desired_force
        return step(self, force)

    monkeypatch.setattr(MujocoPhysics, "step", late)
    assert failures(task) == {"one step", *ACTUATORS}


def test_the_wrong_integrator_fails_the_checks_of_the_other(monkeypatch):
    make = MujocoPhysics.__init__

    def always_explicit(self, task, actuator, inner_steps, integrator):
        make(self, task, actuator, inner_steps, "euler")

    monkeypatch.setattr(MujocoPhysics, "__init__", always_explicit)
    outcome = {check.name: check.passed for check in validate("cartpole", SAMPLES, RUNS)}
    assert all(passed == ("semi-implicit" not in name) for name, passed in outcome.items())


def test_the_oracle_is_the_installed_gymnasium(monkeypatch):
    step = gymnasium.envs.classic_control.CartPoleEnv.step

    def shifted(self, action):
        outcome = step(self, action)
        self.state = np.array([*self.state[:3], self.state[3] + 1e-6])
        return outcome

    monkeypatch.setattr(gymnasium.envs.classic_control.CartPoleEnv, "step", shifted)
    assert failures("cartpole") == {"one step", *ACTUATORS}


# -- numbers that are none ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("worst", "passed"),
    [(0.0, True), (1e-12, True), (1.0001e-12, False), (math.inf, False), (math.nan, False)],
)
def test_a_check_passes_up_to_its_tolerance_and_never_on_nan(worst, passed):
    assert Check("name", "oracle", 1, worst, 1e-12, "where").passed is passed


@pytest.mark.parametrize("at", [1, 7, SAMPLES])
def test_one_nan_among_good_samples_fails_the_check(monkeypatch, at):
    step, calls = MujocoPhysics.step, iter(range(1, 10**6))

    def broken(self, desired_force):
        signals = step(self, desired_force)
        if next(calls) == at:
            self.data.qpos[0] = np.nan
        return signals

    monkeypatch.setattr(MujocoPhysics, "step", broken)
    first = validate("cartpole", SAMPLES, RUNS)[0]
    assert math.isnan(first.worst)
    assert not first.passed
    assert "x [m] from" in first.where


def test_a_run_that_diverges_is_a_failed_check_that_says_so(monkeypatch):
    step, calls = MujocoPhysics.step, iter(range(1, 10**6))
    last = len(TASKS["cartpole"].integrators) * SAMPLES

    def diverging(self, desired_force):
        if next(calls) == last + 5:
            raise SimulationDivergedError("it diverged")
        return step(self, desired_force)

    monkeypatch.setattr(MujocoPhysics, "step", diverging)
    checks = validate("cartpole", SAMPLES, RUNS)
    assert [check.passed for check in checks] == [True, True, False, True, True, True, True, True, True, True]
    assert checks[2].worst == math.inf
    assert checks[2].where == "step 5 of seed 0: it diverged"


# -- arguments ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("options", "named"), [({"samples": 0}, "samples = 0"), ({"runs": -1}, "runs = -1")])
def test_counts_below_one_are_refused(options, named):
    with pytest.raises(ValueError, match=named):
        validate("cartpole", **options)


def test_an_unknown_task_is_refused_with_the_nearest():
    with pytest.raises(ValueError, match="did you mean 'acrobot'"):
        validate("acrobat")
