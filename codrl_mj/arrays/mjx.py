"""Our motors in MJX: `MJXMotors`, whose `step` replaces `mjx.step`.

The step is a pure function, which `jax.jit`, `jax.vmap`, `jax.lax.scan` and derivatives take. It
computes the forces of the motors at the beginning of a step, and passes them to `mjx.step` as the
controls of a model whose actuators deliver their controls.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from codrl_mj.actuators import (
    Family,
    Ideal,
    Inputs,
    family_name,
    parameter_paths,
    parameters_type,
)
from codrl_mj.arrays.array_code import advance
from codrl_mj.arrays.draws import WorldDraws
from codrl_mj.arrays.models import SimulatorModel, SimulatorMotor
from codrl_mj.envs.motor_fields import depends_on
from codrl_mj.fields import check_names

# JAX and MJX are not followed by the type checker.
Array = Any
"""Array of JAX."""
Model = Any
"""Model of MJX."""
Data = Any
"""Data of MJX."""
Parameters = dict[str, dict[str, Array]]
"""Family -> dotted path -> values of a parameter, shape (motors of the family,)."""


class MotorState(NamedTuple):
    """State of all motors, which is a pytree."""

    steps: Array
    """Number of steps since the reset."""
    noise_keys: Array
    """Keys of the sensors' noise, which are whole numbers, shape (motors,)."""
    # Families have different named tuples.
    families: dict[str, Any]
    """Family -> its `State`, whose entries have the shape (motors of the family,)."""


class MotorStep(NamedTuple):
    """Simulation and motors after a step."""

    data: Data
    """Data of MJX."""
    state: MotorState
    """State of the motors."""
    # Families have different named tuples.
    signals: dict[str, Any]
    """Family -> its `Signals` in this step, whose entries have the shape (motors of the family,).
    """


class MotorForces(NamedTuple):
    """Controls of a step that contain the motors' forces."""

    controls: Array
    """Control of each actuator; for one with a motor it is the motor's force."""
    state: MotorState
    """State of the motors after the step."""
    signals: dict[str, Any]
    """As in `MotorStep`."""


class MotorGroup(NamedTuple):
    """Motors of one family."""

    family: Family
    """The family."""
    numbers: np.ndarray
    """Numbers of the motors in `SimulatorModel.motors`."""
    motors: tuple[SimulatorMotor, ...]
    """The motors."""
    varying: tuple[str, ...]
    """Dotted paths of the parameters that are arguments of a step. Others are constants."""


