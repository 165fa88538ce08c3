"""A session simulates as MuJoCo does, and refuses invalid settings."""

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
    new_session = Session(
        EnvConfig.from_mapping({"task": POLE, "actuator": {".*": motor}, **arguments}),
        dict(policies),
    )
    new_session.choose("zero")
    new_session.auto_reset = False
    return new_session


@pytest.fixture(scope="module")
def motors_added():
    return session()


@pytest.mark.parametrize("auto_reset", [True, False])
def test_at_the_time_limit_it_resets_or_continues(auto_reset):
    view = session("ideal", max_episode_steps=3)
    view.auto_reset = auto_reset
    endings = [view.step() and view.ended for _ in range(4)]
    assert endings[:3] == ["", "", "past the time limit"]
    assert view.time == pytest.approx((1 if auto_reset else 4) * view.recorder.step_duration)
    assert endings[3] == ("" if auto_reset else "past the time limit")


def test_a_push_is_a_force_at_the_center_of_mass():
    view = session("ideal")
    model, data = view.model, mujoco.MjData(view.model)
    data.qpos[:], data.qvel[:] = view.data.qpos, view.data.qvel
    view.push("pole", 3.0)
    # A push lasts whole environment steps, of two integration steps each.
    push_steps = int(np.ceil(PUSH_DURATION / model.opt.timestep / 2)) * 2
    for step in range(10):
        assert view.step()
        for inner in range(2):
            data.xfrc_applied[model.body("pole").id, 0] = (
                3.0 if 2 * step + inner < push_steps else 0.0
            )
            mujoco.mj_step(model, data)
    assert abs(data.qvel).max() > 0.1
    np.testing.assert_array_equal(view.data.qpos, data.qpos)


def test_signals_are_those_of_every_integration_step(motors_added):
    motors_added.reset()
    for _ in range(5):
        motors_added.step()
    times = [row_time for row_time, _ in motors_added.signals]
    np.testing.assert_allclose(times, 0.02 * np.arange(1, 11), atol=1e-12)
    assert motors_added.signals[-1][1].shape == (1, len(motors_added.recorder.trace_names))
    assert motors_added.time == pytest.approx(0.2)


def test_a_setting_changes_the_simulation_and_the_motion_continues(motors_added):
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


def test_unstable_settings_are_reported_and_not_simulated(motors_added):
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
    "recover", [Session.reset, lambda view: view.set_disturbance(("command_delay",), 0.04)]
)
def test_a_diverged_simulation_stops_until_a_reset_or_another_setting(recover):
    view = session("ideal")
    assert view.step()
    view.data.qvel[:] = np.nan
    assert not view.step()
    assert view.is_stopped
    recover(view)
    assert not view.is_stopped
    assert (view.time, view.total) == (0.0, 0.0)
    np.testing.assert_array_equal(view.observation, np.append(view.data.qpos, view.data.qvel))
    assert view.step()
    assert np.isfinite(view.data.qpos).all()


def test_external_forces_are_kept():
    """Apply a force as MuJoCo's own viewer does for the mouse, between two steps."""
    view = session("ideal")
    pole = view.model.body("pole").id
    view.data.xfrc_applied[pole, 0] = 3.0
    view.data.qpos[:] = view.data.qvel[:] = 0.0
    view.step()
    assert view.data.qvel[0] > 0.0
    assert view.data.xfrc_applied[pole, 0] == 3.0
    view.reset()
    assert not view.data.xfrc_applied.any()


def test_a_policy_for_another_environment_is_refused(motors_added):
    class Wide:
        def predict(self, observation, **_):
            return np.zeros((len(observation), 5)), None

    motors_added.policies["wide"] = Wide
    with pytest.raises(ValueError, match="policy wide: its actions"):
        motors_added.choose("wide")
    assert motors_added.policy_name == "zero"


def test_controls_are_the_fields_with_their_bounds_and_units(motors_added):
    actuator = motors_added.config.actuators_by_name[".*"]
    controls_by_path = {control.path: control for control in controls(actuator, 48.0)}
    resistance = controls_by_path["motor", "resistance"]
    assert resistance.unit == "ohm"
    assert resistance.value == actuator.motor.resistance
    assert 0 < resistance.low < resistance.value < resistance.high
    assert (
        controls_by_path["motor", "gear_efficiency"].high == 1.0
    )  # its bound instead of four times its value
    assert controls_by_path["controller", "anti_windup"].options == (
        "back_calculation",
        "clamping",
        "none",
    )
    assert controls_by_path["controller", "delayed"].value is False
    for path, control in controls_by_path.items():
        optional = {
            field.name: field.metadata.get("absent") for field in dataclasses.fields(actuator)
        }
        part = (getattr(actuator, path[0]) or optional[path[0]]) if len(path) > 1 else actuator
        fields = {field.name: field for field in dataclasses.fields(part)}
        # Both ends of a slider can be set.
        for end in (control.low, control.high) if None not in (control.low, control.high) else ():
            holds, *_ = fields[path[-1]].metadata["bound"]
            assert holds(type(control.value)(control.from_slider(end))), path


def test_the_end_of_a_slider_stands_for_an_infinite_voltage():
    voltage = {control.path: control for control in controls(DCMotorActuator(), 48.0)}[
        "supply", "voltage"
    ]
    assert voltage.high == 48.0
    assert voltage.from_slider(48.0) == np.inf
    assert voltage.from_slider(12.0) == 12.0
    assert ("supply", "voltage") not in [control.path for control in controls(DCMotorActuator())]


class FakeBrowser:
    """Replacement of the browser that records its calls."""

    url = "http://127.0.0.1:0"
    instances: ClassVar = []

    def __init__(self, session, _port, title):  # noqa: D107
        self.session, self.title, self.calls = session, title, []
        self.instances.append(self)

    def run(self, should_stop):
        self.calls.append(f"should stop: {should_stop()}")
        assert self.session.step()

    def close(self):
        self.calls.append("closed")


def test_ctrl_c_waits_for_the_end_of_a_step_and_closes_the_server(monkeypatch, capsys):
    class Interrupted(FakeBrowser):
        def run(self, should_stop):
            signal.raise_signal(signal.SIGINT)
            super().run(should_stop)

    monkeypatch.setattr("codrl_mj.viz.view.browser.Browser", Interrupted)
    assert main(["view", "cartpole"]) == 130
    assert FakeBrowser.instances.pop().calls == ["should stop: True", "closed"]
    assert "stopped" in capsys.readouterr().err


def test_the_command_line_offers_policies_of_this_and_other_runs(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("codrl_mj.viz.view.browser.Browser", FakeBrowser)
    run = Path(__file__).parents[2] / "fixtures" / "runs" / "cartpole"
    other_run = shutil.copytree(run, tmp_path / "other" / "cartpole")
    assert (
        main(["view", str(run), "--policies", str(run), str(other_run), "--actuator", "weaker"])
        == 0
    )
    browser = FakeBrowser.instances.pop()
    assert (browser.title, browser.calls) == (
        "cartpole on weaker",
        ["should stop: False", "closed"],
    )
    # There is no policy `zero`, because every action of CartPole has a force.
    names = [
        "last",
        "runs/cartpole",
        "other/cartpole",
        "random",
    ]
    assert (list(browser.session.policies), browser.session.policy_name) == (names, "last")
    browser.session.choose("other/cartpole")
    assert browser.session.step()
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
