"""The settings of SAC in sac.yml, as rl-zoo3 takes them from a module."""

from codrl_mj.rl_zoo3 import read

hyperparams = read("sac")
