"""Off-the-shelf motors: printed datasheets, the parameters derived from them, and a catalogue."""

from codrl_mj.catalogue.datasheet import (
    Datasheet,
    MotorEntry,
    from_datasheet,
    motor_entry,
    motor_names,
    new_motor,
)
from codrl_mj.catalogue.derivation import Disagreement, MotorParameters

__all__ = [
    "Datasheet",
    "from_datasheet",
    "MotorParameters",
    "Disagreement",
    "MotorEntry",
    "motor_entry",
    "motor_names",
    "new_motor",
]
