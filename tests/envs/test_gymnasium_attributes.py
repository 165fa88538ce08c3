"""Attributes of Gymnasium's environments can be read and written with the same effect."""

import copy
import inspect

import gymnasium
import numpy as np
import pytest

from codrl_mj.envs.distributions import Uniform
from codrl_mj.physics import PHYSICS
from codrl_mj.physics.analytic import AnalyticPhysics
from codrl_mj.tasks import TASKS
from tests.tasks.faces import every_rebuilt

NOT_OF_THE_TASK = {
    "last_u",
    "np_random",
    "np_random_seed",
    "state",
    "steps_beyond_terminated",
    "unwrapped",
}
NOT_OF_THE_TASK |= {
    "action_space",
    "high",
    "high_state",
    "low",
    "low_state",
    "metadata",
    "observation_space",
    "spec",
}
NOT_OF_THE_TASK |= {
    "action_arrow",
    "actions_num",
    "clock",
    "domain_fig",
    "isopen",
    "render_mode",
    "screen",
    "surf",
}
NOT_OF_THE_TASK |= {"SCREEN_DIM", "screen_dim", "screen_height", "screen_width"}

WRITES = [
    ("cartpole", {"gravity": 3.7}),
    ("cartpole", {"gravity": 0.0}),
    ("cartpole", {"length": 0.8, "polemass_length": 0.1 * 0.8}),
    ("cartpole", {"masscart": 2.5, "total_mass": 2.5 + 0.1}),
    ("cartpole", {"masspole": 0.3, "total_mass": 1.0 + 0.3, "polemass_length": 0.3 * 0.5}),
    (
        "cartpole",
        {"length": 1.1, "masspole": 0.3, "total_mass": 1.0 + 0.3, "polemass_length": 0.3 * 1.1},
    ),
    ("cartpole", {"force_mag": 14.0}),
    ("cartpole", {"tau": 0.01}),
    ("pendulum", {"g": 3.7}),
    ("pendulum", {"m": 0.4}),
    ("pendulum", {"l": 1.7}),
    ("pendulum", {"max_torque": 3.5}),
    ("pendulum", {"dt": 0.02}),
    ("acrobot", {"LINK_LENGTH_1": 1.3}),
    ("acrobot", {"LINK_COM_POS_1": 0.6, "LINK_COM_POS_2": 0.3}),
    ("acrobot", {"LINK_MASS_1": 1.4, "LINK_MASS_2": 0.6}),
    ("acrobot", {"LINK_MOI": 0.7}),
    ("acrobot", {"AVAIL_TORQUE": [-3.0, 0.5, 2.0]}),
    ("acrobot", {"dt": 0.05}),
    ("mountain_car", {"force": 0.0017}),
    ("mountain_car", {"gravity": 0.003}),
    ("mountain_car_continuous", {"power": 0.001}),
]
"""Tasks, and consistent numbers: Gymnasium stores sums and products as separate attributes."""


def _pair(task, **arguments):
    """Make this package's and Gymnasium's environment, without wrappers that end episodes."""
    env = gymnasium.make(TASKS[task].env_id, **{"actuator": "ideal", **arguments})
    return env.unwrapped, gymnasium.make(TASKS[task].gymnasium_id).unwrapped


def _run(env, task, seed):
    """Return the states over 50 steps, shape (50, n)."""
    # Continuous actions are float64: with float32 Gymnasium computes in float32.
    generator = np.random.default_rng(seed)
    env.reset(seed=seed)
    states = []
    for _ in range(50):
        forces = TASKS[task].forces
        env.step(
            generator.uniform(-4.0, 4.0, 1) if forces is None else generator.integers(len(forces))
        )
        states.append(np.array(env.state, dtype=np.float64))
    return np.array(states)


@pytest.mark.parametrize("physics", PHYSICS)
@every_rebuilt
def test_all_numbers_of_gymnasiums_environment_can_be_read(task, physics):
    ours, theirs = _pair(task, physics=physics)
    ours.reset(seed=0)
    # A step drives the analytic physics by its attributes.
    ours.step(ours.action_space.sample())
    names = [name for name in dir(theirs) if name[0] != "_" and name not in NOT_OF_THE_TASK]
    expected = {
        name: value for name in names if not inspect.isroutine(value := getattr(theirs, name))
    }
    assert len(expected) >= 6
    assert {name: getattr(ours, name) for name in expected} == expected


