"""Films of episodes: as a file, with a strip of torque and voltage under the scene; as a clip, the scene alone.

Episodes of tasks are recorded first and drawn afterwards from their states, so that drawing never
disturbs a simulation; an environment of somebody else's draws itself while it runs.
"""

import contextlib
import dataclasses
import io
import itertools
import tempfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.evaluation.episodes import Episode, run_episodes
from codrl_mj.physics.offscreen import OffscreenRenderer
from codrl_mj.runs.files import atomic_write, atomic_folder
from codrl_mj.viz.films.strip import (
    AXIS_WIDTH,
    HEADER_HEIGHT,
    MARGIN,
    PLOT_HEIGHT,
    draw_strip,
    draw_text,
)

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


class Filmed(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Keeps an image of every instant of an episode, packed: they would fill a gigabyte."""

    def __init__(self, env: "gymnasium.Env[Any, Any]", pretty: bool = False) -> None:
        """Film an environment; pretty are shadows and multisampling, which on a CPU cost ten times the rest."""
        if env.render_mode != "rgb_array":
            raise ValueError(f"render_mode = {env.render_mode!r}: must be 'rgb_array' for a film")
        super().__init__(env)
        if not pretty and hasattr(env.unwrapped, "model"):
            quality = env.unwrapped.model.vis.quality
            quality.shadowsize = quality.offsamples = 0

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode, and its film."""
        result = self.env.reset(**options)
        self._packed: list[tuple[tuple[int, ...], bytes]] = []
        self._keep(self.env.render())
        return result

    def step(self, action: Any) -> Any:
        """Advance by one environment step."""
        result = self.env.step(action)
        self._keep(self.env.render())
        return result

    def _keep(self, image: Any) -> None:
        self._packed.append((image.shape, zlib.compress(image.tobytes(), 1)))

    def image(self, instant: int) -> np.ndarray:
        """What was seen after so many steps: (height, width, 3), uint8."""
        shape, packed = self._packed[instant]
        return np.frombuffer(zlib.decompress(packed), np.uint8).reshape(shape)


@dataclasses.dataclass(frozen=True)
class Panel:
    """One episode to be shown, beside others."""

    task: str
    """Task name."""
    episode: Episode
    """The episode."""
    seen: Filmed | None = None
    """Of an environment of somebody else's: what was seen of it."""
    title: str = ""
    """Drawn above the scene."""
    motor: int = 0
    """Which of several motors the strip shows."""


def record(
    policy: Any,
    env: Any,
    seed: int,
    width: int,
    height: int,
    camera: str = "fixed",
    pretty: bool = False,
) -> Panel:
    """Run an episode, in an `EnvConfig`, to be filmed in images of a size [px].

    In environments of others the camera `fixed` is their own, and what is seen is kept; our tasks
    are drawn from their states.
    """
    view, made = env.world.view(env, width, height, None if camera == "fixed" else camera), []
    if view is None:
        return Panel(env.task, run_episodes(policy, env.make, 1, seed)[0])

    def make() -> Any:
        made.append(Filmed(env.make(**view), pretty))
        return made[-1]

    (episode,) = run_episodes(policy, make, 1, seed)
    return Panel(env.task, episode, made[0])


@contextlib.contextmanager
def _scene(
    panel: Panel, size: tuple[int, int], camera: str = "fixed", pretty: bool = False
) -> Iterator[tuple[float, Callable[[int], np.ndarray]]]:
    """Frames a second of an episode, and what draws its scene after so many steps: (height, width, 3), uint8, new.

    Of a task an OpenGL context is held meanwhile.
    """
    episode, seen = panel.episode, panel.seen
    if seen is not None:
        from PIL import Image

        def sized(instant: int) -> np.ndarray:
            image = Image.fromarray(seen.image(instant))
            return np.array(image if image.size == size else image.resize(size))

        yield seen.metadata.get("render_fps") or 1.0 / float(episode.time[0]), sized
        return
    env: Any = ActuatedEnv(panel.task, "ideal")
    with contextlib.closing(OffscreenRenderer(env.model, *size, camera, pretty)) as renderer:

        def drawn(instant: int) -> np.ndarray:
            env.physics.show(episode.state[instant])
            return renderer.render(env.data)

        yield env.metadata["render_fps"], drawn


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
        panels: one or more episodes of the same task, side by side; a shorter one stands still at
            its end.
        out: the file to make; its suffix chooses the format (`.mp4`: H.264; `.gif`). Without a
            suffix, a folder of PNG frames.
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
            stack.enter_context(_scene(one, (width, height), camera, pretty)) for one in panels
        ]
        drawn = [
            _drawn(one, image, width, height, end)
            for one, (_, image) in zip(panels, scenes, strict=True)
        ]
        rate, last = scenes[0][0], max(len(panel.episode.reward) for panel in panels)
        stride = max(1, round(rate / _MAX_FPS))
        instants = [*range(0, last, stride), last]
        blanks = np.hstack([blank for blank, _ in drawn])
        add = stack.enter_context(_encoding(out, rate / stride))
        for count, instant in enumerate(instants, 1):
            frame = blanks.copy()
            for (_, draw), part in zip(drawn, np.hsplit(frame, len(drawn)), strict=True):
                draw(instant, part)
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
            f"film {out}: unknown format {out.suffix!r}: the suffix must be one of"
            f" {', '.join(_FORMATS[:-1])}, or none for a folder of PNG frames"
        )
    if out.suffix == "" and out.exists():
        raise FileExistsError(f"folder {out} exists already: choose another --out, or delete it")
    for name, size in (("width", width), ("height", height)):
        if size % 2:
            raise ValueError(f"{name} = {size}: must be even, as video encoders need it [px]")
    for name, size, least in (("width", width, _MIN_WIDTH), ("height", height, _MIN_HEIGHT)):
        if size < least:
            raise ValueError(
                f"{name} = {size}: must be >= {least} [px], for the title and the strip"
            )


