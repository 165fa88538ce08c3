"""Off-screen rendering of MuJoCo models, and a window that shows the images."""

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
    """No OpenGL context can be created on this machine or in this process."""


_open_renderers: "weakref.WeakSet[OffscreenRenderer]" = weakref.WeakSet()
# After this error the process cannot use OpenGL: another attempt would end the process.
_fatal_errors: list[mujoco.FatalError] = []


@functools.cache
def _register_cleanup() -> None:
    """Free open contexts at exit, before the OpenGL library shuts down, and abandon them in forks.

    Call this after creating the first context: that registers the library's own shutdown, and
    functions that are registered later run earlier.
    """

    @atexit.register
    def close_all() -> None:
        for renderer in list(_open_renderers):
            renderer.close()

    # Windows has no fork.
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_abandon_after_fork)


def _abandon_after_fork() -> None:
    """Abandon contexts and display in a forked process, where using them could hang.

    The threads of a software renderer exist only in the parent process. A display of another EGL
    platform starts new threads; if there is no other platform, the inherited display is used.
    """
    # MuJoCo's module, which exists only with the EGL backend.
    egl: Any = sys.modules.get("mujoco.egl")
    if egl is None:
        return
    atexit.unregister(egl.EGL.eglTerminate)
    for renderer in list(_open_renderers):
        _abandon(renderer._renderer)
        renderer._renderer = None
    try:
        egl.EGL_DISPLAY = (
            egl.EGL.eglGetPlatformDisplayEXT(_EGL_PLATFORM_SURFACELESS, None, None)
            or egl.EGL_DISPLAY
        )
    # PyOpenGL's errors cannot be named here, because only the EGL backend imports it.
    except Exception:
        return


_EGL_PLATFORM_SURFACELESS = 0x31DD


