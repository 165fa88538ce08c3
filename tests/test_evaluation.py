"""Evaluation: measures against counting, a closed form, an identity or a direct calculation."""

import dataclasses
import functools
import json
import math
from typing import ClassVar, NamedTuple

import gymnasium
import numpy as np
import pytest

from codrl_mj import Uniform
from codrl_mj.actuators import (
    IDEAL,
    ActuatorModel,
    CurrentLoop,
    DCMotorActuator,
    Drive,
    GearMotor,
    Lag,
    Motor,
    SampledLoop,
    Supply,
)
from codrl_mj.disturbances import Disturbances
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import MEASURES, Episode, RandomPolicy, evaluate, run_episodes, summarize
from codrl_mj.fields import real
from codrl_mj.physics import trace_names
from codrl_mj.tasks import TASKS, named_actuator
from codrl_mj.viz.films import strip
from codrl_mj.viz.films.film import record
from codrl_mj.viz.pages.episode import RunEpisode, _motor_plots, _motor_series

TRACE = trace_names(DCMotorActuator)
ROW = ("actual_force", "current", "voltage", "speed", "saturated")
PEAKS = {"saturated_percent", "peak_voltage", "peak_current", "rms_current", "peak_speed"}
ELECTRICAL = PEAKS | {"energy_drawn", "energy_returned", "copper_loss", "magnetic_energy"}


class Leaner:
    """Policy that pushes the cart to the side to which the pole leans, or to the opposite side."""

    def predict(self, observation, *, deterministic=False):
        return np.where((observation[:, 2] > 0) == deterministic, 1, 0), None


class Constant:
    """Policy with a constant action, or one that alternates its sign, for a box of one number."""

    def __init__(self, action, factor=1.0):
        """Keep the action, which changes by the factor from one step to the next."""
        self.action, self.factor = action, factor

    def predict(self, observation, *, deterministic=False):  # noqa: ARG002
        self.action *= self.factor
        return np.full((len(observation), 1), self.action, np.float32), None


MOTOR = DCMotorActuator()


def minimal_episode(
    task="cartpole",
    actuator=MOTOR,
    states=None,
    rows=(),
    reward=None,
    terminated=True,
    desired=None,
):
    """Return an episode with only the fields that a measure reads.

    `rows` are the rows of the trace, with the entries of `ROW`. There is one step per row unless
    `states` has another number. The desired torque of a step is by default the torque at its end.
    """
    definition = TASKS[task]
    steps = len(rows) if states is None else len(states) - 1
    states = (
        np.zeros((steps + 1, len(definition.state_names)))
        if states is None
        else np.array(states, dtype=float)
    )
    rows = np.zeros((steps, len(ROW))) if len(rows) == 0 else np.array(rows, dtype=float)
    trace = {name: np.zeros(len(rows)) for name in TRACE} | dict(zip(ROW, rows.T, strict=True))
    inner_steps = len(rows) // steps
    ends = {
        name: values[inner_steps - 1 :: inner_steps]
        for name, values in trace.items()
        if name != "speed"
    }
    desired = ends["actual_force"] if desired is None else np.array(desired, dtype=float)
    return Episode(
        time=definition.step_duration * np.arange(1, steps + 1),
        state=states,
        observation=states,
        action=np.zeros(steps),
        reward=np.ones(steps) if reward is None else np.array(reward),
        first_speeds=states[0, list(definition.speed_indices)],
        trace=trace,
        signals=ends | {"desired_force": desired},
        terminated=terminated,
        actuator=actuator,
    )


# -- returns, success, time to goal ----------------------------------------------------------------


def test_returns_and_lengths_are_correct():
    episodes = [
        minimal_episode(rows=[(0, 0, 0, 0, 0)] * len(rewards), reward=rewards, terminated=over)
        for rewards, over in (
            ([1.0, 2.0], True),
            ([0.0], False),
            ([5.0, 1.0, 4.0], True),
            ([-7.0], True),
        )
    ]
    summary = summarize("cartpole", episodes)
    assert (summary.task, summary.episodes, summary.terminated) == ("cartpole", 4, 3)
    assert summary.returns.low < summary.returns.mean == (3 + 0 + 10 - 7) / 4 < summary.returns.high
    assert (summary.returns_median, summary.returns_interquartile_mean, summary.length.mean) == (
        1.5,
        1.5,
        7 / 4,
    )
    assert summary.episode_returns == (3, 0, 10, -7)
    assert summary.episode_times_to_goal == (None, 0, None, None)


