"""Can this motor, with this gear and supply, do that task? Answered before training; docs/motor_methods.md."""

from codrl_mj.sizing.bounds import HOPELESS, SURELY, SURELY_NOT, TRY_IT, Bound, Feasibility, feasibility
from codrl_mj.sizing.choice import Candidate, Catalogued, actuators_of, catalogued, choose, geared
from codrl_mj.sizing.demand import Demand, demand_of, demands_of, recorded
from codrl_mj.sizing.operation import Operation, best_ratio, operation
from codrl_mj.sizing.swing import Swing, least_gain, least_pumped, least_voltage

__all__ = [
    "Demand",
    "demand_of",
    "demands_of",
    "recorded",
    "Bound",
    "Feasibility",
    "feasibility",
    "SURELY",
    "SURELY_NOT",
    "HOPELESS",
    "TRY_IT",
    "Candidate",
    "choose",
    "geared",
    "actuators_of",
    "Catalogued",
    "catalogued",
    "Operation",
    "operation",
    "best_ratio",
    "Swing",
    "least_gain",
    "least_pumped",
    "least_voltage",
]
