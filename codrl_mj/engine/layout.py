"""Where MuJoCo's structures keep their fields, for the MuJoCo that is installed.

The offsets differ between MuJoCo versions, so none is written down: `mujoco.introspect` describes the structures as
the C headers declare them, ctypes lays them out by the platform's ABI, and `check_layout` compares the result with
live objects before anything relies on it.
"""

import ctypes
import functools
from typing import Any

import mujoco
from mujoco.introspect import ast_nodes
from mujoco.introspect.structs import STRUCTS

from codrl_mj.plugin import LayoutError

_SCALARS = {
    "mjtNum": ctypes.c_double,
    "double": ctypes.c_double,
    "float": ctypes.c_float,
    "int": ctypes.c_int,
    "unsigned int": ctypes.c_uint,
    "char": ctypes.c_char,
    "bool": ctypes.c_bool,
    "mjtBool": ctypes.c_bool,
    "mjtByte": ctypes.c_ubyte,
    "unsigned char": ctypes.c_ubyte,
    "size_t": ctypes.c_size_t,
    "mjtSize": ctypes.c_int64,
    "int64_t": ctypes.c_int64,
    "uint64_t": ctypes.c_uint64,
    "uintptr_t": ctypes.c_size_t,
}


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
        f"MuJoCo {mujoco.__version__} declares a type that this version of codrl_mj does not know: {node.name!r}"
    )


def _structure(name: str, fields: Any) -> type[ctypes.Structure]:
    members = [(field.name, _ctype(field.type)) for field in fields]
    return type(name, (ctypes.Structure,), {"_fields_": members})


@functools.cache
def struct(name: str) -> type[ctypes.Structure]:
    """MuJoCo's structure of a C name (`mjModel`, `mjData`, `mjOption`, ...) as a ctypes structure.

    Raises:
        LayoutError: the structure holds a type that is not known here.
    """
    return _structure(name, STRUCTS[name].fields)


def offset(struct_name: str, field: str) -> int:
    """Offset in bytes of a field of `mjModel` or `mjData`, which may be dotted (`opt.timestep`).

    Raises:
        LayoutError: there is no such field in the installed MuJoCo.
    """
    kind, total = struct(struct_name), 0
    for part in field.split("."):
        if not hasattr(kind, part):
            raise LayoutError(f"MuJoCo {mujoco.__version__}: {struct_name} has no field {field!r}")
        total += getattr(kind, part).offset
        kind = dict(kind._fields_)[part]  # type: ignore[assignment, arg-type]
    return total


_PROBE = """
<mujoco>
  <option timestep="0.0123" integrator="implicit" actuatorgroupdisable="1 5"><flag clampctrl="disable"/></option>
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


def check_layout(model_fields: tuple[str, ...], data_fields: tuple[str, ...]) -> None:
    """Compare the computed layout of the given fields with a live model and its data.

    Every listed array must lie where the layout says, and every listed scalar must have its value there; the probe
    gives every count another value. A field that the public bindings do not show (`pbase`) is checked through its
    neighbours on both sides.

    Args:
        model_fields: fields of mjModel that will be read.
        data_fields: fields of mjData that will be read or written.

    Raises:
        LayoutError: a field is elsewhere.
    """
    model = mujoco.MjSpec.from_string(_PROBE).compile()  # within `motorised`, which this is no model for
    data = mujoco.MjData(model)
    data.time = 4.56
    mujoco.mj_fwdPosition(model, data)  # uses the stack: `maxuse_stack` is no longer zero
    for owner, name, fields in ((model, "mjModel", model_fields), (data, "mjData", data_fields)):
        raw: Any = struct(name).from_address(owner._address)
        for field in fields:
            live, found = owner, raw
            for part in field.split("."):
                live, found = getattr(live, part), getattr(found, part)
            expected = live.ctypes.data if hasattr(live, "ctypes") else live
            if found != expected:
                raise LayoutError(
                    f"MuJoCo {mujoco.__version__}: {name}.{field} reads {found!r} where its layout says, expected "
                    f"{expected!r}. Install a MuJoCo that this version of codrl_mj was tested with (see pyproject.toml)"
                )
