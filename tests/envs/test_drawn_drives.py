"""Bench motors in every task, alone and in batches, and whatever of them sits in the model drawn at resets."""

import dataclasses
import math
import re

import mujoco
import numpy as np
import pytest

from codrl_mj import Choice, Uniform
from codrl_mj.actuators import (
    DCMotorActuator,
    Drive,
    GearMotor,
    JointAdditions,
    Supply,
    field_paths,
    field_values,
    from_array,
)
from codrl_mj.envs import ActuatedEnv
from codrl_mj.validation.motor_catalogue import DriveOracle, JointOracle
from tests.envs.faces import run
from tests.envs.vectors import assert_equal_episodes, assert_same, batched, looped
from tests.matrix import matrix_params
from tests.tasks.faces import actions

# every field counts: 60 turns make the rod light for its motor, so that its speed changes within a
# step
MOTOR = GearMotor(
    *(0.942, 0.363e-3, 0.036, 0.036),
    rotor_inertia=1.35e-5,
    gear_ratio=60.0,
    gear_efficiency=0.8,
    coulomb_friction=2e-3,
    viscous_friction=1e-5,
    stribeck_friction=1e-3,
    stribeck_speed=20.0,
    stribeck_exponent=1.5,
    load_inertia=0.3,
    thermal_resistance_winding=300.0,
    thermal_time_constant_winding=1.0,
    thermal_resistance_housing=20.0,
    thermal_time_constant_housing=3.0,
    ambient_temperature=20.0,
    max_temperature=25.5,
    arm_radius=0.8,
)
SIMPLE = {
    "stribeck_friction": 0.0,
    "load_inertia": math.inf,
    **dict.fromkeys(("thermal_resistance_winding", "thermal_resistance_housing"), 0.0),
    "gear_efficiency": 1.0,
    "ambient_temperature": 25.0,
    "resistance_coefficient": 0.0,
    "max_temperature": math.inf,
}
"""What `DriveOracle` does not know, left out."""
ONE = Drive(MOTOR, supply=Supply(6.0))  # which is short at times
ADDED = {
    name: getattr(MOTOR, name) for name in ("rotor_inertia", "coulomb_friction", "viscous_friction")
}
NOMINAL = {
    path: value
    for path, value in zip(field_paths(Drive), field_values(ONE), strict=True)
    if path.startswith("motor.") and value != 0.0
}
DRAWN = {name: Uniform(0.7 * value, 1.2 * value) for name, value in NOMINAL.items()}
DRAWN["motor.max_temperature"] = Uniform(
    24.5, 26.0
)  # above all that the surroundings are drawn to be
every_field = pytest.mark.parametrize("name", NOMINAL)


def episode(env, seed=0):
    """Whatever is seen of an episode's steps, as rows; observations come first."""
    env.reset(seed=seed)
    steps = [env.step(action) for action in actions(env.task.name, 1, 12)]
    return np.array([[*step[0], *step[4].values()] for step in steps], dtype=np.float64)


def on_joint(model):
    """What the model has on the actuated joint."""
    dof = model.jnt_dofadr[model.actuator("motor").trnid[0]]
    return JointAdditions(
        *(getattr(model, f"dof_{kind}")[dof] for kind in ("armature", "damping", "frictionloss"))
    )


@every_field
def test_a_drawn_field_acts_as_in_a_drive_that_has_it(name):
    drawn = ActuatedEnv("pendulum", ONE, randomize={name: DRAWN[name]})
    found = episode(drawn, seed=3)
    part, field = name.split(".")
    assert (
        getattr(getattr(drawn.actuator, part), field) == drawn.randomization[name] != NOMINAL[name]
    )
    fixed = ActuatedEnv("pendulum", drawn.actuator)
    fixed.reset(seed=3)
    drawn.reset(seed=3)
    fixed.state = drawn.state
    for action in actions("pendulum", 1, 12):
        one, other = drawn.step(action), fixed.step(action)
        assert one[4] == other[4]
        np.testing.assert_array_equal(drawn.state, fixed.state)
    assert on_joint(drawn.model) == on_joint(fixed.model) == drawn.actuator.additions
    np.testing.assert_array_equal(drawn.model.actuator_gear, fixed.model.actuator_gear)
    np.testing.assert_array_equal(drawn.model.dof_invweight0, fixed.model.dof_invweight0)
    assert not np.array_equal(
        found, episode(ActuatedEnv("pendulum", ONE), seed=3)
    )  # it has an effect


