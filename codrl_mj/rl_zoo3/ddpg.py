"""Settings of DDPG from ddpg.yml, in the form of a configuration module of rl-zoo3."""

from codrl_mj.rl_zoo3 import read_hyperparameters

hyperparams = read_hyperparameters("ddpg")
