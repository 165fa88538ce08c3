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

PAPER_TASKS = frozenset(TASKS)

hypothesis.settings.register_profile(
    "deterministic", derandomize=True, deadline=None, max_examples=100, database=None
)
hypothesis.settings.load_profile("deterministic")


REPRESENTATIVES = ("pendulum", "cartpole", "mountain_car")
"""Of products of the tasks with something else `make test` runs these: a continuous, an unbounded and a walled one."""


def pytest_collection_modifyitems(items):
    """Leave the other tasks' rows of such products to `make check`."""
    for item in items:
        parameters = getattr(item, "callspec", None)
        if parameters and len(parameters.params) > 1:
            task = parameters.params.get("task")
            if isinstance(task, str) and task in PAPER_TASKS and task not in REPRESENTATIVES:
                item.add_marker(pytest.mark.matrix)


def pytest_collection_finish():
    """Spare the collector what lives as long as the process: thousands of tests, and all that they import."""
    gc.collect()
    gc.freeze()


def _remove_callbacks():
    for name in ("control", "act_bias", "act_gain", "act_dyn", "passive"):
        getattr(mujoco, f"set_mjcb_{name}")(None)


@pytest.fixture
def bare_engine():
    """MuJoCo without any callback, before and after the test."""
    _remove_callbacks()
    yield
    _remove_callbacks()


@pytest.fixture
def installed(bare_engine):
    """MuJoCo with our motors' callbacks during the test, and without any after it."""
    engine.load_family(DCMotorActuator)
    engine.install()


@pytest.fixture(autouse=True)
def _only_our_tasks():
    """Whatever task a test registers is forgotten after it: others go through all that are known."""
    yield
    for name in set(TASKS) - PAPER_TASKS:
        registry.pop(TASKS.pop(name).env_id, None)


@pytest.fixture(autouse=True, scope="session")
def _as_wide_as_a_file():
    """Processes of a parallel run have a COLUMNS of their own."""
    os.environ.pop("COLUMNS", None)
