"""Readout of our actuators from compiled models and their data, with either backend."""

import numbers
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from codrl_mj.actuators import (
    BUILT_IN,
    ActuatorModel,
    Family,
    family_id,
    import_path,
    parameters_type,
)
from codrl_mj.actuators.noise import MAX_KEY
from codrl_mj.engine import shafts
from codrl_mj.engine.families import (
    SIGNATURE,
    USER_HEADER_SIZE,
    compiled_advance,
    loaded_families,
    signals_offset,
    slot_size,
)
from codrl_mj.engine.mounting import arm_outside_gear
from codrl_mj.engine.plugin import EXTRA_STATES, PLUGIN_HEADER_SIZE, REASONS
from codrl_mj.plugin import FAMILY, NAME, registered_plugins


def motors(model: mujoco.MjModel) -> dict[int, ActuatorModel]:
    """Return our actuators in a compiled model, of both backends.

    Call this before you create an `MjData` from a model that was read from an `.mjb` file or a
    pickle. Such files refer to plugins by number, and MuJoCo runs any plugin that has this number.

    Args:
        model: any MuJoCo model.

    Returns:
        Index of the model's actuator -> our actuator, in ascending order.

    Raises:
        ValueError: an actuator has our signature but not our layout, or our plugin but not our
            signature; or a parameter is out of bounds; or the family is not known in this process.
            In the callback backend also: the actuator has a delay, which the callback does not see;
            a gain, whose force would add to the motor's; or limits of its activations, which are
            the motor's state.
    """
    actuators = {}
    plugin_slot = registered_plugins()[NAME][0]
    for index in range(model.nactuator):
        user, instance = model.actuator_user[index], model.actuator_plugin[index]
        has_plugin = instance >= 0 and model.plugin[instance] == plugin_slot
        is_signed = len(user) >= USER_HEADER_SIZE and tuple(user[:2]) == SIGNATURE
        if not has_plugin and not is_signed:
            continue
        if not is_signed and any(
            tuple(model.actuator_user[partner][:2]) == SIGNATURE
            for partner in actuators_sharing_motor(model, index)
        ):
            # Its force is part of the command of another actuator's motor.
            continue
        try:
            actuators[index] = _motor_at(model, index, plugin_slot)
        except ValueError as error:
            raise ValueError(
                f"{model.actuator(index).name or f'actuator {index}'}: {error}"
            ) from None
    return actuators


def actuators_sharing_motor(model: mujoco.MjModel, index: int) -> list[int]:
    """Return the indices of the actuators that share a motor with an actuator, itself included."""
    instance = model.actuator_plugin[index]
    return [index] if instance < 0 else np.flatnonzero(model.actuator_plugin == instance).tolist()


def _motor_at(model: mujoco.MjModel, index: int, plugin_slot: int) -> ActuatorModel:
    """Return the motor of one of our actuators; `plugin_slot` is our plugin's number in MuJoCo."""
    user, instance = model.actuator_user[index], model.actuator_plugin[index]
    uses_plugin = instance >= 0
    if uses_plugin and model.plugin[instance] != plugin_slot:
        raise ValueError(
            f"plugin slot = {model.plugin[instance]}: a motor of codrl_mj needs {plugin_slot}, the"
            " slot of its plugin. The model was compiled in a process with other plugins: compile"
            " it in this process, from XML or a spec"
        )
    if uses_plugin and (len(user) < PLUGIN_HEADER_SIZE or tuple(user[:2]) != SIGNATURE):
        raise ValueError(REASONS[1])
    families: dict[float, Family] = {
        family_id(family): family for family in (*BUILT_IN, *loaded_families())
    }
    family = families.get(user[2])
    if family is None:
        raise ValueError(
            f"family {user[2]:g} is not known in this process: import its module and call "
            "codrl_mj.engine.load_family first; if an earlier version of codrl_mj saved the model,"
            " build it again, because a family's number changes with the name of its class"
        )
    size, names = slot_size(family), parameters_type(family)._fields
    if uses_plugin:
        name = (
            bytes(model.plugin_attr[model.plugin_attradr[instance] :]).partition(b"\0")[0].decode()
        )
        if name != import_path(family):
            raise ValueError(
                f"{FAMILY} = {name!r} of its plugin: must be {import_path(family)!r}, as in its"
                " user data"
            )
        if model.plugin_statenum[instance] != size + EXTRA_STATES:
            raise ValueError(REASONS[5])
        header_size, arm = PLUGIN_HEADER_SIZE, user[USER_HEADER_SIZE]
    else:
        expected = {
            "dyntype": (model.actuator_dyntype[index], mujoco.mjtDyn.mjDYN_USER, 'dyntype="user"'),
            "biastype": (
                model.actuator_biastype[index],
                mujoco.mjtBias.mjBIAS_USER,
                'biastype="user"',
            ),
            "actdim": (model.actuator_actnum[index], size, f'actdim="{size}"'),
            "delay": (model.actuator_delay[index], 0.0, 'delay="0"'),
            "gaintype": (
                model.actuator_gaintype[index],
                mujoco.mjtGain.mjGAIN_FIXED,
                'gaintype="fixed"',
            ),
            "gainprm": (model.actuator_gainprm[index, 0], 0.0, 'gainprm="0"'),
            "actlimited": (model.actuator_actlimited[index], False, 'actlimited="false"'),
        }
        for field, (value, required, remedy) in expected.items():
            if value != required:
                raise ValueError(f"{field} = {value:g}: a motor of codrl_mj needs {remedy}")
        gear = model.actuator_gear[model.actuator_outadr[index]]
        if not gear[0] > 0 or np.any(gear[1:]):
            raise ValueError(
                f"gear = {gear}: a motor of codrl_mj needs gear = 1/arm > 0 and no other entry"
            )
        header_size, arm = USER_HEADER_SIZE, 1.0 / gear[0]
    if len(user) < header_size + len(names):
        raise ValueError(
            f"user = {list(user)}: a {family.__name__} needs {header_size} numbers and"
            f" {', '.join(names)}"
        )
    actuator: ActuatorModel = family.from_parameter_values(
        user[header_size : header_size + len(names)], arm
    )
    return actuator


