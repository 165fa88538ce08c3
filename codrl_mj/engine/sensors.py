"""What actuators' sensors say, compiled: `ActuatorModel.observe` on raw parameters and signals."""

import functools
from typing import Any

from numba import types

from codrl_mj.actuators import Family, Inputs, parameters_type
from codrl_mj.engine.families import HEAD, compiled_function
from codrl_mj.engine.layout import offset
from codrl_mj.engine.memory import array, i64, internal, read, tuple_of, write


@functools.cache
def compiled_observe(family: Family) -> Any:
    """(parameters, signals, timestep, time, key, seen) -> nothing: writes what the sensors say.

    Vectors go by their addresses.
    """
    parameters_of, signals_of = parameters_type(family), family.Signals
    kinds = tuple_of(parameters_of), types.float64, tuple_of(signals_of), tuple_of(Inputs)
    observe = compiled_function(family.observe, family.OBSERVED, f"{family.__name__}.OBSERVED", *kinds)

    @internal
    def fill(parameters: int, shown: int, timestep: float, time: float, key: float, seen: int) -> None:
        inputs = Inputs(0.0, 0.0, 0.0, time, key)
        write(observe(read(parameters, parameters_of), timestep, read(shown, signals_of), inputs), seen)

    return fill


@functools.cache
def compiled_parameters() -> Any:
    """(model, actuator) -> address of the parameters of one of a model's actuators, in its user data."""
    user_at, width_at = offset("mjModel", "actuator_user"), offset("mjModel", "nuser_actuator")

    @internal
    def parameters(model: int, actuator: int) -> int:
        return array(model, user_at) + 8 * (actuator * i64(model + width_at)[0] + HEAD)

    return parameters
