"""Films of episodes: files with plots of signals below the scene, and clips of the scene.

Episodes of tasks are recorded first and rendered from their states afterwards, so that rendering
never changes a simulation. Third-party environments render themselves while they run.
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
from typing import Any, NamedTuple, SupportsFloat

import gymnasium
import numpy as np

from codrl_mj.boundary import Action, Argument, Info, Observation
from codrl_mj.envs.config import Env, EnvConfig
from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.evaluation.episodes import Episode, Policy, run_episodes
from codrl_mj.physics.offscreen import OffscreenRenderer
from codrl_mj.runs.files import atomic_folder, atomic_write
from codrl_mj.viz.films.strip import (
    AXIS_WIDTH,
    HEADER_HEIGHT,
    MARGIN,
    PLOT_HEIGHT,
    draw_strip,
    draw_text,
)
from codrl_mj.viz.scene import render_arguments

_FORMATS = (".mp4", ".gif", "")
_FILE_ENCODING = ("-preset", "veryfast", "-crf", "18")
"""Encoder options for files: half the time of ffmpeg's default, and a smaller file."""
_PAGE_ENCODING = ("-preset", "veryfast", "-crf", "26", "-g", "15", "-movflags", "+faststart")
"""Encoder options for pages: a key frame every half second, because a page seeks in its film."""
_TITLE_HEIGHT = 40  # px
_MIN_WIDTH, _MIN_HEIGHT = 160, 80  # px
_WINDOW_STEPS = 150  # environment steps visible in the plots
_MAX_FPS, _MAX_FRAMES = 30, 600
"""Maximum frame rate [1/s], and maximum number of frames of a clip."""
_TERMINATED_COLOR, _TIME_LIMIT_COLOR = "#B03A2E", "#1E8449"


class FrameRecorder(gymnasium.Wrapper[Observation, Action, Observation, Action]):
    """Wrapper that stores an image of every instant of an episode.

    The images are compressed: raw ones would fill a gigabyte.
    """

    def __init__(self, env: Env, pretty: bool = False) -> None:
        """Wrap an environment.

        Args:
            env: the environment, with `render_mode="rgb_array"`.
            pretty: render shadows and multisampling, which on a CPU take ten times as long as the
                rest.
        """
        if env.render_mode != "rgb_array":
            raise ValueError(f"render_mode = {env.render_mode!r}: must be 'rgb_array' for a film")
        super().__init__(env)
        if not pretty and hasattr(env.unwrapped, "model"):
            quality = env.unwrapped.model.vis.quality
            # MuJoCo reads these when a renderer is created, so they must be set before the first
            # image.
            quality.shadowsize = quality.offsamples = 0

    def reset(self, **options: Argument) -> tuple[Observation, Info]:
        """Start an episode and its recording."""
        result = self.env.reset(**options)
        self._packed: list[tuple[tuple[int, ...], bytes]] = []
        self._store_frame(self.env.render())
        return result

    def step(self, action: Action) -> tuple[Observation, SupportsFloat, bool, bool, Info]:
        """Advance by one environment step."""
        result = self.env.step(action)
        self._store_frame(self.env.render())
        return result

    # Gymnasium declares other types of images too, which `rgb_array` excludes.
    def _store_frame(self, image: Any) -> None:
        self._packed.append((image.shape, zlib.compress(image.tobytes(), 1)))

    def image(self, instant: int) -> np.ndarray:
        """Return the image after a number of steps: (height, width, 3), uint8."""
        shape, packed = self._packed[instant]
        return np.frombuffer(zlib.decompress(packed), np.uint8).reshape(shape)


@dataclasses.dataclass(frozen=True)
class Panel:
    """One episode to be shown, beside others."""

    task: str
    """Task name."""
    episode: Episode
    """The episode."""
    recorder: FrameRecorder | None = None
    """Recorded images of a third-party environment; None for a task."""
    title: str = ""
    """Text above the scene."""
    motor: int = 0
    """Index of the motor whose signals are plotted."""
    options: Info = dataclasses.field(default_factory=dict)
    """Options of the task that differ from their defaults, which may change its scene."""


