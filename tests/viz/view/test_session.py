"""A session does what MuJoCo does, and what cannot be simulated is not."""

import dataclasses
import shutil
import signal
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np
import pytest

from codrl_mj.actuators import DCMotorActuator
from codrl_mj.cli import main
from codrl_mj.envs.config import EnvConfig
from codrl_mj.viz.view.session import PUSH_DURATION, Session, controls

POLE, MOTOR = "InvertedPendulum-v5", "maxon-re65"


def session(motor=MOTOR, policies=(), **arguments):
    made = Session(
        EnvConfig.from_mapping({"task": POLE, "actuator": {".*": motor}, **arguments}),
        dict(policies),
    )
    made.choose("zero")
    made.auto_reset = False
    return made


@pytest.fixture(scope="module")
def motors_added():
    return session()


@pytest.mark.parametrize("again", [True, False])
def test_at_the_time_limit_it_says_so_and_begins_anew_or_goes_on(again):
    made = session("ideal", max_episode_steps=3)
    made.auto_reset = again
    said = [made.step() and made.ended for _ in range(4)]
    assert said[:3] == ["", "", "past the time limit"]
    assert made.time == pytest.approx((1 if again else 4) * made.recorder.step_duration)
    assert said[3] == ("" if again else "past the time limit")


def test_a_push_is_a_force_at_the_bodys_centre_of_mass():
    made = session("ideal")
    model, data = made.model, mujoco.MjData(made.model)
    data.qpos[:], data.qvel[:] = made.data.qpos, made.data.qvel
    made.push("pole", 3.0)
    lasts = (
        int(np.ceil(PUSH_DURATION / model.opt.timestep / 2)) * 2
    )  # whole environment steps of two integration steps
    for step in range(10):
        assert made.step()
        for inner in range(2):
            data.xfrc_applied[model.body("pole").id, 0] = 3.0 if 2 * step + inner < lasts else 0.0
            mujoco.mj_step(model, data)
    assert abs(data.qvel).max() > 0.1
    np.testing.assert_array_equal(made.data.qpos, data.qpos)


def test_signals_are_those_of_every_integration_step(motors_added):
    motors_added.reset()
    for _ in range(5):
        motors_added.step()
    times = [when for when, _ in motors_added.signals]
    np.testing.assert_allclose(times, 0.02 * np.arange(1, 11), atol=1e-12)
    assert motors_added.signals[-1][1].shape == (1, len(motors_added.recorder.trace_names))
    assert motors_added.time == pytest.approx(0.2)


def test_a_setting_goes_into_the_simulation_and_the_motion_goes_on(motors_added):
    motors_added.reset()
    motors_added.step()
    before = motors_added.data.qpos.copy(), motors_added.data.qvel.copy()
    motors_added.set_actuator(".*", ("supply", "voltage"), 7.0)
    assert not motors_added.is_stopped
    np.testing.assert_array_equal((motors_added.data.qpos, motors_added.data.qvel), before)
    motors_added.choose("random")
    for _ in range(20):
        motors_added.step()
    voltages = [
        row[0, motors_added.recorder.trace_names.index("voltage")]
        for _, row in motors_added.signals
    ]
    assert np.abs(voltages).max() == pytest.approx(7.0)
    motors_added.choose("zero")
    motors_added.set_disturbance(("command_delay",), 0.04)
    assert motors_added.env.get_wrapper_attr("spec") is not None
    assert motors_added.config.disturbances.command_delay == 0.04


def test_what_is_unstable_is_said_and_not_simulated(motors_added):
    motors_added.reset()
    motors_added.set_actuator(".*", ("controller", "kp"), 1e6)
    assert "unstable: spectral radius" in motors_added.problem
    state = motors_added.data.qpos.copy()
    assert not motors_added.step()
    np.testing.assert_array_equal(motors_added.data.qpos, state)
    motors_added.set_actuator(".*", ("motor", "resistance"), -1.0)
    assert "resistance = -1.0: must be" in motors_added.problem
    motors_added.set_actuator(".*", ("controller", "kp"), 0.0)
    assert motors_added.problem is None
    assert motors_added.step()


@pytest.mark.parametrize(
    "anew", [Session.reset, lambda made: made.set_disturbance(("command_delay",), 0.04)]
)
def test_a_simulation_that_left_the_numbers_waits_for_a_reset_or_another_setting(anew):
    made = session("ideal")
    assert made.step()
    made.data.qvel[:] = np.nan
    assert not made.step()
    assert made.is_stopped
    anew(made)
    assert not made.is_stopped
    assert (made.time, made.total) == (0.0, 0.0)
    np.testing.assert_array_equal(made.observation, np.append(made.data.qpos, made.data.qvel))
    assert made.step()
    assert np.isfinite(made.data.qpos).all()


