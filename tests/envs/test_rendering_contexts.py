"""OpenGL contexts that cannot be, or that somebody else ends, frees or inherits; each in a process of its own."""

import os
import subprocess
import sys

import pytest

WITHOUT = """
import mujoco
import gymnasium, codrl_mj
from codrl_mj.physics.offscreen import RenderingUnavailableError
env = gymnasium.make("codrl_mj/CartPole-v0", actuator="ideal", render_mode="rgb_array", width=64, height=48)
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
    env = gymnasium.make("codrl_mj/CartPole-v0", actuator="ideal", render_mode="rgb_array", width=size, height=48)
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
    """What a program prints where there is no display."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if name not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")
    }
    line = [sys.executable, "-c", program]
    done = subprocess.run(
        line, env=kept | environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert not environment or not done.stderr
    return done.stdout


def _drawn(program):
    return _run(PROGRAM + program, MUJOCO_GL="egl", SDL_VIDEODRIVER="dummy").split()


def test_where_there_can_be_no_image_the_error_says_what_to_do():
    """In a process that imported mujoco first, so that its backend needs a display, and there is none."""
    said = _run(WITHOUT)
    assert said.count("MUJOCO_GL is not set") == 2  # MuJoCo's own second attempt ends the process
    assert "set MUJOCO_GL=egl before mujoco is first imported" in said
    assert "apt-get install libegl1" in said
    assert said.endswith("1.0\n")  # the environment itself goes on


@pytest.mark.matrix
def test_after_the_display_has_ended_environments_close_and_render_again():
    program = "end_display(); one[0].close(); print(same(*two), same(*one), same(*made(64)))"
    assert _drawn(program) == ["True"] * 3
    assert _drawn("end_display()") == []  # at exit


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_process_renders_what_it_inherited_and_anew_and_none_frees_another_s():
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
    assert _drawn(program) == ["True", "True", "0", *["True"] * 3]