def record(
    policy: Policy,
    env: EnvConfig,
    seed: int,
    width: int,
    height: int,
    camera: str = "fixed",
    pretty: bool = False,
) -> Panel:
    """Run an episode in an `EnvConfig`, and record what a film of it needs.

    Third-party environments store their images while they run, and the camera `fixed` selects their
    default camera. Tasks are rendered later from their states.
    """
    render_options = render_arguments(env, width, height, None if camera == "fixed" else camera)
    recorders: list[FrameRecorder] = []
    if render_options is None:
        options = env.source.non_default_options(env.options)
        episode = run_episodes(policy, env.build, 1, seed)[0]
        return Panel(env.task, episode, options=options)

    def make_recorder() -> FrameRecorder:
        recorders.append(FrameRecorder(env.build(**render_options), pretty))
        return recorders[-1]

    (episode,) = run_episodes(policy, make_recorder, 1, seed)
    return Panel(env.task, episode, recorders[0])


@contextlib.contextmanager
def _scene(
    panel: Panel, size: tuple[int, int], camera: str = "fixed", pretty: bool = False
) -> Iterator[tuple[float, Callable[[int], np.ndarray]]]:
    """Yield the frame rate of an episode, and a function that renders its scene after some steps.

    The function returns a new array: (height, width, 3), uint8. For a task an OpenGL context is
    open within the block.
    """
    episode, recorder = panel.episode, panel.recorder
    if recorder is not None:
        from PIL import Image

        def resized_image(instant: int) -> np.ndarray:
            image = Image.fromarray(recorder.image(instant))
            return np.array(image if image.size == size else image.resize(size))

        yield recorder.metadata.get("render_fps") or 1.0 / float(episode.time[0]), resized_image
        return
    env = ActuatedEnv(panel.task, "ideal", **panel.options)
    with contextlib.closing(OffscreenRenderer(env.model, *size, camera, pretty)) as renderer:

        def render_state(instant: int) -> np.ndarray:
            env.physics.show(episode.state[instant])
            return renderer.render(env.data)

        yield env.metadata["render_fps"], render_state


