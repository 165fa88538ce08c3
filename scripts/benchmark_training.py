"""Compare how fast codrl_mj and other libraries learn CartPole and Pendulum, side by side.

    python scripts/benchmark_training.py --seeds 10
    python scripts/benchmark_training.py --only 'ours, fast' --task pendulum

Each contender has its own process and one core. It trains until both the mean of the last 100
training episodes and the mean of 20 greedy episodes are good enough (475 of 500; -200). The cost is
counted in processor seconds, without those greedy episodes, and in environment steps. The first
training of a process also pays for imports and compilers, so its time since the process's start has
its own column. Rows are appended to docs/results/training_speed.csv; trainings that already have a
row are skipped. Libraries that are not installed are reported and skipped: pip install '.[bench]'.
"""

import argparse
import collections
import contextlib
import csv
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

ROWS = Path(__file__).parents[1] / "docs" / "results" / "training_speed.csv"
PAGE = ROWS.parents[1] / "training_speed.md"
WRITTEN = "<!-- written by scripts/benchmark_training.py -->"
LIMITS = """## Limits

- A time is the median over the seeds that learned the task. Seeds that did not learn are left out.
  A cell with fewer than ten of them has their number in brackets.
- We made the settings `fast` for this stopwatch and these two tasks. The other libraries run the
  settings that their authors recommend, which are not tuned for these thresholds. Compare them with
  `default`, although we chose `default` on these tasks, too.
"""
"""Section below the table."""
COLUMNS = (
    "task",
    "contender",
    "seed",
    "steps",
    "seconds",
    "greedy_steps",
    "greedy_seconds",
    "first",
)
ENOUGH = {"cartpole": 475.0, "pendulum": -200.0}
TITLES = {"cartpole": "CartPole", "pendulum": "Pendulum"}
WORTH = {"cartpole": 200.0, "pendulum": -500.0}
"""Mean return of the last 20 training episodes above which greedy episodes are run."""
GYMNASIUM_IDS = {"cartpole": "CartPole-v1", "pendulum": "Pendulum-v1"}
BUDGET = 150_000
"""Number of environment steps after which a training has failed."""
INTERVAL = 2048
"""Number of environment steps between two tests with greedy episodes."""


class LearnedError(Exception):
    """Exception that ends a training: both means are good enough, or the budget is spent."""


class Watch:
    """Monitor of a training: steps and processor time until it is good enough, without tests."""

    def __init__(self, task: str, env: Callable[[], gymnasium.vector.VectorEnv]) -> None:
        """Start the clock; `env` makes 20 environments for greedy episodes."""
        self._task, self._make = task, env
        self._began, self.paused, self._looked = time.process_time(), 0.0, 0
        self.results: dict[str, Any] = {}

    def update(self, steps: int, returns: Any, act: Callable[[np.ndarray], np.ndarray]) -> None:
        """Update the results at the end of a rollout.

        Args:
            steps: environment steps so far.
            returns: returns of the last training episodes, or None if the library does not report
                them; then only greedy episodes count.
            act: greedy policy, from observations (n, k) to actions (n, ...).

        Raises:
            LearnedError: both means are good enough, or the budget is spent.
        """
        now = time.process_time() - self._began - self.paused
        last = [WORTH[self._task]] * 20 if returns is None else list(returns)
        if (
            "steps" not in self.results
            and len(last) >= 100
            # Before there are 100 training episodes their mean says little.
            and np.mean(last[-100:]) >= ENOUGH[self._task]
        ):
            self.results |= {"steps": steps, "seconds": now}
        promising = len(last) >= 20 and np.mean(last[-20:]) >= WORTH[self._task]
        if "greedy_steps" not in self.results and promising and steps - self._looked >= INTERVAL:
            self._looked, start = steps, time.process_time()
            if self._greedy(act) >= ENOUGH[self._task]:
                self.results |= {"greedy_steps": steps, "greedy_seconds": now}
            self.paused += time.process_time() - start
        if len(self.results) == (2 if returns is None else 4) or steps >= BUDGET:
            raise LearnedError

    def _greedy(self, act: Callable[[np.ndarray], np.ndarray]) -> float:
        envs = self._make()
        observations, _ = envs.reset(seed=1_000_000)
        total, over = np.zeros(envs.num_envs), np.zeros(envs.num_envs, dtype=bool)
        while not over.all():
            observations, rewards, terminated, truncated, _ = envs.step(act(observations))
            total += np.where(over, 0.0, rewards)
            over |= terminated | truncated
        envs.close()
        return float(total.mean())


