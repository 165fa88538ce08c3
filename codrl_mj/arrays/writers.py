"""Motors in the notation of other simulators: `write_motor`.

Three simulators know a motor as a torque source under a torque-speed line: mjlab, Isaac Lab and
Newton. MuJoCo's `<dcmotor>` and BAM know a winding without inductance or a loop. Each text comes
with its losses, which `written_losses.py` computes.
"""

import json
from collections.abc import Callable
from typing import Literal, NamedTuple

from codrl_mj.actuators import ActuatorModel, Drive, JointAdditions, TorqueSpeed
from codrl_mj.arrays.c_code import c_function
from codrl_mj.arrays.written_losses import LostField, WrittenComparison, compare, lost_fields
from codrl_mj.arrays.written_models import (
    bam_parameters,
    dcmotor_element,
    format_number,
    torque_speed_line,
    winding_of,
    written_additions,
)

Target = Literal["c", "mjlab", "isaaclab", "newton", "dcmotor", "bam"]
"""Notation: C, a configuration of mjlab or Isaac Lab, a function for Newton's model builder,
MuJoCo's `<dcmotor>`, or the parameters of BAM (Better Actuator Models).
"""


class WrittenMotor(NamedTuple):
    """Motor in the notation of another simulator, and what the notation cannot say."""

    target: Target
    """The notation."""
    text: str
    """The motor: lines of Python, XML, JSON or C."""
    slides: bool
    """True if the joint is a slide, so that forces [N] and speeds [m/s] are written."""
    lost: tuple[LostField, ...]
    """Fields of the motor that have no place in the notation."""
    comparison: WrittenComparison | None
    """Differences in torque and motion; None for C, which computes the same."""


class _Joint(NamedTuple):
    """Joint of a written motor."""

    name: str
    """Name, or pattern of names."""
    additions: JointAdditions
    """Quantities that the motor adds to the joint."""
    force_unit: str
    speed_unit: str


def write_motor(actuator: ActuatorModel, target: Target, joint: str | None = None) -> WrittenMotor:
    """Write a motor in the notation of another simulator.

        >>> from codrl_mj.actuators import TorqueSpeed
        >>> written = write_motor(TorqueSpeed(stall_torque=2.0, no_load_speed=30.0), "mjlab")
        >>> "saturation_effort=2.0," in written.text
        True

    Args:
        actuator: a `Drive`, or a `TorqueSpeed`, which has no winding. C takes every family.
        target: the notation.
        joint: regular expression of the joints' names for mjlab, Isaac Lab and Newton, by default
            all; name of the joint for MuJoCo, by default `joint`; not used for BAM and C.

    Raises:
        ValueError: the notation is unknown or not for this family, or a number that it needs is
            missing; the message names it.
    """
    if target == "c":
        return WrittenMotor(target, c_function(actuator), False, (), None)
    writers: dict[str, Callable[[ActuatorModel, _Joint], str]] = {
        "mjlab": _mjlab,
        "isaaclab": _isaaclab,
        "newton": _newton,
        "dcmotor": _dcmotor,
        "bam": _bam,
    }
    if target not in writers:
        raise ValueError(f"target = {target!r}: must be one of {', '.join(['c', *writers])}")
    if not isinstance(actuator, Drive | TorqueSpeed):
        raise ValueError(
            f"actuator = {type(actuator).__name__}: cannot be written for {target}; pass a Drive or"
            " a TorqueSpeed, or write it as c"
        )
    # The arm is 1 on a hinge, so another one means a slide.
    slides = isinstance(actuator, Drive) and actuator.motor.arm_radius != 1.0
    units = ("N", "m/s") if slides else ("N*m", "rad/s")
    name = joint or ("joint" if target == "dcmotor" else ".*")
    text = writers[target](actuator, _Joint(name, written_additions(actuator), *units))
    lost = lost_fields(actuator, target) if isinstance(actuator, Drive) else ()
    return WrittenMotor(target, text, slides, lost, compare(actuator, target))


