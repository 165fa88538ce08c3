"""Trainings side by side: how soon CartPole and Pendulum are learned, by ours and by other libraries.

    python scripts/benchmark_training.py --seeds 10
    python scripts/benchmark_training.py --only 'ours, fast' --task pendulum

Each contender has a process of its own and one core, and trains until the mean of the last 100
training episodes and that of 20 greedy episodes have both been good enough (475 of 500; -200).
Counted are processor seconds without those greedy episodes, and environment steps. The first
training of a process also pays for imports and compilers: its time from the process's start stands
apart. Rows are added to docs/results/training_speed.csv as they finish; what is there is not done
again. Libraries that are not installed are named, and left out: pip install '.[bench]'.
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
PAGE, WRITTEN = (
    ROWS.parents[1] / "training_speed.md",
    "<!-- written by scripts/benchmark_training.py -->",
)
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
"""Mean of the last 20 training episodes from which on greedy ones are looked at."""
THEIRS = {"cartpole": "CartPole-v1", "pendulum": "Pendulum-v1"}
BUDGET = 150_000
"""Environment steps after which a training has failed."""
INTERVAL = 2048
"""Environment steps between two looks at greedy episodes."""


class LearntError(Exception):
    """Both means were good enough, or the budget is spent."""


class Watch:
    """When a training was good enough, by processor time without what looking takes."""

    def __init__(self, task: str, env: Callable[[], gymnasium.vector.VectorEnv]) -> None:
        """Begin; `env` makes 20 environments for greedy episodes."""
        self._task, self._make = task, env
        self._began, self.paused, self._looked = time.process_time(), 0.0, 0
        self.found: dict[str, Any] = {}

    def see(self, steps: int, returns: Any, act: Callable[[np.ndarray], np.ndarray]) -> None:
        """Look, at the end of a rollout: returns of the last training episodes, and actions (n, ...) for (n, k).

        Where a library does not say what training episodes came to, greedy ones alone count.
        """
        now = time.process_time() - self._began - self.paused
        last = [WORTH[self._task]] * 20 if returns is None else list(returns)
        if (
            "steps" not in self.found
            and len(last) >= 100
            and np.mean(last[-100:]) >= ENOUGH[self._task]
        ):
            self.found |= {"steps": steps, "seconds": now}
        promising = len(last) >= 20 and np.mean(last[-20:]) >= WORTH[self._task]
        if "greedy_steps" not in self.found and promising and steps - self._looked >= INTERVAL:
            self._looked, start = steps, time.process_time()
            if self._greedy(act) >= ENOUGH[self._task]:
                self.found |= {"greedy_steps": steps, "greedy_seconds": now}
            self.paused += time.process_time() - start
        if len(self.found) == (2 if returns is None else 4) or steps >= BUDGET:
            raise LearntError

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


def _looking(watch: Watch) -> Any:
    """A callback of Stable-Baselines3's, and of what is built on it."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Look(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            assert self.model.ep_info_buffer is not None
            act = lambda seen: self.model.predict(seen, deterministic=True)[0]  # noqa: E731
            watch.see(self.num_timesteps, [one["r"] for one in self.model.ep_info_buffer], act)

    return Look()


def _twenty(task: str, actuator: str | None) -> Callable[[], gymnasium.vector.VectorEnv]:
    """Makes 20 environments, Gymnasium's own or ours."""
    if actuator is None:
        return lambda: gymnasium.make_vec(THEIRS[task], 20, "sync")
    import codrl_mj

    return lambda: codrl_mj.make_vec(task, 20, actuator=actuator)


