"""Subjects of the benchmark of other simulators: many drives, and HalfCheetah in mujoco_warp."""

# numba, Warp and JAX are not followed by the type checker.
# mypy: disable-error-code="untyped-decorator"

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numba
import numpy as np
import warp as wp

from codrl_mj.actuators import (
    ActuatorModel,
    Drive,
    Inputs,
    family_id,
    parameter_paths,
    parameters_type,
    resolve,
)
from codrl_mj.arrays import advance
from codrl_mj.arrays.c_code import Real
from codrl_mj.arrays.warp import StepArrays, WarpActuators
from codrl_mj.engine.families import (
    advance_slot,
    commit_slot,
    load_family,
    slot_size,
)
from mujoco_warp_cheetahs import MOTOR, Cheetahs

NUM_WORLDS, NUM_DRIVES, STEP = 4096, 12, 0.002
NUM_CHEETAHS = 256
PERIOD = 8
"""Number of steps after which commands and speeds repeat."""
_STEPS_PER_CONTROL = 10
DRAWN = ("motor.resistance", "motor.torque_constant", "motor.back_emf_constant")
"""Parameters that each drive in each world has for itself, where parameters are drawn."""

wp.config.quiet = True


@dataclasses.dataclass(frozen=True)
class Subject:
    """One thing that is timed: a simulation that takes steps."""

    name: str
    """Name in the table."""
    run: Callable[[int], None]
    """Timed function; it takes the given number of steps."""
    period: int = PERIOD
    """Number of steps after which its inputs repeat; a turn is a multiple of it."""
    prepare: Callable[[], None] = lambda: None
    """Function that is called before each turn and not timed."""
    forces: Callable[[], np.ndarray] = lambda: np.zeros(0)
    """Function that returns the forces of the last step, shape (worlds, drives)."""


class Drives(NamedTuple):
    """The drives of a group, and their inputs in `PERIOD` steps."""

    actuator: ActuatorModel
    """The drive."""
    drawn: tuple[str, ...]
    """Paths of drawn parameters."""
    parameters: np.ndarray
    """Values of all parameters, shape (worlds or 1, drives, parameters)."""
    commands: np.ndarray
    """Desired torques at the joints [N*m], shape (steps, worlds, drives), as 32-bit floats."""
    speeds: np.ndarray
    """Speeds of the joints [rad/s], shape (steps, worlds, drives), as 32-bit floats."""
    inertia: float
    """Inertia at the joints [kg*m^2]."""

    def column(self, path: str) -> np.ndarray:
        """Return the values of a parameter, shape (worlds or 1, drives)."""
        return self.parameters[..., list(parameter_paths(Drive).values()).index(path)]


def make_drives(drawn: tuple[str, ...]) -> Drives:
    """Return drives that follow square waves of torque at speeds up to 0.8 of the no-load speed.

    Args:
        drawn: paths of parameters that are drawn per drive and world, within 10 %.
    """
    generator = np.random.default_rng(0)
    actuator = resolve(MOTOR, None, "a drive").replaced({"motor.gear_ratio": 9.0})
    assert isinstance(actuator, Drive)
    motor, voltage = actuator.motor, actuator.voltage_limit
    shape = (NUM_WORLDS, NUM_DRIVES)
    parameters = np.tile(
        np.array(actuator.parameter_values), (NUM_WORLDS if drawn else 1, NUM_DRIVES, 1)
    )
    for path in drawn:
        column = list(parameter_paths(Drive).values()).index(path)
        parameters[..., column] *= generator.uniform(0.9, 1.1, shape)
    stall_torque = motor.torque_constant * voltage / motor.resistance / actuator.arm_radius
    no_load_speed = voltage / motor.back_emf_constant * actuator.arm_radius
    phases = generator.integers(0, PERIOD, shape)
    steps = np.arange(PERIOD)[:, np.newaxis, np.newaxis]
    is_forward = (steps + phases) % PERIOD < PERIOD // 2
    amplitudes = stall_torque * generator.uniform(0.0, 1.0, shape)
    ripple = 1.0 + 0.01 * np.sin(2.0 * np.pi * (steps + phases) / PERIOD)
    return Drives(
        actuator,
        drawn,
        parameters,
        np.where(is_forward, amplitudes, -amplitudes).astype(np.float32),
        (no_load_speed * generator.uniform(-0.8, 0.8, shape) * ripple).astype(np.float32),
        0.02 + motor.rotor_inertia / actuator.arm_radius**2,
    )


