"""Compiled actuator families: a table of C functions that both backends call by family number.

A family's number is in the model's `user` data, so a callback or plugin that was compiled once also
runs families that were written later. A family is compiled once per process, in a fraction of a
second.
"""

import contextlib
import ctypes
import functools
from collections.abc import Callable, Iterator
from types import FunctionType
from typing import NamedTuple, cast

import numpy as np
from numba import types
from numba.core.dispatcher import Dispatcher
from numpy.typing import ArrayLike

from codrl_mj.actuators import Family, Inputs, family_id, import_path, parameters_type
from codrl_mj.actuators.model import Advance, advance_signature, check_family
from codrl_mj.compile_cache import CompiledCallback, VerifiedMarker, cfunc
from codrl_mj.engine.memory import (
    call,
    f64,
    i32,
    internal,
    named_address,
    named_tuple_type,
    read,
    register_callees,
    u8,
    u64,
    write,
)
from codrl_mj.engine.model_access import load_inertia
from codrl_mj.engine.supplies import load_supplies
from codrl_mj.user_code import Form, UserFunction, check_form, compile_error_message

SIGNATURE = (250700.0, 268401.0)
"""First two numbers of the `user` data of our actuators and joints: the paper's arXiv identifier.

It is split in two because XML files keep only six digits of a number.
"""


class SlotHeader(NamedTuple):
    """Header of an actuator's slot, its state in `data.act` or `data.plugin_state`.

    The header is followed by the family's committed state (at `state_time`), the candidate state
    one step later, the signals, and a 0. The 0 is there because the engine multiplies the last
    activation by the actuator's gain, which is 0: an infinite signal in its place would give NaN.
    """

    state_time: float
    """Simulation time [s] of the committed state."""
    noise_key: float
    """Key of the episode's random numbers."""
    torque: float
    """Torque delivered at the shaft [N*m]."""


USER_HEADER_SIZE, SLOT_HEADER_SIZE = 3, len(SlotHeader._fields)
"""Lengths of the headers of an actuator's `user` data and of its slot."""

_ADDRESSES = np.zeros(10**6, dtype=np.uintp)
"""Addresses of the families' compiled functions by family number; 0 if not compiled.

The operating system maps these 8 MB page by page, so unused entries take no memory.
"""
STATES, SIGNALS, PARAMETERS, INERTIA, MOTION, SLOT_SIZE = range(6)
"""Columns of the table of sizes: numbers of states, signals and parameters; 1 if the family needs
the inertia; 1 if its command is a motion; and its `slot_size`.
"""
_SIZES = np.zeros((10**6, 6), dtype=np.int32)
"""Sizes of the families, by family number."""
_IMPORT_PATHS = np.zeros(10**6, dtype=np.uintp)
"""Addresses of the families' import paths as C strings, by family number."""
_COMPILED: dict[int, tuple[Family, object]] = {}
"""Family number -> (family, owner of the memory that the tables point to)."""

addresses_pointer = named_address("codrl_mj_families", _ADDRESSES.ctypes.data)
sizes_pointer = named_address("codrl_mj_sizes", _SIZES.ctypes.data)
import_paths_pointer = named_address("codrl_mj_import_paths", _IMPORT_PATHS.ctypes.data)

ArrayAdvance = Callable[[ArrayLike, float, ArrayLike, Inputs], tuple[np.ndarray, float, np.ndarray]]
"""A family's `advance` (parameters, timestep, state, inputs) that returns its state and signals as
arrays.
"""

_F64, _ADDRESS = types.float64, types.uintp
_ADVANCE_TYPE = _F64(_ADDRESS, _F64, _ADDRESS, _ADDRESS, _ADDRESS, *(_F64,) * 6)


def loaded_families() -> tuple[Family, ...]:
    """Return the families that have been compiled in this process."""
    return tuple(family for family, _ in _COMPILED.values())


def slot_size(family: Family) -> int:
    """Return the length of a slot of this family."""
    return signals_offset(family) + len(family.Signals._fields) + 1


def signals_offset(family: Family) -> int:
    """Return the offset of the signals in a family's slot."""
    return SLOT_HEADER_SIZE + 2 * len(family.State._fields)


def user_header(family: Family) -> tuple[float, float, float]:
    """Return the header of an actuator's `user` data; the parameters follow it."""
    return *SIGNATURE, float(family_id(family))


