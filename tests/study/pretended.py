"""Run folders with pretended results: scores from a formula, in the files that a study reads."""

import json

from codrl_mj.evaluation import MEASURES

INTERVALS = {"returns", "success", "energy_drawn"}


def pretend(grid, score, leaving_out=()):
    """Write finished runs and tests.

    Args:
        grid: grid of the study.
        score: function (trial, seed) -> mean return.
        leaving_out: (arm, seed) of trainings that are left out.
    """
    folders, tests = grid.folders, grid.policy_tests
    for cell, config in grid.cells.items():
        if cell not in leaving_out:
            folders[cell].mkdir(parents=True)
            (folders[cell] / "config.json").write_text(
                json.dumps({"train": config.as_mapping(), "code": "c0de" * 16})
            )
            (folders[cell] / "episodes.csv").write_text(_episodes(config.total_steps or 2000))
            (folders[cell] / "result.json").write_text(
                json.dumps({"steps": config.total_steps, "seconds": 10.0})
            )
    for trial in grid.trials:
        for seed in grid.seeds_of(trial.arm):
            if (trial.arm.name, seed) not in leaving_out:
                record = tests[trial.name, seed].record
                record.parent.mkdir(exist_ok=True)
                record.write_text(json.dumps(evaluation(score(trial, seed), grid.episodes)))


def _episodes(steps):
    """Return twenty training episodes of equal length with returns 1, 2, ... 20."""
    rows = [
        f"{number},{round(number * steps / 20)},{number},{steps // 20}" for number in range(1, 21)
    ]
    return "\n".join(["episode,steps,return,length", *rows, ""])


def evaluation(mean_return, episodes):
    """Return an evaluation in which every measure but the return is 1 or None."""
    values = dict.fromkeys(MEASURES, 1.0) | {"tracking_percent": None}
    values |= {name: {"mean": 0.5, "low": 0.25, "high": 0.75} for name in INTERVALS}
    return values | {
        "returns": {"mean": mean_return, "low": mean_return - 1.0, "high": mean_return + 1.0},
        "episodes": episodes,
    }