IN_TURN = [
    "everything",
    "motor.resistance",
    "motor.rotor_inertia",
    "motor.coulomb_friction",
    "motor.gear_ratio",
]


@pytest.mark.parametrize("name", matrix_params(IN_TURN, ["everything", *NOMINAL]))
def test_a_drawn_field_is_drawn_in_a_batch_as_alone_and_brought_back(name):
    randomize = DRAWN if name == "everything" else {name: DRAWN[name]}
    arguments = {"actuator": ONE, "randomize": randomize, "max_episode_steps": 5}
    env, fresh = (batched("pendulum", 2, **arguments) for _ in range(2))
    assert_equal_episodes(env, looped("pendulum", 2, **arguments), 12)
    fresh.reset(seed=50)
    for start in (env.unwrapped.snapshot(), fresh.unwrapped.snapshot()):  # of two draws
        runs = []
        for one in (env, fresh):
            one.restore(start)
            runs.append(run(one.unwrapped, 12, seed=0))
        assert_same(*runs)


def test_before_the_first_draw_everything_is_nominal_and_can_be_again():
    alone, many = (
        ActuatedEnv("pendulum", ONE, randomize=DRAWN),
        batched("pendulum", 2, actuator=ONE, randomize=DRAWN),
    )

    def mounted():
        rows = [
            (on_joint(model), model.actuator("motor").gear[0])
            for model in many.unwrapped.physics.models()
        ]
        return [(on_joint(alone.model), alone.model.actuator("motor").gear[0]), *rows]

    nominal, starts = (
        (ONE.additions, 1.0 / ONE.arm_radius),
        [env.snapshot() for env in (alone, many)],
    )
    for env in (alone, many):
        env.reset(seed=0)
    assert len({nominal, *mounted()}) == 3  # the first of many is the one alone
    for env, start in zip((alone, many), starts, strict=True):
        env.restore(start)
    assert mounted() == [nominal] * 3


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("task", ["pendulum", "cartpole"])
def test_everything_drawn_moves_as_the_equations_say(task, seed):
    """Against Gymnasium's equations with rotor and friction, and a winding by scipy's matrix exponential."""
    # the load is heavy for this gear: with a light one the held speed rings, and rounding grows
    # threefold a step
    nominal = dataclasses.replace(ONE, motor=dataclasses.replace(MOTOR, gear_ratio=20.0, **SIMPLE))
    ranges = {name: one for name, one in DRAWN.items() if name.removeprefix("motor.") not in SIMPLE}
    ranges["motor.gear_ratio"] = Uniform(15.0, 25.0)
    env = ActuatedEnv(task, nominal, randomize=ranges)
    env.reset(seed=seed)
    one, definition, state = env.actuator, env.task, env.state
    timestep, at = definition.step_duration, definition.speed_indices[0]
    bench, mechanics = (
        DriveOracle(one, timestep),
        JointOracle(definition, one, timestep, definition.integrators[0]),
    )
    arm = one.motor.arm_radius / one.motor.gear_ratio
    for action in actions(task, seed, 30):
        force = env.setup.commands.force(action)
        env.step(action)
        state = mechanics.step(state, bench.torque(force * arm, state[at] / arm) / arm)
        np.testing.assert_allclose(env.state, state, rtol=0, atol=1e-10)


@pytest.mark.parametrize("field", ADDED)
def test_what_a_motor_lacks_can_be_drawn_and_goes_away_again(field):
    """Friction needs the engine's solver, which is on in the episodes that have some, and off in the others."""
    bare = dataclasses.replace(ONE, motor=dataclasses.replace(MOTOR, **dict.fromkeys(ADDED, 0.0)))
    arguments = {"actuator": bare, "randomize": {f"motor.{field}": Choice([0.0, ADDED[field]])}}
    env = ActuatedEnv("cartpole", **arguments)
    constraint, seen = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT), set()
    for seed in range(8):
        found = episode(env, seed)
        value = env.randomization[f"motor.{field}"]
        fixed = ActuatedEnv("cartpole", env.actuator)
        np.testing.assert_array_equal(episode(fixed, seed), found)
        assert bool(env.model.opt.disableflags & constraint) == (
            field != "coulomb_friction" or value == 0.0
        )
        assert any(on_joint(env.model)) == (value > 0.0)
        seen.add(value)
    assert seen == {0.0, ADDED[field]}
    arguments["max_episode_steps"] = 4
    assert_equal_episodes(
        batched("cartpole", 4, **arguments), looped("cartpole", 4, **arguments), 20
    )


