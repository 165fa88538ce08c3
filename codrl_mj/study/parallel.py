"""Calls computed many at once, in processes of this machine or on a Ray cluster; nothing else here starts processes."""

import contextlib
import dataclasses
import functools
import itertools
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Literal

from codrl_mj.fields import Checked, choice
from codrl_mj.training import TrainingStoppedError
from codrl_mj.training.run import collecting_signals


@dataclasses.dataclass(frozen=True)
class Workers(Checked):
    """What computes the calls.

    Raises:
        ValueError: unknown backend, or an impossible number of jobs.
    """

    jobs: int = -1
    """Calls at once, >= 1; -1 for one on each CPU (of the cluster)."""
    backend: Literal["local", "ray"] = choice("local", "local", "ray")
    """`local`: processes of this machine; `ray`: a Ray cluster, whose machines all see the run folders."""
    address: str | None = None
    """Of the Ray cluster, such as `auto` or `ray://head:10001`; None starts Ray on this machine."""

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
        """Processors of this machine that so many jobs use."""
        return (os.cpu_count() or 1) if self.jobs == -1 else self.jobs


def compute(
    function: Callable[..., Any], work: Iterable[tuple[Any, ...]], workers: Workers
) -> Iterator[Any]:
    """Results of calls, all of it picklable, as they come; those of a Ray cluster when all are there.

    After a Ctrl-C no call is begun any more, trainings write their checkpoints, and other calls
    end; a second one stops at once. What a call raises breaks the others off. Processes end with
    this one, however it ends.
    """
    calls = list(work)
    if not calls:
        return
    import joblib

    local = workers.backend == "local"
    none: list[int] = []
    with (
        _backend(workers) as backend,
        collecting_signals(signal.SIGINT) if local else contextlib.nullcontext(none) as asked,
    ):
        parallel = joblib.Parallel(
            n_jobs=workers.jobs,
            backend=backend,
            batch_size=1,
            pre_dispatch="n_jobs",
            return_as="generator_unordered" if local else "list",
        )
        call = joblib.delayed(_call)
        parent = os.getpid() if local else None
        begun = itertools.takewhile(lambda _: not asked, calls)
        for result, stopped_by in parallel(
            call(function, arguments, parent) for arguments in begun
        ):
            if stopped_by is None:
                yield result
            else:
                asked.append(stopped_by)
        if asked:
            raise TrainingStoppedError(
                "stopped: the same command goes on from the last checkpoints", asked[0]
            )


def _call(
    function: Callable[..., Any], arguments: tuple[Any, ...], parent: int | None
) -> tuple[Any, int | None]:
    """The result, and the signal that stopped it."""
    if parent is not None and os.getpid() != parent:
        _serve(parent)
    try:
        return function(*arguments), None
    except TrainingStoppedError as stopped:
        return None, stopped.signal_number


@functools.cache
def _serve(parent: int) -> None:
    """Have this process end when its parent does, even if that is killed, and leave Ctrl-C to it and to trainings."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _backend(workers: Workers) -> Iterator[str]:
    """The name in joblib of the backend, which is up while the block runs."""
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
    ours = not ray.is_initialized()
    if ours:
        ray.init(address=workers.address, log_to_driver=False)
    register_ray()
    try:
        yield "ray"
    finally:
        if ours:
            ray.shutdown()
