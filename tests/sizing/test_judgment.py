"""Judgments of motors: equal in `feasible` and `choose`, and consistent with trained policies."""

import csv
import dataclasses
import functools
import math
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from codrl_mj.actuators import Drive, GearMotor, SampledLoop, Supply, resolve
from codrl_mj.agents import SACConfig
from codrl_mj.cli import main
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import RandomPolicy
from codrl_mj.sizing import (
    DEPENDS,
    HOPELESS,
    SURELY,
    SURELY_NOT,
    TRY_IT,
    choose,
    demand_from_arrays,
    demand_of,
    demands_of,
    equivalent_gears,
    feasibility,
    find_drive,
    with_best_gear,
)
from codrl_mj.training import TrainConfig
from tests.external_envs.models import ARM, ArmEnv
from tests.matrix import matrix_params

DOCS = Path(__file__).parents[2] / "docs"
LIGHT = 1e-12
"""A rotor's inertia [kg*m^2] that is known and does not matter: motors of the studies have none."""
COOL = math.inf
POLOLU = """
[datasheet]
gear_ratio = "18.75:1"
shaft = "output"
nominal_voltage = "12 V"
stall_torque = "8.5 kg.cm"
stall_current = "5.5 A"
no_load_speed = "530 rpm"
no_load_current = "0.2 A"
inductance = "1.5 mH"
"""


@pytest.fixture(scope="module")
def furuta():
    return demand_of("furuta", episodes=2)


@pytest.fixture
def pololu(tmp_path):
    """Return the datasheet of a geared motor, without the rotor's inertia and with 10 g*cm^2."""
    files = tmp_path / "unknown.toml", tmp_path / "known.toml"
    files[0].write_text(POLOLU)
    files[1].write_text(f'{POLOLU}rotor_inertia = "10 g*cm^2 at motor"\n')
    return files


def swinging(torque=0.1, amplitude=1.0, omega=4.0, **changes):
    """Return a demand over one period of an oscillation, with a torque in phase with the angle."""
    time = np.linspace(0.0, 2.0 * math.pi / omega, 2001)
    demand = demand_from_arrays(
        time, torque * np.cos(omega * time), amplitude * omega * np.cos(omega * time)
    )
    return dataclasses.replace(demand, exact=False, **changes)


def drive(voltage=24.0, **motor):
    fields = {
        "resistance": 1.0,
        "inductance": 1e-6,
        "torque_constant": 0.05,
        "back_emf_constant": 0.05,
        **motor,
    }
    return Drive(GearMotor(**fields), SampledLoop(), Supply(voltage))


# -- trained policies ---


def published():
    """Return task, actuator, score and success of every published row with a motor."""
    rows = {}
    for study in ("actuators", "insurance"):
        with (DOCS / "results" / study / "trials.csv").open() as file:
            for row in csv.DictReader(file):
                if "'family': 'drive'" in row["actuator"]:
                    rows.setdefault((row["task"], row["actuator"]), []).append(
                        (float(row["score"]), float(row["success"]))
                    )
    return rows


@pytest.mark.parametrize(
    "task",
    matrix_params(
        ["pendulum"],
        ["pendulum", "cartpole", "acrobot", "furuta", "mountain_car", "mountain_car_continuous"],
    ),
)
def test_no_published_row_contradicts_a_verdict(task):
    """Surely: the policies score 0.9 or more. Hopeless, surely not: all trained policies fail."""
    demand, verdicts = demand_of(task, episodes=2), []
    for (of, actuator), outcomes in published().items():
        if of != task:
            continue
        motor = resolve(
            eval(actuator, {"inf": math.inf, "nan": math.nan}), None, task
        )  # a dict, as str prints it
        if motor.motor.rotor_inertia == 0.0:
            motor = motor.replaced({"motor.rotor_inertia": LIGHT})
        verdict = feasibility(motor, demand, COOL).verdict
        verdicts.append(verdict)
        if verdict == SURELY:
            assert min(score for score, _ in outcomes) >= 0.9, actuator
        if verdict in (HOPELESS, SURELY_NOT):
            assert max(success for _, success in outcomes) <= 0.2, actuator
    assert len(verdicts) >= 7
    assert TRY_IT in verdicts


def test_no_policy_trained_through_the_motor_contradicts_a_verdict(furuta):
    """Policies of one seed each, trained through a Pololu 37D at 12 V: docs/motor_verdicts.csv."""
    with (DOCS / "motor_verdicts.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        numbers = (
            "resistance",
            "inductance",
            "torque_constant",
            "back_emf_constant",
            "rotor_inertia",
            "gear_ratio",
        )
        numbers += ("gear_efficiency", "coulomb_friction", "viscous_friction")
        judgment = feasibility(
            drive(float(row["voltage"]), **{name: float(row[name]) for name in numbers}),
            furuta,
            COOL,
        )
        assert judgment.verdict == row["verdict"]
        assert judgment.operating_points.own_share == pytest.approx(
            float(row["own_share"]), rel=0.05
        )
        assert judgment.verdict != SURELY or float(row["success"]) >= 0.9
        assert judgment.verdict not in (HOPELESS, SURELY_NOT) or float(row["success"]) <= 0.2
    assert {SURELY, TRY_IT} == {row["verdict"] for row in rows}
    assert any(
        float(row["success"]) == 0.0 for row in rows
    )  # An earlier version judged this surely.


