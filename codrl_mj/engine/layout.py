"""Access to MuJoCo's structures and functions in code that numba compiles.

For example `MODEL.actuator_user(model)` and `DATA.time(data)`.

Compiled code identifies a simulation by two integers, the addresses of its `mjModel` and `mjData`,
which must outlive the call. A fatal error in the engine (an unknown integrator, memory exhausted)
ends the process in compiled code, while `mujoco.mj_step` would raise `mujoco.FatalError`; our
models cause no such error.

Offsets differ between MuJoCo versions, so none is hard-coded: `mujoco.introspect` describes the
structures as the C headers declare them, ctypes lays them out by the platform's ABI, and each field
is compared with a live object before its first use. Compiled code contains the offsets as
constants.
"""

import ctypes
import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType
from typing import Any, TypeAlias

import mujoco
import numpy as np
from llvmlite.ir import IRBuilder, Value
from mujoco.introspect import ast_nodes
from mujoco.introspect.structs import STRUCTS
from numba import types
from numba.core.base import BaseContext
from numba.core.registry import cpu_target
from numba.core.typing import Signature
from numba.core.typing.ctypes_utils import from_ctypes

from codrl_mj.compile_cache import external_function
from codrl_mj.engine.memory import Pointer, llvm_intrinsic, to_pointer
from codrl_mj.plugin import LayoutError as LayoutError
from codrl_mj.plugin import library

CType: TypeAlias = (
    ast_nodes.ValueType
    | ast_nodes.PointerType
    | ast_nodes.ArrayType
    | ast_nodes.AnonymousStructDecl
)
"""A type of C in MuJoCo's introspection."""
# ctypes has no public name for the common base class of its types.
CtypesType: TypeAlias = type[Any]

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
"""C type -> ctypes type; numba's table turns these into the types of compiled code.

Sizes are signed, because in numba the sum of a signed and an unsigned integer is a float.
"""


def _ctype(node: CType) -> CtypesType:
    """Return the ctypes type of an introspected C type."""
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
    # The remaining mjt* types are enumerations, which C stores as int.
    if node.name.startswith("mjt"):
        return ctypes.c_int
    raise LayoutError(
        f"MuJoCo {mujoco.__version__} declares a type that this version of codrl_mj does not know:"
        f" {node.name!r}"
    )


def _structure(
    name: str,
    fields: Sequence[ast_nodes.StructFieldDecl | ast_nodes.AnonymousStructDecl],
) -> type[ctypes.Structure]:
    members = [(field.name, _ctype(field.type)) for field in fields]
    return type(name, (ctypes.Structure,), {"_fields_": members})


@functools.cache
def struct(name: str) -> type[ctypes.Structure]:
    """Return the ctypes structure of a C name (`mjModel`, `mjData`, `mjOption`, ...)."""
    return _structure(name, STRUCTS[name].fields)


def offset(struct_name: str, field: str) -> int:
    """Return the offset [bytes] of a field, whose name may be dotted (`opt.timestep`)."""
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
def _live_objects() -> dict[str, mujoco.MjModel | mujoco.MjData]:
    """Return a live model and its data by the names of their structures.

    All counts differ, so that a wrong offset cannot read the right value by chance.
    """
    # MjSpec bypasses the patched loaders of `motors_added`: the probe must not get motors.
    model = mujoco.MjSpec.from_string(_PROBE).compile()
    data = mujoco.MjData(model)
    data.time = 4.56
    # This uses the stack, so that `maxuse_stack` differs from zero.
    mujoco.mj_fwdPosition(model, data)
    return {"mjModel": model, "mjData": data}