class MJXMotors:
    """Motors of a model in MJX.

    >>> robot = prepare_model("robot.xml", {".*hip": "maxon-ec45-flat-50w"})
    >>> motors = MJXMotors(robot)
    >>> model, state = mjx.put_model(motors.model), motors.init()
    >>> data = mjx.make_data(model)
    >>> data, state, signals = jax.jit(motors.step)(model, data, state, controls)
    """

    def __init__(
        self,
        robot: SimulatorModel,
        *,
        randomize: object = None,
        varying: Sequence[str] = (),
        max_iterations: int | None = None,
    ) -> None:
        """Compile the model.

        Args:
            robot: the result of `prepare_model`.
            randomize: distributions of parameters, for `draw`, as for an environment.
            varying: dotted paths of further parameters that are arguments of a step.
            max_iterations: as for `codrl_mj.arrays.advance`; needed for reverse-mode derivatives.

        Raises:
            ValueError: an unknown path, or one that also changes the joint; or `WorldDraws` refuses
                the distributions.
        """
        self._robot, self._max_iterations = robot, max_iterations
        self._draws = WorldDraws(robot, randomize)
        paths = [parameter_paths(type(motor.actuator)).values() for motor in robot.motors]
        check_names(varying, {path for of_motor in paths for path in of_motor}, "parameter")
        self._original: mujoco.MjModel = robot.spec.copy().compile()
        self.model: mujoco.MjModel = _with_forces_as_controls(robot)
        """Model for `mjx.put_model`. The control of an actuator with a motor is its force."""
        self.groups: tuple[MotorGroup, ...] = tuple(
            self._group(family, varying)
            for family in dict.fromkeys(type(motor.actuator) for motor in robot.motors)
        )
        """The motors of each family."""

    def _group(self, family: Family, varying: Sequence[str]) -> MotorGroup:
        motors = self._robot.motors
        numbers = [k for k, motor in enumerate(motors) if type(motor.actuator) is family]
        drawn = [path for number in numbers for path in self._draws.paths_of(number)]
        paths = [path for path in parameter_paths(family).values() if path in {*drawn, *varying}]
        for path in paths:
            for motor in (motors[number].actuator for number in numbers):
                if depends_on(
                    lambda actuator: (actuator.arm_radius, actuator.additions), motor, path
                ):
                    raise ValueError(
                        f"varying: {path}: it also changes the motor's arm, or the inertia or"
                        " friction of the joint, which are constants of the model: change other"
                        " parameters"
                    )
        return MotorGroup(
            family, np.array(numbers), tuple(motors[number] for number in numbers), tuple(paths)
        )

    def init(self, noise_keys: Array | None = None) -> MotorState:
        """Return the state of motors at rest.

        Args:
            noise_keys: keys of the sensors' noise, shape (motors,); 0 if None. Below 2**24 a
                32-bit float has every whole number.
        """
        real = jnp.zeros(0).dtype
        keys = jnp.zeros(len(self._robot.motors), real)
        if noise_keys is not None:
            keys = jnp.broadcast_to(jnp.asarray(noise_keys, real), keys.shape)
        families = {
            family_name(group.family): _make(
                group.family.State,
                [jnp.zeros(len(group.motors), real) for _ in group.family.State._fields],
            )
            for group in self.groups
        }
        return MotorState(jnp.zeros((), jnp.int32), keys, families)

    def reset(
        self, state: MotorState, is_reset: Array, noise_keys: Array | None = None
    ) -> MotorState:
        """Return a state in which the motors of some worlds are at rest.

        Args:
            state: the state of all worlds.
            is_reset: mask of worlds, shape (worlds,); or one bool for a state of one world.
            noise_keys: new keys for these worlds, shape (motors,) or (worlds, motors); None leaves
                the old ones.
        """
        is_reset = jnp.asarray(is_reset)

        def choose(new: Array, old: Array) -> Array:
            missing = (1,) * (old.ndim - is_reset.ndim)
            return jnp.where(is_reset.reshape(is_reset.shape + missing), new, old)

        fresh = self.init()._replace(noise_keys=state.noise_keys)
        if noise_keys is not None:
            fresh = fresh._replace(noise_keys=jnp.asarray(noise_keys, state.noise_keys.dtype))
        chosen: MotorState = jax.tree.map(choose, fresh, state)
        return chosen

    def parameters(self) -> Parameters:
        """Return the parameters that are arguments of a step, with the values of the motors."""
        return {
            family_name(group.family): {
                path: jnp.asarray(_column(group, path), jnp.zeros(0).dtype)
                for path in group.varying
            }
            for group in self.groups
        }

    def draw(self, generator: np.random.Generator, num_worlds: int) -> Parameters:
        """Draw parameters on the host, arrays of shape (num_worlds, motors of the family).

        Raises:
            ValueError: see `WorldDraws.draw`.
        """
        values = self._draws.draw(generator, num_worlds)
        drawn: Parameters = {}
        for group in self.groups:
            tables = {
                path: np.tile(_column(group, path), (num_worlds, 1)) for path in group.varying
            }
            for column, number in enumerate(group.numbers):
                for field, path in self._draws.paths_of(number).items():
                    tables[field][:, column] = values[path]
            real = jnp.zeros(0).dtype
            drawn[family_name(group.family)] = {
                path: jnp.asarray(table, real) for path, table in tables.items()
            }
        return drawn

    def step(
        self,
        model: Model,
        data: Data,
        state: MotorState,
        controls: Array,
        parameters: Parameters | None = None,
    ) -> MotorStep:
        """Advance simulation and motors by a step, in place of `mjx.step`.

        Args:
            model: `mjx.put_model` of `self.model`.
            data: data of one world; `jax.vmap` maps the function to many.
            state: state of the motors, of `init` or of the last step.
            controls: controls of the original model, shape (actuators,).
            parameters: values of `parameters` or `draw`; None: those of the motors.
        """
        forces = self.forces(model, data, state, controls, parameters)
        after = mjx.step(model, data.replace(ctrl=forces.controls))
        return MotorStep(after, forces.state, forces.signals)

    def forces(
        self,
        model: Model,
        data: Data,
        state: MotorState,
        controls: Array,
        parameters: Parameters | None = None,
    ) -> MotorForces:
        """Return the motors' forces in a step, without a step of the simulation.

        The arguments are those of `step`.
        """
        real = data.qpos.dtype
        controls = jnp.asarray(controls, real)
        shafts = _Shafts.of(self._original, data)
        clipped = _clipped(self._original, controls)
        desired = _desired_forces(self._original, clipped, shafts)
        inertia = self._inertia(model, data)
        families, signals = {}, {}
        for group in self.groups:
            name = family_name(group.family)
            indices = np.array([motor.actuator_index for motor in group.motors])
            arms = jnp.asarray([motor.actuator.arm_radius for motor in group.motors], real)
            commands = clipped[indices] / arms if group.family.MOTION else desired[indices] * arms
            inputs = Inputs(
                commands,
                shafts.length[indices] / arms,
                shafts.speed[indices] / arms,
                jnp.broadcast_to(state.steps * self._robot.timestep, arms.shape).astype(real),
                state.noise_keys[group.numbers],
                jnp.inf if inertia is None else inertia[indices] * arms * arms,
            )
            result = advance(
                group.family,
                jnp,
                _parameter_values(group, (parameters or {}).get(name, {}), real),
                self._robot.timestep,
                state.families[name],
                inputs,
                self._max_iterations,
            )
            families[name], signals[name] = result.state, result.signals
            if group.family is not Ideal:
                limits = [(motor.min_force, motor.max_force) for motor in group.motors]
                low, high = jnp.asarray(limits, real).T
                controls = controls.at[indices].set(jnp.clip(result.torque / arms, low, high))
        return MotorForces(
            controls, MotorState(state.steps + 1, state.noise_keys, families), signals
        )

    def _inertia(self, model: Model, data: Data) -> Array | None:
        """Return 1/(m*M^-1*m) for all actuators, where a motor needs it; None if none does.

        M is the inertia matrix at the positions of the data, and m the gear times the row of the
        actuator's joint.
        """
        groups = [group for group in self.groups if group.family.INERTIA]
        if not groups:
            return None
        original = self._original
        indices = [motor.actuator_index for group in groups for motor in group.motors]
        dofs = original.jnt_dofadr[original.actuator_trnid[indices, 0]]
        rows = np.zeros((len(indices), original.nv))
        rows[np.arange(len(indices)), dofs] = original.actuator_gear[indices, 0]
        moments = jnp.asarray(rows, data.qpos.dtype)
        # mjx.step computes the same again, and the compiler merges both.
        data = mjx.crb(model, mjx.com_pos(model, mjx.kinematics(model, data)))
        factor = jax.scipy.linalg.cho_factor(mjx.full_m(model, data))
        solutions = jax.scipy.linalg.cho_solve(factor, moments.T)
        inertia = jnp.full(original.nu, jnp.inf, moments.dtype)
        return inertia.at[np.array(indices)].set(1.0 / jnp.sum(moments.T * solutions, axis=0))


