"""Run folders of studies that were never run: scores that a formula gives, where the study looks for them."""

import json

from codrl_mj.evaluation import MEASURES
from codrl_mj.study.grid import cell_folder
from codrl_mj.study.mismatch import cell_name, cells, deployments, trials

INTERVALS = {"returns", "success", "energy_drawn"}


def pretend(config, score, leaving_out=()):
    """Write finished runs and tests.

    Args:
        config: of the study.
        score: (trial, seed) -> mean return.
        leaving_out: names of trainings that are not to be there.
    """
    every = cells(config)
    for name, cell in every.items():
        if name not in leaving_out:
            folder = cell_folder(config.root, cell)
            folder.mkdir(parents=True)
            (folder / "config.json").write_text(json.dumps({"train": cell.as_mapping(), "code": "c0de" * 16}))
            (folder / "result.json").write_text(json.dumps({"steps": cell.total_steps, "seconds": 10.0}))
    tests = deployments(config)
    for name, trial in trials(config).items():
        for seed, deployment in tests[name].items():
            if cell_name(trial.arm.task, trial.arm.name, seed) not in leaving_out:
                deployment.record.parent.mkdir(exist_ok=True)
                deployment.record.write_text(json.dumps(evaluation(score(trial, seed), config.episodes)))


def evaluation(mean_return, episodes):
    """An evaluation whose every measure but the return is 1, or unknown."""
    values = dict.fromkeys(MEASURES, 1.0) | {"tracking_percent": None}
    values |= {name: {"mean": 0.5, "low": 0.25, "high": 0.75} for name in INTERVALS}
    return values | {
        "returns": {"mean": mean_return, "low": mean_return - 1.0, "high": mean_return + 1.0},
        "episodes": episodes,
    }
