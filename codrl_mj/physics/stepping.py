"""Compiled environment step of one simulation in MuJoCo.

Compiled functions identify a simulation by one integer, `pointers`: the address of its
`PointerTable`. `settings` has a row for each actuator, a `Wiring` followed by
`DisturberParameters`; `memory` is that of the disturber, with a row for each actuator; `trace` is
that of `Physics`. All are live: changing them changes the simulation. Options and observation
belong to the environment, see `codrl_mj.envs.compiled`.
"""

import functools
from typing import NamedTuple

import mujoco
import numba
import numpy as np
from numba import types
from numba.extending import overload

from codrl_mj.actuators import Family
from codrl_mj.compile_cache import njit
from codrl_mj.disturbances import NO_DISTURBANCES
from codrl_mj.engine.families import (
    USER_HEADER_SIZE,
    SlotHeader,
    compiled_observe,
    load_family,
    signals_offset,
)
from codrl_mj.engine.layout import DATA, MODEL, addresses, engine_function
from codrl_mj.engine.memory import f64, i64, internal, read_row, stack_floats
from codrl_mj.engine.model_access import user_address
from codrl_mj.physics.base import Compiled, Force, SimulationConfig, Stepping
from codrl_mj.physics.compiled_task import (
    compiled_constrain,
    compiled_reader,
    is_finite_state,
)
from codrl_mj.physics.disturber import KEY_COLUMN, DisturberParameters, disturb

TORQUE, NOISE_KEY = SlotHeader._fields.index("torque"), SlotHeader._fields.index("noise_key")


class Wiring(NamedTuple):
    """Indices of an actuator's quantities in MuJoCo's arrays, and its arm."""

    actuator: float
    """Index of the actuator."""
    ctrl: float
    """Index of its control."""
    act: float
    """Index of the first of its activations."""
    dof: float
    """Index of its joint's velocity."""
    arm: float
    """Arm [m]."""
    qpos: float
    """Index of its joint's position."""


NUM_WIRING = len(Wiring._fields)


class PointerTable(NamedTuple):
    """Addresses and sizes of a simulation; stored in an int64 array that must exist as long."""

    model: int
    """Address, like the next six entries."""
    data: int
    settings: int
    memory: int
    trace: int
    options: int
    observation: int
    actuators: int
    """Number of actuators: of rows in the settings and in the memory."""
    settings_columns: int
    """Number of columns of the settings."""
    memory_columns: int
    """Number of columns of the memory."""
    inner_steps: int
    """Integration steps per environment step."""
    columns: int
    """Number of columns of the trace."""


def make_pointer_table(
    data: mujoco.MjData, settings: np.ndarray, memory: np.ndarray, trace: np.ndarray
) -> np.ndarray:
    """Return the `PointerTable` of a simulation; the caller keeps the contiguous arrays alive."""
    addresses_of_arrays = (array.ctypes.data for array in (settings, memory, trace))
    sizes = *settings.shape, memory.shape[-1], len(trace), trace.shape[-1]
    # The environment fills in the two addresses of its options and its observation.
    return np.array([*addresses(data), *addresses_of_arrays, 0, 0, *sizes], np.int64)


@internal
def simulation_at(pointers: int) -> tuple[int, int, np.ndarray, np.ndarray, np.ndarray]:
    """Return addresses of model and data, and the settings, memory and trace of a simulation."""
    entries = i64(pointers)
    table = PointerTable(
        entries[0],
        entries[1],
        entries[2],
        entries[3],
        entries[4],
        entries[5],
        entries[6],
        entries[7],
        entries[8],
        entries[9],
        entries[10],
        entries[11],
    )
    settings = numba.carray(f64(table.settings), (table.actuators, table.settings_columns))
    memory = numba.carray(f64(table.memory), (table.actuators, table.memory_columns))
    trace = numba.carray(f64(table.trace), (table.inner_steps, table.actuators, table.columns))
    return table.model, table.data, settings, memory, trace


OPTIONS, OBSERVATION = (
    PointerTable._fields.index("options"),
    PointerTable._fields.index("observation"),
)


def compiled_stepping(simulation: SimulationConfig) -> Stepping:
    """Return the functions for simulations with these settings; each compiles on first use."""
    task, disturbed = simulation.task, simulation.disturbances != NO_DISTURBANCES
    if simulation.motors_added:
        load_family(simulation.family)
    order, explicit = (task.qpos, task.qvel), simulation.integrator == "euler"
    constrain = compiled_constrain(task.constrain, task.state_names, *order)
    return _stepping(
        constrain,
        compiled_reader(*order),
        *order,
        explicit,
        disturbed,
        simulation.family,
        simulation.motors_added,
    )