def load_family(family: Family) -> None:
    """Compile a family on first use, and put it into the table.

    A class that is defined again under its name, as in a notebook, replaces the previous class.

    Raises:
        ValueError: another family has the same number; or the previous class of this name had
            other numbers of states, signals or parameters, on which existing models rely; or numba
            cannot compile `advance`; or `advance` does not return what the family declares.
    """
    check_family(family)
    family_number, sizes = family_id(family), family_sizes(family)
    loaded, _ = _COMPILED.get(family_number, (None, None))
    if loaded is family:
        return
    if loaded is not None and import_path(loaded) != import_path(family):
        raise ValueError(
            f"families {import_path(family)} and {import_path(loaded)} have the same number"
            f" {family_number}: rename one"
        )
    if loaded is not None and family_sizes(loaded) != sizes:
        raise ValueError(
            f"family {import_path(family)} has {sizes[:3]} states, signals and parameters, and"
            f" {family_sizes(loaded)[:3]} when it was loaded before: give it another name, or"
            " restart Python"
        )
    if family.INERTIA:
        load_inertia()
    if family.SHARES_SUPPLY:
        load_supplies()
    function, text = _compile(family), ctypes.create_string_buffer(import_path(family).encode())
    _SIZES[family_number], _IMPORT_PATHS[family_number] = (
        (*sizes, slot_size(family)),
        ctypes.addressof(text),
    )
    # The function's address is set last: with it the family counts as compiled.
    _ADDRESSES[family_number] = function.address
    # The previous entry is kept alive: another thread may still be running its function.
    _COMPILED[family_number] = family, (function, text, _COMPILED.get(family_number))


def family_sizes(family: Family) -> tuple[int, ...]:
    """Return a family's row in the table of sizes, without its `slot_size`."""
    counts = (len(kind._fields) for kind in (family.State, family.Signals, parameters_type(family)))
    return *counts, int(family.INERTIA), int(family.MOTION)


@contextlib.contextmanager
def family_replaced(family: Family, replacement: Family) -> Iterator[None]:
    """Replace a family's compiled `advance` by another family's, in a `with` block.

    Both families must have the same states and signals.
    """
    load_family(family)
    family_number, function = family_id(family), _compile(replacement)
    original = _ADDRESSES[family_number]
    _ADDRESSES[family_number] = function.address
    try:
        yield
    finally:
        _ADDRESSES[family_number] = original


@functools.cache
def compiled_function(
    function: UserFunction, form: Form, declared: str, *argument_types: types.Type
) -> UserFunction:
    """Compile a user's function, and check that its result has the declared form.

    The check compiles it; both are skipped if the function passed in an earlier process.
    """
    compiled = internal(function)
    dispatcher, marker = (
        cast(Dispatcher, compiled),
        VerifiedMarker("fits", function, form, argument_types),
    )
    try:
        register_callees(cast(FunctionType, function))
        if marker.exists():
            return compiled
        dispatcher.compile(argument_types)
    except Exception as error:
        raise ValueError(compile_error_message(function, error)) from error
    check_form(
        function,
        _example(dispatcher.overloads[argument_types].signature.return_type),
        form,
        declared,
    )
    marker.write()
    return compiled


def _example(kind: types.Type) -> object:
    """Return 0.0 for a numeric numba type, a tuple for a tuple type, and other types unchanged."""
    if isinstance(kind, types.BaseTuple):
        return tuple(map(_example, kind))
    return 0.0 if isinstance(kind, types.Float | types.Integer | types.Boolean) else kind


@functools.cache
def _compile(family: Family) -> CompiledCallback[..., float]:
    parameters_of, state_of = parameters_type(family), family.State
    argument_types = (
        named_tuple_type(parameters_of),
        _F64,
        named_tuple_type(state_of),
        named_tuple_type(Inputs),
    )
    advance: Advance = compiled_function(
        family.advance, *advance_signature(family), *argument_types
    )

    @cfunc(_ADVANCE_TYPE, nogil=True, error_model="numpy")
    def step(
        parameters_address: int,
        timestep: float,
        state_address: int,
        candidate_address: int,
        signals_address: int,
        desired: float,
        position: float,
        speed: float,
        time: float,
        key: float,
        inertia: float,
    ) -> float:
        state, torque, signals = advance(
            read(parameters_address, parameters_of),
            timestep,
            read(state_address, state_of),
            Inputs(desired, position, speed, time, key, inertia),
        )
        write(state, candidate_address)
        write(signals, signals_address)
        return torque

    return step


