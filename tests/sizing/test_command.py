"""The verbs of `codrl-mj motor`: output, files and refusals."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from codrl_mj.catalogue import motor_names
from codrl_mj.cli import main
from codrl_mj.sizing import DriveLimits, find_drive, find_entry
from codrl_mj.viz.pages.diagrams import torque_speed_diagram

OWN = """
manufacturer = "we"
product = "ours"
kind = "brushed"
[datasheet]
nominal_voltage = "12 V"
resistance = "2 ohm"
inductance = "1 mH"
torque_constant = "20 mN*m/A"
continuous_current = "1.5 A"
peak_current = "4 A"
[estimated]
inductance = "like others"
[sources]
"a page" = "the rest"
"""


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    """Run every test in an empty folder."""
    monkeypatch.chdir(tmp_path)


def printed_by(capsys, *arguments):
    assert main(["motor", *arguments]) == 0
    out, error = capsys.readouterr()
    assert error == ""
    return out


def read(capsys, *arguments):
    return json.loads(printed_by(capsys, *arguments, "--json"))


def is_png(path):
    return path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and path.stat().st_size > 20_000


def test_list_has_every_motor(capsys):
    text = printed_by(capsys, "list", "--sort", "stall_torque")
    assert max(map(len, map(str.rstrip, text.splitlines()[:-1]))) <= 80
    first = [
        line.split()[0]
        for line in text.splitlines()[5:]
        if line.split()[:1] and line.split()[0] in motor_names()
    ]
    assert sorted(first) == motor_names()
    assert first[0] == "heinzmann-pmg-132"
    assert "mN·m/A" in text
    content = read(capsys, "list")
    rows = content["motors"]
    assert content["units"]["stall_torque"] == "N*m"
    assert set(content["units"]) == rows[0].keys() - {"name", "kind"}
    assert [row["name"] for row in rows] == motor_names()
    assert set(DriveLimits._fields) < rows[0].keys()


def test_show_prints_the_source_of_every_number(capsys):
    text = " ".join(
        printed_by(
            capsys, "show", "pololu-37d-30", "--gear-ratio", "50", "--out", "pictures"
        ).split()
    )
    for part in (
        "Pololu 37D",
        "nominal_voltage / stall_current",
        "source 1: Pololu",
        "estimated:",
        "note:",
        "N*m*s/rad",
    ):
        assert part in text
    assert "motor.gear_ratio 50" in text
    assert "Not known: rotor inertia" in text
    assert is_png(Path("pictures/torque_speed.png"))
    content = read(capsys, "show", "rev-neo", "--voltage", "24")
    assert any("torque_constant" in number for number in content["disagreements"])
    assert {"name": "supply.voltage", "value": 24.0, "unit": "V"} in content["drive"]
    assert {row["name"]: row["value"] for row in content["abilities"]}[
        "mechanical_time_constant"
    ] is None


def test_show_accepts_a_custom_datasheet_and_any_drive(capsys):
    Path("own.toml").write_text(OWN)
    text = printed_by(capsys, "show", "own.toml", "--out", ".")
    parts = (
        "we ours, brushed",
        "Limits at the output, at 12 V",
        "assumed",
        "The motor, at its rotor",
        "source 1",
    )
    assert sorted(parts, key=text.index) == list(parts)
    content = read(capsys, "show", "own.toml")
    assert {row["name"]: row["value"] for row in content["abilities"]}[
        "stall_torque"
    ] == pytest.approx(0.12)
    assert "numbers" not in read(capsys, "show", "codrl_mj.actuators:Drive")


def test_show_prints_the_line_of_a_motor_without_a_winding(capsys):
    line = printed_by(capsys, "show", "unitree-go2")
    parts = ("Unitree Go2", "stall_torque", "36.73", "resistance is not printed", "note", "source")
    assert sorted(parts, key=line.index) == list(parts)
    content = read(capsys, "show", "unitree-go2")
    assert content["max_torque"] == pytest.approx(20.2)
    # Half of the stall torque at half of the no-load speed is the largest power.
    assert content["power"] == pytest.approx(20.2 * 1.8182 * 30.0 / 4.0)
    assert "unitree-go2" in read(capsys, "list")["torque_speed_lines"]
    for words in (["show", "unitree-go2", "--voltage", "12"], ["design", "unitree-go2"]):
        assert main(["motor", *words]) == 2
        message = capsys.readouterr().err
        assert "family torque_speed" in message
        assert "resistance is not printed" in message


def test_a_file_is_written_filled_in_and_shown(capsys):
    printed_by(capsys, "new", "mine.toml")
    assert main(["motor", "new", "mine.toml"]) == 2
    assert "mine.toml: already exists" in capsys.readouterr().err
    assert main(["motor", "show", "mine.toml"]) == 2
    assert "datasheet.resistance is not printed" in capsys.readouterr().err
    text = Path("mine.toml").read_text()
    for name, value in (
        ("kv", "340 RPM/V"),
        ("resistance", "64 mΩ"),
        ("inductance", "30 µH"),
        ("peak_current", "38 A"),
    ):
        text = text.replace(f'\n{name} = ""', f'\n{name} = "{value}"')
    Path("mine.toml").write_text(text)
    shown = printed_by(capsys, "show", "mine.toml")
    assert "mine.toml: mine\n" in shown
    assert "assumed, because not specified: supply.voltage = 24 V, motor.rotor_inertia = 0" in shown
    assert "-0.0%" not in shown
    content = {row["name"]: row["value"] for row in read(capsys, "show", "mine.toml")["abilities"]}
    assert content["peak_torque"] == pytest.approx(38.0 * 60.0 / (2.0 * np.pi * 340.0))


def test_design_prints_the_gains_and_the_margins(capsys):
    printed_by(capsys, "design", "quanser-qube-servo-2", "--bandwidth", "1500")
    arguments = (
        "design",
        "quanser-qube-servo-2",
        "--bandwidth",
        "2000",
        "--delayed",
        "--out",
        "pictures",
    )
    text = printed_by(capsys, *arguments)
    assert "20000 Hz, a sample of delay: kp = 8.98171 V/A, ki = 78374 V/(A·s)" in text
    assert re.search(r"\*20 +1 ", text)
    assert "not possible: SampledLoop.bandwidth = 2000: must be <= 1591.55 Hz" in text
    assert is_png(Path("pictures/bode.png"))
    content = read(capsys, *arguments)
    assert content["phase_margin"] == pytest.approx(49.53, abs=0.01)
    assert len(content["others"]) == 4
    assert not read(capsys, *arguments[:4], "--no-delayed")["delayed"]
    assert "a sample lasts" not in text
    slow = " ".join(
        printed_by(capsys, "design", "quanser-qube-servo-2", "--sample-rate", "2000").split()
    )
    assert "2000 Hz: a sample lasts 3.6 times the winding's L/R = 0.138 ms" in slow
    assert "take 2,414 Hz or more" in slow


def test_step_compares_all_kinds_of_anti_windup(capsys):
    text = printed_by(capsys, "step", "quanser-qube-servo-2", "--out", "pictures")
    for word in ("back_calculation", "clamping", "none", "undershoot", f"{0.2 * 18.0 / 8.4:.4f} A"):
        assert word in text
    assert is_png(Path("pictures/step.png"))
    content = read(capsys, "step", "quanser-qube-servo-2")
    assert content["saturated"]["recoveries"]["back_calculation"]["time"] < 1e-3
    assert content["small"]["settling_time"] == pytest.approx(0.6e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("show maxon-ec45-flat-50", "did you mean 'maxon-ec45-flat-50w'"),
        ("show ideal", "is not a drive"),
        ("step lag", "is not a drive"),
        ("show rev-neo --gear-ratio 0", "GearMotor.gear_ratio = 0.0: must be a finite number > 0"),
        ("design rev-neo --bandwidth 9000", "must be <= 3183.1 Hz at sample_rate = 20000 Hz"),
        (
            "design rev-neo --delayed --no-delayed",
            "--delayed and --no-delayed: use only one of them",
        ),
        ("show rev-neo --voltage 0.001 --out here", "a voltage that overcomes the friction"),
        ("show nothing.toml", "there is no such file; codrl-mj motor new nothing.toml writes one"),
        ("new nothing.txt", "nothing.txt: must end in .toml"),
    ],
)
def test_bad_input_prints_one_line_and_writes_nothing(capsys, arguments, message):
    assert main(["motor", *arguments.split()]) == 2
    error = capsys.readouterr().err
    assert error.startswith("codrl-mj: error: ")
    assert error.count("\n") == 1
    assert message in error
    assert not list(Path.cwd().iterdir())


def test_operating_points_are_drawn_in_the_diagram():
    points = np.array([[800.0, 0.1], [-20.0, 2.0]])
    drive, entry = find_drive("maxon-ec45-flat-50w"), find_entry("maxon-ec45-flat-50w")
    plot = torque_speed_diagram(drive, entry.parameters, points)
    curves = {curve.label: curve for curve in plot.curves}
    np.testing.assert_array_equal(
        np.column_stack([curves["operating points"].x, curves["operating points"].y]), points
    )
    limit = curves["continuous current, 2.52 A, highest"]
    assert limit.x.max() > 800.0
    assert plot.y_limit > 2.0
    assert "rad/s" in plot.x_label
    assert "N·m" in plot.y_label
    with pytest.raises(ValueError, match=r"points: shape \(3,\), must be \(n, 2\)"):
        torque_speed_diagram(drive, points=[1.0, 2.0, 3.0])


@pytest.mark.parametrize("verb", ["list", "show", "design", "step"])
def test_the_help_of_every_verb_has_an_example(capsys, verb):
    with pytest.raises(SystemExit) as process:
        main(["motor", verb, "--help"])
    assert process.value.code == 0
    assert f"Example: codrl-mj motor {verb}" in " ".join(capsys.readouterr().out.split())


def test_help_imports_no_large_library():
    program = (
        "import sys; from codrl_mj.cli import main\ntry: main(['motor', '--help'])\nexcept"
        " SystemExit: pass\nprint([name for name in ('matplotlib', 'control', 'pint', 'scipy',"
        " 'numba', 'torch') if name in sys.modules])"
    )
    process = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    assert process.stdout.splitlines()[-1] == "[]"
