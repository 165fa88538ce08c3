"""Motors on paper: what a drive can do, its current loop's gains and margins, and its step responses."""

from codrl_mj.motor_design.drives import Abilities, abilities, find_drive, find_entry, torque_limits
from codrl_mj.motor_design.loop import (
    LoopDesign,
    Looped,
    Response,
    closed_loop,
    design,
    designs,
    gains,
    is_closed,
    open_loop,
    respond,
    sampled_too_seldom,
    small_step,
)
from codrl_mj.motor_design.overview import catalogue_rows, explain, unknown_in_words
from codrl_mj.motor_design.windup import Recovery, Steps, step

__all__ = [
    "catalogue_rows",
    "explain",
    "unknown_in_words",
    "find_drive",
    "find_entry",
    "Abilities",
    "abilities",
    "torque_limits",
    "LoopDesign",
    "Looped",
    "is_closed",
    "design",
    "designs",
    "gains",
    "sampled_too_seldom",
    "open_loop",
    "closed_loop",
    "Response",
    "respond",
    "small_step",
    "Steps",
    "Recovery",
    "step",
]
