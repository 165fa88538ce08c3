"""What compiled models and their data say of our actuators, at either door."""

import numbers
from collections.abc import Callable, Collection, Mapping, Sequence

import mujoco
import numpy as np

from codrl_mj.actuators import (
    BUILT_IN,
    ActuatorModel,
    Family,
    UnstableError,
    family_id,
    parameters_type,
    import_path,
    stability,
)
from codrl_mj.actuators.noise import MAX_KEY
from codrl_mj.engine.doors import shaft_inertia
from codrl_mj.engine.families import (
    HEAD,
    SIGNATURE,
    compiled_advance,
    loaded_families,
    signals_at,
    slot_size,
)
from codrl_mj.engine.plugin import EXTRA_STATES, PLUGIN_HEAD, REASONS
from codrl_mj.plugin import FAMILY, NAME, registered


def motors(model: mujoco.MjModel) -> dict[int, ActuatorModel]:
    """Our actuators in a compiled model, at both doors.

    To be called before an `MjData` is made of a model from an `.mjb` file or a pickle, whose motors
    might not be what they were: MuJoCo runs whatever plugin has the number that such a file has
    kept.

    Args:
        model: any MuJoCo model.

    Returns:
        The actuator by its index, in order.

    Raises:
        ValueError: an actuator carries our signature but not our layout, or a parameter out of
            bounds; its plugin is not ours, or ours and it does not carry the signature; its family
            is not known in this process; or, at the control callback's door, it uses MuJoCo's
            actuator delay, which the callback does not see, a gain, which would add to the motor's
            torque, or limits of its activations, which are the motor's state.
    """
    found = {}
    slot = registered()[NAME][0]
    for index in range(model.nactuator):
        user, instance = model.actuator_user[index], model.actuator_plugin[index]
        ours = instance >= 0 and model.plugin[instance] == slot
        signed = len(user) >= HEAD and tuple(user[:2]) == SIGNATURE
        if not ours and not signed:
            continue
        if not signed and any(
            tuple(model.actuator_user[one][:2]) == SIGNATURE for one in sharing(model, index)
        ):
            continue  # its force is asked of the motor of another actuator
        try:
            found[index] = _motor_at(model, index, slot)
        except ValueError as error:
            raise ValueError(
                f"{model.actuator(index).name or f'actuator {index}'}: {error}"
            ) from None
    return found


def sharing(model: mujoco.MjModel, index: int) -> list[int]:
    """Return the indices of the actuators that share a motor with an actuator, itself among them."""
    instance = model.actuator_plugin[index]
    return [index] if instance < 0 else np.flatnonzero(model.actuator_plugin == instance).tolist()


def _motor_at(model: mujoco.MjModel, index: int, slot: int) -> ActuatorModel:
    """The motor of an actuator that is ours; `slot` is where our plugin is."""
    user, instance = model.actuator_user[index], model.actuator_plugin[index]
    behind_plugin = instance >= 0
    if behind_plugin and model.plugin[instance] != slot:
        raise ValueError(
            f"plugin slot = {model.plugin[instance]}: a motor of codrl_mj needs {slot}, where its"
            " plugin is. The model was compiled where others were registered before it: compile it"
            " here, from XML or a spec"
        )
    if behind_plugin and (len(user) < PLUGIN_HEAD or tuple(user[:2]) != SIGNATURE):
        raise ValueError(REASONS[1])
    known: dict[float, Family] = {
        family_id(family): family for family in (*BUILT_IN, *loaded_families())
    }
    family = known.get(user[2])
    if family is None:
        raise ValueError(
            f"family {user[2]:g} is not known in this process: import its module and call "
            "codrl_mj.engine.load_family first"
        )
    size, names = slot_size(family), parameters_type(family)._fields
    if behind_plugin:
        name = (
            bytes(model.plugin_attr[model.plugin_attradr[instance] :]).partition(b"\0")[0].decode()
        )
        if name != import_path(family):
            raise ValueError(
                f"{FAMILY} = {name!r} of its plugin: its user data are those of {import_path(family)}"
            )
        if model.plugin_statenum[instance] != size + EXTRA_STATES:
            raise ValueError(REASONS[5])
        head, arm = PLUGIN_HEAD, user[HEAD]
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
        for field, (value, wanted, remedy) in expected.items():
            if value != wanted:
                raise ValueError(f"{field} = {value:g}: a motor of codrl_mj needs {remedy}")
        gear = model.actuator_gear[model.actuator_outadr[index]]
        if not gear[0] > 0 or np.any(gear[1:]):
            raise ValueError(
                f"gear = {gear}: a motor of codrl_mj needs gear = 1/arm > 0 and no other entry"
            )
        head, arm = HEAD, 1.0 / gear[0]
    if len(user) < head + len(names):
        raise ValueError(
            f"user = {list(user)}: a {family.__name__} needs {head} numbers and {', '.join(names)}"
        )
    return family.from_parameter_values(user[head : head + len(names)], arm)


