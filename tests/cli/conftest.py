"""Fixtures of the command line's tests: an empty folder for each test, and a run."""

import pytest

from tests.cli.lines import TINY, run_ok


@pytest.fixture(autouse=True)
def empty_folder(tmp_path, monkeypatch):
    """Run every test in an empty folder."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """Return a tiny run of CartPole through the actuator `weaker`."""
    out = tmp_path_factory.mktemp("trained") / "run"
    run_ok(f"train cartpole --actuator weaker {TINY} --out {out}")
    return out