# -- rotor and friction ---


def test_the_shares_of_rotor_and_friction_are_part_of_the_judgment():
    """The inertia's share is N^2 J alpha over tau, the friction's N tau_c over tau."""
    demand = swinging()  # 0.1 N*m, 16 rad/s^2
    limit = 0.5 * 0.1 / 16.0
    for inertia, verdict in ((0.98 * limit, SURELY), (1.02 * limit, TRY_IT)):
        assert feasibility(drive(rotor_inertia=inertia), demand, COOL).verdict == verdict
    heavy = feasibility(drive(rotor_inertia=4.0 * limit, gear_ratio=3.0), demand, COOL)
    (rotor,) = heavy.failed_bounds
    assert (rotor.name, rotor.available) == ("rotor", 50.0)
    assert rotor.needed == pytest.approx(50.0 * 36.0, rel=1e-3)
    assert "lower the gear to" not in rotor.remedy  # The gear would be 0.5.
    within = feasibility(drive(rotor_inertia=limit / 4.0, gear_ratio=3.0), demand, COOL)
    assert "lower the gear to 2, or let policies command voltage" in within.reason
    for friction, verdict in ((0.00249, SURELY), (0.00251, TRY_IT)):
        rubbing = drive(rotor_inertia=LIGHT, coulomb_friction=friction, gear_ratio=2.0)
        assert feasibility(rubbing, demand, COOL).verdict == verdict
    (rubs,) = feasibility(
        drive(rotor_inertia=LIGHT, coulomb_friction=0.01, gear_ratio=4.0), demand, COOL
    ).failed_bounds
    assert rubs.needed == pytest.approx(40.0)
    assert "take a smaller motor, or train with it" in rubs.remedy


def test_a_motor_on_which_policies_failed_is_not_judged_surely(furuta, pololu):
    """An earlier version judged each gear surely; with 18.75, policies succeed in 0 %."""
    gears = (50.0, 6.25, 18.75, 30.0)
    choices = choose(furuta, [str(pololu[1])], gears=gears)
    assert [choice.ratio for choice in choices] == pytest.approx(sorted(gears))
    assert {choice.feasibility.verdict for choice in choices} == {TRY_IT}
    shares = [choice.feasibility.operating_points.own_share for choice in choices]
    assert shares == sorted(shares)
    assert shares[0] < 0.5 < 1.0 < shares[1] < 3.0 < shares[2]
    assert all(
        "friction: Coulomb friction, share of the largest load" in choice.rejection_reason
        for choice in choices
    )


# -- unknown numbers ---


def test_an_unknown_rotor_inertia_gives_it_depends_with_its_limit():
    demand = swinging()
    unknown = feasibility(drive(rotor_inertia=0.0), demand, COOL)
    assert unknown.verdict == DEPENDS
    (rotor,) = unknown.failed_bounds
    assert rotor.available == pytest.approx(0.5 * 0.1 / 16.0, rel=2e-3)
    assert (
        "its inertia is not known: give rotor_inertia, must be at most 0.00312 kg*m^2 at the motor"
        in unknown.reason
    )
    for share, verdict in ((0.99, SURELY), (1.01, TRY_IT)):
        assert (
            feasibility(drive(rotor_inertia=share * rotor.available), demand, COOL).verdict
            == verdict
        )
    steady = dataclasses.replace(
        demand_from_arrays(np.arange(3.0), np.full(3, 0.1), np.full(3, 1.0)), exact=False
    )
    assert (
        feasibility(drive(rotor_inertia=0.0), steady, COOL).verdict == SURELY
    )  # Nothing accelerates.


def test_an_unknown_continuous_current_gives_it_depends_on_heat():
    judgment = feasibility(drive(rotor_inertia=LIGHT), swinging())
    assert judgment.verdict == DEPENDS
    rms = 0.1 / 0.05 / math.sqrt(2.0)
    assert (
        f"heat: its continuous current is not known, must be at least {rms:.3g} A"
        in judgment.reason
    )


# -- the same judgment ---


def test_feasible_and_choose_give_the_same_judgment_and_text(furuta, pololu, capsys, monkeypatch):
    monkeypatch.setattr("codrl_mj.sizing.demand_of", lambda *_, **__: furuta)
    for name in (*map(str, pololu), "quanser-qube-servo-2", "maxon-re65"):
        (choice,) = choose(furuta, [name])
        assert choice.feasibility.reason in choice.rejection_reason
        assert (
            main(["motor", "feasible", name, "furuta", "--gear-ratio", f"{choice.ratio:.9g}"]) == 0
        )
        printed = " ".join(capsys.readouterr().out.split())
        assert printed.endswith(f" {choice.feasibility.verdict}")
        for bound in choice.feasibility.failed_bounds:
            assert str(bound) in printed
            assert str(bound) in choice.rejection_reason


