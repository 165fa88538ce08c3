"""Types of the public names, which `__init__.py` imports on first use."""

from codrl_mj.disturbances import Disturbances as Disturbances
from codrl_mj.disturbances import Joint as Joint
from codrl_mj.engine.reading import signals as signals
from codrl_mj.engine.specs import add_motors as add_motors
from codrl_mj.envs.config import EnvConfig as EnvConfig
from codrl_mj.envs.config import EnvSource as EnvSource
from codrl_mj.envs.distributions import Choice as Choice
from codrl_mj.envs.distributions import LogUniform as LogUniform
from codrl_mj.envs.distributions import Uniform as Uniform
from codrl_mj.envs.registration import register as register
from codrl_mj.envs.sb3 import make_sb3_vec_env as make_sb3_vec_env
from codrl_mj.evaluation import evaluate as evaluate
from codrl_mj.external_envs.building import motors_added as motors_added
from codrl_mj.external_envs.dm_control import make_dm_control as make_dm_control
from codrl_mj.external_envs.sources import ExternalEnvSource as ExternalEnvSource
from codrl_mj.factory import make as make
from codrl_mj.factory import make_vec as make_vec
from codrl_mj.runs.policies import load_policy as load_policy
from codrl_mj.tasks import Task as Task
from codrl_mj.training import TrainConfig as TrainConfig
from codrl_mj.training import train as train
from codrl_mj.validation import validate as validate

__version__: str

def _exit_on_interrupt(*_: object) -> None: ...