def drives(drawn: tuple[str, ...]) -> list[Subject]:
    """Return the group of many drives: our compiled loop, Warp and JAX.

    Raises:
        ValueError: the forces of a member differ from those of our loop.
    """
    group = make_drives(drawn)
    members = [compiled_loop(group), *(warp_kernel(group, real) for real in ("double", "float"))]
    if drawn:
        everything = tuple(parameter_paths(Drive).values())
        members.append(warp_kernel(group, "double", everything))
    members += [jax_arrays(group, real) for real in ("double", "float")]
    first, *others = members
    first.run(2 * PERIOD)
    reference = first.forces()
    for member in others:
        member.run(2 * PERIOD)
        error = np.abs(member.forces() - reference) / np.abs(reference).max()
        if not np.quantile(error, 0.999) < 1e-5:
            raise ValueError(
                f"{member.name}: its forces differ by {error.max():.1e} of the largest"
            )
    return members


@numba.njit(error_model="numpy")
def _step_bank(
    family_number: int,
    parameters: np.ndarray,
    parameters_address: int,
    slots: np.ndarray,
    slots_address: int,
    desired: np.ndarray,
    speeds: np.ndarray,
    forces: np.ndarray,
    arm: float,
    time: float,
    inertia: float,
    is_first: bool,
) -> None:
    """Advance all drives by a step, as our engine advances the actuators of a model."""
    num_rows, num_drives, num_parameters = parameters.shape
    for world in range(len(slots)):
        for k in range(num_drives):
            row = (world % num_rows) * num_drives + k
            slot = slots_address + 8 * (world * num_drives + k) * slots.shape[2]
            if not is_first:
                commit_slot(family_number, slot, time)
            forces[world, k] = (
                advance_slot(
                    family_number,
                    parameters_address + 8 * row * num_parameters,
                    STEP,
                    slot,
                    desired[world, k] * arm,
                    0.0,
                    speeds[world, k] / arm,
                    time,
                    inertia * arm * arm,
                )
                / arm
            )


def compiled_loop(group: Drives) -> Subject:
    """Return the steps of our engine's compiled functions in a serial loop over the drives."""
    load_family(Drive)
    arm, parameters = group.actuator.arm_radius, group.parameters
    slots = np.zeros((NUM_WORLDS, NUM_DRIVES, slot_size(Drive)))
    commands, speeds = group.commands.astype(float), group.speeds.astype(float)
    forces = np.zeros((NUM_WORLDS, NUM_DRIVES))
    steps = 0

    def run(count: int) -> None:
        nonlocal steps
        for step in range(steps, steps + count):
            _step_bank(
                family_id(Drive),
                parameters,
                parameters.ctypes.data,
                slots,
                slots.ctypes.data,
                commands[step % PERIOD],
                speeds[step % PERIOD],
                forces,
                arm,
                STEP * step,
                group.inertia,
                step == 0,
            )
        steps += count

    return Subject("our engine's compiled loop", run, forces=forces.copy)


