"""Actuators of one family as a Warp kernel over worlds and actuators: `WarpActuators`.

The kernel runs on a CPU and on CUDA devices. Parameters, states and signals are tables on the
device. An adapter passes positions, speeds and desired forces of a simulator, and gets forces.
"""
# Warp takes the types of a kernel's arguments from its annotations, which depend on the precision.
# mypy: disable-error-code="valid-type,untyped-decorator"

import functools
import math
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from codrl_mj.actuators import ActuatorModel, parameter_paths, parameters_type
from codrl_mj.actuators.noise import MAX_KEY
from codrl_mj.arrays.c_code import Real, c_program
from codrl_mj.fields import check_names

# Warp is not followed by the type checker.
Array = Any
"""Array of Warp on a device."""
Kernel = Any
"""Kernel of Warp."""
Device = Any
"""Device of Warp, or its name."""
TIME, STEPS, POSITION, SPEED, TORQUE = range(5)
"""Rows of the record of the last call: time [s], number of steps, shaft's position, speed and
torque.
"""
_RECORD_SIZE = 5
_NEVER = 1e30
"""Time in the record of a world that must be brought to rest in the next call."""


class StepArrays(NamedTuple):
    """Arrays of a simulator for one step; columns are those of its actuators."""

    time: Array
    """Time at the beginning of the step [s], shape (worlds,)."""
    desired: Array
    """Desired force [N] or [N*m], or commanded motion, shape (worlds, columns)."""
    position: Array
    """Length of each actuator [m] or [rad], shape (worlds, columns)."""
    speed: Array
    """Speed of each actuator, shape (worlds, columns)."""
    force: Array
    """Delivered force, which is written, shape (worlds, columns); it may be `desired`."""
    inertia: Array = None
    """Inertia at each actuator [kg*m^2] or [kg], shape (worlds or 1, columns); None if unknown."""


