"""What is drawn at every reset, as configurations and the command line have it."""

import dataclasses
import itertools
import json
import re
import shlex
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml

from codrl_mj import Choice, LogUniform, Uniform
from codrl_mj.cli import main
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import make_env

PAGE = (Path(__file__).parent.parent / "docs" / "randomization.md").read_text()
RANDOMIZE = {
    "controller.kp": LogUniform(0.5, 5.0),
    "motor.inductance": Uniform(0.05, 0.2),
    "controller.substeps": Choice([1, 2]),
    "controller.bemf_compensation": Choice([True, False]),
    "model.mass.pole": Uniform(0.8, 1.25),
}
WRITTEN = (
    "controller.kp=loguniform(0.5, 5.0)",
    "motor.inductance=uniform(0.05, 0.2)",
    "controller.substeps=choice(1, 2)",
    "controller.bemf_compensation=choice(True, False)",
    "model.mass.pole=uniform(0.8, 1.25)",
)


@pytest.mark.parametrize(
    "given",
    [
        RANDOMIZE,
        WRITTEN,
        list(WRITTEN),
        {name: str(distribution) for name, distribution in RANDOMIZE.items()},
        [text.replace(" ", "").replace("=", " = ") for text in WRITTEN],
    ],
    ids=["distributions", "tuple", "list", "mapping of text", "other spaces"],
)
def test_every_form_is_the_same_configuration(given):
    config = EnvConfig(randomize=given)
    assert config.randomize == WRITTEN
    assert hash(config) == hash(EnvConfig(randomize=RANDOMIZE))
    arguments = config.as_arguments()["randomize"]
    assert list(arguments.items()) == list(RANDOMIZE.items())  # the order too: it is that of the draws
    assert EnvConfig(**json.loads(json.dumps(dataclasses.asdict(config)))) == config
    assert EnvConfig(**yaml.safe_load(yaml.safe_dump(json.loads(json.dumps(dataclasses.asdict(config)))))) == config


def test_environments_draw_from_it():
    ours = make_env("cartpole", "paper", **EnvConfig(randomize=WRITTEN).as_arguments())
    theirs = make_env("cartpole", "paper", randomize=RANDOMIZE)
    assert ours.reset(seed=3)[1]["randomization"] == theirs.reset(seed=3)[1]["randomization"]


def test_nothing_is_drawn_by_default():
    assert EnvConfig().randomize is None
    assert "randomize" not in EnvConfig().as_arguments()
    drawn = EnvConfig(randomize=WRITTEN)
    assert drawn != EnvConfig()
    assert dataclasses.replace(drawn, randomize=None) == EnvConfig()
    assert EnvConfig().seen_as(drawn).randomize is None  # it is no part of what an agent commands and sees


