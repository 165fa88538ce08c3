"""The actuator as mathematics: parameters, one step of the current loop, stability, named actuators. No MuJoCo."""

from codrl_mj.motor.catalog import NAMED, actuator_over, named_actuator, resolve
from codrl_mj.motor.current_loop import advance, advance_imperfect, electrical_step
from codrl_mj.motor.parameters import Actuator, CurrentLoop, Motor, from_vector, to_vector
from codrl_mj.motor.stability import check_stable, closed_loop_matrix, spectral_radii, spectral_radius

__all__ = [
    "NAMED",
    "Actuator",
    "CurrentLoop",
    "Motor",
    "actuator_over",
    "advance",
    "advance_imperfect",
    "check_stable",
    "closed_loop_matrix",
    "electrical_step",
    "from_vector",
    "named_actuator",
    "resolve",
    "spectral_radii",
    "spectral_radius",
    "to_vector",
]
