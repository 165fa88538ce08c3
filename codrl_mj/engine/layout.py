"""MuJoCo's structures and functions in functions that numba compiles: `MODEL.actuator_user(model)`, `DATA.time(data)`.

Compiled code knows a simulation by two integers, the addresses of its `mjModel` and `mjData`, which
must outlive the call. A fault that the engine itself finds (an unknown integrator, memory run out)
ends the process there, where `mujoco.mj_step` would raise `mujoco.FatalError`; our models cause
none.

The offsets differ between MuJoCo versions, so none is written down: `mujoco.introspect` describes
the structures as the C headers declare them, ctypes lays them out by the platform's ABI, and a
field is compared with a live object before anything relies on it. Compiled code has the offsets as
constants.
"""

import ctypes
import functools
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
from mujoco.introspect import ast_nodes
from mujoco.introspect.structs import STRUCTS
from numba import types
from numba.core.registry import cpu_target
from numba.core.typing.ctypes_utils import from_ctypes

from codrl_mj.compile_cache import external_function
from codrl_mj.engine.memory import emitted, pointed
from codrl_mj.plugin import LayoutError, library

_SCALARS = {
    "mjtNum": ctypes.c_double,
    "double": ctypes.c_double,
    "float": ctypes.c_float,
    "int": ctypes.c_int,
    "unsigned int": ctypes.c_uint,
    "char": ctypes.c_char,
    "bool": ctypes.c_ubyte,
    "mjtBool": ctypes.c_ubyte,
    "mjtByte": ctypes.c_ubyte,
    "unsigned char": ctypes.c_ubyte,
    "size_t": ctypes.c_int64,
    "mjtSize": ctypes.c_int64,
    "int64_t": ctypes.c_int64,
    "uint64_t": ctypes.c_uint64,
    "uintptr_t": ctypes.c_int64,
}
"""C types as ctypes has them and, by numba's table, compiled code, which counts with signed numbers."""


def _ctype(node: Any) -> Any:
    """The ctypes type of an introspected C type."""
    if isinstance(node, ast_nodes.PointerType):
        return ctypes.c_void_p
    if isinstance(node, ast_nodes.ArrayType):
        kind = _ctype(node.inner_type)
        for extent in reversed(node.extents):
            kind = kind * extent
        return kind
    if isinstance(node, ast_nodes.AnonymousStructDecl):
        return _structure("anonymous", node.fields)
    if node.name in _SCALARS:
        return _SCALARS[node.name]
    if node.name in STRUCTS:
        return struct(node.name)
    if node.name.startswith("mjt"):  # the remaining mjt* types are enumerations
        return ctypes.c_int
    raise LayoutError(
        f"MuJoCo {mujoco.__version__} declares a type that this version of codrl_mj does not know:"
        f" {node.name!r}"
    )


def _structure(name: str, fields: Any) -> type[ctypes.Structure]:
    members = [(field.name, _ctype(field.type)) for field in fields]
    return type(name, (ctypes.Structure,), {"_fields_": members})


@functools.cache
def struct(name: str) -> type[ctypes.Structure]:
    """MuJoCo's structure of a C name (`mjModel`, `mjData`, `mjOption`, ...) as a ctypes structure."""
    return _structure(name, STRUCTS[name].fields)


def offset(struct_name: str, field: str) -> int:
    """Offset in bytes of a field of `mjModel` or `mjData`, which may be dotted (`opt.timestep`)."""
    kind, total = struct(struct_name), 0
    for part in field.split("."):
        if not hasattr(kind, part):
            raise LayoutError(f"MuJoCo {mujoco.__version__}: {struct_name} has no field {field!r}")
        total += getattr(kind, part).offset
        kind = dict(kind._fields_)[part]  # type: ignore[assignment, arg-type]
    return total


_PROBE = """
<mujoco>
  <option timestep="0.0123" integrator="implicitfast" actuatorgroupdisable="1 5"><flag clampctrl="disable"/></option>
  <extension><plugin plugin="mujoco.pid"><instance name="p"/></plugin></extension>
  <worldbody>
    <body>
      <joint name="a" type="slide" user="21 22 23 24 25 26 27 28 29 30 31 32"/>
      <geom size="1"/>
      <body>
        <joint name="b" type="ball"/>
        <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      </body>
      <body/>
      <body/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="a" ctrllimited="true" ctrlrange="-2 3" group="4"/>
    <orientation joint="b" kp="1" input="quat"/>
    <motor joint="a"/>
    <motor joint="a"/>
    <general joint="a" dyntype="user" actdim="11" biastype="user" user="41 42 43 44 45 46 47 48 49 50 51 52 53 54 55"/>
    <plugin joint="a" plugin="mujoco.pid" instance="p"/>
  </actuator>
</mujoco>
"""