class _Shafts(NamedTuple):
    """Positions and speeds of all actuators; 0 for those that drive no hinge and no slide."""

    length: Array
    speed: Array

    @classmethod
    def of(cls, model: mujoco.MjModel, data: Data) -> "_Shafts":
        """Return the positions and speeds of a simulation."""
        is_driving_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
        joints = np.where(is_driving_joint, model.actuator_trnid[:, 0], 0)
        gear = jnp.asarray(
            np.where(is_driving_joint, model.actuator_gear[:, 0], 0.0), data.qpos.dtype
        )
        return cls(
            gear * data.qpos[model.jnt_qposadr[joints]], gear * data.qvel[model.jnt_dofadr[joints]]
        )


def _with_forces_as_controls(robot: SimulatorModel) -> mujoco.MjModel:
    """Return the compiled model in which the controls of actuators with motors are forces.

    An ideal motor leaves its actuator as it is, so that it follows its command within RK4.
    """
    spec = robot.spec.copy()
    for motor in robot.motors:
        if isinstance(motor.actuator, Ideal):
            continue
        target = spec.actuators[motor.actuator_index]
        target.gaintype, target.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE
        target.gainprm[:], target.biasprm[:] = [1.0] + [0.0] * (mujoco.mjNGAIN - 1), 0.0
        target.ctrllimited = target.forcelimited = int(mujoco.mjtLimited.mjLIMITED_FALSE)
    return spec.compile()


