"""The page docs/train_elsewhere.md follows from its rows, and its files are as described."""

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
import yaml

import codrl_mj
from codrl_mj import cli
from codrl_mj.catalogue import motor_entry

ROOT = Path(__file__).parent.parent
EXAMPLE = ROOT / "examples" / "train_elsewhere"
PAGE = (ROOT / "docs" / "train_elsewhere.md").read_text()
TEXT = " ".join(PAGE.split())


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Copy the example into a new folder, from which Python imports its modules."""
    shutil.copytree(EXAMPLE, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    before = {*sys.modules}
    yield tmp_path
    for name in {path.stem for path in EXAMPLE.glob("*.py")} - before:
        sys.modules.pop(name, None)
    gymnasium.registry.pop("SwingUp-v0", None)


def test_the_page_has_the_tables_of_its_rows(folder):
    import results

    rows = results.read_rows(ROOT / "docs" / "train_elsewhere.csv")
    assert results.table(rows) in PAGE
    gaps, spreads = {}, {}
    for trained in ("ideal", "motor"):
        for tested in ("ideal", "motor"):
            group = [
                row for row in rows if (row["trained on"], row["tested on"]) == (trained, tested)
            ]
            assert len(group) == 5
            gaps[trained, tested] = max(float(row["largest gap of an episode"]) for row in group)
            spreads[trained, tested] = np.ptp([float(row["ours"]) for row in group])
            # The simulators differ by much less than the seeds.
            means = [abs(float(row["MJX"]) - float(row["ours"])) for row in group]
            assert max(means) < 0.01 * spreads[trained, tested]
    assert f"differs by at most {max(gaps.values()):.3f}" in TEXT
    on_motor = max(gap for (_, tested), gap in gaps.items() if tested == "motor")
    assert f"on the motor by at most {on_motor:.3f}" in TEXT
    assert f"trained through the motor differ by {spreads['motor', 'motor']:.1f}" in TEXT
    curves = results.read_rows(ROOT / "docs" / "train_elsewhere_curves.csv")
    assert {(row["trained on"], row["seed"]) for row in curves} == {
        (row["trained on"], row["seed"]) for row in rows
    }


def test_the_page_quotes_the_files():
    (datasheet,), (settings,) = (
        re.findall(rf"```{kind}\n(.*?)```", PAGE, re.DOTALL) for kind in ("toml", "yaml")
    )
    assert datasheet in (EXAMPLE / "motor.toml").read_text()
    assert settings in (EXAMPLE / "actuators.yaml").read_text()
    entry, _, _ = blocks = re.findall(r"```py\n(.*?)```", PAGE, re.DOTALL)
    assert entry in (EXAMPLE / "step_mjlab.py").read_text()
    for line in blocks[1].split("...\n"):
        assert line in (EXAMPLE / "swing_up_mjx.py").read_text()


def test_the_motor_is_that_of_the_catalogue_and_too_weak_to_hold_the_rod(folder):
    parameters = motor_entry("motor.toml").parameters
    assert parameters == motor_entry("quanser-srv02").parameters
    model = mujoco.MjModel.from_xml_path("rod.xml")
    data = mujoco.MjData(model)
    data.qpos[0] = math.pi / 2
    mujoco.mj_forward(model, data)
    assert f"{data.qfrc_bias[0]:.2f} N·m to be held level" in TEXT
    speed = math.sqrt(4.0 * data.qfrc_bias[0] / model.dof_M0[0])
    assert f"passes the bottom at {speed:.0f} rad/s" in TEXT


def test_the_environment_takes_the_motor(folder):
    env = codrl_mj.make("swing_up:SwingUp-v0", yaml.safe_load(Path("actuators.yaml").read_text()))
    observation, _ = env.reset(seed=3)
    total, is_truncated, num_steps = 0.0, False, 0
    while not is_truncated:
        observation, reward, _, is_truncated, info = env.step([0.48])
        total, num_steps = total + reward, num_steps + 1
        assert abs(info["voltage"]) <= 5.0
    env.close()
    assert observation.dtype == np.float32
    assert num_steps == 200
    assert "is_success" in info
    assert -100.0 < total < 200.0


@pytest.mark.parametrize("line", re.findall(r"^\$ codrl-mj (.*)$", PAGE, re.MULTILINE))
def test_a_command_of_the_page_is_parsed(line, monkeypatch, folder):
    parsed = []
    for verb in map(cli.find_verb, cli.VERBS):
        monkeypatch.setattr(verb, "run", lambda self: parsed.append(self) or 0)
    assert cli.main(shlex.split(line)) == 0
    assert len(parsed) == 1