@functools.cache
def _live() -> dict[str, Any]:
    """A model and its data, of which every count has another value, by the names of their structures."""
    model = mujoco.MjSpec.from_string(
        _PROBE
    ).compile()  # within `motors_added`, which this is no model for
    data = mujoco.MjData(model)
    data.time = 4.56
    mujoco.mj_fwdPosition(model, data)  # uses the stack: `maxuse_stack` is no longer zero
    return {"mjModel": model, "mjData": data}


def check_field(struct_name: str, field: str) -> None:
    """Compare the layout of a field of `mjModel` or `mjData` with a live object.

    An array must lie where the layout says, anything else must have its value there. A field that
    the public bindings do not show (`pbase`), or of which there is nothing, is checked through its
    neighbours on both sides.
    """
    with ThreadPoolExecutor(
        1
    ) as thread:  # the compiler of a model, which may be running, is not reentrant in its own
        owner = thread.submit(_live).result()[struct_name]
    raw: Any = struct(struct_name).from_address(owner._address)
    names = [field]
    if field.count(".") == 0 and not _is_shown(owner, field):
        order = [one.name for one in STRUCTS[struct_name].fields]
        place = order.index(field)
        before, after = order[:place][::-1], order[place + 1 :]
        names = [next(one for one in side if _is_shown(owner, one)) for side in (before, after)]
    for name in names:
        live, found = owner, raw
        for part in name.split("."):
            live, found = getattr(live, part), getattr(found, part)
        expected = live.ctypes.data if hasattr(live, "ctypes") else live
        if found != expected:
            raise LayoutError(
                f"MuJoCo {mujoco.__version__}: {struct_name}.{name} reads {found!r} where its"
                f" layout says, expected {expected!r}. Install a MuJoCo that this version of"
                " codrl_mj was tested with (see pyproject.toml)"
            )


def _is_shown(owner: Any, field: str) -> bool:
    """Whether the bindings show a field of which there is something."""
    live = getattr(owner, field, None)
    return isinstance(live, int | float) or getattr(live, "size", 0) > 0


class Fields(ModuleType):
    """The fields of a structure, each a function of the structure's address for compiled code.

    That of an array is a typed pointer to its entries, any other its value. A module, because numba
    looks up what these have while it compiles.
    """

    def __init__(self, struct_name: str, within: str = "") -> None:
        """Of `mjModel` or `mjData`; `within` ends with a dot where the fields are those of a part, such as `opt.`."""
        super().__init__(f"{struct_name}.{within}".rstrip("."))
        self._owner, self._within = struct_name, within

    def __getattr__(self, name: str) -> Any:
        """The function of a field, made and compared when it is first named."""
        kind = STRUCTS[self._owner]
        for part in self._within.rstrip(".").split(".") if self._within else ():
            kind = STRUCTS[next(one.type.name for one in kind.fields if one.name == part)]
        node = next((one.type for one in kind.fields if one.name == name), None)
        if node is None:
            raise AttributeError(name)
        path = f"{self._within}{name}"
        if isinstance(node, ast_nodes.ValueType) and node.name in STRUCTS:
            made: Any = Fields(self._owner, f"{path}.")
        else:
            check_field(self._owner, path)
            made = _function(self._owner, path, node)
        setattr(self, name, made)
        return made


def _function(struct_name: str, path: str, node: Any) -> Any:
    """What reads a field, compiled into whoever calls it."""
    is_array = isinstance(node, ast_nodes.PointerType)
    element = from_ctypes(_SCALARS[node.inner_type.name if is_array else node.name])
    kind, at = types.CPointer(element) if is_array else element, offset(struct_name, path)

    @emitted(lambda address: kind(types.uintp))  # noqa: ARG005 - one
    def field(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ARG001 - numba fixes them
        place = builder.add(arguments[0], context.get_constant(types.uintp, at))
        return builder.load(pointed(builder, place, context.get_value_type(kind)))

    # numba has to know it at once: it may be compiling what names it
    cpu_target.typing_context.refresh()
    return field


MODEL, DATA = Fields("mjModel"), Fields("mjData")
"""The structures that a simulation is known by."""


def addresses(data: mujoco.MjData) -> tuple[int, int]:
    """The addresses of an `MjData`'s model and of itself, by which compiled code knows them."""
    return data.model._address, data._address


def address_of(owner: Any, name: str) -> int:
    """Of a field of an `MjModel` or `MjData`, which may be dotted (`opt.timestep`): of an array that of its entries."""
    live = functools.reduce(getattr, name.split("."), owner)
    if isinstance(live, np.ndarray):
        return live.ctypes.data
    return int(owner._address) + offset(
        "mjModel" if isinstance(owner, mujoco.MjModel) else "mjData", name
    )


@functools.cache
def engine_function(name: str) -> Any:
    """A function of MuJoCo's of (model, data), such as `mj_step`, by their addresses, for compiled code."""
    return external_function(
        f"codrl_mj_{name}", getattr(library(), name), types.void(types.uintp, types.uintp)
    )
