"""Training callback that records, reports, evaluates, writes checkpoints and stops."""

import contextlib
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger

from codrl_mj.evaluation import Evaluation, evaluate
from codrl_mj.runs import (
    BEST,
    CHECKPOINTS,
    CURVE,
    EPISODES,
    EVALUATION,
    PROGRESS,
    RESULT,
    TENSORBOARD,
)
from codrl_mj.runs.files import with_digest, write_json
from codrl_mj.runs.policies import save_policy
from codrl_mj.training import folder, history
from codrl_mj.training.checkpoint import State, capture, load_checkpoint, restore, save_checkpoint
from codrl_mj.training.config import EVALUATION_SEED, TrainConfig
from codrl_mj.training.history import EPISODE_COLUMNS, REPORT_COLUMNS, GrowingTable, Progress

REPORT_INTERVAL = 1000
"""Environment steps between two reports, rounded up to the end of a rollout."""
_RATES = ("learning_rate", "critic_learning_rate", "step_size")
_CHECKPOINTED = ("marks", "squares", "samples", "best")


class TrainingCompleted(Exception):  # noqa: N818 - no error
    """Raised to leave Stable-Baselines3's learning loop after the last step of a training."""


class Watcher(BaseCallback):
    """Callback of every training run, which acts between two rollouts."""

    def __init__(
        self,
        config: TrainConfig,
        out: Path,
        stop_signals: Sequence[int],
        on_progress: Callable[[Progress], None] | None,
        tensorboard: bool,
    ) -> None:
        """Store the arguments of `train`, and the list of signals that stop the training."""
        super().__init__()
        self._config = config
        self._out = out
        self._stop_signals = stop_signals
        self._on_progress = on_progress
        self._tensorboard = tensorboard
        self._marks = {"report": 0, "evaluation": 0, "checkpoint": 0}
        # Sum of the squared torque errors since the last report, and the number of samples.
        self._squares, self._samples = 0.0, 0
        self._best = {"return": -math.inf, "steps": 0}
        self._seconds_before, self._steps_before, self._start = 0.0, 0, time.perf_counter()
        self._identity = json.dumps(config.as_mapping(), sort_keys=True)
        self._resumed: State | None = None
        self.saved_steps = 0
        self.evaluation: Evaluation | None = None

    # -- the callback -----------------------------------------------------------------------------

    def _on_training_start(self) -> None:
        """Restore the last checkpoint after the model has initialized itself."""
        self._arms = self.training_env.arm_radii
        if any(path.endswith("arm_radius") for path in self._config.env.distributions):
            # With a randomized arm radius, no single value is valid for all episodes.
            self._arms = np.full_like(self._arms, math.nan)
        state = self._resumed = load_checkpoint(self._out / CHECKPOINTS, self._identity)
        rows: dict[str, np.ndarray | None] = {"episodes": None, "reports": None}
        if state is not None:
            restore(self.model, self.training_env, state)
            rows = {name: state.arrays[f"watch.{name}"] for name in rows}
            for name in (*_CHECKPOINTED, "seconds_before"):
                setattr(self, f"_{name}", state.facts["watch"][name])
            self.saved_steps = self._steps_before = self.model.num_timesteps
            self.num_timesteps = self.model.num_timesteps
        self.episodes = GrowingTable(self._out / EPISODES, EPISODE_COLUMNS, rows["episodes"])
        self.reports = GrowingTable(self._out / PROGRESS, REPORT_COLUMNS, rows["reports"])
        writers: list[KVWriter] = []
        if self._tensorboard:
            # Stable-Baselines3 raises either error if TensorBoard is not installed.
            with contextlib.suppress(AssertionError, ImportError):
                from stable_baselines3.common.logger import TensorBoardOutputFormat

                writers.append(TensorBoardOutputFormat(str(self._out / TENSORBOARD)))
        self.model.set_logger(Logger(str(self._out), writers))
        self._start = time.perf_counter()

    def _on_rollout_start(self) -> None:
        if self.complete:
            raise TrainingCompleted
        if self._resumed is not None:
            # Stable-Baselines3 draws state-dependent noise between the start of a training and the
            # first rollout, so the state is restored a second time.
            restore(self.model, self.training_env, self._resumed)
            self._resumed = None
        stopping = bool(self._stop_signals)
        self.run_due_actions(stopping)
        if stopping:
            message = (
                f"stopped after {self.saved_steps:,} steps: continue with"
                f" {folder.resume_command(self._out)}"
            )
            raise folder.TrainingStoppedError(message, self._stop_signals[-1])

    def _on_step(self) -> bool:
        # An agent's compiled loop takes several steps in one call, and passes the signals of all of
        # them.
        signals = self.locals.get("signals", self.training_env.signals)
        if signals is not None:
            errors = np.subtract(signals["desired_force"], signals["actual_force"]).reshape(
                -1, len(self._arms)
            )
            errors = (errors * self._arms).ravel()
            self._squares += float(np.dot(errors, errors))
            self._samples += errors.size
        for info in self.locals["infos"]:
            if "episode" in info:
                episode = info["episode"]
                self.episodes.add(
                    (len(self.episodes.rows) + 1, self.num_timesteps, episode["r"], episode["l"])
                )
        return not self._episodes_done

    @property
    def _episodes_done(self) -> bool:
        return (
            self._config.total_episodes is not None
            and len(self.episodes.rows) >= self._config.total_episodes
        )

    @property
    def complete(self) -> bool:
        """True if the training's budget is used up."""
        steps = self._config.total_steps
        return self._episodes_done or (steps is not None and self.model.num_timesteps >= steps)

    @contextlib.contextmanager
    def explaining_errors(self) -> Iterator[None]:
        """Add explanations to errors: how to continue the run, or why the weights diverged."""
        try:
            yield
        except OSError as error:
            raise OSError(
                f"training in {self._out} was interrupted: {error}."
                f" {folder.describe_resumption(self._out)}"
            ) from error
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"stopped at once. {folder.describe_resumption(self._out)}"
            ) from None
        except Exception:
            self._check_weights()
            raise

    def _check_weights(self) -> None:
        """Raise an error that names the likely cause if a weight is not finite."""
        # The model is set when learning begins.
        model = getattr(self, "model", None)
        if model is None or all(
            tensor.isfinite().all() for tensor in model.policy.state_dict().values()
        ):
            return
        agent = self._config.agent.as_mapping()
        rates = [f"agent.{name} = {agent[name]:g}" for name in _RATES if agent.get(name)]
        raise FloatingPointError(
            f"the weights of {agent['name']} are not finite at step"
            f" {self.model.num_timesteps:,}: learning diverged. Lower {' or '.join(rates)}, or"
            " scale the rewards down"
        )

    # -- between two rollouts ---------------------------------------------------------------------

    def run_due_actions(self, stopping: bool = False, last: bool = False) -> None:
        """Report, evaluate and write a checkpoint, each if it is due.

        Args:
            stopping: write a checkpoint in any case.
            last: do all three in any case.
        """
        if self.model.num_timesteps == 0:
            return
        evaluation = self._due("evaluation", self._config.evaluation_interval) or last
        report = self._due("report", REPORT_INTERVAL) or evaluation
        checkpoint = self._due("checkpoint", self._config.checkpoint_interval) or last or stopping
        if report or checkpoint:
            self._check_weights()
        if evaluation:
            self._evaluate()
        if report:
            self._report(evaluation)
        if checkpoint:
            self._save()

    def _due(self, action: str, interval: int) -> bool:
        mark = self.model.num_timesteps // interval
        due: bool = mark > self._marks[action]
        self._marks[action] = mark
        return due

    def _evaluate(self) -> None:
        config = self._config
        env, episodes = config.evaluation_env, config.evaluation_episodes
        self.evaluation = evaluate(self.model.policy, env, episodes, EVALUATION_SEED)
        if self.evaluation.returns.mean > self._best["return"]:
            self._best = {"return": self.evaluation.returns.mean, "steps": self.model.num_timesteps}
            self._save_policy(self._out / BEST, self.evaluation)

    def _save_policy(self, path: Path, evaluation: Evaluation) -> None:
        """Write the current policy with its evaluation."""
        save_policy(self.model.policy, self._config.agent, path)
        write_json(path / EVALUATION, with_digest(evaluation.as_mapping()))

    def _report(self, evaluated: bool) -> None:
        if self.reports.last_mean("steps", 1) == self.model.num_timesteps:
            # The process was killed after the last report, before the run was marked as finished.
            return
        elapsed = time.perf_counter() - self._start
        progress = Progress(
            steps=self.model.num_timesteps,
            episodes=len(self.episodes.rows),
            mean_return=self.episodes.last_mean("return"),
            mean_length=self.episodes.last_mean("length"),
            torque_error=math.sqrt(self._squares / self._samples) if self._samples else math.nan,
            evaluation_return=(
                self.evaluation.returns.mean if self.evaluation and evaluated else math.nan
            ),
            steps_per_second=(self.model.num_timesteps - self._steps_before) / elapsed,
            seconds=self._seconds_before + elapsed,
        )
        self._squares, self._samples = 0.0, 0
        self.reports.add(getattr(progress, name) for name in REPORT_COLUMNS)
        self.reports.flush()
        self.episodes.flush()
        for name in REPORT_COLUMNS[1:]:
            if not math.isnan(value := getattr(progress, name)):
                self.logger.record(f"run/{name}", value)
        self.logger.dump(self.model.num_timesteps)
        if self._on_progress is not None:
            self._on_progress(progress)

    def _save(self) -> None:
        arrays, facts = capture(self.model, self.training_env)
        watch = {name: getattr(self, f"_{name}") for name in _CHECKPOINTED}
        watch["seconds_before"] = self._seconds_before + time.perf_counter() - self._start
        tables = {"watch.episodes": self.episodes.array(), "watch.reports": self.reports.array()}
        state = State(arrays | tables, facts | {"watch": watch})
        save_checkpoint(self._out / CHECKPOINTS, state, self._identity)
        self.episodes.flush()
        self.saved_steps = self.model.num_timesteps

    def finish(self) -> None:
        """Write the policy, its evaluation, the learning curve and the result."""
        # The result comes last, because it marks the run as finished.
        self.run_due_actions(last=True)
        assert self.evaluation is not None
        self._save_policy(self._out, self.evaluation)
        title = f"{self._config.agent.name.upper()} on {self._config.task}"
        history.save_learning_curve(
            self._out / CURVE, title, self.episodes.array(), self.reports.array()
        )
        result = {
            "steps": self.model.num_timesteps,
            "episodes": len(self.episodes.rows),
            "mean_return": self.episodes.last_mean("return"),
            "evaluation_return": self.evaluation.returns.mean,
            "best": self._best,
            "seconds": self._seconds_before + time.perf_counter() - self._start,
        }
        write_json(self._out / RESULT, with_digest(result))

    def close(self) -> None:
        """Close the logger's files."""
        # Before learning begins there is no logger.
        if hasattr(getattr(self, "model", None), "_logger"):
            self.logger.close()
