"""Feasibility of tasks: formulas against closed forms, and predictions against simulations."""

import dataclasses
import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from codrl_mj.actuators import Drive, GearMotor, Ideal, Inputs, SampledLoop, Supply, parameters_type
from codrl_mj.cli import main
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import run_episodes
from codrl_mj.sizing import (
    DEPENDS,
    HOPELESS,
    SURELY,
    SURELY_NOT,
    TRY_IT,
    best_ratio,
    choose,
    demand_from_arrays,
    demand_of,
    feasibility,
    find_drive,
    min_energy_gain,
    min_pumped_energy,
    min_supply_voltage,
    operating_points,
)
from codrl_mj.sizing.limits import max_power
from codrl_mj.sizing.scripted import Scripted, observe_state
from codrl_mj.tasks import TASKS
from tests.matrix import matrix_params

PAPER = GearMotor(
    resistance=1.0, inductance=0.01, torque_constant=1.0, back_emf_constant=1.0, rotor_inertia=1e-9
)
MOTOR = GearMotor(
    resistance=2.0,
    inductance=1e-3,
    torque_constant=0.05,
    back_emf_constant=0.04,
    rotor_inertia=1e-5,
)
COOL = math.inf
"""A continuous current for which heat does not matter."""


def drive(motor=PAPER, voltage=24.0, **loop):
    return Drive(motor, SampledLoop(**loop), Supply(voltage))


def steady(torque, speed, count=11):
    return demand_from_arrays(0.1 * np.arange(count), np.full(count, torque), np.full(count, speed))


def bounds(judgment):
    return {bound.name: bound for bound in judgment.bounds}


@pytest.fixture(scope="module")
def pendulum():
    return demand_of("pendulum")


def from_hanging(actuator, steps=400):
    """Return the states (steps + 1, 2) of the scripted swing-up from almost hanging."""
    env, policy = (
        EnvConfig("pendulum", actuator, max_episode_steps=steps).build(),
        Scripted(TASKS["pendulum"]),
    )
    env.reset(seed=0)
    env.unwrapped.physics.state = np.array([np.pi - 0.05, 0.0])
    states = [env.unwrapped.physics.state]
    for _ in range(steps):
        env.step(policy.predict(states[-1][np.newaxis])[0][0])
        states.append(env.unwrapped.physics.state)
    return np.array(states)


def swings_up(actuator):
    return bool(np.cos(from_hanging(actuator)[-40:, 0]).min() > 0.99)


# formulas


def test_a_steady_load_follows_the_motor_equation():
    motor = dataclasses.replace(
        MOTOR, gear_ratio=20.0, coulomb_friction=1e-3, viscous_friction=1e-6
    )
    required = operating_points(steady(1.5, 8.0), drive(motor))
    torque = 1.5 / 20.0 + 1e-3 + 1e-6 * 160.0
    assert required.torque == pytest.approx(torque)
    assert required.voltage == pytest.approx(2.0 * torque / 0.05 + 0.04 * 160.0)
    assert required.rms_current == pytest.approx(torque / 0.05)
    assert required.copper_loss == pytest.approx(1.1 * 2.0 * (torque / 0.05) ** 2)
    assert required.energy_drawn == pytest.approx(1.1 * required.voltage[0] * torque / 0.05)


def test_rotor_and_gear_add_to_the_load():
    time = np.linspace(0.0, 2.0, 2001)
    motor = dataclasses.replace(MOTOR, gear_ratio=30.0, gear_efficiency=0.8)
    required = operating_points(
        demand_from_arrays(time, np.zeros_like(time), 5.0 * np.sin(4.0 * time)), drive(motor)
    )
    driving = np.cos(4.0 * time) * np.sin(4.0 * time) > 0.0
    expected = 1e-5 * 30.0 * 20.0 * np.cos(4.0 * time) / np.where(driving, 0.8, 1.0)
    assert required.torque[1:-1] == pytest.approx(expected[1:-1], abs=1e-7)


