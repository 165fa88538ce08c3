"""Value iteration of the continuous mountain car: what the best policy is worth, and does, at a discount factor.

The dynamics are the installed Gymnasium environment's, driven by `codrl_mj.physics.analytic`;
reward and end are the task's. Nothing of them is written down here again.
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
    """Where values are computed; between its points they are interpolated."""

    positions: int = integer(121, minimum=2)
    """Points from wall to wall, >= 2."""
    speeds: int = integer(121, minimum=2)
    """Points between the speed limits, >= 2."""
    forces: int = integer(21, minimum=3)
    """Forces to choose from, evenly from -1 N to 1 N, >= 3; an odd number, so that there is one of 0."""

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
        """The points' positions [m] and speeds [m/s]."""
        space = TASKS[TASK].observation_space
        (x_low, v_low), (x_high, v_high) = space.low.astype(float), space.high.astype(float)
        return np.linspace(x_low, x_high, self.positions), np.linspace(v_low, v_high, self.speeds)

    @property
    def actions(self) -> np.ndarray:
        """The forces [N]."""
        return np.linspace(-1.0, 1.0, self.forces)


class Model:
    """One step of the car from every point of a grid under every force."""

    def __init__(self, grid: Mesh = Mesh()) -> None:
        """Step Gymnasium's environment from every point: some seconds."""
        from scipy import sparse

        task = TASKS[TASK]
        assert task.twin is not None
        step = task.twin()
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
        """Weights of the points' values in what comes after, shape (A*S, S); none where the episode ends."""


def interpolation(grid: Mesh, states: np.ndarray) -> Any:
    """Weights with which values at the grid's points make values at states: bilinear, a sparse matrix (n, S).

    Args:
        grid: the grid.
        states: positions and speeds, shape (n, 2); beyond the grid those at its edge count.
    """
    from scipy import sparse

    below, share = [], []
    for axis, values in zip(grid.axes, states.T, strict=True):
        place = np.clip((values - axis[0]) / (axis[1] - axis[0]), 0, len(axis) - 1)
        below.append(np.minimum(place.astype(int), len(axis) - 2))
        share.append(place - below[-1])
    corners = [(i, j) for i in (0, 1) for j in (0, 1)]
    weights = [np.abs(1 - i - share[0]) * np.abs(1 - j - share[1]) for i, j in corners]
    columns = [(below[0] + i) * grid.speeds + below[1] + j for i, j in corners]
    rows = np.tile(np.arange(len(states)), len(corners))
    shape = len(states), grid.positions * grid.speeds
    return sparse.csr_array((np.concatenate(weights), (rows, np.concatenate(columns))), shape=shape)


def iterate(
    rewards: np.ndarray, transitions: Any, discount: float, accuracy: float = 1e-4
) -> np.ndarray:
    """Value iteration: the values of every action at every state, Q = r + discount * P max Q.

    It ends when the last change times discount/(1 - discount), which bounds the error left, is
    below the accuracy.

    Args:
        rewards: shape (A, S).
        transitions: probabilities of the states that come next, shape (A*S, S); rows of 0 where the
            episode ends.
        discount: from 0 to below 1.
        accuracy: of the values.

    Returns:
        Q, shape (A, S).

    Raises:
        ValueError: the discount is out of bounds: the sum would not converge.
    """
    if not 0 <= discount < 1:
        raise ValueError(f"discount = {discount}: must be from 0 to below 1")
    values = np.zeros(rewards.shape[1])
    while True:
        of_actions = rewards + discount * (transitions @ values).reshape(rewards.shape)
        best = of_actions.max(axis=0)
        change = np.abs(best - values).max()
        values = best
        if change * discount <= accuracy * (1 - discount):
            return of_actions


class Greedy:
    """The policy that takes the best action by interpolated values."""

    def __init__(self, grid: Mesh, of_actions: np.ndarray) -> None:
        """Keep the values, shape (A, S)."""
        self._grid, self._of_actions = grid, of_actions

    def predict(
        self,
        observation: np.ndarray,
        *,
        deterministic: bool = False,  # noqa: ARG002 - the protocol's
    ) -> tuple[np.ndarray, Any]:
        """The best force for each observation (position and speed), shape (n, 1)."""
        values = interpolation(self._grid, observation.astype(float)) @ self._of_actions.T
        return self._grid.actions[np.argmax(values, axis=1)][:, None], None


@dataclasses.dataclass(frozen=True)
class Optimum:
    """The best policy at a discount factor, and what it does in Gymnasium's environment."""

    discount: float
    """The discount factor."""
    value: float
    """The discounted return that it expects from x = -0.5 m at rest."""
    stands_still: bool
    """It applies no force at all in any episode."""
    returns: Interval
    """Return (not discounted) of the episodes."""
    success: float
    """Share of episodes that reach the goal."""
    steps: Quartiles | None
    """Steps to the goal; None if no episode reaches it."""
    episode: Episode
    """The first episode."""

    def as_mapping(self) -> dict[str, Any]:
        """JSON-serialisable values, without the episode."""
        mapping = {name: value for name, value in vars(self).items() if name != "episode"}
        return mapping | {
            "returns": self.returns._asdict(),
            "steps": None if self.steps is None else self.steps._asdict(),
        }


def optimum(model: Model, discount: float, episodes: int = 20) -> Optimum:
    """Find the best policy and let it drive Gymnasium's own car, without a motor.

    Args:
        model: the steps of the car.
        discount: from 0 to below 1.
        episodes: seeds from 0.
    """
    of_actions = iterate(model.rewards, model.transitions, discount)
    ran = run_episodes(
        Greedy(model.grid, of_actions),
        EnvConfig(TASK, None, physics="analytic").make,
        episodes=episodes,
    )
    lengths = np.array([len(episode.reward) for episode in ran if episode.terminated])
    return Optimum(
        discount=discount,
        value=start_value(model, of_actions),
        stands_still=all(not episode.action.any() for episode in ran),
        returns=bootstrap_mean(np.array([episode.total for episode in ran])),
        success=len(lengths) / len(ran),
        steps=quartiles(lengths) if len(lengths) else None,
        episode=ran[0],
    )


def start_value(model: Model, of_actions: np.ndarray) -> float:
    """Value of x = -0.5 m at rest, the middle of the starts, from Q of shape (A, S)."""
    return float((interpolation(model.grid, np.array([[-0.5, 0.0]])) @ of_actions.max(axis=0))[0])


def values_over(model: Model, discounts: Sequence[float]) -> dict[float, float]:
    """Values of x = -0.5 m at rest by discount factor."""
    return {
        discount: start_value(model, iterate(model.rewards, model.transitions, discount))
        for discount in discounts
    }
