"""One environment step of one simulation in MuJoCo, compiled: the engine's step with what comes before and after it.

A compiled function knows a simulation by its `arguments`: (address of the model, address of the data, settings,
memory, trace). `settings` has a row for each actuator, a `Wiring` and then a disturber's `Numbers`; `memory` is a
disturber's, a row for each actuator; `trace` that of `Physics`. They are live: what changes them changes the
simulation.
"""

import functools
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types
from numba.extending import overload

from codrl_mj.actuators import Family
from codrl_mj.disturbances import OFF
from codrl_mj.engine.doors import user_of
from codrl_mj.engine.families import HEAD, Slot, compiled_observe, load_family, signals_at
from codrl_mj.engine.layout import DATA, MODEL, engine_function
from codrl_mj.engine.memory import on_stack, row_as
from codrl_mj.kept import njit
from codrl_mj.physics.base import Plant
from codrl_mj.physics.compiled_task import Compiled, compiled_constrain, compiled_reader, is_fine
from codrl_mj.physics.disturber import KEY_COLUMN, Numbers, disturb

TORQUE, NOISE_KEY = Slot._fields.index("torque"), Slot._fields.index("noise_key")


class Wiring(NamedTuple):
    """Where an actuator's numbers are in MuJoCo's arrays, and its arm."""

    actuator: float
    """Its index."""
    ctrl: float
    """Index of its control."""
    act: float
    """Index of the first of its activations."""
    dof: float
    """Index of its joint's velocity."""
    arm: float
    """[m]."""


WIRING = len(Wiring._fields)


class Stepping(NamedTuple):
    """Compiled functions; `arguments` are those of the module's docstring."""

    step: Compiled
    """(force, *arguments) -> whether the state is still one of numbers within `LARGEST`: takes one environment step
    under a desired force [N or N*m], or under several, an array (n,). What the actuators did is in `trace`."""
    start: Compiled
    """(state (n,), key, *arguments but the last) -> nothing: starts an episode, as `Physics.reset` does."""
    read: Compiled
    """(state (n,), address of the data) -> nothing: fills `state` with the present one."""
    observed: Compiled
    """(row of trace (n, c), seen (n, k), *the first three arguments) -> nothing: fills `seen` with what the sensors say
    at present."""


def compiled_stepping(plant: Plant) -> Stepping:
    """The functions for simulations of a plant; compiled as they are used, once a process."""
    task, disturbed = plant.task, plant.disturbances != OFF
    if plant.motorised:
        load_family(plant.family)
    order, explicit = (task.qpos, task.qvel), plant.integrator == "euler"
    kept = compiled_constrain(task.constrain, task.state_names, *order)
    return _stepping(kept, compiled_reader(*order), *order, explicit, disturbed, plant.family, plant.motorised)


def force_of(forces: Any, actuator: int) -> float:
    """The force for an actuator: of an array, or the number itself."""
    return forces[actuator] if isinstance(forces, np.ndarray) else forces


@overload(force_of)  # not inlined by numba, which would drop stores through pointers as dead code
def _force_of(forces, actuator):  # type: ignore[no-untyped-def]  # noqa: ARG001 - numba compares the arguments
    if isinstance(forces, types.Array):
        return lambda forces, actuator: forces[actuator]
    return lambda forces, actuator: forces  # noqa: ARG005


@functools.cache
def _stepping(
    keep: Compiled | None,
    read_state: Compiled,
    positions: tuple[int, ...],
    velocities: tuple[int, ...],
    explicit: bool,
    disturbed: bool,
    family: Family,
    motorised: bool,
) -> Stepping:
    engine_step, engine_reset = engine_function("mj_step"), engine_function("mj_resetData")
    size, moving = len(positions) + len(velocities), len(positions)
    first, count = signals_at(family), len(family.Signals._fields)
    observe = compiled_observe(family) if family.OBSERVED else None

    @njit(nogil=True, error_model="numpy")
    def step(force: Any, model: int, data: int, settings: np.ndarray, memory: np.ndarray, trace: np.ndarray) -> bool:
        timestep = MODEL.opt.timestep(model)
        qpos, qvel, ctrl, act = DATA.qpos(data), DATA.qvel(data), DATA.ctrl(data), DATA.act(data)
        state = numba.carray(on_stack(size), size)
        for inner in range(len(trace)):
            for actuator in range(len(settings)):
                wiring = row_as(settings[actuator], Wiring)
                command = force_of(force, actuator)
                if disturbed:
                    numbers = row_as(settings[actuator, WIRING:], Numbers)
                    command, DATA.qfrc_applied(data)[int(wiring.dof)] = disturb(numbers, memory[actuator], command)
                ctrl[int(wiring.ctrl)] = command * wiring.arm
                trace[inner, actuator, 0] = command
            if explicit:
                for entry in range(moving):
                    state[entry] = qpos[entry] + timestep * qvel[entry]
            engine_step(model, data)
            if explicit:
                for entry in range(moving):
                    qpos[entry] = state[entry]
            if keep is not None:
                keep(qpos, qvel, state, timestep)
            for actuator in range(len(settings)):
                wiring = row_as(settings[actuator], Wiring)
                row = trace[inner, actuator]
                if motorised:
                    own = int(wiring.act)
                    row[1] = act[own + TORQUE] / wiring.arm
                    for entry in range(count):
                        row[2 + entry] = act[own + first + entry]
                else:
                    row[1] = row[0]
                row[2 + count] = qvel[int(wiring.dof)]
        read_state(qpos, qvel, state)
        return is_fine(state)

    @njit(nogil=True, error_model="numpy")
    def start(
        state: np.ndarray,
        key: float,
        model: int,
        data: int,
        settings: np.ndarray,
        memory: np.ndarray,
    ) -> None:
        engine_reset(model, data)
        qpos, qvel = DATA.qpos(data), DATA.qvel(data)
        for entry in range(len(positions)):
            qpos[entry] = state[positions[entry]]
        for entry in range(len(velocities)):
            qvel[entry] = state[velocities[entry]]
        for actuator in range(len(settings)):
            if motorised:
                DATA.act(data)[int(row_as(settings[actuator], Wiring).act) + NOISE_KEY] = key + actuator
            if disturbed:
                memory[actuator] = 0.0
                memory[actuator, memory.shape[1] + KEY_COLUMN] = key + actuator

    @njit(nogil=True, error_model="numpy")
    def read(state: np.ndarray, data: int) -> None:
        read_state(DATA.qpos(data), DATA.qvel(data), state)

    @njit(nogil=True, error_model="numpy")
    def observed(row: np.ndarray, seen: np.ndarray, model: int, data: int, settings: np.ndarray) -> None:
        if observe is not None:
            for actuator in range(len(settings)):
                wiring = row_as(settings[actuator], Wiring)
                observe(
                    user_of(model, int(wiring.actuator)) + 8 * HEAD,
                    row[actuator, 2:].ctypes.data,
                    MODEL.opt.timestep(model),
                    DATA.time(data),
                    DATA.act(data)[int(wiring.act) + NOISE_KEY],
                    seen[actuator].ctypes.data,
                )

    return Stepping(step, start, read, observed)
