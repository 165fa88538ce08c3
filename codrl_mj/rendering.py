"""Films of episodes: the scene, and under it a strip of desired and actual torque.

Episodes are recorded first and drawn afterwards from their states, so that drawing never disturbs a simulation.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.envs import ActuatedEnv
from codrl_mj.evaluation import Episode
from codrl_mj.files import writing
from codrl_mj.motor import Actuator
from codrl_mj.physics.offscreen import OffscreenRenderer

FORMATS = (".mp4", ".gif")
_DPI = 100
_TITLE_HEIGHT = 40  # px
_HEADER_HEIGHT, _PLOT_HEIGHT, _TIME_HEIGHT = 24, 120, 26  # px, the strip's legend, plot and time axis
_AXIS_WIDTH, _MARGIN = 62, 10  # px, left and right of the plot
_MIN_WIDTH, _MIN_HEIGHT = 160, 80  # px
_WINDOW_STEPS = 150  # environment steps that the strip shows at a time
_MAX_FPS = 30
_DESIRED, _ACTUAL, _SATURATED = "#0072B2", "#D55E00", "#CC79A7"  # told apart by colour-blind eyes (Okabe and Ito)
_FELL, _LASTED = "#B03A2E", "#1E8449"


@dataclasses.dataclass(frozen=True)
class Panel:
    """One episode to be shown, beside others."""

    title: str
    """Drawn above the scene."""
    task: str
    """Task name."""
    actuator: Actuator | None
    """What the episode ran on; None is the ideal actuator."""
    episode: Episode
    """The episode."""


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
        out: the file to make; its suffix chooses the format (`.mp4`: H.264; `.gif`).
        width: width of one panel [px], even, >= 160.
        height: height of one panel's scene [px], even, >= 80.
        camera: a camera of the model.
        pretty: shadows, reflections and multisampling.
        on_frame: called with (frames written, frames in all).

    Returns:
        `out`.

    Raises:
        ValueError: no panel, unknown format, odd or too small a size, or unknown camera.
        RenderingUnavailableError: no OpenGL context can be made here; the message has the remedy.
    """
    import imageio

    if out.suffix not in FORMATS:
        raise ValueError(f"video {out}: unknown format {out.suffix!r}: the suffix must be one of {', '.join(FORMATS)}")
    if not panels:
        raise ValueError("panels: there must be at least one episode to show")
    for name, size in (("width", width), ("height", height)):
        if size % 2:
            raise ValueError(f"{name} = {size}: must be even, as video encoders need it [px]")
    for name, size, least in (("width", width, _MIN_WIDTH), ("height", height, _MIN_HEIGHT)):
        if size < least:
            raise ValueError(f"{name} = {size}: must be >= {least} [px], for the title and the strip")
    drawn: list[_DrawnPanel] = []
    try:
        for panel in panels:
            drawn.append(_DrawnPanel(panel, width, height, camera, pretty, _end(panels)))  # noqa: PERF401 - may raise
        stride = max(1, round(drawn[0].rate / _MAX_FPS))
        last = max(len(panel.episode.reward) for panel in panels)
        instants = [*range(0, last, stride), last]
        fps = drawn[0].rate / stride
        options: dict[str, Any] = (
            {"fps": fps, "codec": "libx264", "quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "error"}
            if out.suffix == ".mp4"
            else {"duration": 1000 / fps, "loop": 0}  # ms
        )
        with writing(out) as temporary, imageio.get_writer(temporary, **options) as writer:
            for count, instant in enumerate(instants, 1):
                writer.append_data(np.hstack([drawing.frame(instant) for drawing in drawn]))
                if on_frame is not None:
                    on_frame(count, len(instants))
    finally:
        for drawing in drawn:
            drawing.close()
    return out


def _end(panels: Sequence[Panel]) -> float:
    """Time at which the longest episode ends [s]."""
    return max(float(panel.episode.time[-1]) for panel in panels)


class _DrawnPanel:
    """A panel with its scene, its title and its strip drawn once; frames slide a window over the strip."""

    def __init__(self, panel: Panel, width: int, height: int, camera: str, pretty: bool, end: float) -> None:
        self._panel = panel
        self._env = ActuatedEnv(panel.task, "ideal")
        self.rate = self._env.metadata["render_fps"]
        self._renderer = OffscreenRenderer(self._env.model, width, height, camera, pretty)
        self._title = _draw_text(panel.title, width)
        self._window = min(end, _WINDOW_STEPS * float(panel.episode.time[0]))
        self._scale = (width - _AXIS_WIDTH - _MARGIN) / self._window  # px per second
        self._axis, self._strip = _draw_strip(panel, width, round(self._scale * end), end)
        self._last = len(panel.episode.reward)
        fell, over = panel.episode.terminated, panel.episode.time[-1]
        self._over = _draw_text(
            f"ended at {over:.2f} s" if fell else f"time limit, {over:.2f} s", width, _FELL if fell else _LASTED
        )

    def frame(self, instant: int) -> np.ndarray:
        """The panel after `instant` steps, shape (height, width, 3), uint8."""
        episode, now = self._panel.episode, min(instant, self._last)
        self._env.physics.show(episode.state[now])  # type: ignore[attr-defined]
        scene = self._renderer.render(self._env.data).copy()
        if now == self._last:
            scene[-_TITLE_HEIGHT:] = self._over
            if episode.terminated:
                scene[:-_TITLE_HEIGHT] = scene[:-_TITLE_HEIGHT] // 2 + 90  # faded
        time = float(episode.time[now - 1]) if now else 0.0
        begin = round(self._scale * max(0.0, time - self._window))
        size = round(self._scale * self._window)
        shown = self._strip[:, begin : begin + size].copy()
        cursor = min(round(self._scale * time) - begin, size - 1)
        shown[:_PLOT_HEIGHT, cursor + 1 :] = 255  # what has not happened yet
        shown[:_PLOT_HEIGHT, cursor] = 120
        strip = self._axis.copy()
        strip[_HEADER_HEIGHT:, _AXIS_WIDTH : _AXIS_WIDTH + size] = shown
        return np.vstack([self._title, scene, strip])

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()


def _figure(width: int, height: int) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
    FigureCanvasAgg(figure)
    return figure


def _pixels(figure: Any) -> np.ndarray:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()


def _draw_text(text: str, width: int, colour: str = "#22313F") -> np.ndarray:
    figure = _figure(width, _TITLE_HEIGHT)
    figure.text(0.5, 0.5, text, ha="center", va="center", fontsize=12, color=colour, weight="bold")
    return _pixels(figure)


def _draw_strip(panel: Panel, width: int, length: int, end: float) -> tuple[np.ndarray, np.ndarray]:
    """The strip's frame, `width` wide (legend and vertical axis), and its whole content, `length` wide."""
    body = _PLOT_HEIGHT + _TIME_HEIGHT
    frame, content = _figure(width, _HEADER_HEIGHT + body), _figure(length, body)
    axis = frame.add_axes(
        (_AXIS_WIDTH / width, _TIME_HEIGHT / (_HEADER_HEIGHT + body), 1e-6, _PLOT_HEIGHT / (_HEADER_HEIGHT + body))
    )
    plot = content.add_axes((0, _TIME_HEIGHT / body, 1, _PLOT_HEIGHT / body))
    lines = _plot_torque(panel, plot, end)
    for axes in (axis, plot):
        axes.set_ylim(plot.get_ylim())
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    axis.set_ylabel("torque [N·m]" if panel.actuator else "force [N]", fontsize=9)
    axis.set_xticks([])
    plot.set(yticks=[], xlim=(0, end))
    plot.spines["left"].set_visible(False)
    plot.xaxis.set_major_formatter("{x:g} s")
    frame.legend(handles=lines, loc="upper right", ncols=3, fontsize=8, frameon=False, borderaxespad=0.2)
    return _pixels(frame), _pixels(content)


def _plot_torque(panel: Panel, axes: Any, end: float) -> list[Any]:
    """Plot desired and actual torque (force, where there is no motor), and where the voltage was at its limit."""
    from matplotlib.ticker import MultipleLocator

    episode, arm = panel.episode, 1.0 if panel.actuator is None else panel.actuator.motor.arm_radius
    time = np.concatenate([[0.0], episode.time])
    desired, actual = episode.signals["desired_force"] * arm, episode.signals["actual_force"] * arm
    limit = 1.15 * max(np.abs(desired).max(), np.abs(actual).max(), 1e-9)
    axes.set_ylim(-limit, limit)
    axes.xaxis.set_major_locator(MultipleLocator(max(0.5, np.ceil(end / 20) / 2)))
    axes.axhline(0, color="0.85", linewidth=0.8)
    lines = [
        axes.stairs(values, time, baseline=None, color=colour, linewidth=line, label=label)
        for values, colour, label, line in (
            (desired, _DESIRED, "desired", 1.0),
            (actual, _ACTUAL, "actual", 2.0),
        )
    ]
    if episode.signals["saturated"].any():
        band = np.where(episode.signals["saturated"], limit, -limit)
        options = {"baseline": -limit, "fill": True, "color": _SATURATED, "alpha": 0.3}
        lines.append(axes.stairs(band, time, label="voltage saturated", **options))
    return lines
