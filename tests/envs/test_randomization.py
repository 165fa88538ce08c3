"""Actuators and models drawn at resets: from the right distributions, the same alone and in a batch, and in effect."""

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
from codrl_mj.engine.families import HEAD
from codrl_mj.envs import ActuatedEnv
from codrl_mj.tasks import named_actuator
from tests.envs.faces import DRIVE, plain, scales
from tests.envs.vectors import assert_same, batched
from tests.tasks.faces import actions, every_rebuilt, gymnasiums, random_states

JOINT = {"pendulum": "hinge", "cartpole": "slider", "acrobot": "elbow"}


def everything_drawn(task):
    """All that is drawn of a task, its damping too."""
    return DRIVE | scales(task) | {f"model.damping.{JOINT.get(task, 'slider')}": Uniform(0.0, 0.3)}


# -- distributions ------------------------------------------------------------------------------------------


def test_values_have_the_distributions_that_were_asked_for():
    asked = everything_drawn("cartpole")
    env = batched("cartpole", 4000, randomize=asked, allow_unstable=True)
    drawn = env.reset(seed=3)[1]["randomization"]

    def probability(name, transform=lambda x: x):
        low, high = transform(asked[name].low), transform(asked[name].high)
        assert asked[name].low <= drawn[name].min() < drawn[name].max() <= asked[name].high
        return scipy.stats.kstest(transform(drawn[name]), "uniform", (low, high - low)).pvalue

    for name, distribution in asked.items():
        if isinstance(distribution, Uniform):
            assert probability(name) > 1e-3, name
    assert probability("controller.kp", np.log) > 1e-3
    assert probability("controller.kp") < 1e-12  # the oracle tells a uniform from a log-uniform
    for name in ("controller.max_voltage", "controller.substeps", "controller.bemf_compensation"):
        values, counts = np.unique(drawn[name], return_counts=True)
        assert list(values) == sorted(asked[name].values)
        assert scipy.stats.chisquare(counts).pvalue > 1e-3
    assert drawn["controller.substeps"].dtype.kind == "i"
    assert drawn["controller.bemf_compensation"].dtype == bool
    table = np.array(
        [drawn[name] for name in asked if name != "controller.max_voltage"], dtype=float
    )
    correlations = np.corrcoef(table) - np.eye(len(table))
    assert np.abs(correlations).max() < 0.07  # 4.4 standard deviations: no two share a draw


@pytest.mark.parametrize(
    ("distribution", "formula"),
    [
        (Uniform(-1.0, 3.0), lambda draw: -1.0 + 4.0 * draw),
        (LogUniform(1.0, 16.0), lambda draw: 16.0**draw),
        (Choice([3.0, 1.0, 2.0]), lambda draw: np.array([3.0, 1.0, 2.0])[(3 * draw).astype(int)]),
    ],
)
def test_a_value_is_the_formula_of_its_draw_within_the_bounds_however_many_are_drawn(
    distribution, formula
):
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
def test_seeds_draw_gymnasiums_initial_states_all_the_same(task):
    ours = ActuatedEnv(task, randomize={"controller.kp": LogUniform(0.5, 2.0), **scales(task)})
    gym = gymnasiums(task).unwrapped
    undrawn = ActuatedEnv(task)
    for seed in range(5):
        seen, info = ours.reset(seed=seed)
        expected, _ = gym.reset(seed=seed)
        np.testing.assert_array_equal(seen, expected)
        assert info["randomization"]["rejected"] == 0
        assert undrawn.reset(seed=seed)[1] == {}
    # without randomisation nothing more is drawn: a second episode is the second of Gymnasium's,
    # too
    np.testing.assert_array_equal(undrawn.reset()[0], gym.reset()[0])


# -- in effect ----------------------------------------------------------------------------------------------


@every_rebuilt
@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
def test_the_drawn_actuator_is_what_acts(task, physics):
    ours, ends = ActuatedEnv(task, physics=physics, randomize=DRIVE), set()
    for seed in range(4):
        drawn, actuator = ours.reset(seed=seed)[1]["randomization"], ours.actuator
        for name in DRIVE:
            part, field = name.split(".")
            assert getattr(getattr(actuator, part), field) == drawn[name]
        same = ActuatedEnv(task, physics=physics, actuator=actuator)
        same.reset(seed=seed)
        for action in actions(task, seed, 25):
            assert_same(
                plain((ours.step(action), ours.state)), plain((same.step(action), same.state))
            )
        ends.add(tuple(ours.state))
        if physics == "mujoco":
            assert tuple(ours.model.actuator_user[0, HEAD:]) == actuator.parameter_values
    assert len(ends) == 4


