"""OpenGL contexts that are unavailable, terminated, freed or inherited; each in its own process."""

import os
import subprocess
import sys

import pytest

WITHOUT = """
import mujoco
import gymnasium, codrl_mj
from codrl_mj.physics.offscreen import RenderingUnavailableError
view = {"render_mode": "rgb_array", "width": 64, "height": 48}
env = gymnasium.make("codrl_mj/CartPole-v0", actuator="ideal", **view)
env.reset(seed=0)
for _ in range(2):
    try:
        env.render()
    except RenderingUnavailableError as error:
        print(error)
print(env.step(1)[1])
"""
PROGRAM = """
import multiprocessing
import gymnasium, numpy as np, codrl_mj

def made(size):
    view = {"render_mode": "rgb_array", "width": size, "height": 48}
    env = gymnasium.make("codrl_mj/CartPole-v0", actuator="ideal", **view)
    env.reset(seed=0)
    return env, env.render()

def end_display():  # as SDL does when pygame quits, where it draws through EGL
    from mujoco import egl
    assert egl.EGL.eglTerminate(egl.EGL_DISPLAY)

def same(env, image):
    return bool(np.array_equal(env.render(), image))

one, two = made(64), made(80)
"""


def _run(program, **environment):
    """Run a program without a display, and return its output."""
    environment_without_display = {
        name: value
        for name, value in os.environ.items()
        if name not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")
    }
    command = [sys.executable, "-c", program]
    process = subprocess.run(
        command,
        env=environment_without_display | environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    assert "Traceback" not in process.stderr
    assert not environment or not process.stderr
    return process.stdout


def _printed_words(program):
    """Return the words that the program prints after the common one."""
    return _run(PROGRAM + program, MUJOCO_GL="egl", SDL_VIDEODRIVER="dummy").split()


def test_the_error_without_opengl_has_a_remedy():
    """Import mujoco first, so that its backend needs a display; there is none."""
    output = _run(WITHOUT)
    # MuJoCo's own second attempt would end the process.
    assert output.count("MUJOCO_GL is not set") == 2
    assert "set MUJOCO_GL=egl before mujoco is first imported" in output
    assert "apt-get install libegl1" in output
    # The environment itself continues.
    assert output.endswith("1.0\n")


@pytest.mark.matrix
def test_environments_close_and_render_again_after_the_display_was_terminated():
    program = "end_display(); one[0].close(); print(same(*two), same(*one), same(*made(64)))"
    assert _printed_words(program) == ["True"] * 3
    # The contexts are freed at exit.
    assert _printed_words("end_display()") == []


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_process_renders_inherited_and_new_environments_and_frees_only_its_own():
    program = """
def child():
    print(same(*one), same(made(64)[0], one[1]), flush=True)
    one[0].close()

process = multiprocessing.get_context("fork").Process(target=child)
process.start()
process.join(60)
print(process.exitcode, same(*two))
process.kill()
one[0].close()
print(same(*two), same(*two))
"""
    assert _printed_words(program) == ["True", "True", "0", *["True"] * 3]
