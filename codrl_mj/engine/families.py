"""Families of actuators, compiled: one table of C functions that both doors into MuJoCo call by a family's number.

A family's number is in the model's `user` data, so a callback or plugin that was compiled once runs
families that were written later. Compiling one takes a fraction of a second, once a process.
"""

import contextlib
import ctypes
import functools
import sys
from collections.abc import Callable, Iterator
from types import CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import register_jitable

from codrl_mj.actuators import Family, Inputs, family_id, parameters_type, import_path
from codrl_mj.actuators.model import advance_signature, check_family
from codrl_mj.compile_cache import Note, cfunc
from codrl_mj.engine.doors import load_inertia
from codrl_mj.engine.memory import call, f64, i32, internal, read, symbol, tuple_of, u8, u64, write
from codrl_mj.user_code import Form, check_form, not_compiled

SIGNATURE = (250700.0, 268401.0)
"""First two numbers of the `user` data of every actuator and joint that is ours: the paper's arXiv
identifier, in two, because a number keeps six digits in an XML file.
"""


class Slot(NamedTuple):
    """What the state of an actuator of ours begins with, in `data.act` or `data.plugin_state`.

    The family's committed state follows (at time `tick`), then its candidate one step later, then
    its signals, then a 0: the engine multiplies the last activation by the actuator's gain, 0,
    which makes NaN of infinity.
    """

    tick: float
    """Time [s] of the committed state."""
    noise_key: float
    """Key of the episode's random numbers."""
    torque: float
    """Torque delivered at the shaft [N*m]."""


HEAD, SLOT = 3, len(Slot._fields)
"""Numbers of what an actuator's `user` data, and its state, begin with."""

_ADDRESSES = np.zeros(10**6, dtype=np.uintp)
"""Address of a family's compiled function by its number; 0 where it has not been compiled. 8 MB
that the system hands out page by page.
"""
STATES, SIGNALS, PARAMETERS, INERTIA, MOTION, WHOLE = range(6)
"""Columns of the table of sizes: a family's numbers of states, signals and parameters, whether it
asks for the inertia and is asked for motions, and its `slot_size`.
"""
_SIZES = np.zeros((10**6, 6), dtype=np.int32)
"""The sizes of a family, by its number."""
_REFERENCES = np.zeros(10**6, dtype=np.uintp)
"""Address of its `reference`, as C has strings, likewise."""
_COMPILED: dict[int, tuple[Family, Any]] = {}
"""Number -> (family, what owns the memory that the tables point to)."""

addresses_at = symbol("codrl_mj_families", _ADDRESSES.ctypes.data)
sizes_at = symbol("codrl_mj_sizes", _SIZES.ctypes.data)
references_at = symbol("codrl_mj_references", _REFERENCES.ctypes.data)

_F64, _AT = types.float64, types.uintp
_FUNCTION = _F64(_AT, _F64, _AT, _AT, _AT, *(_F64,) * 6)


def loaded_families() -> tuple[Family, ...]:
    """The families that have been compiled in this process."""
    return tuple(family for family, _ in _COMPILED.values())


def slot_size(family: Family) -> int:
    """Numbers of state that an actuator of a family has in MuJoCo."""
    return signals_at(family) + len(family.Signals._fields) + 1


def signals_at(family: Family) -> int:
    """Where its signals begin in there."""
    return SLOT + 2 * len(family.State._fields)


def user_head(family: Family) -> tuple[float, float, float]:
    """What the `user` data of a family's actuators begin with, at either door; its parameters follow."""
    return *SIGNATURE, float(family_id(family))


