"""Randomization of actuators and models: distributions, equality with batches, and effects."""

import dataclasses
import math

import gymnasium
import numpy as np
import pytest
import scipy.stats

from codrl_mj import Choice, LogUniform, Uniform
from codrl_mj.actuators import (
    CurrentLoop,
    DCMotorActuator,
    Drive,
    GearMotor,
    Supply,
    spectral_radius,
)
from codrl_mj.actuators.stability import spectral_radii, stability_radii
from codrl_mj.engine.families import USER_HEADER_SIZE
from codrl_mj.envs import ActuatedEnv
from codrl_mj.tasks import named_actuator
from tests.conformance.environments import DRIVE, scales
from tests.conformance.episodes import assert_same, plain
from tests.envs.vectors import batched
from tests.tasks.faces import actions, every_rebuilt, gymnasiums, random_states

JOINT = {"pendulum": "hinge", "cartpole": "slider", "acrobot": "elbow"}


def everything_drawn(task):
    """Return distributions of everything random in a task, including its damping."""
    return DRIVE | scales(task) | {f"model.damping.{JOINT.get(task, 'slider')}": Uniform(0.0, 0.3)}


# -- distributions --------------------------------------------------------------------------------


def test_drawn_values_have_the_requested_distributions():
    distributions = everything_drawn("cartpole")
    env = batched("cartpole", 4000, randomize=distributions, allow_unstable=True)
    drawn_values = env.reset(seed=3)[1]["randomization"]

    def probability(name, transform=lambda x: x):
        low, high = transform(distributions[name].low), transform(distributions[name].high)
        assert (
            distributions[name].low
            <= drawn_values[name].min()
            < drawn_values[name].max()
            <= distributions[name].high
        )
        return scipy.stats.kstest(
            transform(drawn_values[name]), "uniform", (low, high - low)
        ).pvalue

    for name, distribution in distributions.items():
        if isinstance(distribution, Uniform):
            assert probability(name) > 1e-3, name
    assert probability("controller.kp", np.log) > 1e-3
    # The test must be able to distinguish a uniform from a log-uniform distribution.
    assert probability("controller.kp") < 1e-12
    for name in ("controller.max_voltage", "controller.substeps", "controller.bemf_compensation"):
        values, counts = np.unique(drawn_values[name], return_counts=True)
        assert list(values) == sorted(distributions[name].values)
        assert scipy.stats.chisquare(counts).pvalue > 1e-3
    assert drawn_values["controller.substeps"].dtype.kind == "i"
    assert drawn_values["controller.bemf_compensation"].dtype == bool
    table = np.array(
        [drawn_values[name] for name in distributions if name != "controller.max_voltage"],
        dtype=float,
    )
    correlations = np.corrcoef(table) - np.eye(len(table))
    # 0.07 is 4.4 standard deviations: no two fields share a draw.
    assert np.abs(correlations).max() < 0.07


@pytest.mark.parametrize(
    ("distribution", "formula"),
    [
        (Uniform(-1.0, 3.0), lambda draw: -1.0 + 4.0 * draw),
        (LogUniform(1.0, 16.0), lambda draw: 16.0**draw),
        (Choice([3.0, 1.0, 2.0]), lambda draw: np.array([3.0, 1.0, 2.0])[(3 * draw).astype(int)]),
    ],
)
def test_values_follow_the_formula_for_any_number_of_draws(distribution, formula):
    draws = np.random.default_rng(0).random(257)
    draws[:2] = 0.0, np.nextafter(1.0, 0.0)
    values = distribution.transform(draws)
    np.testing.assert_allclose(
        values, formula(draws), rtol=1e-15 if isinstance(distribution, LogUniform) else 0
    )
    for size in (1, 2, 3, 5, 8, 13, 64):
        parts = [
            distribution.transform(draws[start : start + size])
            for start in range(0, len(draws), size)
        ]
        np.testing.assert_array_equal(np.concatenate(parts), values)
    assert min(distribution.extremes) <= values.min()
    assert values.max() <= max(distribution.extremes)