REFUSED = {
    "empty": ({}, "randomize = {}: must be one or more of FIELD=DISTRIBUTION"),
    "one text": ("a=uniform(0, 1)", "randomize = 'a=uniform(0, 1)': must be one or more of FIELD=DISTRIBUTION"),
    "no sequence": (3, "randomize = 3: must be one or more of FIELD=DISTRIBUTION"),
    "no equals sign": (["motor.inductance"], "randomize: 'motor.inductance': must be FIELD=DISTRIBUTION, such as "),
    "no field": (["=uniform(0, 1)"], "randomize: '=uniform(0, 1)': must be FIELD=DISTRIBUTION, such as "),
    "no text": ([3], "randomize: 3: must be FIELD=DISTRIBUTION, such as "),
    "twice": (["a=uniform(0, 1)", "a=choice(1)"], "randomize: a is named twice"),
    "no distribution": ({"a": {"uniform": [0, 1]}}, "randomize: a: {'uniform': [0, 1]} is no distribution: must be "),
    "a number": ({"a": 0.3}, "randomize: a: 0.3 is no distribution: must be uniform(LOW, HIGH), "),
    "unknown": (["a=gauss(0, 1)"], "randomize: a: 'gauss(0, 1)' is no distribution: it must be uniform(LOW, HIGH), "),
    "too few": (["a=uniform(1)"], "randomize: a: 'uniform(1)' has 1 values: must be uniform(LOW, HIGH)"),
    "bounds": (["a=uniform(2, 1)"], "randomize: a: 'uniform(2, 1)': Uniform.high = 1: must be >= low = 2"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_randomisation_is_refused_with_a_reason(case):
    randomize, message = REFUSED[case]
    with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
        EnvConfig(randomize=randomize)


# -- the command line ---------------------------------------------------------------------------------------


def _rendered(folder, *flags):
    """The currents of an episode that the command line films."""
    arguments = ["render", "pendulum", "--width", "160", "--height", "120", "--env.max-episode-steps", "12"]
    trajectory = folder / "episode.npz"
    assert main([*arguments, "--out", str(folder / "frames"), "--trajectory", str(trajectory), *flags]) == 0
    with np.load(trajectory) as episode:
        return episode["current"]


def test_the_command_line_draws(tmp_path):
    fixed, drawn, exact = tmp_path / "fixed", tmp_path / "drawn", tmp_path / "exact"
    for folder in (fixed, drawn, exact):
        folder.mkdir()
    nominal = _rendered(fixed)
    flags = ["--env.randomize", "motor.inductance=uniform(0.3, 0.6)", "controller.kp=loguniform(0.1,10)"]
    assert not np.array_equal(_rendered(drawn, *flags), nominal)
    one = ["--env.randomize", "motor.inductance=choice(0.25)"]
    set_by_name = tmp_path / "set"
    set_by_name.mkdir()
    expected = _rendered(set_by_name, "--actuator.motor.inductance", "0.25")
    np.testing.assert_array_equal(_rendered(exact, *one), expected)


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("motor.inductance", "'motor.inductance': must be FIELD=DISTRIBUTION"),
        ("motor.inductance=gauss(0,1)", "motor.inductance: 'gauss(0,1)' is no distribution"),
        ("motor.inductance=uniform(0.2,0.1)", "Uniform.high = 0.1: must be >= low = 0.2"),
        ("motor.inductance=uniform(0,0.2)", "must be"),
        ("motor.inductanc=uniform(0.1,0.2)", "did you mean 'motor.inductance'?"),
    ],
)
def test_the_command_line_refuses_with_one_line(flag, message, capsys, tmp_path):
    assert main(["render", "pendulum", "--out", str(tmp_path / "film.mp4"), "--env.randomize", flag]) == 2
    error = capsys.readouterr().err
    assert error.startswith("codrl-mj: error: randomize")
    assert message in error
    assert error.count("\n") == 1


# -- the page -----------------------------------------------------------------------------------------------


def test_the_examples_of_the_page_run(capsys):
    namespace = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(compile(block, "randomization.md", "exec"), namespace)
    assert "rejected" in capsys.readouterr().out
    namespace["env"].close()


def test_the_files_of_the_page_are_configurations():
    blocks = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    assert blocks
    for block in blocks:
        content = yaml.safe_load(block)
        env = make_env(content["task"], "paper", **EnvConfig(**content["env"]).as_arguments())
        assert isinstance(env, gymnasium.Env)
        assert env.reset(seed=0)[1]["randomization"].keys() > content["env"]["randomize"].keys()


def test_the_flags_of_the_page_survive_the_shell():
    commands = re.findall(r"^\$ (codrl-mj (?:.*\\\n)*.*)$", PAGE, re.MULTILINE)
    assert commands
    for command in commands:
        words = iter(shlex.split(command.replace("\\\n", "")))
        assert "--env.randomize" in words  # leaves what follows it
        config = EnvConfig(randomize=list(itertools.takewhile(lambda word: not word.startswith("--"), words)))
        assert len(config.as_arguments()["randomize"]) == 2
