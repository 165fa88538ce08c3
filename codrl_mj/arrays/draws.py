"""Parameters of motors drawn for each world of a simulator: `WorldDraws`."""

import itertools
import random
from collections.abc import Mapping

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel, UnstableError, parameter_paths
from codrl_mj.arrays.models import SimulatorModel
from codrl_mj.engine.matching import match_pattern
from codrl_mj.engine.shafts import check_shafts
from codrl_mj.envs.distributions import MODEL, Distribution, parse_randomize, split_pattern
from codrl_mj.envs.motor_fields import check_motor_field, depends_on
from codrl_mj.fields import check_names

MAX_REDRAWS = 1000
"""Number of consecutive unstable draws of a world after which drawing fails."""
MAX_CORNERS = 32
"""Maximum number of combinations of bounds to check; if there are more, a sample is checked."""


class WorldDraws:
    """Distributions of motors' parameters, and values drawn from them for each world.

    A world whose motors would be unstable is drawn again as a whole.
    """

    def __init__(self, robot: SimulatorModel, randomize: object) -> None:
        """Check the distributions.

        Args:
            robot: the model with its motors.
            randomize: paths and distributions, as for an environment's `randomize`. A path is FIELD
                or PATTERN:FIELD.

        Raises:
            ValueError: a path is unknown, or its field cannot be drawn for each world; a value is
                out of bounds; or a combination of bounds makes position or speed loops unstable.
        """
        self._robot = robot
        self.distributions: dict[str, Distribution] = parse_randomize(randomize)
        """Path -> distribution, in the order of drawing."""
        self._fields: list[dict[str, str]] = [{} for _ in robot.motors]
        """For each motor: field -> path of its distribution."""
        for path, distribution in self.distributions.items():
            try:
                self._match(path, distribution)
            except ValueError as error:
                raise ValueError(f"randomize[{path!r}] = {distribution}: {error}") from None
        if self.distributions and not robot.allow_unstable:
            self._check_corners()

    def _match(self, path: str, distribution: Distribution) -> None:
        """Give a distribution to the motors that its path matches."""
        pattern, field = split_pattern(path)
        if field.startswith(MODEL):
            raise ValueError("it is the model's: draw it with the simulator's own functions")
        names = [list(names) for names in self._robot.names]
        numbers = match_pattern(pattern, names) if pattern else range(len(names))
        for number in numbers:
            motor = self._robot.motors[number].actuator
            if field in self._fields[number]:
                raise ValueError("it is drawn by another pattern, too")
            check_names([field], parameter_paths(type(motor)).values(), "parameter")
            check_motor_field(field, distribution, motor, {})
            if depends_on(lambda actuator: actuator.additions, motor, field):
                raise ValueError(
                    "it also changes the inertia or friction of the joint, which is the same in all"
                    " worlds: draw other fields"
                )
            self._fields[number][field] = path

    def paths_of(self, number: int) -> Mapping[str, str]:
        """Return field -> path of its distribution, for the drawn fields of a motor."""
        return self._fields[number]

    def draw(self, generator: np.random.Generator, num_worlds: int) -> dict[str, np.ndarray]:
        """Return path -> drawn values, shape (num_worlds,).

        Raises:
            ValueError: `MAX_REDRAWS` draws of a world in a row are unstable.
        """
        values = {path: np.empty(num_worlds) for path in self.distributions}
        pending = np.arange(num_worlds)
        for _ in range(MAX_REDRAWS):
            for path, distribution in self.distributions.items():
                values[path][pending] = distribution.transform(generator.random(len(pending)))
            drawn = {path: column[pending] for path, column in values.items()}
            if self._robot.allow_unstable or not self.distributions:
                return values
            pending = pending[self._unstable(drawn, len(pending))]
            if not len(pending):
                return values
        last = {path: float(column[pending[0]]) for path, column in values.items()}
        raise ValueError(
            f"randomize: {MAX_REDRAWS} draws in a row are unstable at a step of"
            f" {self._robot.timestep:g} s; the last was {last}. Narrow the bounds, shorten the"
            " step, or pass allow_unstable=True"
        )

    def _unstable(self, values: Mapping[str, np.ndarray], num_worlds: int) -> np.ndarray:
        """Return a mask of the worlds with an unstable motor, shape (num_worlds,)."""
        unstable = np.zeros(num_worlds, dtype=bool)
        for motor, fields in zip(self._robot.motors, self._fields, strict=True):
            family = type(motor.actuator)
            rows = np.tile(np.array(motor.actuator.parameter_values), (num_worlds, 1))
            paths = list(parameter_paths(family).values())
            for field, path in fields.items():
                rows[:, paths.index(field)] = values[path]
            if fields:
                unstable |= ~(family.instability(rows, self._robot.timestep) < 1.0)
        return unstable

    def _check_corners(self) -> None:
        """Raise if a combination of bounds makes loops of position or speed unstable."""
        motors = self._robot.motors
        if not any(motor.actuator.closes_loops for motor in motors):
            return
        bounds = [
            (min(distribution.extremes), max(distribution.extremes))
            for distribution in self.distributions.values()
        ]
        corners = list(itertools.islice(itertools.product(*bounds), 2**12))
        if len(corners) > MAX_CORNERS:
            corners = random.Random(0).sample(corners, MAX_CORNERS)
        model = self._robot.spec.copy().compile()
        for corner in corners:
            self._check_corner(model, dict(zip(self.distributions, corner, strict=True)))

    def _check_corner(self, model: mujoco.MjModel, values: Mapping[str, float]) -> None:
        """Raise if motors with these values, path -> value, are unstable with their joints."""
        actuators: dict[int, ActuatorModel] = {}
        for motor, fields in zip(self._robot.motors, self._fields, strict=True):
            changes = {field: values[path] for field, path in fields.items()}
            actuators[motor.actuator_index] = motor.actuator.replaced(changes)
        try:
            for actuator in actuators.values():
                actuator.check(self._robot.timestep)
        except ValueError:
            # Such values are drawn again, so they are no error.
            return
        arms = {index: actuator.arm_radius for index, actuator in actuators.items()}
        try:
            check_shafts(model, actuators, arms)
        except UnstableError as error:
            text = ", ".join(f"{path} = {value:g}" for path, value in values.items())
            raise ValueError(f"randomize: {text}: {error}; or narrow the bounds") from None
