"""Actuators and models drawn at resets: from the right distributions, the same alone and in a batch, and in effect."""

import copy
import dataclasses
import math
import pickle
import re

import gymnasium
import numpy as np
import pytest
import scipy.stats

import codrl_mj
from codrl_mj import Choice, LogUniform, Uniform
from codrl_mj.actuators import Actuator, CurrentLoop, Drive, GearMotor, Supply, actuator_over, spectral_radius
from codrl_mj.actuators.stability import spectral_radii, stability_radii
from codrl_mj.engine.families import HEAD
from codrl_mj.envs import ActuatedEnv
from codrl_mj.tasks import named_actuator
from tests.envs.vectors import MODES, assert_equal_episodes, assert_same, batched, looped, random_actions
from tests.tasks.faces import actions, every_rebuilt, gymnasiums, random_states

DRIVE = {
    "controller.kp": LogUniform(0.3, 15.0),  # straddles instability on every task
    "motor.inductance": Uniform(0.05, 0.2),
    "motor.torque_constant": Uniform(0.5, 1.5),
    "motor.arm_radius": Uniform(0.2, 1.2),
    "controller.max_voltage": Choice([3.0, 12.0, math.inf]),
    "controller.substeps": Choice([1, 2, 3]),
    "controller.bemf_compensation": Choice([True, False]),
}
MODEL = {
    "pendulum": ("model.mass.rod", "model.length.rod"),
    "cartpole": ("model.mass.cart", "model.mass.pole", "model.length.pole"),
    "acrobot": ("model.mass.upper", "model.mass.lower", "model.length.upper", "model.length.lower"),
    "mountain_car": ("model.mass.car",),
    "mountain_car_continuous": ("model.mass.car",),
}
JOINT = {"pendulum": "hinge", "cartpole": "slider", "acrobot": "elbow"}


def scales(task):
    """Every scale factor of a task's model, drawn."""
    return dict.fromkeys((*MODEL[task], "model.gravity"), Uniform(0.6, 1.7))


DISTURBED = {
    "command_delay": 0.03,
    "pulse_force": 1.0,
    "pulse_duration": 0.05,
    "pulse_interval": 0.1,
}
IMPERFECT = {"controller": {"current_noise": 0.1}, "supply": {"resistance": 2.0}}


def everything(task):
    """All that the tests draw of a task."""
    return DRIVE | scales(task) | {f"model.damping.{JOINT.get(task, 'slider')}": Uniform(0.0, 0.3)}


# -- distributions ------------------------------------------------------------------------------------------


def test_values_have_the_distributions_that_were_asked_for():
    env = batched("cartpole", 4000, randomize=everything("cartpole"), allow_unstable=True)
    _, infos = env.reset(seed=3)
    drawn = infos["randomization"]

    def probability(name, transform=lambda x: x):
        low, high = (transform(bound) for bound in (env_bounds[name].low, env_bounds[name].high))
        assert env_bounds[name].low <= drawn[name].min() < drawn[name].max() <= env_bounds[name].high
        return scipy.stats.kstest(transform(drawn[name]), "uniform", (low, high - low)).pvalue

    env_bounds = everything("cartpole")
    for name, distribution in env_bounds.items():
        if isinstance(distribution, Uniform):
            assert probability(name) > 1e-3, name
    assert probability("controller.kp", np.log) > 1e-3
    assert probability("controller.kp") < 1e-12  # the oracle tells a uniform from a log-uniform
    for name in ("controller.max_voltage", "controller.substeps", "controller.bemf_compensation"):
        values, counts = np.unique(drawn[name], return_counts=True)
        assert list(values) == sorted(env_bounds[name].values)
        assert scipy.stats.chisquare(counts).pvalue > 1e-3
    assert drawn["controller.substeps"].dtype.kind == "i"
    assert drawn["controller.bemf_compensation"].dtype == bool
    names = list(env_bounds)
    table = np.array([drawn[name] for name in names if name != "controller.max_voltage"], dtype=float)
    correlations = np.corrcoef(table) - np.eye(len(table))
    assert np.abs(correlations).max() < 0.07  # 4.4 standard deviations: no two share a draw


