"""Training from a configuration to a finished run folder, from the start or a checkpoint."""

import contextlib
import hashlib
import importlib.util
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

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
    """Train an agent and write a run folder, or continue an interrupted training.

    The folder grows while the agent trains: `config.json` (resolved configuration, versions, digest
    of the code), `progress.csv` and `episodes.csv`, `checkpoints/`, `best/` (the policy of the best
    evaluation), TensorBoard's events; at the end come `policy.safetensors` and `policy.json` (the
    last policy), `evaluation.json`, `learning_curve.png` and, last, `result.json`, which marks the
    run as finished.

    SIGINT (Ctrl-C) and SIGTERM let the rollout end, write a checkpoint and stop; a second Ctrl-C
    stops at once.

    Args:
        config: configuration of the training.
        out: the run folder.
        on_progress: function that is called at the ends of rollouts.
        resume: continue the run in `out` from its last intact checkpoint, with the same result as
            an uninterrupted run. Start a run if there is none, and return at once if it is
            finished.
        accept_changes: continue even if code or package versions differ from those at its start.
        tensorboard: write events for TensorBoard, if it is installed.
        wandb: name of a Weights & Biases project that also gets the reports.

    Returns:
        `out`.

    Raises:
        FileExistsError: `out` exists and `resume` is False; nothing in it was changed.
        OSError: `out` cannot be written.
        ValueError: the configuration cannot be trained, for instance because the actuator is
            unstable; or the run in `out` has another configuration, or was started with other
            software.
        RunInUseError: another process trains in `out`.
        TrainingStoppedError: a signal stopped the training.
    """
    check_episodes(config.evaluation_episodes, "evaluation_episodes")
    record = folder.prepare_run(out, config, resume, accept_changes)
    if record is None and finished(out):
        return out
    if wandb is not None and importlib.util.find_spec("wandb") is None:
        raise ValueError(f"wandb = {wandb!r}: Weights & Biases is not installed: pip install wandb")
    import torch

    # Learning curves are drawn at the end; a missing matplotlib should fail before the training.
    importlib.import_module("matplotlib.figure")
    from stable_baselines3.common.logger import Logger

    from codrl_mj.envs.sb3 import ActuatedVecEnv
    from codrl_mj.training.watcher import TrainingCompleted, Watcher

    # Networks of this size run several times slower on two threads.
    torch.set_num_threads(1)
    with (
        folder.locked_for_training(out, record is None),
        collecting_signals(signal.SIGINT, signal.SIGTERM) as stop_signals,
    ):
        envs = ActuatedVecEnv(config.env.build_vec(config.num_envs))
        with contextlib.closing(envs), _wandb_context(wandb, out, config):
            model = config.agent.make_model(envs, config.seed)
            watcher = Watcher(config, out, stop_signals, on_progress, tensorboard)
            with contextlib.closing(watcher), watcher.explaining_errors():
                if record is not None:
                    # The configuration is written first, so that every folder with files of a run
                    # has it.
                    write_json(out / CONFIG, with_digest(record))
                steps = config.total_steps
                if steps is None:
                    # The watcher ends learning after `total_episodes`. The longest possible
                    # episodes give an upper bound of the steps.
                    steps = (
                        (config.total_episodes or 0)
                        * (config.env.time_limit or 0)
                        * config.num_envs
                    )
                # The watcher sets its logger when learning begins. Without this line, the default
                # logger would create a temporary folder before that.
                model.set_logger(Logger(None, []))
                with contextlib.suppress(TrainingCompleted):
                    model.learn(steps, callback=watcher, log_interval=None)
                watcher.finish()
    return out


@contextlib.contextmanager
def collecting_signals(*signals: int) -> Iterator[list[int]]:
    """Collect signals in a list within a `with` block, instead of their usual effect.

    A SIGINT after another signal raises KeyboardInterrupt.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        # Only the main thread may set handlers of signals.
        yield received
        return

    def collect(number: int, _: FrameType | None) -> None:
        if received and number == signal.SIGINT:
            raise KeyboardInterrupt
        received.append(number)

    previous = {number: signal.signal(number, collect) for number in signals}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _wandb_context(
    wandb_project: str | None, out: Path, config: TrainConfig
) -> contextlib.AbstractContextManager[object]:
    """Return a context in which Weights & Biases receives the events for TensorBoard."""
    if wandb_project is None:
        return contextlib.nullcontext()
    import wandb

    run: contextlib.AbstractContextManager[object] = wandb.init(
        project=wandb_project,
        name=out.name,
        dir=out,
        config=config.as_mapping(),
        sync_tensorboard=True,
        # The id depends on the folder alone, so that a resumed run continues the same record.
        id=hashlib.sha256(str(out.resolve()).encode()).hexdigest()[:16],
        resume="allow",
    )
    return run
