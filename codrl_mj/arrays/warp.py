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
from codrl_mj.arrays.c_code import Real, c_program, replacement_functions
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
REPEATED, NEXT, AT_REST = range(3)
"""Kinds of calls: a call repeats the last step, takes the one after it, or begins at rest."""
_LINE_SIZE = 128
"""Number of bytes that a GPU reads at once; a CPU reads half of it."""
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


class LaneTable:
    """Numbers of all actuators on a device, some per actuator.

    Args:
        num_entries: number of entries per actuator.
        shape: number of worlds, or 1 if they have the same numbers, and of actuators.
        scalar: Warp's type of the numbers.
        device: the device.
    """

    def __init__(
        self, num_entries: int, shape: tuple[int, int], scalar: Any, device: Device
    ) -> None:
        """Create a table of zeros."""
        self._shape, self._size = shape, shape[0] * shape[1]
        line = _LINE_SIZE // np.dtype(wp.dtype_to_numpy(scalar)).itemsize
        # An odd number of lines: a CPU keeps only a few numbers whose addresses differ by a
        # multiple of 4,096 bytes in its cache, and the entries of an actuator would be such.
        self.stride = (-(-self._size // line) | 1) * line
        """Distance between two entries of the same actuator."""
        # Warp has no empty arrays of data that kernels may read.
        self.array: Array = wp.zeros(max(num_entries, 1) * self.stride, dtype=scalar, device=device)
        """All entries; `_snippet` tells the order."""

    def entry(self, index: int) -> Array:
        """Return a view of an entry, with the shape of the table."""
        start = index * self.stride
        return self.array[start : start + self._size].reshape(self._shape)


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
        self._kernel = _kernel(actuators[0], self._variables, timestep, real, edge)
        self._parameters = self._table(len(self._variables), self._num_rows)
        for index, name in enumerate(self._variables):
            values = rows[:, parameters_type(self.family)._fields.index(name)]
            self._parameters.entry(index).assign(np.tile(values, (self._num_rows, 1)))
        # The first half are the committed states, the second the candidates of the present step.
        self._states = self._table(2 * len(self.family.State._fields), num_worlds)
        self._signals = self._table(len(self.family.Signals._fields), num_worlds)
        self._record = self._table(_RECORD_SIZE, num_worlds)
        self._record.array.fill_(_NEVER)
        self._keys = self._array(np.zeros((num_worlds, len(actuators))))
        self._arms = self._array([actuator.arm_radius for actuator in actuators])
        self._limits = self._array(force_limits or [(-math.inf, math.inf)] * len(actuators))
        self._ids = wp.array(self.columns, dtype=int, device=self.device)
        self._unknown_inertia = wp.full((1, 1), math.inf, dtype=self._edge, device=self.device)
        self._stages = 4 if holds_stages else 1

    def _table(self, num_entries: int, num_rows: int) -> LaneTable:
        """Return a table for all actuators in some worlds."""
        shape = num_rows, len(self.actuators)
        return LaneTable(num_entries, shape, self._scalar, self.device)

    def _array(self, values: object) -> Array:
        """Return an array on the device."""
        return wp.array(np.asarray(values, np.float64), dtype=self._scalar, device=self.device)

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
                self._parameters.stride,
                self._states.stride,
                self._parameters.array,
                self._states.array,
                self._signals.array,
                self._record.array,
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
            inputs=[mask, len(self.actuators)],
            outputs=[self._record.array],
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
        return self._parameters.entry(self._variables.index(names[path]))

    def signal(self, name: str) -> Array:
        """Return a view of a signal in the last step, shape (worlds, actuators).

        Raises:
            ValueError: the family has no such signal.
        """
        check_names([name], self.family.Signals._fields, "signal")
        return self._signals.entry(self.family.Signals._fields.index(name))

    def state(self, name: str) -> Array:
        """Return a view of an entry of the state before the last step, shape (worlds, actuators).

        Raises:
            ValueError: the family has no such entry.
        """
        check_names([name], self.family.State._fields, "entry of the state")
        return self._states.entry(self.family.State._fields.index(name))

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
def _forget(mask: wp.array(dtype=wp.bool), num_actuators: int, record: wp.array(dtype=Any)) -> None:
    """Make the next call of masked worlds begin at rest."""
    world, k = wp.tid()
    # The time is the first entry of the record.
    lane = world * num_actuators + k
    if mask[world]:
        record[lane] = type(record[lane])(_NEVER)


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


def _snippet(actuator: ActuatorModel, variables: Sequence[str], timestep: float, real: Real) -> str:
    """Return the C++ of a function that reads a lane of the tables, and writes it."""
    family = type(actuator)
    program = c_program(actuator, real=real, variables=variables, timestep=timestep)
    states = family.State._fields

    def entry(table: str, index: int) -> str:
        return f"{table}.data[{index} * stride + lane]"

    return "\n".join(
        [
            # GPUs have these functions.
            "#ifndef __CUDA_ARCH__",
            *replacement_functions(real, program.statements),
            "#endif",
            "#ifndef HUGE_VAL",
            "#define HUGE_VAL (1e300 * 1e300)",
            "#endif",
            *(
                f"const {real} p_{name} = parameters.data[{index} * parameter_stride + row];"
                for index, name in enumerate(variables)
            ),
            # After a step, its candidates become the committed states.
            f"const int source = lane + (call == {NEXT} ? {len(states)} * stride : 0);",
            *(
                f"const {real} s_{name} = call == {AT_REST} ? 0"
                f" : states.data[{index} * stride + source];"
                for index, name in enumerate(states)
            ),
            *(f"{entry('states', index)} = s_{name};" for index, name in enumerate(states)),
            *program.statements,
            *(
                f"{entry('states', len(states) + index)} = {value};"
                for index, value in enumerate(program.state)
            ),
            *(
                f"{entry('signals', index)} = {value};"
                for index, value in enumerate(program.signals)
            ),
            f"return {program.torque};",
        ]
    )


def _kernel(
    actuator: ActuatorModel, variables: Sequence[str], timestep: float, real: Real, edge: Real
) -> Kernel:
    """Return the kernel of actuators that differ from an actuator in variables only."""
    snippet = _snippet(actuator, variables, timestep, real)
    return _cached_kernel(snippet, type(actuator).MOTION, real, edge)


@functools.cache
def _cached_kernel(snippet: str, is_motion: bool, real: Real, edge: Real) -> Kernel:
    """Return a kernel around the C++ of a family, compiled by Warp at its first launch."""
    scalar, external = _SCALARS[real], _SCALARS[edge]
    motion = wp.constant(int(is_motion))

    @wp.func_native(snippet)
    def advance(
        lane: int,
        row: int,
        parameter_stride: int,
        stride: int,
        call: int,
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
        parameter_stride: int,
        stride: int,
        parameters: wp.array(dtype=scalar),
        states: wp.array(dtype=scalar),
        signals: wp.array(dtype=scalar),
        record: wp.array(dtype=scalar),
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
        lane = world * num_actuators + k
        row = wp.where(num_rows > 1, lane, k)
        arm = arms[k]
        time = scalar(times[world])
        position = scalar(positions[world, column]) / arm
        speed = scalar(speeds[world, column]) / arm
        half = timestep * scalar(0.5)
        elapsed = time - record[TIME * stride + lane]
        steps = record[STEPS * stride + lane]
        call = int(AT_REST)
        if wp.abs(elapsed) < half:
            is_moved = (
                position != record[POSITION * stride + lane]
                or speed != record[SPEED * stride + lane]
            )
            if num_stages > 1 and is_moved:
                forces[world, column] = external(record[TORQUE * stride + lane] / arm)
                return
            call = REPEATED
        elif elapsed > scalar(0.0) and elapsed < timestep + half:
            # The previous step was taken, so that its candidate becomes the state.
            call = NEXT
            steps += scalar(1.0)
        else:
            # Times are counted in steps, because a sum of 32-bit times would drift.
            steps = wp.round(time / timestep)
        record[TIME * stride + lane] = time
        record[STEPS * stride + lane] = steps
        # Arrays of inertias may have one row for all worlds, or one column for all actuators.
        inertia = inertias[
            wp.where(inertias.shape[0] > 1, world, 0), wp.where(inertias.shape[1] > 1, column, 0)
        ]
        command = scalar(desired[world, column]) * arm
        if motion == 1:
            command = scalar(desired[world, column]) / arm
        torque = advance(
            lane,
            row,
            parameter_stride,
            stride,
            call,
            parameters,
            states,
            signals,
            command,
            position,
            speed,
            steps * timestep,
            keys[world, k],
            scalar(inertia) * arm * arm,
        )
        force = wp.clamp(torque / arm, limits[k, 0], limits[k, 1])
        record[POSITION * stride + lane] = position
        record[SPEED * stride + lane] = speed
        record[TORQUE * stride + lane] = force * arm
        forces[world, column] = external(force)

    return step