def test_damping_is_drawn_on_top_of_the_drive_s_and_the_joint_s():
    env = ActuatedEnv(
        "pendulum",
        ONE,
        joint={"damping": 0.25, "armature": 0.5},
        randomize={"model.damping.hinge": Uniform(0.1, 0.3)},
    )
    env.reset(seed=0)
    drawn, arm = env.randomization["model.damping.hinge"], ONE.arm_radius
    assert on_joint(env.model).damping == pytest.approx(0.25 + drawn + 1e-5 / arm**2, rel=1e-14)
    assert on_joint(env.model).armature == pytest.approx(0.5 + 1.35e-5 / arm**2, rel=1e-14)
    both = {"model.damping.hinge": Uniform(0.1, 0.3), "motor.viscous_friction": Uniform(0.0, 2e-5)}
    arguments = {
        "actuator": ONE,
        "joint": {"damping": 0.25},
        "randomize": both,
        "max_episode_steps": 5,
    }
    assert_equal_episodes(
        batched("pendulum", 3, **arguments), looped("pendulum", 3, **arguments), 12
    )


@pytest.mark.parametrize(
    "randomize", [None, {"motor.gear_ratio": Uniform(10.0, 80.0)}], ids=["fixed", "drawn"]
)
def test_different_drives_bring_each_their_own_rotor_and_friction(randomize):
    frictions = {"coulomb_friction": 0.0, "viscous_friction": 0.0}
    drives = [ONE, Drive(), Drive(dataclasses.replace(MOTOR, rotor_inertia=2e-4, **frictions))]
    arguments = {
        "actuator": drives,
        "max_episode_steps": 6,
        **({"randomize": randomize} if randomize else {}),
    }
    env = batched("pendulum", 3, **arguments)
    assert_equal_episodes(env, looped("pendulum", 3, **arguments), 15)
    if randomize is None:
        assert [on_joint(model) for model in env.unwrapped.physics.models()] == [
            one.additions for one in drives
        ]


@every_field
def test_gymnasium_s_equations_refuse_by_name_what_they_have_no_place_for(name):
    bare = dataclasses.replace(ONE, motor=dataclasses.replace(MOTOR, **dict.fromkeys(ADDED, 0.0)))
    arguments = {
        "actuator": bare,
        "physics": "analytic",
        "randomize": {name: DRAWN[name]},
        "inner_steps": 5,
    }
    if name.removeprefix("motor.") in {"gear_ratio", "arm_radius", *ADDED}:
        with pytest.raises(
            ValueError, match=rf"cannot draw {re.escape(name)}: .*friction and rotors; use"
        ):
            ActuatedEnv("pendulum", **arguments)
    else:
        episode(ActuatedEnv("pendulum", **arguments))


def test_where_a_current_is_commanded_a_rotor_is_drawn_and_what_would_change_its_meaning_is_not():
    env = ActuatedEnv(
        "pendulum", ONE, action="current", randomize={"motor.rotor_inertia": Uniform(1e-6, 1e-5)}
    )
    env.reset(seed=0)
    assert on_joint(env.model).armature == env.actuator.additions.armature != ONE.additions.armature
    with pytest.raises(
        ValueError, match=r"motor\.gear_ratio.*it would change what an action means"
    ):
        ActuatedEnv(
            "pendulum", ONE, action="current", randomize={"motor.gear_ratio": Uniform(1.0, 2.0)}
        )


@pytest.mark.parametrize("one", [ONE, DCMotorActuator()], ids=["drive", "current loop"])
def test_an_unchecked_actuator_follows_as_a_checked_one(one):
    twin = from_array(type(one), field_values(one))
    assert (twin.arm_radius, twin.additions) == (one.arm_radius, one.additions)
