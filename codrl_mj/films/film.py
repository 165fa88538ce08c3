"""Films of episodes: as a file, with a strip of torque and voltage under the scene; as a clip, the scene alone.

Episodes of tasks are recorded first and drawn afterwards from their states, so that drawing never disturbs a
simulation; an environment of somebody else's draws itself while it runs.
"""

import contextlib
import dataclasses
import io
import itertools
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.evaluation.episodes import Episode
from codrl_mj.films.record import Frames, scene
from codrl_mj.films.strip import (
    AXIS_WIDTH,
    HEADER_HEIGHT,
    MARGIN,
    PLOT_HEIGHT,
    draw_strip,
    draw_text,
    pixels_per_second,
)
from codrl_mj.runs.files import writing, writing_folder

_FORMATS = (".mp4", ".gif", "")
_FINE = ("-preset", "veryfast", "-crf", "18")
"""For files: half the time of ffmpeg's default, and a smaller file."""
_SOUGHT = ("-preset", "veryfast", "-crf", "26", "-g", "15", "-movflags", "+faststart")
"""For pages: a key frame every half second, for it is sought in; up to date players need no more than this."""
_TITLE_HEIGHT = 40  # px
_MIN_WIDTH, _MIN_HEIGHT = 160, 80  # px
_WINDOW_STEPS = 150  # environment steps that the strip shows at a time
_MAX_FPS, _MOST_FRAMES = 30, 600
"""Frames a second, and in a clip."""
_FELL, _LASTED = "#B03A2E", "#1E8449"


@dataclasses.dataclass(frozen=True)
class Panel:
    """One episode to be shown, beside others."""

    title: str
    """Drawn above the scene."""
    task: str
    """Task name."""
    actuator: Any
    """What the episode ran on; with several motors a tuple."""
    episode: Episode
    """The episode."""
    motor: int = 0
    """Which of several motors the strip shows."""
    frames: Frames | None = None
    """Of an environment of somebody else's: what `record` returned beside the episode."""


