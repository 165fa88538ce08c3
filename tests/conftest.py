"""Settings and fixtures of the whole suite."""

import hypothesis
import mujoco
import pytest

from codrl_mj import callbacks

hypothesis.settings.register_profile("deterministic", derandomize=True, deadline=None, max_examples=100, database=None)
hypothesis.settings.load_profile("deterministic")


def _remove_callbacks():
    mujoco.set_mjcb_control(None)
    mujoco.set_mjcb_act_bias(None)


@pytest.fixture
def bare_engine():
    """MuJoCo without any callback, before and after the test."""
    _remove_callbacks()
    yield
    _remove_callbacks()


@pytest.fixture
def installed():
    """MuJoCo with our callbacks during the test, and without any after it."""
    _remove_callbacks()
    callbacks.install()
    yield
    _remove_callbacks()
