"""Result of the identification of a position servo, and the actuator that it becomes."""

import dataclasses
import math

from codrl_mj.actuators import ActuatorModel, actuator_from_mapping
from codrl_mj.identify.result import MAX_UNEXPLAINED, USABLE, Identified

_NEEDED = (
    *("position_gain", "stall_torque", "duty_gain", "damping", "armature"),
    *("coulomb_friction", "command_delay"),
)
"""Parameters without which a servo is not an actuator."""
_ASSUMED_VOLTAGE = 12.0
"""Supply voltage [V] of an actuator without a logged one; it only scales kT and R."""
_MAX_WAITING = 7.0
"""Largest number of command periods that a command of the family `pwm_servo` may be late."""
_TIME_CONSTANT = 1e-5
"""Time constant of the winding [s], which commands and positions do not show."""


@dataclasses.dataclass(frozen=True)
class IdentifiedServo(Identified):
    """A position servo that was identified from its commands and positions."""

    is_scaled: bool = True
    """True if torques are in N*m; False if only their ratios to the inertia are known."""
    gain: float | None = None
    """Register that the position gain refers to; None: none was logged."""
    limits_torque: bool = False
    """True if the stall torque limits the torque after the damping, as a current loop does."""
    step: float = 0.005
    """Median time between two commands [s]."""

    def problem(self) -> str | None:
        """Return the reason why no actuator can be made, with a remedy; None if it can."""
        if self.unexplained > MAX_UNEXPLAINED:
            return super().problem()
        if not self.is_scaled:
            return (
                "without a known load, only ratios to the moving inertia can be told. Hang up a"
                " pendulum and give --known mass=VALUE length=VALUE, or give --known"
                " armature=VALUE or stall_torque=VALUE"
            )
        by_name = {estimate.name: estimate for estimate in self.estimates}
        if self.limits_torque:
            return (
                "the limit acts on the torque, as that of a current loop does, and not on the"
                " duty: the family pwm_servo has no such limit. In MuJoCo, use"
                f" {self.position_element()}"
            )
        lacking = [name for name in _NEEDED if name not in by_name]
        if lacking == ["armature"] and "inertia" in by_name:
            return (
                "the logs show the total inertia, which includes that of the load: give --known"
                " load_inertia=VALUE"
            )
        unusable = [
            by_name[name]
            for name in _NEEDED
            if name in by_name and by_name[name].status not in USABLE
        ]
        if unusable:
            texts = [
                f"{estimate.name} is {estimate.status}: {estimate.why}" for estimate in unusable
            ]
            names = " ".join(
                f"{estimate.name}=VALUE" for estimate in unusable if estimate.name != "duty_gain"
            )
            return f"{'; '.join(texts)}. Give --known {names}"
        if lacking:
            return f"{', '.join(lacking)}: the logs do not determine them"
        return None

    def position_element(self) -> str:
        """Return MuJoCo's `<position>` and the attributes of its joint, with these torques."""
        values = {estimate.name: estimate.value for estimate in self.estimates}
        viscous = values.get("viscous_friction", 0.0)
        return (
            f'<position kp="{values["position_gain"]:.4g}"'
            f' kv="{max(values["damping"] - viscous, 0.0):.4g}"'
            f' forcerange="{-values["stall_torque"]:.4g} {values["stall_torque"]:.4g}"/> at a joint'
            f' with damping="{viscous:.4g}", frictionloss="{values["coulomb_friction"]:.4g}" and'
            f' armature="{values.get("armature", 0.0):.4g}"'
        )

    @property
    def supply_text(self) -> str | None:
        """Text on the supply and the register that the torques refer to."""
        register = "" if self.gain is None else f"position_gain holds at gain = {self.gain:g}"
        if self.supply is None:
            return register or None
        volts = f"torques hold at a supply of {self.supply:.4g} V"
        return f"{volts}, {register}" if register else volts

    @property
    def base_text(self) -> None:
        """None: a servo takes no parameters from a datasheet."""
        return None

    def _motor(self) -> dict[str, float]:
        """Return a motor at the output with the identified torques.

        Commands and positions show kT/R and kT*kE/R + viscous friction. If R is not known, there is
        no viscous friction, and kE = kT: other values move in the same way.
        """
        values = {estimate.name: estimate.value for estimate in self.estimates}
        volts = self.supply or _ASSUMED_VOLTAGE
        stall, damping = values["stall_torque"], values["damping"]
        viscous = values.get("viscous_friction", 0.0)
        constant = values.get("torque_constant", max(damping - viscous, 1e-9) * volts / stall)
        resistance = constant * volts / stall
        motor = {
            "resistance": resistance,
            "inductance": _TIME_CONSTANT * resistance,
            "torque_constant": constant,
            "back_emf_constant": max(damping - viscous, 0.0) * resistance / constant,
            "rotor_inertia": values["armature"],
            "coulomb_friction": values["coulomb_friction"],
            "viscous_friction": viscous,
        }
        extra = ("gear_efficiency", "stribeck_friction", "stribeck_speed")
        return motor | {name: values[name] for name in extra if name in values}

    def mapping(self) -> dict[str, object]:
        """Return the servo as a mapping of the family `pwm_servo`.

        Raises:
            ValueError: a parameter is not known; the message names it.
        """
        problem = self.problem()
        if problem is not None:
            raise ValueError(problem)
        values = {estimate.name: estimate.value for estimate in self.estimates}
        delay = max(values["command_delay"], 0.0)
        rate = float(f"{1.0 / self.step:.6g}")
        if delay > 0.0:
            rate = min(rate, math.floor(_MAX_WAITING / delay))
        loop = {
            "position_gain": values["duty_gain"],
            "command_delay": delay,
            "command_rate": rate,
        }
        if "max_velocity" in values:
            loop["max_velocity"] = values["max_velocity"]
        return {
            "family": "pwm_servo",
            "motor": self._motor(),
            "loop": loop,
            "supply": {"voltage": self.supply or _ASSUMED_VOLTAGE},
        }

    def actuator(self) -> ActuatorModel:  # type: ignore[override]
        """Return the servo as an actuator of the family `pwm_servo`."""
        return actuator_from_mapping(self.mapping())

    def intervals(self) -> dict[str, tuple[float, float]]:
        """Return the intervals of the usable parameters, by field of the actuator."""
        fields = {
            "coulomb_friction": "motor.coulomb_friction",
            "armature": "motor.rotor_inertia",
            "duty_gain": "loop.position_gain",
            "command_delay": "loop.command_delay",
        }
        return {
            fields[estimate.name]: (max(estimate.low, 0.0), estimate.high)
            for estimate in self.estimates
            if estimate.name in fields
            and estimate.status in USABLE
            and estimate.low < estimate.high
        }