@pytest.mark.filterwarnings("ignore:.*already returned terminated")
@pytest.mark.parametrize(
    ("task", "values"),
    WRITES,
    ids=lambda case: case if isinstance(case, str) else "+".join(case),
)
@pytest.mark.parametrize("physics", PHYSICS)
def test_a_written_number_has_the_same_effect_as_in_gymnasium(task, values, physics):
    ours, theirs = _pair(task, physics=physics)
    before = _run(theirs, task, seed=3)
    state = ours.state = ours.state + 0.01
    for name, value in values.items():
        setattr(ours, name, value)
        setattr(theirs, name, value)
        assert getattr(ours, name) == pytest.approx(value, rel=1e-15)
    np.testing.assert_array_equal(ours.state, state)
    # Gymnasium's continuous car rounds its state to float32 in every step
    tolerance = 1e-6 if task == "mountain_car_continuous" else 1e-9
    # Written values must outlast a reset.
    for _ in range(2):
        after = _run(theirs, task, seed=3)
        np.testing.assert_allclose(_run(ours, task, seed=3), after, rtol=0, atol=tolerance)
    assert not np.allclose(after, before, rtol=0, atol=1e-3)


@every_rebuilt
def test_the_next_step_starts_from_a_state_that_was_set(task):
    ours, theirs = _pair(task)
    state = np.linspace(0.02, 0.05, len(TASKS[task].state_names))
    for env in (ours, theirs):
        env.reset(seed=0)
    ours.state, theirs.state = tuple(state), state.copy()
    np.testing.assert_array_equal(ours.state, state)
    action = np.array([0.5]) if TASKS[task].forces is None else 1
    np.testing.assert_allclose(ours.step(action)[0], theirs.step(action)[0], rtol=0, atol=1e-6)
    for wrong in (state[:-1], "here", None, state * np.nan):
        with pytest.raises(ValueError, match=r"state = .* must be finite numbers, of shape"):
            ours.state = wrong


@pytest.mark.parametrize("physics", PHYSICS)
def test_setting_the_state_does_not_change_the_motor(physics):
    env = gymnasium.make("codrl_mj/CartPole-v0", physics=physics).unwrapped
    env.reset(seed=0)
    env.step(1)
    other_env = copy.deepcopy(env)
    env.state = other_env.state
    for action in (1, 0, 1):
        info, expected = env.step(action)[4], other_env.step(action)[4]
        assert info == expected
        assert info["current"] != 0.0


def test_wrappers_and_copies_have_the_attributes():
    env = gymnasium.make("codrl_mj/CartPole-v0", actuator="ideal")
    assert env.has_wrapper_attr("gravity")
    assert env.set_wrapper_attr("gravity", 10.0)
    assert (
        env.get_wrapper_attr("gravity")
        == env.unwrapped.gravity
        == copy.deepcopy(env).unwrapped.gravity
        == 10.0
    )
    assert env.unwrapped.model.opt.gravity[2] == -10.0
    assert not env.has_wrapper_attr("gravitation")
    # Other attributes can still be set freely.
    env.unwrapped.gravitation = 1


