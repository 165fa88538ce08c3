"""Frames into a file, encoded while the next one is drawn."""

import contextlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.runs.files import writing, writing_folder

FORMATS = (".mp4", ".gif", "")
FINE = ("-preset", "veryfast", "-crf", "18")  # half the time of the default, and a smaller file


@contextlib.contextmanager
def encoding(out: Path, fps: float, h264: Sequence[str] = FINE) -> Iterator[Callable[[np.ndarray], None]]:
    """A function that appends a frame to the film at `out`, which appears when the block ends.

    Args:
        out: `.mp4` (H.264) or `.gif`; without a suffix, a folder of PNG frames.
        fps: frames a second.
        h264: what ffmpeg is told of it.
    """
    with _writer(out, fps, h264) as write, ThreadPoolExecutor(1) as beside:
        last: list[Future[None]] = []

        def add(frame: np.ndarray) -> None:
            if last:
                last.pop().result()
            last.append(beside.submit(write, frame))

        yield add
        for one in last:
            one.result()


@contextlib.contextmanager
def _writer(out: Path, fps: float, h264: Sequence[str]) -> Iterator[Callable[[np.ndarray], None]]:
    import imageio

    if out.suffix == "":
        counter = itertools.count()
        with writing_folder(out) as folder:
            yield lambda frame: imageio.imwrite(folder / f"frame_{next(counter):05d}.png", frame)
        return
    options: dict[str, Any] = {"duration": 1000 / fps, "loop": 0}  # ms
    if out.suffix == ".mp4":
        options = {"fps": fps, "codec": "libx264", "quality": None, "macro_block_size": 2, "ffmpeg_log_level": "error"}
        options["output_params"] = [*h264]
    with writing(out) as temporary, imageio.get_writer(temporary, **options) as writer:
        yield writer.append_data
