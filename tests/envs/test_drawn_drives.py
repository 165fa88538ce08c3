"""Motors from datasheets in tasks and batches, with randomized parts in the model."""

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
from tests.conformance.episodes import assert_same, run
from tests.envs.vectors import assert_equal_episodes, batched, looped
from tests.matrix import matrix_params
from tests.tasks.faces import actions

# Every field has an effect: the ratio of 60 makes the rod light for its motor, so that its speed
# changes within a step.
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
"""Values that remove effects which `DriveOracle` does not model."""
# The voltage of the supply is sometimes too low.
NOMINAL_DRIVE = Drive(MOTOR, supply=Supply(6.0))
JOINT_FIELDS = {
    name: getattr(MOTOR, name) for name in ("rotor_inertia", "coulomb_friction", "viscous_friction")
}
NOMINAL = {
    path: value
    for path, value in zip(field_paths(Drive), field_values(NOMINAL_DRIVE), strict=True)
    if path.startswith("motor.") and value != 0.0
}
RANGES = {name: Uniform(0.7 * value, 1.2 * value) for name, value in NOMINAL.items()}
# The limit stays above all drawn ambient temperatures.
RANGES["motor.max_temperature"] = Uniform(24.5, 26.0)
every_field = pytest.mark.parametrize("name", NOMINAL)


def episode(env, seed=0):
    """Return observations and signals of an episode's steps as rows; observations come first."""
    env.reset(seed=seed)
    steps = [env.step(action) for action in actions(env.task.name, 1, 12)]
    return np.array([[*step[0], *step[4].values()] for step in steps], dtype=np.float64)


def joint_additions(model):
    """Return the model's values on the actuated joint."""
    dof = model.jnt_dofadr[model.actuator("motor").trnid[0]]
    return JointAdditions(
        *(getattr(model, f"dof_{kind}")[dof] for kind in ("armature", "damping", "frictionloss"))
    )


@every_field
def test_a_drawn_field_acts_as_in_a_drive_with_that_value(name):
    randomized_env = ActuatedEnv("pendulum", NOMINAL_DRIVE, randomize={name: RANGES[name]})
    rows = episode(randomized_env, seed=3)
    part, field = name.split(".")
    assert (
        getattr(getattr(randomized_env.actuator, part), field)
        == randomized_env.randomization[name]
        != NOMINAL[name]
    )
    fixed_env = ActuatedEnv("pendulum", randomized_env.actuator)
    fixed_env.reset(seed=3)
    randomized_env.reset(seed=3)
    fixed_env.state = randomized_env.state
    for action in actions("pendulum", 1, 12):
        outcome, expected = randomized_env.step(action), fixed_env.step(action)
        assert outcome[4] == expected[4]
        np.testing.assert_array_equal(randomized_env.state, fixed_env.state)
    assert (
        joint_additions(randomized_env.model)
        == joint_additions(fixed_env.model)
        == randomized_env.actuator.additions
    )
    np.testing.assert_array_equal(randomized_env.model.actuator_gear, fixed_env.model.actuator_gear)
    np.testing.assert_array_equal(
        randomized_env.model.dof_invweight0, fixed_env.model.dof_invweight0
    )
    # The field must have an effect.
    assert not np.array_equal(rows, episode(ActuatedEnv("pendulum", NOMINAL_DRIVE), seed=3))


IN_TURN = [
    "everything",
    "motor.resistance",
    "motor.rotor_inertia",
    "motor.coulomb_friction",
    "motor.gear_ratio",
]


@pytest.mark.parametrize("name", matrix_params(IN_TURN, ["everything", *NOMINAL]))
def test_a_batch_draws_and_restores_fields_as_a_single_environment(name):
    randomize = RANGES if name == "everything" else {name: RANGES[name]}
    arguments = {"actuator": NOMINAL_DRIVE, "randomize": randomize, "max_episode_steps": 5}
    env, other_env = (batched("pendulum", 2, **arguments) for _ in range(2))
    assert_equal_episodes(env, looped("pendulum", 2, **arguments), 12)
    other_env.reset(seed=50)
    # The two snapshots have different draws.
    for start_snapshot in (env.unwrapped.snapshot(), other_env.unwrapped.snapshot()):
        runs = []
        for each_env in (env, other_env):
            each_env.restore(start_snapshot)
            runs.append(run(each_env.unwrapped, 12, seed=0))
        assert_same(*runs)