def test_a_force_of_somebody_elses_stays():
    """MuJoCo's own viewer writes the mouse's push between two steps."""
    made = session("ideal")
    pole = made.model.body("pole").id
    made.data.xfrc_applied[pole, 0] = 3.0
    made.data.qpos[:] = made.data.qvel[:] = 0.0
    made.step()
    assert made.data.qvel[0] > 0.0
    assert made.data.xfrc_applied[pole, 0] == 3.0
    made.reset()
    assert not made.data.xfrc_applied.any()


def test_a_policy_for_another_environment_is_refused(motors_added):
    class Wide:
        def predict(self, observation, **_):
            return np.zeros((len(observation), 5)), None

    motors_added.policies["wide"] = Wide
    with pytest.raises(ValueError, match="policy wide: its actions"):
        motors_added.choose("wide")
    assert motors_added.policy_name == "zero"


def test_controls_are_the_fields_with_their_bounds_and_units(motors_added):
    actuator = motors_added.config.driven[".*"]
    found = {one.path: one for one in controls(actuator, 48.0)}
    resistance = found["motor", "resistance"]
    assert resistance.unit == "ohm"
    assert resistance.value == actuator.motor.resistance
    assert 0 < resistance.low < resistance.value < resistance.high
    assert found["motor", "gear_efficiency"].high == 1.0  # its bound, not four times its value
    assert found["controller", "anti_windup"].options == ("back_calculation", "clamping", "none")
    assert found["controller", "delayed"].value is False
    for path, one in found.items():
        part = getattr(actuator, path[0]) if len(path) > 1 else actuator
        fields = {field.name: field for field in dataclasses.fields(part)}
        for end in (
            (one.low, one.high) if None not in (one.low, one.high) else ()
        ):  # both can be set
            holds, *_ = fields[path[-1]].metadata["bound"]
            assert holds(type(one.value)(one.from_slider(end))), path


def test_an_endless_voltage_ends_at_the_end_of_its_slider():
    voltage = {one.path: one for one in controls(DCMotorActuator(), 48.0)}["supply", "voltage"]
    assert voltage.high == 48.0
    assert voltage.from_slider(48.0) == np.inf
    assert voltage.from_slider(12.0) == 12.0
    assert ("supply", "voltage") not in [one.path for one in controls(DCMotorActuator())]


class Shown:
    """Takes the place of a browser; what it is given, and what is done with it."""

    url = "http://127.0.0.1:0"
    seen: ClassVar = []

    def __init__(self, session, _port, title):  # noqa: D107
        self.session, self.title, self.done = session, title, []
        self.seen.append(self)

    def run(self, until):
        self.done.append(f"asked to end: {until()}")
        assert self.session.step()

    def close(self):
        self.done.append("closed")


def test_a_ctrl_c_waits_for_the_end_of_a_step_and_closes_the_server(monkeypatch, capsys):
    class Interrupted(Shown):
        def run(self, until):
            signal.raise_signal(signal.SIGINT)
            super().run(until)

    monkeypatch.setattr("codrl_mj.viz.view.browser.Browser", Interrupted)
    assert main(["view", "cartpole"]) == 130
    assert Shown.seen.pop().done == ["asked to end: True", "closed"]
    assert "stopped" in capsys.readouterr().err


def test_the_command_line_offers_the_runs_policy_and_those_of_others(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("codrl_mj.viz.view.browser.Browser", Shown)
    run = Path(__file__).parents[2] / "fixtures" / "runs" / "cartpole"
    other = shutil.copytree(run, tmp_path / "other" / "cartpole")
    assert main(["view", str(run), "--policies", str(run), str(other), "--actuator", "weaker"]) == 0
    shown = Shown.seen.pop()
    assert (shown.title, shown.done) == ("cartpole on weaker", ["asked to end: False", "closed"])
    names = [
        "last",
        "runs/cartpole",
        "other/cartpole",
        "random",
    ]  # none of its actions does nothing
    assert (list(shown.session.policies), shown.session.policy_name) == (names, "last")
    shown.session.choose("other/cartpole")
    assert shown.session.step()
    assert (
        main(
            [
                "view",
                "cartpole",
                "--policies",
                str(run),
                "--env.action",
                "voltage",
                "--env.levels",
                "-5",
                "5",
            ]
        )
        == 2
    )
    assert "was trained with 'force'" in capsys.readouterr().err
