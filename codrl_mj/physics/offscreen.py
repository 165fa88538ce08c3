"""Drawing a MuJoCo model: off-screen, with errors that say what to do; and what was drawn in a window."""

import atexit
import functools
import numbers
import os
import sys
import weakref
from typing import Any

import mujoco
import numpy as np
from gymnasium.error import DependencyNotInstalled

from codrl_mj.fields import did_you_mean


class RenderingUnavailableError(RuntimeError):
    """No OpenGL context can be made on this machine, or in this process."""


_open: "weakref.WeakSet[OffscreenRenderer]" = weakref.WeakSet()
_fatal: list[
    mujoco.FatalError
] = []  # why there is no OpenGL in this process: another attempt would end it


@functools.cache
def _watch_process() -> None:
    """At exit free the contexts that nobody closed, while the OpenGL library is still there: later it complains.

    To be called after the first context is made: the library registers its own shutdown then, and
    the last one registered runs first. In a process forked off, contexts are made anew.
    """

    @atexit.register
    def close_all() -> None:
        for renderer in list(_open):
            renderer.close()

    if hasattr(os, "register_at_fork"):  # not on Windows
        os.register_at_fork(after_in_child=_leave_to_parent)


def _leave_to_parent() -> None:
    """Let go of contexts and display after a fork: a software renderer's threads stayed behind, waiting for them hangs.

    A display on another platform has threads of its own. Where there is none, the inherited one has
    to do.
    """
    egl: Any = sys.modules.get("mujoco.egl")
    if egl is None:
        return
    atexit.unregister(egl.EGL.eglTerminate)
    for renderer in list(_open):
        _abandon(renderer._renderer)
        renderer._renderer = None
    try:
        egl.EGL_DISPLAY = (
            egl.EGL.eglGetPlatformDisplayEXT(_EGL_PLATFORM_SURFACELESS, None, None)
            or egl.EGL_DISPLAY
        )
    except Exception:  # of PyOpenGL, which only the EGL backend needs
        return


_EGL_PLATFORM_SURFACELESS = 0x31DD