class Clip(NamedTuple):
    """A film whose frame k shows the time k/rate of its episode, until the next."""

    video: bytes
    """H.264 in an MP4 file."""
    rate: float
    """Frames a second of the episode."""
    still: bytes
    """An image of it, a JPEG file."""


def clip(panel: Panel, width: int, height: int) -> Clip:
    """The scene of an episode in memory, even sizes [px].

    A `RenderingUnavailableError` has the remedy where no OpenGL context can be made.
    """
    from PIL import Image

    steps, duration = len(panel.episode.time), float(panel.episode.time[0])
    stride = max(1, round(1.0 / (duration * _MAX_FPS)), -(-steps // _MOST_FRAMES))
    instants = [*range(0, steps, stride), steps]
    rate, still = 1.0 / (stride * duration), io.BytesIO()
    with _scene(panel, (width, height)) as (_, draw), tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        with _encoding(path, rate, _SOUGHT) as add:
            for place, instant in enumerate(instants):
                image = draw(instant)
                if place == len(instants) // 3:
                    Image.fromarray(image).save(still, "jpeg", quality=85)
                add(image)
        return Clip(path.read_bytes(), rate, still.getvalue())


@contextlib.contextmanager
def _encoding(
    out: Path, fps: float, h264: Sequence[str] = _FINE
) -> Iterator[Callable[[np.ndarray], None]]:
    """A function that appends a frame, encoded while the next one is drawn, to a film that appears when all is well."""
    import imageio

    options: dict[str, Any] = {"duration": 1000 / fps, "loop": 0}  # ms
    if out.suffix == ".mp4":
        options = {
            "fps": fps,
            "codec": "libx264",
            "quality": None,
            "macro_block_size": 2,
            "ffmpeg_log_level": "error",
        }
        options["output_params"] = [*h264]
    with contextlib.ExitStack() as stack:
        if out.suffix == "":
            folder, counter = stack.enter_context(atomic_folder(out)), itertools.count()

            def write(frame: np.ndarray) -> None:
                imageio.imwrite(folder / f"frame_{next(counter):05d}.png", frame)

        else:
            temporary = stack.enter_context(atomic_write(out))
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


def _drawn(
    panel: Panel, image: Callable[[int], np.ndarray], width: int, height: int, end: float
) -> tuple[np.ndarray, Callable[[int, np.ndarray], None]]:
    """A panel without its scene, and what draws it after so many steps over a copy of that: (height, width, 3), uint8.

    Title and strip are drawn once, a window slides over the strip. `image` draws the scene, and
    `end` [s] is where the longest episode ends.
    """
    episode, top, bottom = panel.episode, _TITLE_HEIGHT, _TITLE_HEIGHT + height
    window = min(end, _WINDOW_STEPS * float(episode.time[0]))
    scale, axis, strip = draw_strip(panel.task, episode, panel.motor, width, window, end)
    last, fell, over = len(episode.reward), episode.terminated, episode.time[-1]
    words = f"ended at {over:.2f} s" if fell else f"time limit, {over:.2f} s"
    ending = draw_text(words, width, _TITLE_HEIGHT, _FELL if fell else _LASTED)

    def draw(instant: int, frame: np.ndarray) -> None:
        now = min(instant, last)
        view = frame[top:bottom]
        view[:] = image(now)
        if now == last:
            view[-_TITLE_HEIGHT:] = ending
            if fell:
                view[:-_TITLE_HEIGHT] = view[:-_TITLE_HEIGHT] // 2 + 90  # faded
        time = float(episode.time[now - 1]) if now else 0.0
        begin, size = round(scale * max(0.0, time - window)), round(scale * window)
        cursor = min(round(scale * time) - begin, size - 1)
        shown = strip[:, begin : begin + size + MARGIN]
        below = frame[bottom + HEADER_HEIGHT :, AXIS_WIDTH : AXIS_WIDTH + shown.shape[1]]
        below[PLOT_HEIGHT:] = shown[PLOT_HEIGHT:]
        below[:PLOT_HEIGHT, :cursor] = shown[
            :PLOT_HEIGHT, :cursor
        ]  # and nothing of what has not happened yet
        below[:PLOT_HEIGHT, cursor] = 120

    return (
        np.vstack(
            [draw_text(panel.title, width, top), np.zeros((height, width, 3), np.uint8), axis]
        ),
        draw,
    )