class _DampedAcrobot:
    """Mixed into Gymnasium's: a damped elbow."""

    damping = 0.0

    def _dsdt(self, augmented):
        *state, torque = augmented
        return super()._dsdt(np.append(state, torque - self.damping * state[3]))


def changed_gymnasium(task, drawn):
    """Gymnasium's environment with its attributes changed as the drawn factors say, as a function: one step."""
    gravity = drawn["model.gravity"]
    if (
        task == "acrobot"
    ):  # its gravity is no attribute: lengths / k, masses * k, inertias and torque / k are the same
        env = type("Damped", (_DampedAcrobot, type(gymnasiums(task).unwrapped)), {})()
    else:
        env = gymnasiums("mountain_car" if task == "mountain_car_continuous" else task).unwrapped
    if task == "pendulum":
        env.m *= drawn["model.mass.rod"]
        env.l *= drawn["model.length.rod"]
        env.g *= gravity
    elif task == "cartpole":
        env.masscart *= drawn["model.mass.cart"]
        env.masspole *= drawn["model.mass.pole"]
        env.length *= drawn["model.length.pole"]
        env.total_mass = env.masscart + env.masspole
        env.polemass_length = env.masspole * env.length
        env.gravity *= gravity
    elif task == "acrobot":
        env.LINK_MASS_1 = drawn["model.mass.upper"] * gravity
        env.LINK_MASS_2 = drawn["model.mass.lower"] * gravity
        env.LINK_LENGTH_1 = drawn["model.length.upper"] / gravity
        env.LINK_COM_POS_1 = 0.5 * drawn["model.length.upper"] / gravity
        env.LINK_COM_POS_2 = 0.5 * drawn["model.length.lower"] / gravity
        moments = [
            drawn[f"model.mass.{link}"] * drawn[f"model.length.{link}"] ** 2
            for link in ("upper", "lower")
        ]
        assert moments[0] == pytest.approx(moments[1], rel=1e-14)  # Gymnasium has one for both
        env.LINK_MOI = moments[0] / gravity
        env.AVAIL_TORQUE = [torque / gravity for torque in (-1.0, 0.0, 1.0)]
        env.damping = drawn.get("model.damping.elbow", 0.0) / gravity
    else:
        env.gravity *= gravity
        env.force = (0.0015 if task == "mountain_car_continuous" else 0.001) / drawn[
            "model.mass.car"
        ]

    def step(state, action):
        env.reset(seed=0)
        env.state = tuple(state) if task != "acrobot" else np.array(state)
        if (
            task == "mountain_car_continuous"
        ):  # Gymnasium's own rounds its state: the discrete one, with its power
            env.force *= abs(float(action[0]))
            env.step(2 if action[0] > 0 else 0)
            env.force /= abs(float(action[0]))
        else:
            env.step(action)
        return np.array(env.state)

    return step


def _factors(task, generator):
    """Random ones; of an acrobot, both of whose links have the same moment of inertia, with a damped elbow."""
    factors = {name: generator.uniform(0.6, 1.7) for name in scales(task)}
    if task == "acrobot":
        moment = factors["model.mass.upper"] * factors["model.length.upper"] ** 2
        factors["model.length.lower"] = math.sqrt(moment / factors["model.mass.lower"])
        factors["model.damping.elbow"] = generator.uniform(0.1, 0.5)
    return factors


@every_rebuilt
def test_masses_lengths_gravity_and_damping_are_those_of_gymnasium_with_changed_attributes(task):
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
            changed_gymnasium(task, one) for one in (factors, dict.fromkeys(scales(task), 1.0))
        )
        for state, action in zip(random_states(task, 1, 5), actions(task, 2, 5), strict=True):
            ours.physics.reset(state)
            ours.step(action)
            after = step(state, action)
            np.testing.assert_allclose(ours.state, after, rtol=0, atol=1e-12)
            matters = np.abs(after - unchanged(state, action)).max() > 1e-6
        assert matters or task.startswith("mountain_car")  # the factors matter


