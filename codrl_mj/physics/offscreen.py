"""Off-screen rendering of a MuJoCo model, with errors that say what to do."""

import atexit
import difflib
import functools
import numbers
import os
import weakref

import mujoco
import numpy as np


class RenderingUnavailableError(RuntimeError):
    """No OpenGL context can be made on this machine, or in this process."""


_open: "weakref.WeakSet[OffscreenRenderer]" = weakref.WeakSet()


@functools.cache
def _close_all_at_exit() -> None:
    """At exit free the contexts that nobody closed, while the OpenGL library is still there: later it complains.

    To be called after the first context is made: the library registers its own shutdown then, and the last one
    registered runs first.
    """

    @atexit.register
    def close_all() -> None:
        for renderer in list(_open):
            renderer.close()


class OffscreenRenderer:
    """Draws a model into RGB arrays.

    By default shadows, reflections and multisampling are off: on a CPU renderer they cost ten times the rest.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        width: int = 480,
        height: int = 480,
        camera: str = "fixed",
        pretty: bool = False,
    ) -> None:
        """Make the OpenGL context.

        Args:
            model: the model to draw.
            width: image width [px], at most the model's `offwidth`.
            height: image height [px], at most the model's `offheight`.
            camera: name of a camera of the model.
            pretty: shadows, reflections and multisampling, for stills.

        Raises:
            ValueError: unknown camera, or a size out of bounds.
            RenderingUnavailableError: no OpenGL context can be made.
        """
        check_view(model, width, height, camera)
        self._camera = camera
        self._pretty = pretty
        model.vis.quality.offsamples = 8 if pretty else 0
        model.vis.quality.shadowsize = 4096 if pretty else 0
        try:
            self._renderer = mujoco.Renderer(model, height=int(height), width=int(width))
        except Exception as error:  # each backend raises its own kind, most of them not exported
            raise RenderingUnavailableError(_no_context(error)) from error
        _open.add(self)
        _close_all_at_exit()

    def render(self, data: mujoco.MjData) -> np.ndarray:
        """Draw the data's present positions (their kinematics must be up to date).

        Returns:
            Image, shape (height, width, 3), uint8.
        """
        self._renderer.update_scene(data, self._camera)
        flags = self._renderer.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._pretty
        flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = self._pretty
        return self._renderer.render()

    def close(self) -> None:
        """Free the OpenGL context; harmless when repeated."""
        renderer, self._renderer = getattr(self, "_renderer", None), None  # type: ignore[assignment]
        if renderer is not None:
            renderer.close()

    def __del__(self) -> None:
        """Free the OpenGL context."""
        self.close()


def check_view(model: mujoco.MjModel, width: int, height: int, camera: str) -> None:
    """Check that a model can be drawn so, without making an OpenGL context; the arguments are `OffscreenRenderer`'s.

    Raises:
        ValueError: unknown camera, or a size out of bounds.
    """
    for name, value, largest in (
        ("width", width, model.vis.global_.offwidth),
        ("height", height, model.vis.global_.offheight),
    ):
        if isinstance(value, bool) or not isinstance(value, numbers.Integral) or not 1 <= value <= largest:
            raise ValueError(f"{name} = {value!r}: must be an integer from 1 to {largest} [px]")
    names = [model.camera(index).name for index in range(model.ncam)]
    if camera not in names:
        near = difflib.get_close_matches(str(camera), names, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ValueError(f"camera = {camera!r}: {hint}The model's cameras are {', '.join(names) or 'none'}")


def _no_context(error: Exception) -> str:
    backend = os.environ.get("MUJOCO_GL", "not set")
    return (
        f"cannot make an OpenGL context (MUJOCO_GL is {backend}): {type(error).__name__}: {error}. Without a display, "
        "install a software renderer (Debian, Ubuntu: apt-get install libegl1 libgl1-mesa-dri) and set MUJOCO_GL=egl "
        "before mujoco is first imported: in the shell, or by importing codrl_mj before mujoco"
    )
