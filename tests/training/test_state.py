"""Every entry of a model's state has an effect or a reason not to; none may be missing."""

import copy
import dataclasses

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from codrl_mj.envs.sb3 import make_sb3_vec_env
from codrl_mj.training.checkpoint import State, capture, restore
from codrl_mj.training.watcher import TrainingCompleted
from tests.matrix import matrix_params
from tests.training.interruptions import CASES

EVERYWHERE = {"_current_progress_remaining", "env.seeds", "last_episode_starts"}
"""Entries that are computed again, used by the first reset, or used only in a rollout."""
FOR_THE_LOG, COPIED, DRAWN = {"_n_updates"}, {"env.observations"}, {"env.rejected"}
NUMPY, TORCH, ACTIONS = {"random.numpy", "random.numpy.key"}, {"random.torch"}, {"random.actions"}
WITHOUT_EFFECT = {
    "ppo, an episode budget": FOR_THE_LOG | COPIED | DRAWN | ACTIONS | {"_episode_num"},
    "ppo, state-dependent noise": (
        FOR_THE_LOG
        | COPIED
        | ACTIONS
        | {
            "_episode_num",
            "noise.exploration_mat",
            "noise.exploration_matrices",
        }
    ),  # a rollout draws its own
    "ddpg": FOR_THE_LOG | COPIED | TORCH | {"_episode_num"},
    "dqn, epsilon by episodes": (
        FOR_THE_LOG | COPIED | DRAWN | TORCH | {"exploration_rate"}
    ),  # by _episode_num
    "dqn, epsilon by steps": (
        FOR_THE_LOG | COPIED | TORCH | {"_episode_num", "exploration_rate"}
    ),  # by num_timesteps
    "td3": COPIED | {"_episode_num"},
    "sac, learned entropy coefficient": FOR_THE_LOG | COPIED | DRAWN | {"_episode_num"},
    "sarsa": (
        FOR_THE_LOG
        | NUMPY
        | TORCH
        | ACTIONS
        | {
            "exploration_rate",
            "last_obs",
            "env.ended",
            "env.lengths",
            "env.returns",
        }
    ),  # between two whole episodes
}
"""Entries of each case without effect: counts for logs, unused generators, computed values."""
NETWORKS_ASKED = ("ppo, an episode budget", "ddpg")
"""Cases that test each tensor of networks and optimizers; all cases share the code."""


class Stretch(BaseCallback):
    """Callback that learns from a state (None: the start) to the end of a rollout."""

    def __init__(self, start, end):
        """Learn from `start` to `end`."""
        super().__init__()
        self.start, self.end, self.episodes, self.reached = start, end, [], None

    def _on_training_start(self):
        self._restore()

    def _on_rollout_start(self):
        if self.model.num_timesteps >= self.end:
            self.reached = copy.deepcopy(capture(self.model, self.training_env))
            raise TrainingCompleted
        self._restore()
        self.start = None

    def _restore(self):
        if self.start is not None:
            restore(self.model, self.training_env, self.start)

    def _on_step(self):
        for info in self.locals["infos"]:
            if "episode" in info:
                self.episodes.append(
                    (
                        *info["terminal_observation"].tolist(),
                        info["episode"]["r"],
                        info["episode"]["l"],
                    )
                )
        return True


class Learner:
    """Model that learns from given states."""

    def __init__(self, config):
        """Make the model."""
        self.envs = make_sb3_vec_env(config.env, config.num_envs)
        self.model = config.agent.make_model(self.envs, config.seed)
        self.model.set_logger(Logger(None, []))

    def learn(self, start, end):
        """Return the resulting state, and the episodes by name."""
        stretch = Stretch(start, end)
        with pytest.raises(TrainingCompleted):
            self.model.learn(10**6, callback=stretch, log_interval=None)
        return stretch.reached, {
            **stretch.reached.arrays,
            **stretch.reached.facts,
            "episodes": stretch.episodes,
        }


def quick(config):
    """Return the configuration with few gradient steps."""
    if "gradient_steps" not in {field.name for field in dataclasses.fields(config.agent)}:
        return config
    return dataclasses.replace(
        config, agent=dataclasses.replace(config.agent, train_every=4, gradient_steps=2)
    )


def matters(learner, start, name, end, expected):
    """Return True if a change of an entry of the state is refused or changes what follows."""
    arrays, facts = dict(start.arrays), copy.deepcopy(start.facts)
    values = arrays if name in arrays else facts
    values[name] = another(name, values[name])
    try:
        _, reached = learner.learn(State(arrays, facts), end)
    except (RuntimeError, ValueError):
        return True
    return any(not equal(reached[entry], expected[entry]) for entry in expected if entry != name)


def another(name, value):
    """Return another value of the same type and shape."""
    if name == "random.torch":
        return torch.Generator().manual_seed(1).get_state().numpy()
    if name.startswith("random") and isinstance(value, dict):
        inner = value["state"]
        return value | {
            "state": {"pos": (inner["pos"] + 7) % 624} if "pos" in inner else inner | {"state": 1}
        }
    if name == "buffer.actions" and value.dtype.kind == "i":
        # There are two actions.
        return 1 - value
    if name.endswith(".groups"):
        return [group | {"betas": (0.5, 0.5)} for group in value]
    if name.endswith(".moments") or name == "buffer":
        return {}
    if isinstance(value, int):
        return value + 1
    if isinstance(value, float):
        return 0.9 * value + 0.01
    if value.dtype == bool:
        return ~value
    if value.dtype.kind in "iu":
        return value + value.dtype.type(20)
    noise = np.random.default_rng(0).standard_normal(value.shape)
    return value + (0.05 * noise * (1 + np.abs(value))).astype(value.dtype)


def equal(value, expected):
    if isinstance(value, np.ndarray):
        return np.array_equal(value, expected, equal_nan=value.dtype.kind == "f")
    return value == expected


def is_network(entry):
    return entry.startswith("policy.") or ".optimizer" in entry


@pytest.mark.parametrize("name", matrix_params(NETWORKS_ASKED, WITHOUT_EFFECT))
def test_every_entry_of_the_state_has_an_effect_and_must_exist(name):
    config = quick(CASES[name])
    learner = Learner(config)
    length = {"ppo": 32, "dqn": 24 * config.num_envs}.get(config.agent.name, 8 * config.num_envs)
    mattered = set()
    # Both are in the middle of episodes, before and after learning from a buffer begins.
    for first_steps in (20, 69 * config.num_envs):
        start, _ = learner.learn(None, first_steps)
        end = start.facts["num_timesteps"] + length
        _, expected = learner.learn(start, end)
        _, repeated = learner.learn(start, end)
        assert [entry for entry in expected if not equal(expected[entry], repeated[entry])] == []
        entries = {*start.arrays, *start.facts}
        # The order is fixed, because generators continue from one entry to the next.
        for entry in sorted(entries - mattered):
            network = is_network(entry) and config.agent.name != "sarsa"
            if not network or (first_steps > 20 and name in NETWORKS_ASKED):
                mattered |= {entry} if matters(learner, start, entry, end, expected) else set()
            else:
                mattered.add(entry)
    assert entries - mattered == EVERYWHERE | WITHOUT_EFFECT[name]
    for entry in entries:
        arrays, facts = (
            {key: value for key, value in part.items() if key != entry} for part in start
        )
        with pytest.raises(ValueError, match="belongs to another configuration"):
            restore(learner.model, learner.envs, State(arrays, facts))
