"""Integration steps, integrators, and detection of divergence."""

import re

import numpy as np
import pytest

from codrl_mj.actuators import IDEAL, DCMotorActuator
from codrl_mj.physics import PHYSICS, AnalyticPhysics, SimulationConfig, SimulationDivergedError
from codrl_mj.tasks import TASKS

every_task = pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
FIELDS = {"body_mass": np.ones((1, 2)), "body_ipos": np.zeros((1, 2, 3))}


@every_task
def test_default_steps_are_the_papers_with_a_motor_and_gymnasiums_without(
    task,
):
    assert task.num_inner_steps(DCMotorActuator(), None, None) == task.motor_inner_steps
    assert task.num_inner_steps(IDEAL, None, None) == (10 if task.name == "furuta" else 1)
    for count in (1, 2, 3, 7, 10, 1000):
        assert task.num_inner_steps(IDEAL, None, task.step_duration / count) == count
        assert task.num_inner_steps(IDEAL, count, None) == count


@every_task
@pytest.mark.parametrize("ratio", [0.5, 1.001, 1.5, 2.5, 9.99])
def test_raises_with_both_numbers_if_a_timestep_does_not_divide(task, ratio):
    timestep = task.step_duration / ratio
    with pytest.raises(
        ValueError, match=rf"{timestep:g} s does not divide .*{task.step_duration:g} s"
    ) as refused:
        task.num_inner_steps(IDEAL, None, timestep)
    assert f"the ratio is {ratio:.6g}, must be an integer >= 1" in str(refused.value)


@every_task
def test_the_default_integrator_is_the_first_and_unknown_ones_raise(task):
    assert task.integrator(None) == task.integrators[0]
    for name in task.integrators:
        assert task.integrator(name) == name
    with pytest.raises(
        ValueError, match=f"integrator = 'leapfrog': {task.name} has {', '.join(task.integrators)}"
    ):
        task.integrator("leapfrog")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1.1e10, -1e39])
@every_task
def test_divergence_reports_all_invalid_entries_and_the_time(task, bad):
    physics = AnalyticPhysics(SimulationConfig(task, [IDEAL]))
    physics.time = 1.25
    physics.check_finite()
    for index, name in enumerate(task.state_names):
        physics.state = np.zeros(len(task.state_names))
        physics.state[index] = bad
        message = (
            f"{task.name}: the simulation diverged at t = 1.25 s: {name} = {bad:g}. Reset the"
            " environment"
        )
        with pytest.raises(SimulationDivergedError, match=re.escape(message)):
            physics.check_finite()


def test_raises_with_its_name_if_a_physics_has_no_model_fields(monkeypatch):
    class Custom(AnalyticPhysics):
        """Custom physics."""

    plant = SimulationConfig(TASKS["pendulum"], [IDEAL])
    message = (
        "fields = body_mass, body_ipos: only a MuJoCo model has such fields, not {!r}; use 'mujoco'"
    )
    for make, name in ((AnalyticPhysics, "analytic"), (Custom, "Custom")):
        with pytest.raises(ValueError, match=message.format(name)):
            make(plant).set_model(FIELDS)
    monkeypatch.setitem(PHYSICS, "mine", Custom)
    with pytest.raises(ValueError, match="fields, not 'mine'"):
        Custom(plant).set_model(FIELDS)