def _line_numbers(actuator: ActuatorModel) -> tuple[str, str, str]:
    """Return stall torque, no-load speed and largest torque of the line at the joint."""
    line = torque_speed_line(actuator)
    limit = min(line.max_torque, line.stall_torque)
    return format_number(line.stall_torque), format_number(line.no_load_speed), format_number(limit)


def _mjlab(actuator: ActuatorModel, joint: _Joint) -> str:
    stall, speed, limit = _line_numbers(actuator)
    return f"""\
from mjlab.actuator import DcMotorActuatorCfg

# At the joint, in {joint.force_unit} and {joint.speed_unit}. With gains of 0, the command is the \
effort target.
ACTUATOR = DcMotorActuatorCfg(
    target_names_expr=({json.dumps(joint.name)},),
    stiffness=0.0,
    damping=0.0,
    saturation_effort={stall},
    velocity_limit={speed},
    effort_limit={limit},
    armature={format_number(joint.additions.armature)},
    frictionloss={format_number(joint.additions.friction)},
    viscous_damping={format_number(joint.additions.damping)},
)
"""


def _isaaclab(actuator: ActuatorModel, joint: _Joint) -> str:
    stall, speed, limit = _line_numbers(actuator)
    friction = format_number(joint.additions.friction)
    return f"""\
from isaaclab.actuators import DCMotorCfg

# At the joint, in {joint.force_unit} and {joint.speed_unit}. With gains of 0, the command is the \
effort target.
# Isaac Lab 2 calls the limits velocity_limit and effort_limit.
ACTUATOR = DCMotorCfg(
    joint_names_expr=[{json.dumps(joint.name)}],
    stiffness=0.0,
    damping=0.0,
    saturation_effort={stall},
    actuator_velocity_limit={speed},
    actuator_effort_limit={limit},
    armature={format_number(joint.additions.armature)},
    friction={friction},
    dynamic_friction={friction},
    viscous_friction={format_number(joint.additions.damping)},
)
"""


def _newton(actuator: ActuatorModel, joint: _Joint) -> str:
    stall, speed, limit = _line_numbers(actuator)
    return f"""\
import re

from newton.actuators import ClampingDCMotor, DrivePD

# At the joint, in {joint.force_unit} and {joint.speed_unit}.
LINE = {{
    "saturation_effort": {stall},
    "velocity_limit": {speed},
    "max_motor_effort": {limit},
}}


def add_motors(builder):
    \"\"\"Add motors to joints of a ModelBuilder; their command is the feedforward effort.\"\"\"
    for joint, label in enumerate(builder.joint_label):
        if re.fullmatch({json.dumps(joint.name)}, label.rpartition("/")[2]):
            dof, position = builder.joint_qd_start[joint], builder.joint_q_start[joint]
            builder.add_actuator(
                DrivePD, dof, [(ClampingDCMotor, LINE)], pos_index=position, kp=0.0, kd=0.0
            )
            builder.joint_armature[dof] += {format_number(joint.additions.armature)}
            builder.joint_friction[dof] += {format_number(joint.additions.friction)}
            builder.joint_damping[dof] += {format_number(joint.additions.damping)}
"""


def _dcmotor(actuator: ActuatorModel, joint: _Joint) -> str:
    winding = winding_of(actuator, "dcmotor")
    additions = joint.additions
    volts = format_number(winding.volts_per_force)
    back_emf = format_number(winding.volts_per_speed)
    return f"""\
<!-- Add to the joint: armature="{format_number(additions.armature)}" \
damping="{format_number(additions.damping)}" frictionloss="{format_number(additions.friction)}".
     The control is a voltage [V]. For a torque t [{joint.force_unit}] at a joint speed w \
[{joint.speed_unit}]:
     {volts} * t + {back_emf} * w. -->
<actuator>
  {dcmotor_element(actuator, joint.name)}
</actuator>
"""


def _bam(actuator: ActuatorModel, joint: _Joint) -> str:
    del joint  # BAM's file describes a motor; the joint is named where it is used.
    rounded = {
        name: value if isinstance(value, str) else float(format_number(value))
        for name, value in bam_parameters(actuator).items()
    }
    return json.dumps(rounded, indent=4) + "\n"