STANDING, FALLEN = [[0, 0, 0, 0]] * 4, [[0, 0, 0, 0], [0, 0, 0.3, 0]]
DOWN, UP = [0, 0, 0, 0], [math.pi, 0, 1, 0]
HANGING, UPRIGHT, FAST, SWUNG = [math.pi, 0.0], [2 * math.pi - 0.09, 0.09], [0.0, 0.11], [0.11, 0.0]
ROLLING, SHORT = [0, 0.01], [[0, 0.01]] * 3


def arriving(goal):
    """Return cars that arrive after 7 s, after 9 s, pass the flag and return, or never arrive."""
    beyond = goal + 0.01
    late = ([ROLLING] * 9 + [[goal, 0.0]], True)
    return [
        ([ROLLING] * 7 + [[beyond, 0.01]], True),
        late,
        ([ROLLING, [beyond, -0.01]], False),
        (SHORT, False),
    ]


@pytest.mark.parametrize(
    ("task", "episodes", "share", "quartiles"),
    [
        # A pole that stands until the time limit.
        (
            "cartpole",
            [(STANDING, False), (FALLEN, True), (FALLEN, True), (STANDING, False)],
            0.5,
            None,
        ),
        # A car at its flag and an acrobot at its height, with the time.
        ("mountain_car", arriving(0.5), 0.5, (8.0, 7.5, 8.5)),
        ("mountain_car_continuous", arriving(0.45), 0.5, (8.0, 7.5, 8.5)),
        ("acrobot", [([DOWN, DOWN, UP], True), ([DOWN] * 4, False)], 0.5, (0.4, 0.4, 0.4)),
        # A pendulum upright and still for its last second; the time is when it settled.
        ("pendulum", [([HANGING] * 30 + [UPRIGHT] * 21, False)], 1.0, [30 * 0.05] * 3),
        ("pendulum", [([UPRIGHT] * 40 + [HANGING] + [UPRIGHT] * 30, False)], 1.0, [41 * 0.05] * 3),
        ("pendulum", [([HANGING] * 30 + [UPRIGHT] * 20, False)], 0.0, None),  # 0.95 s
        ("pendulum", [([UPRIGHT] * 60 + [FAST], False)], 0.0, None),
        ("pendulum", [([UPRIGHT] * 40 + [SWUNG] + [UPRIGHT] * 5, False)], 0.0, None),
        ("pendulum", [([UPRIGHT] * 15, False)], 0.0, None),  # Shorter than a second.
    ],
)
def test_success_and_time_to_goal_follow_the_task_s_definition(task, episodes, share, quartiles):
    summary = summarize(
        task, [minimal_episode(task, IDEAL, states, terminated=over) for states, over in episodes]
    )
    assert summary.success.mean == share
    assert summary.failure == pytest.approx(
        (1 - share, 1 - summary.success.high, 1 - summary.success.low)
    )
    times = [time for time in summary.episode_times_to_goal if time is not None]
    assert len(times) == share * len(episodes)
    assert summary.time_to_goal == (quartiles if quartiles is None else pytest.approx(quartiles))


# -- tracking --------------------------------------------------------------------------------------


def pushing(*forces):
    return [(force, 0, 0, 0, 0) for force in forces]


def test_the_tracking_error_uses_every_integration_step_at_the_shaft():
    arm = 0.25
    actuator = DCMotorActuator(Motor(arm_radius=arm))
    # Two environment steps of two integration steps each, with a desired force of 10 N and then
    # -10 N; and one more step.
    first = minimal_episode(
        "cartpole",
        actuator,
        np.zeros((3, 4)),
        pushing(8.0, 10.0, -4.0, -10.0),
        desired=[10.0, -10.0],
    )
    second = minimal_episode(
        "cartpole", actuator, np.zeros((2, 4)), pushing(9.0, 10.0), desired=[10.0]
    )
    summary = summarize("cartpole", [first, second])
    error = (
        math.sqrt((2.0**2 + 6.0**2 + 1.0**2) / 6) * arm
    )  # N*m; the errors at the ends of the steps are 0.
    assert summary.tracking_rms == pytest.approx(error, rel=1e-12)
    assert summary.tracking_percent == pytest.approx(100 * error / (10.0 * arm), rel=1e-12)
    assert summary.tracking_max == pytest.approx(6.0 * arm, rel=1e-12)
    delivered = (8.0, 10.0, -4.0, -10.0, 9.0, 10.0)
    assert summary.torque_rms == pytest.approx(
        math.sqrt(sum(f**2 for f in delivered) / 6) * arm, rel=1e-12
    )
    duration = float(first.time[-1] + second.time[-1])
    assert summary.reversals == pytest.approx(
        1 / duration, rel=1e-12
    )  # No sign change counts between episodes.


