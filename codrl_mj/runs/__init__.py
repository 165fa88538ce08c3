"""Run folders: their files, policies and summaries.

This module defines the names of the files in a run folder and the mark of a finished run.
"""

import re
from collections.abc import Sequence
from pathlib import Path

CONFIG, RESULT, EVALUATION = "config.json", "result.json", "evaluation.json"
PROGRESS, EPISODES, CURVE = "progress.csv", "episodes.csv", "learning_curve.png"
BEST, CHECKPOINTS, TENSORBOARD, LOCK = "best", "checkpoints", "tensorboard", ".lock"
POLICY_FILES = WEIGHTS, DESCRIPTION = "policy.safetensors", "policy.json"
DIGEST = "weights_sha256"
"""Key of the weights' digest in a policy's description."""
CHECKPOINT = re.compile(r"step-(?P<step>\d{12})-(?P<digest>[0-9a-f]{16})\.safetensors")
"""Pattern of the names of checkpoints."""


def finished(run: Path) -> bool:
    """Return True if the training of a run folder is finished."""
    # The result is written last.
    return (run / RESULT).is_file()


def find_checkpoints(folder: Path) -> dict[Path, re.Match[str]]:
    """Return the checkpoints of a folder, oldest first, with the match of `CHECKPOINT`."""
    named = {path: CHECKPOINT.fullmatch(path.name) for path in sorted(folder.glob("*"))}
    return {path: match for path, match in named.items() if match is not None}


def unique_names(folders: Sequence[Path]) -> list[str]:
    """Return short names of folders, with as many parents as needed to distinguish them."""
    for length in range(1, 4):
        names = ["/".join(folder.resolve().parts[-length:]) for folder in folders]
        if len(set(names)) == len(names):
            return names
    return [f"{name} ({number})" for number, name in enumerate(names, 1)]
