"""What the engine makes of the controls before an actuator sees them, for actuators that it leaves to us. Compiled."""

import functools
from typing import Any, NamedTuple

import mujoco

from codrl_mj.engine.layout import offset
from codrl_mj.engine.memory import array, f64, i32, i64, internal, u8

COMMAND_MODEL_FIELDS = (
    "nu",
    "opt.disableflags",
    "opt.disableactuator",
    "actuator_ctrladr",
    "actuator_group",
    "actuator_ctrllimited",
    "actuator_ctrlrange",
)
COMMAND_DATA_FIELDS = ("ctrl",)


class Commands(NamedTuple):
    """Functions for compiled code."""

    command: Any
    """(model, data, actuator) -> the control that it acts on."""
    is_disabled: Any
    """(model, actuator) -> whether its group is switched off."""


@internal(inline="always")
def clip(value: float, low: float, high: float) -> float:
    """MuJoCo's `mju_clip`, which keeps what is no number."""
    return low if value < low else high if value > high else value


@functools.cache
def commands() -> Commands:
    """The functions; the layout of the fields above must have been checked."""
    model_at = {field: offset("mjModel", field) for field in COMMAND_MODEL_FIELDS}
    nu_at, ctrladr_at, group_at = model_at["nu"], model_at["actuator_ctrladr"], model_at["actuator_group"]
    disableflags_at, disableactuator_at = model_at["opt.disableflags"], model_at["opt.disableactuator"]
    ctrllimited_at, ctrlrange_at = model_at["actuator_ctrllimited"], model_at["actuator_ctrlrange"]
    ctrl_at = offset("mjData", "ctrl")
    no_clamp, groups, largest = int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL), mujoco.mjNGROUP, mujoco.mjMAXVAL

    @internal(inline="always")
    def clamped(model: int, data: int, control: int) -> float:
        value = f64(array(data, ctrl_at))[control]
        if u8(array(model, ctrllimited_at))[control] and not i32(model + disableflags_at)[0] & no_clamp:
            limits = f64(array(model, ctrlrange_at))
            return clip(value, limits[2 * control], limits[2 * control + 1])
        return value

    @internal(inline="always")
    def command(model: int, data: int, actuator: int) -> float:
        """Clamped where it is limited; then zero if any control is bad."""
        for control in range(i64(model + nu_at)[0]):
            if not abs(clamped(model, data, control)) <= largest:
                return 0.0
        return clamped(model, data, i32(array(model, ctrladr_at))[actuator])

    @internal(inline="always")
    def is_disabled(model: int, actuator: int) -> bool:
        group = i32(array(model, group_at))[actuator]
        return 0 <= group < groups and (i32(model + disableactuator_at)[0] >> group) & 1 == 1

    return Commands(command, is_disabled)