def compiled_advance(family: Family) -> ArrayAdvance:
    """Return a family's compiled `advance` for Python; its states and signals are arrays."""
    load_family(family)
    function, (states, signals, _) = _compile(family).ctypes, family_sizes(family)[:3]

    def advance(
        parameters: ArrayLike, timestep: float, state: ArrayLike, inputs: Inputs
    ) -> tuple[np.ndarray, float, np.ndarray]:
        parameter_array, before, after, signal_array = (
            np.array(parameters),
            np.array(state),
            np.empty(states),
            np.empty(signals),
        )
        addresses = [array.ctypes.data for array in (parameter_array, before, after, signal_array)]
        torque = function(addresses[0], timestep, *addresses[1:], *inputs)
        return after, torque, signal_array

    return advance


@functools.cache
def compiled_observe(family: Family) -> Callable[[int, int, float, float, float, int], None]:
    """Return a compiled function (parameters, signals, timestep, time, key, readings) -> None.

    It writes the sensors' readings to `readings`. Parameters, signals and readings are passed by
    address.
    """
    parameters_of, signals_of = parameters_type(family), family.Signals
    argument_types = (
        named_tuple_type(parameters_of),
        types.float64,
        named_tuple_type(signals_of),
        named_tuple_type(Inputs),
    )
    observe = compiled_function(
        family.observe, family.OBSERVED, f"{family.__name__}.OBSERVED", *argument_types
    )

    @internal
    def fill(
        parameters: int,
        signals: int,
        timestep: float,
        time: float,
        key: float,
        readings_address: int,
    ) -> None:
        inputs = Inputs(0.0, 0.0, 0.0, time, key)
        write(
            observe(read(parameters, parameters_of), timestep, read(signals, signals_of), inputs),
            readings_address,
        )

    return fill


@internal
def is_compiled(family_number: float) -> bool:
    """Return True if the table has a family of this number; any float is allowed."""
    return 0.0 <= family_number < 1e6 and u64(addresses_pointer())[int(family_number)] != 0


@internal(inline="always")
def family_size(family_number: int, column: int) -> int:
    """Return a column of the table of sizes, such as `SLOT_SIZE`, for a family's number."""
    return i32(sizes_pointer())[6 * family_number + column]


@internal(inline="always")
def has_import_path(family_number: int, text: int) -> bool:
    """Return True if the C string at address `text` equals a family's import path."""
    name, index = u64(import_paths_pointer())[family_number], 0
    while u8(name)[index] == u8(text)[index]:
        if u8(name)[index] == 0:
            return True
        index += 1
    return False


@internal
def commit_slot(family_number: int, slot: int, time: float) -> None:
    """Make an actuator's candidate state the committed one, after a step to `time`."""
    values, num_states = f64(slot), family_size(family_number, STATES)
    values[0] = time
    for entry in range(SLOT_HEADER_SIZE, SLOT_HEADER_SIZE + num_states):
        values[entry] = values[entry + num_states]


@internal
def advance_slot(
    family_number: int,
    parameters: int,
    timestep: float,
    slot: int,
    desired: float,
    position: float,
    speed: float,
    time: float,
    inertia: float,
) -> float:
    """Compute an actuator's candidate state and signals; store and return its torque [N*m].

    Parameters and slot are passed by address. The desired torque [N*m], position [rad], speed
    [rad/s] and inertia [kg*m^2] are those of the shaft.
    """
    # Repeated calls within a step start from the same committed state, and only overwrite the
    # candidate.
    values, state_bytes = f64(slot), 8 * family_size(family_number, STATES)
    state = slot + 8 * SLOT_HEADER_SIZE
    candidate = state + state_bytes
    values[2] = call(
        u64(addresses_pointer())[family_number],
        *(
            parameters,
            timestep,
            state,
            candidate,
            candidate + state_bytes,
            desired,
            position,
            speed,
            time,
            values[1],
            inertia,
        ),
    )
    return values[2]
