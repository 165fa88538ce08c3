"""Value iteration, against a chain's closed form and Gymnasium's mountain car."""

import gymnasium
import numpy as np
import pytest
from scipy import sparse

from reproduction.value_iteration import Mesh, Model, interpolation, iterate, optimum

COARSE = Mesh(61, 61, 11)


@pytest.fixture(scope="module")
def model():
    return Model(COARSE)


@pytest.mark.parametrize("discount", [0.0, 0.5, 0.99])
def test_the_values_of_a_chain_agree_with_the_closed_form(discount):
    """Actions are to stay for 0 or to step forward for -c; the n-th step earns 1.

    The value is g^(n-1) - c (1 - g^n)/(1 - g) at discount g.
    """
    length, cost = 5, 0.1
    stay = sparse.eye_array(length)
    step = sparse.csr_array(np.diag(np.ones(length - 1), 1))  # the last one ends the episode
    rewards = np.array([np.zeros(length), np.full(length, -cost)])
    rewards[1, -1] += 1.0
    values = iterate(rewards, sparse.vstack([stay, step]), discount, 1e-9).max(axis=0)
    steps = np.arange(length, 0, -1)
    walking = discount ** (steps - 1.0) - cost * (1 - discount**steps) / (1 - discount)
    assert values == pytest.approx(np.maximum(walking, 0.0), abs=1e-9)


@pytest.mark.parametrize("discount", [1.0, -0.1])
def test_raises_if_the_discount_does_not_converge(discount):
    with pytest.raises(ValueError, match=f"discount = {discount}: must be from 0 to below 1"):
        iterate(np.zeros((1, 1)), sparse.eye_array(1), discount)


@pytest.mark.parametrize(
    ("field", "value"), [("positions", 1), ("speeds", 0), ("forces", 4), ("forces", 1)]
)
def test_raises_if_the_grid_is_invalid(field, value):
    with pytest.raises(ValueError, match=f"Mesh.{field} = {value}: must be"):
        Mesh(**{field: value})


def test_interpolation_is_exact_for_bilinear_functions():
    grid = Mesh(7, 5, 3)
    positions, speeds = np.meshgrid(*grid.axes, indexing="ij")

    def bilinear(x, v):
        return 2.0 - 3.0 * x + 50.0 * v + 7.0 * x * v

    states = np.random.default_rng(0).uniform([-1.2, -0.07], [0.6, 0.07], (200, 2))
    states = np.vstack(
        [states, [[0.6, 0.07], [-1.2, -0.07], *np.stack([positions, speeds], -1).reshape(-1, 2)]]
    )
    weights = interpolation(grid, states)
    assert weights @ bilinear(positions, speeds).ravel() == pytest.approx(bilinear(*states.T))
    assert weights.sum(axis=1) == pytest.approx(1.0)


def test_the_model_agrees_with_gymnasium_s_step(model):
    """The oracle rounds its state to float32."""
    env = gymnasium.make("MountainCarContinuous-v0", disable_env_checker=True).unwrapped
    random = np.random.default_rng(0)
    positions, speeds = model.grid.axes
    ended = 0
    for _ in range(500):
        x, v, action = random.integers(61), random.integers(61), random.integers(11)
        env.reset()
        env.state = np.array([positions[x], speeds[v]])
        after, reward, over, _, _ = env.step(np.array([model.grid.actions[action]]))
        row = model.transitions[[action * 61 * 61 + x * 61 + v]]
        assert model.rewards[action, x * 61 + v] == pytest.approx(reward)
        assert row.sum() == pytest.approx(0.0 if over else 1.0)
        if not over:
            means = row @ np.stack(np.meshgrid(positions, speeds, indexing="ij"), -1).reshape(-1, 2)
            assert means[0] == pytest.approx(after, abs=1e-6)
        ended += over
    assert ended > 0


def test_at_the_papers_discount_factor_standing_still_is_optimal(model):
    still = optimum(model, 0.85, episodes=3)
    assert still.stands_still
    assert still.value == pytest.approx(0.0, abs=1e-3)
    assert (still.returns.mean, still.success, still.steps) == (0.0, 0.0, None)


def test_at_a_larger_discount_factor_the_car_solves_the_task(model):
    driving = optimum(model, 0.99, episodes=5)
    assert not driving.stands_still
    assert driving.success == 1.0
    assert driving.returns.mean > gymnasium.spec("MountainCarContinuous-v0").reward_threshold
    steps = len(driving.episode.reward)
    assert driving.episode.total == pytest.approx(
        100 - 0.1 * (driving.episode.action**2).sum(), abs=1e-4
    )
    # 100 discounted over the way, less at most 0.1 a step: bounds that need no value iteration
    assert 100 * 0.99 ** (steps + 5) - 10 < driving.value < 100 * 0.99 ** (steps - 5)
