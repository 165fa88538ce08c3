"""Files that trainings leave: whole files, run folders and what they came to, policies that are safe to load.

Here is what a run folder holds under which name, and what marks it as finished.
"""

import re
from collections.abc import Sequence
from pathlib import Path

CONFIG, RESULT, EVALUATION = "config.json", "result.json", "evaluation.json"
PROGRESS, EPISODES, CURVE = "progress.csv", "episodes.csv", "learning_curve.png"
BEST, CHECKPOINTS, TENSORBOARD, LOCK = "best", "checkpoints", "tensorboard", ".lock"
POLICY_FILES = WEIGHTS, DESCRIPTION = "policy.safetensors", "policy.json"
DIGEST = "weights_sha256"
"""Entry of a policy's description: the digest of its weights."""
CHECKPOINT = re.compile(r"step-(?P<step>\d{12})-(?P<digest>[0-9a-f]{16})\.safetensors")
"""Names of checkpoints."""


def finished(run: Path) -> bool:
    """Whether the training of a run folder is finished: its result, which is written last, is there."""
    return (run / RESULT).is_file()


def find_checkpoints(folder: Path) -> dict[Path, re.Match[str]]:
    """The checkpoints of a folder, the oldest first, and what their names say."""
    named = {path: CHECKPOINT.fullmatch(path.name) for path in sorted(folder.glob("*"))}
    return {path: match for path, match in named.items() if match is not None}


def unique_names(folders: Sequence[Path]) -> list[str]:
    """Names of some folders, with as much of their paths as tells them apart."""
    for length in range(1, 4):
        names = ["/".join(one.resolve().parts[-length:]) for one in folders]
        if len(set(names)) == len(names):
            return names
    return [f"{name} ({place})" for place, name in enumerate(names, 1)]