def motor_slots(
    data: mujoco.MjData, actuators: Mapping[int, ActuatorModel]
) -> dict[int, np.ndarray]:
    """Return views of the motors' slots by index; a plugin's view includes its `EXTRA_STATES`."""
    model, slots = data.model, {}
    for index, actuator in actuators.items():
        instance, family = model.actuator_plugin[index], type(actuator)
        start = model.actuator_actadr[index] if instance < 0 else model.plugin_stateadr[instance]
        size = slot_size(family) + (0 if instance < 0 else EXTRA_STATES)
        slots[index] = (data.act if instance < 0 else data.plugin_state)[start : start + size]
    return slots


def clear_motors(data: mujoco.MjData, noise_keys: Sequence[int] | None = None) -> None:
    """Bring all motors of a simulation to rest at its present time, as `mj_resetData` does.

    Call this after you set positions and velocities during an episode, and at the start of an
    episode if sensors have noise: each key gives different random numbers.

    Args:
        data: the simulation.
        noise_keys: a whole number from 0 to 2**53 - 1 for each motor. None keeps the present keys,
            which are 0 after a reset.

    Raises:
        ValueError: `motors` refuses the model, the number of keys differs from the number of
            motors, or a key is not such a number; no motor has been changed.
    """
    slots = list(motor_slots(data, motors(data.model)).values())
    keys = (
        [slot[1] for slot in slots]
        if noise_keys is None
        else np.ravel(np.array(noise_keys, dtype=object)).tolist()
    )
    if len(keys) != len(slots):
        raise ValueError(
            f"noise_keys: got {len(keys)} keys, must be {len(slots)}: one for each motor of the"
            " model"
        )
    for index, key in enumerate(keys):
        if not (isinstance(key, numbers.Real) and 0 <= key < MAX_KEY and key % 1 == 0):  # type: ignore[operator]
            raise ValueError(
                f"noise_keys[{index}] = {key!r}: must be a whole number from 0 to 2**53 - 1, so"
                " that a float64 holds it exactly"
            )
    for slot, key in zip(slots, keys, strict=True):
        bring_to_rest(slot, data.time, key)


def bring_to_rest(slot: np.ndarray, time: float, noise_key: float) -> None:
    """Clear a motor's slot, a view from `motor_slots`, at a time [s]."""
    slot[:] = 0.0
    slot[:2] = time, noise_key


def check_shafts(
    model: mujoco.MjModel,
    allow_unstable: bool = False,
    held: bool = False,
    actuators: Mapping[int, ActuatorModel] | None = None,
    explicit: bool = False,
) -> float:
    """Raise an error if actuators are unstable with the joints that they move.

    Args:
        model: a compiled model.
        allow_unstable: True to return instead of raising an error.
        held: True if actuators are simulated without the inertia, at a constant speed over a step.
        actuators: actuators by index; the model's own if None.
        explicit: True if positions are integrated with the previous speeds (explicit Euler).

    Returns:
        See `codrl_mj.engine.shafts.check_shafts`.

    Raises:
        UnstableError: the loops are unstable; the message has the spectral radius and a remedy.
    """
    closing = {
        index: actuator
        for index, actuator in (actuators or motors(model)).items()
        if actuator.closes_loops
    }
    arms = {index: arm_outside_gear(model, index, motor) for index, motor in closing.items()}
    return shafts.check_shafts(
        model, closing, arms, allow_unstable, held, explicit, compiled_advance
    )


