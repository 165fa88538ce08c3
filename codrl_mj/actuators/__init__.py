"""Actuators as mathematics: what one is, the families of them, stability, names. No MuJoCo."""

from codrl_mj.actuators.current_loop import (
    CurrentLoop,
    DCMotorActuator,
    Motor,
    Supply,
    VoltageDriven,
    electrical_step,
)
from codrl_mj.actuators.drive import Drive, VoltageDrive
from codrl_mj.actuators.gear_motor import GearMotor
from codrl_mj.actuators.ideal import IDEAL, Ideal
from codrl_mj.actuators.lag import Lag
from codrl_mj.actuators.model import (
    BUILT_IN,
    FAMILIES,
    ActuatorModel,
    Command,
    Family,
    Inputs,
    JointAdditions,
    Nothing,
    UnstableError,
    family_name,
    family_number,
    reference,
)
from codrl_mj.actuators.named import (
    NAMED,
    actuator_from_mapping,
    actuator_over,
    check_same_family,
    find_family,
    identified_ranges,
    is_family,
    label_of,
    mapping_of,
    name_of,
    named_mapping,
    names_together,
    resolve,
    set_display_name,
)
from codrl_mj.actuators.parameters import (
    choices_of,
    field_paths,
    field_values,
    from_array,
    parameter_paths,
    parameters_type,
)
from codrl_mj.actuators.sampled_loop import SampledLoop
from codrl_mj.actuators.servo import Servo, ServoLoop
from codrl_mj.actuators.stability import check_stable, spectral_radii, spectral_radius
from codrl_mj.actuators.torque_speed import TorqueSpeed
from codrl_mj.user_code import allow_imports

__all__ = [
    "BUILT_IN",
    "FAMILIES",
    "IDEAL",
    "NAMED",
    "DCMotorActuator",
    "ActuatorModel",
    "Command",
    "CurrentLoop",
    "Drive",
    "Family",
    "GearMotor",
    "Ideal",
    "Inputs",
    "JointAdditions",
    "Lag",
    "Motor",
    "Nothing",
    "SampledLoop",
    "Servo",
    "ServoLoop",
    "Supply",
    "TorqueSpeed",
    "UnstableError",
    "VoltageDrive",
    "VoltageDriven",
    "actuator_from_mapping",
    "actuator_over",
    "check_same_family",
    "check_stable",
    "electrical_step",
    "family_name",
    "family_number",
    "field_paths",
    "field_values",
    "choices_of",
    "find_family",
    "identified_ranges",
    "is_family",
    "label_of",
    "set_display_name",
    "mapping_of",
    "name_of",
    "named_mapping",
    "names_together",
    "parameter_paths",
    "parameters_type",
    "reference",
    "resolve",
    "spectral_radii",
    "spectral_radius",
    "allow_imports",
    "from_array",
]
