"""What both doors read of a model, compiled: an actuator's numbers, and what the engine makes of its control."""

import mujoco

from codrl_mj.engine.layout import DATA, MODEL
from codrl_mj.engine.memory import at, internal

_NO_CLAMP, _GROUPS, _LARGEST = int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL), mujoco.mjNGROUP, mujoco.mjMAXVAL


@internal(inline="always")
def user_of(model: int, actuator: int) -> int:
    """Address of an actuator's `user` data."""
    return at(MODEL.actuator_user(model), actuator * MODEL.nuser_actuator(model))


@internal(inline="always")
def clip(value: float, low: float, high: float) -> float:
    """MuJoCo's `mju_clip`, which keeps what is no number."""
    return low if value < low else high if value > high else value


@internal(inline="always")
def _clamped(model: int, data: int, control: int) -> float:
    value = DATA.ctrl(data)[control]
    if MODEL.actuator_ctrllimited(model)[control] and not MODEL.opt.disableflags(model) & _NO_CLAMP:
        limits = MODEL.actuator_ctrlrange(model)
        return clip(value, limits[2 * control], limits[2 * control + 1])
    return value


@internal(inline="always")
def command(model: int, data: int, actuator: int) -> float:
    """The control that an actuator acts on: clamped where it is limited; zero if any control is bad."""
    for control in range(MODEL.nu(model)):
        if not abs(_clamped(model, data, control)) <= _LARGEST:
            return 0.0
    return _clamped(model, data, MODEL.actuator_ctrladr(model)[actuator])


@internal(inline="always")
def is_disabled(model: int, actuator: int) -> bool:
    """Whether an actuator's group is switched off."""
    group = MODEL.actuator_group(model)[actuator]
    return 0 <= group < _GROUPS and (MODEL.opt.disableactuator(model) >> group) & 1 == 1