def test_tracking_is_averaged_over_steps_not_episodes():
    nine_bad = minimal_episode(rows=pushing(*[0] * 9), desired=[1.0] * 9)
    one_good = minimal_episode(rows=[(1.0, 0, 0, 0, 1)], desired=[1.0])
    summary = summarize("cartpole", [nine_bad, one_good])
    assert summary.tracking_rms == pytest.approx(math.sqrt(0.9), rel=1e-12)
    assert summary.saturated_percent == pytest.approx(10.0, rel=1e-12)


def test_a_desired_torque_of_zero_has_no_relative_error_and_no_delay():
    summary = summarize("cartpole", [minimal_episode(rows=pushing(*[0.5] * 4), desired=[0.0] * 4)])
    assert (summary.tracking_rms, summary.tracking_percent, summary.tracking_lag) == (
        0.5,
        None,
        None,
    )


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.15])
def test_the_lag_of_an_ideal_actuator_is_its_command_delay(delay):
    env = EnvConfig("pendulum", "ideal", disturbances=Disturbances(command_delay=delay))
    result = evaluate(RandomPolicy("pendulum"), env, episodes=5)
    assert result.tracking_lag == pytest.approx(
        delay, abs=0.001
    )  # The noise beside the peak is 1/sqrt(1000) steps of 0.05 s.
    assert (result.tracking_rms > 0) == (delay > 0)


def test_the_ideal_actuator_tracks_perfectly_and_has_no_motor():
    result = evaluate(Leaner(), EnvConfig("cartpole", "ideal"), episodes=2)
    assert (result.tracking_rms, result.tracking_percent, result.tracking_max) == (0.0, 0.0, 0.0)
    assert all(getattr(result, name) is None for name in ELECTRICAL)
    assert result.mechanical_work.mean > 0


def test_a_voltage_command_has_no_tracking_measures():
    env = EnvConfig("pendulum", action="voltage", max_episode_steps=5)
    result = evaluate(Constant(1.0), env, episodes=2)
    assert (
        result.tracking_rms
        is result.tracking_percent
        is result.tracking_max
        is result.tracking_lag
        is None
    )
    assert result.peak_voltage == 1.0


class VoltSignals(NamedTuple):
    """Signals of `Position`: volts, without a unit in `SIGNAL_UNITS`."""

    current: float
    voltage: float


def advance(parameters, timestep, state, inputs):
    voltage = min(max(parameters.gain * (inputs.desired_torque - inputs.position), -12.0), 12.0)
    current = (voltage - inputs.speed) / 4.0
    return state, 0.01 * current, VoltSignals(current, voltage)


@dataclasses.dataclass(frozen=True)
class Position(ActuatorModel):
    """Hobby servo whose command is an angle, and which applies a voltage to its winding."""

    Signals: ClassVar[type] = VoltSignals
    advance: ClassVar = staticmethod(advance)
    MOTION: ClassVar[bool] = True
    is_torque_controlled: ClassVar[bool] = False
    gain: float = real(5.0, above=0.0)


