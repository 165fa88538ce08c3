"""Training runs: from a configuration to a run folder, however often they are interrupted."""

from codrl_mj.runs.layout import finished
from codrl_mj.training.config import EVALUATION_SEED, TrainConfig, read_config
from codrl_mj.training.folder import RunInUseError, load_config
from codrl_mj.training.history import Progress
from codrl_mj.training.run import TrainingStoppedError, train

__all__ = [
    "EVALUATION_SEED",
    "Progress",
    "RunInUseError",
    "TrainConfig",
    "TrainingStoppedError",
    "finished",
    "load_config",
    "read_config",
    "train",
]
