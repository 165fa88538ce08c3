"""What `import codrl_mj` does and does not do, in a process that has imported nothing yet."""

import json
import os
import subprocess
import sys

import pytest

import codrl_mj

PROGRAM = """
import json, os, sys
import gymnasium, codrl_mj

def loaded():
    heavy = "numba llvmlite torch stable_baselines3 matplotlib imageio scipy tyro rich dm_control pint"
    return [name for name in heavy.split() if name in sys.modules]

found = {"package": loaded(), "ids": [*gymnasium.registry], "backend": os.environ.get("MUJOCO_GL")}
import codrl_mj.actuators
found["motor"] = loaded()
import codrl_mj.deploy
print(json.dumps(found | {"board": loaded()}))
"""


@pytest.fixture(scope="module")
def found():
    """What a process without a display has after one import and the next."""
    clean = {
        name: value
        for name, value in os.environ.items()
        if name not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")
    }
    line = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(line, env=clean, capture_output=True, text=True, timeout=120, check=True)
    assert done.stderr == ""
    return json.loads(done.stdout)


def test_importing_the_package_imports_nothing_heavy(found):
    assert found["package"] == []


def test_importing_the_package_registers_every_environment(found):
    assert {task.env_id for task in codrl_mj.tasks.TASKS.values()} <= {*found["ids"]}


def test_importing_the_motor_imports_no_engine(found):
    assert not {"numba", "torch"} & {*found["motor"]}


def test_a_board_s_log_is_checked_without_what_trains(found):
    assert not {"torch", "stable_baselines3"} & {*found["board"]}


def test_rendering_goes_through_egl(found):
    assert found["backend"] == ("egl" if sys.platform == "linux" else None)


@pytest.mark.parametrize(
    ("environment", "imported", "expected"),
    [
        ({}, False, "egl"),
        ({"DISPLAY": ":7"}, False, None),
        ({"WAYLAND_DISPLAY": "wayland-0"}, False, None),
        ({"DISPLAY": ""}, False, "egl"),
        ({"MUJOCO_GL": "osmesa"}, False, "osmesa"),
        ({}, True, None),  # too late: mujoco has read it
    ],
    ids=[
        "no display",
        "X11",
        "Wayland",
        "empty display",
        "chosen by the user",
        "mujoco imported first",
    ],
)
def test_but_not_where_there_is_a_display_or_another_was_chosen(
    monkeypatch, environment, imported, expected
):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "platform", "linux")
    if not imported:
        monkeypatch.delitem(sys.modules, "mujoco")
    codrl_mj._choose_headless_backend()
    assert os.environ.pop("MUJOCO_GL", None) == expected


def test_every_public_name_can_be_had_and_listed():
    assert all(
        getattr(codrl_mj, name) is not None and name in dir(codrl_mj) for name in codrl_mj.__all__
    )


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'codrl_mj' has no attribute 'Actuators'"):
        _ = codrl_mj.Actuators