def test_an_angle_command_has_no_tracking_measures():
    env = EnvConfig(
        "Reacher-v5", {"joint0": Position(), "joint1": Lag(time_constant=0.1)}, max_episode_steps=4
    )
    (episode,) = run_episodes(RandomPolicy(env.action_space, 0), env.build, 1, 3)
    assert episode.is_torque_controlled == (False, True)
    result = summarize(env.task, [episode])
    assert result.motors["joint0"]["tracking_rms"] is None
    # The total is the error of the only motor with a torque command.
    command = np.repeat(episode.signals["desired_force"][:, 1], episode.inner_steps)
    error = command - episode.trace["actual_force"][:, 1]
    assert result.tracking_rms == pytest.approx(math.sqrt(np.mean(error**2)), rel=1e-12)
    assert result.motors["joint1"]["tracking_rms"] == result.tracking_rms
    shown = [RunEpisode("run", env, episode, None, None, 3)]
    plots = {plot.title: plot for plot in _motor_plots(_motor_series(shown, list(episode.motors)))}
    for title, name in (
        ("Torque at the shaft", "desired"),
        ("Error: desired minus actual", "desired minus actual"),
    ):
        assert [curve.label for curve in plots[title].curves if name in curve.label] == [
            f"joint1: {name}"
        ]
    current_only = EnvConfig("Reacher-v5", Position(), max_episode_steps=4)
    (episode,) = run_episodes(RandomPolicy(current_only.action_space, 0), current_only.build, 1, 3)
    result = summarize(current_only.task, [episode])
    assert (
        result.tracking_rms
        is result.tracking_percent
        is result.tracking_max
        is result.tracking_lag
        is None
    )
    plots = _motor_plots(
        _motor_series(
            [RunEpisode("run", current_only, episode, None, None, 3)], list(episode.motors)
        )
    )
    assert "Error: desired minus actual" not in [plot.title for plot in plots]


def test_a_film_shows_the_voltage_of_every_family_with_one(monkeypatch):
    assert strip._second_signal(Position()) == ("voltage", "u [V]")
    assert strip._second_signal(IDEAL) == (None, "u [V]")
    assert strip._second_signal(Lag()) == (None, "")
    drawn = []
    monkeypatch.setattr(
        strip, "_pixels", lambda figure: drawn.append(figure) or np.zeros((1, 1, 3), np.uint8)
    )
    env = EnvConfig("Reacher-v5", Position(), max_episode_steps=4)
    (episode,) = run_episodes(RandomPolicy(env.action_space, 0), env.build, 1, 3)
    strip.draw_strip(env.task, episode, 0, 300, 1.0, 1.0)
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == ["actual", "voltage"]


# -- the motor -------------------------------------------------------------------------------------


@pytest.mark.parametrize("max_voltage", [0.3, 0.6, 1.0, 24.0])
def test_the_saturated_share_counts_voltages_at_the_limit(max_voltage):
    weaker = named_actuator("weaker", "cartpole")
    actuator = DCMotorActuator(
        weaker.motor, CurrentLoop(kp=0.2, ki=0.2, kff=0.5, max_voltage=max_voltage)
    )
    make = EnvConfig("cartpole", actuator, inner_steps=2).build
    episodes = run_episodes(Leaner(), make, episodes=3)
    voltages = np.concatenate([episode.trace["voltage"] for episode in episodes])
    summary = summarize("cartpole", episodes)
    assert summary.saturated_percent == pytest.approx(
        100 * np.mean(np.abs(voltages) == max_voltage), rel=1e-12
    )
    assert summary.peak_voltage <= max_voltage
    assert (summary.saturated_percent > 0) == (max_voltage <= 1.0)


def test_a_stalled_motor_agrees_with_its_closed_form():
    """At constant voltage i(k) = u/R*(1 - q^k) with q = 1 - R*dt/L, so sums are geometric."""
    motor, voltage, steps, count = (
        Motor(resistance=2.0, inductance=1.5, back_emf_constant=0.0),
        0.5,
        6,
        20,
    )
    env = EnvConfig(
        "mountain_car_continuous", DCMotorActuator(motor), action="voltage", max_episode_steps=steps
    )
    result = evaluate(Constant(voltage), env, episodes=3)
    dt, n, final = 1.0 / count, steps * count, voltage / motor.resistance
    q = 1 - motor.resistance * dt / motor.inductance
    ones, squares = (1 - q**n) / (1 - q), (1 - q ** (2 * n)) / (1 - q**2)
    drawn = voltage * final * dt * (n - (1 + q) / 2 * ones)
    heat = (
        motor.resistance
        * final**2
        * dt
        / 3
        * (3 * n - 3 * (1 + q) * ones + (1 + q + q * q) * squares)
    )
    assert result.energy_drawn.mean == pytest.approx(drawn, rel=1e-12)
    assert result.energy_returned.mean == 0.0
    assert result.copper_loss.mean == pytest.approx(heat, rel=1e-12)
    assert result.magnetic_energy.mean == pytest.approx(
        motor.inductance / 2 * (final * (1 - q**n)) ** 2, rel=1e-12
    )
    assert result.peak_current == pytest.approx(final * (1 - q**n), rel=1e-12)
    assert result.rms_current == pytest.approx(
        math.sqrt(heat / motor.resistance / (n * dt)), rel=1e-12
    )
    assert (result.peak_voltage, result.saturated_percent) == (voltage, 0.0)
    # The exact motor: Euler's steps differ by dt/T = 1/15 of the transient.
    time, constant = n * dt, motor.electrical_time_constant
    transient = voltage * final * constant
    exact = voltage * final * (time - constant * (1 - math.exp(-time / constant)))
    assert result.energy_drawn.mean == pytest.approx(exact, abs=transient * dt / constant)


