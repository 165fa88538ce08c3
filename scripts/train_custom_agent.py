"""Train a custom agent on our environments: proximal policy optimization (PPO) in plain torch.

The whole agent is in this file. It uses the registered environments, which `gym.make_vec` steps
together, and no agent library. Copy it and change it as you like. `docs/other_agents.md` shows how
the weights are used.

Example: python scripts/train_custom_agent.py --task pendulum --actuator paper --total-steps 400000
"""

import dataclasses
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode, VectorEnv
from rich.progress import Progress
from safetensors.torch import save
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Independent, Normal

from codrl_mj.runs.files import atomic_write
from codrl_mj.tasks import TASKS

# These options must be at least 1, those of AMOUNTS at least 0.
COUNTS = (
    "num_envs",
    "total_steps",
    "rollout",
    "epochs",
    "minibatches",
    "hidden",
    "eval_episodes",
)
AMOUNTS = (
    "seed",
    "learning_rate",
    "clip",
    "entropy",
    "target_kl",
    "gamma",
    "gae_lambda",
)


@dataclasses.dataclass(frozen=True)
class Options:
    """Train PPO through an actuator, evaluate it greedily, and save its weights."""

    task: Literal[tuple(TASKS)] = "cartpole"  # type: ignore[valid-type]
    """Task to learn."""
    actuator: str = "default"
    """Actuator: ideal, paper, weak, weaker or open_loop."""
    num_envs: int = 64
    """Number of parallel environments, >= 1."""
    total_steps: int = 200_000
    """Number of environment steps, >= 1; rounded up to whole rollouts."""
    seed: int = 0
    """Seed of weights, actions and environments, >= 0; the same seed gives the same weights."""
    out: Path = Path("runs/custom.safetensors")
    """File for the weights."""
    rollout: int = 32
    """Steps of every environment between two updates, >= 1."""
    epochs: int = 10
    """Passes over each rollout, >= 1, unless `target_kl` stops them."""
    minibatches: int = 8
    """Gradient steps in a pass, >= 1."""
    learning_rate: float = 1e-3
    """Adam's first step size, >= 0; it falls linearly to 0."""
    gamma: float = 0.99
    """Discount factor, from 0 to 1."""
    gae_lambda: float = 0.97
    """Lambda of generalized advantage estimation, from 0 to 1."""
    clip: float = 0.2
    """Clip range of the probability ratio, >= 0."""
    entropy: float = 0.0
    """Weight of the entropy bonus, >= 0."""
    target_kl: float = 0.015
    """KL divergence [nat] from the old policy at which passes over a rollout stop, >= 0."""
    hidden: int = 64
    """Units in each of the two hidden layers of actor and critic, >= 1."""
    eval_episodes: int = 100
    """Number of evaluation episodes, >= 1."""

    def check(self) -> None:
        """Raise ValueError, naming field, value and bound, if a number is out of bounds."""
        for name in COUNTS + AMOUNTS:
            minimum = int(name in COUNTS)
            maximum = 1 if name in ("gamma", "gae_lambda") else math.inf
            if not minimum <= getattr(self, name) <= maximum:
                raise ValueError(
                    f"--{name.replace('_', '-')} {getattr(self, name)}: must be from {minimum} to"
                    f" {maximum}"
                )
        if (size := self.num_envs * self.rollout) < 2 * self.minibatches:
            raise ValueError(
                f"--minibatches {self.minibatches}: must be <= {size // 2}, half the steps of a"
                " rollout"
            )


class Moments(nn.Module):
    """Running mean and variance, which bring observations and rewards to a common scale."""

    mean: Tensor
    variance: Tensor
    count: Tensor

    def __init__(self, size: int) -> None:  # noqa: D107
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("variance", torch.ones(size))
        self.register_buffer("count", torch.zeros(()))

    def update(self, batch: Tensor) -> None:
        """Include a batch (n, size), by the formula of Chan, Golub and LeVeque (1979)."""
        total, difference = self.count + len(batch), batch.mean(0) - self.mean
        squares = self.variance * self.count + batch.var(0, correction=0) * len(batch)
        self.variance = (squares + difference**2 * self.count * len(batch) / total) / total
        self.mean, self.count = self.mean + difference * len(batch) / total, total

    def scale(self) -> Tensor:
        """Return the standard deviations (size,), never 0."""
        return (self.variance + 1e-8).sqrt()

    def forward(self, values: Tensor) -> Tensor:
        """Center and scale values, and clip them at 10 standard deviations."""
        return ((values - self.mean) / self.scale()).clamp(-10.0, 10.0)


