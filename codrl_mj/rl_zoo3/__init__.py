r"""Settings for rl-zoo3's own command line, one YAML file and one module of the same name for each algorithm.

    python -m rl_zoo3.train --algo ppo --env codrl_mj/CartPole-v0 --gym-packages codrl_mj \
        --conf-file codrl_mj.rl_zoo3.ppo

rl-zoo3 takes either as its `--conf-file`: a path to the YAML file, or the module, which is found
wherever the package is installed. docs/other_agents.md has the rest.
"""

from importlib.resources import files
from typing import Any


def read(algorithm: str) -> dict[str, dict[str, Any]]:
    """The settings of an algorithm, such as `ppo`: environment id -> hyperparameter -> value."""
    import yaml

    settings: dict[str, dict[str, Any]] = yaml.safe_load(
        files(__name__).joinpath(f"{algorithm}.yml").read_text()
    )
    return settings
