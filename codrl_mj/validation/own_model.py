"""Checks of any model with codrl_mj motors, through the callbacks or the plugin.

Actuators of any family run inside the engine and, for comparison, as the same functions in plain
Python. A function of floats must have the same result in both, so `compiled_checks` does not
tolerate a difference of a single bit.
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
    PwmLoop,
    PwmServo,
    SampledLoop,
    SharedDrive,
    SharedSupply,
    Supply,
    TorqueSpeed,
    parameters_type,
    spectral_radius,
)
from codrl_mj.engine.families import SLOT_HEADER_SIZE, SlotHeader, load_family
from codrl_mj.engine.joint_dynamics import describe_duplicate_dynamics
from codrl_mj.engine.model_access import shaft_inertia
from codrl_mj.engine.mounting import arm_outside_gear, desired_input
from codrl_mj.engine.reading import actuators_sharing_motor, motor_slots
from codrl_mj.physics import SimulationConfig, install_callbacks, motors
from codrl_mj.physics.mjcf import task_model
from codrl_mj.physics.variation import without_additions
from codrl_mj.tasks import find_task, resolve_actuators
from codrl_mj.validation.compare import FALLBACK_ACTUATOR, paper_actuators
from codrl_mj.validation.execution import UNIT, commands, differs
from codrl_mj.validation.in_python import advance_in_python
from codrl_mj.validation.rotors import ECCENTRIC_ROTOR, EVERY_FEATURE, Loop, build_rotors
from codrl_mj.validation.table import Case, Check, Skipped, check

STEP_TOLERANCE = 1e-11
"""Tolerance between compiled and plain-Python loops.

The compiler may fuse a multiplication with an addition: 1e-16 a step, which a slow loop adds up.
"""


def load_model(path: Path) -> mujoco.MjModel:
    """Compile an MJCF file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: MuJoCo cannot compile the model.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no model at {path}")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"{path}: MuJoCo cannot compile this model: {error}") from None


NOT_APPLICABLE = {
    "dynamics": "no Gymnasium environment has these equations of motion",
    "trajectories": "no Gymnasium environment has these equations of motion",
    "convergence": "there is no second implementation of the mechanics to converge to",
    "energy": "the losses of joints, contacts and constraints are not modeled here",
}
"""Group that does not apply to a user's model -> reason."""


NOISE_KEY = SlotHeader._fields.index("noise_key")
"""Index of the noise key in a motor's slot."""


def compared_names(actuator: ActuatorModel) -> tuple[str, ...]:
    """Return the names of the values that `compare_with_python` compares.

    They are the states and signals after a step and the torque that the engine applied.
    """
    # mypy does not know the State and Signals classes that each family defines.
    return (*actuator.State._fields, *actuator.Signals._fields, "torque")


