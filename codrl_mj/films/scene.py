"""What is seen of an episode at each of its instants."""

import numpy as np

from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.evaluation.episodes import Episode
from codrl_mj.films.record import Frames
from codrl_mj.physics.offscreen import OffscreenRenderer


class Scene:
    """A task's, drawn from the episode's states; of an environment of others what was taken, brought to size."""

    def __init__(
        self,
        task: str,
        episode: Episode,
        taken: Frames | None,
        width: int,
        height: int,
        camera: str = "fixed",
        pretty: bool = False,
    ) -> None:
        """Make the OpenGL context, where one is needed; `taken` is what `record` returned beside the episode.

        Raises:
            ValueError: unknown camera, or a size [px] out of bounds.
            RenderingUnavailableError: no OpenGL context can be made here; the message has the remedy.
        """
        self._states, self._taken, self._size = episode.state, taken, (width, height)
        self._renderer = None
        if taken is not None:
            self.rate = taken.rate or 1.0 / float(episode.time[0])
            return
        self._env = ActuatedEnv(task, "ideal")
        self.rate = self._env.metadata["render_fps"]
        self._renderer = OffscreenRenderer(self._env.model, width, height, camera, pretty)

    def image(self, instant: int) -> np.ndarray:
        """The scene after `instant` steps, shape (height, width, 3), uint8; a new array."""
        if self._taken is None:
            self._env.physics.show(self._states[instant])  # type: ignore[attr-defined]
            return self._renderer.render(self._env.data)  # type: ignore[union-attr]
        from PIL import Image

        image = Image.fromarray(self._taken[instant])
        return np.array(image if image.size == self._size else image.resize(self._size))

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._renderer is not None:
            self._renderer.close()