def check_field(struct_name: str, field: str) -> None:
    """Compare the layout of a field of `mjModel` or `mjData` with a live object.

    The number at the field's offset must be the address of an array, or the value of any other
    field. If the bindings do not expose the field (`pbase`), or it is empty, its nearest neighbors
    on both sides are checked instead.

    Raises:
        LayoutError: the field differs.
    """
    # MuJoCo's model compiler is not reentrant within a thread, and may be running in this one.
    with ThreadPoolExecutor(1) as thread:
        owner = thread.submit(_live_objects).result()[struct_name]
    raw = struct(struct_name).from_address(owner._address)
    names = [field]
    if field.count(".") == 0 and not _is_exposed(owner, field):
        order = [member.name for member in STRUCTS[struct_name].fields]
        index = order.index(field)
        before, after = order[:index][::-1], order[index + 1 :]
        names = [
            next(member for member in side if _is_exposed(owner, member))
            for side in (before, after)
        ]
    for name in names:
        live, value = owner, raw
        for part in name.split("."):
            live, value = getattr(live, part), getattr(value, part)
        expected = live.ctypes.data if hasattr(live, "ctypes") else live
        if value != expected:
            raise LayoutError(
                f"MuJoCo {mujoco.__version__}: {struct_name}.{name} reads {value!r} at its"
                f" declared offset, expected {expected!r}. Install a MuJoCo that this version of"
                " codrl_mj was tested with (see pyproject.toml)"
            )


def _is_exposed(owner: mujoco.MjModel | mujoco.MjData, field: str) -> bool:
    """Return True if the bindings expose a field and it is not empty."""
    live = getattr(owner, field, None)
    return isinstance(live, int | float) or getattr(live, "size", 0) > 0


class StructFields(ModuleType):
    """Fields of a structure as functions of the structure's address, for compiled code.

    For an array, the function returns a typed pointer to the entries; for any other field, the
    value. The class is a module because numba resolves a module's attributes while it compiles.
    """

    def __init__(self, struct_name: str, within: str = "") -> None:
        """Select `mjModel` or `mjData`, or a structure within it, with a final dot (`opt.`)."""
        super().__init__(f"{struct_name}.{within}".rstrip("."))
        self._owner, self._within = struct_name, within

    def __getattr__(self, name: str) -> object:
        """Return a field's function; create it and check the field on first access."""
        kind = STRUCTS[self._owner]
        for part in self._within.rstrip(".").split(".") if self._within else ():
            kind = STRUCTS[next(member.type.name for member in kind.fields if member.name == part)]
        node = next((member.type for member in kind.fields if member.name == name), None)
        if node is None:
            raise AttributeError(name)
        path = f"{self._within}{name}"
        if isinstance(node, ast_nodes.ValueType) and node.name in STRUCTS:
            attribute: object = StructFields(self._owner, f"{path}.")
        else:
            check_field(self._owner, path)
            attribute = _function(self._owner, path, node)
        setattr(self, name, attribute)
        return attribute


IntField = Callable[[int], int]
FloatField = Callable[[int], float]
"""Function of the structure's address that returns a number."""
IntArray = Callable[[int], Pointer[int]]
FloatArray = Callable[[int], Pointer[float]]
"""Function of the structure's address that returns a pointer to the entries of an array."""


class OptionFields(StructFields):
    """Fields of `mjOption` that this package uses."""

    timestep: FloatField
    integrator: IntField
    disableflags: IntField
    disableactuator: IntField


