"""What `import codrl_mj` does and does not do, each in a process of its own."""

import os
import subprocess
import sys

import pytest

HEAVY = ("numba", "llvmlite", "torch", "stable_baselines3", "matplotlib", "imageio", "scipy", "tyro", "rich")
CLEAN = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")}


def _python(program, **environment):
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**CLEAN, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert done.stderr == ""
    return done.stdout.strip()


def test_importing_the_package_imports_nothing_heavy():
    assert _python(f"import sys, codrl_mj; print([name for name in {HEAVY} if name in sys.modules])") == "[]"


def test_importing_the_package_registers_every_environment():
    program = "import gymnasium, codrl_mj; print([i for i in gymnasium.registry if i.startswith('codrl_mj/')])"
    assert "codrl_mj/CartPole-v0" in _python(program)


def test_importing_the_motor_imports_no_engine():
    program = "import sys, codrl_mj.actuators; print([n for n in ('numba', 'torch') if n in sys.modules])"
    assert _python(program) == "[]"


def test_a_board_s_log_is_checked_without_what_trains():
    program = "import sys, codrl_mj.deploy; print([n for n in ('torch', 'stable_baselines3') if n in sys.modules])"
    assert _python(program) == "[]"


BACKEND = "print(os.environ.get('MUJOCO_GL'))"


@pytest.mark.parametrize(
    ("environment", "before", "expected"),
    [
        ({}, "", "egl"),
        ({"DISPLAY": ":7"}, "", "None"),
        ({"WAYLAND_DISPLAY": "wayland-0"}, "", "None"),
        ({"DISPLAY": ""}, "", "egl"),
        ({"MUJOCO_GL": "osmesa"}, "", "osmesa"),
        ({}, "import mujoco;", "None"),  # too late: mujoco has read it
    ],
    ids=["no display", "X11", "Wayland", "empty display", "chosen by the user", "mujoco imported first"],
)
def test_rendering_goes_through_egl_where_there_is_no_display_and_nothing_was_chosen(environment, before, expected):
    assert _python(f"import os; {before} import codrl_mj; {BACKEND}", **environment) == expected


def test_every_public_name_can_be_had_and_listed():
    program = (
        "import codrl_mj; print(all(getattr(codrl_mj, n) is not None and n in dir(codrl_mj) for n in codrl_mj.__all__))"
    )
    assert _python(program) == "True"


def test_an_unknown_name_is_an_attribute_error():
    import codrl_mj

    with pytest.raises(AttributeError, match="module 'codrl_mj' has no attribute 'Actuators'"):
        _ = codrl_mj.Actuators
