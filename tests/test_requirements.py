"""With packages of the simulation missing or too old, imports say so and register nothing."""

import importlib.metadata
import importlib.util
import json
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from codrl_mj import requirements
from tests.bare_environment import BareEnvironment

REPOSITORY = Path(__file__).parents[1]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
REQUIRED = {Requirement(text).name: Requirement(text) for text in PROJECT["dependencies"]}

PROGRAM = """
import json, os, sys
import gymnasium
import codrl_mj
from codrl_mj.actuators import resolve
motor = resolve("maxon-ec45-flat-50w", None, "a robot")
errors = []
for use in (lambda: codrl_mj.make, lambda: __import__("codrl_mj.engine.control")):
    try:
        use()
    except ImportError as error:
        errors.append(str(error))
ids = [name for name in gymnasium.registry if name.startswith("codrl_mj")]
loaded = [name for name in ("mujoco", "numba") if name in sys.modules]
answer = {"ids": ids, "loaded": loaded, "errors": errors, "backend": os.environ.get("MUJOCO_GL")}
print(json.dumps(answer))
"""


def test_the_oldest_mujoco_is_that_of_the_project():
    oldest = ".".join(map(str, requirements.MIN_MUJOCO))
    assert oldest in {
        part.version for part in REQUIRED["mujoco"].specifier if part.operator == ">="
    }
    assert {*requirements.SIMULATION_PACKAGES} <= REQUIRED.keys()


@pytest.mark.parametrize(
    ("version", "is_old"),
    [
        *(("3.11.0", True), ("3.9.1", True), ("2.3.7", True)),
        *(("3.17.0", False), ("3.100.0", False), ("4.0.0", False)),
    ],
)
def test_versions_of_mujoco_are_compared_as_numbers(monkeypatch, version, is_old):
    monkeypatch.setattr(importlib.metadata, "version", lambda name: {"mujoco": version}[name])
    problem = requirements.simulation_problem.__wrapped__()
    assert bool(problem) == is_old
    if is_old:
        assert problem.startswith(f"it needs MuJoCo 3.17 or newer, and {version} is installed.")
        assert "pip install codrl-mj" in problem


@pytest.mark.parametrize("package", requirements.SIMULATION_PACKAGES)
def test_a_missing_package_is_named(monkeypatch, package):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == package else find_spec(name)
    )
    problem = requirements.simulation_problem.__wrapped__()
    assert problem.startswith(f"{package} is not installed.")
    assert problem.endswith("pip install codrl-mj")


def test_without_numba_nothing_is_registered_and_the_environment_is_not_changed(
    tmp_path, monkeypatch
):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    environment = BareEnvironment(tmp_path)
    environment.link(["numpy", "pint", "pyyaml", "gymnasium", "mujoco"])
    environment.add_path(REPOSITORY)
    process = environment.run("-c", PROGRAM)
    assert process.returncode == 0, process.stderr
    answer = json.loads(process.stdout)
    remedy = requirements._REMEDY
    assert answer == {
        "ids": [],
        "loaded": [],
        "errors": [
            f"codrl_mj.{module} cannot be imported: numba is not installed. {remedy}"
            for module in ("factory", "engine.control")
        ],
        "backend": None,
    }