class ModelFields(StructFields):
    """Fields of `mjModel` that this package uses."""

    opt: OptionFields
    nu: IntField
    nv: IntField
    njnt: IntField
    nactuator: IntField
    nuser_jnt: IntField
    nuser_actuator: IntField
    M_rownnz: IntArray
    M_rowadr: IntArray
    M_colind: IntArray
    body_mass: FloatArray
    body_geomnum: IntArray
    body_geomadr: IntArray
    jnt_type: IntArray
    jnt_bodyid: IntArray
    jnt_qposadr: IntArray
    jnt_dofadr: IntArray
    jnt_user: FloatArray
    geom_pos: FloatArray
    geom_quat: FloatArray
    actuator_dyntype: IntArray
    actuator_gaintype: IntArray
    actuator_biastype: IntArray
    actuator_dynprm: FloatArray
    actuator_gainprm: FloatArray
    actuator_biasprm: FloatArray
    actuator_actearly: IntArray
    actuator_actadr: IntArray
    actuator_actnum: IntArray
    actuator_ctrladr: IntArray
    actuator_outadr: IntArray
    actuator_group: IntArray
    actuator_plugin: IntArray
    actuator_ctrllimited: IntArray
    actuator_actlimited: IntArray
    actuator_forcelimited: IntArray
    actuator_ctrlrange: FloatArray
    actuator_actrange: FloatArray
    actuator_forcerange: FloatArray
    actuator_user: FloatArray
    plugin_stateadr: IntArray
    plugin_statenum: IntArray


class DataFields(StructFields):
    """Fields of `mjData` that this package uses."""

    time: FloatField
    pbase: IntField
    qpos: FloatArray
    qvel: FloatArray
    act: FloatArray
    act_dot: FloatArray
    ctrl: FloatArray
    plugin_state: FloatArray
    qfrc_applied: FloatArray
    qfrc_passive: FloatArray
    xpos: FloatArray
    xmat: FloatArray
    geom_xpos: FloatArray
    geom_xmat: FloatArray
    actuator_length: FloatArray
    actuator_velocity: FloatArray
    actuator_force: FloatArray
    actuator_moment: FloatArray
    moment_rownnz: IntArray
    moment_rowadr: IntArray
    moment_colind: IntArray
    qLD: FloatArray  # noqa: N815 - the engine's name
    qLDiagInv: FloatArray  # noqa: N815 - the engine's name


def _function(struct_name: str, path: str, node: CType) -> Callable[[int], float | Pointer[float]]:
    """Return an intrinsic that reads a field; it is inlined into its callers."""
    is_array = isinstance(node, ast_nodes.PointerType)
    element = from_ctypes(_SCALARS[node.inner_type.name if is_array else node.name])
    kind, field_offset = types.CPointer(element) if is_array else element, offset(struct_name, path)

    def generate(
        context: BaseContext,
        builder: IRBuilder,
        signature: Signature,  # noqa: ARG001 - numba fixes the arguments
        arguments: Sequence[Value],
    ) -> Value:
        field_address = builder.add(arguments[0], context.get_constant(types.uintp, field_offset))
        return builder.load(to_pointer(builder, field_address, context.get_value_type(kind)))

    @llvm_intrinsic(lambda address: kind(types.uintp), generate)  # noqa: ARG005 - numba passes one
    def field(address: int) -> float | Pointer[float]:
        raise NotImplementedError

    # Without a refresh, numba would not find the intrinsic in the function that it is compiling.
    cpu_target.typing_context.refresh()
    return field


MODEL, DATA = ModelFields("mjModel"), DataFields("mjData")
"""Fields of `mjModel` and `mjData`."""


def addresses(data: mujoco.MjData) -> tuple[int, int]:
    """Return the addresses of a simulation's `mjModel` and `mjData`, for compiled code."""
    return data.model._address, data._address


def field_address(owner: mujoco.MjModel | mujoco.MjData, name: str) -> int:
    """Return the address of a field of an `MjModel` or `MjData`, or of an array's entries.

    The field's name may be dotted (`opt.timestep`).
    """
    live = functools.reduce(getattr, name.split("."), owner)
    if isinstance(live, np.ndarray):
        return int(live.ctypes.data)
    return int(owner._address) + offset(
        "mjModel" if isinstance(owner, mujoco.MjModel) else "mjData", name
    )


@functools.cache
def engine_function(name: str) -> Callable[[int, int], None]:
    """Return MuJoCo's function of (model, data), such as `mj_step`, for compiled code."""
    return external_function(
        f"codrl_mj_{name}", getattr(library(), name), types.void(types.uintp, types.uintp)
    )
