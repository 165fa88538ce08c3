"""Off-the-shelf motors: printed datasheets, the parameters derived from them, and a catalogue."""

from codrl_mj.catalogue.datasheet import (
    Datasheet,
    MotorEntry,
    from_datasheet,
    joint_names,
    motor_entry,
    motor_names,
    new_motor,
)
from codrl_mj.catalogue.derivation import IncompleteError, MotorParameters, TorqueSpeedLine
from codrl_mj.catalogue.relations import Disagreement

__all__ = [
    "Datasheet",
    "from_datasheet",
    "MotorParameters",
    "Disagreement",
    "IncompleteError",
    "TorqueSpeedLine",
    "MotorEntry",
    "motor_entry",
    "motor_names",
    "joint_names",
    "new_motor",
]