def network(inputs: int, hidden: int, outputs: int, gain: float) -> nn.Sequential:
    """Create two hidden tanh layers with orthogonal weights; `gain` scales the last layer's."""
    layers = [nn.Linear(inputs, hidden), nn.Linear(hidden, hidden), nn.Linear(hidden, outputs)]
    for layer, scale in zip(layers, (math.sqrt(2), math.sqrt(2), gain), strict=True):
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.Tanh(), layers[1], nn.Tanh(), layers[2])


class Agent(nn.Module):
    """Actor and critic.

    Continuous actions are Gaussian, on a scale where the bounds are -1 and 1, and clipped there.
    """

    def __init__(self, observations: gym.Space[Any], actions: Any, hidden: int) -> None:  # noqa: D107
        super().__init__()
        self.discrete = isinstance(actions, gym.spaces.Discrete)
        inputs = math.prod(observations.shape or ())
        outputs = int(actions.n) if self.discrete else actions.shape[0]
        self.seen = Moments(inputs)
        self.actor = network(inputs, hidden, outputs, 0.01)
        self.critic = network(inputs, hidden, 1, 1.0)
        if not self.discrete:
            self.log_std = nn.Parameter(torch.full((outputs,), -0.5))
            self.register_buffer("middle", torch.as_tensor(actions.high + actions.low) / 2)
            self.register_buffer("reach", torch.as_tensor(actions.high - actions.low) / 2)

    def policy(self, observations: Tensor) -> Distribution:
        """Return the distribution of actions for observations (..., k)."""
        outputs = self.actor(self.seen(observations))
        if self.discrete:
            return Categorical(logits=outputs, validate_args=False)
        return Independent(
            Normal(outputs, self.log_std.exp(), validate_args=False), 1, validate_args=False
        )

    def value(self, observations: Tensor) -> Tensor:
        """Return the expected discounted return (...,), in units of the scale in `train`."""
        return self.critic(self.seen(observations)).squeeze(-1)

    @torch.no_grad()  # type: ignore[untyped-decorator]
    def act(self, observations: np.ndarray, greedy: bool = True) -> tuple[Tensor, np.ndarray]:
        """Return actions for observations (n, k): as the policy draws them, and as commands."""
        policy = self.policy(torch.as_tensor(observations))
        actions = policy.mode if greedy else policy.sample()
        return (
            actions,
            (actions if self.discrete else self.middle + self.reach * actions.clamp(-1, 1)).numpy(),
        )


def advantages(
    rewards: Tensor,
    values: Tensor,
    next_values: Tensor,
    terminated: Tensor,
    ended: Tensor,
    gamma: float,
    lam: float,
) -> Tensor:
    """Estimate advantages (GAE, Schulman et al., arXiv 1506.02438); all shapes are (T, N).

    `values` are of the observation before each step, `next_values` of the one after it, which is
    the last one of the episode if it `ended`. Rewards after an episode that the task `terminated`
    are zero; after a time limit their expected value counts.
    """
    errors = rewards + gamma * next_values * ~terminated - values
    result, next_advantage = torch.zeros_like(rewards), torch.zeros_like(rewards[0])
    for step in reversed(range(len(rewards))):
        result[step] = next_advantage = errors[step] + gamma * lam * next_advantage * ~ended[step]
    return result