def _watch_callback(watch: Watch) -> Any:
    """Return a callback for Stable-Baselines3 and for libraries built on it."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Look(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            assert self.model.ep_info_buffer is not None
            act = lambda observations: self.model.predict(observations, deterministic=True)[0]  # noqa: E731
            watch.update(
                self.num_timesteps, [episode["r"] for episode in self.model.ep_info_buffer], act
            )

    return Look()


def _test_envs(task: str, actuator: str | None) -> Callable[[], gymnasium.vector.VectorEnv]:
    """Return a function that makes 20 environments, Gymnasium's or ours."""
    if actuator is None:
        return lambda: gymnasium.make_vec(GYMNASIUM_IDS[task], 20, "sync")
    import codrl_mj

    return lambda: codrl_mj.make_vec(task, 20, actuator=actuator)


def ours(settings: str, actuator: str | None) -> Callable[[str, int, Watch], None]:
    """Return our PPO with its own settings on our task; actuator None: on Gymnasium's task."""

    def run(task: str, seed: int, watch: Watch) -> None:
        from stable_baselines3.common.env_util import make_vec_env

        from codrl_mj import TrainConfig, make_sb3_vec_env

        config = TrainConfig.preset(task, "ppo", settings, actuator or "default")
        count = config.num_envs
        env = (
            make_vec_env(GYMNASIUM_IDS[task], count)
            if actuator is None
            else make_sb3_vec_env(config.env, count)
        )
        config.agent.make_model(env, seed).learn(BUDGET, _watch_callback(watch))

    return run


ZOO: dict[str, dict[str, Any]] = {
    "cartpole": {
        "n_steps": 32,
        "batch_size": 256,
        "gae_lambda": 0.8,
        "gamma": 0.98,
        "n_epochs": 20,
        "ent_coef": 0.0,
    },
    "pendulum": {
        "n_steps": 1024,
        "batch_size": 64,
        "gae_lambda": 0.95,
        "gamma": 0.9,
        "n_epochs": 10,
        "use_sde": True,
    },
}
"""Settings for PPO of RL Baselines3 Zoo, except schedules and numbers of environments.

On CartPole the learning rate falls linearly from 1e-3, and the clip range from 0.2. The zoo uses
eight environments for CartPole and four for Pendulum.
"""


def on_stable_baselines3(library: str, actuator: str | None) -> Callable[[str, int, Watch], None]:
    """Return PPO of `stable_baselines3` or `sbx`, with the zoo's settings."""

    def run(task: str, seed: int, watch: Watch) -> None:
        import importlib

        from stable_baselines3.common.env_util import make_vec_env

        from codrl_mj import make_sb3_vec_env
        from codrl_mj.envs.config import EnvConfig

        is_cartpole = task == "cartpole"
        # sbx takes a function for the learning rate, but only a number for the clip range.
        settings = ZOO[task] | {
            "learning_rate": (lambda progress_remaining: 1e-3 * progress_remaining)
            if is_cartpole
            else 1e-3,
            "clip_range": (lambda progress_remaining: 0.2 * progress_remaining)
            if is_cartpole and library != "sbx"
            else 0.2,
        }
        if settings.get("use_sde"):
            # The zoo samples the exploration noise of Pendulum's gSDE every four steps.
            settings["sde_sample_freq"] = 4
        count = 8 if is_cartpole else 4
        env: Any = make_vec_env(GYMNASIUM_IDS[task], count, seed=seed)
        if actuator is not None:
            env = make_sb3_vec_env(EnvConfig(task, actuator), count)
        model = importlib.import_module(library).PPO("MlpPolicy", env, seed=seed, **settings)
        model.learn(100_000, _watch_callback(watch))

    return run