def film(
    panels: Sequence[Panel],
    out: Path,
    width: int = 480,
    height: int = 360,
    camera: str = "fixed",
    pretty: bool = False,
    on_frame: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a video of episodes side by side, at the task's frame rate (CartPole: the time of the simulation).

    Args:
        panels: one or more episodes of the same task, side by side; a shorter one stands still at its end.
        out: the file to make; its suffix chooses the format (`.mp4`: H.264; `.gif`). Without a suffix, a folder of PNG
            frames.
        width: width of one panel [px], even, >= 160.
        height: height of one panel's scene [px], even, >= 80.
        camera: a camera of the model.
        pretty: shadows, reflections and multisampling.
        on_frame: called with (frames written, frames in all).

    Returns:
        `out`.

    Raises:
        FileExistsError: the folder for the frames exists.
        ValueError: no panel, unknown format, odd or too small a size, or unknown camera.
        RenderingUnavailableError: no OpenGL context can be made here; the message has the remedy.
    """
    check_film(out, width, height)
    if not panels:
        raise ValueError("panels: there must be at least one episode to show")
    end = max(float(panel.episode.time[-1]) for panel in panels)
    with contextlib.ExitStack() as stack:
        scenes = [
            stack.enter_context(scene(one.task, one.episode, one.frames, (width, height), camera, pretty))
            for one in panels
        ]
        drawn = [_DrawnPanel(one, image, width, height, end) for one, (_, image) in zip(panels, scenes, strict=True)]
        rate, last = scenes[0][0], max(len(panel.episode.reward) for panel in panels)
        stride = max(1, round(rate / _MAX_FPS))
        instants = [*range(0, last, stride), last]
        blank = np.hstack([drawing.blank for drawing in drawn])
        add = stack.enter_context(_encoding(out, rate / stride))
        for count, instant in enumerate(instants, 1):
            frame = blank.copy()
            for drawing, part in zip(drawn, np.hsplit(frame, len(drawn)), strict=True):
                drawing.draw(instant, part)
            add(frame)
            if on_frame is not None:
                on_frame(count, len(instants))
    return out


def check_film(out: Path, width: int, height: int) -> None:
    """Refuse a film's file and size, as `film` does, before there is an episode.

    Raises:
        FileExistsError: the folder for the frames exists.
        ValueError: unknown format, odd or too small a size.
    """
    if out.suffix not in _FORMATS:
        raise ValueError(
            f"film {out}: unknown format {out.suffix!r}: the suffix must be one of {', '.join(_FORMATS[:-1])}, or none "
            "for a folder of PNG frames"
        )
    if out.suffix == "" and out.exists():
        raise FileExistsError(f"folder {out} exists already: choose another --out, or delete it")
    for name, size in (("width", width), ("height", height)):
        if size % 2:
            raise ValueError(f"{name} = {size}: must be even, as video encoders need it [px]")
    for name, size, least in (("width", width, _MIN_WIDTH), ("height", height, _MIN_HEIGHT)):
        if size < least:
            raise ValueError(f"{name} = {size}: must be >= {least} [px], for the title and the strip")


class Clip(NamedTuple):
    """A film whose frame k shows the time k/rate of its episode, until the next."""

    video: bytes
    """H.264 in an MP4 file."""
    rate: float
    """Frames a second of the episode."""
    still: bytes
    """An image of it, a JPEG file."""


def clip(task: str, episode: Episode, taken: Frames | None, width: int, height: int) -> Clip:
    """The scene of a task's episode in memory, even sizes [px]; `taken` is what `record` returned beside the episode.

    Raises:
        RenderingUnavailableError: no OpenGL context can be made here; the message has the remedy.
    """
    from PIL import Image

    steps, duration = len(episode.time), float(episode.time[0])
    stride = max(1, round(1.0 / (duration * _MAX_FPS)), -(-steps // _MOST_FRAMES))
    instants = [*range(0, steps, stride), steps]
    rate, still = 1.0 / (stride * duration), io.BytesIO()
    with scene(task, episode, taken, (width, height)) as (_, draw), tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        with _encoding(path, rate, _SOUGHT) as add:
            for place, instant in enumerate(instants):
                image = draw(instant)
                if place == len(instants) // 3:
                    Image.fromarray(image).save(still, "jpeg", quality=85)
                add(image)
        return Clip(path.read_bytes(), rate, still.getvalue())


@contextlib.contextmanager
def _encoding(out: Path, fps: float, h264: Sequence[str] = _FINE) -> Iterator[Callable[[np.ndarray], None]]:
    """A function that appends a frame, encoded while the next one is drawn, to a film that appears when all is well."""
    import imageio

    options: dict[str, Any] = {"duration": 1000 / fps, "loop": 0}  # ms
    if out.suffix == ".mp4":
        options = {"fps": fps, "codec": "libx264", "quality": None, "macro_block_size": 2, "ffmpeg_log_level": "error"}
        options["output_params"] = [*h264]
    with contextlib.ExitStack() as stack:
        if out.suffix == "":
            folder, counter = stack.enter_context(writing_folder(out)), itertools.count()

            def write(frame: np.ndarray) -> None:
                imageio.imwrite(folder / f"frame_{next(counter):05d}.png", frame)
        else:
            temporary = stack.enter_context(writing(out))
            write = stack.enter_context(imageio.get_writer(temporary, **options)).append_data
        beside = stack.enter_context(ThreadPoolExecutor(1))
        last: list[Future[None]] = []

        def add(frame: np.ndarray) -> None:
            if last:
                last.pop().result()
            last.append(beside.submit(write, frame))

        yield add
        for one in last:
            one.result()


class _DrawnPanel:
    """A panel with its title and its strip drawn once; frames slide a window over the strip."""

    def __init__(self, panel: Panel, image: Callable[[int], np.ndarray], width: int, height: int, end: float) -> None:
        """Draw them; `image` draws the scene after so many steps, and `end` [s] is where the longest episode ends."""
        episode = panel.episode
        self._panel, self._top, self._bottom = panel, _TITLE_HEIGHT, _TITLE_HEIGHT + height
        self._image = image
        self._window = min(end, _WINDOW_STEPS * float(episode.time[0]))
        self._scale = pixels_per_second(width, self._window)
        self._axis, self._strip = draw_strip(panel.task, episode, panel.actuator, width, self._window, end, panel.motor)
        empty = np.zeros((height, width, 3), np.uint8)
        self.blank = np.vstack([draw_text(panel.title, width, _TITLE_HEIGHT), empty, self._axis])
        self._last = len(episode.reward)
        fell, over = episode.terminated, episode.time[-1]
        ending = f"ended at {over:.2f} s" if fell else f"time limit, {over:.2f} s"
        self._over = draw_text(ending, width, _TITLE_HEIGHT, _FELL if fell else _LASTED)

    def draw(self, instant: int, frame: np.ndarray) -> None:
        """Draw the panel after `instant` steps over its `blank` one, shape (height, width, 3), uint8."""
        episode, now = self._panel.episode, min(instant, self._last)
        view = frame[self._top : self._bottom]
        view[:] = self._image(now)
        if now == self._last:
            view[-_TITLE_HEIGHT:] = self._over
            if episode.terminated:
                view[:-_TITLE_HEIGHT] = view[:-_TITLE_HEIGHT] // 2 + 90  # faded
        time = float(episode.time[now - 1]) if now else 0.0
        begin = round(self._scale * max(0.0, time - self._window))
        size = round(self._scale * self._window)
        cursor = min(round(self._scale * time) - begin, size - 1)
        shown = self._strip[:, begin : begin + size + MARGIN]
        strip = frame[self._bottom + HEADER_HEIGHT :, AXIS_WIDTH : AXIS_WIDTH + shown.shape[1]]
        strip[PLOT_HEIGHT:] = shown[PLOT_HEIGHT:]
        strip[:PLOT_HEIGHT, :cursor] = shown[:PLOT_HEIGHT, :cursor]  # and nothing of what has not happened yet
        strip[:PLOT_HEIGHT, cursor] = 120
