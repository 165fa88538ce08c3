"""The settings of TD3 in td3.yml, as rl-zoo3 takes them from a module."""

from codrl_mj.rl_zoo3 import read

hyperparams = read("td3")