class OffscreenRenderer:
    """Draws a model into RGB arrays.

    By default shadows, reflections and multisampling are off: on a CPU renderer they cost ten times
    the rest. What is left goes for the larger part into the sky, which is drawn once for each pose
    of the camera.
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
        self._model, self._size = model, (int(width), int(height))
        self._sky: tuple[bytes, np.ndarray] = (b"", np.empty(0))
        self._sky_apart = not pretty and _only_sky_is_black(model)
        self._renderer: mujoco.Renderer | None = self._make()
        _open.add(self)
        _watch_process()

    def _make(self) -> mujoco.Renderer:
        """With a frame buffer no larger than the image: all of it is cleared for each."""
        egl: Any = sys.modules.get("mujoco.egl")
        limits, (width, height) = self._model.vis.global_, self._size
        largest = limits.offwidth, limits.offheight
        try:
            if (
                egl is not None and egl.EGL_DISPLAY
            ):  # MuJoCo makes it once, but SDL (pygame) ends it with its window
                egl.EGL.eglInitialize(egl.EGL_DISPLAY, None, None)
            limits.offwidth, limits.offheight = self._size
            if _fatal:
                raise _fatal[0]
            return mujoco.Renderer(self._model, height=height, width=width)
        except Exception as error:  # each backend raises its own kind, most of them not exported
            if (
                not _fatal
                and isinstance(error, mujoco.FatalError)
                and "platform library" in str(error)
            ):
                _fatal.append(error)
            backend = os.environ.get("MUJOCO_GL", "not set")
            raise RenderingUnavailableError(
                f"cannot make an OpenGL context (MUJOCO_GL is {backend}): {type(error).__name__}:"
                f" {error}. Without a display, install a software renderer (Debian, Ubuntu: apt-get"
                " install libegl1 libgl1-mesa-dri) and set MUJOCO_GL=egl before mujoco is first"
                " imported: in the shell, or by importing codrl_mj before mujoco"
            ) from error
        finally:
            limits.offwidth, limits.offheight = largest

    def render(self, data: mujoco.MjData) -> np.ndarray:
        """Draw the data's present positions (their kinematics must be up to date).

        Returns:
            Image, shape (height, width, 3), uint8.

        Raises:
            RenderingUnavailableError: somebody ended the OpenGL context, and no other can be made.
        """
        if self._renderer is None or not _make_current(self._renderer):
            self.close()
            self._renderer = self._make()
        self._renderer.update_scene(data, self._camera)
        flags = self._renderer.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._pretty
        flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = self._pretty
        if not self._sky_apart:
            return self._renderer.render()
        scene = self._renderer.scene
        view = bytes(
            np.concatenate([np.append(camera.forward, camera.up) for camera in scene.camera])
        )
        if view != self._sky[0]:  # what the camera sees where there is nothing
            scene.ngeom, count = 0, scene.ngeom
            self._sky = view, self._renderer.render()
            scene.ngeom = count
        flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = False
        image = self._renderer.render()
        flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = True
        np.copyto(image, self._sky[1], where=image == 0)
        return image

    def close(self) -> None:
        """Free the OpenGL context; harmless when repeated, or when somebody ended the context."""
        renderer, self._renderer = getattr(self, "_renderer", None), None
        if renderer is None:
            return
        try:  # in its own context: in another's, the same names are that one's buffers
            current = _make_current(renderer)
            if current:
                renderer.close()
        except Exception:  # it could still be made current, but not be freed: its display has ended
            current = False
        if not current:
            _abandon(renderer)

    def __del__(self) -> None:
        """Free the OpenGL context."""
        self.close()


def _only_sky_is_black(model: mujoco.MjModel) -> bool:
    """Whether of a picture without sky only the sky's pixels have a colour of 0.

    All else is lit by the headlight's ambient part, opaque, and has no picture on it.
    """
    light = model.vis.headlight
    colours = np.vstack([model.geom_rgba, model.site_rgba, model.mat_rgba])
    return bool(
        light.active
        and (model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).all()
        and (colours[:, 3] == 1).all()
        and colours[:, :3].min(initial=1) * light.ambient.min() > 2 / 255
    )


def _make_current(renderer: mujoco.Renderer) -> bool:
    """Make a renderer's context the thread's; False if it is no more."""
    try:
        if renderer._gl_context is not None:
            renderer._gl_context.make_current()
    except Exception:  # each backend raises its own kind
        return False
    return True


def _abandon(renderer: mujoco.Renderer | None) -> None:
    """Let go of a renderer whose context is no more, or another process's."""
    egl: Any = sys.modules.get("mujoco.egl")
    if egl is not None and renderer is not None:
        egl.EGL.eglReleaseThread()  # without any context, freeing its buffers frees nobody else's
        renderer._gl_context._context = None
        renderer.close()


def check_view(model: mujoco.MjModel, width: int, height: int, camera: str) -> None:
    """Check that a model can be drawn so, without making an OpenGL context; the arguments are `OffscreenRenderer`'s."""
    for name, value, largest in (
        ("width", width, model.vis.global_.offwidth),
        ("height", height, model.vis.global_.offheight),
    ):
        if (
            isinstance(value, bool)
            or not isinstance(value, numbers.Integral)
            or not 1 <= value <= largest
        ):
            raise ValueError(f"{name} = {value!r}: must be an integer from 1 to {largest} [px]")
    names = [model.camera(index).name for index in range(model.ncam)]
    if camera not in names:
        hint = did_you_mean(camera, names)
        raise ValueError(
            f"camera = {camera!r}: {hint}The model's cameras are {', '.join(names) or 'none'}"
        )


class Window:
    """Shows images one after another, no faster than a frame rate."""

    def __init__(self, width: int, height: int) -> None:
        """Open it, for images of a size [px]."""
        try:
            import pygame
        except ImportError:
            raise DependencyNotInstalled(
                "render_mode = 'human' needs pygame: pip install pygame-ce"
            ) from None
        self._pygame: Any = pygame
        pygame.display.init()
        self._screen = pygame.display.set_mode((width, height))
        self._clock = pygame.time.Clock()

    def show(self, image: np.ndarray, rate: float) -> None:
        """Show an image (height, width, 3), uint8, at most at a rate [1/s]: waits as long as it must."""
        self._screen.blit(self._pygame.surfarray.make_surface(image.swapaxes(0, 1)), (0, 0))
        self._pygame.event.pump()
        self._clock.tick(rate)
        self._pygame.display.flip()

    def close(self) -> None:
        """Close it."""
        self._pygame.display.quit()