@pytest.mark.parametrize("task", ["pendulum", "acrobot", "mountain_car"])
def test_the_energy_balance_converges_with_the_step(task):
    """With kE = kT, drawn minus returned energy is heat, field or work, up to Euler's error."""
    gaps, actuator = [], DCMotorActuator(Motor(), CurrentLoop(kp=2.0, ki=2.0))
    for timestep in (0.005, 0.0025, 0.00125):  # the winding's time constant is 0.1 s
        env = EnvConfig(task, actuator, timestep=timestep, max_episode_steps=8)
        result = evaluate(RandomPolicy(task), env, episodes=3)
        spent = result.copper_loss.mean + result.magnetic_energy.mean + result.mechanical_work.mean
        gaps.append(result.energy_drawn.mean - result.energy_returned.mean - spent)
    coarse, middle, fine = map(abs, gaps)
    assert coarse / middle == pytest.approx(2.0, abs=0.3)
    assert middle / fine == pytest.approx(2.0, abs=0.2)
    assert coarse < 0.1 * spent


def test_a_drive_s_energy_balance_holds_if_its_winding_is_much_faster_than_a_step():
    """The step is 2.5 ms and L/R 0.14 ms, so mean voltage times mean current is too much."""
    motor = GearMotor(8.4, 1.16e-3, 0.042, 0.042, rotor_inertia=4e-6, gear_ratio=40.0)
    drive = Drive(motor, SampledLoop(20e3, max_current=0.8), Supply(18.0))
    env = EnvConfig("pendulum", drive, timestep=0.0025, max_episode_steps=100)
    result = evaluate(Constant(2.0, factor=-1.0), env, episodes=2)
    drawn = result.energy_drawn.mean - result.energy_returned.mean
    spent = result.copper_loss.mean + result.magnetic_energy.mean + result.mechanical_work.mean
    assert drawn == pytest.approx(spent, rel=5e-3)
    duration = 100 * 0.05
    assert result.rms_current == pytest.approx(
        math.sqrt(result.copper_loss.mean / 8.4 / duration), rel=1e-12
    )
    assert result.saturated_percent == result.current_saturated_percent == 100.0
    assert 0.0 < result.voltage_saturated_percent < 50.0  # While the current reverses.
    assert result.temperature_saturated_percent == 0.0


def test_work_energies_and_peaks_refer_to_the_shaft():
    motor = Motor(arm_radius=0.5, resistance=2.0)
    # Force, current, voltage, speed, saturated. Then the motor brakes.
    rows = [
        (3.0, 1.0, 6.0, 0.5, 0),
        (1.0, -4.0, -7.0, -0.8, 1),
        (0.0, -4.0, 3.0, -0.8, 1),
        (0.0, 0.0, 0.0, -0.8, 0),
    ]
    states = [[0.0, -0.9, 0.0, 0.0]] * 5  # Before the first step the cart moves at -0.9 m/s.
    result = summarize(
        "cartpole", [minimal_episode(actuator=DCMotorActuator(motor), states=states, rows=rows)] * 2
    )
    dt = 0.02
    assert result.mechanical_work.mean == pytest.approx((3.0 * -0.2 + 1.0 * -0.15) * dt, rel=1e-12)
    assert result.energy_drawn.mean == pytest.approx((6.0 * 0.5 + -7.0 * -1.5) * dt, rel=1e-12)
    assert result.energy_returned.mean == pytest.approx(3.0 * 4.0 * dt, rel=1e-12)
    squares = (1.0 + (1.0 - 4.0 + 16.0) + 3 * 16.0 + 16.0) / 3
    assert result.copper_loss.mean == pytest.approx(2.0 * squares * dt, rel=1e-12)
    assert (result.peak_voltage, result.peak_current, result.saturated_percent) == (7.0, 4.0, 50.0)
    assert result.peak_speed == pytest.approx(0.9 / 0.5)


