"""Episodes that can be filmed: what an environment of somebody else's draws is taken while it runs."""

import zlib
from typing import Any

import gymnasium
import numpy as np

from codrl_mj.evaluation.episodes import Episode, run_episodes


class Frames:
    """Images of an episode's instants, packed: they would fill a gigabyte."""

    def __init__(self, rate: float) -> None:
        """Begin with none.

        Args:
            rate: images a second; 0: as many as the episode has steps.
        """
        self.rate = rate
        self._packed: list[tuple[tuple[int, ...], bytes]] = []

    def add(self, image: Any) -> None:
        """Append one, (height, width, 3), uint8."""
        self._packed.append((image.shape, zlib.compress(image.tobytes(), 1)))

    def __len__(self) -> int:
        """How many there are."""
        return len(self._packed)

    def __getitem__(self, index: int) -> np.ndarray:
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
        self._taken()

    def _taken(self) -> None:
        self.frames = Frames(self.metadata.get("render_fps", 0.0))

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode, and its film."""
        result = self.env.reset(**options)
        self._taken()
        self.frames.add(self.env.render())
        return result

    def step(self, action: Any) -> Any:
        """Advance by one environment step."""
        result = self.env.step(action)
        self.frames.add(self.env.render())
        return result


def record(
    policy: Any, env: Any, seed: int, width: int, height: int, camera: str = "fixed", pretty: bool = False
) -> tuple[Episode, Frames | None]:
    """Run an episode to be filmed.

    Args:
        policy: chooses the actions.
        env: an `EnvConfig`.
        seed: of the episode.
        width: of the images [px].
        height: of the images [px].
        camera: of the model; `fixed` is, in environments of others, their own.
        pretty: see `Filmed`.

    Returns:
        The episode; and in environments of others its images: our tasks are drawn from the episode's states.

    Raises:
        ValueError: the environment draws no images, or not by this camera.
    """
    view, made = env.world.view(env, width, height, None if camera == "fixed" else camera), []
    if view is None:
        return run_episodes(policy, env.make, 1, seed)[0], None

    def make() -> Any:
        made.append(Filmed(env.make(**view), pretty))
        return made[-1]

    (episode,) = run_episodes(policy, make, 1, seed)
    return episode, made[0].frames