def slots(data: mujoco.MjData, actuators: Mapping[int, ActuatorModel]) -> dict[int, np.ndarray]:
    """A view of the state of each of these motors, by its index; a plugin's ends with the desired force [N]."""
    model, found = data.model, {}
    for index, actuator in actuators.items():
        instance, family = model.actuator_plugin[index], type(actuator)
        start = model.actuator_actadr[index] if instance < 0 else model.plugin_stateadr[instance]
        size = slot_size(family) + (0 if instance < 0 else EXTRA_STATES)
        found[index] = (data.act if instance < 0 else data.plugin_state)[start : start + size]
    return found


def clear_motors(data: mujoco.MjData, noise_keys: Sequence[int] | None = None) -> None:
    """Bring all motors of a simulation to rest, at its present time; `mj_resetData` does that too.

    To be called where positions and velocities are set in the middle of an episode, and at the
    start of an episode in which sensors have noise: each key gives other random numbers.

    Args:
        data: the simulation.
        noise_keys: one for each motor, whole numbers from 0 to 2**53 - 1; None: those that they
            have, 0 after a reset.

    Raises:
        ValueError: the model is not as `motors` wants it, there are not as many keys as motors, or
            a key is no such number; no motor has been changed.
    """
    found = list(slots(data, motors(data.model)).values())
    keys = (
        [slot[1] for slot in found]
        if noise_keys is None
        else np.ravel(np.array(noise_keys, dtype=object)).tolist()
    )
    if len(keys) != len(found):
        raise ValueError(
            f"noise_keys: there are {len(keys)}, must be {len(found)}, one for each motor of the"
            " model"
        )
    for index, key in enumerate(keys):
        if not (isinstance(key, numbers.Real) and 0 <= key < MAX_KEY and key % 1 == 0):  # type: ignore[operator]
            raise ValueError(
                f"noise_keys[{index}] = {key!r}: must be a whole number from 0 to 2**53 - 1, which"
                " a float64 holds"
            )
    for slot, key in zip(found, keys, strict=True):
        bring_to_rest(slot, data.time, key)


def bring_to_rest(slot: np.ndarray, time: float, noise_key: float) -> None:
    """Clear a motor's state, as `slots` has it, at a time [s]."""
    slot[:] = 0.0
    slot[:2] = time, noise_key


