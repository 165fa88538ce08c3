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
    """To the last bit, noise of the sensor included: what was measured then is beside them."""
    run = RUNS / name
    now = evaluate(load_policy(run), load_config(run).evaluation_env, 2, EVALUATION_SEED).as_mapping()
    then = json.loads((run / "evaluation.json").read_text())
    then["units"], now["units"] = None, None  # there are more measures now
    assert {
        key: value for key, value in json.loads(json.dumps(now)).items() if key in then and key != "conditions"
    } == {key: value for key, value in then.items() if key != "conditions"}
