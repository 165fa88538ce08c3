"""Integration steps, integrators and the check for divergence."""

import numpy as np
import pytest

from codrl_mj.actuators import IDEAL, Actuator, Inputs
from codrl_mj.physics import SimulationDivergedError
from codrl_mj.physics.base import check_finite, check_integrator, inner_step_count
from codrl_mj.tasks import TASKS


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_the_default_is_the_papers_inner_loop_with_a_motor_and_gymnasiums_step_without(task):
    assert inner_step_count(task, Actuator(), None, None) == task.motor_inner_steps
    assert inner_step_count(task, IDEAL, None, None) == 1


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
@pytest.mark.parametrize("count", [1, 2, 3, 7, 10, 1000])
def test_a_timestep_that_divides_the_environment_step_gives_their_ratio(task, count):
    assert inner_step_count(task, IDEAL, None, task.step_duration / count) == count
    assert inner_step_count(task, IDEAL, count, None) == count


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
@pytest.mark.parametrize("ratio", [0.5, 1.001, 1.5, 2.5, 9.99])
def test_a_timestep_that_does_not_divide_is_refused_with_both_numbers(task, ratio):
    timestep = task.step_duration / ratio
    with pytest.raises(ValueError, match="does not divide") as refused:
        inner_step_count(task, IDEAL, None, timestep)
    for number in (timestep, task.step_duration):
        assert f"{number:g} s" in str(refused.value)
    assert f"the ratio is {ratio:.6g}, must be an integer >= 1" in str(refused.value)


@pytest.mark.parametrize("timestep", [0.0, -0.01, np.nan, np.inf])
def test_a_timestep_that_is_no_duration_is_refused(timestep):
    with pytest.raises(ValueError, match=f"timestep = {timestep}: must be a finite number > 0"):
        inner_step_count(TASKS["cartpole"], IDEAL, None, timestep)


@pytest.mark.parametrize("inner_steps", [0, -1, 1.5, 2.0, True, "2", np.nan])
def test_inner_steps_that_are_no_count_are_refused(inner_steps):
    with pytest.raises(ValueError, match=r"inner_steps = .*: must be an integer >= 1") as refused:
        inner_step_count(TASKS["cartpole"], IDEAL, inner_steps, None)
    assert repr(inner_steps) in str(refused.value)


def test_both_at_once_are_refused_with_both_numbers():
    with pytest.raises(ValueError, match=r"inner_steps = 2 and timestep = 0\.01: give one of them"):
        inner_step_count(TASKS["cartpole"], IDEAL, 2, 0.01)


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_the_default_integrator_is_the_first_and_others_are_refused_with_the_choice(task):
    assert check_integrator(task, None) == task.integrators[0]
    for name in task.integrators:
        assert check_integrator(task, name) == name
    with pytest.raises(ValueError, match=f"integrator = 'leapfrog': {task.name} has {', '.join(task.integrators)}"):
        check_integrator(task, "leapfrog")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1.1e10, -1e39])
@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_divergence_names_every_broken_entry_and_the_time(task, bad):
    state = np.zeros(len(task.state_names))
    check_finite(task, state, 0.0)
    for index, name in enumerate(task.state_names):
        broken = state.copy()
        broken[index] = bad
        with pytest.raises(SimulationDivergedError) as raised:
            check_finite(task, broken, 1.25)
        assert f"{task.name}: the simulation diverged at t = 1.25 s: {name} = {bad:g}" in str(raised.value)
        assert "Reset the environment" in str(raised.value)


def test_the_ideal_actuator_delivers_what_is_desired_and_has_no_current():
    _, torque, signals = IDEAL.advance((), 0.01, IDEAL.State(), Inputs(3.0, 1.0, 2.0, 0.5, 7.0))
    assert torque == 3.0
    assert signals._asdict() == {"current": 0.0, "reference_current": 0.0, "voltage": 0.0, "saturated": 0.0}