def _clipped(model: mujoco.MjModel, controls: Array) -> Array:
    """Return controls within their ranges."""
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL):
        return controls
    return _limited(controls, model.actuator_ctrllimited, model.actuator_ctrlrange)


def _limited(values: Array, is_limited: np.ndarray, ranges: np.ndarray) -> Array:
    limits = np.where(is_limited[:, np.newaxis], ranges, [-np.inf, np.inf])
    low, high = jnp.asarray(limits, values.dtype).T
    return jnp.clip(values, low, high)


def _desired_forces(model: mujoco.MjModel, controls: Array, shafts: _Shafts) -> Array:
    """Return the forces that the actuators of the original model would deliver by themselves.

    `prepare_model` has refused motors behind other kinds of gain and bias than these.
    """
    is_affine_gain = model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_AFFINE)
    is_affine_bias = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
    gains, biases = model.actuator_gainprm[:, :3].copy(), model.actuator_biasprm[:, :3].copy()
    gains[~is_affine_gain, 1:], biases[~is_affine_bias] = 0.0, 0.0
    states = jnp.stack([jnp.ones_like(shafts.length), shafts.length, shafts.speed], axis=1)
    gain, bias = (
        jnp.sum(jnp.asarray(table, states.dtype) * states, axis=1) for table in (gains, biases)
    )
    return _limited(gain * controls + bias, model.actuator_forcelimited, model.actuator_forcerange)


def _column(group: MotorGroup, path: str) -> np.ndarray:
    """Return the values of a parameter, shape (motors,)."""
    index = list(parameter_paths(group.family).values()).index(path)
    return np.array([motor.actuator.parameter_values[index] for motor in group.motors])


def _parameter_values(
    group: MotorGroup, values: Mapping[str, Array], real: Any
) -> tuple[object, ...]:
    """Return the parameters of a group: given values, a constant, or different constants.

    Raises:
        ValueError: a value is given for a path that is not varying.
    """
    check_names(values, group.varying, "varying parameter", f"{family_name(group.family)}: ")
    entries: list[object] = []
    for path in parameter_paths(group.family).values():
        column = _column(group, path)
        is_constant = bool((column == column[0]).all())
        constant = float(column[0]) if is_constant else jnp.asarray(column, real)
        entries.append(jnp.asarray(values[path], real) if path in values else constant)
    return _make(parameters_type(group.family), entries)


def _make(kind: Any, entries: Sequence[object]) -> tuple[object, ...]:
    """Return a named tuple of a family with arrays as entries."""
    result: tuple[object, ...] = kind(*entries)
    return result
