"""The checks that apply to a user's own model, or a task's, with any number of our motors at either door.

Actuators of any family run inside the engine, callback and all, beside the same functions in plain
Python. A function of floats has one result, whoever compiled it: `compiled_checks` has a tolerance
of no bit.
"""

import copy
import dataclasses
import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import mujoco
import numpy as np

from codrl_mj.actuators import (
    FAMILIES,
    ActuatorModel,
    DCMotorActuator,
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
    spectral_radius,
)
from codrl_mj.engine import load_family
from codrl_mj.engine.doors import shaft_inertia
from codrl_mj.engine.families import SLOT, Slot, slot_size
from codrl_mj.engine.reading import sharing, slots
from codrl_mj.engine.specs import doubled
from codrl_mj.physics import SimulationConfig, install_callbacks, motors
from codrl_mj.physics.mjcf import task_model
from codrl_mj.physics.variation import without_motors
from codrl_mj.tasks import find_task, resolve_actuators
from codrl_mj.validation.compare import STAND_IN, actuators_of
from codrl_mj.validation.execution import UNIT, commands, differing
from codrl_mj.validation.rotors import EVERY_FEATURE, SWINGING, Loop, motors_on
from codrl_mj.validation.table import Case, Check, Skipped, check

STEP_TOLERANCE = 1e-11
"""The compiled loop may fuse a multiplication with an addition: 1e-16 a step, which a slow loop adds up."""


def load(path: Path) -> mujoco.MjModel:
    """Compile an MJCF file; a FileNotFoundError or a ValueError where there is none that MuJoCo takes."""
    if not path.is_file():
        raise FileNotFoundError(f"no model at {path}")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"{path}: MuJoCo cannot compile this model: {error}") from None


UNKNOWN = {
    "dynamics": "no Gymnasium environment has these equations of motion",
    "trajectories": "no Gymnasium environment has these equations of motion",
    "convergence": "there is no second implementation of the mechanics to converge to",
    "energy": "the losses of joints, contacts and constraints are not modelled here",
}
"""Groups that need to know more of a model than its motors, and what."""


KEY = Slot._fields.index("noise_key")


def entries(actuator: ActuatorModel) -> tuple[str, ...]:
    """What `beside` compares, by name: states and signals after a step, and the torque that the engine took from it."""
    return (*actuator.State._fields, *actuator.Signals._fields, "torque")  # type: ignore[attr-defined]