def check_shafts(
    model: mujoco.MjModel,
    allow_unstable: bool = False,
    held: bool = False,
    actuators: Mapping[int, ActuatorModel] | None = None,
    explicit: bool = False,
) -> float:
    """Refuse actuators that are unstable with the joints that they move, at the model's step and initial position.

    Gravity, springs, contacts, limits and the model's own servos are left out of the check.

    Args:
        model: a compiled model.
        allow_unstable: whether to return instead.
        held: whether actuators are not told the inertia, so that they hold the speed over a step.
        actuators: the actuators by their indices; the model's own if None.
        explicit: whether positions are moved by the old speeds.

    Returns:
        The spectral radius of all loops over positions and speeds together; 0 if there are none.

    Raises:
        UnstableError: with the number and a remedy.
    """
    asking = {index: one for index, one in (actuators or motors(model)).items() if one.closes_loops}
    if not asking:
        return 0.0
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    shafts, inertias = (
        [(model.actuator_trntype[index], *model.actuator_trnid[index]) for index in asking],
        [],
    )
    names = [model.actuator(index).name or f"actuator {index}" for index in asking]
    for (index, actuator), shaft, name in zip(asking.items(), shafts, names, strict=True):
        arm = (
            1.0 if model.actuator_plugin[index] < 0 else actuator.arm_radius
        )  # the callback's is in the gear
        inertias.append(shaft_inertia(model, data, model.actuator_outadr[index], 1.0 / arm))
        try:
            several = shafts.count(shaft)
            actuator.check_shaft(model.opt.timestep, inertias[-1] / several, several > 1 or held)
        except UnstableError as error:
            if not allow_unstable:
                raise UnstableError(f"{name}: {error}") from None
    spectral_radius, linear = _loop_radius(model, data, asking, inertias, held, explicit)
    step = model.opt.timestep
    largest = spectral_radius(step)
    if largest < STABLE or allow_unstable:
        return largest
    separate = {number: spectral_radius(step, number) for number in linear}
    worst = max(separate, key=separate.__getitem__)
    together = separate[worst] < STABLE
    remedy = list(asking.values())[worst].loop_remedy(inertias[worst])
    raise UnstableError(
        f"{', '.join(names[number] for number in linear) if together else names[worst]}: the outer"
        f" loops are unstable{' together' * together}: spectral radius {largest:.4g} over a"
        f" mechanical step of {step:g} s, must be < 1. {remedy}"
        f" {_shorter(asking.values(), spectral_radius, step)}; or pass allow_unstable=True"
    )


def _loop_radius(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    actuators: Mapping[int, ActuatorModel],
    inertias: Sequence[float],
    held: bool,
    explicit: bool,
) -> tuple[Callable[..., float], list[int]]:
    """Return a function of a step [s], and of the numbers of some actuators unless of all, and which are linear."""
    joints, motors = _joints(model, data, actuators, explicit), list(actuators.values())
    advances = [motor.advance if held else compiled_advance(type(motor)) for motor in motors]
    known = [
        inertia if motor.INERTIA and not held else np.inf
        for motor, inertia in zip(motors, inertias, strict=True)
    ]

    def linearized(number: int, timestep: float, size: float = 1.0) -> np.ndarray:
        change = size * stability.PERTURBATION
        return stability.linearize(
            motors[number], advances[number], timestep, known[number], change
        )

    def is_smooth(number: int) -> bool:
        small, large = (linearized(number, model.opt.timestep, size) for size in (1.0, 10.0))
        return np.allclose(small, large, rtol=0.01, atol=1e-6 * np.abs(small).max())

    def spectral_radius(timestep: float, *numbers: int) -> float:
        chosen = list(numbers or linear)
        loops = [linearized(number, timestep) for number in chosen]
        shafts = joints._replace(moments=joints.moments[chosen])
        return stability.loop_radius(shafts, loops, timestep) if chosen else 0.0

    # A custom family may have friction or a gap at rest, of which a linear loop says nothing.
    linear = [
        number
        for number, motor in enumerate(motors)
        if type(motor) in BUILT_IN or is_smooth(number)
    ]
    return spectral_radius, linear


STABLE = 1.0 + 1e-6
"""Spectral radius below which loops are stable: that of joints that nothing holds is 1, with rounding."""


def _shorter(
    actuators: Collection[ActuatorModel], radius_at: Callable[[float], float], timestep: float
) -> str:
    """Return a sentence on the longest of some shorter steps [s] at which all is stable."""
    for parts in (2, 3, 4, 5, 8, 10, 16, 20, 32, 50, 100):
        try:
            for actuator in actuators:
                actuator.check(timestep / parts)
        except ValueError:
            continue
        if (radius := radius_at(timestep / parts)) < STABLE:
            return (
                f"Or shorten the step to {timestep / parts:g} s, which does (spectral radius"
                f" {radius:.4g})"
            )
    return "A shorter step does not help"


