"""One environment step of one simulation in MuJoCo, compiled: the engine's step with what comes before and after it.

A compiled function knows a simulation by one number, `where`: the address of its `PointerTable`.
`settings` has a row for each actuator, a `Wiring` and then a disturber's `DisturberParameters`; `memory` is a
disturber's, a row for each actuator; `trace` that of `Physics`. They are live: what changes them
changes the simulation. What an environment has beside it, options and observation, is for
`codrl_mj.envs.compiled`.
"""

import functools
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types
from numba.extending import overload

from codrl_mj.actuators import Family
from codrl_mj.compile_cache import njit
from codrl_mj.disturbances import NO_DISTURBANCES
from codrl_mj.engine.doors import user_of
from codrl_mj.engine.families import HEAD, Slot, compiled_observe, load_family, signals_at
from codrl_mj.engine.layout import DATA, MODEL, addresses, engine_function
from codrl_mj.engine.memory import f64, i64, internal, on_stack, row_as
from codrl_mj.physics.base import SimulationConfig
from codrl_mj.physics.compiled_task import Compiled, compiled_constrain, compiled_reader, is_finite_state
from codrl_mj.physics.disturber import KEY_COLUMN, DisturberParameters, disturb

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
    qpos: float
    """Index of its joint's position."""


WIRING = len(Wiring._fields)


class PointerTable(NamedTuple):
    """Where a simulation is: an int64 array, which must live as long as it."""

    model: int
    """An address, as the next six."""
    data: int
    settings: int
    memory: int
    trace: int
    options: int
    observation: int
    actuators: int
    """How many, and what the arrays have of each."""
    of_settings: int
    of_memory: int
    inner_steps: int
    columns: int
    """Of the trace."""


def make_pointer_table(data: Any, settings: np.ndarray, memory: np.ndarray, trace: np.ndarray) -> np.ndarray:
    """The `PointerTable` of a simulation, by its `MjData`; all of them are contiguous, and stay the caller's."""
    each = (one.ctypes.data for one in (settings, memory, trace))
    sizes = *settings.shape, memory.shape[-1], len(trace), trace.shape[-1]
    return np.array([*addresses(data), *each, 0, 0, *sizes], np.int64)


@internal
def simulation_at(pointers: int) -> tuple[int, int, np.ndarray, np.ndarray, np.ndarray]:
    """Addresses of model and data of the simulation at an address, settings, memory and trace."""
    at = i64(pointers)
    found = PointerTable(
        at[0], at[1], at[2], at[3], at[4], at[5], at[6], at[7], at[8], at[9], at[10], at[11]
    )
    settings = numba.carray(f64(found.settings), (found.actuators, found.of_settings))
    memory = numba.carray(f64(found.memory), (found.actuators, found.of_memory))
    trace = numba.carray(f64(found.trace), (found.inner_steps, found.actuators, found.columns))
    return found.model, found.data, settings, memory, trace


OPTIONS, OBSERVATION = PointerTable._fields.index("options"), PointerTable._fields.index("observation")


class Stepping(NamedTuple):
    """Compiled functions; `where` is that of the module's docstring."""

    step: Compiled
    """(force, where) -> whether the state is still one of numbers within `MAX_STATE`: takes one
    environment step under a desired force [N or N*m], or under several, an array (n,). What the
    actuators did is in `trace`.
    """
    start: Compiled
    """(state (n,), key, where) -> nothing: starts an episode, as `Physics.reset` does."""
    read: Compiled
    """(state (n,), where) -> nothing: fills `state` with the present one."""
    read_sensors: Compiled
    """(row of trace (n, c), seen (n, k), where) -> nothing: fills `seen` with what the sensors say at present."""


def compiled_stepping(simulation: SimulationConfig) -> Stepping:
    """The functions for simulations of a plant; compiled as they are used, once a process."""
    task, disturbed = simulation.task, simulation.disturbances != NO_DISTURBANCES
    if simulation.motors_added:
        load_family(simulation.family)
    order, explicit = (task.qpos, task.qvel), simulation.integrator == "euler"
    kept = compiled_constrain(task.constrain, task.state_names, *order)
    return _stepping(
        kept, compiled_reader(*order), *order, explicit, disturbed, simulation.family, simulation.motors_added
    )


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
    motors_added: bool,
) -> Stepping:
    engine_step, engine_reset = engine_function("mj_step"), engine_function("mj_resetData")
    size, moving = len(positions) + len(velocities), len(positions)
    first, count = signals_at(family), len(family.Signals._fields)
    observe = compiled_observe(family) if family.OBSERVED else None

    @njit(nogil=True, error_model="numpy")
    def step(force: Any, pointers: int) -> bool:
        model, data, settings, memory, trace = simulation_at(pointers)
        timestep = MODEL.opt.timestep(model)
        qpos, qvel, ctrl, act = DATA.qpos(data), DATA.qvel(data), DATA.ctrl(data), DATA.act(data)
        state = numba.carray(on_stack(size), size)
        for inner in range(len(trace)):
            for actuator in range(len(settings)):
                wiring = row_as(settings[actuator], Wiring)
                command = force_of(force, actuator)
                if disturbed:
                    numbers = row_as(settings[actuator, WIRING:], DisturberParameters)
                    command, DATA.qfrc_applied(data)[int(wiring.dof)] = disturb(
                        numbers, memory[actuator], command
                    )
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
                if motors_added:
                    own = int(wiring.act)
                    row[1] = act[own + TORQUE] / wiring.arm
                    for entry in range(count):
                        row[2 + entry] = act[own + first + entry]
                else:
                    row[1] = row[0]
                row[2 + count] = qvel[int(wiring.dof)]
        read_state(qpos, qvel, state)
        return is_finite_state(state)

    @njit(nogil=True, error_model="numpy")
    def start(state: np.ndarray, key: float, pointers: int) -> None:
        model, data, settings, memory, _ = simulation_at(pointers)
        engine_reset(model, data)
        qpos, qvel = DATA.qpos(data), DATA.qvel(data)
        for entry in range(len(positions)):
            qpos[entry] = state[positions[entry]]
        for entry in range(len(velocities)):
            qvel[entry] = state[velocities[entry]]
        for actuator in range(len(settings)):
            if motors_added:
                DATA.act(data)[int(row_as(settings[actuator], Wiring).act) + NOISE_KEY] = (
                    key + actuator
                )
            if disturbed:
                hold = row_as(settings[actuator, WIRING:], DisturberParameters).hold
                position = qpos[int(row_as(settings[actuator], Wiring).qpos)]
                memory[actuator] = 0.0
                memory[actuator, : memory.shape[1] + KEY_COLUMN] = (
                    hold * position if hold != 0.0 else 0.0
                )
                memory[actuator, memory.shape[1] + KEY_COLUMN] = key + actuator

    @njit(nogil=True, error_model="numpy")
    def read(state: np.ndarray, pointers: int) -> None:
        _, data, _, _, _ = simulation_at(pointers)
        read_state(DATA.qpos(data), DATA.qvel(data), state)

    @njit(nogil=True, error_model="numpy")
    def read_sensors(row: np.ndarray, seen: np.ndarray, pointers: int) -> None:
        model, data, settings, _, _ = simulation_at(pointers)
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

    return Stepping(step, start, read, read_sensors)
