"""Run folders that stand in the repository, of an earlier commit: their policies do what they did then."""

import json
from pathlib import Path

import pytest

from codrl_mj.evaluation import evaluate
from codrl_mj.runs.policies import load_policy
from codrl_mj.training import EVALUATION_SEED, load_config

RUNS = Path(__file__).parent / "fixtures" / "runs"


@pytest.mark.parametrize("name", ["cartpole", "pendulum"])
def test_a_policy_does_what_it_did(name):
    """Noise of the sensor included: what was measured then is beside them.

    Not to the last bit: a network's float32 sums are in another order on another processor.
    """
    run = RUNS / name
    now = evaluate(
        load_policy(run), load_config(run).evaluation_env, 2, EVALUATION_SEED
    ).as_mapping()
    then = json.loads((run / "evaluation.json").read_text())
    then["units"], now["units"] = None, None  # there are more measures now
    kept = then.keys() - {"conditions"}
    assert kept <= now.keys()
    for name in kept:
        check_close(json.loads(json.dumps(now[name])), then[name], name)


def check_close(ours, theirs, where):
    """Whatever is in two nested values is the same; numbers to 1e-6 of themselves."""
    if isinstance(theirs, dict | list):
        keys = theirs.keys() if isinstance(theirs, dict) else range(len(theirs))
        assert len(ours) == len(theirs), where
        for key in keys:
            check_close(ours[key], theirs[key], f"{where}/{key}")
    else:
        assert ours == (pytest.approx(theirs, rel=1e-6) if isinstance(theirs, float) else theirs), (
            where
        )
