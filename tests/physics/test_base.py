"""Integration steps, integrators and the check for divergence."""

import numpy as np
import pytest

from codrl_mj.actuators import IDEAL, Actuator, Inputs
from codrl_mj.physics import PHYSICS, AnalyticPhysics, Plant, SimulationDivergedError
from codrl_mj.tasks import TASKS


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_the_default_is_the_papers_inner_loop_with_a_motor_and_gymnasiums_step_without(task):
    assert task.steps_within(Actuator(), None, None) == task.motor_inner_steps
    assert task.steps_within(IDEAL, None, None) == (10 if task.name == "furuta" else 1)


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
@pytest.mark.parametrize("count", [1, 2, 3, 7, 10, 1000])
def test_a_timestep_that_divides_the_environment_step_gives_their_ratio(task, count):
    assert task.steps_within(IDEAL, None, task.step_duration / count) == count
    assert task.steps_within(IDEAL, count, None) == count


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
@pytest.mark.parametrize("ratio", [0.5, 1.001, 1.5, 2.5, 9.99])
def test_a_timestep_that_does_not_divide_is_refused_with_both_numbers(task, ratio):
    timestep = task.step_duration / ratio
    with pytest.raises(ValueError, match="does not divide") as refused:
        task.steps_within(IDEAL, None, timestep)
    for number in (timestep, task.step_duration):
        assert f"{number:g} s" in str(refused.value)
    assert f"the ratio is {ratio:.6g}, must be an integer >= 1" in str(refused.value)


@pytest.mark.parametrize("timestep", [0.0, -0.01, np.nan, np.inf])
def test_a_timestep_that_is_no_duration_is_refused(timestep):
    with pytest.raises(ValueError, match=f"timestep = {timestep}: must be a finite number > 0"):
        TASKS["cartpole"].steps_within(IDEAL, None, timestep)


@pytest.mark.parametrize("inner_steps", [0, -1, 1.5, 2.0, True, "2", np.nan])
def test_inner_steps_that_are_no_count_are_refused(inner_steps):
    with pytest.raises(ValueError, match=r"inner_steps = .*: must be an integer >= 1") as refused:
        TASKS["cartpole"].steps_within(IDEAL, inner_steps, None)
    assert repr(inner_steps) in str(refused.value)


def test_both_at_once_are_refused_with_both_numbers():
    with pytest.raises(ValueError, match=r"inner_steps = 2 and timestep = 0\.01: give one of them"):
        TASKS["cartpole"].steps_within(IDEAL, 2, 0.01)


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_the_default_integrator_is_the_first_and_others_are_refused_with_the_choice(task):
    assert task.integrator(None) == task.integrators[0]
    for name in task.integrators:
        assert task.integrator(name) == name
    with pytest.raises(ValueError, match=f"integrator = 'leapfrog': {task.name} has {', '.join(task.integrators)}"):
        task.integrator("leapfrog")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1.1e10, -1e39])
@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_divergence_names_every_broken_entry_and_the_time(task, bad):
    physics = AnalyticPhysics(Plant(task, [IDEAL]))
    physics.time = 1.25
    physics.check_finite()
    for index, name in enumerate(task.state_names):
        physics.state = np.zeros(len(task.state_names))
        physics.state[index] = bad
        with pytest.raises(SimulationDivergedError) as raised:
            physics.check_finite()
        assert f"{task.name}: the simulation diverged at t = 1.25 s: {name} = {bad:g}" in str(raised.value)
        assert "Reset the environment" in str(raised.value)


@pytest.mark.parametrize("name", PHYSICS)
def test_every_physics_checks_its_present_state_and_lets_no_fields_be_set(name):
    physics = PHYSICS[name](Plant(TASKS["pendulum"], [IDEAL], 1, "semi-implicit"))
    physics.reset(np.array([0.3, 0.1]))
    physics.check_finite()
    physics.set_model({})
    physics.state = np.array([0.3, 1.1e10])
    with pytest.raises(SimulationDivergedError, match=r"pendulum: the simulation diverged at t = 0 s: theta_dot"):
        physics.check_finite()


def test_the_analytic_physics_refuses_fields_of_a_model_and_names_them():
    physics = PHYSICS["analytic"](Plant(TASKS["pendulum"], [IDEAL], 1, "semi-implicit"))
    with pytest.raises(ValueError, match=r"fields = body_mass, .*: they are a MuJoCo model's, which .*use 'mujoco'"):
        physics.set_model({"body_mass": np.ones((1, 2)), "body_ipos": np.zeros((1, 2, 3))})


def test_a_physics_of_somebodys_own_refuses_them_by_its_own_name(monkeypatch):
    class Mine(AnalyticPhysics):
        """Of nobody else."""

    physics = Mine(Plant(TASKS["pendulum"], [IDEAL]))
    with pytest.raises(ValueError, match="which 'Mine' has not"):
        physics.set_model({"body_mass": np.ones((1, 2))})
    monkeypatch.setitem(PHYSICS, "mine", Mine)
    with pytest.raises(ValueError, match="which 'mine' has not"):
        physics.set_model({"body_mass": np.ones((1, 2))})


def test_the_ideal_actuator_delivers_what_is_desired_and_has_no_current():
    _, torque, signals = IDEAL.advance((), 0.01, IDEAL.State(), Inputs(3.0, 1.0, 2.0, 0.5, 7.0))
    assert torque == 3.0
    assert signals._asdict() == {"current": 0.0, "reference_current": 0.0, "voltage": 0.0, "saturated": 0.0}