class Readout:
    """Fast reader of the signals of all motors of a model, one array for each signal.

    Args:
        model: a compiled model.

    Raises:
        ValueError: as for `motors`.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        """Compute the indices of the signals in the simulation's state."""
        self.motors = motors(model)
        indices = np.array(list(self.motors), dtype=int)
        families: list[Family] = [type(actuator) for actuator in self.motors.values()]
        out, instances = model.actuator_outadr[indices], model.actuator_plugin[indices]
        uses_plugin, torque_controlled = (
            instances >= 0,
            np.array([family.is_torque_controlled for family in families], dtype=bool),
        )
        self._plugin_use = uses_plugin.all(), uses_plugin.any()
        # Indices refer to the vector that `table` reads: activations, plugin states, or, if the
        # model has motors in both backends, the activations followed by the plugin states.
        in_plugin = model.plugin_stateadr[instances] if model.nplugin else 0
        first = 0 if uses_plugin.all() else model.na
        starts = np.where(uses_plugin, first + in_plugin, model.actuator_actadr[indices])
        last = np.array([slot_size(family) for family in families], dtype=int)
        desired = np.where(uses_plugin & torque_controlled, starts + last, -1)
        columns = {"desired_force": desired, "actual_force": np.full(len(families), -1)}
        for motor, (start, family) in enumerate(zip(starts, families, strict=True)):
            for column, name in enumerate(family.Signals._fields, start + signals_offset(family)):
                columns.setdefault(name, np.full(len(families), -1))[motor] = column
        self.names = tuple(columns)
        """Names of the signals, in order."""
        self._columns = np.stack(list(columns.values()))
        # With another integer type numpy would convert the indices at each use.
        self._out = out.astype(np.intp)
        missing = self._columns == -1
        self._desired_is_actual, missing[:2] = np.flatnonzero(missing[0]), False
        self._missing = missing if missing.any() else None
        # In the callback backend the arm is part of the gear, and forces are those of the shaft.
        self._in_callback = np.flatnonzero(~uses_plugin)
        self._gear = np.where(uses_plugin, 1.0, model.actuator_gear[out, 0])
        self._command_is_desired = np.flatnonzero(~uses_plugin & torque_controlled)
        self._control = model.actuator_ctrladr[indices[self._command_is_desired]]
        limited = model.actuator_ctrllimited[self._control].astype(bool)
        low, high = model.actuator_ctrlrange[self._control].T
        self._low, self._high = np.where(limited, low, -np.inf), np.where(limited, high, np.inf)

    def table(self, data: mujoco.MjData) -> np.ndarray:
        """Return the signals after the last step or `mj_forward`, shape (k, n_motors).

        The rows are those of `names`.

        Args:
            data: a simulation of the model.
        """
        all_plugins, any_plugin = self._plugin_use
        states = (
            data.plugin_state
            if all_plugins
            else np.append(data.act, data.plugin_state)
            if any_plugin
            else data.act
        )
        table: np.ndarray = states[self._columns]
        table[1] = data.actuator_force[self._out]
        if self._desired_is_actual.size:
            table[0, self._desired_is_actual] = table[1, self._desired_is_actual]
        if self._missing is not None:
            table[self._missing] = np.nan
        if self._in_callback.size:
            table[:2] *= self._gear
            controls = data.ctrl[self._control]
            if not data.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
                controls = np.clip(controls, self._low, self._high)
            table[0, self._command_is_desired] = controls * self._gear[self._command_is_desired]
        return table

    def __call__(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        """Return the rows of `table` by name.

        Args:
            data: a simulation of the model.

        Returns:
            Name -> array (n_motors,). `desired_force` and `actual_force` [N], or torques [N*m], are
            on the joint's side of the arm, but before the gear of a model with the plugin backend.
            Signals of the families follow; NaN if a motor's family has no signal of that name.
        """
        return dict(zip(self.names, self.table(data), strict=True))


def signals(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, np.ndarray]:
    """Return the signals of all motors; for repeated use, a `Readout` of the model is faster.

    Raises:
        ValueError: as for `motors`.
    """
    return Readout(model)(data)
