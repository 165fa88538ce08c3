"""Our motors in mujoco_warp: `attach_motors`.

mujoco_warp computes the forces of a model's actuators, and then calls `Callback.act_bias`. There
our kernels take these forces as commands, and replace them by the forces of the motors. No actuator
of the model is changed, and `Data.ctrl` stays the user's.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import mujoco
import numpy as np

from codrl_mj.actuators import Ideal, parameter_paths
from codrl_mj.arrays.c_code import Real
from codrl_mj.arrays.draws import WorldDraws
from codrl_mj.arrays.models import SimulatorModel, SimulatorMotor
from codrl_mj.arrays.warp import Array, StepArrays, WarpActuators, host_indices
from codrl_mj.arrays.warp_inertia import ActuatorInertia, Data, Model
from codrl_mj.fields import check_names

_RK4 = int(mujoco.mjtIntegrator.mjINT_RK4)


class AttachedMotors:
    """Motors that act in a simulation of mujoco_warp; `attach_motors` creates them."""

    def __init__(
        self,
        robot: SimulatorModel,
        model: Model,
        data: Data,
        draws: WorldDraws,
        generator: np.random.Generator,
        varying: Sequence[str],
        per_world: bool,
        real: Real,
    ) -> None:
        """Create the kernels and tables; see `attach_motors`."""
        self._robot, self._draws, self._generator = robot, draws, generator
        self._numbers: list[list[int]] = []
        """For each group: its motors' numbers in `robot.motors`."""
        families = dict.fromkeys(type(motor.actuator) for motor in robot.motors)
        groups = []
        for family in families:
            numbers = [
                number
                for number, motor in enumerate(robot.motors)
                if type(motor.actuator) is family
            ]
            motors: list[SimulatorMotor] = [robot.motors[number] for number in numbers]
            drawn = [field for number in numbers for field in draws.paths_of(number)]
            groups.append(
                WarpActuators(
                    [motor.actuator for motor in motors],
                    data.nworld,
                    robot.timestep,
                    columns=[motor.actuator_index for motor in motors],
                    force_limits=[(motor.min_force, motor.max_force) for motor in motors],
                    varying={*drawn, *varying} & {*parameter_paths(family).values()},
                    per_world=per_world or bool(drawn),
                    # An ideal motor follows its command in all stages, as in our engine.
                    holds_stages=robot.integrator == _RK4 and family is not Ideal,
                    device=data.qpos.device,
                    real=real,
                )
            )
            self._numbers.append(numbers)
        self.groups: tuple[WarpActuators, ...] = tuple(groups)
        """The motors of each family: their parameters, states and signals."""
        needing = [column for group in groups if group.family.INERTIA for column in group.columns]
        self._inertia = ActuatorInertia(model, data, needing) if needing else None

    def __call__(self, model: Model, data: Data) -> None:
        """Replace the forces of the motors' actuators; mujoco_warp calls this in each step."""
        inertia = None
        if self._inertia is not None:
            self._inertia.compute(model, data)
            inertia = self._inertia.inertia
        arrays = StepArrays(
            data.time,
            data.actuator_force,
            data.actuator_length,
            data.actuator_velocity,
            data.actuator_force,
            inertia,
        )
        for group in self.groups:
            group.step(arrays)

    def signal(self, name: str) -> Array:
        """Return a view of a signal in the last step, shape (worlds, motors of the family).

        Raises:
            ValueError: no family, or more than one, has such a signal; use `groups` then.
        """
        groups = [group for group in self.groups if name in group.family.Signals._fields]
        return _only(groups, name).signal(name)

    def parameter(self, path: str) -> Array:
        """Return a view of a parameter, shape (worlds or 1, motors of the family), to be written.

        Args:
            path: dotted path, which is drawn or one of `varying`.

        Raises:
            ValueError: no family, or more than one, has such a parameter; use `groups` then.
        """
        groups = [group for group in self.groups if path in parameter_paths(group.family).values()]
        return _only(groups, path).parameter(path)

    def reset(self, worlds: object = None) -> None:
        """Bring motors of worlds to rest at their next step; see `WarpActuators.reset`.

        `mujoco_warp.reset_data` needs no such call, because it sets the time back.
        """
        for group in self.groups:
            group.reset(worlds)

    def draw(self, worlds: object = None) -> dict[str, np.ndarray]:
        """Draw new values of the randomized parameters, on the host.

        Args:
            worlds: indices, a slice or a mask of worlds; None: all.

        Returns:
            Path -> values, shape (number of worlds,).

        Raises:
            ValueError: see `WorldDraws.draw`.
        """
        num_worlds = self.groups[0].num_worlds
        rows = np.arange(num_worlds)[slice(None) if worlds is None else host_indices(worlds)]
        values = self._draws.draw(self._generator, len(rows))
        for group, numbers in zip(self.groups, self._numbers, strict=True):
            for column, number in enumerate(numbers):
                for field, path in self._draws.paths_of(number).items():
                    view = group.parameter(field)
                    table = view.numpy()
                    table[rows, column] = values[path]
                    view.assign(table)
        return values

    def draw_noise_keys(self) -> None:
        """Give each sensor with noise a new key; call it at resets for other random numbers."""
        for group in self.groups:
            if group.family.RANDOM:
                group.draw_noise_keys(self._generator)