def test_a_torque_step_adds_l_di_dt_to_the_voltage():
    """Torque steps of 1.5 N*m in 0.1 s at 8 rad/s: a rise needs more voltage, a fall less."""
    slow = dataclasses.replace(MOTOR, inductance=0.05, rotor_inertia=0.0)
    torque = np.array([0.0, 1.5, 1.5, 0.0])
    required = operating_points(
        demand_from_arrays(0.1 * np.arange(4), torque, np.full(4, 8.0)), drive(slow)
    )
    current, rise, back_emf = 1.5 / 0.05, 0.05 * 30.0 / 0.1, 0.04 * 8.0
    expected = [
        back_emf,
        2.0 * current + rise + back_emf,
        2.0 * current + back_emf,
        rise - back_emf,
    ]
    assert required.voltage == pytest.approx(expected)


def test_the_best_gear_minimizes_the_voltage():
    ratio = best_ratio(1.5, 8.0, MOTOR)
    assert ratio == pytest.approx(math.sqrt(2.0 * 1.5 / (0.05 * 0.04 * 8.0)))
    light = dataclasses.replace(MOTOR, rotor_inertia=0.0)

    def voltage(gear):
        return operating_points(
            steady(1.5, 8.0), drive(dataclasses.replace(light, gear_ratio=gear))
        ).voltage[0]

    assert voltage(ratio) == pytest.approx(2.0 * math.sqrt(2.0 * 12.0 * 0.04 / 0.05))
    assert voltage(ratio) < min(voltage(0.95 * ratio), voltage(1.05 * ratio))
    (chosen,) = choose(steady(1.5, 8.0), ["quanser-qube-servo-2"])
    motor = chosen.drive.motor
    assert chosen.ratio == pytest.approx(float(best_ratio(1.5, 8.0, motor)), rel=0.02)


def test_the_largest_power_is_a_quarter_of_the_stall_losses():
    bound = bounds(feasibility(drive(voltage=8.0), steady(2.0, 8.0)))["power"]
    assert (bound.needed, bound.available) == pytest.approx((16.0, 16.0))
    weaker = bounds(feasibility(drive(voltage=7.9), steady(2.0, 8.0)))["power"]
    assert not weaker.holds
    assert weaker.verdict == SURELY_NOT
    assert "raise the supply to 8 V" in weaker.remedy
    limited = bounds(feasibility(drive(voltage=8.0, max_current=1.0), steady(2.0, 8.0)))["power"]
    assert limited.available == pytest.approx(7.0)


def test_stall_and_heat():
    judgment = bounds(
        feasibility(drive(voltage=24.0, max_current=3.0), steady(2.0, 1.0), continuous_current=1.9)
    )
    assert judgment["stall"].available == pytest.approx(3.0)
    assert (judgment["heat"].needed, judgment["heat"].verdict) == (pytest.approx(2.0), TRY_IT)
    stiff = dataclasses.replace(PAPER, coulomb_friction=30.0)
    assert bounds(feasibility(drive(stiff), dataclasses.replace(steady(2.0, 1.0), exact=False)))[
        "stall"
    ].verdict == (SURELY_NOT)


def test_recordings_are_exact_demands_and_tasks_are_not():
    required = steady(2.0, 8.0)
    assert feasibility(drive(voltage=10.0), required, COOL).verdict == SURELY
    assert feasibility(drive(voltage=9.9), required).verdict == SURELY_NOT
    assert (
        feasibility(drive(voltage=9.9), dataclasses.replace(required, exact=False)).verdict
        == TRY_IT
    )


@pytest.mark.parametrize(
    ("voltage", "loop", "continuous", "verdict"),
    [
        (3.1, {}, 2.1, SURELY),
        (0.31, {}, None, TRY_IT),
        (0.29, {}, None, HOPELESS),  # of 3 V
        (24.0, {"max_current": 0.21}, None, TRY_IT),
        (24.0, {"max_current": 0.19}, None, HOPELESS),  # of 2 A
        (24.0, {}, 0.64, TRY_IT),
        (24.0, {}, 0.62, HOPELESS),  # of 2 A rms: ten times the heat
    ],
)
def test_a_shortage_by_a_factor_of_ten_is_hopeless(voltage, loop, continuous, verdict):
    required = dataclasses.replace(steady(2.0, 1.0), exact=False)
    assert feasibility(drive(voltage=voltage, **loop), required, continuous).verdict == verdict


