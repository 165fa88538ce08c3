"""Structure offsets: against the addresses of live objects, and that a wrong layout is never used."""

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
"""Whatever compiled code reads or writes."""
STACK = [("mjData", field) for field in ("narena", "nbuffer", "pstack", "maxuse_stack")]
"""Around `pbase`, which the bindings do not show."""
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
    """Two pointers are never equal, so only scalars need a probe that gives them different values."""
    return dict(layout.struct(struct_name)._fields_)[field] is ctypes.c_void_p


@pytest.mark.parametrize("struct_name", ["mjModel", "mjData"])
def test_every_array_of_a_live_object_lies_where_its_offset_says(struct_name):
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
        found = ctypes.c_void_p.from_address(
            owner._address + layout.offset(struct_name, field.name)
        ).value
        if found is not None:  # else it lives in the arena, which nothing has used yet
            assert found == live.ctypes.data, field.name
            checked += 1
    assert checked > 50


def test_scalars_of_nested_structures_too_are_read_and_written_where_their_offset_says():
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


def test_the_hidden_stack_frame_lies_between_its_checked_neighbours():
    order = [name for name, _ in layout.struct("mjData")._fields_]
    at = {name: order.index(name) for name in ("pbase", *(field for _, field in STACK))}
    assert at["narena"] < at["nbuffer"] < at["pstack"] < at["pbase"] < at["maxuse_stack"]


def test_unknown_fields_and_types_are_refused():
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
    """Let the layout of one structure be the given (name, type) members."""
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
def test_a_field_that_has_moved_is_refused(struct_name, field, monkeypatch):
    members = list(layout.struct(struct_name)._fields_)
    place = [name for name, _ in members].index(field)
    _corrupt(
        monkeypatch,
        struct_name,
        [*members[:place], ("added_by_a_new_version", ctypes.c_int64), *members[place:]],
    )
    with pytest.raises(LayoutError, match="where its layout says, expected"):
        _check()


@pytest.mark.parametrize(
    ("struct_name", "field"), [case for case in CASES if not _is_pointer(*case)]
)
def test_a_scalar_that_changed_places_with_another_is_refused(struct_name, field, monkeypatch):
    members = list(layout.struct(struct_name)._fields_)
    place = [name for name, _ in members].index(field)
    most_likely = ("mjModel", f"opt.{field}") if struct_name == "mjOption" else (struct_name, field)
    for other_place, (other, kind) in enumerate(members):
        if (
            other == field
            or kind is not members[place][1]
            or other in INDISTINGUISHABLE.get(field, ())
        ):
            continue
        swapped = list(members)
        swapped[place], swapped[other_place] = (other, kind), (field, kind)
        with monkeypatch.context() as patch:
            _corrupt(patch, struct_name, swapped)
            with pytest.raises(LayoutError):
                _check(most_likely)


@pytest.mark.parametrize("owner", ["mjModel", "mjData"])
def test_nothing_is_compiled_from_a_wrong_layout(owner, monkeypatch):
    _corrupt(
        monkeypatch,
        owner,
        [("added_by_a_new_version", ctypes.c_int64), *layout.struct(owner)._fields_],
    )
    fields, name = layout.Fields(owner), "nactuator" if owner == "mjModel" else "time"

    @numba.njit
    def read(address):
        return getattr(fields, name)(address)

    with pytest.raises(LayoutError, match=f"MuJoCo {mujoco.__version__}: {owner}"):
        read.compile("float64(uintp)")
