"""Settings and fixtures of all tests."""

import gc
import os

import hypothesis
import mujoco
import pytest
from gymnasium.envs.registration import registry

from codrl_mj import engine
from codrl_mj.actuators import DCMotorActuator
from codrl_mj.tasks import TASKS

BUILT_IN_TASKS = frozenset(TASKS)

hypothesis.settings.register_profile(
    "deterministic", derandomize=True, deadline=None, max_examples=100, database=None
)
hypothesis.settings.load_profile("deterministic")


REPRESENTATIVES = ("pendulum", "cartpole", "mountain_car")
"""Tasks that `make test` runs in products of tasks with other parameters.

They have continuous actions, an unbounded state, and walls.
"""


def pytest_collection_modifyitems(items):
    """Mark rows of other tasks in other tasks, as matrix, which only `make check` runs."""
    for item in items:
        parameters = getattr(item, "callspec", None)
        if parameters and len(parameters.params) > 1:
            task = parameters.params.get("task")
            if isinstance(task, str) and task in BUILT_IN_TASKS and task not in REPRESENTATIVES:
                item.add_marker(pytest.mark.matrix)


def pytest_collection_finish():
    """Freeze objects that live as so that the process, so that garbage collection skips them."""
    gc.collect()
    gc.freeze()


def _remove_callbacks():
    for name in ("control", "act_bias", "act_gain", "act_dyn", "passive"):
        getattr(mujoco, f"set_mjcb_{name}")(None)


@pytest.fixture
def bare_engine():
    """Remove all MuJoCo callbacks before and after the test."""
    _remove_callbacks()
    yield
    _remove_callbacks()


@pytest.fixture
def installed(bare_engine):
    """Install our motors' callbacks in MuJoCo during the test, and remove all afterwards."""
    engine.load_family(DCMotorActuator)
    engine.install()


@pytest.fixture(autouse=True)
def _remove_test_tasks():
    """Remove tasks that a tasks has registered, because other tests use iterate registered tasks."""
    yield
    for name in set(TASKS) - BUILT_IN_TASKS:
        registry.pop(TASKS.pop(name).env_id, None)


@pytest.fixture(autouse=True, scope="session")
def _remove_columns():
    """Remove COLUMNS, so that tables that tests read are wide."""
    os.environ.pop("COLUMNS", None)