def test_every_episode_is_measured_with_its_random_motor():
    drawn = {"motor.resistance": Uniform(0.5, 3.0), "motor.arm_radius": Uniform(0.5, 2.0)}
    env = EnvConfig("pendulum", "weak", max_episode_steps=20, randomize=drawn)
    result = evaluate(RandomPolicy("pendulum"), env, episodes=3)
    episodes = run_episodes(RandomPolicy("pendulum"), env.build, 3)
    arms = [episode.actuator.motor.arm_radius for episode in episodes]
    assert len(set(arms)) == 3
    single = [summarize("pendulum", [episode]) for episode in episodes]
    errors = [
        np.repeat(e.signals["desired_force"], e.inner_steps) - e.trace["actual_force"]
        for e in episodes
    ]
    assert result.tracking_max == pytest.approx(np.abs(np.array(errors).T * arms).max(), rel=1e-12)
    fastest = [max(abs(e.state[0, 1]), np.abs(e.trace["speed"]).max()) for e in episodes]
    assert result.peak_speed == pytest.approx(max(np.array(fastest) / arms), rel=1e-12)
    powers = [
        e.actuator.motor.resistance * episode.rms_current**2
        for e, episode in zip(episodes, single, strict=True)
    ]
    assert result.copper_loss.mean == pytest.approx(
        np.mean(powers) * episodes[0].time[-1], rel=1e-12
    )


# -- the whole -------------------------------------------------------------------------------------


def test_an_evaluation_summarizes_its_episodes_and_records_its_conditions():
    actuator = named_actuator("weaker", "cartpole").replaced({"controller.current_bias": 0.2})
    late = {"command_delay": 0.01}
    env = EnvConfig("cartpole", actuator, "analytic", inner_steps=2, disturbances=late)
    make = functools.partial(
        gymnasium.make,
        "codrl_mj/CartPole-v0",
        actuator=actuator,
        physics="analytic",
        inner_steps=2,
        disturbances=late,
    )
    for deterministic in (True, False):
        result = evaluate(Leaner(), env, 3, seed=9, deterministic=deterministic)
        expected = summarize(
            "cartpole", run_episodes(Leaner(), make, 3, seed=9, deterministic=deterministic)
        )
        for name in MEASURES:
            assert getattr(result, name) == getattr(expected, name), name
        assert EnvConfig.from_mapping(result.conditions["env"]) == env
        assert (result.conditions["seed"], result.conditions["deterministic"]) == (9, deterministic)


def test_an_evaluation_is_json_with_a_unit_for_every_measure():
    result = evaluate(
        Constant(0.4), EnvConfig("pendulum", "weak", max_episode_steps=30), episodes=2
    )
    mapping = result.as_mapping()
    assert json.loads(json.dumps(mapping)) == mapping
    assert mapping["returns"] == {
        "mean": result.returns.mean,
        "low": result.returns.low,
        "high": result.returns.high,
    }
    assert mapping["units"].keys() == MEASURES.keys() <= mapping.keys()
    assert (mapping["units"]["energy_drawn"], mapping["units"]["tracking_rms"]) == ("J", "N*m")
    assert {"tracking_lag", "mechanical_work", "time_to_goal", "success"} < MEASURES.keys()
    assert {name for name in MEASURES if mapping[name] is not None} >= ELECTRICAL


def test_a_policy_is_not_measured_where_its_observations_or_actions_are_others():
    policy = RandomPolicy("pendulum")
    policy.action_space = EnvConfig("pendulum", action="voltage").build().action_space
    with pytest.raises(
        ValueError,
        match=r"action_space: the policy was trained with Box.*but the environment has",
    ):
        evaluate(policy, EnvConfig("pendulum"), episodes=1)
    policy.action_space = None
    policy.observation_space = EnvConfig("cartpole").build().observation_space
    for run in (
        lambda env: evaluate(policy, env, episodes=1),
        lambda env: run_episodes(policy, env.build, 1),
        lambda env: record(policy, env, 0, 64, 48),
    ):
        with pytest.raises(ValueError, match=r"observation_space: the policy was trained with Box"):
            run(EnvConfig("pendulum"))