def with_rlox(task: str, seed: int, watch: Watch) -> None:
    """Train PPO of `rlox`, with its own settings."""
    import torch
    from rlox.algorithms.ppo import PPO
    from rlox.callbacks import Callback

    class Look(Callback):
        def on_rollout_end(self, **arguments: Any) -> None:
            act = lambda observations: np.asarray(  # noqa: E731
                algorithm.predict(torch.as_tensor(observations, dtype=torch.float32))
            )
            config = algorithm.config
            watch.update((arguments["update"] + 1) * config.n_envs * config.n_steps, None, act)

    algorithm = PPO(GYMNASIUM_IDS[task], seed=seed, callbacks=[Look()])
    algorithm.train(BUDGET)


def with_rltools(task: str, seed: int, watch: Watch) -> None:
    """Train SAC of `rltools`, compiled for the environment at run time."""
    from gymnasium.wrappers import RescaleAction
    from rltools import SAC

    if task != "pendulum":
        raise NotImplementedError("its SAC has continuous actions")
    returns: collections.deque[float] = collections.deque(maxlen=100)

    class Counted(gymnasium.Wrapper):
        total = 0.0

        def reset(self, **arguments: Any) -> Any:
            self.total = 0.0
            return self.env.reset(**arguments)

        def step(self, action: Any) -> Any:
            observation, reward, terminated, truncated, info = self.env.step(action)
            self.total += float(reward)
            if terminated or truncated:
                returns.append(self.total)
            return observation, reward, terminated, truncated, info

    # rltools only takes actions from -1 to 1.
    def make() -> gymnasium.Env:
        env = RescaleAction(
            Counted(gymnasium.make(GYMNASIUM_IDS[task])), np.float32(-1.0), np.float32(1.0)
        )
        env.reset(seed=seed)
        return env

    state = SAC(make).State(seed)
    # Actions are rescaled to Pendulum's range, from -2 to 2 N*m.
    act = lambda rows: 2.0 * np.array([state.action(row) for row in rows], dtype=np.float32)  # noqa: E731
    for steps in range(1, BUDGET + 1):
        if state.step():
            break
        if steps % 1000 == 0:
            watch.update(steps, returns, act)


