"""One environment step of one simulation in MuJoCo, compiled: the engine's step with what comes before and after it.

A compiled function knows a simulation by its `arguments`: (address of the model, address of the data, settings,
memory, trace). `settings` is the vector described by `SETTING_NAMES`, then a disturber's numbers; `memory` a
disturber's, of one row; `trace` that of `Physics`. They are live: what changes them changes the simulation.
"""

import functools
from typing import Any, NamedTuple

import numba
import numpy as np

from codrl_mj.callbacks.engine import engine
from codrl_mj.callbacks.kernels import AVAILABLE_VOLTAGE, CURRENT, NOISE_KEY, VOLTAGE
from codrl_mj.motor import Actuator
from codrl_mj.physics.base import (
    TRACE_ACTUAL_FORCE,
    TRACE_CURRENT,
    TRACE_DESIRED_FORCE,
    TRACE_SATURATED,
    TRACE_SPEED,
    TRACE_VOLTAGE,
    delivered,
)
from codrl_mj.physics.constrain import Compiled, compiled_constrain, compiled_reader, is_fine
from codrl_mj.physics.disturber import KEY_COLUMN, compiled_disturbance, sensor_error
from codrl_mj.tasks import Task

SETTING_NAMES = (
    "motorised",
    "imperfect",
    "dof",
    "current_bias",
    "current_noise",
    "arm",
    "torque_constant",
    "max_voltage",
)
"""What `settings` begin with: whether there is a motor, and one with an imperfect sensor or supply; the index of the
actuated joint's velocity; the current sensor's bias and noise [A]; and the motor's arm [m], torque constant [N*m/A] and
largest voltage [V]."""
MOTORISED, IMPERFECT, DOF, BIAS, NOISE, ARM, TORQUE_CONSTANT, MAX_VOLTAGE = range(len(SETTING_NAMES))
DISTURBANCE = len(SETTING_NAMES)
"""Where the disturber's numbers begin."""


def actuator_settings(actuator: Actuator | None) -> tuple[float, float, float]:
    """Arm, torque constant and largest voltage; for the ideal actuator such that force and control are equal."""
    if actuator is None:
        return 1.0, 1.0, np.inf
    return actuator.motor.arm_radius, actuator.motor.torque_constant, actuator.controller.max_voltage


class Stepping(NamedTuple):
    """Compiled functions; `arguments` are those of the module's docstring."""

    step: Compiled
    """(force, *arguments) -> (fine, *signals): takes one environment step under a desired force [N or N*m]. `fine` says
    whether the state is still one of numbers within `LARGEST`; the signals are in the order of `Signals`."""
    start: Compiled
    """(state (n,), key, *arguments) -> nothing: starts an episode, as `Physics.reset` does."""
    read: Compiled
    """(state (n,), *arguments) -> nothing: fills `state` with the present one."""
    sensed: Compiled
    """(current, *arguments) -> current [A] that the sensor measures at present."""


def compiled_stepping(task: Task, explicit: bool, disturbed: bool, noisy: bool) -> Stepping:
    """The functions for simulations of a task; compiled as they are used, once a process.

    Args:
        task: the task.
        explicit: whether positions are moved by the old velocity.
        disturbed: whether there is a disturber.
        noisy: whether the current sensor has noise.
    """
    return _stepping(compiled_constrain(task), compiled_reader(task), task.qpos, task.qvel, explicit, disturbed, noisy)