class WarpActuators:
    """Actuators of one family in many worlds: parameters, states and signals on a device.

    The state of a world follows the simulator's time. A call at the same time repeats the step, a
    call one step later goes on, and a call at any other time begins at rest, as after a reset.
    """

    def __init__(
        self,
        actuators: Sequence[ActuatorModel],
        num_worlds: int,
        timestep: float,
        *,
        columns: Sequence[int] | None = None,
        force_limits: Sequence[tuple[float, float]] | None = None,
        varying: Collection[str] = (),
        per_world: bool = False,
        holds_stages: bool = False,
        device: Device = None,
        real: Real = "double",
        edge: Real = "float",
    ) -> None:
        """Compile the kernel, and create tables with all actuators at rest.

        Args:
            actuators: actuators of one family, n of them.
            num_worlds: number of worlds.
            timestep: mechanical step [s].
            columns: the actuators' columns in the arrays of the simulator; 0 to n - 1 if None.
            force_limits: lowest and highest force of each actuator; none if None.
            varying: dotted paths of parameters that can be changed. The others become constants of
                the kernel if all actuators have the same value.
            per_world: True if each world has its own parameters.
            holds_stages: True to hold the force in calls at the same time with other positions or
                speeds, which are the later stages of RK4.
            device: device of Warp; its default if None.
            real: precision of the tables and of the computation.
            edge: precision of the simulator's arrays.

        Raises:
            ValueError: actuators of several families, or an unknown path.
            UnsupportedError: see `check_family`.
        """
        self.family = type(actuators[0])
        if any(type(actuator) is not self.family for actuator in actuators):
            names = sorted({type(actuator).__name__ for actuator in actuators})
            raise ValueError(f"actuators: must be of one family, but are {', '.join(names)}")
        self.actuators, self.num_worlds, self.timestep = tuple(actuators), num_worlds, timestep
        self.columns = tuple(range(len(actuators)) if columns is None else columns)
        """Columns of the actuators in the simulator's arrays."""
        self.device = wp.get_device(device)
        self._scalar, self._edge = _SCALARS[real], _SCALARS[edge]
        self._num_rows = num_worlds if per_world else 1
        rows = np.array([actuator.parameter_values for actuator in actuators])
        paths = parameter_paths(self.family)
        check_names(varying, paths.values(), "parameter")
        self._variables = tuple(
            name
            for column, (name, path) in enumerate(paths.items())
            if path in varying or (rows[:, column] != rows[0, column]).any()
        )
        self._kernel = _kernel(actuators[0], self._variables, real, edge)
        used = [parameters_type(self.family)._fields.index(name) for name in self._variables]
        self._parameters = self._table(
            rows.T[used][:, np.newaxis].repeat(self._num_rows, axis=1).reshape(-1)
        )
        num_states, num_signals = len(self.family.State._fields), len(self.family.Signals._fields)
        size = num_worlds * len(actuators)
        # The first half are the committed states, the second the candidates of the present step.
        self._states = self._table(np.zeros(2 * num_states * size))
        self._signals = self._table(np.zeros(num_signals * size))
        self._record = self._table(np.full((_RECORD_SIZE, num_worlds, len(actuators)), _NEVER))
        self._keys = self._table(np.zeros((num_worlds, len(actuators))))
        self._arms = self._table([actuator.arm_radius for actuator in actuators])
        limits = np.array(force_limits or [(-math.inf, math.inf)] * len(actuators), dtype=float)
        self._limits = self._table(limits)
        self._ids = wp.array(self.columns, dtype=int, device=self.device)
        self._unknown_inertia = wp.full((1, 1), math.inf, dtype=self._edge, device=self.device)
        self._stages = 4 if holds_stages else 1

    def _table(self, values: object) -> Array:
        """Return an array on the device; Warp has no empty arrays of data that kernels may read."""
        array = np.asarray(values, dtype=np.float64)
        return wp.array(
            array if array.size else np.zeros(1), dtype=self._scalar, device=self.device
        )

    def step(self, arrays: StepArrays) -> None:
        """Write the forces that the actuators deliver over a step.

        Nothing is allocated, so that a CUDA graph may capture the call.
        """
        inertia = self._unknown_inertia if arrays.inertia is None else arrays.inertia
        wp.launch(
            self._kernel,
            dim=(self.num_worlds, len(self.actuators)),
            inputs=[
                self._scalar(self.timestep),
                len(self.actuators),
                self._num_rows,
                self._stages,
                self._ids,
                self._parameters,
                self._states,
                self._signals,
                self._record,
                self._keys,
                self._arms,
                self._limits,
                arrays.time,
                arrays.desired,
                arrays.position,
                arrays.speed,
                inertia,
            ],
            outputs=[arrays.force],
            device=self.device,
        )

    def reset(self, worlds: object = None) -> None:
        """Bring worlds to rest at their next step.

        A simulator whose time goes back at a reset needs no call.

        Args:
            worlds: indices or a mask of worlds, of numpy, torch or Warp; a slice; None: all. A
                mask of Warp on the device is not copied.
        """
        mask = worlds
        if not (isinstance(worlds, wp.array) and worlds.dtype is wp.bool):
            chosen = np.zeros(self.num_worlds, dtype=bool)
            chosen[slice(None) if worlds is None else host_indices(worlds)] = True
            mask = wp.array(chosen, dtype=wp.bool, device=self.device)
        wp.launch(
            _forget,
            dim=(self.num_worlds, len(self.actuators)),
            inputs=[mask],
            outputs=[self._record],
            device=self.device,
        )

    def parameter(self, path: str) -> Array:
        """Return a view of a parameter, shape (worlds or 1, actuators), which may be written.

        Args:
            path: dotted path, such as `motor.resistance`; one of `varying`.

        Raises:
            ValueError: the parameter is a constant of the kernel, or unknown.
        """
        paths = parameter_paths(self.family)
        names = {path: name for name, path in paths.items() if name in self._variables}
        check_names([path], paths.values(), "parameter")
        if path not in names:
            raise ValueError(f"{path}: is a constant of the kernel: name it in `varying`")
        shape = self._num_rows, len(self.actuators)
        return _slice(self._parameters, self._variables.index(names[path]), shape)

    def signal(self, name: str) -> Array:
        """Return a view of a signal in the last step, shape (worlds, actuators).

        Raises:
            ValueError: the family has no such signal.
        """
        return self._view(self._signals, self.family.Signals._fields, name, "signal")

    def state(self, name: str) -> Array:
        """Return a view of an entry of the state before the last step, shape (worlds, actuators).

        Raises:
            ValueError: the family has no such entry.
        """
        return self._view(self._states, self.family.State._fields, name, "entry of the state")

    def _view(self, table: Array, names: Sequence[str], name: str, kind: str) -> Array:
        """Return a view of one of a table's entries, shape (worlds, actuators)."""
        check_names([name], names, kind)
        return _slice(table, names.index(name), (self.num_worlds, len(self.actuators)))

    def draw_noise_keys(self, generator: np.random.Generator) -> None:
        """Give each actuator in each world another random key for its sensor's noise."""
        shape = self.num_worlds, len(self.actuators)
        self.set_noise_keys(generator.integers(0, self._max_noise_key, shape))

    @property
    def _max_noise_key(self) -> int:
        """Exclusive upper bound of the noise keys, which the tables hold exactly."""
        return MAX_KEY if self._scalar is wp.float64 else 2**24

    def set_noise_keys(self, keys: np.ndarray) -> None:
        """Set the keys of the sensors' noise, shape (worlds, actuators).

        Raises:
            ValueError: a key is no whole number from 0 to 2**53 - 1, or to 2**24 - 1 in floats.
        """
        limit = self._max_noise_key
        if ((keys < 0) | (keys >= limit) | (keys % 1 != 0)).any():
            raise ValueError(f"keys: must be whole numbers from 0 to {limit - 1}")
        self._keys.assign(np.asarray(keys, dtype=np.float64))