@pytest.mark.parametrize("distribution", [Uniform(0.1, 0.7), LogUniform(1e-3, 5.0), Choice([3.0, 1.0, 2.0])])
def test_a_value_is_a_pure_function_of_its_draw_within_the_bounds(distribution):
    draws = np.random.default_rng(0).random(257)
    draws[:2] = 0.0, np.nextafter(1.0, 0.0)
    values = distribution.transform(draws)
    for size in (1, 2, 3, 5, 8, 13, 64):
        parts = [distribution.transform(draws[start : start + size]) for start in range(0, len(draws), size)]
        np.testing.assert_array_equal(np.concatenate(parts), values)
    assert min(distribution.extremes) <= values.min()
    assert values.max() <= max(distribution.extremes)


def test_a_value_is_the_formula_of_its_draw():
    draws = np.array([0.0, 0.25, 0.9])
    np.testing.assert_array_equal(Uniform(-1.0, 3.0).transform(draws), [-1.0, 0.0, 2.6])
    np.testing.assert_allclose(LogUniform(1.0, 16.0).transform(draws), [1.0, 2.0, 16.0**0.9], rtol=1e-15)
    np.testing.assert_array_equal(Choice([5, 6, 7, 8]).transform(draws), [5.0, 6.0, 8.0])


# -- one environment and many -------------------------------------------------------------------------------


@every_rebuilt
@pytest.mark.parametrize("mode", MODES)
def test_drawn_episodes_are_those_of_single_environments(task, mode):
    arguments = {"randomize": everything(task), "max_episode_steps": 9}
    ours = batched(task, 4, mode, num_threads=1 if mode == "SameStep" else 2, **arguments)
    ends = assert_equal_episodes(ours, looped(task, 4, mode, **arguments), 34)
    assert (ends.sum(axis=1) > 1).all()


@pytest.mark.parametrize(
    "arguments",
    [
        {"actuator": "ideal", "randomize": scales("cartpole")},
        {"randomize": {"controller.kp": LogUniform(0.5, 30.0)}},
        {"action": "current", "levels": (-1.5, 1.5), "randomize": {"motor.resistance": Uniform(0.5, 2.0)}},
        {"action": "voltage", "levels": (-9.0, 9.0), "randomize": {"motor.inductance": Uniform(0.05, 0.2)}},
        {"integrator": "semi-implicit", "randomize": everything("cartpole"), "observe_actuator": True},
        {"inner_steps": 4, "randomize": everything("cartpole")},
        {
            "actuator": actuator_over(named_actuator("paper", "cartpole"), IMPERFECT),
            "disturbances": DISTURBED,
            "joint": {"friction": 0.2},
            "randomize": DRIVE | scales("cartpole"),
        },
    ],
    ids=str,
)
def test_so_are_those_of_other_set_ups(arguments):
    for mode in ("NextStep", "SameStep"):
        arguments = {"max_episode_steps": 12, **arguments}
        assert_equal_episodes(batched("cartpole", 3, mode, **arguments), looped("cartpole", 3, mode, **arguments), 40)


def test_each_of_different_actuators_is_varied():
    nominal = [Actuator(controller=CurrentLoop(kp=kp, substeps=2)) for kp in (0.5, 1.0, 2.0)]
    arguments = {"actuator": nominal, "randomize": {"motor.inductance": Uniform(0.05, 0.2)}}
    assert_equal_episodes(batched("pendulum", 3, **arguments), looped("pendulum", 3, **arguments), 20)


