"""The examples of docs/arrays.md for other simulators run."""

import re
import shutil
import warnings
from pathlib import Path

import pytest

from tests.arrays.models import CHEETAH

ROOT = Path(__file__).parents[2]
BLOCKS = re.findall(r"```py\n(.*?)```", (ROOT / "docs" / "arrays.md").read_text(), re.DOTALL)


@pytest.mark.parametrize("package", ["mujoco_warp", "mjlab"])
def test_the_example_of_a_simulator_runs(package, tmp_path, monkeypatch, capsys):
    pytest.importorskip("warp", reason="NOT RUN: Warp is not installed: make simulators")
    pytest.importorskip(package, reason=f"NOT RUN: {package} is not installed: make simulators")
    (block,) = [
        block for block in BLOCKS if f"import {package}" in block or f"{package}.entity" in block
    ]
    shutil.copy(CHEETAH, tmp_path / "half_cheetah.xml")
    shutil.copy(ROOT / "tests" / "arrays" / "gearbox.py", tmp_path / "my_gearbox.py")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    with warnings.catch_warnings():
        # The model has dynamics of its own beside those of its motors.
        warnings.simplefilter("ignore")
        names: dict[str, object] = {}
        exec(block, names)
    if package == "mujoco_warp":
        assert capsys.readouterr().out.endswith("(64, 3)\n")
    else:
        (cfg,) = names["articulation"].actuators
        actuator = cfg.build(None, [0], ["front_hip"])
        assert actuator.motor.motor.gear_ratio == 9.0
