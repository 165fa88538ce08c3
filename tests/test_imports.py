"""Effects of `import codrl_mj` in a process that has not imported anything yet."""

import ast
import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import codrl_mj

PROGRAM = """
import json, os, sys
import gymnasium, codrl_mj

def loaded():
    heavy = "numba llvmlite torch stable_baselines3 matplotlib imageio scipy tyro rich"
    heavy += " dm_control pint"
    return [name for name in heavy.split() if name in sys.modules]

found = {"package": loaded(), "ids": [*gymnasium.registry], "backend": os.environ.get("MUJOCO_GL")}
import codrl_mj.actuators
found["motor"] = loaded()
import codrl_mj.deploy
print(json.dumps(found | {"board": loaded()}))
"""


@pytest.fixture(scope="module")
def loaded_modules():
    """Return the modules that a process without a display has loaded after each import."""
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")
    }
    command = [sys.executable, "-c", PROGRAM]
    process = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=120, check=True
    )
    assert process.stderr == ""
    return json.loads(process.stdout)


def test_importing_the_package_imports_nothing_heavy(loaded_modules):
    assert loaded_modules["package"] == []


def test_importing_the_package_registers_every_environment(loaded_modules):
    assert {task.env_id for task in codrl_mj.tasks.TASKS.values()} <= {*loaded_modules["ids"]}


def test_importing_the_motor_imports_no_engine(loaded_modules):
    assert not {"numba", "torch"} & {*loaded_modules["motor"]}


def test_a_board_s_log_is_checked_without_training_libraries(loaded_modules):
    assert not {"torch", "stable_baselines3"} & {*loaded_modules["board"]}


def test_rendering_goes_through_egl(loaded_modules):
    assert loaded_modules["backend"] == ("egl" if sys.platform == "linux" else None)


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
def test_the_backend_depends_on_the_display_and_on_the_user_s_choice(
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


def test_every_public_name_can_be_imported_and_listed():
    assert all(
        getattr(codrl_mj, name) is not None and name in dir(codrl_mj) for name in codrl_mj.__all__
    )


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'codrl_mj' has no attribute 'Actuators'"):
        _ = codrl_mj.Actuators


@pytest.mark.parametrize(
    "package", ["codrl_mj", "codrl_mj.engine", "codrl_mj.envs", "codrl_mj.sizing"]
)
def test_the_stub_of_a_package_has_its_public_names(package):
    """Type checkers and editors read the names that `__init__.py` imports on first use there."""
    module = importlib.import_module(package)
    tree = ast.parse(Path(module.__file__).with_suffix(".pyi").read_text())
    imported = {
        alias.asname: node.module
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname
    }
    assert imported == module._PUBLIC
