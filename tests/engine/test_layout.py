"""Structure offsets agree with live objects, and a wrong layout is never used."""

import ctypes
import re
from pathlib import Path

import mujoco
import numba
import numpy as np
import pytest

from codrl_mj.engine import LayoutError, layout

SOURCE = "".join(path.read_text() for path in Path(layout.__file__).parents[1].rglob("*.py"))
OWNERS = {"MODEL": "mjModel", "DATA": "mjData"}
USED = sorted(
    {(OWNERS[owner], field) for owner, field in re.findall(r"\b(MODEL|DATA)\.([\w.]+)\(", SOURCE)}
)
"""Fields that compiled code reads or writes."""
STACK = [("mjData", field) for field in ("narena", "nbuffer", "pstack", "maxuse_stack")]
"""Fields around `pbase`, which the bindings do not expose."""
CASES = [
    ("mjOption", field[4:]) if field.startswith("opt.") else (owner, field) for owner, field in USED
]
CASES = [case for case in CASES if case != ("mjData", "pbase")] + STACK
# These are equal outside a step: no probe can tell them apart.
INDISTINGUISHABLE = {
    "pstack": {"pbase", "parena", "threadpool"},
    "maxuse_stack": {"maxuse_arena"},
}


def _is_pointer(struct_name, field):
    """Return True for a pointer, whose values always differ; only scalars need a special probe."""
    return dict(layout.struct(struct_name)._fields_)[field] is ctypes.c_void_p


@pytest.mark.parametrize("struct_name", ["mjModel", "mjData"])
def test_every_array_has_the_offset_of_the_layout(struct_name):
    model = mujoco.MjSpec.from_string(layout._PROBE).compile()
    owner = model if struct_name == "mjModel" else mujoco.MjData(model)
    checked = 0
    for field in layout.STRUCTS[struct_name].fields:
        live = getattr(owner, field.name, None)
        if not (
            isinstance(live, np.ndarray)
            and live.size
            and isinstance(field.type, layout.ast_nodes.PointerType)
        ):
            continue
        pointer = ctypes.c_void_p.from_address(
            owner._address + layout.offset(struct_name, field.name)
        ).value
        # A null pointer belongs to the arena, which has not been used yet.
        if pointer is not None:
            assert pointer == live.ctypes.data, field.name
            checked += 1
    assert checked > 50


def test_scalars_of_nested_structures_are_read_and_written_at_their_offsets():
    model = mujoco.MjSpec.from_string(layout._PROBE).compile()
    data = mujoco.MjData(model)
    count = ctypes.c_int64.from_address(model._address + layout.offset("mjModel", "nactuator"))
    timestep = ctypes.c_double.from_address(
        model._address + layout.offset("mjModel", "opt.timestep")
    )
    time = ctypes.c_double.from_address(data._address + layout.offset("mjData", "time"))
    assert (count.value, timestep.value, time.value) == (
        model.nactuator,
        model.opt.timestep,
        data.time,
    )
    timestep.value, time.value = 0.25, 7.5
    assert (model.opt.timestep, data.time) == (0.25, 7.5)


def test_the_hidden_stack_frame_is_between_checked_neighbors():
    order = [name for name, _ in layout.struct("mjData")._fields_]
    indices = {name: order.index(name) for name in ("pbase", *(field for _, field in STACK))}
    assert (
        indices["narena"]
        < indices["nbuffer"]
        < indices["pstack"]
        < indices["pbase"]
        < indices["maxuse_stack"]
    )


def test_offset_raises_for_unknown_fields_and_types():
    with pytest.raises(
        LayoutError, match=f"MuJoCo {mujoco.__version__}: mjModel has no field 'no_such_thing'"
    ):
        layout.offset("mjModel", "no_such_thing")
    with pytest.raises(LayoutError, match=r"mjModel has no field 'opt\.no_such_thing'"):
        layout.offset("mjModel", "opt.no_such_thing")
    with pytest.raises(LayoutError, match="does not know: 'quaternion128'"):
        layout._ctype(layout.ast_nodes.ValueType(name="quaternion128"))
    assert not hasattr(layout.MODEL, "no_such_thing")
    assert not hasattr(layout.MODEL.opt, "nactuator")