def make_envs(options: Options, num_envs: int) -> VectorEnv[Any, Any, Any]:
    """Create environments on one thread, which reset in the step that ends an episode."""
    arguments: Any = {
        "actuator": options.actuator,
        "num_threads": 1,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    env_id = TASKS[options.task].env_id
    return gym.make_vec(env_id, num_envs, vectorization_mode="vector_entry_point", **arguments)


def train(options: Options, on_rollout: Callable[[int, float], None] | None = None) -> Agent:
    """Train an agent.

    Args:
        options: options of the command line.
        on_rollout: called with the steps so far and the mean return of the last 100 episodes, NaN
            before the first has ended.


    Raises:
        ValueError: an option is out of bounds, or the actuator is unknown or unstable.
    """
    options.check()
    # Networks of this size are slower on several threads.
    torch.set_num_threads(1)
    torch.manual_seed(options.seed)
    envs = make_envs(options, options.num_envs)
    agent = Agent(envs.single_observation_space, envs.single_action_space, options.hidden)
    optimizer = torch.optim.Adam(agent.parameters(), eps=1e-5)
    returns, finished = Moments(1), [math.nan]
    discounted, undiscounted = np.zeros((2, options.num_envs))
    size = options.rollout * options.num_envs
    rollouts = math.ceil(options.total_steps / size)
    observations, _ = envs.reset(seed=options.seed)
    for rollout in range(rollouts):
        steps = []
        for _ in range(options.rollout):
            actions, commands = agent.act(observations, greedy=False)
            next_observations, rewards, terminated, truncated, infos = envs.step(commands)
            ended, final_observations = terminated | truncated, next_observations.copy()
            if ended.any():
                # Here `next_observations` has the first observation of the next episode.
                final_observations[ended] = np.stack(infos["final_obs"][ended])
            discounted, undiscounted = rewards + options.gamma * discounted, rewards + undiscounted
            steps.append(
                (observations, actions, rewards, final_observations, terminated, ended, discounted)
            )
            finished += undiscounted[ended].tolist()
            discounted = discounted * ~ended
            undiscounted = undiscounted * ~ended
            observations = next_observations
        columns = (torch.as_tensor(np.stack(column)) for column in zip(*steps, strict=True))
        states, taken_actions, scaled_rewards, next_states, terminations, ends, discounted_sums = (
            columns
        )
        returns.update(discounted_sums.float().reshape(-1, 1))
        with torch.no_grad():
            log_probs = agent.policy(states).log_prob(taken_actions)
            values = agent.value(states)
            next_values = agent.value(next_states)
        # The scale of the discounted sums adapts the critic's targets to any task's rewards.
        scaled_rewards = scaled_rewards.float() / returns.scale()
        gains = advantages(
            scaled_rewards,
            values,
            next_values,
            terminations,
            ends,
            options.gamma,
            options.gae_lambda,
        )
        optimizer.param_groups[0]["lr"] = options.learning_rate * (1 - rollout / rollouts)
        batch = [
            tensor.flatten(0, 1)
            for tensor in (states, taken_actions, log_probs, gains, gains + values)
        ]
        improve(agent, optimizer, batch, options)
        agent.seen.update(batch[0])
        if on_rollout is not None:
            on_rollout((rollout + 1) * size, float(np.mean(finished[1:][-100:] or finished)))
    envs.close()
    return agent


def improve(
    agent: Agent, optimizer: torch.optim.Optimizer, batch: list[Tensor], options: Options
) -> None:
    """Take gradient steps on PPO's clipped objective (Schulman et al., arXiv 1707.06347).

    `batch` has n observations, actions, their log-probabilities under the old policy, advantages,
    and returns.
    """
    for _ in range(options.epochs):
        divergences = []
        for rows in torch.randperm(len(batch[0])).tensor_split(options.minibatches):
            states, taken_actions, log_probs, gains, targets = (tensor[rows] for tensor in batch)
            gains = (gains - gains.mean()) / (gains.std() + 1e-8)
            policy = agent.policy(states)
            log_ratio = policy.log_prob(taken_actions) - log_probs
            ratio = log_ratio.exp()
            objective = torch.minimum(
                ratio * gains, ratio.clamp(1 - options.clip, 1 + options.clip) * gains
            ).mean()
            error = (agent.value(states) - targets).square().mean()
            optimizer.zero_grad()
            (error / 2 - objective - options.entropy * policy.entropy().mean()).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()
            # This estimate of the KL divergence is never negative.
            divergences.append((ratio - 1 - log_ratio).mean().item())
        if np.mean(divergences) > options.target_kl:
            return


def evaluate(agent: Agent, options: Options) -> np.ndarray:
    """Return the returns of greedy episodes, shape (eval_episodes,), from other initial states."""
    envs = make_envs(options, options.eval_episodes)
    observations, _ = envs.reset(seed=2**31 + options.seed)
    returns, running = np.zeros(options.eval_episodes), np.ones(options.eval_episodes, dtype=bool)
    while running.any():
        observations, rewards, terminated, truncated, _ = envs.step(agent.act(observations)[1])
        returns += rewards * running
        running &= ~(terminated | truncated)
    envs.close()
    return returns


def main(arguments: list[str] | None = None) -> int:
    """Train, evaluate and save."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        with atomic_write(options.out) as out, Progress() as bar:
            row = bar.add_task(options.task, total=options.total_steps)

            def show(steps: int, mean_return: float) -> None:
                bar.update(
                    row, completed=steps, description=f"{options.task}, return {mean_return:.0f}"
                )

            agent = train(options, show)
            out.write_bytes(save(agent.state_dict()))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    returns = evaluate(agent, options)
    print(
        f"greedy return: {returns.mean():.1f} (worst {returns.min():.1f}) over {len(returns)}"
        " episodes"
    )
    print(f"weights: {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