class OffscreenRenderer:
    """Renderer of a model into RGB arrays.

    By default shadows, reflections and multisampling are off: on a CPU renderer they cost ten times
    as much as everything else. The sky would take most of the remaining time, so it is drawn only
    once for each pose of the camera.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        width: int = 480,
        height: int = 480,
        camera: str = "fixed",
        pretty: bool = False,
    ) -> None:
        """Create the OpenGL context.

        Args:
            model: model to draw.
            width: image width [px], at most the model's `offwidth`.
            height: image height [px], at most the model's `offheight`.
            camera: name of a camera of the model.
            pretty: True to render shadows, reflections and multisampling, for still images.

        Raises:
            ValueError: unknown camera, or a size out of bounds.
            RenderingUnavailableError: no OpenGL context can be created.
        """
        check_view(model, width, height, camera)
        self._camera = camera
        self._pretty = pretty
        model.vis.quality.offsamples = 8 if pretty else 0
        model.vis.quality.shadowsize = 4096 if pretty else 0
        self._model, self._size = model, (int(width), int(height))
        self._sky: tuple[bytes, np.ndarray] = (b"", np.empty(0))
        self._reuses_sky = not pretty and _only_sky_is_black(model)
        self._renderer: mujoco.Renderer | None = self._make()
        _open_renderers.add(self)
        _register_cleanup()

    def _make(self) -> mujoco.Renderer:
        """Create the renderer; its frame buffer is no larger than the image, to save clearing."""
        egl = sys.modules.get("mujoco.egl")
        limits, (width, height) = self._model.vis.global_, self._size
        largest = limits.offwidth, limits.offheight
        # Each backend raises its own errors, most of which are not exported.
        try:
            # MuJoCo initializes the display once, but SDL (pygame) terminates it with its window.
            if egl is not None and egl.EGL_DISPLAY:
                egl.EGL.eglInitialize(egl.EGL_DISPLAY, None, None)
            limits.offwidth, limits.offheight = self._size
            if _fatal_errors:
                raise _fatal_errors[0]
            return mujoco.Renderer(self._model, height=height, width=width)
        except Exception as error:
            if (
                not _fatal_errors
                and isinstance(error, mujoco.FatalError)
                and "platform library" in str(error)
            ):
                _fatal_errors.append(error)
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
        """Draw the present positions of the data, whose kinematics must be up to date.

        Returns:
            Image, shape (height, width, 3), uint8.

        Raises:
            RenderingUnavailableError: another program ended the OpenGL context, and no new one can
                be created.
        """
        if self._renderer is None or not _make_current(self._renderer):
            self.close()
            self._renderer = self._make()
        self._renderer.update_scene(data, self._camera)
        flags = self._renderer.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._pretty
        flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = self._pretty
        if not self._reuses_sky:
            image: np.ndarray = self._renderer.render()
            return image
        scene = self._renderer.scene
        view = bytes(
            np.concatenate([np.append(camera.forward, camera.up) for camera in scene.camera])
        )
        # For a new camera pose, the sky is first rendered without the bodies. It then replaces the
        # black pixels of all images in this pose.
        if view != self._sky[0]:
            scene.ngeom, count = 0, scene.ngeom
            self._sky = view, self._renderer.render()
            scene.ngeom = count
        flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = False
        image = self._renderer.render()
        flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = True
        np.copyto(image, self._sky[1], where=image == 0)
        return image

    def close(self) -> None:
        """Free the OpenGL context; harmless if it is closed already."""
        renderer, self._renderer = getattr(self, "_renderer", None), None
        if renderer is None:
            return
        # Buffers are freed in their own context, because in another context the same names belong
        # to other buffers. If the display has ended, the context can still become current, but
        # freeing it raises.
        try:
            current = _make_current(renderer)
            if current:
                renderer.close()
        except Exception:
            current = False
        if not current:
            _abandon(renderer)

    def __del__(self) -> None:
        """Free the OpenGL context."""
        self.close()


def _only_sky_is_black(model: mujoco.MjModel) -> bool:
    """Return True if a picture without sky is black (0) only where the sky would be.

    Everything else must be lit by the headlight's ambient part, be opaque, and have no texture.
    """
    light = model.vis.headlight
    colors = np.vstack([model.geom_rgba, model.site_rgba, model.mat_rgba])
    return bool(
        light.active
        and (model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).all()
        and (colors[:, 3] == 1).all()
        and colors[:, :3].min(initial=1) * light.ambient.min() > 2 / 255
    )


def _make_current(renderer: mujoco.Renderer) -> bool:
    """Make a renderer's context current in this thread; return False if it is gone."""
    try:
        # Each backend raises its own errors.
        if renderer._gl_context is not None:
            renderer._gl_context.make_current()
    except Exception:
        return False
    return True


def _abandon(renderer: mujoco.Renderer | None) -> None:
    """Abandon a renderer whose context no longer exists or belongs to another process."""
    egl = sys.modules.get("mujoco.egl")
    if egl is not None and renderer is not None:
        # Without a current context, freeing the renderer's buffers cannot free those of another
        # context.
        egl.EGL.eglReleaseThread()
        renderer._gl_context._context = None
        renderer.close()


def check_view(model: mujoco.MjModel, width: int, height: int, camera: str) -> None:
    """Raise if a model cannot be drawn with these arguments of `OffscreenRenderer`.

    No OpenGL context is created.
    """
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


class DisplayWindow:
    """On-screen window that shows images one after another, no faster than a frame rate."""

    def __init__(self, width: int, height: int) -> None:
        """Open a window for images of this size [px]."""
        try:
            import pygame
        except ImportError:
            raise DependencyNotInstalled(
                "render_mode = 'human' needs pygame: pip install pygame-ce"
            ) from None
        self._pygame = pygame
        pygame.display.init()
        self._screen = pygame.display.set_mode((width, height))
        self._clock = pygame.time.Clock()

    def show(self, image: np.ndarray, rate: float) -> None:
        """Show an image (height, width, 3), uint8, at most at a rate [1/s]."""
        self._screen.blit(self._pygame.surfarray.make_surface(image.swapaxes(0, 1)), (0, 0))
        self._pygame.event.pump()
        self._clock.tick(rate)
        self._pygame.display.flip()

    def close(self) -> None:
        """Close the window."""
        self._pygame.display.quit()