def ours(settings: str, actuator: str | None) -> Callable[[str, int, Watch], None]:
    """Our PPO with its own settings, on our task through an actuator; None: on Gymnasium's task."""

    def run(task: str, seed: int, watch: Watch) -> None:
        from stable_baselines3.common.env_util import make_vec_env

        from codrl_mj import TrainConfig, make_sb3_vec_env

        config = TrainConfig.preset(task, "ppo", settings, actuator or "default")
        count = config.num_envs
        env = (
            make_vec_env(THEIRS[task], count)
            if actuator is None
            else make_sb3_vec_env(config.env, count)
        )
        config.agent.make_model(env, seed).learn(BUDGET, _looking(watch))

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
"""What RL Baselines3 Zoo recommends for PPO, whose learning rate on CartPole falls linearly from
1e-3, as clipping does from 0.2; eight environments there, four on Pendulum.
"""


def on_stable_baselines3(library: str, actuator: str | None) -> Callable[[str, int, Watch], None]:
    """PPO of `stable_baselines3` or `sbx`, with the zoo's settings."""

    def run(task: str, seed: int, watch: Watch) -> None:
        import importlib

        from stable_baselines3.common.env_util import make_vec_env

        from codrl_mj import make_sb3_vec_env
        from codrl_mj.envs.config import EnvConfig

        falling = task == "cartpole"
        given = ZOO[task] | {
            "learning_rate": (lambda left: 1e-3 * left) if falling else 1e-3,
            "clip_range": (lambda left: 0.2 * left) if falling and library != "sbx" else 0.2,
        }
        if given.get("use_sde"):
            given["sde_sample_freq"] = 4
        count = 8 if falling else 4
        env: Any = make_vec_env(THEIRS[task], count, seed=seed)
        if actuator is not None:
            env = make_sb3_vec_env(EnvConfig(task, actuator), count)
        model = importlib.import_module(library).PPO("MlpPolicy", env, seed=seed, **given)
        model.learn(100_000, _looking(watch))

    return run


def with_rlox(task: str, seed: int, watch: Watch) -> None:
    """PPO of `rlox`, with its own settings."""
    import torch
    from rlox.algorithms.ppo import PPO
    from rlox.callbacks import Callback

    class Look(Callback):
        def on_rollout_end(self, **given: Any) -> None:
            act = lambda seen: np.asarray(  # noqa: E731
                algorithm.predict(torch.as_tensor(seen, dtype=torch.float32))
            )
            config = algorithm.config
            watch.see((given["update"] + 1) * config.n_envs * config.n_steps, None, act)

    algorithm = PPO(THEIRS[task], seed=seed, callbacks=[Look()])
    algorithm.train(BUDGET)


def with_rltools(task: str, seed: int, watch: Watch) -> None:
    """SAC of `rltools`, compiled for the environment at run time; it takes actions from -1 to 1 alone."""
    from gymnasium.wrappers import RescaleAction
    from rltools import SAC

    if task != "pendulum":
        raise NotImplementedError("its SAC has continuous actions")
    returns: collections.deque = collections.deque(maxlen=100)

    class Counted(gymnasium.Wrapper):
        total = 0.0

        def reset(self, **given: Any) -> Any:
            self.total = 0.0
            return self.env.reset(**given)

        def step(self, action: Any) -> Any:
            observation, reward, terminated, truncated, info = self.env.step(action)
            self.total += float(reward)
            if terminated or truncated:
                returns.append(self.total)
            return observation, reward, terminated, truncated, info

    def make() -> gymnasium.Env:
        env = RescaleAction(
            Counted(gymnasium.make(THEIRS[task])), np.float32(-1.0), np.float32(1.0)
        )
        env.reset(seed=seed)
        return env

    state = SAC(make).State(seed)
    act = lambda seen: 2.0 * np.array([state.action(one) for one in seen], dtype=np.float32)  # noqa: E731
    for steps in range(1, BUDGET + 1):
        if state.step():
            break
        if steps % 1000 == 0:
            watch.see(steps, returns, act)


