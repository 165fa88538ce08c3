"""Which friction a motor has: what foretells logs that it was not fitted to."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from codrl_mj.identify.estimate import estimate
from codrl_mj.identify.log import Log
from codrl_mj.identify.prediction import predict
from codrl_mj.identify.stages import Shaft

TRIED = ("load", "stribeck", "both")
LEAST_LOGS = 3


def foretold(stage: Shaft, logs: Sequence[Log], on_step: Callable[[], None]) -> np.ndarray:
    """Mean absolute error on each log of the fit to all others, from that to all, shape (n,)."""
    segments, model, starts = stage.build(logs)
    whole, errors = estimate(model, segments, starts[:2])[0].values, []
    for place, log in enumerate(logs):
        others = [other for index, other in enumerate(logs) if index != place]
        best, _ = estimate(model, stage.build(others)[0], [whole], most=12)
        found = predict(model, best.values, log)
        errors.append(found.open_loop if found.closed_loop is None else found.closed_loop)
        on_step()
    return np.array(errors)


def chosen_friction(stage: Shaft, logs: Sequence[Log], wanted: str, on_step: Callable[[], None]) -> Shaft:
    """The stage with the friction that is wanted or, for `auto`, with what leaving out one log at a time speaks for.

    More than viscous and Coulomb friction is kept where the errors on the logs left out fall by more, in the mean, than
    two standard deviations of that mean. With fewer than three logs none is.
    """
    if wanted != "auto":
        return dataclasses.replace(stage, friction=wanted)
    if len(logs) < LEAST_LOGS:
        return stage
    best, least = stage, foretold(stage, logs, on_step)
    for friction in TRIED:
        tried = dataclasses.replace(stage, friction=friction)
        errors = foretold(tried, logs, on_step)
        gained = least - errors
        if gained.mean() > 2.0 * gained.std(ddof=1) / np.sqrt(len(gained)):
            best, least = tried, errors
    return best