def force_of(forces: Force, actuator: int) -> float:
    """Return the force for an actuator: an entry of an array, or the number itself."""
    return forces[actuator] if isinstance(forces, np.ndarray) else forces


# This is an overload because numba does not inline those: inlining would drop stores through
# pointers as dead code.
@overload(force_of)
def _force_of(forces, actuator):  # type: ignore[no-untyped-def]  # noqa: ARG001 - numba compares the arguments' names
    if isinstance(forces, types.Array):
        return lambda forces, actuator: forces[actuator]
    return lambda forces, actuator: forces  # noqa: ARG005


@functools.cache
def _stepping(
    constrain: Compiled | None,
    read_state: Compiled,
    positions: tuple[int, ...],
    velocities: tuple[int, ...],
    explicit: bool,
    disturbed: bool,
    family: Family,
    motors_added: bool,
) -> Stepping:
    engine_step, engine_reset = engine_function("mj_step"), engine_function("mj_resetData")
    size, num_positions = len(positions) + len(velocities), len(positions)
    first, count = signals_offset(family), len(family.Signals._fields)
    observe = compiled_observe(family) if family.OBSERVED else None

    @njit(nogil=True, error_model="numpy")
    def step(force: Force, pointers: int) -> bool:
        model, data, settings, memory, trace = simulation_at(pointers)
        timestep = MODEL.opt.timestep(model)
        qpos, qvel, ctrl, act = DATA.qpos(data), DATA.qvel(data), DATA.ctrl(data), DATA.act(data)
        state = numba.carray(stack_floats(size), size)
        for inner in range(len(trace)):
            for actuator in range(len(settings)):
                wiring = read_row(settings[actuator], Wiring)
                command = force_of(force, actuator)
                if disturbed:
                    disturber_parameters = read_row(
                        settings[actuator, NUM_WIRING:], DisturberParameters
                    )
                    command, DATA.qfrc_applied(data)[int(wiring.dof)] = disturb(
                        disturber_parameters, memory[actuator], command
                    )
                ctrl[int(wiring.ctrl)] = command * wiring.arm
                trace[inner, actuator, 0] = command
            # Explicit Euler moves positions by the old velocities, but `mj_step` by the new ones.
            # So the positions are computed before it and written after it.
            if explicit:
                for entry in range(num_positions):
                    state[entry] = qpos[entry] + timestep * qvel[entry]
            engine_step(model, data)
            if explicit:
                for entry in range(num_positions):
                    qpos[entry] = state[entry]
            if constrain is not None:
                constrain(qpos, qvel, state, timestep)
            for actuator in range(len(settings)):
                wiring = read_row(settings[actuator], Wiring)
                row = trace[inner, actuator]
                if motors_added:
                    first_activation = int(wiring.act)
                    row[1] = act[first_activation + TORQUE] / wiring.arm
                    for entry in range(count):
                        row[2 + entry] = act[first_activation + first + entry]
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
                DATA.act(data)[int(read_row(settings[actuator], Wiring).act) + NOISE_KEY] = (
                    key + actuator
                )
            if disturbed:
                force_per_position = read_row(
                    settings[actuator, NUM_WIRING:], DisturberParameters
                ).force_per_position
                position = qpos[int(read_row(settings[actuator], Wiring).qpos)]
                memory[actuator] = 0.0
                memory[actuator, : memory.shape[1] + KEY_COLUMN] = (
                    force_per_position * position if force_per_position != 0.0 else 0.0
                )
                memory[actuator, memory.shape[1] + KEY_COLUMN] = key + actuator

    @njit(nogil=True, error_model="numpy")
    def read(state: np.ndarray, pointers: int) -> None:
        _, data, _, _, _ = simulation_at(pointers)
        read_state(DATA.qpos(data), DATA.qvel(data), state)

    @njit(nogil=True, error_model="numpy")
    def read_sensors(row: np.ndarray, readings: np.ndarray, pointers: int) -> None:
        model, data, settings, _, _ = simulation_at(pointers)
        if observe is not None:
            for actuator in range(len(settings)):
                wiring = read_row(settings[actuator], Wiring)
                observe(
                    user_address(model, int(wiring.actuator)) + 8 * USER_HEADER_SIZE,
                    row[actuator, 2:].ctypes.data,
                    MODEL.opt.timestep(model),
                    DATA.time(data),
                    DATA.act(data)[int(wiring.act) + NOISE_KEY],
                    readings[actuator].ctypes.data,
                )

    return Stepping(step, start, read, read_sensors)
