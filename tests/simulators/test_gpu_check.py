"""The check for a GPU runs on a CPU, and says what it left out there."""

import json

import pytest

pytest.importorskip("warp", reason="NOT RUN: Warp is not installed: make simulators")
pytest.importorskip("mujoco_warp", reason="NOT RUN: no mujoco_warp: make simulators")
# The script imports Warp.
import gpu_check

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def test_the_dry_run(tmp_path, monkeypatch, capsys):
    out = tmp_path / "results.json"
    monkeypatch.setattr("sys.argv", ["gpu_check.py", "--device", "cpu", "--out", str(out)])
    assert gpu_check.main() == 0
    printed = capsys.readouterr().out
    results = json.loads(out.read_text())
    assert not results["is_gpu"]
    assert "NOT DONE: no GPU was used" in printed
    assert "not a CUDA graph" in " ".join(results["not_done"])
    assert results["sizes"]["worlds"] < gpu_check.FULL.worlds
    assert len(results["kernel_errors"]) == 8
    assert 0.0 < results["pendulum_error_rad"] < gpu_check.PENDULUM_BAR
    times = results["cheetah_step"]
    assert list(times) == ["without motors", "six motors, double", "six motors, float"]
    # On a CPU, a captured step computes exactly what a launched one does.
    assert all(entry["gap"] == 0.0 < entry["captured_ms"] for entry in times.values())


def test_a_wrong_kernel_is_noticed(monkeypatch):
    actuator = gpu_check.motors()["drive"]
    assert gpu_check.kernel_error(actuator, "double", 20, "cpu") < 1e-12
    compiled_advance = gpu_check.compiled_advance

    def other_advance(family):
        advance = compiled_advance(family)

        def with_error(*arguments):
            state, torque, signals = advance(*arguments)
            return state, torque * (1.0 + 1e-6), signals

        return with_error

    monkeypatch.setattr(gpu_check, "compiled_advance", other_advance)
    assert gpu_check.kernel_error(actuator, "double", 20, "cpu") > gpu_check.BARS["double"]


def test_a_machine_without_the_device_is_told(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["gpu_check.py", "--device", "cuda:77"])
    with pytest.raises(SystemExit):
        gpu_check.main()
    assert "--device cuda:77: " in capsys.readouterr().err
