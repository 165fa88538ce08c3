"""Episodes that can be filmed, and what is seen of them at each instant.

What an environment of somebody else's draws is taken while it runs; our tasks are drawn afterwards.
"""

import contextlib
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np

from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.evaluation.episodes import Episode, run_episodes
from codrl_mj.physics.offscreen import OffscreenRenderer


class Frames:
    """Images of an episode's instants, packed: they would fill a gigabyte."""

    def __init__(self, rate: float) -> None:
        """Begin with none; images a second, 0: as many as the episode has steps."""
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
        """Film an environment; pretty are shadows and multisampling, which on a CPU cost ten times the rest."""
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
    """Run an episode, in an `EnvConfig`, to be filmed in images of a size [px].

    In environments of others the camera `fixed` is their own, and their images are found beside the episode; our tasks
    are drawn from its states.
    """
    view, made = env.world.view(env, width, height, None if camera == "fixed" else camera), []
    if view is None:
        return run_episodes(policy, env.make, 1, seed)[0], None

    def make() -> Any:
        made.append(Filmed(env.make(**view), pretty))
        return made[-1]

    (episode,) = run_episodes(policy, make, 1, seed)
    return episode, made[0].frames


@contextlib.contextmanager
def scene(
    task: str,
    episode: Episode,
    taken: Frames | None,
    size: tuple[int, int],
    camera: str = "fixed",
    pretty: bool = False,
) -> Iterator[tuple[float, Callable[[int], np.ndarray]]]:
    """Frames a second of an episode, and what draws its scene after so many steps: (height, width, 3), uint8, new.

    `taken` is what `record` returned beside the episode; of a task it is None, and an OpenGL context is held meanwhile.

    Raises:
        ValueError: unknown camera, or a size [px] out of bounds.
        RenderingUnavailableError: no OpenGL context can be made here; the message has the remedy.
    """
    if taken is not None:
        from PIL import Image

        def sized(instant: int) -> np.ndarray:
            image = Image.fromarray(taken[instant])
            return np.array(image if image.size == size else image.resize(size))

        yield taken.rate or 1.0 / float(episode.time[0]), sized
        return
    env: Any = ActuatedEnv(task, "ideal")
    with contextlib.closing(OffscreenRenderer(env.model, *size, camera, pretty)) as renderer:

        def drawn(instant: int) -> np.ndarray:
            env.physics.show(episode.state[instant])
            return renderer.render(env.data)

        yield env.metadata["render_fps"], drawn