def test_everything_is_nominal_before_the_first_reset_and_after_restoring_that_state():
    single_env, vector_env = (
        ActuatedEnv("pendulum", NOMINAL_DRIVE, randomize=RANGES),
        batched("pendulum", 2, actuator=NOMINAL_DRIVE, randomize=RANGES),
    )

    def mountings():
        rows = [
            (joint_additions(model), model.actuator("motor").gear[0])
            for model in vector_env.unwrapped.physics.models()
        ]
        return [
            (joint_additions(single_env.model), single_env.model.actuator("motor").gear[0]),
            *rows,
        ]

    nominal, start_snapshots = (
        (NOMINAL_DRIVE.additions, 1.0 / NOMINAL_DRIVE.arm_radius),
        [env.snapshot() for env in (single_env, vector_env)],
    )
    for env in (single_env, vector_env):
        env.reset(seed=0)
    # The vector's first environment has the same seed as the single one.
    assert len({nominal, *mountings()}) == 3
    for env, start_snapshot in zip((single_env, vector_env), start_snapshots, strict=True):
        env.restore(start_snapshot)
    assert mountings() == [nominal] * 3


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("task", ["pendulum", "cartpole"])
def test_a_randomized_drive_follows_the_equations(task, seed):
    """Compare with Gymnasium's equations with rotor and friction, and a matrix exponential."""
    # The load is heavy for this gear: with a light one the held speed oscillates, and rounding
    # errors grow threefold per step.
    nominal = dataclasses.replace(
        NOMINAL_DRIVE, motor=dataclasses.replace(MOTOR, gear_ratio=20.0, **SIMPLE)
    )
    ranges = {
        name: distribution
        for name, distribution in RANGES.items()
        if name.removeprefix("motor.") not in SIMPLE
    }
    ranges["motor.gear_ratio"] = Uniform(15.0, 25.0)
    env = ActuatedEnv(task, nominal, randomize=ranges)
    env.reset(seed=seed)
    actuator, definition, state = env.actuator, env.task, env.state
    timestep, speed_index = definition.step_duration, definition.speed_indices[0]
    bench, mechanics = (
        DriveOracle(actuator, timestep),
        JointOracle(definition, actuator, timestep, definition.integrators[0]),
    )
    arm = actuator.motor.arm_radius / actuator.motor.gear_ratio
    for action in actions(task, seed, 30):
        force = env.setup.commands.force(action)
        env.step(action)
        state = mechanics.step(state, bench.torque(force * arm, state[speed_index] / arm) / arm)
        np.testing.assert_allclose(env.state, state, rtol=0, atol=1e-10)


@pytest.mark.parametrize("field", JOINT_FIELDS)
def test_quantities_that_the_nominal_motor_lacks_can_be_drawn(field):
    """Check friction, whose solver in the engine is only on in episodes with friction."""
    bare_drive = dataclasses.replace(
        NOMINAL_DRIVE, motor=dataclasses.replace(MOTOR, **dict.fromkeys(JOINT_FIELDS, 0.0))
    )
    arguments = {
        "actuator": bare_drive,
        "randomize": {f"motor.{field}": Choice([0.0, JOINT_FIELDS[field]])},
    }
    env = ActuatedEnv("cartpole", **arguments)
    constraint, seen_values = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT), set()
    for seed in range(8):
        rows = episode(env, seed)
        value = env.randomization[f"motor.{field}"]
        fixed_env = ActuatedEnv("cartpole", env.actuator)
        np.testing.assert_array_equal(episode(fixed_env, seed), rows)
        assert bool(env.model.opt.disableflags & constraint) == (
            field != "coulomb_friction" or value == 0.0
        )
        assert any(joint_additions(env.model)) == (value > 0.0)
        seen_values.add(value)
    assert seen_values == {0.0, JOINT_FIELDS[field]}
    arguments["max_episode_steps"] = 4
    assert_equal_episodes(
        batched("cartpole", 4, **arguments), looped("cartpole", 4, **arguments), 20
    )


