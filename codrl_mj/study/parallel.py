"""Parallel calls in processes of this machine or on a Ray cluster."""

import contextlib
import dataclasses
import functools
import itertools
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Literal, TypeVar

from codrl_mj.fields import Checked, choice
from codrl_mj.training import TrainingStoppedError
from codrl_mj.training.run import collecting_signals

Result = TypeVar("Result")
"""Result of a call."""


@dataclasses.dataclass(frozen=True)
class Workers(Checked):
    """Settings of the worker processes.

    Raises:
        ValueError: unknown backend, or an impossible number of jobs.
    """

    jobs: int = -1
    """Number of parallel calls, >= 1; -1 for one on each CPU of this machine or of the cluster."""
    backend: Literal["local", "ray"] = choice("local", "local", "ray")
    """`local`: processes of this machine; `ray`: a Ray cluster with a shared file system."""
    address: str | None = None
    """Address of the Ray cluster (`auto`, `ray://head:10001`); None starts Ray on this machine."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        if (
            isinstance(self.jobs, bool)
            or not isinstance(self.jobs, int)
            or (self.jobs < 1 and self.jobs != -1)
        ):
            raise ValueError(
                f"jobs = {self.jobs!r}: must be an integer >= 1, or -1 for one on each CPU"
            )

    @property
    def cores(self) -> int:
        """Number of this machine's CPUs that the jobs use."""
        return (os.cpu_count() or 1) if self.jobs == -1 else self.jobs


def call_in_parallel(
    function: Callable[..., Result], work: Iterable[tuple[object, ...]], workers: Workers
) -> Iterator[Result]:
    """Yield the results of calls as they complete; with Ray, after all of them have finished.

    After Ctrl-C no further call starts, trainings stop at a checkpoint, and other calls run to
    their end; a second Ctrl-C stops at once. An exception in a call aborts the others. The worker
    processes end with this process, even if it is killed.

    Args:
        function: picklable function.
        work: picklable arguments of each call.
        workers: settings of the worker processes.

    Raises:
        TrainingStoppedError: a signal requested a stop.
    """
    calls = list(work)
    if not calls:
        return
    import joblib

    local = workers.backend == "local"
    no_signals: list[int] = []
    with (
        _backend(workers) as backend,
        collecting_signals(signal.SIGINT)
        if local
        else contextlib.nullcontext(no_signals) as stop_signals,
    ):
        parallel = joblib.Parallel(
            n_jobs=workers.jobs,
            backend=backend,
            batch_size=1,
            pre_dispatch="n_jobs",
            return_as="generator_unordered" if local else "list",
        )
        delayed_call = joblib.delayed(_call)
        parent = os.getpid() if local else None
        pending = itertools.takewhile(lambda _: not stop_signals, calls)
        for result, stopped_by in parallel(
            delayed_call(function, arguments, parent) for arguments in pending
        ):
            if stopped_by is None:
                yield result
            else:
                stop_signals.append(stopped_by)
        if stop_signals:
            raise TrainingStoppedError(
                "stopped: the same command continues from the last checkpoints", stop_signals[0]
            )


def _call(
    function: Callable[..., Result], arguments: tuple[object, ...], parent: int | None
) -> tuple[Result | None, int | None]:
    """Call a function; return its result and the signal that stopped it, if any."""
    if parent is not None and os.getpid() != parent:
        _die_with_parent(parent)
    try:
        return function(*arguments), None
    except TrainingStoppedError as stopped:
        return None, stopped.signal_number


@functools.cache
def _die_with_parent(parent: int) -> None:
    """Make this process end with its parent, even if that is killed, and ignore Ctrl-C."""
    # Ctrl-C reaches all processes of the terminal. The parent handles it and tells the trainings.
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _backend(workers: Workers) -> Iterator[str]:
    """Start the backend for the duration of the block and yield its name in joblib."""
    if workers.backend == "local":
        yield "loky"
        return
    try:
        import ray
        from ray.util.joblib import register_ray
    except ModuleNotFoundError:
        raise ValueError(
            "backend = 'ray': Ray is not installed: pip install 'codrl-mj[ray]'"
        ) from None
    started_here = not ray.is_initialized()
    if started_here:
        ray.init(address=workers.address, log_to_driver=False)
    register_ray()
    try:
        yield "ray"
    finally:
        if started_here:
            ray.shutdown()
