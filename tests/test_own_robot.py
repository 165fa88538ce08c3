"""The code and commands of docs/own_robot.md work as printed, and the robot is as described."""

import dataclasses
import math
import re
import shlex
import shutil
import sys
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.cli import main

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "examples" / "own_robot"
PAGE = (ROOT / "docs" / "own_robot.md").read_text()
BLOCKS = re.findall(r"```(xml|python)\n(.*?)```", PAGE, re.DOTALL)
FILES, COMMANDS = BLOCKS[:2], re.findall(r"^\$ codrl-mj (.*)$", PAGE, re.MULTILINE)
SHORT = {"100000": "512", "50": "1"}
"""Numbers in the page's commands -> smaller ones for the tests."""


@pytest.fixture(autouse=True)
def robot_files(tmp_path, monkeypatch):
    """Copy the two files into a new folder, from which Python imports them again."""
    shutil.copytree(FOLDER, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "ball_and_beam", raising=False)
    yield
    sys.modules.pop("ball_and_beam", None)


def test_the_page_has_the_whole_task_and_the_actuator_of_the_model():
    kinds, (part, module) = zip(*FILES, strict=True)
    assert kinds == ("xml", "python")
    assert module == (FOLDER / "ball_and_beam.py").read_text()
    assert "<motor" in part
    assert part in (FOLDER / "ball_and_beam.xml").read_text()


def test_the_page_has_every_field_of_a_task():
    named = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`.*?) \|", PAGE, re.MULTILINE))))
    assert named == {field.name for field in dataclasses.fields(codrl_mj.Task)}


def test_the_python_examples_run(capsys):
    namespace = {}
    for _, block in BLOCKS[2:]:
        # The blocks continue each other.
        exec(compile(block, "own_robot.md", "exec"), namespace)
    single_output, batch_output, randomization_output = capsys.readouterr().out.splitlines()
    desired, actual, _, voltage = map(float, single_output.split())
    # The gear transmits only a part of the torque.
    assert 0.0 < abs(actual) < abs(desired)
    assert abs(voltage) <= 6.0
    assert batch_output == "(4096, 4) (4096,)"
    assert "model.mass.ball" in randomization_output
    namespace["envs"].close()


def run(*commands):
    for command in commands:
        assert main([SHORT.get(word, word) for word in shlex.split(command)]) == 0


def test_the_training_runs():
    run(COMMANDS[0])
    assert Path("runs/ball/policy.safetensors").is_file()


@pytest.mark.matrix
def test_all_commands_run_one_after_the_other():
    run(*COMMANDS)
    assert [command.split()[0] for command in COMMANDS] == [
        "train",
        "evaluate",
        "evaluate",
        "render",
        "validate",
    ]
    assert Path("ball.gif").stat().st_size > 1000


def test_the_ball_rolls_like_a_solid_ball():
    """Compare with 5/7 g sin(angle), the acceleration of a solid ball on a beam that is held."""
    model = mujoco.MjModel.from_xml_path("ball_and_beam.xml")
    data = mujoco.MjData(model)
    data.qpos[:] = 0.3, 0.1
    mujoco.mj_forward(model, data)
    force = np.zeros(2)
    # The force for a unit acceleration of the ball, if the beam does not accelerate.
    mujoco.mj_mulM(model, data, force, np.array([0.0, 1.0]))
    assert -data.qfrc_bias[1] / force[1] == pytest.approx(5 / 7 * 9.81 * math.sin(0.3), rel=1e-12)


def test_fields_that_a_task_omits_are_derived():
    import ball_and_beam

    task = ball_and_beam.TASK
    assert (task.qpos, task.qvel, task.render_fps, task.options()) == ((0, 1), (2, 3), 50, ())
    assert task.action_space == gymnasium.spaces.Box(np.float32(-0.4), np.float32(0.4), (1,))
    assert task.observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (4,))