# predictions


def test_the_scripted_swing_up_reaches_and_reports_upright(pendulum):
    assert (
        pendulum.source == "scripted swing-up and hold of pendulum, 10 of 10 episodes at the goal"
    )
    assert len(pendulum.torque) == len(pendulum.speed) == len(pendulum.acceleration) == 2000
    assert np.abs(pendulum.torque).max() == 2.0


def test_the_predicted_supply_of_a_swing_up_agrees_with_simulation(pendulum):
    """Any controller needs 5.17 V, and energy pumping 5.59 V; a slower winding needs more."""
    min_voltage = min_supply_voltage(pendulum.swing, drive(), min_energy_gain)
    assert min_voltage == pytest.approx(5.17, abs=0.02)
    assert min_supply_voltage(pendulum.swing, drive(), min_pumped_energy) == pytest.approx(
        5.59, abs=0.02
    )
    assert feasibility(drive(voltage=5.1), pendulum).verdict == SURELY_NOT
    assert feasibility(drive(voltage=5.5), pendulum).verdict == TRY_IT
    slow = dataclasses.replace(PAPER, inductance=0.1)
    assert not swings_up(drive(voltage=5.1))
    assert not swings_up(drive(slow, 5.5))
    assert swings_up(drive(voltage=6.0))
    assert swings_up(drive(slow, 6.0))


def test_a_catalogue_motor_swings_up_slightly_above_the_predicted_supply(pendulum):
    motor = find_drive("faulhaber-1331-006", 160.0)
    min_voltage = min_supply_voltage(pendulum.swing, motor, min_energy_gain)
    assert not swings_up(dataclasses.replace(motor, supply=Supply(0.97 * min_voltage)))
    assert swings_up(dataclasses.replace(motor, supply=Supply(1.1 * min_voltage)))


def test_a_sagging_supply_acts_like_additional_resistance(pendulum):
    """Compare power, stall and swings below the no-load speed, and the required supply."""
    sagging = Drive(PAPER, SampledLoop(), Supply(7.5, 0.5))
    stiff = drive(dataclasses.replace(PAPER, resistance=1.5), 7.5)
    ours, theirs = (bounds(feasibility(drive_, pendulum)) for drive_ in (sagging, stiff))
    for name in ("voltage", "stall", "power", "pumping", "swing"):
        assert ours[name].available == pytest.approx(theirs[name].available, rel=1e-12)
        assert ours[name].needed == pytest.approx(theirs[name].needed, rel=1e-12)
    min_voltage = min_supply_voltage(pendulum.swing, sagging, min_energy_gain)
    assert not swings_up(dataclasses.replace(sagging, supply=Supply(0.97 * min_voltage, 0.5)))
    assert swings_up(dataclasses.replace(sagging, supply=Supply(1.1 * min_voltage, 0.5)))


def test_friction_and_damping_raise_the_supply_of_a_swing_up(pendulum):
    light = min_energy_gain(pendulum.swing, drive(voltage=5.5))
    rough = dataclasses.replace(PAPER, coulomb_friction=0.1)
    assert min_energy_gain(pendulum.swing, drive(rough, 5.5)) < light
    assert min_energy_gain(pendulum.swing._replace(damping=0.05), drive(voltage=5.5)) < light
    assert min_pumped_energy(pendulum.swing._replace(max_torque=6.0), drive()) == math.inf


def test_a_surely_sufficient_motor_does_not_change_the_run(pendulum):
    """At 10 V the run equals the ideal one, up to the delay of L/R = 0.1 ms."""
    quick = drive(dataclasses.replace(PAPER, inductance=1e-4), 10.0)
    assert operating_points(pendulum, quick).voltage.max() <= 10.0
    assert feasibility(quick, pendulum, COOL).verdict == SURELY
    assert np.abs(from_hanging(quick) - from_hanging(Ideal())).max() < 0.005