def beside(
    model: mujoco.MjModel, actuators: Mapping[int, ActuatorModel], controls: np.ndarray
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Run a model from rest, and each actuator in Python under the inputs that the engine had for it.

    The actuators in Python, by index in the model, start at rest and are never corrected. At the
    plugin's door the desired force is what the engine made of the model's actuator; at the
    callback's it is the control itself, of shape (steps, nu). By index: what was found in the
    engine and in Python, of shape (steps, k), columns as in `entries`.
    """
    data = mujoco.MjData(model)
    slot_of = slots(data, actuators)
    kinds: dict[int, Family] = {at: type(one) for at, one in actuators.items()}
    parameters = {at: parameters_type(kinds[at])(*one.parameter_values) for at, one in actuators.items()}
    states = {at: kind.State(*[0.0] * len(kind.State._fields)) for at, kind in kinds.items()}
    found = {at: np.empty((2, len(controls), len(entries(one)))) for at, one in actuators.items()}
    for at in actuators:
        slot_of[at][KEY] = at + 1.0
    for step, control in enumerate(controls):
        data.ctrl[:] = control
        before = copy.copy(data)
        mujoco.mj_forward(
            model, before
        )  # what the callback is about to see, and the torque it makes
        mujoco.mj_step(model, data)
        for at, actuator in actuators.items():
            output = model.actuator_outadr[at]
            arm = (
                1.0 if model.actuator_plugin[at] < 0 else actuator.arm_radius
            )  # the callback's is in the gear
            moving = (
                float(before.actuator_length[output]) / arm,
                float(before.actuator_velocity[output]) / arm,
            )
            address, limited = model.actuator_ctrladr[at], model.actuator_forcelimited[output]
            asked, range_ = float(control[address]), model.actuator_ctrlrange[address]
            asked = float(np.clip(asked, *range_)) if model.actuator_ctrllimited[address] else asked
            if model.actuator_plugin[at] < 0 or actuator.MOTION:
                desired = asked / arm
            else:
                desired = float(slot_of[at][slot_size(kinds[at])]) * arm
            inertia = (
                shaft_inertia(model, before, output, 1.0 / arm) if actuator.INERTIA else math.inf
            )
            inputs = Inputs(desired, *moving, before.time, at + 1.0, inertia)
            states[at], torque, signals = actuator.advance(
                parameters[at], model.opt.timestep, states[at], inputs
            )
            torque = (
                float(np.clip(torque / arm, *model.actuator_forcerange[output]))
                if limited
                else torque / arm
            )
            oracle = [*states[at], *signals, torque]
            after = SLOT + len(states[at])  # the candidate state, then the signals
            found[at][0, step] = (
                *slot_of[at][after : after + len(oracle) - 1],
                before.actuator_force[output],
            )
            found[at][1, step] = oracle
    return {at: (both[0], both[1]) for at, both in found.items()}


BELOW_ONE = float(np.nextafter(1.0, 0.0))


@check(
    "motor",
    Check(
        "stable: {motor}", "the family's own bound, a loop's eigenvalues", BELOW_ONE, "instability"
    ),
)
def stable(actuator: ActuatorModel, timestep: float) -> Iterator[Case]:
    """What the family says of its parameters; of a loop, of which that is infinite from 1 on, the spectral radius."""
    found = float(actuator.instability(np.array([actuator.parameter_values]), timestep)[0])
    radius = spectral_radius(actuator, timestep) if isinstance(actuator, DCMotorActuator) else found
    yield Case(max(found, radius) if radius < 1.0 else radius, f"at a step of {timestep:g} s")


@check(
    "motor",
    Check(
        "steps: {motor}", "the same functions in plain Python at the recorded speed", STEP_TOLERANCE
    ),
)
def motor_steps(actuator: ActuatorModel, ours: np.ndarray, oracle: np.ndarray) -> Iterator[Case]:
    """A motor in the engine against its own in plain Python, driven by the speed that the model itself reached.

    The Python motor starts at rest and is never corrected; states and signals are compared after
    every step, and so is the torque that the engine applied.
    """
    names = entries(actuator)
    yield Case(
        np.abs(ours - oracle) / np.maximum(1.0, np.abs(oracle)),
        lambda at: f"{names[at % len(names)]} at step {at // len(names) + 1}",
    )


def motor_checks(model: mujoco.MjModel, quick: bool) -> Iterator[Check | Skipped]:
    """The motors of a model whose callbacks are installed: stable, in step with Python, and each loop alone."""
    named = {at: model.actuator(at).name or f"actuator {at}" for at in range(model.nactuator)}
    ours = motors(model)
    driven = {one for at in ours for one in sharing(model, at)}
    if foreign := [model.actuator(at).name or str(at) for at in named if at not in driven]:
        yield Skipped(
            f"actuators {', '.join(foreign)}", "not motors of codrl_mj, which leaves them alone"
        )
    for text in doubled(without_motors(model, ours), ours):
        yield Skipped(
            "whether a motor is counted twice", f"this cannot be seen in a compiled model: {text}"
        )
    running = {}
    for at, actuator in ours.items():
        group = int(model.actuator_group[at])
        if 0 <= group < mujoco.mjNGROUP and bool(model.opt.disableactuator >> group & 1):
            yield Skipped(f"steps: {named[at]}", "its actuator group is disabled: it never runs")
        elif isinstance(actuator, Ideal):
            yield Skipped(f"steps: {named[at]}", "it is ideal: there is nothing to step")
        else:
            running[at] = actuator
    for at, actuator in ours.items():
        yield from stable(actuator, model.opt.timestep, motor=named[at])
    for at, found in beside(
        model, running, commands(model, 200 if quick else 2000, seed=7)
    ).items():
        yield from motor_steps(running[at], *found, motor=named[at])
    loops = {}
    for at, actuator in ours.items():
        if not isinstance(actuator, DCMotorActuator):
            yield Skipped(
                f"responses of {named[at]}", "it is no current loop: there is no oracle for it"
            )
        elif spectral_radius(actuator, model.opt.timestep) < 1.0:
            loops[named[at]] = Loop(actuator, model.opt.timestep)
        else:
            yield Skipped(f"responses of {named[at]}", "its loop is unstable: it has none")
    if loops:
        from codrl_mj.validation.motor_loops import sampled_checks  # needs scipy and python-control

        yield from sampled_checks(loops, quick)


def checks(task_name: str, quick: bool = False) -> Iterator[Check | Skipped]:
    """The checks of a task's own motors, in its model."""
    task = find_task(task_name)
    if not task.paper:
        yield Skipped("the paper's actuators", f"it has none: the {STAND_IN} is in their place")
    actuators = (
        actuators_of(task) if task.actuator == "ideal" else resolve_actuators("default", task)
    )
    model = task_model(SimulationConfig(task, actuators, task.motor_inner_steps))
    install_callbacks(model)
    yield from motor_checks(model, quick)


_LOOP = dataclasses.replace(
    EVERY_FEATURE.actuator.controller, max_voltage=1.5, current_bias=0.02, current_noise=0.05
)
EXAMPLES: tuple[ActuatorModel, ...] = (
    DCMotorActuator(EVERY_FEATURE.actuator.motor, _LOOP, Supply(voltage=1.6, resistance=0.5)),
    Lag(time_constant=0.03, delay=0.013),
    TorqueSpeed(stall_torque=0.2, no_load_speed=1.0, max_torque=0.2),
    Drive(GearMotor(gear_ratio=3.0), SampledLoop(sample_rate=10e3, max_current=4.0), Supply(6.0)),
)
"""Actuators in which every parameter counts and limits are reached, of those families whose defaults do not show it."""


def compiled_checks(quick: bool) -> Iterator[Check]:
    """`advance` of every family, those that commands leave of it too, on swinging rotors under random torques."""
    examples = {type(one): one for one in EXAMPLES}
    named = [
        examples.get(family) or family() for family in FAMILIES.values() if family is not Ideal
    ]
    driven = [command.actuator for one in named for command in one.commands().values()]
    actuators = list({type(one): one for one in (*driven, *named)}.values())
    for actuator in actuators:
        load_family(type(actuator))
    model = motors_on(SWINGING, actuators, 0.01)
    found = beside(
        model, dict(enumerate(actuators)), commands(model, 200 if quick else 2000, seed=7)
    )
    for at, actuator in enumerate(actuators):
        yield from compiled_advance(entries(actuator), *found[at], family=type(actuator).__name__)


@check("motor", Check("compiled advance: {family}", "the same function in plain Python", 0.0, UNIT))
def compiled_advance(
    names: tuple[str, ...], compiled: np.ndarray, python: np.ndarray
) -> Iterator[Case]:
    """Floats that differ, of shape (steps, names), and the first of them."""
    unequal = differing(compiled, python)
    step, entry = divmod(int(np.argmax(unequal)), len(names))
    first = f"the first of them at step {step + 1}: {names[entry]}"
    yield Case(float(unequal.sum()), lambda _: first, unequal.size)
