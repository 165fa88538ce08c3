"""Actuators of any family inside the engine, callback and all, beside the same functions in plain Python.

A function of floats has one result, whoever compiled it: `compiled_checks` has a tolerance of no bit.
"""

import copy
import dataclasses
import math
from collections.abc import Iterator, Mapping

import mujoco
import numpy as np

from codrl_mj.actuators import (
    FAMILIES,
    Actuator,
    ActuatorModel,
    Drive,
    Family,
    GearMotor,
    Ideal,
    Inputs,
    Lag,
    SampledLoop,
    Supply,
    TorqueSpeed,
    parameters_type,
)
from codrl_mj.engine import load_family
from codrl_mj.engine.families import SLOT, Slot, slot_size
from codrl_mj.engine.inertia import shaft_inertia
from codrl_mj.engine.reading import slots
from codrl_mj.validation.execution import UNIT, commands, differing
from codrl_mj.validation.rotors import EVERY_FEATURE, SWINGING, motors_on
from codrl_mj.validation.table import Case, Check, Oracle, check

KEY = Slot._fields.index("noise_key")


def entries(actuator: ActuatorModel) -> tuple[str, ...]:
    """What `beside` compares, by name: states and signals after a step, and the torque that the engine took from it."""
    return (*actuator.State._fields, *actuator.Signals._fields, "torque")  # type: ignore[attr-defined]


def beside(
    model: mujoco.MjModel, actuators: Mapping[int, ActuatorModel], controls: np.ndarray
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Run a model from rest, and each actuator in Python under the inputs that the engine had for it.

    The actuators in Python, by index in the model, start at rest and are never corrected. At the plugin's door the
    desired force is what the engine made of the model's actuator; at the callback's it is the control itself, of shape
    (steps, nu). By index: what was found in the engine and in Python, of shape (steps, k), columns as in `entries`.
    """
    data = mujoco.MjData(model)
    slot_of = slots(data, actuators)
    kinds: dict[int, Family] = {at: type(one) for at, one in actuators.items()}
    parameters = {at: parameters_type(kinds[at])(*one.numbers) for at, one in actuators.items()}
    states = {at: kind.State(*[0.0] * len(kind.State._fields)) for at, kind in kinds.items()}
    found = {at: np.empty((2, len(controls), len(entries(one)))) for at, one in actuators.items()}
    for at in actuators:
        slot_of[at][KEY] = at + 1.0
    for step, control in enumerate(controls):
        data.ctrl[:] = control
        before = copy.copy(data)
        mujoco.mj_forward(model, before)  # what the callback is about to see, and the torque it makes
        mujoco.mj_step(model, data)
        for at, actuator in actuators.items():
            output = model.actuator_outadr[at]
            arm = 1.0 if model.actuator_plugin[at] < 0 else actuator.arm_radius  # the callback's is in the gear
            moving = float(before.actuator_length[output]) / arm, float(before.actuator_velocity[output]) / arm
            if model.actuator_plugin[at] < 0:
                desired = _clamped(model, at, control)
            else:
                desired = float(slot_of[at][slot_size(kinds[at])]) * arm
                if actuator.MOTION:
                    desired = _clamped(model, at, control) / arm
            inertia = shaft_inertia(model, before, output, 1.0 / arm) if actuator.INERTIA else math.inf
            inputs = Inputs(desired, *moving, before.time, at + 1.0, inertia)
            states[at], torque, signals = actuator.advance(parameters[at], model.opt.timestep, states[at], inputs)
            oracle = [*states[at], *signals, _limited(model, at, torque / arm)]
            after = SLOT + len(states[at])  # the candidate state, then the signals
            found[at][0, step] = *slot_of[at][after : after + len(oracle) - 1], before.actuator_force[output]
            found[at][1, step] = oracle
    return {at: (both[0], both[1]) for at, both in found.items()}


def _clamped(model: mujoco.MjModel, index: int, control: np.ndarray) -> float:
    address = model.actuator_ctrladr[index]
    low, high = model.actuator_ctrlrange[address] if model.actuator_ctrllimited[address] else (-np.inf, np.inf)
    return float(np.clip(control[address], low, high))


def _limited(model: mujoco.MjModel, index: int, torque: float) -> float:
    if not model.actuator_forcelimited[model.actuator_outadr[index]]:
        return torque
    return float(np.clip(torque, *model.actuator_forcerange[model.actuator_outadr[index]]))


_LOOP = dataclasses.replace(EVERY_FEATURE.actuator.controller, max_voltage=1.5, current_bias=0.02, current_noise=0.05)
EXAMPLES: tuple[ActuatorModel, ...] = (
    Actuator(EVERY_FEATURE.actuator.motor, _LOOP, Supply(voltage=1.6, resistance=0.5)),
    Lag(time_constant=0.03, delay=0.013),
    TorqueSpeed(stall_torque=0.2, no_load_speed=1.0, max_torque=0.2),
    Drive(GearMotor(gear_ratio=3.0), SampledLoop(sample_rate=10e3, max_current=4.0), Supply(6.0)),
)
"""Actuators in which every parameter counts and limits are reached, of those families whose defaults do not show it."""


def compiled_checks(quick: bool) -> Iterator[Check]:
    """`advance` of every family, those that commands leave of it too, on swinging rotors under random torques."""
    examples = {type(one): one for one in EXAMPLES}
    named = [examples.get(family) or family() for family in FAMILIES.values() if family is not Ideal]
    driven = [command.actuator for one in named for command in one.commands().values()]
    actuators = list({type(one): one for one in (*driven, *named)}.values())
    for actuator in actuators:
        load_family(type(actuator))
    model = motors_on(SWINGING, actuators, 0.01)
    found = beside(model, dict(enumerate(actuators)), commands(model, 200 if quick else 2000, seed=7))
    for at, actuator in enumerate(actuators):
        yield from compiled_advance.of(family=type(actuator).__name__)(entries(actuator), *found[at])


@check("motor", Oracle("compiled advance: {family}", "the same function in plain Python", 0.0, UNIT))
def compiled_advance(names: tuple[str, ...], compiled: np.ndarray, python: np.ndarray) -> Iterator[Case]:
    """Floats that differ, of shape (steps, names), and the first of them."""
    unequal = differing(compiled, python)
    step, entry = divmod(int(np.argmax(unequal)), len(names))
    first = f"the first of them at step {step + 1}: {names[entry]}"
    yield Case(float(unequal.sum()), lambda _: first, unequal.size)
