"""All that the README offers without extras works with only the core dependencies."""

import json
import re
import tomllib
from pathlib import Path

import pytest

from codrl_mj import requirements
from codrl_mj.cli import VERBS
from tests.bare_environment import BareEnvironment

REPOSITORY = Path(__file__).parents[1]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]

USE = """
import json
import gymnasium as gym
import numpy as np
import codrl_mj

done = {}
for task in ("pendulum", "furuta"):
    motor = "maxon-ec45-flat-50w" if task == "pendulum" else None
    env = codrl_mj.make(task, motor, render_mode="rgb_array")
    env.reset(seed=0)
    reward = env.step(env.action_space.sample())[1]
    done[task] = bool(np.isfinite(reward)) and env.render().std() > 0
envs = codrl_mj.make_vec("cartpole", 4, "weaker")
done["vector"] = envs.reset(seed=0)[0].shape == (4, 4)
cheetah = codrl_mj.make("HalfCheetah-v5", {".*": "lag"})
cheetah.reset(seed=0)
done["third-party"] = bool(np.isfinite(cheetah.step(cheetah.action_space.sample())[1]))
print(json.dumps({name: bool(value) for name, value in done.items()}))
"""
COMMANDS = [
    "motor list",
    "motor show maxon-ec45-flat-50w",
    "motor feasible maxon-ec45-flat-50w pendulum --gear-ratio 20",
    "identify simulate maxon-ec45-flat-50w --duration 1 --out log.csv",
    (
        "identify check log.csv --columns"
        " time=time:s,voltage=voltage:V,current=current:A,position=position:rad"
    ),
]
"""Commands that neither train nor draw."""


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """Return a function that runs Python in an environment with only the core dependencies."""
    environment = BareEnvironment(tmp_path_factory.mktemp("core"))
    environment.link([*PROJECT["dependencies"], "codrl-mj"])
    environment.add_path(REPOSITORY)
    return environment.run


def test_environments_work_with_the_core_dependencies_alone(python):
    process = python("-c", USE)
    assert process.returncode == 0, process.stderr
    assert json.loads(process.stdout.splitlines()[-1]) == {
        "pendulum": True,
        "furuta": True,
        "vector": True,
        "third-party": True,
    }


def test_the_extras_are_really_missing_there(python):
    modules = [
        "torch",
        "stable_baselines3",
        "matplotlib",
        "jinja2",
        "dm_control",
        "viser",
        "control",
        "onnx",
        "pytest",
    ]
    program = f"import importlib.util as u; print([m for m in {modules} if u.find_spec(m)])"
    assert python("-c", program).stdout.strip() == "[]"


def test_verbs_that_neither_train_nor_draw_work_with_the_core_dependencies_alone(python):
    program = "import sys; from codrl_mj.cli import main; import json\n"
    program += f"print([main(line.split()) for line in {COMMANDS}])"
    process = python("-c", program)
    assert process.stdout.splitlines()[-1:] == [str([0] * len(COMMANDS))], (
        process.stdout[-500:] + process.stderr
    )


def test_every_verb_explains_itself_with_the_core_dependencies_alone(python):
    program = f"""
import contextlib, io
from codrl_mj.cli import main
silent = []
for name in {list(VERBS)}:
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main([*name.split(), "--help"])
    if "usage" not in text.getvalue().lower():
        silent.append(name)
print(silent)
"""
    process = python("-c", program)
    assert process.stdout.splitlines()[-1:] == ["[]"], process.stdout + process.stderr


@pytest.mark.parametrize(
    ("command", "module", "extra"),
    [
        ("train pendulum --total-steps 10 --out runs/a", "stable_baselines3", "train"),
        ("view pendulum", "trimesh", "view"),
    ],
)
def test_a_verb_that_needs_an_extra_names_it(python, command, module, extra):
    process = python(
        "-c", f"import sys; from codrl_mj.cli import main; sys.exit(main({command.split()}))"
    )
    assert process.returncode == 2
    assert f"pip install 'codrl-mj[{extra}]'" in process.stderr
    assert module in process.stderr.replace("-", "_")


def test_a_public_name_that_needs_an_extra_names_it(python):
    process = python("-c", "import codrl_mj; codrl_mj.make_sb3_vec_env")
    assert process.returncode == 1
    assert process.stderr.splitlines()[-1] == (
        "ModuleNotFoundError: stable_baselines3 is not installed. The extra 'train' installs it: pip"
        " install 'codrl-mj[train]'"
    )


@pytest.mark.parametrize(
    ("module", "brought_by"),
    [
        ("torch", ["train"]),
        ("serial.tools", ["deploy"]),
        ("PIL", ["render"]),
        ("matplotlib", ["render", "train", "validate"]),
        ("onnxruntime", ["deploy"]),
    ],
)
def test_the_message_on_a_missing_module_names_the_extras_that_declare_it(module, brought_by):
    distribution = requirements.DISTRIBUTIONS.get(
        module.partition(".")[0], module.partition(".")[0]
    )
    declaring = [
        name for name in brought_by if any(text.startswith(distribution) for text in EXTRAS[name])
    ]
    # pyproject.toml must declare the same.
    assert declaring == brought_by
    text = requirements.missing_module_message(
        ModuleNotFoundError(f"No module named {module!r}", name=module)
    )
    assert all(f"'{name}'" in text or f"[{name}]" in text for name in brought_by)
    assert "dev" not in re.findall(r"'(\w+)'", text)


def test_the_message_on_an_unknown_module_keeps_its_name():
    error = ModuleNotFoundError("No module named 'nothing_such'", name="nothing_such")
    assert (
        requirements.missing_module_message(error)
        == "No module named 'nothing_such': install the package that provides it"
    )
