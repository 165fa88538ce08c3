"""Check of the stability of actuators together with the joints that they move.

The module needs no numba, so that adapters to other simulators can use it where numba is missing.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from codrl_mj.actuators import (
    BUILT_IN,
    ActuatorModel,
    Family,
    UnstableError,
    check_supplies,
    stability,
)

# Compiled and plain functions take the same arguments.
AdvanceFunction = Callable[..., Any]
"""`advance` of a family."""


def _plain_advance(family: Family) -> AdvanceFunction:
    """Return a family's `advance` in plain Python."""
    return family.advance


def check_shafts(
    model: mujoco.MjModel,
    actuators: Mapping[int, ActuatorModel],
    arms: Mapping[int, float],
    allow_unstable: bool = False,
    held: bool = False,
    explicit: bool = False,
    advance_of: Callable[[Family], AdvanceFunction] = _plain_advance,
) -> float:
    """Raise an error if actuators are unstable with the joints that they move.

    The check linearizes joints and actuators at the model's initial position. It ignores gravity,
    springs, contacts, limits and the model's own servos.

    Args:
        model: a compiled model.
        actuators: actuators by index; those without loops are left out.
        arms: arm [m] of each actuator where MuJoCo's gear does not contain it; otherwise 1.
        allow_unstable: True to return instead of raising an error.
        held: True if actuators are simulated without the inertia, at a constant speed over a step.
        explicit: True if positions are integrated with the previous speeds (explicit Euler).
        advance_of: function that returns a family's `advance`, compiled or not.

    Returns:
        The spectral radius of all position and speed loops together; 0 if there are none.

    Raises:
        UnstableError: the loops are unstable; the message has the spectral radius and a remedy.
    """
    loop_actuators = {
        index: actuator for index, actuator in actuators.items() if actuator.closes_loops
    }
    if not loop_actuators:
        return 0.0
    names = [model.actuator(index).name or f"actuator {index}" for index in loop_actuators]
    actuators_by_name = dict(zip(names, loop_actuators.values(), strict=True))
    check_supplies(actuators_by_name, allow_unstable)
    sharing = [name for name, motor in actuators_by_name.items() if motor.SHARES_SUPPLY]
    if held and len(sharing) > 1:
        raise ValueError(
            f"{', '.join(sharing)}: motors that share a supply need physics = 'mujoco', because"
            " physics = 'analytic' advances each motor by itself"
        )
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    joints = _joints(model, data, loop_actuators, arms, explicit)
    inertias = _shaft_inertias(joints)
    shafts = [
        (model.actuator_trntype[index], *model.actuator_trnid[index]) for index in loop_actuators
    ]
    for actuator, inertia, shaft, name in zip(
        loop_actuators.values(), inertias, shafts, names, strict=True
    ):
        try:
            # Motors on the same shaft share its inertia equally; each is checked with its share.
            num_on_shaft = shafts.count(shaft)
            actuator.check_shaft(
                model.opt.timestep, inertia / num_on_shaft, num_on_shaft > 1 or held
            )
        except UnstableError as error:
            if not allow_unstable:
                raise UnstableError(f"{name}: {error}") from None
    step = model.opt.timestep
    spectral_radius, linear = _loop_radius(
        joints, list(loop_actuators.values()), inertias, step, held, advance_of
    )
    largest = spectral_radius(step)
    if largest < MAX_STABLE_RADIUS or allow_unstable:
        return largest
    separate_radii = {number: spectral_radius(step, number) for number in linear}
    worst = max(separate_radii, key=separate_radii.__getitem__)
    coupled = separate_radii[worst] < MAX_STABLE_RADIUS
    remedy = list(loop_actuators.values())[worst].loop_remedy(inertias[worst])
    raise UnstableError(
        f"{', '.join(names[number] for number in linear) if coupled else names[worst]}: the"
        f" outer loops are unstable{' together' * coupled}: spectral radius {largest:.4g} over a"
        f" mechanical step of {step:g} s, must be < 1. {remedy}"
        f" {_shorter_step(loop_actuators.values(), spectral_radius, step)}; or pass"
        " allow_unstable=True"
    )


