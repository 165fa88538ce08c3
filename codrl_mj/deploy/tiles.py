"""Tile-coding SARSA's policy as what it computes, for other runtimes and for whoever wants to read it."""

import csv
import dataclasses
import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from codrl_mj.agents.tile_coding import TileCoder, choose_actions


@dataclasses.dataclass(frozen=True)
class Tiles:
    """A policy that takes the action whose weights add up to most in the tiles of an observation."""

    coder: TileCoder
    """Which tiles an observation (k,) lies in, one of each tiling."""
    table: np.ndarray
    """Weights, shape (tiles, actions), float64."""
    factors: np.ndarray
    """Ones, shape (k,): observations are taken as they come."""

    low = high = None  # actions are discrete

    def __call__(self, observations: np.ndarray, kind: Any = np.float32) -> np.ndarray:  # noqa: ARG002 - as a `Network`
        """Indices (N,) of the actions for observations (N, k); tiles and weights are doubles in any case."""
        return choose_actions(
            observations, self.coder, self.table, True, 0.0, np.random.default_rng(0)
        )

    def graph(self, node: Any) -> str:
        """The name of what an ONNX graph gives that computes it, by `node(kind, *inputs, **attributes)`."""
        coder, angles = self.coder, self.angles
        entries = node("Cast", "observation", to=11)  # 11, 7: double, int64
        sides = [node("Gather", entries, coder.entries[:angles, k], axis=1) for k in (0, 1)]
        further = node("Gather", entries, coder.entries[angles:, 0], axis=1)
        # ONNX has no atan2: half a turn more where the cosine is negative, to the side of the sine
        if angles:
            zero, turn = np.zeros(1), np.full(1, np.pi)
            side = node("Where", node("Less", sides[1], zero), -turn, turn)
            more = node("Where", node("Less", sides[0], zero), side, zero)
            quarter = node(
                "Cast", node("Div", sides[1], sides[0]), to=1
            )  # onnxruntime has it in float alone
            angle = node("Add", node("Cast", node("Atan", quarter), to=11), more)
            further = node("Concat", angle, further, axis=1)
        place = node("Floor", node("Mul", node("Sub", further, coder.low), coder.quanta))
        place = node("Min", node("Max", place, np.zeros(1)), coder.last.astype(np.float64))
        quanta = node("Unsqueeze", node("Cast", place, to=7), np.array([1]))
        cells = node("Div", node("Add", quanta, coder.displacements), np.array([1 << coder.shift]))
        steps = node("Mul", node("Mod", cells, coder.cells), coder.strides)
        within = node("ReduceSum", steps, np.array([2]), keepdims=0)
        first = np.arange(1 << coder.shift) * (coder.size >> coder.shift)
        weights = node("Gather", self.table, node("Add", within, first), axis=0)
        return str(
            node(
                "ArgMax", node("ReduceSum", weights, np.array([1]), keepdims=0), axis=1, keepdims=0
            )
        )

    def first_step(self, index: int) -> dict[str, float | None]:
        """As of a `Network`."""
        return {"scale": float(self.factors[index]), "offset": 0.0}

    def as_csv(self, names: Sequence[str]) -> str:
        """The table: a row a tile, with its tiling, its place along each axis and the weight of each action.

        An axis is an entry of the observation, by its name, or an angle, of which two entries are
        cosine and sine.
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
        """How many axes are angles; each has the observation's next two entries, its cosine and sine."""
        return int((self.coder.entries[:, 1] >= 0).sum())

    @property
    def choices(self) -> int:
        """How many actions there are."""
        return self.table.shape[1]

    @property
    def working(self) -> int:
        """Numbers that a step keeps beside the table."""
        return 1 << self.coder.shift

    @property
    def size(self) -> int:
        """How many weights there are."""
        return self.table.size
