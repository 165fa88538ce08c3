"""Actuator families, their stability and their names, in pure Python without MuJoCo."""

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
from codrl_mj.actuators.geared import Geared
from codrl_mj.actuators.ideal import IDEAL, Ideal
from codrl_mj.actuators.lag import Lag
from codrl_mj.actuators.model import (
    BUILT_IN,
    FAMILIES,
    ActuatorModel,
    Command,
    Empty,
    Family,
    Inputs,
    JointAdditions,
    UnstableError,
    family_id,
    family_name,
    import_path,
)
from codrl_mj.actuators.named import (
    NAMED,
    ActuatorSetting,
    actuator_from_mapping,
    check_same_family,
    combined_name,
    display_label,
    display_name,
    find_family,
    identified_ranges,
    is_family,
    mapping_of,
    named_mapping,
    override_actuator,
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
from codrl_mj.actuators.pwm_loop import PwmLoop
from codrl_mj.actuators.pwm_servo import PwmServo
from codrl_mj.actuators.sampled_loop import SampledLoop
from codrl_mj.actuators.servo import Servo, ServoLoop
from codrl_mj.actuators.servo_friction import ServoFriction
from codrl_mj.actuators.shared_drive import (
    SharedDrive,
    SharedSupply,
    SharedVoltageDrive,
    check_supplies,
)
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
    "ActuatorSetting",
    "Command",
    "CurrentLoop",
    "Drive",
    "Family",
    "GearMotor",
    "Geared",
    "Ideal",
    "Inputs",
    "JointAdditions",
    "Lag",
    "Motor",
    "Empty",
    "PwmLoop",
    "PwmServo",
    "SampledLoop",
    "Servo",
    "ServoFriction",
    "ServoLoop",
    "SharedDrive",
    "SharedSupply",
    "SharedVoltageDrive",
    "Supply",
    "TorqueSpeed",
    "UnstableError",
    "VoltageDrive",
    "VoltageDriven",
    "actuator_from_mapping",
    "override_actuator",
    "check_same_family",
    "check_stable",
    "check_supplies",
    "electrical_step",
    "family_name",
    "family_id",
    "field_paths",
    "field_values",
    "choices_of",
    "find_family",
    "identified_ranges",
    "is_family",
    "display_label",
    "set_display_name",
    "mapping_of",
    "display_name",
    "named_mapping",
    "combined_name",
    "parameter_paths",
    "parameters_type",
    "import_path",
    "resolve",
    "spectral_radii",
    "spectral_radius",
    "allow_imports",
    "from_array",
]
