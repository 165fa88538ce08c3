r"""Settings for rl-zoo3's command line: a YAML file and a module for each algorithm.

    python -m rl_zoo3.train --algo ppo --env codrl_mj/CartPole-v0 --gym-packages codrl_mj \
        --conf-file codrl_mj.rl_zoo3.ppo

The `--conf-file` of rl-zoo3 is a path to the YAML file, or the name of the module, which is found
wherever the package is installed. See docs/other_agents.md for details.
"""

from importlib.resources import files

from codrl_mj.boundary import JsonObject


def read_hyperparameters(algorithm: str) -> dict[str, JsonObject]:
    """Return an algorithm's hyperparameters: environment id -> hyperparameter -> value."""
    import yaml

    settings: dict[str, JsonObject] = yaml.safe_load(
        files(__name__).joinpath(f"{algorithm}.yml").read_text()
    )
    return settings
