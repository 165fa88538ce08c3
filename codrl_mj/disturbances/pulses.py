"""Random load pulses. Plain Python on purpose: `codrl_mj.physics.disturber` compiles it."""

import math

import numpy as np

from codrl_mj.actuators.noise import LOAD_STREAM, philox, unit

PULSE_NAMES = ("key", "step", "index", "start")
"""What the memory of an environment's pulses holds: the key of the random numbers, integration steps since the start of
the episode, number of the present or next pulse, and when that one starts [s]."""
KEY, STEP, INDEX, START = range(len(PULSE_NAMES))


def pulse_load(memory: np.ndarray, timestep: float, force: float, duration: float, interval: float) -> float:
    """The mean load [N or N*m] over an environment's next integration step; moves the memory on by that step.

    Pulses of a force [N or N*m] and a duration [s] come after a mean interval [s]. One that covers part of a step
    counts in proportion, so that its impulse does not depend on the step. The memory, shape (4,), has entries as in
    `PULSE_NAMES`: (key, 0, 0, 0) at the start of an episode.
    """
    key, step = int(memory[KEY]), memory[STEP]
    begin, end = step * timestep, (step + 1.0) * timestep
    w0, w1, sign, _ = philox(int(memory[INDEX]), 0, 0, LOAD_STREAM, key)
    if step == 0.0:
        memory[START] = -interval * math.log(unit(w0, w1))
    load = 0.0
    while memory[START] < end:
        last = memory[START] + duration
        covered = max(min(last, end) - max(memory[START], begin), 0.0) / timestep
        load += min(covered, 1.0) * (force if sign & 1 else -force)
        if last > end:
            break
        memory[INDEX] += 1.0
        w0, w1, sign, _ = philox(int(memory[INDEX]), 0, 0, LOAD_STREAM, key)
        memory[START] = last - interval * math.log(unit(w0, w1))
    memory[STEP] = step + 1.0
    return load