def _joints(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    actuators: Mapping[int, ActuatorModel],
    explicit: bool,
) -> stability.Joints:
    """Return the linearized joints of a model at a position, with the shafts of some actuators."""
    inertia, every = np.empty((model.nv, model.nv)), np.zeros((len(data.moment_rownnz), model.nv))
    for row, unit in zip(inertia, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    mujoco.mju_sparse2dense(
        every, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
    )
    arms = [
        1.0 if model.actuator_plugin[index] < 0 else one.arm_radius
        for index, one in actuators.items()
    ]
    moments = every[model.actuator_outadr[list(actuators)]] / np.array(arms)[:, np.newaxis]
    kind, undamped = (
        model.opt.integrator,
        model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP,
    )
    is_rk4 = kind == mujoco.mjtIntegrator.mjINT_RK4
    integrator = "rk4" if is_rk4 else "euler" if explicit else "semi-implicit"
    undamped = undamped and kind == mujoco.mjtIntegrator.mjINT_EULER
    return stability.Joints(inertia, model.dof_damping.copy(), moments, integrator, bool(undamped))


class Readout:
    """Reads the signals of all motors of a model, quickly: one array a signal.

    Args:
        model: a compiled model.

    Raises:
        ValueError: see `motors`.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        """Find the places."""
        self.motors = motors(model)
        indices = np.array(list(self.motors), dtype=int)
        families: list[Family] = [type(actuator) for actuator in self.motors.values()]
        out, instances = model.actuator_outadr[indices], model.actuator_plugin[indices]
        behind_plugin, tracks = (
            instances >= 0,
            np.array([family.is_torque_controlled for family in families], dtype=bool),
        )
        self._behind = behind_plugin.all(), behind_plugin.any()
        # places in plugins' states, after activations where there are motors at both doors
        in_plugin = model.plugin_stateadr[instances] if model.nplugin else 0
        first = 0 if behind_plugin.all() else model.na
        starts = np.where(behind_plugin, first + in_plugin, model.actuator_actadr[indices])
        last = np.array([slot_size(family) for family in families], dtype=int)
        desired = np.where(behind_plugin & tracks, starts + last, -1)
        places = {"desired_force": desired, "actual_force": np.full(len(families), -1)}
        for motor, (start, family) in enumerate(zip(starts, families, strict=True)):
            for place, name in enumerate(family.Signals._fields, start + signals_at(family)):
                places.setdefault(name, np.full(len(families), -1))[motor] = place
        self.names = tuple(places)
        """Of the signals, in order."""
        self._places = np.stack(list(places.values()))
        self._out = out.astype(np.intp)  # which numpy would cast each time
        nothing = self._places == -1
        self._as_delivered, nothing[:2] = np.flatnonzero(nothing[0]), False
        self._nothing = nothing if nothing.any() else None
        # a motor at the callback's door has its arm in the gear, and forces at the shaft
        self._called = np.flatnonzero(~behind_plugin)
        self._gear = np.where(behind_plugin, 1.0, model.actuator_gear[out, 0])
        self._asked = np.flatnonzero(~behind_plugin & tracks)
        self._control = model.actuator_ctrladr[indices[self._asked]]
        limited = model.actuator_ctrllimited[self._control].astype(bool)
        low, high = model.actuator_ctrlrange[self._control].T
        self._low, self._high = np.where(limited, low, -np.inf), np.where(limited, high, np.inf)

    def table(self, data: mujoco.MjData) -> np.ndarray:
        """The signals after the last step or `mj_forward`, shape (k, n_motors), rows as in `names`.

        Args:
            data: a simulation of the model.
        """
        every, some = self._behind
        states = (
            data.plugin_state
            if every
            else np.append(data.act, data.plugin_state)
            if some
            else data.act
        )
        table: np.ndarray = states[self._places]
        table[1] = data.actuator_force[self._out]
        if self._as_delivered.size:
            table[0, self._as_delivered] = table[1, self._as_delivered]
        if self._nothing is not None:
            table[self._nothing] = np.nan
        if self._called.size:
            table[:2] *= self._gear
            controls = data.ctrl[self._control]
            if not data.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
                controls = np.clip(controls, self._low, self._high)
            table[0, self._asked] = controls * self._gear[self._asked]
        return table

    def __call__(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        """`table` by name.

        Args:
            data: a simulation of the model.

        Returns:
            Name -> array (n_motors,): `desired_force` and `actual_force` [N], or torques [N*m], at
            the joint's side of the arm (and before the gear that the model of a plugin has), and
            every signal of the families, NaN where a motor's family has none of that name.
        """
        return dict(zip(self.names, self.table(data), strict=True))


def signals(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, np.ndarray]:
    """The signals of all motors: `Readout(model)(data)`, which is quicker where it is asked often.

    Raises:
        ValueError: see `motors`.
    """
    return Readout(model)(data)