def test_the_first_choice_without_a_gears_loss_delivers_the_demand(pendulum):
    first = next(choice for choice in choose(pendulum) if choice.drive.motor.gear_efficiency == 1.0)
    assert first.feasibility.verdict == SURELY
    required, family, state, delivered = (
        first.feasibility.operating_points,
        type(first.drive),
        Drive.State(*[0.0] * len(Drive.State._fields)),
        [],
    )
    parameters = parameters_type(family)(*first.drive.parameter_values)
    for torque, speed in zip(required.torque, required.speed, strict=True):
        state, output, _ = Drive.advance(
            parameters, 0.05, state, Inputs(torque, 0.0, speed, 0.0, 0.0)
        )
        delivered.append(output)
    error = np.array(delivered) - required.torque
    assert np.abs(error).max() < 0.02 * np.abs(required.torque).max()


def test_the_smallest_suitable_motor_comes_first_and_the_others_have_reasons(
    pendulum,
):
    choices = choose(pendulum)
    good = [choice for choice in choices if not choice.rejection_reason]
    assert choices[: len(good)] == good
    assert [choice.power for choice in good] == sorted(choice.power for choice in good)
    assert min(choice.feasibility.margin for choice in good) >= 0.2
    assert max(choice.feasibility.operating_points.own_share for choice in good) <= 0.5
    assert {choice.feasibility.verdict for choice in good} == {SURELY}
    assert not any("continuous current" in choice.unknown for choice in good)
    others = {choice.name: choice for choice in choices[len(good) :]}
    assert (
        "no gear helps: raise the supply to 15.01 V" in others["dynamixel-mx-64"].rejection_reason
    )
    assert others["dynamixel-mx-64"].ratio == 200.0
    assert "motor.rotor_inertia = 0" in others["pololu-37d-30"].drive.assumed
    assert others["kraken-x60"].feasibility.verdict == DEPENDS
    assert "heat: its continuous current is not known" in others["kraken-x60"].rejection_reason
    assert "rotor: its inertia is not known" in others["kraken-x60"].rejection_reason
    assert "with a margin of 9%, must be >= 20%" in others["quanser-qube-servo-3"].rejection_reason
    wide = [
        choice.name for choice in choose(pendulum, min_margin=0.6) if not choice.rejection_reason
    ]
    assert wide == [choice.name for choice in good if choice.feasibility.margin >= 0.6]


def test_max_power_agrees_with_a_search():
    """Maximize i*(V - R*i)*kT/kE by search, also with a largest current."""
    for max_current in (math.inf, 2.0):
        drive_ = drive(MOTOR, max_current=max_current)
        currents = np.linspace(0.0, min(max_current, 12.0), 100_001)
        assert max_power(drive_) == pytest.approx(
            np.max(currents * (24.0 - 2.0 * currents) * 0.05 / 0.04), rel=1e-8
        )


def test_a_heavy_rotor_is_rejected_for_tasks_but_not_for_recordings():
    """A rotor whose reflected inertia takes twice the load's torque."""
    time = np.linspace(0.0, 2.0, 2001)
    swinging = demand_from_arrays(time, 0.02 * np.cos(4.0 * time), 10.0 * np.sin(4.0 * time))
    name = ["cubemars-ak80-6"]  # has a gear of its own: 6.07e-5 * 36 * 40 = 0.087 N*m
    assert (
        "needs 437.2 %, has 50 %"
        in choose(dataclasses.replace(swinging, exact=False), name)[0].rejection_reason
    )
    assert choose(swinging, name)[0].rejection_reason == ""


def test_the_gear_limits_the_rotor_share_for_tasks_and_maximizes_the_margin_of_recordings():
    time = np.linspace(0.0, 2.0, 2001)
    recording = demand_from_arrays(time, 0.1 * np.cos(4.0 * time), 10.0 * np.sin(4.0 * time))
    free, bound = (
        choose(drive_, ["maxon-ec45-flat-50w"])[0].feasibility
        for drive_ in (recording, dataclasses.replace(recording, exact=False))
    )
    assert bound.operating_points.own_share < 0.5 < 1.0 < free.operating_points.own_share
    assert 0.5 < bound.margin < free.margin


