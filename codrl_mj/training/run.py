"""Runs a training from a configuration to a finished run folder, from the start or from the last checkpoint."""

import contextlib
import hashlib
import importlib.util
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from codrl_mj.evaluation import check_episodes
from codrl_mj.runs import CONFIG, finished
from codrl_mj.runs.files import with_digest, write_json
from codrl_mj.training import folder
from codrl_mj.training.config import TrainConfig
from codrl_mj.training.history import Progress


def train(
    config: TrainConfig,
    out: Path,
    on_progress: Callable[[Progress], None] | None = None,
    resume: bool = False,
    accept_changes: bool = False,
    tensorboard: bool = True,
    wandb: str | None = None,
) -> Path:
    """Train an agent and leave a run folder; or continue one.

    The folder grows while the agent trains: `config.json` (resolved configuration, versions, digest
    of the code), `progress.csv` and `episodes.csv`, `checkpoints/`, `best/` (the policy of the best
    evaluation), TensorBoard's events; at the end come `policy.safetensors` and `policy.json` (the
    last policy), `evaluation.json`, `learning_curve.png` and, last, `result.json`, which marks the
    run as finished.

    SIGINT (Ctrl-C) and SIGTERM let the rollout end, write a checkpoint and stop; a second Ctrl-C
    stops at once.

    Args:
        config: what to train.
        out: the run folder.
        on_progress: called at the ends of rollouts.
        resume: continue the run if `out` has one, from its last checkpoint that is intact, to the
            very result that an uninterrupted run has; start it if there is none, and return if it
            is finished.
        accept_changes: continue even if code or package versions differ from those it was started
            with.
        tensorboard: write events for TensorBoard, if it is installed.
        wandb: name of a Weights & Biases project to report to as well.

    Returns:
        `out`.

    Raises:
        FileExistsError: `out` exists and `resume` is False; nothing in it was touched.
        OSError: `out` cannot be written.
        ValueError: the configuration cannot be trained, for instance because the actuator is
            unstable; or the run in `out` has another one, or was started with other software.
        RunInUseError: another process trains in `out`.
        TrainingStoppedError: a signal asked to stop.
    """
    check_episodes(config.evaluation_episodes, "evaluation_episodes")
    record = folder.admit(out, config, resume, accept_changes)
    if record is None and finished(out):
        return out
    if wandb is not None and importlib.util.find_spec("wandb") is None:
        raise ValueError(f"wandb = {wandb!r}: Weights & Biases is not installed: pip install wandb")
    import torch

    importlib.import_module("matplotlib.figure")  # what is missing is missed now and not in the end
    from stable_baselines3.common.logger import Logger

    from codrl_mj.envs.sb3 import ActuatedVecEnv
    from codrl_mj.training.watcher import LearningEnded, Watcher

    torch.set_num_threads(1)  # networks this small run several times slower on two
    with folder.taken(out, record is None), stopping(signal.SIGINT, signal.SIGTERM) as asked:
        envs = ActuatedVecEnv(config.env.world.vector(config.env, config.num_envs))
        with contextlib.closing(envs), _reporting_to(wandb, out, config):
            model = config.agent.make_model(envs, config.seed)
            watcher = Watcher(config, out, asked, on_progress, tensorboard)
            with contextlib.closing(watcher), watcher.explaining():
                if record is not None:
                    write_json(
                        out / CONFIG, with_digest(record)
                    )  # before anything else is in the folder
                steps = config.total_steps
                if steps is None:  # those of the longest possible episodes where these are counted
                    steps = (
                        (config.total_episodes or 0)
                        * (config.env.time_limit or 0)
                        * config.num_envs
                    )
                model.set_logger(
                    Logger(None, [])
                )  # until the watcher's: the default makes a folder in the system's
                with contextlib.suppress(LearningEnded):
                    model.learn(steps, callback=watcher, log_interval=None)
                watcher.finish()
    return out


@contextlib.contextmanager
def stopping(*signals: int) -> Iterator[list[int]]:
    """Turn the first of some signals within the block into a wish, the list's entry; a second SIGINT raises."""
    asked: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield asked  # only the main thread may handle signals
        return

    def wish(number: int, _: Any) -> None:
        if asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked.append(number)

    before = {number: signal.signal(number, wish) for number in signals}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _reporting_to(
    wandb_project: str | None, out: Path, config: TrainConfig
) -> contextlib.AbstractContextManager[Any]:
    """A context in which Weights & Biases gets what goes to TensorBoard."""
    if wandb_project is None:
        return contextlib.nullcontext()
    import wandb

    return wandb.init(
        project=wandb_project,
        name=out.name,
        dir=out,
        config=config.as_mapping(),
        sync_tensorboard=True,
        id=hashlib.sha256(str(out.resolve()).encode()).hexdigest()[
            :16
        ],  # a continued run goes on there
        resume="allow",
    )