def _loop_radius(
    joints: stability.Joints,
    motors: Sequence[ActuatorModel],
    inertias: Sequence[float],
    step: float,
    held: bool,
    advance_of: Callable[[Family], AdvanceFunction],
) -> tuple[Callable[..., float], list[int]]:
    """Return a function for the spectral radius, and the numbers of the linear actuators.

    The function takes a step [s] and the numbers, in the order of `motors`, of those whose loops
    are closed; without numbers, the loops of all linear actuators are closed.
    """
    advances = [motor.advance if held else advance_of(type(motor)) for motor in motors]
    known_inertias = [
        inertia if motor.INERTIA and not held else np.inf
        for motor, inertia in zip(motors, inertias, strict=True)
    ]

    def linearized(number: int, timestep: float, size: float = 1.0) -> np.ndarray:
        change = size * stability.PERTURBATION
        return stability.linearize(
            motors[number], advances[number], timestep, known_inertias[number], change
        )

    def is_smooth(number: int) -> bool:
        small, large = (linearized(number, step, size) for size in (1.0, 10.0))
        return np.allclose(small, large, rtol=0.01, atol=1e-6 * np.abs(small).max())

    def spectral_radius(timestep: float, *numbers: int) -> float:
        closed = list(numbers or linear)
        loops = [linearized(number, timestep) for number in closed]
        shafts = joints._replace(moments=joints.moments[closed])
        return stability.loop_radius(shafts, loops, timestep) if closed else 0.0

    # A custom family may have friction or backlash at rest, which a linearized loop cannot
    # describe.
    linear = [
        number
        for number, motor in enumerate(motors)
        if type(motor) in BUILT_IN or is_smooth(number)
    ]
    return spectral_radius, linear


MAX_STABLE_RADIUS = 1.0 + 1e-6
"""Spectral radius below which loops count as stable.

Joints without any force have a radius of 1, and rounding may raise it.
"""


def _shaft_inertias(joints: stability.Joints) -> list[float]:
    """Return 1/(m*M^-1*m) for the moment m of each shaft; infinite if it moves nothing."""
    moments = joints.moments.T
    inverse = (moments * np.linalg.solve(joints.inertia, moments)).sum(axis=0)
    return [1.0 / value if value > 0.0 else np.inf for value in inverse.tolist()]


def _shorter_step(
    actuators: Collection[ActuatorModel], radius_at: Callable[[float], float], timestep: float
) -> str:
    """Return a remedy: the longest of several shorter steps [s] that make the loops stable."""
    for parts in (2, 3, 4, 5, 8, 10, 16, 20, 32, 50, 100):
        try:
            for actuator in actuators:
                actuator.check(timestep / parts)
        except ValueError:
            continue
        if (radius := radius_at(timestep / parts)) < MAX_STABLE_RADIUS:
            return (
                f"Or shorten the step to {timestep / parts:g} s, which makes them stable"
                f" (spectral radius {radius:.4g})"
            )
    return "A shorter step does not help"


def _joints(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    actuators: Collection[int],
    arms: Mapping[int, float],
    explicit: bool,
) -> stability.Joints:
    """Return a model's linearized joints at the data's position, with some actuators' shafts."""
    inertia, all_moments = (
        np.empty((model.nv, model.nv)),
        np.zeros((len(data.moment_rownnz), model.nv)),
    )
    for row, unit in zip(inertia, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    mujoco.mju_sparse2dense(
        all_moments,
        data.actuator_moment,
        data.moment_rownnz,
        data.moment_rowadr,
        data.moment_colind,
    )
    radii = np.array([arms[index] for index in actuators])
    moments = all_moments[model.actuator_outadr[list(actuators)]] / radii[:, np.newaxis]
    engine_integrator, undamped = (
        model.opt.integrator,
        model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP,
    )
    is_rk4 = engine_integrator == mujoco.mjtIntegrator.mjINT_RK4
    integrator = "rk4" if is_rk4 else "euler" if explicit else "semi-implicit"
    undamped = undamped and engine_integrator == mujoco.mjtIntegrator.mjINT_EULER
    return stability.Joints(inertia, model.dof_damping.copy(), moments, integrator, bool(undamped))