def _paths(motor: SimulatorMotor) -> Iterable[str]:
    """Return the dotted paths of a motor's parameters."""
    return parameter_paths(type(motor.actuator)).values()


def _only(groups: Sequence[WarpActuators], name: str) -> WarpActuators:
    """Return the only group of a list; `name` is for the message."""
    if len(groups) != 1:
        raise ValueError(f"{name}: {len(groups)} families have it, must be one: use `groups`")
    return groups[0]


def attach_motors(
    robot: SimulatorModel,
    model: Model,
    data: Data,
    *,
    randomize: object = None,
    seed: int = 0,
    varying: Sequence[str] = (),
    per_world: bool = False,
    real: Real = "double",
) -> AttachedMotors:
    """Let motors act in a simulation of mujoco_warp from the next step on.

        >>> robot = prepare_model("robot.xml", {".*hip": "maxon-ec45-flat-50w"})
        >>> model = mujoco_warp.put_model(robot.spec.compile())
        >>> data = mujoco_warp.make_data(robot.spec.compile(), nworld=4096)
        >>> motors = attach_motors(robot, model, data)
        >>> mujoco_warp.step(model, data)

    Args:
        robot: the result of `prepare_model`.
        model: model of mujoco_warp, from `robot.spec`.
        data: its data. Motors act in the data with these worlds only.
        randomize: distributions of parameters, drawn for each world, as for an environment.
        seed: seed of the draws, and of the keys of sensors' noise.
        varying: dotted paths of further parameters that can be changed.
        per_world: True if each world has its own parameters, also without `randomize`.
        real: precision of the motors; mujoco_warp's own is `float`.

    Returns:
        The motors, which `model.callback.act_bias` calls.

    Raises:
        ValueError: the model is not `robot`'s, or `WorldDraws` refuses the distributions.
        UnsupportedError: see `check_family`.
    """
    num_actuators, steps = len(robot.spec.actuators), np.unique(model.opt.timestep.numpy())
    if data.actuator_force.shape[1] != num_actuators:
        raise ValueError(
            f"model: has {data.actuator_force.shape[1]} actuators, must be the compiled"
            f" `robot.spec`, which has {num_actuators}"
        )
    if not np.allclose(steps, robot.timestep, rtol=1e-6, atol=0.0):
        raise ValueError(
            f"model.opt.timestep = {steps}: must be {robot.timestep:g}, for which the motors were"
            " checked: set it in the spec before `prepare_model`"
        )
    known = {path for motor in robot.motors for path in _paths(motor)}
    check_names(varying, known, "parameter")
    generator = np.random.default_rng(seed)
    draws = WorldDraws(robot, randomize)
    motors = AttachedMotors(robot, model, data, draws, generator, varying, per_world, real)
    if draws.distributions:
        motors.draw()
    motors.draw_noise_keys()
    before: Any = model.callback.act_bias

    def act_bias(model: Model, data: Data) -> None:
        if before is not None:
            before(model, data)
        motors(model, data)

    model.callback.act_bias = act_bias
    return motors
