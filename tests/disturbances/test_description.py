"""What can be said about disturbances, and what is refused."""

import dataclasses
import json

import gymnasium
import numpy as np
import pytest

import codrl_mj
from codrl_mj.cli import main
from codrl_mj.disturbances import OFF, Disturbances, resolve_disturbances
from codrl_mj.envs.config import EnvConfig
from tests.disturbances.everything import ALL

FIELDS = [field.name for field in dataclasses.fields(Disturbances)]


def test_everything_is_off_by_default_and_public():
    assert codrl_mj.Disturbances is Disturbances
    assert set(dataclasses.asdict(OFF).values()) == {0.0}
    assert not any((OFF.of_command, OFF.of_motor, OFF.of_joint, OFF.random))
    assert {*ALL} == {*FIELDS}


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "1", None, True, -1.0])
@pytest.mark.parametrize("field", FIELDS)
def test_a_bad_value_is_refused_by_name(field, value):
    if field == "current_bias" and value == -1.0 and value is not True:
        assert Disturbances(current_bias=-1.0).current_bias == -1.0
        return
    with pytest.raises(ValueError, match=rf"Disturbances\.{field} = .*: must be a finite number"):
        Disturbances(**{field: value})


def test_pulses_need_a_duration_and_an_interval_and_these_need_pulses():
    with pytest.raises(ValueError, match=r"pulse_duration = 0: must be a finite number > 0 where there are pulses"):
        Disturbances(pulse_force=1.0, pulse_interval=1.0)
    with pytest.raises(ValueError, match=r"pulse_interval = 0: must be a finite number > 0"):
        Disturbances(pulse_force=1.0, pulse_duration=1.0)
    with pytest.raises(ValueError, match=r"pulse_duration = 2: there are no pulses"):
        Disturbances(pulse_duration=2.0)


def test_a_mapping_is_as_good_and_its_unknown_fields_are_refused():
    assert resolve_disturbances(ALL) == Disturbances(**ALL)
    assert resolve_disturbances(Disturbances(**ALL).as_mapping()) == Disturbances(**ALL)
    assert resolve_disturbances(None) == OFF
    with pytest.raises(ValueError, match=r"unknown field disturbances\.comand_delay; did you mean command_delay\?"):
        resolve_disturbances({"comand_delay": 1})
    with pytest.raises(ValueError, match=r"disturbances = 3: must be a Disturbances or a mapping"):
        resolve_disturbances(3)


REFUSED = {
    "noise of an ideal actuator": ({"actuator": "ideal", "disturbances": {"current_noise": 0.1}}, "no current sensor"),
    "bias of an ideal actuator": ({"actuator": "ideal", "disturbances": {"current_bias": 0.1}}, "current_bias = 0.1"),
    "sag of an ideal actuator": ({"actuator": "ideal", "disturbances": {"supply_resistance": 1}}, "no supply"),
    "analytic damping": ({"physics": "analytic", "disturbances": {"joint_damping": 0.1}}, "use physics='mujoco'"),
    "analytic friction": ({"physics": "analytic", "disturbances": {"joint_friction": 0.1}}, "have neither"),
    "oscillating supply": (
        {"disturbances": {"supply_resistance": 3.0}},
        r"supply_resistance = 3: must be < .* = 3 ohm",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_simulated_is_refused_with_a_reason(case):
    arguments, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        gymnasium.make("codrl_mj/Pendulum-v0", **arguments)


def test_damping_given_twice_is_refused():
    randomize = {"model.damping.hinge": codrl_mj.Uniform(0.0, 0.1)}
    with pytest.raises(ValueError, match=r"joint_damping = 0\.1: give either"):
        gymnasium.make("codrl_mj/Pendulum-v0", randomize=randomize, disturbances={"joint_damping": 0.1})


def test_a_configuration_survives_json():
    config = EnvConfig(disturbances=Disturbances(**ALL))
    assert EnvConfig(**json.loads(json.dumps(dataclasses.asdict(config)))) == config
    assert config.as_arguments()["disturbances"] == Disturbances(**ALL)
    assert "disturbances" not in EnvConfig().as_arguments()


def test_the_command_line_takes_them_and_refuses_in_one_line(capsys, tmp_path):
    line = ["render", "pendulum", "--env.max-episode-steps", "3", "--width", "200", "--height", "120"]
    trajectories = []
    for name, flags in {"plain": [], "late": ["--env.disturbances.command-delay", "0.05"]}.items():
        files = ["--out", str(tmp_path / f"{name}.gif"), "--trajectory", str(tmp_path / f"{name}.npz")]
        assert main([*line, *files, *flags]) == 0
        trajectories.append(np.load(tmp_path / f"{name}.npz"))
    plain, late = trajectories
    np.testing.assert_array_equal(plain["action"], late["action"])
    assert late["reference_current"][0] == 0.0
    np.testing.assert_allclose(late["reference_current"][1:], plain["reference_current"][:-1], rtol=1e-12)
    capsys.readouterr()
    assert main([*line, "--env.disturbances.command-delay", "-1"]) == 2
    assert "Disturbances.command_delay = -1: must be a finite number >= 0" in capsys.readouterr().err
