"""Table of a tile-coding SARSA policy, for other runtimes and as a readable CSV file."""

import csv
import dataclasses
import io
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from codrl_mj.agents.tile_coding import TileCoder, choose_actions
from codrl_mj.deploy.spaces import Entry

Float = type[np.float32] | type[np.float64]
"""Number type of a computation."""


class AddNode(Protocol):
    """Function that adds nodes to an ONNX graph."""

    def __call__(self, kind: str, *inputs: str | np.ndarray, **attributes: int) -> str:
        """Add a node with inputs by name or as constants, and return the name of its output."""


@dataclasses.dataclass(frozen=True)
class Tiles:
    """A policy that takes the action with the largest sum of weights in an observation's tiles."""

    coder: TileCoder
    """Tile coder that maps an observation (k,) to its tiles, one in each tiling."""
    table: np.ndarray
    """Weights, shape (tiles, actions), float64."""
    factors: np.ndarray
    """Factors of the observation, all 1, shape (k,)."""

    # Discrete actions have no bounds; `Network` has these attributes.
    low = high = None

    def __call__(self, observations: np.ndarray, dtype: Float = np.float32) -> np.ndarray:  # noqa: ARG002 - as a `Network`
        """Return action indices (N,) for observations (N, k), always computed in double."""
        return choose_actions(
            observations, self.coder, self.table, True, 0.0, np.random.default_rng(0)
        )

    def add_to_graph(self, node: AddNode) -> str:
        """Add the policy's nodes to an ONNX graph and return the name of the output.

        Args:
            node: function `node(kind, *inputs, **attributes)` that adds a node.
        """
        coder, angles = self.coder, self.angles
        # ONNX's type 11 is double, type 7 is int64, type 1 is float.
        entries = node("Cast", "observation", to=11)
        sides = [node("Gather", entries, coder.entries[:angles, k], axis=1) for k in (0, 1)]
        axes = node("Gather", entries, coder.entries[angles:, 0], axis=1)
        # ONNX has no atan2: where the cosine is negative, half a turn in the direction of the sine
        # is added to the arctangent.
        if angles:
            zero, turn = np.zeros(1), np.full(1, np.pi)
            signed_turn = node("Where", node("Less", sides[1], zero), -turn, turn)
            half_turn = node("Where", node("Less", sides[0], zero), signed_turn, zero)
            # onnxruntime has Atan only in float.
            tangent = node("Cast", node("Div", sides[1], sides[0]), to=1)
            angle = node("Add", node("Cast", node("Atan", tangent), to=11), half_turn)
            axes = node("Concat", angle, axes, axis=1)
        quantized = node("Floor", node("Mul", node("Sub", axes, coder.low), coder.quanta))
        quantized = node("Min", node("Max", quantized, np.zeros(1)), coder.last.astype(np.float64))
        quanta = node("Unsqueeze", node("Cast", quantized, to=7), np.array([1]))
        cells = node("Div", node("Add", quanta, coder.displacements), np.array([1 << coder.shift]))
        steps = node("Mul", node("Mod", cells, coder.cells), coder.strides)
        within = node("ReduceSum", steps, np.array([2]), keepdims=0)
        tiling_starts = np.arange(1 << coder.shift) * (coder.size >> coder.shift)
        weights = node("Gather", self.table, node("Add", within, tiling_starts), axis=0)
        return str(
            node(
                "ArgMax", node("ReduceSum", weights, np.array([1]), keepdims=0), axis=1, keepdims=0
            )
        )

    def input_scaling(self, index: int) -> Entry:
        """Return the scaling of an observation entry, for the contract; see `Network`."""
        return {"scale": float(self.factors[index]), "offset": 0.0}

    def as_csv(self, names: Sequence[str]) -> str:
        """Return the table with a row for each tile: tiling, index on each axis, weight per action.

        An axis is one entry of the observation, or an angle whose cosine and sine are two
        entries.

        Args:
            names: names of the observation's entries.
        """
        axes = [
            names[first].removeprefix("cos_" if second >= 0 else "")
            for first, second in self.coder.entries
        ]
        tilings = 1 << self.coder.shift
        cells = np.stack(
            np.unravel_index(np.arange(len(self.table)), (tilings, *self.coder.cells)), axis=1
        )
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow(["tiling", *axes, *(f"action {k}" for k in range(self.table.shape[1]))])
        rows.writerows(
            [*cell, *weights]
            for cell, weights in zip(cells.tolist(), self.table.tolist(), strict=True)
        )
        return text.getvalue()

    @property
    def angles(self) -> int:
        """Number of axes that are angles; they come first and have two entries, cosine and sine."""
        return int((self.coder.entries[:, 1] >= 0).sum())

    @property
    def choices(self) -> int:
        """Number of actions."""
        return int(self.table.shape[1])

    @property
    def num_working_values(self) -> int:
        """Number of values that a step stores in addition to the table."""
        return 1 << self.coder.shift

    @property
    def size(self) -> int:
        """Number of weights."""
        return self.table.size
