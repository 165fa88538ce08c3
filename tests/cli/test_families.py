"""Actuators of any family on the command line, and custom families and models."""

import dataclasses
import importlib
import sys
from pathlib import Path

import gymnasium
import pytest

from codrl_mj import register
from codrl_mj.actuators import Lag
from codrl_mj.envs.config import EnvConfig
from codrl_mj.tasks import find_task
from codrl_mj.training import TrainConfig, folder, load_config
from tests.cli.lines import SMALL_FILM, TINY, assert_refused, help_text, read_json, run_ok

OWN_FAMILY = """
import dataclasses
from pathlib import Path

from codrl_mj.actuators import Lag
from codrl_mj.fields import real

Path("executed").touch()


@dataclasses.dataclass(frozen=True)
class Slow(Lag):
    family = "slow"

    time_constant: float = real(0.5, minimum=0.0, unit="s")
    \"\"\"Half a second, if nothing else is said.\"\"\"
"""


@pytest.fixture
def own_family(tmp_path, monkeypatch):
    """Write a module with a custom family; yield a function that removes it from `sys.modules`."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "own_family.py").write_text(OWN_FAMILY)
    monkeypatch.syspath_prepend(str(tmp_path / "modules"))

    def unload():
        sys.modules.pop("own_family", None)
        (tmp_path / "executed").unlink(missing_ok=True)

    yield unload
    unload()


@pytest.mark.parametrize("first", ["train cartpole", "evaluate RUN", "render RUN"])
def test_flags_are_those_of_the_named_family(capsys, first, trained, own_family):
    for actuator, flags in {
        "lag": ("--actuator.time-constant", "--actuator.delay"),
        "torque_speed": (
            "--actuator.stall-torque",
            "--actuator.no-load-speed",
            "--actuator.max-torque",
        ),
        "weaker": ("--actuator.motor.inductance", "--actuator.supply.resistance"),
        "own_family:Slow": ("--actuator.time-constant", "Half a second"),
    }.items():
        text = help_text(
            capsys, *first.replace("RUN", str(trained)).split(), "--actuator", actuator
        )
        assert [flag for flag in flags if flag not in text] == []
        assert ("--actuator.motor" in text) == (actuator == "weaker")


def test_flags_set_the_fields_of_a_family():
    run_ok(
        f"train cartpole --actuator lag --actuator.time-constant 0.1 --actuator.delay 0.02 {TINY}"
        " --out run"
    )
    assert load_config(Path("run")).actuator == Lag(0.1, 0.02)
    run_ok("evaluate run --episodes 1 --out e.json --actuator.delay 0.04")
    described = {"family": "lag", "time_constant": 0.1, "delay": 0.04, "gain": 1.0}
    assert read_json("e.json")["conditions"]["env"]["actuator"] == described
    Path("slow.yaml").write_text("{family: lag, time_constant: 0.3}")
    for subject in ("run", "pendulum --actuator slow.yaml"):
        run_ok(f"render {subject} --actuator.delay 0.05 --out film.gif {SMALL_FILM}")


def test_a_module_named_by_a_run_is_imported_only_with_trust(capsys, own_family):
    run_ok(f"train pendulum --actuator own_family:Slow {TINY} --out run")
    own_family()
    for line in (
        "evaluate run --episodes 1",
        "render run",
        "train --resume run",
        "train --config run/config.json",
    ):
        assert "own_family:Slow': needs the module own_family" in assert_refused(capsys, line)
    run_ok("runs . --out runs.json")
    assert [run["actuator"] for run in read_json("runs.json")["runs"]] == ["own_family:Slow"]
    assert not Path("executed").exists()
    run_ok("evaluate run --episodes 1 --trust --actuator.delay 0.05")
    assert Path("executed").exists()


def code_digests(env):
    """Return the digests of code that a run folder stores."""
    # The digest is cached for the life of a process, and import caches may miss a file that was
    # just changed.
    importlib.invalidate_caches()
    folder._code_digest.cache_clear()
    code = folder.provenance(TrainConfig(env))["code"]
    folder._code_digest.cache_clear()
    return code


def test_provenance_includes_the_source_of_a_custom_family(own_family, tmp_path):
    digests = {code_digests(EnvConfig("pendulum"))}
    for text in (OWN_FAMILY, OWN_FAMILY.replace("0.5", "0.6")):
        own_family()
        (tmp_path / "modules" / "own_family.py").write_text(text)
        digests.add(code_digests(EnvConfig("pendulum", "own_family:Slow")))
    assert len(digests) == 3


def test_provenance_includes_the_file_of_a_custom_model(tmp_path):
    arm, path = find_task("tests.own_project.arm:TASK"), tmp_path / "arm.xml"
    path.touch()
    register(
        dataclasses.replace(arm, name="copied_arm", env_id="tests/CopiedArm-v0", asset=str(path))
    )
    custom, third_party = (
        EnvConfig("copied_arm", "lag"),
        EnvConfig("HalfCheetah-v5", options={"xml_file": str(path)}),
    )
    digests = set()
    model = (Path(gymnasium.__file__).parent / "envs/mujoco/assets/half_cheetah.xml").read_text()
    for text in (model, f"{model}<!-- changed -->"):
        path.write_text(text)
        digests |= {code_digests(custom), code_digests(third_party)}
    assert len(digests) == 4


def test_an_environment_registered_by_a_file_is_named_by_file_and_id(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    entry = "gymnasium.envs.mujoco.inverted_pendulum_v5:InvertedPendulumEnv"
    registers = f"gymnasium.register('my/Arm-v0', entry_point='{entry}', max_episode_steps=60)"
    Path("armenv.py").write_text(f"import gymnasium\n\n{registers}\n")
    configs = []
    monkeypatch.setattr("codrl_mj.training.train", lambda config, *_, **__: configs.append(config))
    run_ok(f"train armenv.py:my/Arm-v0 {TINY}")
    assert configs[0].env.task == "armenv:my/Arm-v0"
    assert "there is no such file" in assert_refused(capsys, "train armenvs.py:my/Arm-v0")
