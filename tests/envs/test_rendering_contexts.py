"""OpenGL contexts that somebody else ends, frees or inherits; each in a process of its own."""

import os
import subprocess
import sys

import pytest

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


def _run(program):
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment |= {"MUJOCO_GL": "egl", "SDL_VIDEODRIVER": "dummy"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM + program], env=environment, capture_output=True, text=True, timeout=120
    )
    assert (done.stderr, done.returncode) == ("", 0)
    return done.stdout.split()


@pytest.mark.matrix
def test_after_the_display_has_ended_environments_close_and_render_again():
    program = "end_display(); one[0].close(); print(same(*two), same(*one), same(*made(64)))"
    assert _run(program) == ["True"] * 3
    assert _run("end_display()") == []  # at exit


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
    assert _run(program) == ["True", "True", "0", *["True"] * 3]
