"""Which friction a motor has: what foretells logs that it was not fitted to."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from codrl_mj.identify.estimate import estimate
from codrl_mj.identify.log import Log
from codrl_mj.identify.prediction import predict
from codrl_mj.identify.stages import Shaft

TRIED = ("load", "stribeck", "both")
LEAST_LOGS = 3


def foretold(stage: Shaft, logs: Sequence[Log]) -> np.ndarray:
    """Mean absolute error on each log of the fit to all others, shape (n,)."""
    errors = []
    for place, log in enumerate(logs):
        others = [other for index, other in enumerate(logs) if index != place]
        segments, model, starts = stage.build(others, 0)
        best, _ = estimate(model, segments, starts[:1])
        found = predict(model, best.values, log)
        errors.append(found.open_loop if found.closed_loop is None else found.closed_loop)
    return np.array(errors)


def chosen_friction(stage: Shaft, logs: Sequence[Log], wanted: str) -> Shaft:
    """The stage with the friction that is wanted or, for `auto`, with what leaving out one log at a time speaks for.

    More than viscous and Coulomb friction is kept where the errors on the logs left out fall by more, in the mean, than
    two standard deviations of that mean. With fewer than three logs none is.
    """
    if wanted != "auto":
        return dataclasses.replace(stage, friction=wanted)
    if len(logs) < LEAST_LOGS:
        return stage
    best, least = stage, foretold(stage, logs)
    for friction in TRIED:
        tried = dataclasses.replace(stage, friction=friction)
        errors = foretold(tried, logs)
        gained = least - errors
        if gained.mean() > 2.0 * gained.std(ddof=1) / np.sqrt(len(gained)):
            best, least = tried, errors
    return best