@every_rebuilt
def test_seeds_draw_gymnasiums_initial_states_all_the_same(task):
    ours = ActuatedEnv(task, randomize={"controller.kp": LogUniform(0.5, 2.0), **scales(task)})
    gym = gymnasiums(task).unwrapped
    plain = ActuatedEnv(task)
    for seed in range(5):
        seen, info = ours.reset(seed=seed)
        expected, _ = gym.reset(seed=seed)
        np.testing.assert_array_equal(seen, expected)
        assert info["randomization"]["rejected"] == 0
        assert plain.reset(seed=seed)[1] == {}
    # without randomisation nothing more is drawn: a second episode is the second of Gymnasium's, too
    np.testing.assert_array_equal(plain.reset()[0], gym.reset()[0])


# -- in effect ----------------------------------------------------------------------------------------------


@every_rebuilt
@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
def test_the_drawn_actuator_is_what_acts(task, physics):
    ours = ActuatedEnv(task, physics=physics, randomize=DRIVE)
    trajectories = []
    for seed in range(4):
        _, info = ours.reset(seed=seed)
        drawn, actuator = info["randomization"], ours.actuator
        for name in DRIVE:
            part, field = name.split(".")
            assert getattr(getattr(actuator, part), field) == drawn[name]
        same = ActuatedEnv(task, physics=physics, actuator=actuator)
        same.reset(seed=seed)
        for action in actions(task, seed, 25):
            one, other = ours.step(action), same.step(action)
            assert_same(tuple(map(np.asarray, one[:4])), tuple(map(np.asarray, other[:4])))
            assert one[4] == other[4]
            np.testing.assert_array_equal(ours.state, same.state)
        trajectories.append(ours.state)
        if physics == "mujoco":
            assert tuple(ours.model.actuator_user[0, HEAD:]) == actuator.numbers
    assert len(set(map(tuple, trajectories))) == 4


class _DampedAcrobot:
    """Mixed into Gymnasium's: a damped elbow."""

    damping = 0.0

    def _dsdt(self, augmented):
        *state, torque = augmented
        return super()._dsdt(np.append(state, torque - self.damping * state[3]))


def changed_gymnasium(task, drawn):
    """Gymnasium's environment with its attributes changed as the drawn factors say, as a function: one step."""
    gravity = drawn["model.gravity"]
    if task == "acrobot":  # its gravity is no attribute: lengths / k, masses * k, inertias and torque / k are the same
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
        moments = [drawn[f"model.mass.{link}"] * drawn[f"model.length.{link}"] ** 2 for link in ("upper", "lower")]
        assert moments[0] == pytest.approx(moments[1], rel=1e-14)  # Gymnasium has one for both
        env.LINK_MOI = moments[0] / gravity
        env.AVAIL_TORQUE = [torque / gravity for torque in (-1.0, 0.0, 1.0)]
        env.damping = drawn.get("model.damping.elbow", 0.0) / gravity
    else:
        env.gravity *= gravity
        env.force = (0.0015 if task == "mountain_car_continuous" else 0.001) / drawn["model.mass.car"]

    def step(state, action):
        env.reset(seed=0)
        env.state = tuple(state) if task != "acrobot" else np.array(state)
        if task == "mountain_car_continuous":  # Gymnasium's own rounds its state: the discrete one, with its power
            env.force *= abs(float(action[0]))
            env.step(2 if action[0] > 0 else 0)
            env.force /= abs(float(action[0]))
        else:
            env.step(action)
        return np.array(env.state)

    return step


def _equal_moments(task, factors):
    """The factors, with the lower link's length such that both links of an acrobot have the same moment of inertia."""
    if task == "acrobot":
        moment = factors["model.mass.upper"] * factors["model.length.upper"] ** 2
        factors["model.length.lower"] = math.sqrt(moment / factors["model.mass.lower"])
    return factors


