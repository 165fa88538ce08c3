"""What can be said about disturbances, and what is refused."""

import dataclasses
import json

import gymnasium
import numpy as np
import pytest

import codrl_mj
from codrl_mj.cli import main
from codrl_mj.disturbances import OFF, PLAIN, Disturbances, Joint, resolve
from codrl_mj.envs.config import EnvConfig
from tests.disturbances.everything import MOST, RUBBED

FIELDS = [field.name for field in dataclasses.fields(Disturbances)]
JOINT_FIELDS = [field.name for field in dataclasses.fields(Joint)]


def test_everything_is_off_by_default_and_public():
    assert codrl_mj.Disturbances is Disturbances
    assert codrl_mj.Joint is Joint
    assert {*dataclasses.asdict(OFF).values(), *dataclasses.asdict(PLAIN).values()} == {0.0}
    assert not OFF.random
    assert {*MOST} == {*FIELDS}
    assert {*RUBBED} == {*JOINT_FIELDS}


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "1", None, True, -1.0])
@pytest.mark.parametrize(
    ("kind", "field"), [(kind, field.name) for kind in (Disturbances, Joint) for field in dataclasses.fields(kind)]
)
def test_a_bad_value_is_refused_by_name(kind, field, value):
    with pytest.raises(ValueError, match=rf"{kind.__name__}\.{field} = .*: must be a finite number >= 0"):
        kind(**{field: value})


def test_pulses_need_a_duration_and_an_interval_and_these_need_pulses():
    with pytest.raises(ValueError, match=r"pulse_duration = 0: must be a finite number > 0 where there are pulses"):
        Disturbances(pulse_force=1.0, pulse_interval=1.0)
    with pytest.raises(ValueError, match=r"pulse_interval = 0: must be a finite number > 0"):
        Disturbances(pulse_force=1.0, pulse_duration=1.0)
    with pytest.raises(ValueError, match=r"pulse_duration = 2: there are no pulses"):
        Disturbances(pulse_duration=2.0)


def test_a_mapping_is_as_good_and_its_unknown_fields_are_refused():
    assert resolve(MOST, OFF) == Disturbances(**MOST)
    assert resolve(dataclasses.asdict(Disturbances(**MOST)), OFF) == Disturbances(**MOST)
    assert resolve(None, OFF) == OFF
    with pytest.raises(
        ValueError, match=r"unknown field disturbances\.comand_delay; did you mean disturbances\.command_delay\?"
    ):
        resolve({"comand_delay": 1}, OFF)
    with pytest.raises(ValueError, match=r"'disturbances' = 3: must be a mapping of Disturbances's fields"):
        resolve(3, OFF)
    assert resolve(RUBBED, PLAIN) == resolve(Joint(**RUBBED), PLAIN) == Joint(**RUBBED)
    assert resolve(None, PLAIN) == PLAIN
    with pytest.raises(ValueError, match=r"unknown field joint\.frictoin; did you mean joint\.friction\?"):
        resolve({"frictoin": 1}, PLAIN)
    with pytest.raises(ValueError, match=r"'joint' = 3: must be a mapping of Joint's fields"):
        resolve(3, PLAIN)


REFUSED = {
    "noise of an ideal actuator": (
        {"actuator": {"family": "ideal", "controller": {"current_noise": 0.1}}},
        "unknown actuator field controller",
    ),
    "sag of an ideal actuator": (
        {"actuator": {"family": "ideal", "supply": {"resistance": 1}}},
        "unknown actuator field supply",
    ),
    "analytic damping": ({"physics": "analytic", "joint": {"damping": 0.1}}, "use physics='mujoco'"),
    "analytic friction": ({"physics": "analytic", "joint": {"friction": 0.1}}, "no place for it"),
    "analytic armature": ({"physics": "analytic", "joint": {"armature": 0.1}}, r"joint\.armature = 0\.1"),
    "oscillating supply": (
        {"actuator": {"supply": {"resistance": 3.0}}},
        r"supply\.resistance = 3: must be < .* = 3 ohm",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_simulated_is_refused_with_a_reason(case):
    arguments, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        gymnasium.make("codrl_mj/Pendulum-v0", **arguments)


def test_a_configuration_survives_json():
    config = EnvConfig("pendulum", disturbances=Disturbances(**MOST), joint=Joint(**RUBBED))
    assert EnvConfig.from_mapping(json.loads(json.dumps(config.as_mapping()))) == config
    assert config.as_arguments()["disturbances"] == Disturbances(**MOST)
    assert config.as_arguments()["joint"] == Joint(**RUBBED)
    assert not {"disturbances", "joint"} & {*EnvConfig("pendulum").as_arguments()}


@pytest.mark.matrix
def test_the_command_line_takes_them_and_refuses_in_one_line(capsys, tmp_path):
    line = ["render", "pendulum", "--env.max-episode-steps", "3", "--width", "200", "--height", "120"]
    trajectories = []
    for name, flags in {"plain": [], "late": ["--env.disturbances.command-delay", "0.05"]}.items():
        files = ["--out", str(tmp_path / f"{name}.gif"), "--trajectory", str(tmp_path / f"{name}.npz")]
        assert main([*line, *files, *flags]) == 0
        trajectories.append(np.load(tmp_path / f"{name}.npz"))
    plain, late = trajectories
    np.testing.assert_array_equal(plain["action"], late["action"])
    assert late["signals/reference_current"][0] == 0.0
    np.testing.assert_allclose(
        late["signals/reference_current"][1:], plain["signals/reference_current"][:-1], rtol=1e-12
    )
    capsys.readouterr()
    assert main([*line, "--env.disturbances.command-delay", "-1"]) == 2
    assert "Disturbances.command_delay = -1.0: must be a finite number >= 0" in capsys.readouterr().err