@wp.kernel(enable_backward=False)
def _forget(mask: wp.array(dtype=wp.bool), record: wp.array3d(dtype=Any)) -> None:
    """Make the next call of masked worlds begin at rest."""
    world, k = wp.tid()
    if mask[world]:
        record[TIME, world, k] = type(record[TIME, world, k])(_NEVER)


def host_indices(worlds: object) -> Any:
    """Return indices, a slice or a mask of worlds as numpy takes them."""
    if isinstance(worlds, slice):
        return worlds
    if isinstance(worlds, wp.array):
        return worlds.numpy()
    # A tensor of torch on a CUDA device has to be copied first.
    to_host = getattr(worlds, "cpu", None)
    return np.asarray(to_host() if to_host else worlds)


_SCALARS: dict[Real, Any] = {"double": wp.float64, "float": wp.float32}


def _slice(table: Array, index: int, shape: tuple[int, int]) -> Array:
    """Return one of the parts of a flat table as a view of a shape."""
    size = shape[0] * shape[1]
    return table[index * size : (index + 1) * size].reshape(shape)


def _snippet(actuator: ActuatorModel, variables: Sequence[str], real: Real) -> str:
    """Return the C++ of a function that reads a lane of the tables, and writes it."""
    family = type(actuator)
    program = c_program(actuator, portable=True, real=real, variables=variables)
    num_states = len(family.State._fields)

    def entry(table: str, index: int) -> str:
        return f"{table}.data[{index} * lanes + lane]"

    return "\n".join(
        [
            *(
                f"const {real} p_{name} = parameters.data[{index} * num_parameters + row];"
                for index, name in enumerate(variables)
            ),
            *(
                f"const {real} s_{name} = {entry('states', index)};"
                for index, name in enumerate(family.State._fields)
            ),
            *program.statements,
            *(
                f"{entry('states', num_states + index)} = {value};"
                for index, value in enumerate(program.state)
            ),
            *(
                f"{entry('signals', index)} = {value};"
                for index, value in enumerate(program.signals)
            ),
            f"return {program.torque};",
        ]
    )