@pytest.mark.parametrize("damping", [0.0, 0.3, 5.0])
def test_a_damped_pendulum_and_car_take_the_damping_implicitly(damping):
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
        impulse = mass * (free.state[1] - state[1])  # of everything else
        speed = (mass * state[1] + impulse) / (mass + step * damping * scale)
        np.testing.assert_allclose(ours.state, [state[0] + step * speed, speed], rtol=0, atol=1e-14)


def test_cartpoles_explicit_euler_takes_the_damping_explicitly():
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
    cosine = math.cos(
        state[2]
    )  # inertia matrix of a cart of 1 kg and a rod of 0.1 kg and 2 * 0.5 m on it
    inertia = np.array([[1.1, 0.05 * cosine], [0.05 * cosine, 0.1 / 3.0]])
    braking = np.linalg.solve(
        inertia, [-damping["slider"] * state[1], -damping["hinge"] * state[3]]
    )
    expected = free.state + step * np.array([0.0, braking[0], 0.0, braking[1]])
    np.testing.assert_allclose(explicit.state, expected, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(
        explicit.state[[0, 2]], (state + step * state[[1, 1, 3, 3]])[[0, 2]]
    )


def test_a_pattern_names_the_motors_that_are_drawn():
    every, matched = (
        {path: Uniform(0.05, 0.2)} for path in ("motor.inductance", "slid.*:motor.inductance")
    )
    everywhere, ours = (
        ActuatedEnv("cartpole", randomize=one).reset(seed=3)[1]["randomization"]
        for one in (every, matched)
    )
    assert ours == {"slid.*": {"motor.inductance": everywhere["motor.inductance"]}, "rejected": 0}
    many = batched("cartpole", 2, randomize=matched)
    drawn = many.reset(seed=3)[1]["randomization"]
    assert drawn["slid.*:motor.inductance"][0] == everywhere["motor.inductance"]


def test_what_is_drawn_has_the_drawn_length():
    nominal, ours = (
        ActuatedEnv("cartpole"),
        ActuatedEnv("cartpole", randomize={"model.length.pole": Uniform(0.5, 2)}),
    )
    for _ in range(3):
        length = ours.reset()[1]["randomization"]["model.length.pole"]
        pole, was = ours.model.geom("pole"), nominal.model.geom("pole")
        np.testing.assert_allclose(
            [pole.size[1], pole.pos[2]], length * np.array([was.size[1], was.pos[2]]), rtol=1e-15
        )
        assert (pole.size[0], *pole.pos[:2]) == (was.size[0], *was.pos[:2])
        np.testing.assert_array_equal(ours.model.geom("cart").size, nominal.model.geom("cart").size)
    many = batched(
        "cartpole", 2, randomize={"model.length.pole": Uniform(0.5, 2)}, render_mode="rgb_array"
    )
    lengths = many.reset(seed=0)[1]["randomization"]["model.length.pole"]
    many.image()
    np.testing.assert_allclose(
        many.unwrapped.physics.model.geom("pole").size[1], 0.5 * lengths[0], rtol=1e-15
    )
    many.close()


# -- stability ----------------------------------------------------------------------------------------------


def _proportional():
    """A P loop, whose stability is a line of algebra, and ranges that straddle it at CartPole's step of 0.02 s."""
    nominal = DCMotorActuator(controller=CurrentLoop(kp=1.0))
    return nominal, {"motor.inductance": Uniform(0.02, 0.2), "controller.kp": LogUniform(0.5, 30.0)}


def _recount(seed, episodes):
    """What an environment of that seed draws: values and rejections by hand, from the same numbers."""
    generator = gymnasium.utils.seeding.np_random(seed)[0]
    found = []
    for _ in range(episodes):
        generator.random(4)  # the initial state
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
        found.append((inductance, kp, rejected))
    return np.array(found)


def test_unstable_draws_are_rejected_whole_and_counted():
    nominal, randomize = _proportional()
    env, drawn, radii = ActuatedEnv("cartpole", nominal, randomize=randomize), [], []
    for episode in range(300):
        drawn.append([*env.reset(seed=7 if episode == 0 else None)[1]["randomization"].values()])
        radii.append(spectral_radius(env.actuator, 0.02))
    expected = _recount(7, 300)
    np.testing.assert_allclose(drawn, expected, rtol=1e-14)
    assert max(radii) < 1.0
    assert 50 < expected[:, 2].sum() < 3000  # many were


def test_what_a_motors_fields_refuse_together_is_rejected_too():
    """Though each would do alone; in one simulation as in many."""
    motor = {
        "max_temperature": 90.0,
        "thermal_resistance_winding": 5.0,
        "thermal_resistance_housing": 5.0,
    }
    nominal = Drive(GearMotor(**motor))
    for several in (
        {f"motor.{name}": "choice(0.0, 5.0)" for name in list(motor)[1:]},
        {
            "motor.ambient_temperature": "choice(25.0, -75.0)",
            "motor.resistance_coefficient": "choice(0.0, 0.02)",
        },
    ):
        many = batched("pendulum", 20, actuator=nominal, randomize=several).reset(seed=0)[1][
            "randomization"
        ]
        assert any(many["rejected"])
        env = ActuatedEnv("pendulum", nominal, randomize=several)
        for row in range(20):
            one = env.reset(seed=row)[1]["randomization"]
            assert one == {name: many[name][row] for name in one}


def test_a_winding_too_fast_for_its_supply_is_rejected():
    nominal = DCMotorActuator(controller=CurrentLoop(kp=0.5))
    arguments = {"randomize": {"motor.inductance": Uniform(0.02, 0.2)}}
    for ohms, least in ((0.0, 0.02), (7.0, 0.08)):  # (R + 7) * 0.02 < 2 L
        env = batched(
            "cartpole",
            500,
            actuator=dataclasses.replace(nominal, supply=Supply(resistance=ohms)),
            **arguments,
        )
        drawn = env.reset(seed=0)[1]["randomization"]
        assert least < drawn["motor.inductance"].min() < least + 0.005
        assert drawn["rejected"].any() == (ohms > 0)


@pytest.mark.parametrize("supply", [None, Supply()])
def test_a_supply_is_drawn_over_that_of_the_controller(supply):
    """No supply is one without resistance at `max_voltage`: a supply's voltage limits the terminal's as that does."""
    nominal = dataclasses.replace(named_actuator("paper", "cartpole"), supply=supply)
    limited = dataclasses.replace(
        nominal, controller=dataclasses.replace(nominal.controller, max_voltage=0.5)
    )
    choices = {"supply.voltage": Choice([0.5]), "supply.resistance": Choice([0.0])}
    drawn, fixed = (
        ActuatedEnv("cartpole", nominal, randomize=choices),
        ActuatedEnv("cartpole", limited),
    )
    for env in (drawn, fixed):
        env.reset(seed=1)
    drawn.state = fixed.state
    assert drawn.actuator.supply == Supply(0.5, 0.0)
    for action in (1, 1, 0, 1, 0, 0):
        found = drawn.step(action)
        assert_same(plain(found), plain(fixed.step(action)))
        assert abs(found[4]["voltage"]) <= 0.5
    sagging = ActuatedEnv("cartpole", nominal, randomize={"supply.resistance": Uniform(1.0, 2.0)})
    sagging.reset(seed=1)
    assert math.isinf(sagging.actuator.supply.voltage)


def test_unstable_draws_are_kept_on_request():
    nominal, randomize = _proportional()
    env = batched("cartpole", 200, actuator=nominal, randomize=randomize, allow_unstable=True)
    drawn = env.reset(seed=0)[1]["randomization"]
    gains = np.abs(1.0 - (1.0 + drawn["controller.kp"]) * 0.02 / drawn["motor.inductance"])
    assert (gains > 1.0).sum() > 20
    assert not drawn["rejected"].any()


@pytest.mark.parametrize(
    "make", [lambda **a: ActuatedEnv("cartpole", **a), lambda **a: batched("cartpole", 3, **a)]
)
def test_bounds_without_a_stable_loop_are_an_error_at_the_reset(make):
    env = make(randomize={"controller.kp": Uniform(50.0, 60.0)})
    with pytest.raises(
        ValueError, match=r"1000 draws in a row have an unstable current loop at a step of 0\.02 s"
    ):
        env.reset(seed=0)


def test_a_nominal_actuator_may_be_unstable_if_its_draws_are_not():
    unstable = DCMotorActuator(controller=CurrentLoop(kp=100.0))
    env = ActuatedEnv("cartpole", unstable, randomize={"controller.kp": Uniform(1.0, 2.0)})
    env.reset(seed=0)


def test_the_radius_of_one_is_that_among_many():
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


def test_the_quick_proof_of_stability_and_the_radius_agree():
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
    assert np.isin(quick, (0.0, np.inf)).mean() > 0.8  # it is what saves the time
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