def load_family(family: Family) -> None:
    """Compile a family, on first use, and put it into the table.

    A class that was defined anew, as in a notebook, takes the place of the one before.

    Raises:
        ValueError: another family has the same number: rename one of the two. Or the one before had
            other numbers of states, signals or parameters, which models that exist rely on. Or
            `advance` is not what numba compiles, or does not return what the family declares.
    """
    check_family(family)
    number, sizes = family_id(family), family_sizes(family)
    other, _ = _COMPILED.get(number, (None, None))
    if other is family:
        return
    if other is not None and import_path(other) != import_path(family):
        raise ValueError(
            f"families {import_path(family)} and {import_path(other)} have the same number {number}:"
            " rename one"
        )
    if other is not None and family_sizes(other) != sizes:
        raise ValueError(
            f"family {import_path(family)} has {sizes[:3]} states, signals and parameters, and"
            f" {family_sizes(other)[:3]} when it was loaded before: give it another name, or start"
            " Python anew"
        )
    if family.INERTIA:
        load_inertia()
    function, text = _compile(family), ctypes.create_string_buffer(import_path(family).encode())
    _SIZES[number], _REFERENCES[number] = (*sizes, slot_size(family)), ctypes.addressof(text)
    _ADDRESSES[number] = function.address
    _COMPILED[number] = family, (function, text, _COMPILED.get(number))


def family_sizes(family: Family) -> tuple[int, ...]:
    """Numbers of a family's states, signals and parameters, and its `INERTIA` and `MOTION`."""
    counts = (len(kind._fields) for kind in (family.State, family.Signals, parameters_type(family)))
    return *counts, int(family.INERTIA), int(family.MOTION)


@contextlib.contextmanager
def replaced(family: Family, other: Family) -> Iterator[None]:
    """Run another's `advance` in place of a family's in a `with` block; both have the same states and signals."""
    load_family(family)
    number, function = family_id(family), _compile(other)
    right = _ADDRESSES[number]
    _ADDRESSES[number] = function.address
    try:
        yield
    finally:
        _ADDRESSES[number] = right


_OTHERS = sys.stdlib_module_names | {"numba", "numpy", "scipy"}
"""Packages whose functions numba knows, or does not, by itself."""


_KNOWN: set[FunctionType] = set()


def _make_known(function: Any) -> None:
    """Make the plain functions that a function calls, and these call, known to numba; they stay what they are."""
    codes, names = [function.__code__], set[str]()
    for code in codes:
        names |= {*code.co_names, *code.co_freevars}
        codes += [one for one in code.co_consts if isinstance(one, CodeType)]
    closed = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    scope = function.__globals__ | {name: cell.cell_contents for name, cell in closed}
    found = [scope[name] for name in names & scope.keys()]
    for one in found:  # which grows by what modules have
        if isinstance(one, ModuleType) and one.__name__.partition(".")[0] not in _OTHERS:
            inner = [getattr(one, name) for name in names if hasattr(one, name)]
            found += [new for new in inner if all(new is not other for other in found)]
        ours = isinstance(one, FunctionType) and one.__module__.partition(".")[0] not in _OTHERS
        if ours and one not in _KNOWN:
            _KNOWN.add(one)
            register_jitable(forceinline=True)(one)
            _make_known(one)


@functools.cache
def compiled_function(function: Callable[..., Any], form: Form, declared: str, *kinds: Any) -> Any:
    """A user's function for arguments of such types, whose result is of a form in numba's eyes too.

    It is compiled to find that out, unless a process before has, of the very same function.
    """
    compiled, noted = internal(function), Note("fits", function, form, kinds)
    try:
        _make_known(function)
        if noted.is_there():
            return compiled
        compiled.compile(kinds)
    except Exception as error:
        raise ValueError(not_compiled(function, error)) from error
    check_form(function, _example(compiled.overloads[kinds].signature.return_type), form, declared)
    noted.leave()
    return compiled


def _example(kind: Any) -> Any:
    """A value of one of numba's types; of one that is neither a number nor a tuple of these, the type."""
    if isinstance(kind, types.BaseTuple):
        return tuple(map(_example, kind))
    return 0.0 if isinstance(kind, types.Float | types.Integer | types.Boolean) else kind


