"""Steps of motors in plain Python, as the engine makes them: those of a supply together."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, cast

import numpy as np
from numba.core.dispatcher import Dispatcher

from codrl_mj.actuators import BUILT_IN, ActuatorModel, Inputs, SharedDrive
from codrl_mj.actuators import shared_drive as equations
from codrl_mj.actuators.model import FamilyTuple
from codrl_mj.actuators.parameters import Parameters
from codrl_mj.actuators.shaft import StepAverages
from codrl_mj.engine import supplies

Advanced = tuple[FamilyTuple, float, FamilyTuple]
"""State after a step, torque [N*m] at the rotor, and signals, as `advance` returns them."""


class SharingMotor(NamedTuple):
    """Drive of a shared supply before a step."""

    parameters: Parameters
    state: FamilyTuple
    inputs: Inputs
    closed: bool
    """True if a current loop is closed around the winding."""


def advance_in_python(
    actuators: Mapping[int, ActuatorModel],
    parameters: Mapping[int, Parameters],
    timestep: float,
    states: Mapping[int, FamilyTuple],
    inputs: Mapping[int, Inputs],
) -> dict[int, Advanced]:
    """Advance actuators by a step [s]; all mappings are by the actuator's index in the model."""
    advanced, drives_on = {}, dict[float, dict[int, SharedDrive]]()
    for index, actuator in actuators.items():
        # A custom family that derives from it has its own `advance`, which the engine calls.
        if isinstance(actuator, SharedDrive) and type(actuator) in BUILT_IN:
            drives_on.setdefault(parameters[index].supply_number, {})[index] = actuator
        else:
            arguments = parameters[index], timestep, states[index], inputs[index]
            advanced[index] = actuator.advance(*arguments)
    for drives in drives_on.values():
        sharing = [
            SharingMotor(parameters[index], states[index], inputs[index], drive.CLOSED)
            for index, drive in drives.items()
        ]
        advanced |= dict(zip(drives, advance_supply(sharing, timestep), strict=True))
    return advanced


def advance_supply(motors: Sequence[SharingMotor], timestep: float) -> list[Advanced]:
    """Advance the drives of a supply by a step [s], sample by sample."""
    supply = motors[0].parameters
    started = [
        equations.begin_step(
            motor.parameters,
            timestep,
            motor.state,
            motor.inputs,
            motor.closed,
            supply.sample_rate,
        )
        for motor in motors
    ]
    steps, pieces, sampled = (list(parts) for parts in zip(*started, strict=True))
    averages = [StepAverages(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)] * len(motors)
    samples = max(int(timestep * supply.sample_rate + 0.5), 1)
    volts, amperes = 0.0, 0.0
    for _ in range(samples):
        requests = [
            equations.request_voltage(
                motor.parameters, steps[n], pieces[n], sampled[n], motor.closed
            )
            for n, motor in enumerate(motors)
        ]
        currents = [motor.current for motor in sampled]
        voltage = _voltage(supply, [requested for _, requested in requests], currents)
        supplied = 0.0
        for n, motor in enumerate(motors):
            pieces[n], sampled[n], averages[n], current = equations.advance_sample(
                *(motor.parameters, timestep, steps[n], pieces[n], sampled[n], averages[n]),
                *(*requests[n], voltage, motor.closed),
            )
            supplied += current
        volts, amperes = volts + voltage, amperes + equations.source_current(supply, supplied)
    return [
        equations.end_step(
            *(motor.parameters, timestep, motor.state, motor.inputs, steps[n], sampled[n]),
            *(averages[n], motor.closed, volts / samples, amperes / samples),
        )
        for n, motor in enumerate(motors)
    ]


def _voltage(supply: Parameters, requested: Sequence[float], currents: Sequence[float]) -> float:
    """Return the voltage [V] of a supply at a sample."""
    work = np.zeros((len(currents), supplies.WORK_SIZE))
    work[:, supplies.REQUESTED], work[:, supplies.CURRENT] = requested, currents
    voltage: float = cast(Dispatcher, supplies.bus_voltage).py_func(
        *(work.ravel(), supplies.WORK_SIZE, len(currents)),
        *(supply.supply_voltage, supply.supply_resistance, supply.supply_recharges != 0.0),
    )
    return voltage