@every_rebuilt
def test_randomization_does_not_change_the_initial_states_of_a_seed(task):
    ours = ActuatedEnv(task, randomize={"controller.kp": LogUniform(0.5, 2.0), **scales(task)})
    gym = gymnasiums(task).unwrapped
    undrawn = ActuatedEnv(task)
    for seed in range(5):
        observation, info = ours.reset(seed=seed)
        expected, _ = gym.reset(seed=seed)
        np.testing.assert_array_equal(observation, expected)
        assert info["randomization"]["rejected"] == 0
        assert undrawn.reset(seed=seed)[1] == {}
    # Without randomization no other number is drawn, so the second episode also starts as
    # Gymnasium's.
    np.testing.assert_array_equal(undrawn.reset()[0], gym.reset()[0])


# -- in effect ------------------------------------------------------------------------------------


@every_rebuilt
@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
def test_the_drawn_actuator_is_simulated(task, physics):
    ours, final_states = ActuatedEnv(task, physics=physics, randomize=DRIVE), set()
    for seed in range(4):
        drawn_values, actuator = ours.reset(seed=seed)[1]["randomization"], ours.actuator
        for name in DRIVE:
            part, field = name.split(".")
            assert getattr(getattr(actuator, part), field) == drawn_values[name]
        same = ActuatedEnv(task, physics=physics, actuator=actuator)
        same.reset(seed=seed)
        for action in actions(task, seed, 25):
            assert_same(
                plain((ours.step(action), ours.state)), plain((same.step(action), same.state))
            )
        final_states.add(tuple(ours.state))
        if physics == "mujoco":
            assert (
                tuple(ours.model.actuator_user[0, USER_HEADER_SIZE:]) == actuator.parameter_values
            )
    assert len(final_states) == 4


class _DampedAcrobot:
    """Mixin for Gymnasium's acrobot with a damped elbow."""

    damping = 0.0

    def _dsdt(self, augmented):
        *state, torque = augmented
        return super()._dsdt(np.append(state, torque - self.damping * state[3]))


def changed_gymnasium(task, factors):
    """Return a step function of Gymnasium's environment with scaled attributes."""
    gravity = factors["model.gravity"]
    if task == "acrobot":
        # Its gravity is not an attribute. Lengths divided by the factor, masses times it, and
        # inertias and torques divided by it have the same effect.
        env = type("Damped", (_DampedAcrobot, type(gymnasiums(task).unwrapped)), {})()
    else:
        env = gymnasiums("mountain_car" if task == "mountain_car_continuous" else task).unwrapped
    if task == "pendulum":
        env.m *= factors["model.mass.rod"]
        env.l *= factors["model.length.rod"]
        env.g *= gravity
    elif task == "cartpole":
        env.masscart *= factors["model.mass.cart"]
        env.masspole *= factors["model.mass.pole"]
        env.length *= factors["model.length.pole"]
        env.total_mass = env.masscart + env.masspole
        env.polemass_length = env.masspole * env.length
        env.gravity *= gravity
    elif task == "acrobot":
        env.LINK_MASS_1 = factors["model.mass.upper"] * gravity
        env.LINK_MASS_2 = factors["model.mass.lower"] * gravity
        env.LINK_LENGTH_1 = factors["model.length.upper"] / gravity
        env.LINK_COM_POS_1 = 0.5 * factors["model.length.upper"] / gravity
        env.LINK_COM_POS_2 = 0.5 * factors["model.length.lower"] / gravity
        moments = [
            factors[f"model.mass.{link}"] * factors[f"model.length.{link}"] ** 2
            for link in ("upper", "lower")
        ]
        # Gymnasium's acrobot has one moment of inertia for both links.
        assert moments[0] == pytest.approx(moments[1], rel=1e-14)
        env.LINK_MOI = moments[0] / gravity
        env.AVAIL_TORQUE = [torque / gravity for torque in (-1.0, 0.0, 1.0)]
        env.damping = factors.get("model.damping.elbow", 0.0) / gravity
    else:
        env.gravity *= gravity
        env.force = (0.0015 if task == "mountain_car_continuous" else 0.001) / factors[
            "model.mass.car"
        ]

    def step(state, action):
        env.reset(seed=0)
        env.state = tuple(state) if task != "acrobot" else np.array(state)
        # Gymnasium's continuous car rounds its state to float32; the discrete one is used with
        # the same power.
        if task == "mountain_car_continuous":
            env.force *= abs(float(action[0]))
            env.step(2 if action[0] > 0 else 0)
            env.force /= abs(float(action[0]))
        else:
            env.step(action)
        return np.array(env.state)

    return step