@every_rebuilt
def test_masses_lengths_and_gravity_are_those_of_gymnasium_with_changed_attributes(task):
    generator, worst = np.random.default_rng(5), 0.0
    for _ in range(6):
        factors = _equal_moments(task, {name: generator.uniform(0.6, 1.7) for name in scales(task)})
        ours = ActuatedEnv(task, "ideal", randomize={name: Uniform(value, value) for name, value in factors.items()})
        _, info = ours.reset(seed=0)
        assert info["randomization"] == factors | {"rejected": 0}
        step, plain = changed_gymnasium(task, factors), changed_gymnasium(task, dict.fromkeys(factors, 1.0))
        for state, action in zip(random_states(task, 1, 5), actions(task, 2, 5), strict=True):
            ours.physics.reset(state)
            ours.step(action)
            after = step(state, action)
            worst = max(worst, np.abs(ours.state - after).max())
            matters = np.abs(after - plain(state, action)).max() > 1e-6
        assert matters or task.startswith("mountain_car")  # the factors matter
    assert worst <= 1e-12


def test_acrobats_damped_elbow_is_gymnasiums_with_a_torque_against_its_speed():
    ours = ActuatedEnv("acrobot", "ideal", randomize={"model.damping.elbow": Uniform(0.4, 0.4)})
    ours.reset(seed=0)
    factors = dict.fromkeys(scales("acrobot"), 1.0)
    damped, free = (changed_gymnasium("acrobot", factors | {"model.damping.elbow": d}) for d in (0.4, 0.0))
    for state, action in zip(0.3 * random_states("acrobot", 3, 10), actions("acrobot", 4, 10), strict=True):
        ours.physics.reset(state)
        ours.step(action)
        np.testing.assert_allclose(ours.state, damped(state, action), rtol=0, atol=1e-12)
        assert np.abs(damped(state, action) - free(state, action)).max() > 1e-4


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
    randomize = {f"model.damping.{joint}": Uniform(value, value) for joint, value in damping.items()}
    explicit, free = (ActuatedEnv("cartpole", "ideal", randomize=r) for r in (randomize, None))
    state = np.array([0.1, -0.8, 0.12, 1.1])
    for env in (explicit, free):
        env.reset(seed=0)
        env.physics.reset(state)
        env.step(1)
    cosine = math.cos(state[2])  # inertia matrix of a cart of 1 kg and a rod of 0.1 kg and 2 * 0.5 m on it
    inertia = np.array([[1.1, 0.05 * cosine], [0.05 * cosine, 0.1 / 3.0]])
    braking = np.linalg.solve(inertia, [-damping["slider"] * state[1], -damping["hinge"] * state[3]])
    expected = free.state + step * np.array([0.0, braking[0], 0.0, braking[1]])
    np.testing.assert_allclose(explicit.state, expected, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(explicit.state[[0, 2]], (state + step * state[[1, 1, 3, 3]])[[0, 2]])


def test_a_pattern_names_the_motors_that_are_drawn():
    every, matched = ({path: Uniform(0.05, 0.2)} for path in ("motor.inductance", "slid.*:motor.inductance"))
    plain, ours = (ActuatedEnv("cartpole", randomize=one).reset(seed=3)[1]["randomization"] for one in (every, matched))
    assert ours == {"slid.*": {"motor.inductance": plain["motor.inductance"]}, "rejected": 0}
    many = batched("cartpole", 2, randomize=matched)
    drawn = many.reset(seed=3)[1]["randomization"]
    assert drawn["slid.*:motor.inductance"][0] == plain["motor.inductance"]
    with pytest.raises(ValueError, match=r"'hing\.\*': no actuator has such a name"):
        ActuatedEnv("cartpole", randomize={"hing.*:motor.inductance": Uniform(0.05, 0.2)})


def test_joint_friction_is_not_offered_because_the_models_switch_constraints_off():
    with pytest.raises(ValueError, match=re.escape("unknown field 'model.friction.slider'")):
        ActuatedEnv("cartpole", randomize={"model.friction.slider": Uniform(0.0, 1.0)})


def test_what_is_drawn_has_the_drawn_length():
    nominal, ours = ActuatedEnv("cartpole"), ActuatedEnv("cartpole", randomize={"model.length.pole": Uniform(0.5, 2)})
    for _ in range(3):
        length = ours.reset()[1]["randomization"]["model.length.pole"]
        pole, was = ours.model.geom("pole"), nominal.model.geom("pole")
        np.testing.assert_allclose(
            [pole.size[1], pole.pos[2]], length * np.array([was.size[1], was.pos[2]]), rtol=1e-15
        )
        assert (pole.size[0], *pole.pos[:2]) == (was.size[0], *was.pos[:2])
        np.testing.assert_array_equal(ours.model.geom("cart").size, nominal.model.geom("cart").size)
    many = batched("cartpole", 2, randomize={"model.length.pole": Uniform(0.5, 2)}, render_mode="rgb_array")
    lengths = many.reset(seed=0)[1]["randomization"]["model.length.pole"]
    many.image()
    np.testing.assert_allclose(many.unwrapped.physics.model.geom("pole").size[1], 0.5 * lengths[0], rtol=1e-15)
    many.close()


# -- stability ----------------------------------------------------------------------------------------------


def _proportional():
    """A P loop, whose stability is a line of algebra, and ranges that straddle it at CartPole's step of 0.02 s."""
    nominal = Actuator(controller=CurrentLoop(kp=1.0))
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
            inductance, kp = 0.02 + (0.2 - 0.02) * first, math.exp(math.log(0.5) + math.log(60.0) * second)
            if abs(1.0 - (1.0 + kp) * 0.02 / inductance) < 1.0:
                break
            rejected += 1
        found.append((inductance, kp, rejected))
    return np.array(found)


def test_unstable_draws_are_rejected_whole_and_counted():
    nominal, randomize = _proportional()
    env = ActuatedEnv("cartpole", nominal, randomize=randomize)
    drawn = [env.reset(seed=7)[1]["randomization"]]
    radii = [spectral_radius(env.actuator, 0.02)]
    for _ in range(299):
        drawn.append(env.reset()[1]["randomization"])
        radii.append(spectral_radius(env.actuator, 0.02))
    found = np.array([list(one.values()) for one in drawn])
    expected = _recount(7, 300)
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    assert max(radii) < 1.0
    assert 50 < expected[:, 2].sum() < 3000  # many were

    vector = batched("cartpole", 300, actuator=nominal, randomize=randomize)
    infos = vector.reset(seed=0)[1]["randomization"]
    for row in range(0, 300, 50):
        first = _recount(row, 1)[0]
        np.testing.assert_allclose([infos[name][row] for name in (*randomize, "rejected")], first, rtol=1e-14)


def test_what_a_motors_fields_refuse_together_is_rejected_too():
    """Though each would do alone; in one simulation as in many."""
    motor = {"max_temperature": 90.0, "thermal_resistance_winding": 5.0, "thermal_resistance_housing": 5.0}
    nominal = Drive(GearMotor(**motor))
    for several in (
        {f"motor.{name}": "choice(0.0, 5.0)" for name in list(motor)[1:]},
        {"motor.ambient_temperature": "choice(25.0, -75.0)", "motor.resistance_coefficient": "choice(0.0, 0.02)"},
    ):
        many = batched("pendulum", 20, actuator=nominal, randomize=several).reset(seed=0)[1]["randomization"]
        assert any(many["rejected"])
        env = ActuatedEnv("pendulum", nominal, randomize=several)
        for row in range(20):
            one = env.reset(seed=row)[1]["randomization"]
            assert one == {name: many[name][row] for name in one}


def test_a_winding_too_fast_for_its_supply_is_rejected():
    nominal = Actuator(controller=CurrentLoop(kp=0.5))
    arguments = {"randomize": {"motor.inductance": Uniform(0.02, 0.2)}}
    for ohms, least in ((0.0, 0.02), (7.0, 0.08)):  # (R + 7) * 0.02 < 2 L
        env = batched(
            "cartpole", 500, actuator=dataclasses.replace(nominal, supply=Supply(resistance=ohms)), **arguments
        )
        drawn = env.reset(seed=0)[1]["randomization"]
        assert least < drawn["motor.inductance"].min() < least + 0.005
        assert drawn["rejected"].any() == (ohms > 0)


@pytest.mark.parametrize("supply", [None, Supply()])
def test_a_supply_is_drawn_over_that_of_the_controller(supply):
    """No supply is one without resistance at `max_voltage`: a supply's voltage limits the terminal's as that does."""
    nominal = dataclasses.replace(named_actuator("paper", "cartpole"), supply=supply)
    drawn = ActuatedEnv(
        "cartpole", nominal, randomize={"supply.voltage": Choice([0.5]), "supply.resistance": Choice([0.0])}
    )
    limited = dataclasses.replace(nominal, controller=dataclasses.replace(nominal.controller, max_voltage=0.5))
    fixed = ActuatedEnv("cartpole", limited)
    for env in (drawn, fixed):
        env.reset(seed=1)
    drawn.state = fixed.state
    assert drawn.actuator.supply == Supply(0.5, 0.0)
    for action in (1, 1, 0, 1, 0, 0):
        found, expected = drawn.step(action), fixed.step(action)
        np.testing.assert_array_equal(found[0], expected[0])
        assert found[4] == expected[4]
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


@pytest.mark.parametrize("make", [lambda **a: ActuatedEnv("cartpole", **a), lambda **a: batched("cartpole", 3, **a)])
def test_bounds_without_a_stable_loop_are_an_error_at_the_reset(make):
    env = make(randomize={"controller.kp": Uniform(50.0, 60.0)})
    with pytest.raises(ValueError, match=r"1000 draws in a row have an unstable current loop at a step of 0\.02 s"):
        env.reset(seed=0)


def test_a_nominal_actuator_may_be_unstable_if_its_draws_are_not():
    unstable = Actuator(controller=CurrentLoop(kp=100.0))
    env = ActuatedEnv("cartpole", unstable, randomize={"controller.kp": Uniform(1.0, 2.0)})
    env.reset(seed=0)
    with pytest.raises(ValueError, match="unstable"):  # a model's draws leave the loop as it is
        ActuatedEnv("cartpole", unstable, randomize={"model.gravity": Uniform(0.9, 1.1)})


def test_the_radius_of_one_is_that_among_many():
    generator = np.random.default_rng(0)
    vectors = np.array([Actuator().numbers] * 300)
    vectors[:, 4:8] = generator.uniform(0.0, [20.0, 50.0, 0.05, 1.0], (300, 4))
    vectors[generator.random(300) < 0.3, 5] = 0.0
    vectors[generator.random(300) < 0.3, 6] = 0.0
    vectors[:, 10] = generator.integers(1, 4, 300)
    radii = spectral_radii(Actuator, vectors, 0.05)
    assert (radii < 1.0).any()
    assert (radii > 1.0).any()
    for size in (1, 2, 7, 100):
        parts = [spectral_radii(Actuator, vectors[start : start + size], 0.05) for start in range(0, 300, size)]
        np.testing.assert_array_equal(np.concatenate(parts), radii)


def test_the_quick_proof_of_stability_and_the_radius_agree():
    generator = np.random.default_rng(1)
    vectors = np.array([Actuator().numbers] * 20000)
    vectors[:, 0:2] = np.exp(generator.uniform(-3.0, 1.0, (20000, 2)))
    vectors[:, 4:7] = np.exp(generator.uniform(-9.0, 4.0, (20000, 3))) * (1.0, 1.0, 1e-3)
    vectors[generator.random(20000) < 0.3, 5] = 0.0
    vectors[generator.random(20000) < 0.3, 6] = 0.0
    vectors[:, 10] = generator.integers(1, 4, 20000)
    vectors[:, 11:13] = generator.choice([0.0, 1.0], (20000, 2)) * (10.0, 0.01)
    radii, quick = spectral_radii(Actuator, vectors, 0.02), stability_radii(Actuator, vectors, 0.02)
    np.testing.assert_array_equal(radii < 1.0, quick < 1.0)
    assert 0.02 < (radii >= 1.0).mean() < 0.9
    assert np.isin(quick, (0.0, np.inf)).mean() > 0.8  # it is what saves the time
    edge = np.array([Actuator(controller=CurrentLoop(kp=kp)).numbers for kp in 9.0 + np.linspace(-1e-9, 1e-9, 401)])
    np.testing.assert_array_equal(
        spectral_radii(Actuator, edge, 0.02) < 1.0, stability_radii(Actuator, edge, 0.02) < 1.0
    )


# -- saved and restored -------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["cartpole", "acrobot", "mountain_car"])
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_made_in_mid_episode_goes_on_the_same(task, duplicate):
    env = ActuatedEnv(task, randomize=everything(task))
    env.reset(seed=1)
    for action in actions(task, 0, 5):
        env.step(action)
    twin = duplicate(env)
    for _ in range(3):
        for action in actions(task, 1, 8):
            one, other = env.step(action), twin.step(action)
            assert one[4] == other[4]
            np.testing.assert_array_equal(env.state, twin.state)
        assert env.actuator == twin.actuator
        assert env.reset()[1] == twin.reset()[1]


@every_rebuilt
def test_a_vector_environment_continues_from_plain_arrays_and_as_a_copy(task):
    arguments = {"randomize": everything(task), "max_episode_steps": 10}
    env = batched(task, 5, **arguments)
    generator = np.random.default_rng(0)
    env.reset(seed=0)
    for _ in range(14):
        env.step(random_actions(env, generator))
    kept, twin = env.snapshot(), pickle.loads(pickle.dumps(env))
    assert all(isinstance(value, np.ndarray) and value.dtype != object for value in kept.values())
    batch = [random_actions(env, generator) for _ in range(25)]
    expected = [env.step(one) for one in batch]
    fresh = batched(task, 5, **arguments)
    fresh.reset(seed=99)
    fresh.restore(kept)
    for other in (fresh, twin):
        assert_same(other.randomization["rejected"], kept["rejected"])
        for one, wanted in zip(batch, expected, strict=True):
            assert_same(other.step(one), wanted)


# -- other faces --------------------------------------------------------------------------------------------


def test_dm_control_draws_what_the_environment_draws():
    suite = pytest.importorskip("codrl_mj.suite")
    randomize = everything("cartpole")
    theirs = suite.load("cartpole", randomize=randomize, task_kwargs={"random": 4})
    ours = ActuatedEnv("cartpole", randomize=randomize)
    for episode in range(3):
        _, info = ours.reset(seed=4 if episode == 0 else None)
        theirs.reset()
        assert theirs.randomization == info["randomization"]
        for action in actions("cartpole", episode, 5):
            ours.step(action)
            theirs.step(action)
        np.testing.assert_array_equal(theirs.state, ours.state)


def test_stable_baselines_environments_show_what_they_drew():
    randomize = {"controller.kp": LogUniform(0.5, 5.0)}
    env = codrl_mj.make_sb3_vec_env("codrl_mj/CartPole-v0", 3, randomize=randomize)
    env.seed(0)
    env.reset()
    same = batched("cartpole", 3, randomize=randomize)
    _, infos = same.reset(seed=0)
    np.testing.assert_array_equal(env.randomization["controller.kp"], infos["randomization"]["controller.kp"])


# -- bad input ----------------------------------------------------------------------------------------------

BAD = {
    "unknown": (
        {"motor.inductanze": Uniform(1, 2)},
        "unknown field 'motor.inductanze': did you mean 'motor.inductance'",
    ),
    "unknown body": ({"model.mass.bole": Uniform(1, 2)}, "did you mean 'model.mass.pole'"),
    "no length": ({"model.length.cart": Uniform(1, 2)}, "unknown field 'model.length.cart'"),
    "field's bound": ({"motor.inductance": Uniform(0.0, 0.2)}, "Motor.inductance = 0.0: must be a finite number > 0"),
    "field's bound below": (
        {"controller.kp": Uniform(-1.0, 0.2)},
        "CurrentLoop.kp = -1.0: must be a finite number >= 0",
    ),
    "choice's bound": ({"controller.kp": Choice([1.0, -2.0])}, "CurrentLoop.kp = -2.0: must be a finite number >= 0"),
    "infinite": ({"controller.kp": Choice([1.0, math.inf])}, "CurrentLoop.kp = inf: must be a finite number >= 0"),
    "substeps": ({"controller.substeps": Uniform(1, 4)}, "controller.substeps must be drawn from a Choice of int"),
    "substeps float": (
        {"controller.substeps": Choice([1.5])},
        "controller.substeps must be drawn from a Choice of int",
    ),
    "substeps 0": ({"controller.substeps": Choice([0, 1])}, "CurrentLoop.substeps = 0: must be an integer >= 1"),
    "flag": ({"controller.bemf_compensation": Choice([0, 1])}, "must be drawn from a Choice of bool"),
    "bool": ({"controller.kp": Choice([True])}, "controller.kp must be a number"),
    "mass": ({"model.mass.pole": Uniform(0.0, 1.0)}, "mass.pole = 0: must be a finite number > 0"),
    "damping": ({"model.damping.hinge": Uniform(-1.0, 1.0)}, "damping.hinge = -1: must be a finite number >= 0"),
    "no distribution": (
        {"controller.kp": (1.0, 2.0)},
        "controller.kp: (1.0, 2.0) is no distribution: must be uniform(",
    ),
    "empty": ({}, "must be one or more of FIELD=DISTRIBUTION, or a mapping of fields to these"),
    "no mapping": ("motor.inductance", "must be one or more of FIELD=DISTRIBUTION, or a mapping of fields to these"),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("make", [lambda **a: ActuatedEnv("cartpole", **a), lambda **a: batched("cartpole", 2, **a)])
def test_what_cannot_be_drawn_is_refused_with_a_reason(case, make):
    randomize, message = BAD[case]
    with pytest.raises(ValueError, match="randomize") as refused:
        make(randomize=randomize)
    assert message in str(refused.value)
    for name in randomize if isinstance(randomize, dict) else ():
        assert name in str(refused.value)


@pytest.mark.parametrize(
    ("distribution", "arguments", "message"),
    [
        (Uniform, (2.0, 1.0), "Uniform.high = 1: must be >= low = 2"),
        (Uniform, (0.0, math.inf), "Uniform.high = inf: must be a finite number"),
        (Uniform, ("0", 1.0), "Uniform.low = '0': must be a finite number"),
        (LogUniform, (0.0, 1.0), "LogUniform.low = 0.0: must be a finite number > 0"),
        (LogUniform, (math.nan, 1.0), "LogUniform.low = nan: must be a finite number > 0"),
        (Choice, ([],), "Choice.values = []: must be a sequence of one or more numbers"),
        (Choice, (["a"],), "'a' must be a number"),
        (Choice, ([math.nan],), "nan must be a number"),
    ],
)
def test_impossible_bounds_are_refused(distribution, arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        distribution(*arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"actuator": "ideal", "randomize": {"motor.resistance": Uniform(1, 2)}}, "the ideal actuator has no motor"),
        ({"actuator": "ideal", "randomize": {"controller.kp": Uniform(1, 2)}}, "the ideal actuator has no motor"),
        ({"physics": "analytic", "randomize": {"model.gravity": Uniform(1, 2)}}, "cannot draw model.gravity"),
        (
            {"action": "current", "levels": (-1.0, 1.0), "randomize": {"motor.arm_radius": Uniform(1, 2)}},
            "it would change what an action means",
        ),
        (
            {"action": "voltage", "levels": (-1.0, 1.0), "randomize": {"controller.kp": Uniform(1, 2)}},
            "the command goes past the controller",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        ActuatedEnv("cartpole", **arguments)