def film(
    panels: Sequence[Panel],
    out: Path,
    width: int = 480,
    height: int = 360,
    camera: str = "fixed",
    pretty: bool = False,
    on_frame: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a video of episodes side by side, at the task's frame rate, in simulation time.

    Args:
        panels: one or more episodes of the same task; a shorter one keeps its last frame.
        out: the file to write; its suffix selects the format (`.mp4`: H.264; `.gif`). Without a
            suffix, a folder of PNG frames.
        width: width of one panel [px], even, >= 160.
        height: height of one panel's scene [px], even, >= 80.
        camera: name of a camera of the model.
        pretty: shadows, reflections and multisampling.
        on_frame: called with (number of frames written, total number).

    Returns:
        `out`.

    Raises:
        FileExistsError: the folder for the frames exists.
        ValueError: no panel, unknown format, odd or too small a size, or unknown camera.
        RenderingUnavailableError: no OpenGL context can be created; the message names a remedy.
    """
    check_film(out, width, height)
    if not panels:
        raise ValueError("panels: must have at least one episode to show")
    end = max(float(panel.episode.time[-1]) for panel in panels)
    with contextlib.ExitStack() as stack:
        scenes = [
            stack.enter_context(_scene(panel, (width, height), camera, pretty)) for panel in panels
        ]
        painters = [
            _panel_painter(panel, render, width, height, end)
            for panel, (_, render) in zip(panels, scenes, strict=True)
        ]
        rate, last = scenes[0][0], max(len(panel.episode.reward) for panel in panels)
        stride = max(1, round(rate / _MAX_FPS))
        instants = [*range(0, last, stride), last]
        background_row = np.hstack([background for background, _ in painters])
        add = stack.enter_context(_encoding(out, rate / stride))
        for count, instant in enumerate(instants, 1):
            frame = background_row.copy()
            for (_, paint), part in zip(painters, np.hsplit(frame, len(painters)), strict=True):
                paint(instant, part)
            add(frame)
            if on_frame is not None:
                on_frame(count, len(instants))
    return out


def check_film(out: Path, width: int, height: int) -> None:
    """Raise an error for an invalid file or size of a film, before an episode is run.

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
    for name, size, minimum in (("width", width, _MIN_WIDTH), ("height", height, _MIN_HEIGHT)):
        if size < minimum:
            raise ValueError(
                f"{name} = {size}: must be >= {minimum} [px], for the title and the strip"
            )


class Clip(NamedTuple):
    """A film whose frame k shows the time k/rate of its episode, until the next frame."""

    video: bytes
    """H.264 video in an MP4 file."""
    rate: float
    """Frames per second of the episode."""
    still: bytes
    """One frame as a JPEG file."""


def clip(panel: Panel, width: int, height: int) -> Clip:
    """Return the scene of an episode as a film in memory; width and height [px] must be even.

    Raises:
        RenderingUnavailableError: no OpenGL context can be created; the message names a remedy.
    """
    from PIL import Image

    steps, duration = len(panel.episode.time), float(panel.episode.time[0])
    stride = max(1, round(1.0 / (duration * _MAX_FPS)), -(-steps // _MAX_FRAMES))
    instants = [*range(0, steps, stride), steps]
    rate, still = 1.0 / (stride * duration), io.BytesIO()
    with _scene(panel, (width, height)) as (_, draw), tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        with _encoding(path, rate, _PAGE_ENCODING) as add:
            for index, instant in enumerate(instants):
                image = draw(instant)
                # The still picture is taken after a third of the episode, where more happens than
                # at its start.
                if index == len(instants) // 3:
                    Image.fromarray(image).save(still, "jpeg", quality=85)
                add(image)
        return Clip(path.read_bytes(), rate, still.getvalue())


@contextlib.contextmanager
def _encoding(
    out: Path, fps: float, h264: Sequence[str] = _FILE_ENCODING
) -> Iterator[Callable[[np.ndarray], None]]:
    """Yield a function that appends a frame to a film, encoded while the next frame is rendered.

    The file appears under its name only if the block ends without an error.
    """
    import imageio

    options: dict[str, Argument] = {"duration": 1000 / fps, "loop": 0}  # ms
    if out.suffix == ".mp4":
        options = {
            "fps": fps,
            "codec": "libx264",
            # imageio would choose its own quality and round sizes up to multiples of 16 px.
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
        executor = stack.enter_context(ThreadPoolExecutor(1))
        pending_writes: list[Future[None]] = []

        def add(frame: np.ndarray) -> None:
            # Wait for the previous frame: at most one is queued, and an error of the encoder is
            # raised here.
            if pending_writes:
                pending_writes.pop().result()
            pending_writes.append(executor.submit(write, frame))

        yield add
        for pending in pending_writes:
            pending.result()


def _panel_painter(
    panel: Panel, render: Callable[[int], np.ndarray], width: int, height: int, end: float
) -> tuple[np.ndarray, Callable[[int, np.ndarray], None]]:
    """Return the background of a panel, and a function that paints an instant over a copy of it.

    Both arrays are (height, width, 3), uint8. Title and plots are drawn only once; a window slides
    over the plots.

    Args:
        panel: the episode.
        render: function that renders the scene.
        width: width of the panel [px].
        height: height of the scene [px].
        end: end of the longest episode [s].
    """
    episode, top, bottom = panel.episode, _TITLE_HEIGHT, _TITLE_HEIGHT + height
    window = min(end, _WINDOW_STEPS * float(episode.time[0]))
    scale, axis, strip = draw_strip(panel.task, episode, panel.motor, width, window, end)
    last, terminated, end_time = len(episode.reward), episode.terminated, episode.time[-1]
    ending_text = f"ended at {end_time:.2f} s" if terminated else f"time limit, {end_time:.2f} s"
    ending = draw_text(
        ending_text, width, _TITLE_HEIGHT, _TERMINATED_COLOR if terminated else _TIME_LIMIT_COLOR
    )

    def paint(instant: int, frame: np.ndarray) -> None:
        now = min(instant, last)
        view = frame[top:bottom]
        view[:] = render(now)
        if now == last:
            view[-_TITLE_HEIGHT:] = ending
            if terminated:
                # Fade the scene, to show that the episode has terminated.
                view[:-_TITLE_HEIGHT] = view[:-_TITLE_HEIGHT] // 2 + 90
        time = float(episode.time[now - 1]) if now else 0.0
        begin, size = round(scale * max(0.0, time - window)), round(scale * window)
        cursor = min(round(scale * time) - begin, size - 1)
        visible = strip[:, begin : begin + size + MARGIN]
        plot_area = frame[bottom + HEADER_HEIGHT :, AXIS_WIDTH : AXIS_WIDTH + visible.shape[1]]
        plot_area[PLOT_HEIGHT:] = visible[PLOT_HEIGHT:]
        # Only the past is drawn, up to the cursor.
        plot_area[:PLOT_HEIGHT, :cursor] = visible[:PLOT_HEIGHT, :cursor]
        plot_area[:PLOT_HEIGHT, cursor] = 120

    return (
        np.vstack(
            [draw_text(panel.title, width, top), np.zeros((height, width, 3), np.uint8), axis]
        ),
        paint,
    )
