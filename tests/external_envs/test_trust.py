"""Modules of third-party ids are imported only with permission, even after an earlier import."""

import pytest

from codrl_mj.envs.config import find_source
from codrl_mj.user_code import UntrustedCodeError, allow_imports

MODULE = """
import gymnasium

RIG = "gymnasium.envs.mujoco.inverted_pendulum_v5:InvertedPendulumEnv"
gymnasium.register("trusted/Rig-v0", RIG)
"""


def test_an_id_whose_module_was_imported_needs_permission_all_the_same(tmp_path, monkeypatch):
    """A training has imported the module; its last line names --trust for the next command."""
    (tmp_path / "trusted_rig.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    source = find_source("trusted_rig:trusted/Rig-v0")
    assert find_source("trusted_rig:trusted/Rig-v0") is source
    with allow_imports(False), pytest.raises(UntrustedCodeError, match="trusted_rig"):
        find_source("trusted_rig:trusted/Rig-v0")