def _factors(task, generator):
    """Return random factors; an acrobot's give both links the same inertia, and damp the elbow."""
    factors = {name: generator.uniform(0.6, 1.7) for name in scales(task)}
    if task == "acrobot":
        moment = factors["model.mass.upper"] * factors["model.length.upper"] ** 2
        factors["model.length.lower"] = math.sqrt(moment / factors["model.mass.lower"])
        factors["model.damping.elbow"] = generator.uniform(0.1, 0.5)
    return factors


@every_rebuilt
def test_drawn_factors_equal_changed_attributes_of_gymnasium(task):
    generator = np.random.default_rng(5)
    for _ in range(6):
        factors = _factors(task, generator)
        ours = ActuatedEnv(
            task,
            "ideal",
            randomize={name: Uniform(value, value) for name, value in factors.items()},
        )
        assert ours.reset(seed=0)[1]["randomization"] == factors | {"rejected": 0}
        step, unchanged = (
            changed_gymnasium(task, values)
            for values in (factors, dict.fromkeys(scales(task), 1.0))
        )
        for state, action in zip(random_states(task, 1, 5), actions(task, 2, 5), strict=True):
            ours.physics.reset(state)
            ours.step(action)
            after = step(state, action)
            np.testing.assert_allclose(ours.state, after, rtol=0, atol=1e-12)
            matters = np.abs(after - unchanged(state, action)).max() > 1e-6
        # Otherwise the factors would have no effect. The cars' effects are smaller.
        assert matters or task.startswith("mountain_car")


@pytest.mark.parametrize("damping", [0.0, 0.3, 5.0])
def test_damping_is_integrated_implicitly_in_pendulum_and_car(damping):
    for task, joint in (("pendulum", "hinge"), ("mountain_car", "slider")):
        scale = 1.0 if task == "pendulum" else 1000.0
        randomize = {f"model.damping.{joint}": Uniform(damping * scale, damping * scale)}
        ours, free = (ActuatedEnv(task, "ideal", randomize=r) for r in (randomize, None))
        mass, step = (1.0 / 3.0, 0.05) if task == "pendulum" else (1000.0, 1.0)
        state, action = (0.4, -0.03), (np.array([1.5]) if task == "pendulum" else 2)
        for env in (ours, free):
            env.reset(seed=0)
            env.physics.reset(np.array(state))
            env.step(action)
        # The impulse of all forces except damping.
        impulse = mass * (free.state[1] - state[1])
        speed = (mass * state[1] + impulse) / (mass + step * damping * scale)
        np.testing.assert_allclose(ours.state, [state[0] + step * speed, speed], rtol=0, atol=1e-14)


