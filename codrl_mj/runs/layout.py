"""What a run folder holds under which name, and what marks it as finished."""

from pathlib import Path

CONFIG, RESULT, EVALUATION = "config.json", "result.json", "evaluation.json"
PROGRESS = "progress.csv"
POLICY_FILES = WEIGHTS, DESCRIPTION = "policy.safetensors", "policy.json"


def finished(run: Path) -> bool:
    """Whether the training of a run folder is finished: its result, which is written last, is there."""
    return (run / RESULT).is_file()
