"""The scene of an episode alone, as a small film in memory, whose instants are the episode's."""

import io
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.evaluation.episodes import Episode
from codrl_mj.physics.offscreen import OffscreenRenderer

_MOST_FPS, _MOST_FRAMES = 30, 600


class SceneFilm(NamedTuple):
    """A film whose frame k shows the time k/rate of its episode, until the next."""

    video: bytes
    """H.264 in an MP4 file."""
    rate: float
    """Frames a second of the episode."""
    still: bytes
    """An image of it, a JPEG file."""


def scene_film(
    task: str, episode: Episode, width: int, height: int, frames: Sequence[np.ndarray] | None = None
) -> SceneFilm:
    """Film an episode.

    Args:
        task: the task's name.
        episode: the episode.
        width: of the film [px], even.
        height: of the film [px], even.
        frames: in environments of others, the scene before the first step and after each, as `Filmed` keeps them.

    Raises:
        RenderingUnavailableError: no OpenGL context can be made here; the message has the remedy.
    """
    import imageio
    from PIL import Image

    steps, duration = len(episode.time), float(episode.time[0])
    stride = max(1, round(1.0 / (duration * _MOST_FPS)), -(-steps // _MOST_FRAMES))
    instants = [*range(0, steps, stride), steps]
    images = _drawn(task, episode, instants, width, height) if frames is None else [frames[k] for k in instants]
    options: Any = {"codec": "libx264", "quality": None, "macro_block_size": 2, "ffmpeg_log_level": "error"}
    # a key frame every half second: it is sought in; up to date players need no more than this
    options["output_params"] = ["-preset", "veryfast", "-crf", "26", "-g", "15", "-movflags", "+faststart"]
    rate = 1.0 / (stride * duration)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        with imageio.get_writer(path, fps=rate, **options) as writer:
            for one in images:
                writer.append_data(one)
        video = path.read_bytes()
    buffer = io.BytesIO()
    Image.fromarray(images[len(images) // 3]).save(buffer, "jpeg", quality=85)
    return SceneFilm(video, rate, buffer.getvalue())


def _drawn(task: str, episode: Episode, instants: Sequence[int], width: int, height: int) -> list[np.ndarray]:
    """A task's scene at some instants, from the episode's states."""
    env = ActuatedEnv(task, "ideal")
    renderer = OffscreenRenderer(env.model, width, height)
    try:
        images = []
        for instant in instants:
            env.physics.show(episode.state[instant])  # type: ignore[attr-defined]
            images.append(renderer.render(env.data).copy())
        return images
    finally:
        renderer.close()