def with_envpool(task: str, seed: int, watch: Watch) -> None:
    """Train a PPO that is written in one file, as in many tutorials, on EnvPool's environments."""
    import envpool
    import torch
    from torch import nn

    torch.manual_seed(seed)
    discrete, count, length = task == "cartpole", 32, 64
    gamma, decay, rate, epochs, batch = (
        (0.99, 0.95, 1e-3, 10, 256) if discrete else (0.9, 0.95, 1e-3, 10, 256)
    )
    envs = envpool.make_gymnasium(GYMNASIUM_IDS[task], num_envs=count, seed=seed, num_threads=1)
    inputs, outputs = envs.observation_space.shape[0], 2 if discrete else 1

    def network(last: int) -> nn.Sequential:
        return nn.Sequential(
            nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, last)
        )

    actor, critic, log_std = network(outputs), network(1), nn.Parameter(torch.zeros(outputs))
    parameters = [*actor.parameters(), *critic.parameters(), log_std]
    optimizer = torch.optim.Adam(parameters, lr=rate, eps=1e-5, fused=True)
    scale = torch.ones(inputs) if discrete else torch.tensor([1.0, 1.0, 0.2])

    def policy(observations: torch.Tensor) -> Any:
        out = actor(observations * scale)
        if discrete:
            return torch.distributions.Categorical(logits=out)
        return torch.distributions.Independent(torch.distributions.Normal(out, log_std.exp()), 1)

    def act(observations: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            out = actor(torch.as_tensor(observations, dtype=torch.float32) * scale)
        actions: np.ndarray = out.argmax(1).numpy() if discrete else np.clip(out.numpy(), -2.0, 2.0)
        return actions

    returns: collections.deque[float] = collections.deque(maxlen=100)
    total, steps = np.zeros(count), 0
    observation = torch.as_tensor(envs.reset()[0], dtype=torch.float32)
    # EnvPool's first step after an episode's end is a reset; its reward and action do not count.
    is_reset = torch.zeros(count, dtype=torch.bool)
    while True:
        rollout: list[Any] = []
        with torch.no_grad():
            for _ in range(length):
                chosen = policy(observation)
                action = chosen.sample()
                clipped = action.numpy() if discrete else np.clip(action.numpy(), -2.0, 2.0)
                next_observation, reward, terminated, truncated, _ = envs.step(clipped)
                total += np.where(is_reset.numpy(), 0.0, reward)
                ended = terminated | truncated
                returns.extend(total[ended])
                total[ended] = 0.0
                rollout.append(
                    (
                        observation,
                        action,
                        chosen.log_prob(action),
                        torch.as_tensor(reward, dtype=torch.float32),
                        is_reset,
                        torch.as_tensor(terminated),
                        torch.as_tensor(ended),
                    )
                )
                observation = torch.as_tensor(next_observation, dtype=torch.float32)
                is_reset = torch.as_tensor(ended)
            steps += count * length
            states, actions, log_probs, rewards, is_reset_step, is_terminal, is_last = map(
                torch.stack, zip(*rollout, strict=True)
            )
            values = critic(torch.cat([states, observation[None]]) * scale)[..., 0]
            advantage, advantages = torch.zeros(count), torch.zeros(length, count)
            # Generalized advantage estimation, backwards in time.
            for step in reversed(range(length)):
                error = rewards[step] + gamma * values[step + 1] * ~is_terminal[step] - values[step]
                advantage = error + gamma * decay * advantage * ~is_last[step]
                advantages[step] = advantage
        watch.update(steps, returns, act)
        use = ~is_reset_step.flatten()
        columns = [
            column.flatten(0, 1)[use]
            for column in (states, actions, log_probs, advantages, advantages + values[:-1])
        ]
        for _ in range(epochs):
            for rows in torch.randperm(len(columns[0])).split(batch):
                state, action, old, gain, target = (column[rows] for column in columns)
                ratio = (policy(state).log_prob(action) - old).exp()
                gain = (gain - gain.mean()) / (gain.std() + 1e-8)
                loss = -torch.min(ratio * gain, ratio.clamp(0.8, 1.2) * gain).mean()
                loss = loss + 0.5 * (critic(state * scale)[:, 0] - target).square().mean()
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(parameters, 0.5)
                optimizer.step()


CONTENDERS: dict[str, tuple[Callable[[str, int, Watch], None], str | None]] = {
    # Name -> training, and actuator of the environment; None: Gymnasium's own task.
    "ours, default, Gymnasium's task": (ours("default", None), None),
    "ours, fast, Gymnasium's task": (ours("fast", None), None),
    "ours, default, ideal force": (ours("default", "ideal"), "ideal"),
    "ours, fast, ideal force": (ours("fast", "ideal"), "ideal"),
    "ours, default, through a motor": (ours("default", "paper"), "paper"),
    "ours, fast, through a motor": (ours("fast", "paper"), "paper"),
    "Stable-Baselines3, Gymnasium's task": (on_stable_baselines3("stable_baselines3", None), None),
    "Stable-Baselines3, through a motor": (
        on_stable_baselines3("stable_baselines3", "paper"),
        "paper",
    ),
    "SBX, Gymnasium's task": (on_stable_baselines3("sbx", None), None),
    "SBX, through a motor": (on_stable_baselines3("sbx", "paper"), "paper"),
    "rlox, Gymnasium's task": (with_rlox, None),
    "rltools (SAC), Gymnasium's task": (with_rltools, None),
    "one file, EnvPool's task": (with_envpool, None),
}


def contend(task: str, contender: str, seeds: list[int]) -> None:
    """Train a contender with some seeds in this process, and append a row for each."""
    # All libraries run on one core, even if they start several threads.
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    train, actuator = CONTENDERS[contender]
    for seed in seeds:
        watch = Watch(task, _test_envs(task, actuator))
        with contextlib.suppress(LearnedError):
            train(task, seed, watch)
        # Only the first training of a process pays for imports and compilation.
        first = time.process_time() - watch.paused if seed == seeds[0] else ""
        with ROWS.open("a", newline="") as file:
            csv.DictWriter(file, COLUMNS).writerow(
                {
                    "task": task,
                    "contender": contender,
                    "seed": seed,
                    "first": first,
                    **watch.results,
                }
            )


def rows() -> list[dict[str, str]]:
    """Return the published rows."""
    return list(csv.DictReader(ROWS.open(newline=""))) if ROWS.is_file() else []


def medians(task: str, name: str) -> dict[str, float]:
    """Return the medians over a contender's seeds; `seeds` and `learned` count its trainings."""
    contender_rows = [row for row in rows() if (row["task"], row["contender"]) == (task, name)]
    numbers = {
        "seeds": len(contender_rows),
        "learned": sum(bool(row["greedy_steps"]) for row in contender_rows),
    }
    known = {
        column: [float(row[column]) for row in contender_rows if row[column]]
        for column in COLUMNS[3:]
    }
    return numbers | {
        column: statistics.median(values) for column, values in known.items() if values
    }


FORMS = {"greedy_seconds": ".1f", "greedy_steps": ",.0f"}
"""Columns of the table -> number formats."""


def table() -> str:
    """Return the Markdown table of seconds and steps.

    Contenders with our ideal forces are left out: they take as long as those with our motors.
    """
    titles = [TITLES[task] for task in ENOUGH]
    lines = [
        f"| | {' | '.join(f'{title}: seconds | steps' for title in titles)} |",
        f"| --- |{' ---: |' * len(FORMS) * len(titles)}",
    ]
    for name in (name for name in CONTENDERS if not name.endswith("ideal force")):
        cells = [name]
        for task in ENOUGH:
            numbers = medians(task, name)
            seconds, *others = (
                format(numbers[key], form) if key in numbers else "–" for key, form in FORMS.items()
            )
            note = (
                f" ({numbers['learned']:.0f} of {numbers['seeds']:.0f})"
                if numbers["learned"] < numbers["seeds"]
                else ""
            )
            cells += [seconds + note, *others]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def draw() -> None:
    """Draw the seconds until each contender has learned each task, as bars."""
    from matplotlib.figure import Figure

    from codrl_mj.study.pages import save_figure

    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    for axes, (task, enough) in zip(
        figure.subplots(1, len(ENOUGH), sharey=True), ENOUGH.items(), strict=True
    ):
        seconds = {
            name: medians(task, name).get("greedy_seconds", 0.0) for name in reversed(CONTENDERS)
        }
        colors = ["#0072B2" if name.startswith("ours") else "#999999" for name in seconds]
        bars = axes.barh([*seconds], [*seconds.values()], color=colors)
        axes.bar_label(
            bars, [f"{value:.1f}" if value else "–" for value in seconds.values()], padding=3
        )
        axes.set(title=f"{TITLES[task]} to {enough:g}", xlabel="seconds of one core")
        axes.margins(x=0.15)
        axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, ROWS.with_suffix(".svg"))


