"""Films of episodes: the scene, and under it a strip of desired and actual torque and the voltage.

Episodes of tasks are recorded first and drawn afterwards from their states, so that drawing never disturbs a
simulation; an environment of somebody else's draws itself while it runs.
"""

import contextlib
import dataclasses
import itertools
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.evaluation.episodes import Episode
from codrl_mj.films.strip import AXIS_WIDTH, HEADER_HEIGHT, PLOT_HEIGHT, draw_strip, draw_text, pixels_per_second
from codrl_mj.physics.offscreen import OffscreenRenderer
from codrl_mj.runs.files import writing, writing_folder

FORMATS = (".mp4", ".gif", "")
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
    frames: Sequence[np.ndarray] | None = None
    """Of an environment of somebody else's: the scene before the first step and after each, each (height, width, 3),
    uint8, as `Filmed` keeps them; None: the task's own."""
    rate: float = 0.0
    """Of these: images a second."""


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
    if out.suffix not in FORMATS:
        raise ValueError(
            f"film {out}: unknown format {out.suffix!r}: the suffix must be one of {', '.join(FORMATS[:-1])}, or none "
            "for a folder of PNG frames"
        )
    if out.suffix == "" and out.exists():
        raise FileExistsError(f"folder {out} exists already: choose another --out, or delete it")
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
        with _encoding(out, drawn[0].rate / stride) as add:
            for count, instant in enumerate(instants, 1):
                add(np.hstack([drawing.frame(instant) for drawing in drawn]))
                if on_frame is not None:
                    on_frame(count, len(instants))
    finally:
        for drawing in drawn:
            drawing.close()
    return out


