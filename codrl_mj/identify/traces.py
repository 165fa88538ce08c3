"""What a fit made of its logs over time, and which parameters it could hardly tell apart: to be looked at."""

from typing import Any, NamedTuple

import numpy as np

from codrl_mj.identify import honesty


class Trace(NamedTuple):
    """A simulation beside what was measured, in pieces that each begin from a state of their own."""

    log: str
    part: str
    """`winding` or `shaft`."""
    output: str
    """What is compared: `current` [A], `position` [rad] or `velocity` [rad/s]."""
    time: np.ndarray
    """[s], shape (n,)."""
    measured: np.ndarray
    """Shape (n,)."""
    simulated: np.ndarray
    """Shape (n,)."""
    starts: np.ndarray
    """Rows at which pieces begin."""


def trace(log: str, part: str, output: str, pieces: Any) -> Trace:
    """A trace of some (times, measured, simulated), each of shape (m,)."""
    times, measured, simulated = (np.concatenate(column) for column in zip(*pieces, strict=True))
    starts = np.cumsum([0, *(len(piece[0]) for piece in pieces)])[:-1]
    return Trace(log, part, output, times, measured, simulated, starts)


def fitted_traces(name: str, part: Any) -> tuple[Trace, ...]:
    """The fit of each log of a `Fitted` part; none where the part was not fitted."""
    if part is None:
        return ()
    pieces: dict[int, list[Any]] = {}
    for segment, residuals in zip(part.segments, part.fit.residuals, strict=True):
        simulated = segment.measured + residuals * segment.deviation
        pieces.setdefault(segment.log, []).append((segment.times, segment.measured, simulated))
    output = "current" if name == "winding" else part.model.output
    return tuple(trace(part.logs[place].name, name, output, several) for place, several in pieces.items())


def correlations(part: Any) -> dict[str, dict[str, float]]:
    """Correlations of a `Fitted` part's parameters, by its Jacobian: near 1 or -1, one may stand for the other."""
    if part is None or not part.fit.names:
        return {}
    names = part.fit.names
    table = honesty.correlations(part.fit)
    return {name: dict(zip(names, row.tolist(), strict=True)) for name, row in zip(names, table, strict=True)}