def _check(*first):
    for owner, field in (*first, *USED, *STACK):
        layout.check_field(owner, field)


def _corrupt(monkeypatch, struct_name, members):
    """Replace the layout of a structure by given (name, type) members."""
    true = layout.struct
    bad = type(struct_name, (ctypes.Structure,), {"_fields_": members})
    replaced = {struct_name: bad}
    if struct_name == "mjOption":
        outer = [(name, bad if name == "opt" else kind) for name, kind in true("mjModel")._fields_]
        replaced = {"mjModel": type("mjModel", (ctypes.Structure,), {"_fields_": outer})}
    monkeypatch.setattr(layout, "struct", lambda name: replaced.get(name) or true(name))


def test_the_installed_layout_is_accepted():
    _check()


@pytest.mark.parametrize(("struct_name", "field"), CASES)
def test_check_field_raises_for_a_field_at_another_offset(struct_name, field, monkeypatch):
    members = list(layout.struct(struct_name)._fields_)
    index = [name for name, _ in members].index(field)
    _corrupt(
        monkeypatch,
        struct_name,
        [*members[:index], ("added_by_a_new_version", ctypes.c_int64), *members[index:]],
    )
    with pytest.raises(LayoutError, match="at its declared offset, expected"):
        _check()


@pytest.mark.parametrize(
    ("struct_name", "field"), [case for case in CASES if not _is_pointer(*case)]
)
def test_check_field_raises_for_two_exchanged_scalars(struct_name, field, monkeypatch):
    members = list(layout.struct(struct_name)._fields_)
    index = [name for name, _ in members].index(field)
    most_likely = ("mjModel", f"opt.{field}") if struct_name == "mjOption" else (struct_name, field)
    for other_place, (other_name, kind) in enumerate(members):
        if (
            other_name == field
            or kind is not members[index][1]
            or other_name in INDISTINGUISHABLE.get(field, ())
        ):
            continue
        swapped = list(members)
        swapped[index], swapped[other_place] = (other_name, kind), (field, kind)
        with monkeypatch.context() as patch:
            _corrupt(patch, struct_name, swapped)
            with pytest.raises(LayoutError):
                _check(most_likely)


@pytest.mark.parametrize("owner", ["mjModel", "mjData"])
def test_a_wrong_layout_is_not_compiled(owner, monkeypatch):
    _corrupt(
        monkeypatch,
        owner,
        [("added_by_a_new_version", ctypes.c_int64), *layout.struct(owner)._fields_],
    )
    fields, name = layout.StructFields(owner), "nactuator" if owner == "mjModel" else "time"

    @numba.njit
    def read(address):
        return getattr(fields, name)(address)

    with pytest.raises(LayoutError, match=f"MuJoCo {mujoco.__version__}: {owner}"):
        read.compile("float64(uintp)")


DECLARED = [
    (struct_name, name, kind)
    for struct_name, fields in (
        ("mjModel", layout.ModelFields),
        ("mjData", layout.DataFields),
        ("mjOption", layout.OptionFields),
    )
    for name, kind in vars(fields)["__annotations__"].items()
    if kind is not layout.OptionFields
]


def test_exactly_the_fields_that_are_used_have_a_type():
    used = {
        ("mjOption", field[4:]) if field.startswith("opt.") else (owner, field)
        for owner, field in USED
    }
    assert {(struct_name, name) for struct_name, name, _ in DECLARED} == used


@pytest.mark.parametrize(("struct_name", "name", "kind"), DECLARED)
def test_a_fields_type_is_that_of_the_c_headers(struct_name, name, kind):
    node = next(field.type for field in layout.STRUCTS[struct_name].fields if field.name == name)
    is_array = isinstance(node, layout.ast_nodes.PointerType)
    is_float = (node.inner_type if is_array else node).name == "mjtNum"
    expected = {
        (True, True): layout.FloatArray,
        (True, False): layout.IntArray,
        (False, True): layout.FloatField,
        (False, False): layout.IntField,
    }
    assert kind == expected[is_array, is_float]