def warp_kernel(group: Drives, real: Real, varying: tuple[str, ...] = ()) -> Subject:
    """Return the steps of the kernel of Warp on a CPU.

    Args:
        group: the drives.
        real: precision of the kernel.
        varying: paths of further parameters in its tables.
    """
    kernel = WarpActuators(
        [group.actuator] * NUM_DRIVES,
        NUM_WORLDS,
        STEP,
        varying=(*group.drawn, *varying),
        per_world=bool(group.drawn),
        device="cpu",
        real=real,
    )
    for path in group.drawn:
        kernel.parameter(path).assign(group.column(path))
    commands, speeds = (
        [wp.array(rows, device="cpu") for rows in table] for table in (group.commands, group.speeds)
    )
    times, inertia = (
        wp.zeros(NUM_WORLDS, device="cpu"),
        wp.full((1, 1), group.inertia, device="cpu"),
    )
    positions, forces = (wp.zeros((NUM_WORLDS, NUM_DRIVES), device="cpu") for _ in range(2))
    steps = 0

    def run(count: int) -> None:
        nonlocal steps
        for step in range(steps, steps + count):
            times.fill_(STEP * step)
            index = step % PERIOD
            kernel.step(
                StepArrays(times, commands[index], positions, speeds[index], forces, inertia)
            )
        steps += count

    name = f"Warp, {real}{', all parameters in tables' if varying else ''}"
    return Subject(name, run, forces=lambda: forces.numpy().copy())


def jax_arrays(group: Drives, real: Real) -> Subject:
    """Return the steps of `codrl_mj.arrays.advance` as compiled by JAX."""
    dtype = np.float64 if real == "double" else np.float32
    arm, names = group.actuator.arm_radius, parameters_type(Drive)._fields
    constants = dict(zip(names, group.actuator.parameter_values, strict=True))
    fields = {path: name for name, path in parameter_paths(Drive).items()}

    @functools.partial(jax.jit, donate_argnums=(1,))
    def step(drawn: Any, state: Any, time: Any, command: Any, speed: Any) -> Any:
        like = jnp.zeros((), dtype)
        inputs = Inputs(
            (command * arm).astype(dtype),
            like,
            (speed / arm).astype(dtype),
            time.astype(dtype),
            like,
            group.inertia * arm * arm,
        )
        result = advance(Drive, jnp, constants | drawn, STEP, state, inputs)
        return result.state, (result.torque / arm).astype(np.float32), result.signals

    with jax.enable_x64(real == "double"):
        commands, speeds = (
            [jnp.asarray(rows) for rows in table] for table in (group.commands, group.speeds)
        )
        drawn = {fields[path]: jnp.asarray(group.column(path), dtype) for path in group.drawn}
        shape = (NUM_WORLDS, NUM_DRIVES)
        state = Drive.State(*(jnp.zeros(shape, dtype) for _ in Drive.State._fields))
    steps, forces = 0, np.zeros(0)

    def run(count: int) -> None:
        nonlocal steps, state, forces
        with jax.enable_x64(real == "double"):
            for number in range(steps, steps + count):
                index = number % PERIOD
                state, forces, _ = step(
                    drawn, state, jnp.asarray(STEP * number, dtype), commands[index], speeds[index]
                )
            jax.block_until_ready(state)
        steps += count

    return Subject(f"JAX, {real}", run, forces=lambda: np.asarray(forces))


def cheetahs() -> list[Subject]:
    """Return the group of HalfCheetah in mujoco_warp, without motors first."""
    return [
        cheetah("inertia and friction of six motors, no motors", with_motors=False),
        cheetah("six motors, double"),
        cheetah("six motors, float", real="float"),
        cheetah("Gymnasium's model, without motors", actuators={}),
    ]


def cheetah(name: str, **options: Any) -> Subject:
    """Return the steps of HalfCheetahs in mujoco_warp; every turn begins with a reset.

    Args:
        name: name in the table.
        options: arguments of `Cheetahs`.
    """
    simulation = Cheetahs(NUM_CHEETAHS, "cpu", **options)

    def run(count: int) -> None:
        for step in range(count):
            if step % _STEPS_PER_CONTROL == 0:
                simulation.change_controls(step // _STEPS_PER_CONTROL)
            simulation.step()

    return Subject(name, run, _STEPS_PER_CONTROL, simulation.reset)
