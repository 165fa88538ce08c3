"""Gymnasium's and Stable-Baselines3's checkers have nothing to say that they do not say of Gymnasium's environments."""

import math
import warnings

import pytest
from gymnasium.utils.env_checker import check_env

from codrl_mj.envs import ActuatedEnv
from codrl_mj.tasks import TASKS
from tests.tasks.faces import gymnasiums, ours


class _WithoutNan(ActuatedEnv):
    """Gymnasium's checker compares infos with ==, which the NaN currents of the ideal actuator do not survive."""

    def step(self, action):
        *result, info = super().step(action)
        return *result, {name: None if math.isnan(value) else value for name, value in info.items()}


def _complaints(check, env, **arguments):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check(env, **arguments)
    return {str(warning.message) for warning in caught}


@pytest.mark.parametrize("actuator", ["ideal", "paper"])
@pytest.mark.parametrize("task", TASKS)
def test_gymnasiums_checker(task, actuator):
    """Its only warnings are about the spaces, which are Gymnasium's."""
    env = ours(task, actuator=actuator, render_mode="rgb_array").unwrapped
    if actuator == "ideal":
        spec = env.spec
        env = _WithoutNan(task, actuator=actuator, render_mode="rgb_array")
        env.spec = spec
    accepted = _complaints(check_env, gymnasiums(task).unwrapped, skip_render_check=True)
    assert _complaints(check_env, env) <= accepted
    env.close()


@pytest.mark.parametrize("actuator", ["ideal", "paper"])
@pytest.mark.parametrize("task", TASKS)
def test_stable_baselines3s_checker(task, actuator):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    accepted = _complaints(checker.check_env, gymnasiums(task).unwrapped)
    assert _complaints(checker.check_env, ours(task, actuator=actuator).unwrapped) <= accepted