def arrivals(task, actuator, episodes=5):
    """Return the number of scripted episodes of a task that end at the goal."""
    env = EnvConfig(task, actuator, inner_steps=TASKS[task].motor_inner_steps)
    policy = Scripted(TASKS[task])
    ran = run_episodes(policy, lambda: observe_state(env.build()), episodes, 0)
    return sum(
        not episode.terminated if task == "cartpole" else bool(TASKS[task].goal(episode.state[-1]))
        for episode in ran
    )


@pytest.mark.parametrize(
    "task",
    matrix_params(["pendulum"], ["pendulum", "cartpole", "acrobot", "mountain_car_continuous"]),
)
def test_the_first_choice_succeeds_in_simulation(task):
    assert arrivals(task, choose(demand_of(task))[0].drive) == 5


def test_an_insufficient_motor_fails_in_simulation(pendulum):
    (choice,) = choose(pendulum, ["quanser-srv02"])
    assert {bound.name for bound in choice.feasibility.bounds if not bound.holds} >= {
        "voltage",
        "stall",
        "power",
    }
    assert arrivals("pendulum", choice.drive) == 0


def test_on_a_slide_a_geared_motor_gets_a_wheel():
    demand = demand_of("cartpole", episodes=1)
    assert demand.linear
    (choice,) = choose(demand, ["pololu-37d-30"])
    assert choice.drive.motor.gear_ratio == 30.0
    assert choice.ratio == pytest.approx(30.0 / choice.drive.motor.arm_radius)
    assert choice.drive.motor.arm_radius != 1.0


# bad input


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: demand_of("pendulun"), "did you mean 'pendulum'"),
        (lambda: find_drive("frc-kim"), "did you mean 'frc-cim'"),
        (lambda: find_drive("frc-cim", gear_ratio=0.0), "gear_ratio = 0"),
        (lambda: find_drive("frc-cim", voltage=-1.0), "voltage = -1"),
        (lambda: find_drive("lag"), "is not a drive"),
        (
            lambda: choose(steady(1.0, 1.0), ["frc-cim"], min_margin=1.0),
            r"min_margin = 1: must be >= 0 and < 1",
        ),
        (lambda: demand_from_arrays([0.0, 1.0], [1.0], [1.0, 1.0]), "torque: shape"),
        (lambda: demand_from_arrays([0.0, 0.0], [1.0, 1.0], [1.0, 1.0]), r"time\[1\] = 0 s"),
        (lambda: demand_from_arrays([0.0, 1.0], [1.0, math.nan], [1.0, 1.0]), r"torque\[1\] = nan"),
        (lambda: feasibility(Ideal(), steady(1.0, 1.0)), "must be a codrl_mj.actuators.Drive"),
    ],
)
def test_raises_with_a_remedy_if_the_input_is_invalid(call, match):
    with pytest.raises(ValueError, match=match):
        call()


def test_raises_if_the_file_is_not_a_recording(tmp_path):
    np.savez(tmp_path / "half.npz", time=np.arange(3.0), torque=np.ones(3))
    with pytest.raises(ValueError, match=r"half.npz: no recording .* speed"):
        demand_of(tmp_path / "half.npz")


# the command line


