"""Tiny trainings of all agents, interruptions, and results that must be equal."""

import contextlib
import functools
import importlib.util
import math
import signal
import sys
from pathlib import Path

from codrl_mj.agents import DDPGConfig, DQNConfig, PPOConfig, SACConfig, SARSAConfig, TD3Config
from codrl_mj.disturbances import Disturbances
from codrl_mj.envs.config import EnvConfig
from codrl_mj.runs.files import with_digest, write_json
from codrl_mj.training import TrainConfig, TrainingStoppedError, train
from codrl_mj.training.folder import prepare_run
from codrl_mj.training.watcher import Watcher


def _kill_test():
    """Import scripts/kill_test.py, which does the same with the program."""
    path = Path(__file__).parents[2] / "scripts" / "kill_test.py"
    spec = importlib.util.spec_from_file_location("kill_test", path)
    module = sys.modules["kill_test"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


kill_test = _kill_test()
outcome, differing = kill_test.outcome, kill_test.differing


def begin(run, config):
    """Create a run folder in which a training has started and nothing is learned."""
    write_json(
        run / "config.json",
        with_digest(prepare_run(run, config, resume=False, accept_changes=False)),
    )


def tiny(task, agent, num_envs=1, actuator="paper", total_episodes=None, **env):
    """Return a training of about a second, with three or four checkpoints and evaluations."""
    often = {"checkpoint_interval": 60, "evaluation_interval": 80, "evaluation_episodes": 2}
    budget = {"total_steps": None if total_episodes else 240, "total_episodes": total_episodes}
    env = EnvConfig(task, actuator, max_episode_steps=25, **env)
    return TrainConfig(env, agent, seed=3, num_envs=num_envs, **often, **budget)


_SMALL = {
    "learning_starts": 40,
    "batch_size": 16,
    "buffer_size": 150,
}  # the buffer fills, and is written over
PPO = functools.partial(PPOConfig, rollout_steps=32, batch_size=16, epochs=2, hidden=(8, 8))
DDPG = functools.partial(DDPGConfig, actor_units=(8,), joint_units=(8,), **_SMALL)
DQN, TD3, SAC = (
    functools.partial(agent, hidden=(8,), **_SMALL) for agent in (DQNConfig, TD3Config, SACConfig)
)
DRAWN = {
    "randomize": {"motor.inductance": "uniform(0.05, 0.15)", "controller.kp": "choice(0.5, 1)"}
}
DISTURBED = {
    "disturbances": Disturbances(
        command_delay=0.03, pulse_interval=0.2, pulse_force=0.5, pulse_duration=0.05
    )
}
NOISY = {"controller": {"current_noise": 0.1, "current_bias": 0.05}}
NOISY_PAPER = {"name": "paper", **NOISY}
"""Actuators with errors of the current sensor."""

CASES = {
    "ppo, one optimiser": tiny(
        "cartpole", PPO(), 4, "weaker", options={"center_radius": 0.1}, observe_actuator=True
    ),
    "ppo, separate learning rates": tiny(
        "cartpole", PPO(critic_learning_rate=3e-3), 2, physics="analytic"
    ),
    "ppo, an episode budget": tiny(
        "cartpole",
        PPO(critic_learning_rate=3e-3),
        2,
        NOISY_PAPER,
        total_episodes=9,
        **DRAWN,
        **DISTURBED,
    ),
    "ppo, state-dependent noise": tiny("pendulum", PPO(state_dependent_noise=True), 2),
    "ppo, state-dependent noise, drawn often": tiny(
        "pendulum", PPO(state_dependent_noise=True, noise_steps=5)
    ),
    "ddpg": tiny(
        "pendulum",
        DDPG(critic_learning_rate=2e-3),
        1,
        NOISY_PAPER,
        observe_actuator=True,
        **DISTURBED,
    ),
    "ddpg, several environments": tiny(
        "pendulum", DDPG(train_every=4, gradient_steps=1), 3, physics="analytic"
    ),
    "ddpg, trained after episodes": tiny(
        "pendulum", DDPG(train_every=None, gradient_steps=5), total_episodes=8, **DRAWN
    ),
    "dqn, epsilon by episodes": tiny("cartpole", DQN(target_every=7), **DRAWN),
    "dqn, epsilon by steps": tiny(
        "cartpole",
        DQN(exploration_decay=None, exploration_fraction=0.8, target_every=10),
        3,
        physics="analytic",
    ),
    "td3": tiny("pendulum", TD3(), 2, NOISY_PAPER, **DISTURBED),
    "sac, learned entropy coefficient": tiny("pendulum", SAC(), **DRAWN),
    "sac, state-dependent noise": tiny(
        "pendulum", SAC(entropy_coefficient=0.1, state_dependent_noise=True, train_every=6), 2
    ),
    "sarsa": tiny(
        "mountain_car",
        SARSAConfig(epsilon=0.2, epsilon_decay=0.9),
        1,
        {"name": "weak", **NOISY},
        **DISTURBED,
    ),
    "sarsa, traces": tiny(
        "mountain_car",
        SARSAConfig(epsilon=0.1, trace_decay=0.8),
        total_episodes=9,
        physics="analytic",
    ),
}
"""Trainings of all agents, with one and several environments, both physics, and all features."""


class Crash(BaseException):
    """Error that stands for the end of a process within a test."""


def crash(*_):
    raise Crash


TERMINATE, INTERRUPT = (
    functools.partial(signal.raise_signal, number) for number in (signal.SIGTERM, signal.SIGINT)
)


@contextlib.contextmanager
def after(steps, act):
    """Act once in a block, when a training has taken some environment steps."""
    original, due = Watcher._on_step, None

    def counting(watcher):
        nonlocal due
        due = watcher.saved_steps + steps if due is None else due
        goes_on = original(watcher)
        if watcher.num_timesteps >= due:
            due = math.inf
            act()
        return goes_on

    Watcher._on_step = counting
    try:
        yield
    finally:
        Watcher._on_step = original


def interrupt(config, out, steps, act):
    """Start or continue a training that ends early, by an action after some steps.

    Returns:
        The message of a training that was stopped; None if it crashed.
    """
    try:
        with after(steps, act):
            train(config, out, resume=True, tensorboard=False)
    except TrainingStoppedError as stopped:
        return str(stopped)
    except Crash:
        return None
    raise AssertionError("it came to its end")


def resume(config, out):
    return train(config, out, resume=True, tensorboard=False)
