"""Named actuators: what each name means, and that each can be simulated on each task."""

import pytest

from codrl_mj.motor import NAMED, Actuator, CurrentLoop, Motor, check_stable, named_actuator, resolve
from codrl_mj.motor.catalog import PAPER
from codrl_mj.tasks import TASKS

# arXiv 2507.00268, Experimental Results: kP, kI, kD, kFF, arm
PAPER_GAINS = {
    "pendulum": (1.0, 20.0, 1e-6, 0.0, 1.0),
    "mountain_car": (1.0, 1.0, 1e-2, 0.0, 1.0),
    "mountain_car_continuous": (0.1, 10.0, 1e-3, 0.0, 1.0),
    "acrobot": (1.0, 10.0, 1e-6, 0.0, 1.0),
    "cartpole": (4.3, 1.0, 1e-6, 0.6, 0.15),
}


def test_every_task_has_a_paper_actuator():
    assert PAPER.keys() >= TASKS.keys()


@pytest.mark.parametrize("task", TASKS)
def test_the_paper_actuator_has_the_papers_motor_and_gains(task):
    kp, ki, kd, kff, arm = PAPER_GAINS[task]
    motor = Motor(resistance=1.0, inductance=0.1, torque_constant=1.0, back_emf_constant=1.0, arm_radius=arm)
    assert named_actuator("paper", task) == Actuator(motor, CurrentLoop(kp, ki, kd, kff, max_voltage=24.0))


@pytest.mark.parametrize("task", TASKS)
def test_the_weak_actuators_differ_from_the_papers_in_their_gains_only(task):
    motor = PAPER[task].motor
    assert named_actuator("weak", task) == Actuator(motor, CurrentLoop(kp=1.0, ki=1.0))
    assert named_actuator("weaker", task) == Actuator(motor, CurrentLoop(kp=0.2, ki=0.2))


@pytest.mark.parametrize("task", TASKS)
def test_the_open_loop_actuator_feeds_nothing_back_and_holds_the_reference_at_rest(task):
    actuator = named_actuator("open_loop", task)
    loop = actuator.controller
    assert (loop.kp, loop.ki, loop.kd) == (0.0, 0.0, 0.0)
    assert loop.kff == actuator.motor.resistance  # u = R*i_ref is the voltage at which i_ref is at rest
    assert loop.bemf_compensation
    assert actuator.motor.inductance == 0.5
    assert actuator.motor.arm_radius == PAPER[task].motor.arm_radius


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("name", NAMED)
def test_every_named_actuator_is_stable_at_the_step_it_is_used_with(name, task):
    actuator = named_actuator(name, task)
    if name == "ideal":
        assert actuator is None
    else:
        check_stable(actuator, TASKS[task].step_duration / TASKS[task].motor_inner_steps)


@pytest.mark.parametrize(("wrong", "near"), [("papr", "paper"), ("weakest", "weak"), ("open-loop", "open_loop")])
def test_an_unknown_name_suggests_the_nearest_and_lists_all(wrong, near):
    with pytest.raises(ValueError, match=f"unknown actuator '{wrong}': did you mean '{near}") as refused:
        named_actuator(wrong, "cartpole")
    assert all(name in str(refused.value) for name in NAMED)


def test_a_name_like_none_lists_the_known_ones():
    with pytest.raises(ValueError, match="unknown actuator '12345': Known actuators: ideal, paper, weak, weaker"):
        resolve("12345", "cartpole")


def test_resolve_takes_every_way_to_write_an_actuator():
    actuator = Actuator(Motor(resistance=2.0), CurrentLoop(kp=3.0))
    assert resolve(actuator, "cartpole") is actuator
    assert resolve(actuator.as_mapping(), "cartpole") == actuator
    assert resolve("paper", "cartpole") == PAPER["cartpole"]
    assert resolve("ideal", "cartpole") is None
    assert resolve(None, "cartpole") is None


@pytest.mark.parametrize("value", [3, 1.5, ["paper"], Motor()])
def test_resolve_refuses_anything_else(value):
    with pytest.raises(ValueError, match=r"actuator = .*must be a name .*, an Actuator or a mapping"):
        resolve(value, "cartpole")
