"""Run folders of an earlier commit in the repository: their policies still behave as recorded."""

import json
from pathlib import Path

import pytest

from codrl_mj.evaluation import evaluate
from codrl_mj.runs.policies import load_policy
from codrl_mj.training import EVALUATION_SEED, load_config

RUNS = Path(__file__).parent / "fixtures" / "runs"


@pytest.mark.parametrize("name", ["cartpole", "pendulum"])
def test_a_policy_reproduces_its_recorded_evaluation(name):
    """The recorded evaluation includes sensor noise.

    Equality is not exact: a network's float32 sums have another order on another processor.
    """
    run = RUNS / name
    current = evaluate(
        load_policy(run), load_config(run).evaluation_env, 2, EVALUATION_SEED
    ).as_mapping()
    recorded = json.loads((run / "evaluation.json").read_text())
    recorded["units"], current["units"] = None, None  # Newer versions have more measures.
    run_folder = recorded.keys() - {"conditions"}
    assert run_folder <= current.keys()
    for name in run_folder:
        check_close(json.loads(json.dumps(current[name])), recorded[name], name)


def check_close(ours, theirs, path):
    """Assert that nested values are equal, and numbers up to a relative error of 1e-6."""
    if isinstance(theirs, dict | list):
        keys = theirs.keys() if isinstance(theirs, dict) else range(len(theirs))
        assert len(ours) == len(theirs), path
        for key in keys:
            check_close(ours[key], theirs[key], f"{path}/{key}")
    else:
        assert ours == (pytest.approx(theirs, rel=1e-6) if isinstance(theirs, float) else theirs), (
            path
        )
