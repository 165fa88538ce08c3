"""Films of episodes: the scene, and under it a strip of desired and actual torque and the voltage.

Episodes of tasks are recorded first and drawn afterwards from their states, so that drawing never disturbs a
simulation; an environment of somebody else's draws itself while it runs.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.evaluation.episodes import Episode
from codrl_mj.films.encode import FORMATS, encoding
from codrl_mj.films.record import Frames
from codrl_mj.films.scene import Scene
from codrl_mj.films.strip import (
    AXIS_WIDTH,
    HEADER_HEIGHT,
    MARGIN,
    PLOT_HEIGHT,
    draw_strip,
    draw_text,
    pixels_per_second,
)

_TITLE_HEIGHT = 40  # px
_MIN_WIDTH, _MIN_HEIGHT = 160, 80  # px
_WINDOW_STEPS = 150  # environment steps that the strip shows at a time
_MAX_FPS = 30
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
    drawn: list[_DrawnPanel] = []
    try:
        for panel in panels:
            drawn.append(_DrawnPanel(panel, width, height, camera, pretty, _end(panels)))  # noqa: PERF401 - may raise
        stride = max(1, round(drawn[0].rate / _MAX_FPS))
        last = max(len(panel.episode.reward) for panel in panels)
        instants = [*range(0, last, stride), last]
        blank = np.hstack([drawing.blank for drawing in drawn])
        with encoding(out, drawn[0].rate / stride) as add:
            for count, instant in enumerate(instants, 1):
                frame = blank.copy()
                for drawing, part in zip(drawn, np.hsplit(frame, len(drawn)), strict=True):
                    drawing.draw(instant, part)
                add(frame)
                if on_frame is not None:
                    on_frame(count, len(instants))
    finally:
        for drawing in drawn:
            drawing.close()
    return out


def check_film(out: Path, width: int, height: int) -> None:
    """Refuse a film's file and size, as `film` does, before there is an episode.

    Raises:
        FileExistsError: the folder for the frames exists.
        ValueError: unknown format, odd or too small a size.
    """
    if out.suffix not in FORMATS:
        raise ValueError(
            f"film {out}: unknown format {out.suffix!r}: the suffix must be one of {', '.join(FORMATS[:-1])}, or none "
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


def _end(panels: Sequence[Panel]) -> float:
    """Time at which the longest episode ends [s]."""
    return max(float(panel.episode.time[-1]) for panel in panels)


class _DrawnPanel:
    """A panel with its title and its strip drawn once; frames slide a window over the strip."""

    def __init__(self, panel: Panel, width: int, height: int, camera: str, pretty: bool, end: float) -> None:
        episode = panel.episode
        self._panel, self._top, self._bottom = panel, _TITLE_HEIGHT, _TITLE_HEIGHT + height
        self._scene = Scene(panel.task, episode, panel.frames, width, height, camera, pretty)
        self.rate = self._scene.rate
        self._window = min(end, _WINDOW_STEPS * float(episode.time[0]))
        self._scale = pixels_per_second(width, self._window)
        self._axis, self._strip = draw_strip(panel.task, episode, panel.actuator, width, self._window, end, panel.motor)
        scene = np.zeros((height, width, 3), np.uint8)
        self.blank = np.vstack([draw_text(panel.title, width, _TITLE_HEIGHT), scene, self._axis])
        self._last = len(episode.reward)
        fell, over = episode.terminated, episode.time[-1]
        ending = f"ended at {over:.2f} s" if fell else f"time limit, {over:.2f} s"
        self._over = draw_text(ending, width, _TITLE_HEIGHT, _FELL if fell else _LASTED)

    def draw(self, instant: int, frame: np.ndarray) -> None:
        """Draw the panel after `instant` steps over its `blank` one, shape (height, width, 3), uint8."""
        episode, now = self._panel.episode, min(instant, self._last)
        scene = frame[self._top : self._bottom]
        scene[:] = self._scene.image(now)
        if now == self._last:
            scene[-_TITLE_HEIGHT:] = self._over
            if episode.terminated:
                scene[:-_TITLE_HEIGHT] = scene[:-_TITLE_HEIGHT] // 2 + 90  # faded
        time = float(episode.time[now - 1]) if now else 0.0
        begin = round(self._scale * max(0.0, time - self._window))
        size = round(self._scale * self._window)
        cursor = min(round(self._scale * time) - begin, size - 1)
        shown = self._strip[:, begin : begin + size + MARGIN]
        strip = frame[self._bottom + HEADER_HEIGHT :, AXIS_WIDTH : AXIS_WIDTH + shown.shape[1]]
        strip[PLOT_HEIGHT:] = shown[PLOT_HEIGHT:]
        strip[:PLOT_HEIGHT, :cursor] = shown[:PLOT_HEIGHT, :cursor]  # and nothing of what has not happened yet
        strip[:PLOT_HEIGHT, cursor] = 120

    def close(self) -> None:
        """Free the OpenGL context."""
        self._scene.close()