def main() -> None:
    """Run the missing trainings, print the table, and write it on its page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--task", choices=list(ENOUGH))
    parser.add_argument("--only", default="", help="only contenders whose name contains this")
    parser.add_argument("--here", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if not ROWS.is_file():
        with ROWS.open("w", newline="") as file:
            csv.DictWriter(file, COLUMNS).writeheader()
    for task in [options.task] if options.task else list(ENOUGH):
        for name in CONTENDERS:
            finished_seeds = {
                int(row["seed"])
                for row in rows()
                if (row["task"], row["contender"]) == (task, name)
            }
            seeds = [seed for seed in range(options.seeds) if seed not in finished_seeds]
            if options.here == name:
                contend(task, name, seeds)
            elif not options.here and seeds and options.only in name:
                arguments = ["--task", task, "--seeds", str(options.seeds), "--here", name]
                # The libraries read their number of threads when they are imported, so a child
                # process is used.
                single = dict.fromkeys(
                    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"
                )
                child_command = [sys.executable, __file__, *arguments]
                completed = subprocess.run(
                    child_command,
                    env=os.environ | single,
                    check=False,
                    capture_output=True,
                    text=True,
                )
                if completed.returncode:
                    print(
                        f"left out: {name}, {task}: {completed.stderr.strip().splitlines()[-1]}",
                        flush=True,
                    )
                else:
                    print(f"measured: {name}, {task}", flush=True)
    if not options.here:
        written = f"{table()}\n{LIMITS}"
        print(written)
        PAGE.write_text(f"{PAGE.read_text().partition(WRITTEN)[0]}{WRITTEN}\n\n{written}")
        draw()


if __name__ == "__main__":
    main()
