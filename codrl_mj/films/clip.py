"""The scene of an episode alone, as a small film in memory, whose instants are the episode's."""

import io
import tempfile
from pathlib import Path
from typing import NamedTuple

from codrl_mj.evaluation.episodes import Episode
from codrl_mj.films.encode import encoding
from codrl_mj.films.record import Frames
from codrl_mj.films.scene import Scene

_MOST_FPS, _MOST_FRAMES = 30, 600
_SOUGHT = ("-preset", "veryfast", "-crf", "26", "-g", "15", "-movflags", "+faststart")
"""A key frame every half second: it is sought in; up to date players need no more than this."""


class Clip(NamedTuple):
    """A film whose frame k shows the time k/rate of its episode, until the next."""

    video: bytes
    """H.264 in an MP4 file."""
    rate: float
    """Frames a second of the episode."""
    still: bytes
    """An image of it, a JPEG file."""


def clip(task: str, episode: Episode, taken: Frames | None, width: int, height: int) -> Clip:
    """Film an episode.

    Args:
        task: the task's name.
        episode: the episode.
        taken: as `record` returned it beside the episode.
        width: of the film [px], even.
        height: of the film [px], even.

    Raises:
        RenderingUnavailableError: no OpenGL context can be made here; the message has the remedy.
    """
    from PIL import Image

    steps, duration = len(episode.time), float(episode.time[0])
    stride = max(1, round(1.0 / (duration * _MOST_FPS)), -(-steps // _MOST_FRAMES))
    instants = [*range(0, steps, stride), steps]
    rate, still = 1.0 / (stride * duration), io.BytesIO()
    scene = Scene(task, episode, taken, width, height)
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "film.mp4"
            with encoding(path, rate, _SOUGHT) as add:
                for place, instant in enumerate(instants):
                    image = scene.image(instant)
                    if place == len(instants) // 3:
                        Image.fromarray(image).save(still, "jpeg", quality=85)
                    add(image)
            return Clip(path.read_bytes(), rate, still.getvalue())
    finally:
        scene.close()
