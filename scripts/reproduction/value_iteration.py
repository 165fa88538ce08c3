"""Value iteration of the continuous mountain car: the best policy and its value by discount.

The dynamics are those of the installed Gymnasium environment, which `codrl_mj.physics.analytic`
steps. Reward and termination are the task's. Nothing of them is repeated here.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation.episodes import Episode, run_episodes
from codrl_mj.evaluation.measures import Interval, Quartiles, bootstrap_mean, quartiles
from codrl_mj.fields import Checked, integer
from codrl_mj.tasks import TASKS

TASK = "mountain_car_continuous"
DISCOUNTS = (0.85, 0.9, 0.95, 0.99, 0.999)
"""The paper's discount factor, and larger ones."""


@dataclasses.dataclass(frozen=True)
class Mesh(Checked):
    """Grid of states at which values are computed, with interpolation between its points."""

    positions: int = integer(121, minimum=2)
    """Number of positions from wall to wall, >= 2."""
    speeds: int = integer(121, minimum=2)
    """Number of speeds between the limits, >= 2."""
    forces: int = integer(21, minimum=3)
    """Number of forces, evenly from -1 N to 1 N, >= 3; odd, so that one of them is 0."""

    def __post_init__(self) -> None:
        """Validate.

        Raises:
            ValueError: a number is out of bounds.
        """
        super().__post_init__()
        if self.forces % 2 == 0:
            raise ValueError(f"Mesh.forces = {self.forces}: must be an odd number")

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions [m] and speeds [m/s] of the points."""
        space = TASKS[TASK].observation_space
        (x_low, v_low), (x_high, v_high) = space.low.astype(float), space.high.astype(float)
        return np.linspace(x_low, x_high, self.positions), np.linspace(v_low, v_high, self.speeds)

    @property
    def actions(self) -> np.ndarray:
        """Forces [N]."""
        return np.linspace(-1.0, 1.0, self.forces)


class Model:
    """One step of the car from every point of a grid under every force."""

    def __init__(self, grid: Mesh = Mesh()) -> None:
        """Step Gymnasium's environment from every point, which takes some seconds."""
        from scipy import sparse

        task = TASKS[TASK]
        assert task.reference_env is not None
        step = task.reference_env()
        self.grid = grid
        points = np.stack(
            [axis.ravel() for axis in np.meshgrid(*grid.axes, indexing="ij")], axis=-1
        )
        after = np.array(
            [
                [step(point, force, task.step_duration, "") for point in points]
                for force in grid.actions.tolist()
            ]
        )
        entries = after.reshape(-1, 2).T
        ends = np.asarray(task.terminated(entries))
        force = np.repeat(grid.actions, len(points))
        before = np.tile(points, (grid.forces, 1)).T
        self.rewards = np.asarray(task.reward(before, force, entries, task.options())).reshape(
            grid.forces, -1
        )
        """Reward of every force at every point, shape (A, S)."""
        self.transitions = sparse.diags_array((~ends).astype(float)) @ interpolation(
            grid, entries.T
        )
        """Weights of the points' values in the next state, (A*S, S); 0 if the episode ends."""


def interpolation(grid: Mesh, states: np.ndarray) -> Any:
    """Return the weights of bilinear interpolation as a sparse matrix (n, S).

    They give values at states from values at the grid's points.

    Args:
        grid: grid of the values.
        states: positions and speeds, shape (n, 2); states beyond the grid are moved to its edge.
    """
    from scipy import sparse

    below, share = [], []
    for axis, values in zip(grid.axes, states.T, strict=True):
        position = np.clip((values - axis[0]) / (axis[1] - axis[0]), 0, len(axis) - 1)
        # The last point belongs to the cell below it.
        below.append(np.minimum(position.astype(int), len(axis) - 2))
        share.append(position - below[-1])
    corners = [(i, j) for i in (0, 1) for j in (0, 1)]
    weights = [np.abs(1 - i - share[0]) * np.abs(1 - j - share[1]) for i, j in corners]
    columns = [(below[0] + i) * grid.speeds + below[1] + j for i, j in corners]
    rows = np.tile(np.arange(len(states)), len(corners))
    shape = len(states), grid.positions * grid.speeds
    return sparse.csr_array((np.concatenate(weights), (rows, np.concatenate(columns))), shape=shape)


