"""What is seen of the motors in somebody else's model."""

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel, Family, Inputs, parameters_type
from codrl_mj.engine.families import signals_at
from codrl_mj.engine.reading import Readout, slots
from codrl_mj.foreign.recording import motor_names


def readings(readout: Readout, data: mujoco.MjData) -> dict[str, Any]:
    """The motors' signals after the last step, as `info` has them.

    Args:
        readout: of the model.
        data: a simulation of it.

    Returns:
        `desired_force`, `actual_force`, the families' signals and `saturated` (bool), each a number where there is one
        motor, else an array (n_motors,); units as `Readout` has them.
    """
    table, alone = readout.table(data), len(readout.motors) == 1
    found: dict[str, Any] = dict(zip(readout.names, table[:, 0].tolist() if alone else table, strict=True))
    if "saturated" in found:
        found["saturated"] = found["saturated"] > 0.0  # which NaN is not
    else:
        found["saturated"] = False if alone else np.zeros(table.shape[1], dtype=bool)
    return found


class Sensors:
    """What the sensors of a simulation's motors say: the `OBSERVED` of each motor's family, motor by motor."""

    def __init__(self, data: mujoco.MjData, motors: Mapping[int, ActuatorModel]) -> None:
        """Find them.

        Args:
            data: the simulation.
            motors: as `codrl_mj.motors` reads them.

        Raises:
            ValueError: no motor has anything to observe.
        """
        self._data, model = data, data.model
        observed = {index: motor for index, motor in motors.items() if motor.OBSERVED}
        if not observed:
            kinds = ", ".join(sorted({one.family or type(one).__name__ for one in motors.values()}))
            raise ValueError(
                f"observe_actuator=True: there is nothing to observe of {kinds}; choose another actuator, such as a "
                "motor of the catalogue"
            )
        self.names = tuple(
            f"{own}.{name}"
            for own, one in zip(motor_names(model, observed), observed.values(), strict=True)
            for name in one.OBSERVED
        )
        views = slots(data, observed)
        self._rows: list[tuple[Any, Any, np.ndarray]] = [
            (type(one), parameters_type(_family(one))(*one.numbers), views[index]) for index, one in observed.items()
        ]

    def seen(self) -> np.ndarray:
        """What they say now, shape (k,), float64, entries as in `names`."""
        values: list[float] = []
        for family, parameters, slot in self._rows:
            start, count = signals_at(family), len(family.Signals._fields)
            signals = family.Signals(*slot[start : start + count].tolist())
            inputs = Inputs(0.0, 0.0, 0.0, self._data.time, float(slot[1]))
            values += family.observe(parameters, self._data.model.opt.timestep, signals, inputs)
        return np.array(values)


def _family(motor: ActuatorModel) -> Family:
    return type(motor)
