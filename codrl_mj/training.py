"""Training runs: from a configuration to a run folder."""

import contextlib
import csv
import dataclasses
import importlib.metadata
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from codrl_mj.agents import PPOConfig, make_ppo
from codrl_mj.env_config import EnvConfig
from codrl_mj.evaluation import make_env
from codrl_mj.files import read_json, write_json, writing, writing_folder
from codrl_mj.motor import Actuator, resolve
from codrl_mj.policies import save_policy
from codrl_mj.registration import ENVIRONMENTS
from codrl_mj.tasks import find_task

_CONFIG, _PROGRESS, _CURVE = "config.json", "progress.csv", "learning_curve.png"


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """What to train, on what, for how long.

    Raises:
        ValueError: a field is out of bounds; the message names field, value and bound.
    """

    task: str
    """Task name, such as `cartpole`."""
    actuator: str | Actuator | Mapping[str, Any] | None = "paper"
    """Actuator to train through: a name, an `Actuator`, a mapping of its fields, or None (ideal)."""
    ppo: PPOConfig = PPOConfig()
    """The agent's settings."""
    seed: int = 0
    """Seed of weights, actions and environments, from 0 to 2**32 - 1."""
    total_steps: int = 200_000
    """Environment steps in all, >= 1; rounded up to whole rollouts."""
    num_envs: int = 8
    """Environments side by side, >= 1."""
    env: EnvConfig = EnvConfig()
    """The environment's other arguments."""

    def __post_init__(self) -> None:
        """Validate, and replace the actuator by the `Actuator` (or None) that it stands for."""
        find_task(self.task)
        object.__setattr__(self, "actuator", resolve(self.actuator, self.task))
        for name, kind in (("ppo", PPOConfig), ("env", EnvConfig)):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"TrainConfig.{name} = {getattr(self, name)!r}: must be a {kind.__name__}")
        for name, least, most in (("seed", 0, 2**32 - 1), ("total_steps", 1, None), ("num_envs", 1, None)):
            value = getattr(self, name)
            whole = isinstance(value, int) and not isinstance(value, bool)
            if not whole or value < least or (most is not None and value > most):
                bound = f">= {least}" if most is None else f"from {least} to {most}"
                raise ValueError(f"TrainConfig.{name} = {value!r}: must be an integer {bound}")

    def as_mapping(self) -> dict[str, Any]:
        """The configuration as JSON-serialisable values; `from_mapping` reads it."""
        return dataclasses.asdict(self)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> "TrainConfig":
        """The configuration that `as_mapping` described.

        Raises:
            ValueError: a field is unknown or missing, or out of bounds.
        """
        values = dict(mapping)
        try:
            values["ppo"] = PPOConfig(**{**values["ppo"], "hidden": tuple(values["ppo"]["hidden"])})
            values["env"] = EnvConfig(**values["env"])
            return cls(**values)
        except (KeyError, TypeError) as error:
            raise ValueError(f"not a training configuration: {error!r}") from None


@dataclasses.dataclass(frozen=True)
class Progress:
    """Where a training run stands, after a rollout."""

    steps: int
    """Environment steps so far."""
    total_steps: int
    """Environment steps in all."""
    mean_return: float
    """Mean return of the last 100 training episodes (NaN before the first ends)."""
    mean_length: float
    """Mean length of the same episodes [steps]."""
    steps_per_second: float
    """Environment steps per second since the start."""


def load_config(run: Path) -> TrainConfig:
    """The configuration of a run folder.

    Raises:
        FileNotFoundError: the folder is no run folder.
        ValueError: its configuration is damaged.
    """
    content = read_json(run / _CONFIG, "run configuration")
    try:
        return TrainConfig.from_mapping(content["train"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{run / _CONFIG}: not a run configuration: {error}") from None


def train(config: TrainConfig, out: Path, on_progress: Callable[[Progress], None] | None = None) -> Path:
    """Train an agent and leave a run folder.

    Args:
        config: what to train.
        out: the run folder to make: `config.json` (resolved configuration and package versions), `progress.csv`,
            `learning_curve.png`, `policy.safetensors` and `policy.json`.
        on_progress: called after every rollout.

    Returns:
        `out`.

    Raises:
        FileExistsError: `out` exists; nothing in it was touched.
        ValueError: the configuration cannot be trained, for instance because the actuator is unstable.

    The run folder appears when the run is finished: one that is stopped, however, leaves none.
    """
    if out.exists():
        raise FileExistsError(f"run folder {out} exists already: choose another --out, or delete it to train anew")
    import torch
    from stable_baselines3.common.callbacks import BaseCallback

    torch.set_num_threads(1)  # networks this small run several times slower on two
    envs = _make_envs(config)
    envs.seed(config.seed)
    model = make_ppo(config.ppo, envs, config.seed)
    history: list[Progress] = []
    start = time.perf_counter()

    class Report(BaseCallback):
        """Records the progress after every rollout."""

        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            episodes = self.model.ep_info_buffer or [{"r": float("nan"), "l": float("nan")}]
            history.append(
                Progress(
                    steps=self.num_timesteps,
                    total_steps=config.total_steps,
                    mean_return=sum(episode["r"] for episode in episodes) / len(episodes),
                    mean_length=sum(episode["l"] for episode in episodes) / len(episodes),
                    steps_per_second=self.num_timesteps / (time.perf_counter() - start),
                )
            )
            if on_progress is not None:
                on_progress(history[-1])

    with contextlib.closing(envs), writing_folder(out) as folder:
        write_json(folder / _CONFIG, {"train": config.as_mapping(), "versions": _versions()})
        model.learn(config.total_steps, callback=Report())
        _write_progress(folder / _PROGRESS, history)
        _draw_learning_curve(folder / _CURVE, config, history)
        save_policy(model, folder)
    return out


def _make_envs(config: TrainConfig) -> Any:
    """The environments as one Stable-Baselines3 `VecEnv`: batched, or one by one where the physics cannot be."""
    arguments = config.env.as_arguments()
    if config.env.physics == "mujoco":
        from codrl_mj.envs.sb3 import make_sb3_vec_env

        env_id = ENVIRONMENTS[config.task].env_id
        return make_sb3_vec_env(env_id, config.num_envs, actuator=config.actuator, **arguments)
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv

    return DummyVecEnv([lambda: Monitor(make_env(config.task, config.actuator, **arguments))] * config.num_envs)


def _versions() -> dict[str, str]:
    packages = ("codrl-mj", "gymnasium", "mujoco", "numba", "numpy", "stable-baselines3", "torch")
    return {package: importlib.metadata.version(package) for package in packages}


def _write_progress(path: Path, history: list[Progress]) -> None:
    with writing(path) as temporary, temporary.open("w", newline="") as file:
        table = csv.DictWriter(file, [field.name for field in dataclasses.fields(Progress)])
        table.writeheader()
        table.writerows(dataclasses.asdict(progress) for progress in history)


def _draw_learning_curve(path: Path, config: TrainConfig, history: list[Progress]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.subplots()
    axes.plot([progress.steps for progress in history], [progress.mean_return for progress in history])
    axes.set(xlabel="environment steps", ylabel="return (mean of 100 episodes)", title=f"PPO on {config.task}")
    axes.grid(alpha=0.3)
    with writing(path) as temporary:
        figure.savefig(temporary, dpi=150)
