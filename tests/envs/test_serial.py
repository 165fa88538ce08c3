"""`SerialVectorEnv` compared with Gymnasium's loop and with the batched environment."""

import gymnasium
import numpy as np
import pytest

from codrl_mj import Uniform
from codrl_mj.envs import ActuatedEnv
from codrl_mj.tasks import TASKS, named_actuator
from tests.envs.faces import PHYSICS, arguments
from tests.envs.vectors import (
    assert_equal_episodes,
    assert_same,
    batched,
    looped,
    random_actions,
    serial,
)
from tests.tasks.faces import every_rebuilt


@every_rebuilt
@pytest.mark.parametrize("physics", PHYSICS)
def test_it_is_gymnasiums_loop_and_on_mujoco_the_batched_environment(task, physics):
    options = arguments(task, "everything", physics) | {"max_episode_steps": 11}
    ours = serial(4, task, physics=physics, **options)
    references = [looped(task, 4, "SameStep", physics=physics, **options)]
    references += [batched(task, 4, "SameStep", **options)] if physics == "mujoco" else []
    for reference in references:
        assert assert_equal_episodes(ours, reference, 60, masks=False).sum() > 12
    for generator, reference_generator in zip(ours.np_random, references[0].np_random, strict=True):
        assert generator.random() == reference_generator.random()
    assert isinstance(ours, gymnasium.vector.SyncVectorEnv)
    assert ours.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode.SAME_STEP


@every_rebuilt
def test_signals_and_draws_are_those_of_the_batched_environment(task):
    options = arguments(task, "everything") | {"max_episode_steps": 7}
    ours, theirs = (
        serial(3, task, **options),
        batched(task, 3, "SameStep", **options).unwrapped,
    )
    assert ours.signals is None
    # Before the first reset all values are NaN.
    assert_same(ours.randomization, theirs.randomization)
    ours.reset(seed=2)
    theirs.reset(seed=2)
    for index, actions in enumerate(
        random_actions(ours, np.random.default_rng(index)) for index in range(20)
    ):
        # After this reset, the episodes end in different steps.
        if index == 5:
            mask = {"reset_mask": np.array([True, False, False])}
            assert_same(ours.reset(options=dict(mask)), theirs.reset(options=dict(mask)))
        assert_same(ours.step(actions), theirs.step(actions), f"step {index}")
        assert_same(ours.signals, theirs.signals, f"step {index}")
        assert_same(ours.randomization, theirs.randomization, f"step {index}")


def test_without_a_time_limit_episodes_do_not_end():
    env = serial(2, "pendulum", physics="analytic")
    env.reset(seed=0)
    assert not any(env.step(np.zeros((2, 1), np.float32))[3].any() for _ in range(250))
    assert env.task is TASKS["pendulum"]


def test_each_can_have_an_actuator_of_its_own():
    actuators = [named_actuator(name, "cartpole") for name in ("paper", "weak", "weaker")]
    drawn = {"randomize": {"motor.resistance": Uniform(1, 2)}}
    env = serial(3, "cartpole", actuators, physics="analytic", **drawn)
    env.reset(seed=3)
    env.step(np.array([1, 1, 1]))
    resistances = env.randomization["motor.resistance"]
    assert len(set(resistances)) == 3
    for row, actuator in enumerate(actuators):
        single = ActuatedEnv("cartpole", actuator, physics="analytic", **drawn)
        assert (
            single.reset(seed=3 + row)[1]["randomization"]["motor.resistance"] == resistances[row]
        )
        assert single.step(1)[4]["current"] == env.signals["current"][row]