def test_the_command_judges_a_recording_and_draws_it(tmp_path, capsys):
    np.savez(
        tmp_path / "joint.npz", time=np.arange(3.0), torque=np.full(3, 1.0), speed=np.full(3, 8.0)
    )
    judge = [
        "motor",
        "feasible",
        "maxon-ec45-flat-50w",
        str(tmp_path / "joint.npz"),
        "--gear-ratio",
    ]
    assert main([*judge, "20", "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "surely"
    assert (tmp_path / "out" / "torque_speed.png").read_bytes().startswith(b"\x89PNG")
    assert main([*judge, "20", "--voltage", "4"]) == 1
    printed = capsys.readouterr().out
    assert ", has 4 V: raise the supply to" in " ".join(printed.split())
    assert printed.splitlines()[-1] == "surely not"
    assert "best gear 9.5" in printed  # sqrt(0.942 * 1 / (0.036 * 0.036 * 8)) = 9.53
    assert main([*judge, "0"]) == 2
    assert "gear_ratio = 0" in capsys.readouterr().err


def test_the_command_chooses_and_explains_rejections(tmp_path, capsys):
    assert main(["motor", "choose", "pendulum", "--top", "2", "--out", str(tmp_path)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "smallest suitable motor with a margin of 20% first" in printed
    assert "quanser-srv02 at gear 70: try it" in printed
    assert len(list(tmp_path.glob("*.png"))) == 2


def test_gears_on_a_slide_have_a_unit_and_hopeless_sets_the_exit_status(monkeypatch, capsys):
    demand = dataclasses.replace(steady(10.0, 1.0), exact=False, linear=True)
    monkeypatch.setattr("codrl_mj.sizing.demand_of", lambda *_, **__: demand)
    assert main(["motor", "feasible", "rev-neo", "cartpole"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "rev-neo, gear 1 rad/m, 12 V" in printed
    assert "share of rotor and friction in the largest load: unknown" in printed
    assert printed.endswith(" try it")
    assert main(["motor", "feasible", "rev-neo", "cartpole", "--voltage", "1"]) == 1
    assert capsys.readouterr().out.splitlines()[-1] == "hopeless"


def test_custom_motors_are_ranked_alone(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sheet = '[datasheet]\nkv = "340 rpm/V"\nresistance = "64 mohm"\ninductance = "30 uH"\n'
    Path("a.toml").write_text(sheet)
    Path("b.toml").write_text(
        f'{sheet}rotor_inertia = "60 gcm2"\ncontinuous_current = "12 A"\nnominal_voltage = "12 V"'
    )
    np.savez("joint.npz", time=np.arange(3.0), torque=np.full(3, 1.0), speed=np.full(3, 8.0))
    for words in (["a.toml", "b.toml", "joint.npz"], ["joint.npz", "a.toml", "b.toml"]):
        assert main(["motor", "choose", *words]) == 0
        printed = " ".join(capsys.readouterr().out.split())
        assert "quanser" not in printed
        assert printed.index("b.toml") < printed.index("a.toml")
        # The share of the rotor is unknown for a.toml alone.
        assert len(re.findall(r"unknown(?! and not counted)", printed)) == 1
        assert "a.toml at gear" in printed
        assert (
            "supply.voltage = 24 V, controller.max_current = inf, motor.rotor_inertia = 0"
            in printed
        )
    for words, text in (
        (["a.toml"], "got no task: name exactly one task"),
        (["pendulum", "cartpole"], "got pendulum and cartpole: name exactly one"),
        (["c.toml", "joint.npz"], "there is no such file"),
        (["pendulun", "a.toml"], "did you mean 'pendulum'"),
        (["rev-nao", "joint.npz"], "did you mean 'rev-neo'"),
    ):
        assert main(["motor", "choose", *words]) == 2
        assert text in capsys.readouterr().err
    Path("other").mkdir()
    Path("other/a.toml").write_text(sheet)
    assert (
        main(["motor", "choose", "a.toml", "other/a.toml", "joint.npz", "--out", "found"]) == 1
    )  # The duration is unknown.
    assert len(list(Path("found").glob("*-a.png"))) == 2


def test_only_runs_trained_on_the_ideal_actuator_are_accepted(tmp_path, capsys):
    folder, run = Path(__file__).parents[1] / "fixtures" / "runs" / "cartpole", tmp_path / "run"
    assert main(["motor", "choose", str(folder)]) == 2
    assert "was trained on current_loop: must be ideal" in capsys.readouterr().err
    shutil.copytree(folder, run)
    config = json.loads((run / "config.json").read_text())
    config.pop("sha256")
    config["train"]["env"]["actuator"] = None
    (run / "config.json").write_text(json.dumps(config))
    demand = demand_of(run, episodes=2)
    assert demand.source.startswith("the policy run of cartpole")
    assert set(np.abs(demand.torque)) == {10.0}
    assert demand.episodes == 2