def with_envpool(task: str, seed: int, watch: Watch) -> None:
    """PPO in one file, of the usual kind, on EnvPool's environments."""
    import envpool
    import torch
    from torch import nn

    torch.manual_seed(seed)
    discrete, count, length = task == "cartpole", 32, 64
    gamma, decay, rate, epochs, batch = (
        (0.99, 0.95, 1e-3, 10, 256) if discrete else (0.9, 0.95, 1e-3, 10, 256)
    )
    envs = envpool.make_gymnasium(THEIRS[task], num_envs=count, seed=seed, num_threads=1)
    inputs, outputs = envs.observation_space.shape[0], 2 if discrete else 1

    def network(last: int) -> nn.Sequential:
        return nn.Sequential(
            nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, last)
        )

    actor, critic, log_std = network(outputs), network(1), nn.Parameter(torch.zeros(outputs))
    parameters = [*actor.parameters(), *critic.parameters(), log_std]
    optimiser = torch.optim.Adam(parameters, lr=rate, eps=1e-5, fused=True)
    scale = torch.ones(inputs) if discrete else torch.tensor([1.0, 1.0, 0.2])

    def policy(seen: torch.Tensor) -> Any:
        out = actor(seen * scale)
        if discrete:
            return torch.distributions.Categorical(logits=out)
        return torch.distributions.Independent(torch.distributions.Normal(out, log_std.exp()), 1)

    def act(seen: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            out = actor(torch.as_tensor(seen, dtype=torch.float32) * scale)
        return out.argmax(1).numpy() if discrete else np.clip(out.numpy(), -2.0, 2.0)

    returns: collections.deque = collections.deque(maxlen=100)
    total, steps = np.zeros(count), 0
    seen = torch.as_tensor(envs.reset()[0], dtype=torch.float32)
    began = torch.zeros(count, dtype=torch.bool)  # EnvPool's first step after an end is a reset
    while True:
        kept: list[Any] = []
        with torch.no_grad():
            for _ in range(length):
                chosen = policy(seen)
                action = chosen.sample()
                sent = action.numpy() if discrete else np.clip(action.numpy(), -2.0, 2.0)
                following, reward, terminated, truncated, _ = envs.step(sent)
                total += np.where(began.numpy(), 0.0, reward)
                ended = terminated | truncated
                returns.extend(total[ended])
                total[ended] = 0.0
                kept.append(
                    (
                        seen,
                        action,
                        chosen.log_prob(action),
                        torch.as_tensor(reward, dtype=torch.float32),
                        began,
                        torch.as_tensor(terminated),
                        torch.as_tensor(ended),
                    )
                )
                seen, began = (
                    torch.as_tensor(following, dtype=torch.float32),
                    torch.as_tensor(ended),
                )
            steps += count * length
            states, actions, before, rewards, skipped, dead, over = map(
                torch.stack, zip(*kept, strict=True)
            )
            values = critic(torch.cat([states, seen[None]]) * scale)[..., 0]
            advantage, advantages = torch.zeros(count), torch.zeros(length, count)
            for at in reversed(range(length)):
                error = rewards[at] + gamma * values[at + 1] * ~dead[at] - values[at]
                advantage = error + gamma * decay * advantage * ~over[at]
                advantages[at] = advantage
        watch.see(steps, returns, act)
        use = ~skipped.flatten()
        columns = [
            one.flatten(0, 1)[use]
            for one in (states, actions, before, advantages, advantages + values[:-1])
        ]
        for _ in range(epochs):
            for rows in torch.randperm(len(columns[0])).split(batch):
                state, action, old, gain, target = (one[rows] for one in columns)
                ratio = (policy(state).log_prob(action) - old).exp()
                gain = (gain - gain.mean()) / (gain.std() + 1e-8)
                loss = -torch.min(ratio * gain, ratio.clamp(0.8, 1.2) * gain).mean()
                loss = loss + 0.5 * (critic(state * scale)[:, 0] - target).square().mean()
                optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(parameters, 0.5)
                optimiser.step()


CONTENDERS: dict[str, tuple[Callable[[str, int, Watch], None], str | None]] = {
    # name: its training, and the actuator of the environment; None: Gymnasium's own
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
    """Train with some seeds in this process, and add a row for each."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    train, actuator = CONTENDERS[contender]
    for seed in seeds:
        watch = Watch(task, _twenty(task, actuator))
        with contextlib.suppress(LearntError):
            train(task, seed, watch)
        first = time.process_time() - watch.paused if seed == seeds[0] else ""
        with ROWS.open("a", newline="") as file:
            csv.DictWriter(file, COLUMNS).writerow(
                {"task": task, "contender": contender, "seed": seed, "first": first, **watch.found}
            )


def rows() -> list[dict[str, str]]:
    """What was measured."""
    return list(csv.DictReader(ROWS.open(newline=""))) if ROWS.is_file() else []


def medians(task: str, name: str) -> dict[str, float]:
    """Medians over a contender's seeds, of what there is; `seeds` and `learned` count them."""
    own = [row for row in rows() if (row["task"], row["contender"]) == (task, name)]
    found = {"seeds": len(own), "learned": sum(bool(row["greedy_steps"]) for row in own)}
    known = {column: [float(row[column]) for row in own if row[column]] for column in COLUMNS[3:]}
    return found | {column: statistics.median(values) for column, values in known.items() if values}


FORMS = {"greedy_seconds": ".1f", "greedy_steps": ",.0f"}
"""Columns of the table, and how they are written."""


def table() -> str:
    """Seconds and steps in Markdown, but for our ideal forces, which take what our motors take."""
    titles = [TITLES[task] for task in ENOUGH]
    lines = [
        f"| | {' | '.join(f'{title}: seconds | steps' for title in titles)} |",
        f"| --- |{' ---: |' * len(FORMS) * len(titles)}",
    ]
    for name in (one for one in CONTENDERS if not one.endswith("ideal force")):
        cells = [name]
        for task in ENOUGH:
            of = medians(task, name)
            seconds, *others = (
                format(of[key], form) if key in of else "–" for key, form in FORMS.items()
            )
            few = (
                f" ({of['learned']:.0f} of {of['seeds']:.0f})"
                if of["learned"] < of["seeds"]
                else ""
            )
            cells += [seconds + few, *others]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def draw() -> None:
    """Seconds until each has learned each task, as bars."""
    from matplotlib.figure import Figure

    from codrl_mj.study.pages import save_figure

    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    for axes, (task, enough) in zip(
        figure.subplots(1, len(ENOUGH), sharey=True), ENOUGH.items(), strict=True
    ):
        seconds = {
            name: medians(task, name).get("greedy_seconds", 0.0) for name in reversed(CONTENDERS)
        }
        colours = ["#0072B2" if name.startswith("ours") else "#999999" for name in seconds]
        bars = axes.barh([*seconds], [*seconds.values()], color=colours)
        axes.bar_label(
            bars, [f"{value:.1f}" if value else "–" for value in seconds.values()], padding=3
        )
        axes.set(title=f"{TITLES[task]} to {enough:g}", xlabel="seconds of one core")
        axes.margins(x=0.15)
        axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, ROWS.with_suffix(".svg"))


def main() -> None:
    """Measure what is not there yet, print the table and put it on its page."""
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
            there = {
                int(row["seed"])
                for row in rows()
                if (row["task"], row["contender"]) == (task, name)
            }
            seeds = [seed for seed in range(options.seeds) if seed not in there]
            if options.here == name:
                contend(task, name, seeds)
            elif not options.here and seeds and options.only in name:
                given = ["--task", task, "--seeds", str(options.seeds), "--here", name]
                single = dict.fromkeys(
                    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"
                )
                line = [sys.executable, __file__, *given]
                done = subprocess.run(
                    line, env=os.environ | single, check=False, capture_output=True, text=True
                )
                if done.returncode:
                    print(
                        f"left out: {name}, {task}: {done.stderr.strip().splitlines()[-1]}",
                        flush=True,
                    )
                else:
                    print(f"measured: {name}, {task}", flush=True)
    if not options.here:
        print(table())
        PAGE.write_text(f"{PAGE.read_text().partition(WRITTEN)[0]}{WRITTEN}\n\n{table()}")
        draw()


if __name__ == "__main__":
    main()