def compare_with_python(
    model: mujoco.MjModel, actuators: Mapping[int, ActuatorModel], controls: np.ndarray
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Run a model from rest, and each actuator in plain Python under the same inputs.

    The actuators in Python start at rest and are never corrected. With the plugin, the desired
    force is the engine's force of the model's actuator; with the callbacks, it is the control.

    Args:
        model: a model with installed callbacks.
        actuators: actuator by its index in the model.
        controls: controls, shape (steps, nu).

    Returns:
        By actuator index, the values in the engine and in Python, each of shape (steps, k), with
        columns as in `compared_names`.
    """
    data = mujoco.MjData(model)
    slot_of = motor_slots(data, actuators)
    families: dict[int, Family] = {index: type(actuator) for index, actuator in actuators.items()}
    parameters = {
        index: parameters_type(families[index])(*actuator.parameter_values)
        for index, actuator in actuators.items()
    }
    states = {
        index: kind.State._make([0.0] * len(kind.State._fields)) for index, kind in families.items()
    }
    results = {
        index: np.empty((2, len(controls), len(compared_names(actuator))))
        for index, actuator in actuators.items()
    }
    for index in actuators:
        slot_of[index][NOISE_KEY] = index + 1.0
    for step, control in enumerate(controls):
        data.ctrl[:] = control
        before = copy.copy(data)
        # The copy has the quantities that the callback is about to see, and the resulting torque.
        mujoco.mj_forward(model, before)
        mujoco.mj_step(model, data)
        inputs = {}
        for index, actuator in actuators.items():
            output = model.actuator_outadr[index]
            arm = arm_outside_gear(model, index, actuator)
            motion = (
                float(before.actuator_length[output]) / arm,
                float(before.actuator_velocity[output]) / arm,
            )
            address = model.actuator_ctrladr[index]
            command, range_ = float(control[address]), model.actuator_ctrlrange[address]
            command = (
                float(np.clip(command, *range_)) if model.actuator_ctrllimited[address] else command
            )
            desired = desired_input(model, index, actuator, slot_of[index], command)
            inertia = (
                shaft_inertia(model, before, output, 1.0 / arm) if actuator.INERTIA else math.inf
            )
            inputs[index] = Inputs(desired, *motion, before.time, index + 1.0, inertia)
        advanced = advance_in_python(actuators, parameters, model.opt.timestep, states, inputs)
        for index, (state, torque, signals) in advanced.items():
            states[index], output = state, model.actuator_outadr[index]
            arm = arm_outside_gear(model, index, actuators[index])
            limited = model.actuator_forcelimited[output]
            torque = (
                float(np.clip(torque / arm, *model.actuator_forcerange[output]))
                if limited
                else torque / arm
            )
            oracle = [*state, *signals, torque]
            # A slot holds the accepted state, then the candidate state, then the signals.
            after = SLOT_HEADER_SIZE + len(state)
            results[index][0, step] = (
                *slot_of[index][after : after + len(oracle) - 1],
                before.actuator_force[output],
            )
            results[index][1, step] = oracle
    return {index: (values[0], values[1]) for index, values in results.items()}


BELOW_ONE = float(np.nextafter(1.0, 0.0))


@check(
    "motor",
    Check(
        "stable: {motor}", "the family's own bound, a loop's eigenvalues", BELOW_ONE, "instability"
    ),
)
def stability(actuator: ActuatorModel, timestep: float) -> Iterator[Case]:
    """Check the family's measure of instability, and a current loop's spectral radius.

    For an unstable loop only the spectral radius is reported, because its instability is infinite.
    """
    instability = float(actuator.instability(np.array([actuator.parameter_values]), timestep)[0])
    radius = (
        spectral_radius(actuator, timestep)
        if isinstance(actuator, DCMotorActuator)
        else instability
    )
    yield Case(max(instability, radius) if radius < 1.0 else radius, f"at a step of {timestep:g} s")


@check(
    "motor",
    Check(
        "steps: {motor}", "the same functions in plain Python at the recorded speed", STEP_TOLERANCE
    ),
)
def motor_steps(actuator: ActuatorModel, ours: np.ndarray, oracle: np.ndarray) -> Iterator[Case]:
    """Compare a motor in the engine with the same motor in plain Python, at the model's speed.

    The Python motor starts at rest and is never corrected; states, signals and the applied torque
    are compared after every step.
    """
    names = compared_names(actuator)
    yield Case(
        np.abs(ours - oracle) / np.maximum(1.0, np.abs(oracle)),
        lambda index: f"{names[index % len(names)]} at step {index // len(names) + 1}",
    )


def motor_checks(model: mujoco.MjModel, quick: bool) -> Iterator[Check | Skipped]:
    """Run the motor checks of a model whose callbacks are installed.

    They check that each motor is stable and equal to plain Python, and the response of each loop.
    """
    names = {
        index: model.actuator(index).name or f"actuator {index}" for index in range(model.nactuator)
    }
    ours = motors(model)
    # Several of the model's actuators may share one motor.
    with_motor = {shared for index in ours for shared in actuators_sharing_motor(model, index)}
    if without_motor := [
        model.actuator(index).name or str(index) for index in names if index not in with_motor
    ]:
        yield Skipped(
            f"actuators {', '.join(without_motor)}",
            "not motors of codrl_mj, which does not change them",
        )
    for text in describe_duplicate_dynamics(without_additions(model, ours), ours):
        yield Skipped(
            "whether a motor is counted twice", f"a compiled model does not show it: {text}"
        )
    running = {}
    for index, actuator in ours.items():
        group = int(model.actuator_group[index])
        if 0 <= group < mujoco.mjNGROUP and bool(model.opt.disableactuator >> group & 1):
            yield Skipped(
                f"steps: {names[index]}", "its actuator group is disabled: the motor never runs"
            )
        elif isinstance(actuator, Ideal):
            yield Skipped(
                f"steps: {names[index]}", "the actuator is ideal and has no state to compare"
            )
        else:
            running[index] = actuator
    for index, actuator in ours.items():
        yield from stability(actuator, model.opt.timestep, motor=names[index])
    for index, values in compare_with_python(
        model, running, commands(model, 200 if quick else 2000, seed=7)
    ).items():
        yield from motor_steps(running[index], *values, motor=names[index])
    loops = {}
    for index, actuator in ours.items():
        if not isinstance(actuator, DCMotorActuator):
            yield Skipped(
                f"responses of {names[index]}",
                "the actuator is not a current loop: there is no oracle for it",
            )
        elif spectral_radius(actuator, model.opt.timestep) < 1.0:
            loops[names[index]] = Loop(actuator, model.opt.timestep)
        else:
            yield Skipped(
                f"responses of {names[index]}", "the loop is unstable: it has no steady response"
            )
    if loops:
        # The import is local because python-control is optional.
        from codrl_mj.validation.motor_loops import sampled_checks

        yield from sampled_checks(loops, quick)


def checks(task_name: str, quick: bool = False) -> Iterator[Check | Skipped]:
    """Run the motor checks of a task's model."""
    task = find_task(task_name)
    if not task.paper:
        yield Skipped(
            "the paper's actuators",
            f"the task has none: the {FALLBACK_ACTUATOR} is checked instead",
        )
    actuators = (
        paper_actuators(task) if task.actuator == "ideal" else resolve_actuators("default", task)
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
    SharedDrive(GearMotor(gear_ratio=3.0), SampledLoop(10e3), SharedSupply(6.0, 2.0)),
    PwmServo(
        GearMotor(gear_ratio=3.0),
        PwmLoop(
            deadband=0.01, start_duty=0.05, max_velocity=3.0, command_rate=50.0, command_jitter=2e-3
        ),
        Supply(6.0, 0.5),
    ),
)
"""Actuators in which every parameter matters and limits are reached, unlike their defaults."""


def compiled_checks(quick: bool) -> Iterator[Check]:
    """Compare `advance` of every family with plain Python, on swinging rotors under random torques.

    Families that only serve commands other than the force, such as a voltage, are included.
    """
    examples = {type(actuator): actuator for actuator in EXAMPLES}
    registered = [
        examples.get(family) or family() for family in FAMILIES.values() if family is not Ideal
    ]
    commanded = [
        command.actuator for actuator in registered for command in actuator.commands().values()
    ]
    actuators = list({type(actuator): actuator for actuator in (*commanded, *registered)}.values())
    for actuator in actuators:
        load_family(type(actuator))
    model = build_rotors(ECCENTRIC_ROTOR, actuators, 0.01)
    values = compare_with_python(
        model, dict(enumerate(actuators)), commands(model, 200 if quick else 2000, seed=7)
    )
    for index, actuator in enumerate(actuators):
        yield from compiled_advance(
            compared_names(actuator), *values[index], family=type(actuator).__name__
        )


@check("motor", Check("compiled advance: {family}", "the same function in plain Python", 0.0, UNIT))
def compiled_advance(
    names: tuple[str, ...], compiled: np.ndarray, python: np.ndarray
) -> Iterator[Case]:
    """Count the floats of shape (steps, names) that differ, and report the first of them."""
    unequal = differs(compiled, python)
    step, entry = divmod(int(np.argmax(unequal)), len(names))
    first = f"the first of them at step {step + 1}: {names[entry]}"
    yield Case(float(unequal.sum()), lambda _: first, unequal.size)
