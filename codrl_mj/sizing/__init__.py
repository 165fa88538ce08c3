"""Sizing of drives: limits, current loops, demands of tasks and choice of a motor."""

import importlib

# This function has the name of its module, whose first import would replace a name that is looked
# up on first use.
from codrl_mj.sizing.feasibility import feasibility as feasibility

_PUBLIC = {
    "find_drive": "codrl_mj.sizing.limits",
    "find_entry": "codrl_mj.sizing.limits",
    "find_loop": "codrl_mj.sizing.limits",
    "DriveLimits": "codrl_mj.sizing.limits",
    "drive_limits": "codrl_mj.sizing.limits",
    "torque_limits": "codrl_mj.sizing.limits",
    "catalogue_rows": "codrl_mj.sizing.limits",
    "describe_motor": "codrl_mj.sizing.limits",
    "describe_unknown": "codrl_mj.sizing.limits",
    "CurrentLoopActuator": "codrl_mj.sizing.loop",
    "is_closed": "codrl_mj.sizing.loop",
    "loop_gains": "codrl_mj.sizing.loop",
    "LoopAnalysis": "codrl_mj.sizing.loop",
    "analyze_loop": "codrl_mj.sizing.loop",
    "analyze_sample_rates": "codrl_mj.sizing.loop",
    "undersampling_warning": "codrl_mj.sizing.loop",
    "open_loop": "codrl_mj.sizing.loop",
    "closed_loop": "codrl_mj.sizing.loop",
    "Response": "codrl_mj.sizing.loop",
    "simulate_loop": "codrl_mj.sizing.loop",
    "small_step_response": "codrl_mj.sizing.loop",
    "StepResponses": "codrl_mj.sizing.loop",
    "step_responses": "codrl_mj.sizing.loop",
    "Demand": "codrl_mj.sizing.joint_demand",
    "demand_of": "codrl_mj.sizing.demand",
    "demands_of": "codrl_mj.sizing.demand",
    "demand_from_arrays": "codrl_mj.sizing.joint_demand",
    "OperatingPoints": "codrl_mj.sizing.feasibility",
    "operating_points": "codrl_mj.sizing.feasibility",
    "best_ratio": "codrl_mj.sizing.feasibility",
    "Bound": "codrl_mj.sizing.feasibility",
    "Feasibility": "codrl_mj.sizing.feasibility",
    "feasibility": "codrl_mj.sizing.feasibility",
    "SURELY": "codrl_mj.sizing.feasibility",
    "DEPENDS": "codrl_mj.sizing.feasibility",
    "SURELY_NOT": "codrl_mj.sizing.feasibility",
    "HOPELESS": "codrl_mj.sizing.feasibility",
    "TRY_IT": "codrl_mj.sizing.feasibility",
    "Candidate": "codrl_mj.sizing.choice",
    "choose": "codrl_mj.sizing.choice",
    "with_best_gear": "codrl_mj.sizing.choice",
    "equivalent_gears": "codrl_mj.sizing.choice",
    "ignored_quantities": "codrl_mj.sizing.choice",
    "actuators_of": "codrl_mj.sizing.choice",
    "ServoResponse": "codrl_mj.sizing.servo_response",
    "ServoTrace": "codrl_mj.sizing.servo_response",
    "analyze_servo": "codrl_mj.sizing.servo_response",
    "find_servo": "codrl_mj.sizing.servo_response",
    "Swing": "codrl_mj.sizing.swing",
    "min_energy_gain": "codrl_mj.sizing.swing",
    "min_pumped_energy": "codrl_mj.sizing.swing",
    "min_supply_voltage": "codrl_mj.sizing.swing",
}
"""Public names -> their modules, which are imported on first use: some need an environment."""

__all__ = [*_PUBLIC]


def __getattr__(name: str) -> object:
    """Import a public name on first use."""
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'codrl_mj.sizing' has no attribute {name!r}")