def _kernel(actuator: ActuatorModel, variables: Sequence[str], real: Real, edge: Real) -> Kernel:
    """Return the kernel of actuators that differ from an actuator in variables only."""
    family = type(actuator)
    snippet = _snippet(actuator, variables, real)
    return _cached_kernel(snippet, len(family.State._fields), family.MOTION, real, edge)


@functools.cache
def _cached_kernel(
    snippet: str, num_states: int, is_motion: bool, real: Real, edge: Real
) -> Kernel:
    """Return a kernel around the C++ of a family, compiled by Warp at its first launch."""
    scalar, external = _SCALARS[real], _SCALARS[edge]
    states_per_actuator, motion = wp.constant(num_states), wp.constant(int(is_motion))

    @wp.func_native(snippet)
    def advance(
        lane: int,
        row: int,
        num_parameters: int,
        lanes: int,
        timestep: scalar,
        parameters: wp.array(dtype=scalar),
        states: wp.array(dtype=scalar),
        signals: wp.array(dtype=scalar),
        x_desired_torque: scalar,
        x_position: scalar,
        x_speed: scalar,
        x_time: scalar,
        x_noise_key: scalar,
        x_inertia: scalar,
    ) -> scalar: ...

    @wp.kernel(enable_backward=False, module="unique")
    def step(
        timestep: scalar,
        num_actuators: int,
        num_rows: int,
        num_stages: int,
        ids: wp.array(dtype=int),
        parameters: wp.array(dtype=scalar),
        states: wp.array(dtype=scalar),
        signals: wp.array(dtype=scalar),
        record: wp.array3d(dtype=scalar),
        keys: wp.array2d(dtype=scalar),
        arms: wp.array(dtype=scalar),
        limits: wp.array2d(dtype=scalar),
        times: wp.array(dtype=external),
        desired: wp.array2d(dtype=external),
        positions: wp.array2d(dtype=external),
        speeds: wp.array2d(dtype=external),
        inertias: wp.array2d(dtype=external),
        forces: wp.array2d(dtype=external),
    ) -> None:
        world, k = wp.tid()
        column = ids[k]
        lanes = record.shape[1] * num_actuators
        lane = world * num_actuators + k
        row = (world % num_rows) * num_actuators + k
        arm = arms[k]
        time = scalar(times[world])
        position = scalar(positions[world, column]) / arm
        speed = scalar(speeds[world, column]) / arm
        half = timestep * scalar(0.5)
        elapsed = time - record[TIME, world, k]
        if wp.abs(elapsed) < half:
            is_moved = position != record[POSITION, world, k] or speed != record[SPEED, world, k]
            if num_stages > 1 and is_moved:
                forces[world, column] = external(record[TORQUE, world, k] / arm)
                return
        elif elapsed > scalar(0.0) and elapsed < timestep + half:
            # The previous step was taken, so that its candidate becomes the state.
            for index in range(states_per_actuator):
                states[index * lanes + lane] = states[(states_per_actuator + index) * lanes + lane]
            record[STEPS, world, k] = record[STEPS, world, k] + scalar(1.0)
        else:
            for index in range(states_per_actuator):
                states[index * lanes + lane] = scalar(0.0)
            # Times are counted in steps, because a sum of 32-bit times would drift.
            record[STEPS, world, k] = wp.round(time / timestep)
        record[TIME, world, k] = time
        load = scalar(inertias[world % inertias.shape[0], column % inertias.shape[1]]) * arm * arm
        command = scalar(desired[world, column]) * arm
        if motion == 1:
            command = scalar(desired[world, column]) / arm
        torque = advance(
            lane,
            row,
            num_rows * num_actuators,
            lanes,
            timestep,
            parameters,
            states,
            signals,
            command,
            position,
            speed,
            record[STEPS, world, k] * timestep,
            keys[world, k],
            load,
        )
        force = wp.clamp(torque / arm, limits[k, 0], limits[k, 1])
        record[POSITION, world, k] = position
        record[SPEED, world, k] = speed
        record[TORQUE, world, k] = force * arm
        forces[world, column] = external(force)

    return step