def iterate(
    rewards: np.ndarray, transitions: Any, discount: float, accuracy: float = 1e-4
) -> np.ndarray:
    """Compute Q = r + discount * P max Q, the value of each action at each state, by iteration.

    It ends when the last change times discount/(1 - discount), which bounds the remaining error, is
    below the accuracy.

    Args:
        rewards: rewards, shape (A, S).
        transitions: probabilities of the next states, shape (A*S, S); rows of 0 where the episode
            ends.
        discount: discount factor, from 0 to below 1.
        accuracy: largest error of the values.

    Returns:
        Q, shape (A, S).

    Raises:
            ValueError: the discount is out of bounds; the sum would not converge.
    """
    if not 0 <= discount < 1:
        raise ValueError(f"discount = {discount}: must be from 0 to below 1")
    values = np.zeros(rewards.shape[1])
    while True:
        future = (transitions @ values).reshape(rewards.shape)
        action_values: np.ndarray = rewards + discount * future
        best = action_values.max(axis=0)
        change = np.abs(best - values).max()
        values = best
        if change * discount <= accuracy * (1 - discount):
            return action_values


class Greedy:
    """Policy that takes the best action by interpolated values."""

    def __init__(self, grid: Mesh, action_values: np.ndarray) -> None:
        """Store the grid and the values, shape (A, S)."""
        self._grid, self._action_values = grid, action_values

    def predict(
        self,
        observation: np.ndarray,
        *,
        deterministic: bool = False,  # noqa: ARG002 - the protocol's
    ) -> tuple[np.ndarray, Any]:
        """Return the best force for each observation (position and speed), shape (n, 1)."""
        values = interpolation(self._grid, observation.astype(float)) @ self._action_values.T
        return self._grid.actions[np.argmax(values, axis=1)][:, None], None


@dataclasses.dataclass(frozen=True)
class Optimum:
    """Best policy at a discount factor, and its results in Gymnasium's environment."""

    discount: float
    """Discount factor."""
    value: float
    """Expected discounted return from x = -0.5 m at rest."""
    stands_still: bool
    """True if no force is applied in any episode."""
    returns: Interval
    """Return (not discounted) of the episodes."""
    success: float
    """Share of episodes that reach the goal."""
    steps: Quartiles | None
    """Steps to the goal; None if no episode reaches it."""
    episode: Episode
    """First episode."""

    def as_mapping(self) -> dict[str, Any]:
        """Return JSON-serializable values, without the episode."""
        mapping = {name: value for name, value in vars(self).items() if name != "episode"}
        return mapping | {
            "returns": self.returns._asdict(),
            "steps": None if self.steps is None else self.steps._asdict(),
        }


def optimum(model: Model, discount: float, episodes: int = 20) -> Optimum:
    """Find the best policy and let it drive Gymnasium's own car, without a motor.

    Args:
        model: steps of the car.
        discount: discount factor, from 0 to below 1.
        episodes: number of episodes, with seeds from 0.
    """
    action_values = iterate(model.rewards, model.transitions, discount)
    test_episodes = run_episodes(
        Greedy(model.grid, action_values),
        EnvConfig(TASK, None, physics="analytic").build,
        episodes=episodes,
    )
    lengths = np.array([len(episode.reward) for episode in test_episodes if episode.terminated])
    return Optimum(
        discount=discount,
        value=start_value(model, action_values),
        stands_still=all(not episode.action.any() for episode in test_episodes),
        returns=bootstrap_mean(np.array([episode.total for episode in test_episodes])),
        success=len(lengths) / len(test_episodes),
        steps=quartiles(lengths) if len(lengths) else None,
        episode=test_episodes[0],
    )


def start_value(model: Model, action_values: np.ndarray) -> float:
    """Return the value of x = -0.5 m at rest, the middle of the starts, from Q of shape (A, S)."""
    return float(
        (interpolation(model.grid, np.array([[-0.5, 0.0]])) @ action_values.max(axis=0))[0]
    )


def values_over(model: Model, discounts: Sequence[float]) -> dict[float, float]:
    """Return the values of x = -0.5 m at rest by discount factor."""
    return {
        discount: start_value(model, iterate(model.rewards, model.transitions, discount))
        for discount in discounts
    }