@functools.cache
def _stepping(
    keep: Compiled | None,
    read_state: Compiled,
    positions: tuple[int, ...],
    velocities: tuple[int, ...],
    explicit: bool,
    disturbed: bool,
    noisy: bool,
) -> Stepping:
    mujoco = engine()
    engine_step, engine_reset, engine_timestep, time_of = mujoco.step, mujoco.reset, mujoco.timestep, mujoco.time
    qpos_of, qvel_of, ctrl_of, act_of, load_of = mujoco.qpos, mujoco.qvel, mujoco.ctrl, mujoco.act, mujoco.qfrc_applied
    size, moving = len(positions) + len(velocities), len(positions)
    bounded, constrain = keep is not None, keep or _nothing
    disturbance = compiled_disturbance()
    disturb, disturbing_load = (disturbance.command, disturbance.load) if disturbed else (_nothing, _nothing)
    signals_of = numba.njit(nogil=True, error_model="numpy")(delivered)

    @numba.njit(nogil=True, error_model="numpy")
    def step(
        force: float, model: int, data: int, settings: np.ndarray, memory: np.ndarray, trace: np.ndarray
    ) -> tuple[bool, float, float, float, float, float, bool]:
        timestep = engine_timestep(model)
        qpos, qvel, ctrl, act = qpos_of(data), qvel_of(data), ctrl_of(data), act_of(data)
        arm, torque_constant, available = settings[ARM], settings[TORQUE_CONSTANT], settings[MAX_VOLTAGE]
        motorised, imperfect, dof = settings[MOTORISED] != 0.0, settings[IMPERFECT] != 0.0, int(settings[DOF])
        state = np.empty(size)
        command = force
        signals = (force, force, 0.0, 0.0, 0.0, False)
        for inner in range(len(trace)):
            if disturbed:
                command = disturb(settings[DISTURBANCE:], memory[0], force)
                load_of(data)[dof] = disturbing_load(settings[DISTURBANCE:], memory[0])
            ctrl[0] = command * arm
            if explicit:
                for entry in range(moving):
                    state[entry] = qpos[entry] + timestep * qvel[entry]
            engine_step(model, data)
            if explicit:
                for entry in range(moving):
                    qpos[entry] = state[entry]
            if bounded:
                constrain(qpos, qvel, state, timestep)
            if motorised:
                if imperfect:
                    available = act[AVAILABLE_VOLTAGE]
                signals = signals_of(force, command, act[CURRENT], act[VOLTAGE], arm, torque_constant, available)
            else:
                signals = (force, command, 0.0, 0.0, 0.0, False)
            trace[inner, TRACE_DESIRED_FORCE] = command
            trace[inner, TRACE_ACTUAL_FORCE] = signals[1]
            trace[inner, TRACE_CURRENT] = signals[2]
            trace[inner, TRACE_VOLTAGE] = signals[4]
            trace[inner, TRACE_SPEED] = qvel[dof]
            trace[inner, TRACE_SATURATED] = signals[5]
        read_state(qpos, qvel, state)
        return (is_fine(state), *signals)

    @numba.njit(nogil=True, error_model="numpy")
    def start(
        state: np.ndarray,
        key: float,
        model: int,
        data: int,
        settings: np.ndarray,
        memory: np.ndarray,
        trace: np.ndarray,  # noqa: ARG001 - it is one of the simulation's arguments
    ) -> None:
        engine_reset(model, data)
        qpos, qvel = qpos_of(data), qvel_of(data)
        for entry in range(len(positions)):
            qpos[entry] = state[positions[entry]]
        for entry in range(len(velocities)):
            qvel[entry] = state[velocities[entry]]
        if settings[IMPERFECT] != 0.0:
            act_of(data)[NOISE_KEY] = key
        if disturbed:
            memory[:] = 0.0
            memory[0, memory.shape[1] + KEY_COLUMN] = key

    @numba.njit(nogil=True, error_model="numpy")
    def read(
        state: np.ndarray,
        model: int,  # noqa: ARG001 - the arguments of a simulation go together
        data: int,
        settings: np.ndarray,  # noqa: ARG001
        memory: np.ndarray,  # noqa: ARG001
        trace: np.ndarray,  # noqa: ARG001
    ) -> None:
        read_state(qpos_of(data), qvel_of(data), state)

    @numba.njit(nogil=True, error_model="numpy")
    def sensed(
        current: float,
        model: int,
        data: int,
        settings: np.ndarray,
        memory: np.ndarray,  # noqa: ARG001
        trace: np.ndarray,  # noqa: ARG001
    ) -> float:
        if noisy:  # left out where it is not needed, because it takes long to compile
            key, time, timestep = act_of(data)[NOISE_KEY], time_of(data), engine_timestep(model)
            return current + sensor_error(settings[BIAS], settings[NOISE], key, time, timestep)
        return current + settings[BIAS]

    return Stepping(step, start, read, sensed)


@numba.njit
def _nothing(*arguments: Any) -> float:  # noqa: ARG001 - in the place of another
    return 0.0
