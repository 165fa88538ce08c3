"""The plugin is registered once, at the import of the package, into a checked structure."""

import ctypes
import importlib
import subprocess
import sys

import mujoco
import pytest

import codrl_mj
from codrl_mj import plugin
from codrl_mj.actuators import Empty
from codrl_mj.engine.families import load_family
from tests.add_motors.models import Signals, Worn, arm


def test_the_plugin_is_registered_once_and_keeps_its_slot():
    slot, structure = plugin.registered_plugins()[plugin.NAME]
    count = plugin.library().mjp_pluginCount()
    plugin.register(lambda: None)
    importlib.reload(codrl_mj)
    assert plugin.library().mjp_pluginCount() == count
    assert plugin.registered_plugins()[plugin.NAME][0] == slot
    assert structure.capabilityflags == 1
    assert [structure.attributes[index] for index in range(structure.nattribute)] == [b"family"]


def test_an_import_compiles_nothing_and_a_second_copy_raises():
    """Without the check, MuJoCo would end the process."""
    code = (
        "import sys, codrl_mj; from codrl_mj import plugin; assert 'numba' not in"
        " sys.modules\nprint(list(plugin.registered_plugins())[-1])\nfor name in [name for name in"
        " sys.modules if name.startswith('codrl_mj')]: del sys.modules[name]\nimport codrl_mj"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert result.stdout.strip() == "codrl_mj.actuator"
    assert result.returncode == 1
    assert (
        "RuntimeError: MuJoCo has a plugin codrl_mj.actuator already: another copy of codrl_mj"
        in result.stderr
    )


@pytest.mark.parametrize(
    "change",
    [
        {"sdf_aabb": 1},
        {"compute": None},
        {"actuator_act_dot": None, "visualize": 1},  # as if a function had been added before them
        {"capabilityflags": 2},
        {"nattribute": 0},
        {"nattribute": 10**6},
    ],
)
def test_another_structure_raises(change):
    slot, original = plugin.registered_plugins()["mujoco.pid"]
    structure = plugin.Plugin()
    ctypes.pointer(structure)[0] = original
    plugin.check_structure({"mujoco.pid": (slot, structure)})
    for name, value in change.items():
        setattr(structure, name, value)
    for registered in ({"mujoco.pid": (slot, structure)}, {}):
        with pytest.raises(plugin.LayoutError, match=r"its plugin mujoco\.pid is not as expected"):
            plugin.check_structure(registered)


def test_a_redefined_family_replaces_the_previous_one_if_models_stay_valid():
    def family(factor, **more):
        shown = (0.0,) * len(more.get("Signals", Signals)._fields)

        def advance(parameters, timestep, state, inputs):
            return state, factor * inputs.desired_torque, shown

        return type(
            "Redefined", (Worn,), {"__module__": __name__, "advance": staticmethod(advance), **more}
        )

    spec, forces = arm(), []
    for factor in (2.0, 3.0):
        actuator = family(factor)(arm_radius=1.0)
        model = codrl_mj.add_motors(spec, {"one": actuator}).compile()
        data = mujoco.MjData(model)
        data.ctrl[:] = 0.5
        mujoco.mj_forward(model, data)
        forces.append(data.actuator_force[0])
    assert forces == [1.0, 1.5]
    with pytest.raises(
        ValueError,
        match=r"Redefined has .* states, signals and parameters, and .* when it was loaded before",
    ):
        load_family(family(2.0, Signals=Empty))