@functools.cache
def _compile(family: Any) -> Any:
    parameters_of, state_of = parameters_type(family), family.State
    kinds = tuple_of(parameters_of), _F64, tuple_of(state_of), tuple_of(Inputs)
    advance = compiled_function(family.advance, *advance_signature(family), *kinds)

    @cfunc(_FUNCTION, nogil=True, error_model="numpy")
    def step(
        parameters: int,
        timestep: float,
        before: int,
        after: int,
        seen: int,
        desired: float,
        position: float,
        speed: float,
        time: float,
        key: float,
        inertia: float,
    ) -> float:
        state, torque, outcome = advance(
            read(parameters, parameters_of),
            timestep,
            read(before, state_of),
            Inputs(desired, position, speed, time, key, inertia),
        )
        write(state, after)
        write(outcome, seen)
        return torque

    return step


def compiled_advance(family: Family) -> Callable[..., Any]:
    """Return a family's `advance`, compiled, to be called from Python; states and signals are arrays."""
    load_family(family)
    function, (states, signals, _) = _compile(family).ctypes, family_sizes(family)[:3]

    def advance(
        parameters: Any, timestep: float, state: Any, inputs: Inputs
    ) -> tuple[Any, float, Any]:
        numbers, before, after, seen = (
            np.array(parameters),
            np.array(state),
            np.empty(states),
            np.empty(signals),
        )
        addresses = [one.ctypes.data for one in (numbers, before, after, seen)]
        torque = function(addresses[0], timestep, *addresses[1:], *inputs)
        return after, torque, seen

    return advance


@functools.cache
def compiled_observe(family: Family) -> Any:
    """(parameters, signals, timestep, time, key, seen) -> nothing: writes what the sensors say.

    Vectors go by their addresses.
    """
    kind, signals_of = parameters_type(family), family.Signals
    kinds = tuple_of(kind), types.float64, tuple_of(signals_of), tuple_of(Inputs)
    observe = compiled_function(
        family.observe, family.OBSERVED, f"{family.__name__}.OBSERVED", *kinds
    )

    @internal
    def fill(
        parameters: int, shown: int, timestep: float, time: float, key: float, seen: int
    ) -> None:
        inputs = Inputs(0.0, 0.0, 0.0, time, key)
        write(observe(read(parameters, kind), timestep, read(shown, signals_of), inputs), seen)

    return fill


@internal
def is_compiled(number: float) -> bool:
    """Whether a family of that number is in the table; any float will do."""
    return 0.0 <= number < 1e6 and u64(addresses_at())[int(number)] != 0


@internal(inline="always")
def size_of(number: int, column: int) -> int:
    """A column of the table of sizes, such as `WHOLE`, by a family's number."""
    return i32(sizes_at())[6 * number + column]


@internal(inline="always")
def is_called(number: int, text: int) -> bool:
    """Whether the C string at an address is a family's `reference`."""
    name, place = u64(references_at())[number], 0
    while u8(name)[place] == u8(text)[place]:
        if u8(name)[place] == 0:
            return True
        place += 1
    return False


@internal
def commit_slot(number: int, slot: int, time: float) -> None:
    """A step was taken and it is `time` now: what was an actuator's candidate has happened."""
    own, count = f64(slot), size_of(number, STATES)
    own[0] = time
    for entry in range(SLOT, SLOT + count):
        own[entry] = own[entry + count]


@internal
def advance_slot(
    number: int,
    parameters: int,
    timestep: float,
    slot: int,
    desired: float,
    position: float,
    speed: float,
    time: float,
    inertia: float,
) -> float:
    """Compute an actuator's candidate and signals from its committed state; the torque [N*m], which its slot keeps too.

    By address are the parameters and the slot; torque asked for [N*m], position [rad], speed
    [rad/s] and inertia [kg*m^2] are the shaft's.
    """
    own, size = f64(slot), 8 * size_of(number, STATES)
    before = slot + 8 * SLOT
    after = before + size
    own[2] = call(
        u64(addresses_at())[number],
        *(
            parameters,
            timestep,
            before,
            after,
            after + size,
            desired,
            position,
            speed,
            time,
            own[1],
            inertia,
        ),
    )
    return own[2]
