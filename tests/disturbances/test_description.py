"""Settings of disturbances and joints, and errors."""

import dataclasses
import re

import gymnasium
import pytest

import codrl_mj
from codrl_mj.disturbances import NO_DISTURBANCES, UNMODIFIED_JOINT, Disturbances, Joint, resolve
from tests.disturbances.everything import MOST, RUBBED

FIELDS = [
    (kind, field.name) for kind in (Disturbances, Joint) for field in dataclasses.fields(kind)
]


def test_all_disturbances_are_off_by_default_and_public():
    assert codrl_mj.Disturbances is Disturbances
    assert codrl_mj.Joint is Joint
    assert {
        *dataclasses.asdict(NO_DISTURBANCES).values(),
        *dataclasses.asdict(UNMODIFIED_JOINT).values(),
    } == {0.0}
    assert not NO_DISTURBANCES.random
    assert {*MOST, *RUBBED} == {name for _, name in FIELDS}


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "1", None, True, -1.0])
@pytest.mark.parametrize(("kind", "field"), FIELDS)
def test_raises_with_the_name_of_an_invalid_field(kind, field, value):
    with pytest.raises(
        ValueError, match=rf"{kind.__name__}\.{field} = .*: must be a finite number >= 0"
    ):
        kind(**{field: value})


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"pulse_force": 1.0, "pulse_interval": 1.0},
            "pulse_duration = 0: must be a finite number > 0 where there",
        ),
        (
            {"pulse_force": 1.0, "pulse_duration": 1.0},
            "pulse_interval = 0: must be a finite number > 0",
        ),
        ({"pulse_duration": 2.0}, "pulse_duration = 2: there are no pulses"),
    ],
)
def test_pulses_need_a_duration_and_an_interval_and_vice_versa(fields, message):
    with pytest.raises(ValueError, match=message):
        Disturbances(**fields)


@pytest.mark.parametrize(
    ("kind", "default", "setting"),
    [(Disturbances, NO_DISTURBANCES, MOST), (Joint, UNMODIFIED_JOINT, RUBBED)],
)
def test_a_mapping_of_fields_is_equivalent(kind, default, setting):
    full = kind(**setting)
    assert (
        resolve(setting, default)
        == resolve(full, default)
        == resolve(dataclasses.asdict(full), default)
        == full
    )
    assert resolve(None, default) == default


@pytest.mark.parametrize(
    ("setting", "default", "message"),
    [
        (
            {"comand_delay": 1},
            NO_DISTURBANCES,
            "unknown field disturbances.comand_delay; did you mean disturbances.command_delay?",
        ),
        (
            {"frictoin": 1},
            UNMODIFIED_JOINT,
            "unknown field joint.frictoin; did you mean joint.friction?",
        ),
        (3, NO_DISTURBANCES, "'disturbances' = 3: must be a mapping of Disturbances's fields"),
        (3, UNMODIFIED_JOINT, "'joint' = 3: must be a mapping of Joint's fields"),
    ],
)
def test_raises_if_a_setting_is_invalid(setting, default, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        resolve(setting, default)


@pytest.mark.parametrize("make", [gymnasium.make, codrl_mj.make, codrl_mj.make_vec])
def test_raises_if_a_delay_exceeds_the_episode(make):
    env = "codrl_mj/Pendulum-v0" if make is gymnasium.make else "pendulum"
    with pytest.raises(
        ValueError, match=r"command_delay = 20: must be < 10 s, .*for 20 ms write 0\.02"
    ):
        make(env, actuator="ideal", disturbances={"command_delay": 20})


@pytest.mark.filterwarnings("default::UserWarning")
def test_warns_if_a_delay_exceeds_many_steps():
    for env in ("pendulum", "HalfCheetah-v5"):
        with pytest.warns(
            UserWarning,
            match=r"command_delay = 5: a delay of 100 environment steps; .* write 0\.005",
        ):
            codrl_mj.make(env, "ideal", disturbances={"command_delay": 5})
