"""Training runs, from a configuration to a run folder, with any number of interruptions."""

from codrl_mj.runs import finished
from codrl_mj.training.config import EVALUATION_SEED, TrainConfig, read_config
from codrl_mj.training.folder import RunInUseError, TrainingStoppedError, load_config
from codrl_mj.training.history import Progress
from codrl_mj.training.run import train

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
