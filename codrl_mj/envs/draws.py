"""What the environments of a vector environment are drawn with."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from codrl_mj.actuators import ActuatorModel
from codrl_mj.envs.randomization import Randomization, mounting_of, nominal_fields
from codrl_mj.physics.mujoco_batch import MujocoBatchPhysics
from codrl_mj.physics.streams import Streams
from codrl_mj.physics.variation import write_fields


class Draws:
    """The drawn values of N environments, as arrays, and their way into the simulations."""

    def __init__(
        self, randomization: Randomization, physics: MujocoBatchPhysics, actuators: Sequence[Sequence[ActuatorModel]]
    ) -> None:
        """Begin with nothing drawn for N simulations, of which each has its nominal actuators."""
        self._randomization, self._actuators = randomization, actuators
        self._physics = physics
        count = physics.num_envs
        self._nominal = nominal_fields(actuators)
        self._mounting = mounting_of(actuators)
        self._values = np.full((count, len(randomization.names)), np.nan)
        self._rejected = np.zeros(count, dtype=np.int64)

    def draw(self, streams: Streams, rows: np.ndarray) -> dict[str, Any]:
        """Draw anew for the environments `rows` (m,), whose simulations are to be reset afterwards; their infos.

        Raises:
            ValueError: no stable current loop was drawn.
        """
        self._values[rows], self._rejected[rows] = self._randomization.draw(
            lambda pending, count: streams.random(rows[pending], count),
            self._nominal[rows],
        )
        self._apply(rows)
        return self._randomization.reports(rows, self._values, self._rejected)

    def _apply(self, rows: np.ndarray) -> None:
        """Write the values of some environments into their simulations."""
        values, randomization = self._values[rows], self._randomization
        fields = randomization.drawn(self._nominal[rows], values)
        arms, additions = self._mounting[0][rows], self._mounting[1][rows]
        if randomization.mounted:
            arms, additions = randomization.mounting(fields)
        if randomization.draws_actuator:
            self._physics.set_parameters(rows, randomization.numbers(fields), arms)
        if randomization.variation is not None:
            self._physics.set_model(rows, randomization.model_fields(values, additions))

    def present(self) -> dict[str, np.ndarray]:
        """The values in use by name, and the number of rejected sets, each of shape (N,); NaN before a reset."""
        columns = dict(zip(self._randomization.names, self._values.T.copy(), strict=True))
        return columns | {"rejected": self._rejected.copy()}

    def snapshot(self) -> dict[str, np.ndarray]:
        """What `restore` needs."""
        return {"drawn": self._values.copy(), "rejected": self._rejected.copy()}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Bring back the values, and the simulations to them; to be followed by a restoring of the simulations."""
        self._values[:], self._rejected[:] = snapshot["drawn"], snapshot["rejected"]
        undrawn = np.flatnonzero(np.isnan(self._values).any(axis=1))
        for row in undrawn.tolist():
            self._values[row] = self._randomization.nominal_values(self._actuators[row])
        self._apply(np.arange(len(self._values)))
        self._values[undrawn] = np.nan

    def show(self, row: int) -> None:
        """Give the model that is drawn the lengths of one environment."""
        fields = self._randomization.model_fields(self._values[[row]], drawn=True)
        if not np.isnan(self._values[row]).any():
            write_fields(self._physics.model, fields)
