"""Errors for bad input name field, value and bound, and change nothing."""

import functools
import math
import re

import gymnasium
import numpy as np
import pytest

from codrl_mj import Choice, LogUniform, Uniform, make_vec
from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Drive, GearMotor, Motor
from codrl_mj.envs import ActuatedEnv, ActuatedVectorEnv
from codrl_mj.physics import PHYSICS
from codrl_mj.tasks import TASKS, named_actuator
from tests.conformance.environments import commanded
from tests.conformance.episodes import assert_same, random_actions
from tests.envs.vectors import MODES, batched

INF, NAN = math.inf, math.nan
STABLE = DCMotorActuator(Motor(), CurrentLoop(kp=1.0))
UNSTABLE = DCMotorActuator(Motor(arm_radius=0.15), CurrentLoop(kp=100.0, max_voltage=INF))
WILD = DCMotorActuator(Motor(), CurrentLoop(kp=1000.0, max_voltage=INF))
GEARED = Drive(GearMotor(rotor_inertia=0.001, gear_ratio=20.0))
WEAK, IDEAL = named_actuator("weak", "pendulum"), {"family": "ideal"}
CURRENT = {"action": "current", "levels": (-1.0, 1.0)}
VOLTAGE = {"action": "voltage", "levels": (-1.0, 1.0)}