def test_both_verbs_find_the_same_gear_with_a_ratio_of_at_least_1(furuta):
    ec45, re65 = (find_drive(name) for name in ("maxon-ec45-flat-50w", "maxon-re65"))
    for motor in (ec45, re65):
        assert with_best_gear(motor, furuta).motor.gear_ratio >= 1.0
    (choice,) = choose(furuta, ["maxon-ec45-flat-50w"])
    assert choice.ratio == pytest.approx(
        with_best_gear(ec45, furuta, 2.52).motor.gear_ratio, rel=0.02
    )
    best, demand = (
        with_best_gear(find_drive("quanser-qube-servo-3"), swinging(1.0, 2.0)),
        swinging(1.0, 2.0),
    )
    low, high = equivalent_gears(best, demand)
    verdict = feasibility(best, demand).verdict
    assert low < 1.0 / best.arm_radius < high
    for ratio, same in (
        (1.01 * low, True),
        (0.97 * low, False),
        (0.99 * high, True),
        (1.03 * high, False),
    ):
        assert (
            feasibility(best.replaced({"motor.gear_ratio": ratio}), demand).verdict == verdict
        ) == same


def test_both_verbs_respect_a_largest_current(furuta, capsys, monkeypatch):
    monkeypatch.setattr("codrl_mj.sizing.demand_of", lambda *_, **__: furuta)
    (choice,) = choose(furuta, ["quanser-qube-servo-3"], max_current=0.2)
    assert choice.drive.controller.max_current == 0.2
    assert "current: |i|, largest" in choice.rejection_reason
    assert (
        main(["motor", "feasible", "quanser-qube-servo-3", "furuta", "--max-current", "0.2"]) == 0
    )
    printed = " ".join(capsys.readouterr().out.split())
    assert "A, has 0.2 A: raise controller.max_current" in printed
    assert printed.endswith(" try it")


def test_the_command_line_judges_given_gears(tmp_path, pololu, furuta, capsys, monkeypatch):
    monkeypatch.setattr("codrl_mj.sizing.demands_of", lambda *_, **__: {"": furuta})
    line = [
        "motor",
        "choose",
        str(pololu[1]),
        "furuta",
        "--gears",
        "6.25",
        "18.75",
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(line) == 1  # No gear is suitable.
    printed = " ".join(capsys.readouterr().out.split())
    assert "known.toml at gear 6.25: try it. friction" in printed
    assert "known.toml at gear 18.75: try it. rotor" in printed
    assert "no motor is surely suitable with that margin; the nearest was written" in printed
    assert sorted(path.name for path in (tmp_path / "out").glob("*.png")) == [
        "known-18.75.png",
        "known-6.25.png",
    ]
    assert main([*line[:5], "0"]) == 2
    assert "gear_ratio = 0" in capsys.readouterr().err


# -- peaks and servos ---


def test_a_brief_peak_is_not_hopeless_but_a_lasting_load_is():
    for share, verdict in ((0.005, TRY_IT), (0.02, HOPELESS)):
        torque = np.full(1000, 0.01)
        torque[: int(1000 * share)] = 10.0  # 20 V of 24 at 0.01 N*m would be 0.2; here 200 V
        demand = dataclasses.replace(
            demand_from_arrays(1e-2 * np.arange(1000), torque, np.full(1000, 1.0)), exact=False
        )
        assert feasibility(drive(12.0, rotor_inertia=LIGHT), demand, COOL).verdict == verdict


def test_a_slower_servo_is_never_hopeless():
    demand = swinging(10.0, 100.0)
    assert feasibility(drive(12.0, rotor_inertia=LIGHT), demand, COOL).verdict == HOPELESS
    slower = feasibility(
        drive(12.0, rotor_inertia=LIGHT), dataclasses.replace(demand, servo=True), COOL
    )
    assert slower.verdict == TRY_IT
    assert (
        "a servo asks for less if the motor is slower: evaluate the run on this motor"
        in slower.reason
    )


def test_a_run_reports_which_motors_have_a_servo(tmp_path, monkeypatch):
    """The arm has a position servo and a plain motor; the run's policy acts at random."""
    (tmp_path / "arm.xml").write_text(ARM.replace('gear="5"', 'gear="5" ctrlrange="-1 1"'))
    gymnasium.register(
        "JudgedArm-v0", functools.partial(ArmEnv, tmp_path / "arm.xml"), max_episode_steps=20
    )
    try:
        settings = TrainConfig(EnvConfig("JudgedArm-v0", {".*": "ideal"}), SACConfig())
        monkeypatch.setattr("codrl_mj.sizing.demand.load_config", lambda *_: settings)
        monkeypatch.setattr(
            "codrl_mj.sizing.demand.load_policy", lambda *_: RandomPolicy(settings.env.action_space)
        )
        demands = demands_of(tmp_path, episodes=1)
    finally:
        gymnasium.registry.pop("JudgedArm-v0")
    assert {name: demand.servo for name, demand in demands.items()} == {
        "servo": True,
        "motor": False,
    }