def test_damping_is_integrated_explicitly_in_cartpoles_euler():
    damping, step = {"slider": 0.7, "hinge": 0.02}, 0.02
    randomize = {
        f"model.damping.{joint}": Uniform(value, value) for joint, value in damping.items()
    }
    explicit, free = (ActuatedEnv("cartpole", "ideal", randomize=r) for r in (randomize, None))
    state = np.array([0.1, -0.8, 0.12, 1.1])
    for env in (explicit, free):
        env.reset(seed=0)
        env.physics.reset(state)
        env.step(1)
    # Inertia matrix of a cart of 1 kg with a rod of 0.1 kg and 2 * 0.5 m on it.
    cosine = math.cos(state[2])
    inertia = np.array([[1.1, 0.05 * cosine], [0.05 * cosine, 0.1 / 3.0]])
    braking = np.linalg.solve(
        inertia, [-damping["slider"] * state[1], -damping["hinge"] * state[3]]
    )
    expected = free.state + step * np.array([0.0, braking[0], 0.0, braking[1]])
    np.testing.assert_allclose(explicit.state, expected, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(
        explicit.state[[0, 2]], (state + step * state[[1, 1, 3, 3]])[[0, 2]]
    )


def test_a_pattern_selects_the_motors_to_randomize():
    all_motors_path, pattern_path = (
        {path: Uniform(0.05, 0.2)} for path in ("motor.inductance", "slid.*:motor.inductance")
    )
    drawn_for_all, drawn_by_pattern = (
        ActuatedEnv("cartpole", randomize=randomize).reset(seed=3)[1]["randomization"]
        for randomize in (all_motors_path, pattern_path)
    )
    assert drawn_by_pattern == {
        "slid.*": {"motor.inductance": drawn_for_all["motor.inductance"]},
        "rejected": 0,
    }
    vector_env = batched("cartpole", 2, randomize=pattern_path)
    vector_values = vector_env.reset(seed=3)[1]["randomization"]
    assert vector_values["slid.*:motor.inductance"][0] == drawn_for_all["motor.inductance"]


def test_images_show_the_drawn_length():
    nominal, ours = (
        ActuatedEnv("cartpole"),
        ActuatedEnv("cartpole", randomize={"model.length.pole": Uniform(0.5, 2)}),
    )
    for _ in range(3):
        length = ours.reset()[1]["randomization"]["model.length.pole"]
        pole, nominal_geom = ours.model.geom("pole"), nominal.model.geom("pole")
        np.testing.assert_allclose(
            [pole.size[1], pole.pos[2]],
            length * np.array([nominal_geom.size[1], nominal_geom.pos[2]]),
            rtol=1e-15,
        )
        assert (pole.size[0], *pole.pos[:2]) == (nominal_geom.size[0], *nominal_geom.pos[:2])
        np.testing.assert_array_equal(ours.model.geom("cart").size, nominal.model.geom("cart").size)
    vector_env = batched(
        "cartpole", 2, randomize={"model.length.pole": Uniform(0.5, 2)}, render_mode="rgb_array"
    )
    lengths = vector_env.reset(seed=0)[1]["randomization"]["model.length.pole"]
    vector_env.image()
    np.testing.assert_allclose(
        vector_env.unwrapped.physics.model.geom("pole").size[1], 0.5 * lengths[0], rtol=1e-15
    )
    vector_env.close()


# -- stability ------------------------------------------------------------------------------------


def _proportional():
    """Return a P loop with a known stability limit, and ranges around it at CartPole's step."""
    nominal = DCMotorActuator(controller=CurrentLoop(kp=1.0))
    return nominal, {"motor.inductance": Uniform(0.02, 0.2), "controller.kp": LogUniform(0.5, 30.0)}


def _recount(seed, episodes):
    """Return an environment's values and rejections, computed from the numbers of its generator."""
    generator = gymnasium.utils.seeding.np_random(seed)[0]
    episodes_drawn = []
    for _ in range(episodes):
        # The first four numbers draw the initial state.
        generator.random(4)
        rejected = 0
        while True:
            first, second = generator.random(2)
            inductance, kp = (
                0.02 + (0.2 - 0.02) * first,
                math.exp(math.log(0.5) + math.log(60.0) * second),
            )
            if abs(1.0 - (1.0 + kp) * 0.02 / inductance) < 1.0:
                break
            rejected += 1
        episodes_drawn.append((inductance, kp, rejected))
    return np.array(episodes_drawn)


def test_unstable_sets_are_rejected_as_a_whole_and_counted():
    nominal, randomize = _proportional()
    env, drawn, radii = ActuatedEnv("cartpole", nominal, randomize=randomize), [], []
    for episode in range(300):
        drawn.append([*env.reset(seed=7 if episode == 0 else None)[1]["randomization"].values()])
        radii.append(spectral_radius(env.actuator, 0.02))
    expected = _recount(7, 300)
    np.testing.assert_allclose(drawn, expected, rtol=1e-14)
    assert max(radii) < 1.0
    # Many sets must have been rejected for the comparison to mean something.
    assert 50 < expected[:, 2].sum() < 3000


def test_sets_with_contradicting_fields_are_rejected():
    """Use fields that are valid one by one, in one environment and in a batch."""
    motor = {
        "max_temperature": 90.0,
        "thermal_resistance_winding": 5.0,
        "thermal_resistance_housing": 5.0,
    }
    nominal = Drive(GearMotor(**motor))
    for choices in (
        {f"motor.{name}": "choice(0.0, 5.0)" for name in list(motor)[1:]},
        {
            "motor.ambient_temperature": "choice(25.0, -75.0)",
            "motor.resistance_coefficient": "choice(0.0, 0.02)",
        },
    ):
        vector_values = batched("pendulum", 20, actuator=nominal, randomize=choices).reset(seed=0)[
            1
        ]["randomization"]
        assert any(vector_values["rejected"])
        env = ActuatedEnv("pendulum", nominal, randomize=choices)
        for row in range(20):
            values = env.reset(seed=row)[1]["randomization"]
            assert values == {name: vector_values[name][row] for name in values}


def test_sets_with_an_unstable_winding_are_rejected():
    nominal = DCMotorActuator(controller=CurrentLoop(kp=0.5))
    arguments = {"randomize": {"motor.inductance": Uniform(0.02, 0.2)}}
    # The winding is stable for (R + R_supply) * 0.02 < 2 L.
    for ohms, min_inductance in ((0.0, 0.02), (7.0, 0.08)):
        env = batched(
            "cartpole",
            500,
            actuator=dataclasses.replace(nominal, supply=Supply(resistance=ohms)),
            **arguments,
        )
        drawn_values = env.reset(seed=0)[1]["randomization"]
        assert min_inductance < drawn_values["motor.inductance"].min() < min_inductance + 0.005
        assert drawn_values["rejected"].any() == (ohms > 0)


@pytest.mark.parametrize("supply", [None, Supply()])
def test_a_drawn_supply_limits_the_voltage(supply):
    """Compare with a controller's `max_voltage`, which limits as an ideal supply does."""
    nominal = dataclasses.replace(named_actuator("paper", "cartpole"), supply=supply)
    limited = dataclasses.replace(
        nominal, controller=dataclasses.replace(nominal.controller, max_voltage=0.5)
    )
    choices = {"supply.voltage": Choice([0.5]), "supply.resistance": Choice([0.0])}
    randomized_env, fixed_env = (
        ActuatedEnv("cartpole", nominal, randomize=choices),
        ActuatedEnv("cartpole", limited),
    )
    for env in (randomized_env, fixed_env):
        env.reset(seed=1)
    randomized_env.state = fixed_env.state
    assert randomized_env.actuator.supply == Supply(0.5, 0.0)
    for action in (1, 1, 0, 1, 0, 0):
        outcome = randomized_env.step(action)
        assert_same(plain(outcome), plain(fixed_env.step(action)))
        assert abs(outcome[4]["voltage"]) <= 0.5
    sagging = ActuatedEnv("cartpole", nominal, randomize={"supply.resistance": Uniform(1.0, 2.0)})
    sagging.reset(seed=1)
    assert math.isinf(sagging.actuator.supply.voltage)


def test_unstable_sets_are_accepted_on_request():
    nominal, randomize = _proportional()
    env = batched("cartpole", 200, actuator=nominal, randomize=randomize, allow_unstable=True)
    drawn_values = env.reset(seed=0)[1]["randomization"]
    gains = np.abs(
        1.0 - (1.0 + drawn_values["controller.kp"]) * 0.02 / drawn_values["motor.inductance"]
    )
    assert (gains > 1.0).sum() > 20
    assert not drawn_values["rejected"].any()


@pytest.mark.parametrize(
    "make", [lambda **a: ActuatedEnv("cartpole", **a), lambda **a: batched("cartpole", 3, **a)]
)
def test_raises_at_the_reset_if_no_stable_set_is_drawn(make):
    env = make(randomize={"controller.kp": Uniform(50.0, 60.0)})
    with pytest.raises(
        ValueError, match=r"1000 draws in a row have an unstable current loop at a step of 0\.02 s"
    ):
        env.reset(seed=0)


def test_an_unstable_nominal_actuator_is_accepted_if_its_draws_are_stable():
    unstable = DCMotorActuator(controller=CurrentLoop(kp=100.0))
    env = ActuatedEnv("cartpole", unstable, randomize={"controller.kp": Uniform(1.0, 2.0)})
    env.reset(seed=0)


def test_spectral_radii_do_not_depend_on_the_batch():
    generator = np.random.default_rng(0)
    vectors = np.array([DCMotorActuator().parameter_values] * 300)
    vectors[:, 4:8] = generator.uniform(0.0, [20.0, 50.0, 0.05, 1.0], (300, 4))
    vectors[generator.random(300) < 0.3, 5] = 0.0
    vectors[generator.random(300) < 0.3, 6] = 0.0
    vectors[:, 10] = generator.integers(1, 4, 300)
    radii = spectral_radii(DCMotorActuator, vectors, 0.05)
    assert (radii < 1.0).any()
    assert (radii > 1.0).any()
    for size in (1, 2, 7, 100):
        parts = [
            spectral_radii(DCMotorActuator, vectors[start : start + size], 0.05)
            for start in range(0, 300, size)
        ]
        np.testing.assert_array_equal(np.concatenate(parts), radii)


def test_the_fast_stability_test_agrees_with_the_spectral_radius():
    generator = np.random.default_rng(1)
    vectors = np.array([DCMotorActuator().parameter_values] * 20000)
    vectors[:, 0:2] = np.exp(generator.uniform(-3.0, 1.0, (20000, 2)))
    vectors[:, 4:7] = np.exp(generator.uniform(-9.0, 4.0, (20000, 3))) * (1.0, 1.0, 1e-3)
    vectors[generator.random(20000) < 0.3, 5] = 0.0
    vectors[generator.random(20000) < 0.3, 6] = 0.0
    vectors[:, 10] = generator.integers(1, 4, 20000)
    vectors[:, 11:13] = generator.choice([0.0, 1.0], (20000, 2)) * (10.0, 0.01)
    radii, quick = (
        spectral_radii(DCMotorActuator, vectors, 0.02),
        stability_radii(DCMotorActuator, vectors, 0.02),
    )
    np.testing.assert_array_equal(radii < 1.0, quick < 1.0)
    assert 0.02 < (radii >= 1.0).mean() < 0.9
    # Most loops are decided by the fast test, which saves the time.
    assert np.isin(quick, (0.0, np.inf)).mean() > 0.8
    edge = np.array(
        [
            DCMotorActuator(controller=CurrentLoop(kp=kp)).parameter_values
            for kp in 9.0 + np.linspace(-1e-9, 1e-9, 401)
        ]
    )
    np.testing.assert_array_equal(
        spectral_radii(DCMotorActuator, edge, 0.02) < 1.0,
        stability_radii(DCMotorActuator, edge, 0.02) < 1.0,
    )
