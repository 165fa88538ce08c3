"""Types of the public names, which `__init__.py` imports on first use."""

from codrl_mj.envs.registration import register as register
from codrl_mj.envs.serial import SerialVectorEnv as SerialVectorEnv
from codrl_mj.envs.single import ActuatedEnv as ActuatedEnv
from codrl_mj.envs.vector import ActuatedVectorEnv as ActuatedVectorEnv