def test_drawn_damping_is_added_to_that_of_the_drive_and_the_joint():
    env = ActuatedEnv(
        "pendulum",
        NOMINAL_DRIVE,
        joint={"damping": 0.25, "armature": 0.5},
        randomize={"model.damping.hinge": Uniform(0.1, 0.3)},
    )
    env.reset(seed=0)
    drawn_damping, arm = env.randomization["model.damping.hinge"], NOMINAL_DRIVE.arm_radius
    assert joint_additions(env.model).damping == pytest.approx(
        0.25 + drawn_damping + 1e-5 / arm**2, rel=1e-14
    )
    assert joint_additions(env.model).armature == pytest.approx(0.5 + 1.35e-5 / arm**2, rel=1e-14)
    both_dampings = {
        "model.damping.hinge": Uniform(0.1, 0.3),
        "motor.viscous_friction": Uniform(0.0, 2e-5),
    }
    arguments = {
        "actuator": NOMINAL_DRIVE,
        "joint": {"damping": 0.25},
        "randomize": both_dampings,
        "max_episode_steps": 5,
    }
    assert_equal_episodes(
        batched("pendulum", 3, **arguments), looped("pendulum", 3, **arguments), 12
    )


@pytest.mark.parametrize(
    "randomize", [None, {"motor.gear_ratio": Uniform(10.0, 80.0)}], ids=["fixed", "drawn"]
)
def test_each_environment_has_the_rotor_and_friction_of_its_drive(randomize):
    frictions = {"coulomb_friction": 0.0, "viscous_friction": 0.0}
    drives = [
        NOMINAL_DRIVE,
        Drive(),
        Drive(dataclasses.replace(MOTOR, rotor_inertia=2e-4, **frictions)),
    ]
    arguments = {
        "actuator": drives,
        "max_episode_steps": 6,
        **({"randomize": randomize} if randomize else {}),
    }
    env = batched("pendulum", 3, **arguments)
    assert_equal_episodes(env, looped("pendulum", 3, **arguments), 15)
    if randomize is None:
        assert [joint_additions(model) for model in env.unwrapped.physics.models()] == [
            drive.additions for drive in drives
        ]


@every_field
def test_raises_for_fields_that_gymnasiums_equations_do_not_contain(name):
    bare_drive = dataclasses.replace(
        NOMINAL_DRIVE, motor=dataclasses.replace(MOTOR, **dict.fromkeys(JOINT_FIELDS, 0.0))
    )
    arguments = {
        "actuator": bare_drive,
        "physics": "analytic",
        "randomize": {name: RANGES[name]},
        "inner_steps": 5,
    }
    if name.removeprefix("motor.") in {"gear_ratio", "arm_radius", *JOINT_FIELDS}:
        with pytest.raises(
            ValueError, match=rf"cannot draw {re.escape(name)}: .*friction and rotors; use"
        ):
            ActuatedEnv("pendulum", **arguments)
    else:
        episode(ActuatedEnv("pendulum", **arguments))


def test_a_current_command_allows_to_draw_the_rotor_but_not_the_gear_ratio():
    env = ActuatedEnv(
        "pendulum",
        NOMINAL_DRIVE,
        action="current",
        randomize={"motor.rotor_inertia": Uniform(1e-6, 1e-5)},
    )
    env.reset(seed=0)
    assert (
        joint_additions(env.model).armature
        == env.actuator.additions.armature
        != NOMINAL_DRIVE.additions.armature
    )
    with pytest.raises(
        ValueError, match=r"motor\.gear_ratio.*it would change what an action means"
    ):
        ActuatedEnv(
            "pendulum",
            NOMINAL_DRIVE,
            action="current",
            randomize={"motor.gear_ratio": Uniform(1.0, 2.0)},
        )


@pytest.mark.parametrize(
    "actuator", [NOMINAL_DRIVE, DCMotorActuator()], ids=["drive", "current loop"]
)
def test_an_actuator_from_an_array_has_the_same_arm_and_additions(actuator):
    unchecked = from_array(type(actuator), field_values(actuator))
    assert (unchecked.arm_radius, unchecked.additions) == (actuator.arm_radius, actuator.additions)
