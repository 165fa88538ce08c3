"""An empty folder for each test of the command line, and a run."""

import pytest

from tests.cli.lines import TINY, ran


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Every test runs in an empty folder."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """A tiny run of CartPole through the actuator `weaker`."""
    out = tmp_path_factory.mktemp("trained") / "run"
    ran(f"train cartpole --actuator weaker {TINY} --out {out}")
    return out
