"""Settings and fixtures of the whole suite."""

import gc
import os

import hypothesis
import mujoco
import pytest
from gymnasium.envs.registration import registry

from codrl_mj import engine
from codrl_mj.actuators import DCMotorActuator
from codrl_mj.tasks import TASKS

OURS = frozenset(TASKS)

hypothesis.settings.register_profile(
    "deterministic", derandomize=True, deadline=None, max_examples=100, database=None
)
hypothesis.settings.load_profile("deterministic")


REPRESENTATIVES = ("pendulum", "cartpole", "mountain_car")
"""Tasks of matrix tests in `make test`: a continuous, an unbounded and a walled one."""


def pytest_collection_modifyitems(items):
    """Deselect matrix rows of other tasks, which `make check` runs."""
    for item in items:
        parameters = getattr(item, "callspec", None)
        if parameters and len(parameters.params) > 1:
            task = parameters.params.get("task")
            if isinstance(task, str) and task in OURS and task not in REPRESENTATIVES:
                item.add_marker(pytest.mark.matrix)


def pytest_collection_finish():
    """Freeze collected objects, so that the garbage collector skips tests and imports."""
    gc.collect()
    gc.freeze()


def _remove_callbacks():
    for name in ("control", "act_bias", "act_gain", "act_dyn", "passive"):
        getattr(mujoco, f"set_mjcb_{name}")(None)


@pytest.fixture
def bare_engine():
    """Remove MuJoCo's callbacks before and after the test."""
    _remove_callbacks()
    yield
    _remove_callbacks()


@pytest.fixture
def installed(bare_engine):
    """Install the motors' callbacks in MuJoCo during the test."""
    engine.load_family(DCMotorActuator)
    engine.install()


@pytest.fixture(autouse=True)
def _only_our_tasks():
    """Unregister the tasks of a test after it, because other tests iterate over all tasks."""
    yield
    for name in set(TASKS) - OURS:
        registry.pop(TASKS.pop(name).env_id, None)


@pytest.fixture(autouse=True, scope="session")
def _as_wide_as_a_file():
    """Remove COLUMNS, which processes of a parallel run set."""
    os.environ.pop("COLUMNS", None)