@contextlib.contextmanager
def _encoding(out: Path, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """A function that appends a frame to the film at `out`, which appears when the block ends."""
    import imageio

    if out.suffix == "":
        counter = itertools.count()
        with writing_folder(out) as folder:
            yield lambda frame: imageio.imwrite(folder / f"frame_{next(counter):05d}.png", frame)
        return
    options: dict[str, Any] = (
        {"fps": fps, "codec": "libx264", "quality": None, "macro_block_size": 2, "ffmpeg_log_level": "error"}
        | {"output_params": ["-preset", "veryfast", "-crf", "18"]}  # half the time of the default, and a smaller file
        if out.suffix == ".mp4"
        else {"duration": 1000 / fps, "loop": 0}  # ms
    )
    with writing(out) as temporary, imageio.get_writer(temporary, **options) as writer:
        yield writer.append_data


def _end(panels: Sequence[Panel]) -> float:
    """Time at which the longest episode ends [s]."""
    return max(float(panel.episode.time[-1]) for panel in panels)


class _DrawnPanel:
    """A panel with its scene, its title and its strip drawn once; frames slide a window over the strip."""

    def __init__(self, panel: Panel, width: int, height: int, camera: str, pretty: bool, end: float) -> None:
        self._panel = panel
        self._scene: Any
        if panel.frames is None:
            self._scene = _TaskScene(panel, width, height, camera, pretty)
        else:
            self._scene = _FilmedScene(panel.frames, panel.rate, width, height)
        self.rate = self._scene.rate
        self._title = draw_text(panel.title, width, _TITLE_HEIGHT)
        self._window = min(end, _WINDOW_STEPS * float(panel.episode.time[0]))
        self._scale = pixels_per_second(width, self._window)
        self._axis, self._strip = draw_strip(panel.episode, panel.actuator, width, self._window, end, panel.motor)
        self._last = len(panel.episode.reward)
        fell, over = panel.episode.terminated, panel.episode.time[-1]
        ending = f"ended at {over:.2f} s" if fell else f"time limit, {over:.2f} s"
        self._over = draw_text(ending, width, _TITLE_HEIGHT, _FELL if fell else _LASTED)

    def frame(self, instant: int) -> np.ndarray:
        """The panel after `instant` steps, shape (height, width, 3), uint8."""
        episode, now = self._panel.episode, min(instant, self._last)
        scene = self._scene.image(now)
        if now == self._last:
            scene[-_TITLE_HEIGHT:] = self._over
            if episode.terminated:
                scene[:-_TITLE_HEIGHT] = scene[:-_TITLE_HEIGHT] // 2 + 90  # faded
        time = float(episode.time[now - 1]) if now else 0.0
        begin = round(self._scale * max(0.0, time - self._window))
        size = round(self._scale * self._window)
        shown = self._strip[:, begin : begin + size].copy()
        cursor = min(round(self._scale * time) - begin, size - 1)
        shown[:PLOT_HEIGHT, cursor + 1 :] = 255  # what has not happened yet
        shown[:PLOT_HEIGHT, cursor] = 120
        strip = self._axis.copy()
        strip[HEADER_HEIGHT:, AXIS_WIDTH : AXIS_WIDTH + size] = shown
        return np.vstack([self._title, scene, strip])

    def close(self) -> None:
        """Free the OpenGL context."""
        self._scene.close()


class _TaskScene:
    """A task's scene, drawn from the episode's states."""

    def __init__(self, panel: Panel, width: int, height: int, camera: str, pretty: bool) -> None:
        self._env, self._states = ActuatedEnv(panel.task, "ideal"), panel.episode.state
        self.rate = self._env.metadata["render_fps"]
        self._renderer = OffscreenRenderer(self._env.model, width, height, camera, pretty)

    def image(self, instant: int) -> np.ndarray:
        self._env.physics.show(self._states[instant])  # type: ignore[attr-defined]
        return self._renderer.render(self._env.data).copy()

    def close(self) -> None:
        self._renderer.close()


class _FilmedScene:
    """Images that were taken while the episode ran, brought to size."""

    def __init__(self, frames: Sequence[np.ndarray], rate: float, width: int, height: int) -> None:
        self._frames, self._size, self.rate = frames, (width, height), rate

    def image(self, instant: int) -> np.ndarray:
        from PIL import Image

        frame = Image.fromarray(self._frames[instant])
        return np.array(frame if frame.size == self._size else frame.resize(self._size))

    def close(self) -> None:
        """Nothing is held."""


class Frames(Sequence[np.ndarray]):
    """Images, packed: those of an episode would fill a gigabyte."""

    def __init__(self) -> None:
        """Begin with none."""
        self._packed: list[tuple[tuple[int, ...], bytes]] = []

    def add(self, image: Any) -> None:
        """Append one, (height, width, 3), uint8."""
        self._packed.append((image.shape, zlib.compress(image.tobytes(), 1)))

    def __len__(self) -> int:
        """How many there are."""
        return len(self._packed)

    def __getitem__(self, index: Any) -> Any:
        """The image at an index."""
        shape, packed = self._packed[index]
        return np.frombuffer(zlib.decompress(packed), np.uint8).reshape(shape)


class Filmed(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Keeps an image of every instant of an episode: `frames`."""

    def __init__(self, env: "gymnasium.Env[Any, Any]", pretty: bool = False) -> None:
        """Film an environment.

        Args:
            env: with `render_mode="rgb_array"`.
            pretty: shadows and multisampling, where its model has them; on a CPU they cost ten times the rest.

        Raises:
            ValueError: it draws no images.
        """
        if env.render_mode != "rgb_array":
            raise ValueError(f"render_mode = {env.render_mode!r}: must be 'rgb_array' for a film")
        super().__init__(env)
        if not pretty and hasattr(env.unwrapped, "model"):
            quality = env.unwrapped.model.vis.quality
            quality.shadowsize = quality.offsamples = 0
        self.frames = Frames()

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode, and its film."""
        result = self.env.reset(**options)
        self.frames = Frames()
        self.frames.add(self.env.render())
        return result

    def step(self, action: Any) -> Any:
        """Advance by one environment step."""
        result = self.env.step(action)
        self.frames.add(self.env.render())
        return result