# -- arguments ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "cartpol"}, "unknown task 'cartpol': did you mean 'cartpole'"),
        ({"task": "xyz"}, "unknown task 'xyz': Known: "),
        ({"actuator": "papr"}, "unknown actuator 'papr': did you mean 'paper'"),
        ({"actuator": 3.0}, "actuator = 3.0: must be a name"),
        (
            {"actuator": {"motor": {"resistanze": 1}}},
            "motor.resistanze; did you mean motor.resistance?",
        ),
        (
            {"actuator": {"motor": {"resistance": -1.0}}},
            "Motor.resistance = -1.0: must be a finite number > 0",
        ),
        (
            {"actuator": IDEAL | {"controller": {"current_noise": 0.1}}},
            "unknown actuator field controller",
        ),
        ({"actuator": IDEAL | {"supply": {"resistance": 1}}}, "unknown actuator field supply"),
        ({"physics": "bullet"}, "unknown physics 'bullet': Known: mujoco, analytic"),
        ({"integrator": "rk45"}, "integrator = 'rk45': cartpole has euler, semi-implicit"),
        *(
            ({"inner_steps": bad}, f"inner_steps = {bad!r}: must be an integer >= 1")
            for bad in (0, 1.5, 2.0, True, "2")
        ),
        *(
            ({"timestep": bad}, f"timestep = {bad!r}: must be a finite number > 0")
            for bad in (0.0, -0.01, NAN, INF, "1")
        ),
        (
            {"timestep": 0.015},
            "timestep = 0.015 s does not divide cartpole's environment step of 0.02 s",
        ),
        (
            {"inner_steps": 2, "timestep": 0.01},
            "inner_steps = 2 and timestep = 0.01: give one of them, not both",
        ),
        (
            {"centre_radius": 0.1},
            "'centre_radius' of cartpole: did you mean 'center_radius'? it has center_radius, ",
        ),
        ({"center_radius": -0.1}, "center_radius = -0.1: must be a number > 0"),
        ({"center_radius": NAN}, "center_radius = nan: must be a number > 0"),
        ({"center_radius": "0.1"}, "center_radius = '0.1': must be a number > 0"),
        ({"center_radius": True}, "center_radius = True: must be a number > 0"),
        ({"action": "torque"}, "action = 'torque': must be one of force, current, voltage"),
        ({"levels": (0.0, 1.0)}, "only for action='current' and action='voltage'"),
        (
            {**VOLTAGE, "task": "pendulum"},
            "only for tasks with discrete actions; pendulum's are continuous",
        ),
        (
            {"action": "current", "actuator": "ideal"},
            "the ideal actuator has no current to command",
        ),
        (
            {"max_episode_steps": 9},
            "max_episode_steps = 9: the environment itself has no time limit",
        ),
        ({"task": "Hopper-v5"}, "task = 'Hopper-v5': must be a task; use codrl_mj.make for others"),
        (
            {"action": "voltage", "actuator": "ideal"},
            "the ideal actuator has no voltage to command",
        ),
        (
            {"observe_actuator": True, "actuator": "ideal"},
            "observe_actuator=True: the ideal actuator has no current",
        ),
        (
            {"action": "voltage", "actuator": {"controller": {"max_voltage": INF}}},
            "action = 'voltage': needs a finite controller.max_voltage, it is inf",
        ),
        # |1 - (1 + 100) * 0.02 / 0.1| = 19.2; inner steps below 2 L / (R + kp) = 0.00198 s are
        # stable.
        ({"actuator": UNSTABLE}, "unstable at a step of 0.02 s: spectral radius 19.2, must be < 1"),
        ({"actuator": UNSTABLE, "inner_steps": 10}, "unstable at a step of 0.002 s"),
        # |1 - R dt / L| = 2
        (
            {**VOLTAGE, "actuator": DCMotorActuator(Motor(resistance=15.0))},
            "unstable at a step of 0.02 s",
        ),
        ({"actuator": {"supply": {"resistance": 9.0}}}, "supply.resistance = 9: must be < "),
        ({"physics": "analytic", "joint": {"damping": 0.1}}, "use physics='mujoco'"),
        ({"physics": "analytic", "joint": {"friction": 0.1}}, "no term for it"),
        ({"physics": "analytic", "joint": {"armature": 0.1}}, "joint.armature = 0.1"),
        (
            {"render_mode": "rgb_array", "camera": "fixd"},
            "camera = 'fixd': did you mean 'fixed'? The model's cameras are fixed, close",
        ),
        (
            {"render_mode": "rgb_array", "width": 0},
            "width = 0: must be an integer from 1 to 3840 [px]",
        ),
        (
            {"render_mode": "rgb_array", "width": 3841},
            "width = 3841: must be an integer from 1 to 3840 [px]",
        ),
        (
            {"render_mode": "rgb_array", "height": 2161},
            "height = 2161: must be an integer from 1 to 2160 [px]",
        ),
        (
            {"render_mode": "rgb_array", "height": 100.5},
            "height = 100.5: must be an integer from 1 to 2160 [px]",
        ),
        (
            {"render_mode": "rgb_array", "height": True},
            "height = True: must be an integer from 1 to 2160 [px]",
        ),
        (
            {"render_mode": "rgb_array", "physics": "analytic", "camera": "fixd"},
            "camera = 'fixd': did you mean 'fixed'?",
        ),
    ],
)
def test_raises_for_a_bad_argument_of_a_single_environment(arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        ActuatedEnv(**{"task": "cartpole", **arguments})


def make_serial(task, num_envs, **arguments):
    return make_vec(task, num_envs, physics="analytic", **arguments)


@pytest.mark.parametrize("make", [ActuatedVectorEnv, make_serial])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs = 0: must be an integer >= 1"),
        ({"num_envs": 1.5}, "num_envs = 1.5: must be an integer >= 1"),
        ({"num_envs": True}, "num_envs = True: must be an integer >= 1"),
        ({"max_episode_steps": 0}, "max_episode_steps = 0: must be an integer >= 1"),
        ({"max_episode_steps": 1.5}, "max_episode_steps = 1.5: must be an integer >= 1"),
        ({"max_episode_steps": True}, "max_episode_steps = True: must be an integer >= 1"),
        ({"task": "pendulm"}, "unknown task 'pendulm': did you mean 'pendulum'"),
        ({"centre_radius": 0.1}, "unknown option 'centre_radius' of pendulum: it has none"),
        ({"actuator": [WEAK] * 2}, "actuator: got 2 actuators for 3 environments; give one for"),
        ({"actuator": [WEAK] * 4}, "actuator: got 4 actuators for 3 environments; give one for"),
        ({"actuator": []}, "actuator: got 0 actuators for 3 environments; give one for"),
    ],
)
def test_raises_for_a_bad_argument_of_a_vector_environment(make, arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        make(**{"task": "pendulum", "num_envs": 3, **arguments})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"physics": "analytic"},
            "one Gymnasium environment at a time: use vectorization_mode='sync'",
        ),
        ({"num_threads": -1}, "num_threads = -1: must be an integer >= 0"),
        ({"num_threads": "2"}, "num_threads = '2': must be an integer >= 0"),
        ({"autoreset_mode": "Sometimes"}, "'Sometimes' is not a valid AutoresetMode"),
        ({"render_mode": "human"}, "render_mode = 'human': must be one of None, rgb_array"),
        ({"render_mode": "rgb_array", "camera": "far"}, "camera = 'far'"),
        ({"actuator": [STABLE, "ideal", STABLE]}, "actuator[1] = 'ideal': must not be ideal"),
        ({"actuator": ["weak", None, "weak"]}, "actuator[1] = None: must not be ideal"),
        (
            {"actuator": ["weak", "weka", "weak"]},
            "actuator[1]: unknown actuator 'weka': did you mean 'weak'?",
        ),
        ({"actuator": ["weak", "weak", 3]}, "actuator[2]: actuator = 3: must be a name"),
        ({"actuator": ["weak", "lag", "weak"]}, "of several families (DCMotorActuator, Lag)"),
        ({"actuator": WILD}, "unstable at a step of 0.05 s: spectral radius"),
        (
            {"actuator": [STABLE, STABLE, WILD]},
            "actuator[2]: actuator: the current loop is unstable at a step of 0.05",
        ),
        (
            {"actuator": [STABLE] * 3, "action": "voltage"},
            "action = 'voltage': must be 'force' with one actuator per environment",
        ),
    ],
)
def test_raises_for_a_bad_argument_of_a_batch(arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        ActuatedVectorEnv(**{"task": "pendulum", "num_envs": 3, **arguments})


@pytest.mark.parametrize("physics", PHYSICS)
def test_raises_for_an_unknown_render_mode_at_rendering(physics):
    """Gymnasium only warns of it at construction, and its test suite requires no more."""
    env = ActuatedEnv("cartpole", physics=physics, render_mode="rgb_aray")
    with pytest.raises(
        ValueError,
        match=re.escape("render_mode = 'rgb_aray': must be None, 'human' or 'rgb_array'"),
    ):
        env.render()


def test_the_substeps_proposed_for_an_unstable_loop_make_it_stable():
    with pytest.raises(ValueError, match=r"controller\.substeps = \d+") as error_info:
        ActuatedEnv("cartpole", actuator=UNSTABLE)
    mapping = UNSTABLE.as_mapping()
    mapping["controller"]["substeps"] = int(
        re.search(r"controller\.substeps = (\d+)", str(error_info.value)).group(1)
    )
    env = ActuatedEnv("cartpole", actuator=mapping)
    env.reset(seed=0)
    for _ in range(20):
        info = env.step(1)[-1]
    # Without an integral part the current is kp/(R + kp) times its reference.
    assert info["current"] == pytest.approx(info["reference_current"] * 100 / 101, rel=1e-3)
    ActuatedEnv("cartpole", actuator=UNSTABLE, inner_steps=11)


# -- what is drawn --------------------------------------------------------------------------------

DISTRIBUTION = "is no distribution: must be uniform(LOW, HIGH), "


@pytest.mark.parametrize(
    "make", [functools.partial(ActuatedEnv, "cartpole"), functools.partial(batched, "cartpole", 2)]
)
@pytest.mark.parametrize(
    ("randomize", "message"),
    [
        (
            {},
            (
                "randomize = {}: must be one or more of FIELD=DISTRIBUTION, or a mapping of fields"
                " to these"
            ),
        ),
        (
            "a=uniform(0, 1)",
            "randomize = 'a=uniform(0, 1)': must be one or more of FIELD=DISTRIBUTION",
        ),
        (3, "randomize = 3: must be one or more of FIELD=DISTRIBUTION"),
        (
            ["motor.inductance"],
            "randomize: 'motor.inductance': must be FIELD=DISTRIBUTION, such as ",
        ),
        (["=uniform(0, 1)"], "randomize: '=uniform(0, 1)': must be FIELD=DISTRIBUTION, such as "),
        ([3], "randomize: 3: must be FIELD=DISTRIBUTION, such as "),
        (["a=uniform(0, 1)", "a=choice(1)"], "randomize: a is named twice"),
        ({"a": {"uniform": [0, 1]}}, f"randomize: a: {{'uniform': [0, 1]}} {DISTRIBUTION}"),
        ({"a": 0.3}, f"randomize: a: 0.3 {DISTRIBUTION}"),
        ({"controller.kp": (1.0, 2.0)}, f"randomize: controller.kp: (1.0, 2.0) {DISTRIBUTION}"),
        (
            ["a=gauss(0, 1)"],
            "randomize: a: 'gauss(0, 1)' is no distribution: it must be uniform(LOW, HIGH), ",
        ),
        (["a=uniform(1)"], "randomize: a: 'uniform(1)' has 1 values: must be uniform(LOW, HIGH)"),
        (
            ["a=uniform(2, 1)"],
            "randomize: a: 'uniform(2, 1)': Uniform.high = 1: must be >= low = 2",
        ),
        (["(:a=uniform(0, 1)"], "randomize: (:a: '(': must be a regular expression (missing ), "),
        (
            {"arm": {"model.gravity": "uniform(1, 2)"}},
            (
                "randomize: arm:model.gravity: model.gravity is the model's, not a motor's: leave"
                " 'arm' out"
            ),
        ),
        ({"hing.*:motor.inductance": Uniform(0.05, 0.2)}, "'hing.*': no actuator has such a name"),
        (
            {"motor.inductanze": Uniform(1, 2)},
            "unknown field 'motor.inductanze': did you mean 'motor.inductance'",
        ),
        (
            {"model.mass.bole": Uniform(1, 2)},
            "unknown field 'model.mass.bole': did you mean 'model.mass.pole'",
        ),
        ({"model.length.cart": Uniform(1, 2)}, "unknown field 'model.length.cart'"),
        ({"model.friction.slider": Uniform(0, 1)}, "unknown field 'model.friction.slider'"),
        (
            {"motor.inductance": Uniform(0.0, 0.2)},
            "Motor.inductance = 0.0: must be a finite number > 0",
        ),
        (
            {"controller.kp": Uniform(-1.0, 0.2)},
            "CurrentLoop.kp = -1.0: must be a finite number >= 0",
        ),
        (
            {"controller.kp": Choice([1.0, -2.0])},
            "CurrentLoop.kp = -2.0: must be a finite number >= 0",
        ),
        (
            {"controller.kp": Choice([1.0, INF])},
            "CurrentLoop.kp = inf: must be a finite number >= 0",
        ),
        ({"controller.kp": Choice([True])}, "controller.kp must be a number"),
        (
            {"controller.substeps": Uniform(1, 4)},
            "controller.substeps must be drawn from a Choice of int",
        ),
        (
            {"controller.substeps": Choice([1.5])},
            "controller.substeps must be drawn from a Choice of int",
        ),
        (
            {"controller.substeps": Choice([0, 1])},
            "CurrentLoop.substeps = 0: must be an integer >= 1",
        ),
        (
            {"controller.bemf_compensation": Choice([0, 1])},
            "controller.bemf_compensation must be drawn from a Choice of bool",
        ),
        ({"model.mass.pole": Uniform(0.0, 1.0)}, "mass.pole = 0: must be a finite number > 0"),
        (
            {"model.damping.hinge": Uniform(-1.0, 1.0)},
            "damping.hinge = -1: must be a finite number >= 0",
        ),
    ],
)
def test_raises_for_fields_that_cannot_be_drawn(make, randomize, message):
    with pytest.raises(
        ValueError, match=f"^randomize.*{re.escape(message.removeprefix('randomize'))}"
    ):
        make(randomize=randomize)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"actuator": "ideal", "randomize": {"motor.resistance": Uniform(1, 2)}},
            "the ideal actuator has no motor",
        ),
        (
            {"actuator": "ideal", "randomize": {"controller.kp": Uniform(1, 2)}},
            "the ideal actuator has no motor",
        ),
        (
            {"physics": "analytic", "randomize": {"model.gravity": Uniform(1, 2)}},
            "cannot draw model.gravity",
        ),
        (
            {**CURRENT, "randomize": {"motor.arm_radius": Uniform(1, 2)}},
            "it would change what an action means",
        ),
        (
            {**VOLTAGE, "randomize": {"controller.kp": Uniform(1, 2)}},
            "the command bypasses the controller",
        ),
        (
            {"actuator": GEARED, "randomize": {"motor.gear_ratio": Uniform(0, 1)}},
            "GearMotor.gear_ratio = 0.0: must be",
        ),
        (
            {"actuator": GEARED, "randomize": {"motor.rotor_inertia": Uniform(-1, 1)}},
            "GearMotor.rotor_inertia = -1.0",
        ),
        (
            {"actuator": GEARED, "randomize": {"motor.gear_efficiency": Uniform(0, 1)}},
            "GearMotor.gear_efficiency = 0",
        ),
        # Randomizing the model does not change the loop.
        ({"actuator": UNSTABLE, "randomize": {"model.gravity": Uniform(0.9, 1.1)}}, "unstable"),
    ],
)
def test_raises_for_distributions_that_contradict_other_arguments(arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        ActuatedEnv("cartpole", **arguments)


@pytest.mark.parametrize(
    ("distribution", "arguments", "message"),
    [
        (Uniform, (2.0, 1.0), "Uniform.high = 1: must be >= low = 2"),
        (Uniform, (0.0, INF), "Uniform.high = inf: must be a finite number"),
        (Uniform, ("0", 1.0), "Uniform.low = '0': must be a finite number"),
        (LogUniform, (0.0, 1.0), "LogUniform.low = 0.0: must be a finite number > 0"),
        (LogUniform, (NAN, 1.0), "LogUniform.low = nan: must be a finite number > 0"),
        (Choice, ([],), "Choice.values = []: must be a sequence of one or more numbers"),
        (Choice, (["a"],), "'a' must be a number"),
        (Choice, ([NAN],), "nan must be a number"),
    ],
)
def test_raises_for_impossible_bounds(distribution, arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        distribution(*arguments)


# -- actions --------------------------------------------------------------------------------------

NEITHER = [
    None,
    "1",
    "left",
    {},
    np.nan,
    0.5,
    1.5,
    -1,
    7,
    [0, 1],
    np.zeros(2),
    np.zeros(1, int),
    np.array([np.nan]),
]
NO_BOX = [
    1,
    np.float32([np.nan]),
    np.array(0.5),
    np.zeros((1, 1)),
    np.array([True]),
    np.array(["1"]),
]
NO_CHOICE = [4, 1.0, np.array([0.0])]


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("command", ["force", "current", "voltage"])
def test_raises_for_invalid_actions_and_changes_nothing(task, command):
    env = ActuatedEnv(task, **commanded(task, command))
    env.reset(seed=0)
    before = env.snapshot()
    for action in NEITHER + (NO_CHOICE if hasattr(env.action_space, "n") else NO_BOX):
        with pytest.raises(
            ValueError, match=rf"^action = {re.escape(repr(action))}: not in (Box|Discrete)"
        ):
            env.step(action)
        assert_same(env.snapshot(), before)


def _wrong_batches(env):
    """Return batches for four environments that are refused, with the row that the error names."""
    actions = random_actions(env, np.random.default_rng(0))
    bad_batches = [
        (actions[:3], None),
        (np.concatenate([actions, actions]), None),
        (actions[0], None),
        (None, None),
        ("left", None),
    ]
    if isinstance(env.single_action_space, gymnasium.spaces.Discrete):
        bad_batches += [
            (actions.astype(float), None),
            (actions[:, None], None),
            (actions > 0, None),
        ]
        values = [-1, env.single_action_space.n, np.iinfo(np.int64).max]
    else:
        bad_batches += [
            (np.ones((4, 1), int), None),
            (actions[:, 0], None),
            (np.ones((4, 2), np.float32), None),
        ]
        values = [np.nan]
    for row, value in zip((2, 0, 3), values * 3, strict=False):
        batch = actions.copy()
        batch[row] = value
        bad_batches.append((batch, row))
    return bad_batches


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("mode", MODES)
def test_raises_for_bad_batches_of_actions_before_a_step(task, mode):
    env, control = batched(task, 4, mode), batched(task, 4, mode)
    generator = np.random.default_rng(1)
    for each_env in (env, control):
        each_env.reset(seed=0)
    before = env.unwrapped.snapshot()
    for actions, row in _wrong_batches(env):
        with pytest.raises(
            ValueError,
            match="actions" if row is None else rf"actions\[{row}\] .*environment {row}\)",
        ):
            env.step(actions)
        assert_same(env.unwrapped.snapshot(), before)
    actions = random_actions(env, generator)
    assert_same(env.step(actions), control.step(actions))


# -- resets ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": [1, 2]}, "seed: got 2 seeds for 3 environments; give one for each"),
        ({"seed": [1, 2, 3, 4]}, "seed: got 4 seeds for 3 environments; give one for each"),
        (
            {"options": {"reset_mask": np.ones(2, bool)}},
            "must be a bool array of shape (3,) with at least one True",
        ),
        ({"options": {"reset_mask": np.ones(3)}}, "must be a bool array of shape (3,)"),
        ({"options": {"reset_mask": [True] * 3}}, "must be a bool array of shape (3,)"),
        ({"options": {"reset_mask": np.zeros(3, bool)}}, "with at least one True"),
        ({"options": {"low": 0.5, "high": -0.5}}, "low"),
        ({"options": {"low": "left"}}, "left"),
        ({"seed": -1}, "-1"),
    ],
)
def test_raises_for_a_bad_reset_of_a_batch_and_changes_nothing(arguments, message):
    env = ActuatedVectorEnv(3, "cartpole")
    env.reset(seed=0)
    env.step(np.ones(3, int))
    before = env.snapshot()
    with pytest.raises((ValueError, gymnasium.error.Error), match=re.escape(message)):
        env.reset(**arguments)
    assert_same(env.snapshot(), before)


@pytest.mark.parametrize("value", [-1.0, NAN])
@pytest.mark.parametrize("make", [ActuatedEnv, functools.partial(ActuatedVectorEnv, 2)])
def test_raises_for_reset_options_out_of_order(make, value):
    with pytest.raises(
        ValueError, match=re.escape(f"reset options = {{'x_init': {value}}}: the bounds are [")
    ):
        make("pendulum").reset(seed=0, options={"x_init": value})


def test_raises_if_an_ended_environment_is_stepped_without_a_reset():
    env = batched("cartpole", 3, "Disabled", max_episode_steps=2)
    env.reset(seed=0)
    env.step(np.zeros(3, int))
    env.reset(options={"reset_mask": np.array([True, False, True])})
    *_, truncated, _ = env.step(np.zeros(3, int))
    np.testing.assert_array_equal(truncated, [False, True, False])
    before = env.unwrapped.snapshot()
    with pytest.raises(RuntimeError, match="environment 1 has ended and was not reset"):
        env.step(np.zeros(3, int))
    assert_same(env.unwrapped.snapshot(), before)
    env.reset(options={"reset_mask": truncated})
    env.step(np.zeros(3, int))