@pytest.mark.filterwarnings("ignore:.*already returned terminated")
@pytest.mark.parametrize("mode", ["sync", "vector_entry_point"])
@pytest.mark.parametrize(
    ("task", "name", "values"),
    [("cartpole", "gravity", [9.81, 3.72, 1.62]), ("pendulum", "l", [1.0, 1.5, 0.7])],
)
def test_environments_of_a_vector_have_their_own_values_and_states(task, mode, name, values):
    env = gymnasium.make_vec(TASKS[task].env_id, 3, mode, actuator="ideal")
    env.reset(seed=[5, 5, 5])
    nominal = env.get_attr(name)
    assert nominal == env.call(name) == (getattr(_pair(task)[1], name),) * 3
    assert all(type(value) is float for value in nominal)
    env.set_attr(name, values)
    assert env.get_attr(name) == tuple(values)
    action = np.full((3, 1), 0.5) if TASKS[task].forces is None else np.ones(3, dtype=np.int64)
    observations = [env.step(action)[0] for _ in range(8)][-1]
    for row, value in enumerate(values):
        theirs = _pair(task)[1]
        setattr(theirs, name, value)
        theirs.reset(seed=5)
        expected = [theirs.step(action[row])[0] for _ in range(8)][-1]
        np.testing.assert_allclose(observations[row], expected, rtol=0, atol=1e-5)
    env.set_attr(name, 2.0)
    assert env.get_attr(name) == (2.0, 2.0, 2.0)
    states = np.arange(1.0, 1.0 + 3 * len(TASKS[task].state_names)).reshape(3, -1) / 100
    env.set_attr("state", list(states))
    np.testing.assert_array_equal(env.get_attr("state"), states)
    env.close()


# -- refusals -------------------------------------------------------------------------------------

DRAWN_GRAVITY = {"randomize": {"model.gravity": Uniform(0.9, 1.1)}}
CURRENT = {"actuator": "paper", "action": "current", "levels": (-1, 1)}
CHECKED = "motor and disturbances were checked for this step"


@pytest.mark.parametrize(
    ("arguments", "name", "value", "message"),
    [
        ({}, "x_threshold", 5.0, "must be 2.4 in .*; it is compiled .* `gymnasium.Wrapper`"),
        ({}, "kinematics_integrator", "semi-implicit", "make an environment with integrator="),
        ({}, "total_mass", 3.0, "write masscart and masspole first"),
        ({"actuator": "paper"}, "tau", 0.5, CHECKED),
        ({"actuator": "paper", "physics": "analytic"}, "tau", 0.5, CHECKED),
        (CURRENT, "force_mag", 0.5, "action='force'"),
        (DRAWN_GRAVITY, "masspole", 0.5, "give `randomize` a distribution"),
    ],
)
def test_raises_with_reason_and_remedy_for_read_only_attributes(arguments, name, value, message):
    env = _pair("cartpole", **arguments)[0]
    with pytest.raises(AttributeError, match=message):
        setattr(env, name, value)
    if not arguments:
        # Writing the present value is no change.
        setattr(env, name, getattr(env, name))


@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, "heavy", None, [1.0, 2.0]])
def test_raises_for_impossible_masses_and_changes_nothing(value, physics):
    env = _pair("cartpole", physics=physics)[0]
    with pytest.raises(ValueError, match=r"masspole = .*: must be a finite number > 0"):
        env.masspole = value
    assert env.masspole == 0.1


@pytest.mark.parametrize(
    ("name", "value", "error", "message"),
    [
        ("state", np.zeros((4, 2)), ValueError, r"of shape \(2, 4\)"),
        ("tau", 0.1, AttributeError, "tau = 0.1: the environments share the value 0.02"),
        ("gravity", [1.0, 2.0, 3.0], ValueError, "must be one number, or 2"),
    ],
)
def test_raises_for_changes_that_a_batch_does_not_support(name, value, error, message):
    env = gymnasium.make_vec("codrl_mj/CartPole-v0", 2, actuator="ideal").unwrapped
    assert env.get_attr("num_envs") == (2, 2)
    with pytest.raises(error, match=message):
        setattr(env, name, value)


def test_raises_if_a_custom_physics_without_a_model_has_no_such_number(monkeypatch):
    class Still(AnalyticPhysics):
        """Physics that does not move."""

        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            self.reference_env = lambda state, *_: state

    monkeypatch.setitem(PHYSICS, "still", Still)
    env = _pair("cartpole", physics="still")[0]
    assert (env.x_threshold, env.force_mag) == (2.4, 10.0)
    for name in ("gravity", "masspole"):
        with pytest.raises(
            AttributeError, match=r"Still has no MuJoCo model or data.* use physics='mujoco'"
        ):
            getattr(env, name)
    with pytest.raises(AttributeError, match="Still has no MuJoCo model or data"):
        env.tau = 0.1
