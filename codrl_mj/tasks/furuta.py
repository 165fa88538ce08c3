"""Furuta: swing a rod up on a turning arm and hold it. Quanser's QUBE-Servo 2 rotary pendulum.

## Description

An arm (0.095 kg, 85 mm) turns about a vertical shaft. A rod (0.024 kg, 129 mm) hangs from a hinge
at its end and swings across it, under a gravity of 9.81 m/s^2. The actuator turns the arm: the rod
has none. It is an off-the-shelf motor, `quanser-qube-servo-2`, behind a drive. The paper's
actuators (`paper`, `weak` and so on) are refused; `ideal` is the bare arm, without the rotor.

## Observation space

| index | observation | min | max | unit |
| --- | --- | --- | --- | --- |
| 0 | `cos_arm` | -1 | 1 | |
| 1 | `sin_arm` | -1 | 1 | |
| 2 | `cos_rod`, height of the tip | -1 | 1 | |
| 3 | `sin_rod` | -1 | 1 | |
| 4 | `arm_velocity` | -inf | inf | rad/s |
| 5 | `rod_velocity` | -inf | inf | rad/s |

Angles grow counter-clockwise, the arm's as seen from above, the rod's as seen from outside. The
rod's angle is 0 upright. Angles are not wrapped.

## Action space

`Box(-0.084, 0.084, (1,), float32)`: the desired torque on the arm [N*m]; it saturates at +-0.084,
the motor's torque at the drive's largest current, 2 A.

## Reward

h (1 - (arm angle / 2)^2 / 2 - (torque / 0.084)^2 / 10), with the height h = (1 + cos(rod angle))/2,
angles after the step and the torque delivered. It is never negative, so ending early earns nothing.

## Start

Hanging: arm angle, rod angle minus pi, and both velocities uniform in [-0.05, 0.05] (rad, rad/s).
`reset(options={"low": ..., "high": ...})` sets the bounds.

## End

The arm is more than 2 rad (115 degrees) off the middle. Truncated after 250 steps (5 s). An episode
succeeds if the rod is within 0.1 rad of upright over its last second.

## Arguments

[The arguments of every environment](arguments.md), and those of the rig:

| option | default | unit | meaning |
| --- | ---: | --- | --- |
| `arm_mass` | 0.095 | kg | mass of the arm |
| `arm_length` | 0.085 | m | distance of the rod's hinge from the shaft |
| `arm_inertia` | 0 | kg m^2 | of arm and hub about the shaft, without rotor; 0: uniform arm |
| `rod_mass` | 0.024 | kg | mass of the rod |
| `rod_length` | 0.129 | m | length of the rod from its hinge |
| `rod_center` | 0 | m | distance of its center of mass from the hinge; 0: half of the length |
| `rod_inertia` | 0 | kg m^2 | of the rod about its hinge; 0: uniform rod |
| `arm_damping` | 5e-6 | N m s/rad | viscous friction of the arm's bearing |
| `rod_damping` | 1e-6 | N m s/rad | viscous friction of the rod's hinge |

```console
$ codrl-mj train furuta --env.rod-length 0.2 --env.arm-mass 0.12 --out runs/my_rig
```

In Python: `codrl_mj.make("furuta", rod_length=0.2)`. `randomize` draws factors of these values:
`{"model.length.rod": "uniform(0.9, 1.1)"}`, likewise `model.mass.arm`; of damping it draws what is
added, `model.damping.hinge` ([fields](../randomization.md)). The scripted controller of
`codrl-mj motor feasible` is tuned for the default rig: name a run that was trained on yours.

The supply is the motor's nominal 18 V; the
bench's amplifier is made for 10 V: set `{"name": "default", "supply": {"voltage": 10.0}}`, and its
delay by `disturbances={"command_delay": 0.004}`. `physics="analytic"` has the equations in closed
form, for actuators without a rotor.

## What to expect

At a supply of 10 V, PPO with its `default` settings learns to balance with each of five seeds,
whether it commands torque, current or voltage. The return is 231 to 233 of at most 250:

```console
$ codrl-mj train furuta --env.action voltage --actuator.supply.voltage 10 --seed 0 --out runs/volts
```

Beware of a local optimum: whirling the rod returns 190 and more.

Policies trained on the ideal arm lose with weaker supplies (V) and with delays (ms). The mean
return over three seeds, the worst in brackets ([all rows](furuta_supplies.csv) of
`scripts/furuta_table.py`):

| run on | trained on ideal | at 18 V | at 6 V | at 18 V, 6 ms |
| --- | ---: | ---: | ---: | ---: |
| 18 V | 235 (232) | 233 (232) | 221 (210) | 231 (228) |
| 10 V | 155 (3) | 232 (231) | 227 (221) | 230 (228) |
| 7 V | 114 (2) | 230 (230) | 229 (227) | 198 (182) |
| 5 V | 34 (1) | 200 (181) | 218 (218) | 56 (1) |
| 4 ms | 200 (135) | 232 (232) | 224 (221) | 232 (232) |

Train at 18 V: the policy loses nothing down to 7 V and with a delay of 8 ms, and still swings up at
5 V.

## Where the numbers come from

Masses and lengths are the manual's (Quanser, *QUBE-Servo 2 User Manual*). Arm and rod are uniform:
the arm's inertia about the shaft is m l^2/3 (some simulators have m l^2/12). Joint damping, 5e-6
and 1e-6 N m s/rad, was identified by quanser_robots and Pyrado. Others identified up to five
hundred times as much; set it with `joint=`, which acts on the arm. There is no stiction, and the
encoder's cable does not pull. The options replace all of these by the numbers of your rig.
"""

import math
from typing import Annotated, NamedTuple

import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.envs.classic_control import utils

from codrl_mj.tasks.attributes import (
    GRAVITY,
    Fixed,
    ModelNumber,
    Setting,
    center_of_mass,
    mass,
)
from codrl_mj.tasks.base import Entries, Flags, OptionBounds, ResetOptions, Task, Values
from codrl_mj.tasks.reference_env import ReferenceStates, values_around

MAX_TORQUE = 0.084  # N*m: 2 A, the amplifier's peak current, times kT = 0.042 N*m/A
ARM_LIMIT = 2.0  # rad
GOAL_ANGLE = 0.1  # rad
GOAL_HOLD = 1.0  # s
HUB_INERTIA = 0.6e-6  # kg*m^2, the hub's on the motor's shaft
ROD_RADIUS = 0.00475  # m


class Options(NamedTuple):
    """Options of Furuta: masses, lengths, inertias and damping of the rig.

    The defaults are those of Quanser's QUBE-Servo 2: masses and lengths are the manual's, the
    damping was identified by quanser_robots and Pyrado.
    """

    arm_mass: Annotated[float, OptionBounds("kg", is_excluded=True)] = 0.095
    """Mass of the arm [kg], > 0. Only the inertia of a uniform arm depends on it."""
    arm_length: Annotated[float, OptionBounds("m", is_excluded=True)] = 0.085
    """Distance of the rod's hinge from the shaft [m], > 0."""
    arm_inertia: Annotated[float, OptionBounds("kg*m^2")] = 0.0
    """Inertia of arm and hub about the shaft [kg*m^2], without the motor's rotor and the rod; 0:
    that of a uniform arm, mass*length^2/3, and of the hub, 0.6e-6.
    """
    rod_mass: Annotated[float, OptionBounds("kg", is_excluded=True)] = 0.024
    """Mass of the rod [kg], > 0."""
    rod_length: Annotated[float, OptionBounds("m", is_excluded=True)] = 0.129
    """Length of the rod from its hinge [m], > 0."""
    rod_center: Annotated[float, OptionBounds("m")] = 0.0
    """Distance of the rod's center of mass from its hinge [m]; 0: half of the length."""
    rod_inertia: Annotated[float, OptionBounds("kg*m^2")] = 0.0
    """Inertia of the rod about its hinge [kg*m^2]; 0: that of a uniform rod, mass*length^2/12 about
    its center of mass.
    """
    arm_damping: Annotated[float, OptionBounds("N*m*s/rad")] = 5e-6
    """Viscous friction of the arm's bearing [N*m*s/rad], without the motor's friction."""
    rod_damping: Annotated[float, OptionBounds("N*m*s/rad")] = 1e-6
    """Viscous friction of the rod's hinge [N*m*s/rad]."""


def apply_options(spec: mujoco.MjSpec, options: Options) -> None:
    """Change the model of the QUBE-Servo 2 into that of another rig.

    Raises:
        ValueError: the rod's inertia is too small for its mass and center.
    """
    # The file's numbers are kept to the last bit.
    if options == Options():
        return
    arm, rod = spec.body("arm"), spec.body("rod")
    shaft, hinge = spec.joint("shaft"), spec.joint("hinge")
    shaft.damping[0], hinge.damping[0] = options.arm_damping, options.rod_damping
    # With an inertia about the shaft, the arm is a uniform bar of the same mass and inertia, which
    # need not end at the rod: MuJoCo refuses an inertia that is too small for the center of mass.
    arm_inertia, length = options.arm_inertia, options.arm_length
    if arm_inertia > 0.0:
        shaft.armature = 0.0
        length = math.sqrt(3.0 * arm_inertia / options.arm_mass)
    across = options.arm_mass * length**2 / 12.0
    arm.mass = options.arm_mass
    arm.ipos = [0.0, 0.0, length / 2.0]
    arm.inertia = [across, across, min(1e-6, across)]
    rod.pos = [0.0, 0.0, options.arm_length]
    center = options.rod_center or options.rod_length / 2.0
    along = options.rod_mass * ROD_RADIUS**2 / 2.0
    across = options.rod_mass * options.rod_length**2 / 12.0
    if options.rod_inertia > 0.0:
        across = options.rod_inertia - options.rod_mass * center**2
    # In any body, the inertia about one axis is at most the sum of those about the other two.
    if across < along / 2.0:
        min_inertia = options.rod_mass * center**2 + along / 2.0
        raise ValueError(
            f"rod_inertia = {options.rod_inertia:g}: with rod_mass = {options.rod_mass:g} and its"
            f" center of mass at {center:g} m it must be at least {min_inertia:.4g} kg*m^2; correct"
            " rod_inertia, rod_center or rod_length"
        )
    rod.mass = options.rod_mass
    rod.ipos = [0.0, 0.0, center]
    rod.inertia = [across, across, along]
    _draw_rig(spec, options)


def _draw_rig(spec: mujoco.MjSpec, options: Options) -> None:
    """Change the visible parts of the model; they have no mass."""
    default, arm, rod = Options(), options.arm_length, options.rod_length
    for name, start, end in (
        ("arm", 0.0, max(arm - 0.009, 0.5 * arm)),
        ("axle", max(arm - 0.015, 0.0), arm + 0.005),
        ("rod", 0.0, max(rod - ROD_RADIUS, 0.5 * rod)),
    ):
        spec.geom(name).fromto = [0.0, 0.0, start, 0.0, 0.0, end]
    # A longer rod hangs lower: the cube grows down to a lower table, and the camera moves away.
    drop = max(rod - default.rod_length, 0.0)
    cube, table = spec.geom("cube"), spec.geom("table")
    cube.size = [*cube.size[:2], cube.size[2] + drop / 2.0]
    cube.pos = [*cube.pos[:2], cube.pos[2] - drop / 2.0]
    table.fromto = [0.0, 0.0, -0.15 - drop, 0.0, 0.0, -0.14 - drop]
    scale = max((arm + rod) / (default.arm_length + default.rod_length), 1.0)
    for name in ("fixed", "close"):
        camera = spec.camera(name)
        camera.pos = [scale * entry for entry in camera.pos]


def initial_bounds(options: ResetOptions | None) -> tuple[np.ndarray, np.ndarray]:
    """Return -0.05 and 0.05 about hanging at rest, or the reset options' `low` and `high`."""
    low, high = utils.maybe_parse_reset_bounds(options, -0.05, 0.05)
    return np.full(4, low), np.full(4, high)


def initial_state(draws: Entries) -> tuple[Values, ...]:
    """Return the draws as the state; the rod's angle is drawn relative to hanging."""
    return draws[0], draws[1] + math.pi, draws[2], draws[3]


def observation(state: Entries) -> tuple[Values, ...]:
    """Return the cosines and sines of the angles, and the speeds."""
    return (
        np.cos(state[0]),
        np.sin(state[0]),
        np.cos(state[1]),
        np.sin(state[1]),
        state[2],
        state[3],
    )


def terminated(state: Entries) -> Flags:
    """Return True if the arm is beyond its limit."""
    is_beyond: Flags = np.abs(state[0]) > ARM_LIMIT
    return is_beyond


def goal(state: Entries) -> Flags:
    """Return True if the rod is upright."""
    is_upright: Flags = np.cos(state[1]) > math.cos(GOAL_ANGLE)
    return is_upright


def reward(state: Entries, force: Values, next_state: Entries, options: Options) -> Values:
    """Return the rod's height, reduced by shares for the arm's angle and for the torque."""
    deviation, share = next_state[0] / ARM_LIMIT, force / MAX_TORQUE
    return (
        0.5
        * (1.0 + np.cos(next_state[1]))
        * (1.0 - 0.5 * (deviation * deviation) - 0.1 * (share * share))
    )


class ReferenceEnv:
    """Equations of motion in closed form, with constants that are independent of the MJCF file.

    With the inertias J of arm and hub about the shaft, I of the rod about its hinge and Z along it,
    the Lagrangian is

    ((J + m L^2 + I sin^2 a + Z cos^2 a) w^2 - m L l cos a w v + I v^2)/2 - m g l/2 cos a

    with the arm's length L and speed w, and the rod's mass m, angle a and speed v, and l/2 the
    distance of its center of mass from the hinge. Cazzolato and Prime, *On the Dynamics of the
    Furuta Pendulum*, Journal of Control Science and Engineering (2011), measure the angle a from
    the hanging rod.
    """

    GRAVITY = 9.81
    HUB = 0.6e-6  # kg*m^2
    RADIUS = 0.00475  # of the rod [m]

    def __init__(self, options: Options = Options()) -> None:  # noqa: B008 - it is immutable
        """Compute inertias and moments from the options of a rig."""
        arm, mass, rod = options.arm_length, options.rod_mass, options.rod_length
        # A uniform rod has its own expressions: rounding is then the same as without options.
        if options.rod_center > 0.0:
            center = options.rod_center
            self.across = mass * (rod**2 / 12 + center**2)
            self.coupling, self.weight = mass * arm * center, mass * self.GRAVITY * center
        else:
            self.across = mass * rod**2 / 3
            self.coupling, self.weight = mass * arm * rod / 2, mass * self.GRAVITY * rod / 2
        if options.rod_inertia > 0.0:
            self.across = options.rod_inertia
        self.along = mass * self.RADIUS**2 / 2
        # Inertia about the shaft of arm and hub, and of the rod's mass at its hinge.
        self.turning = (options.arm_mass / 3 + mass) * arm**2 + self.HUB
        if options.arm_inertia > 0.0:
            self.turning = options.arm_inertia + mass * arm**2
        self.damping = options.arm_damping, options.rod_damping

    def derivative(self, state: np.ndarray, force: float) -> np.ndarray:
        """Return the time derivative, shape (4,), of a state under a torque [N*m] on the arm."""
        _, angle, arm_speed, rod_speed = state
        sine, cosine = np.sin(angle), np.cos(angle)
        across, along, coupling = self.across, self.along, self.coupling
        matrix_11 = self.turning + across * sine**2 + along * cosine**2
        matrix_12 = -coupling * cosine
        twisting = (across - along) * sine * cosine
        arm_torque = (
            force
            - (self.damping[0] + 2 * twisting * rod_speed) * arm_speed
            - coupling * sine * rod_speed**2
        )
        rod_torque = self.weight * sine - self.damping[1] * rod_speed + twisting * arm_speed**2
        determinant = matrix_11 * across - matrix_12**2
        return np.array(
            [
                arm_speed,
                rod_speed,
                (across * arm_torque - matrix_12 * rod_torque) / determinant,
                (matrix_11 * rod_torque - matrix_12 * arm_torque) / determinant,
            ]
        )

    def __call__(
        self, state: np.ndarray, force: float, timestep: float, integrator: str
    ) -> np.ndarray:
        """Take a step of the classical Runge-Kutta method."""
        # The environment has only one integrator.
        del integrator
        # Callers check for a state that has diverged, so numpy need not warn of it.
        with np.errstate(all="ignore"):
            first = self.derivative(state, force)
            second = self.derivative(state + timestep / 2 * first, force)
            third = self.derivative(state + timestep / 2 * second, force)
            fourth = self.derivative(state + timestep * third, force)
        after: np.ndarray = state + timestep / 6 * (first + 2 * second + 2 * third + fourth)
        return after


_HIGH = np.array([1.0, 1.0, 1.0, 1.0, np.inf, np.inf], dtype=np.float32)

TASK = Task(
    name="furuta",
    env_id="codrl_mj/Furuta-v0",
    max_episode_steps=250,
    reference_env=ReferenceEnv,
    asset="furuta.xml",
    step_duration=0.02,
    motor_inner_steps=10,
    ideal_inner_steps=10,
    max_force=MAX_TORQUE,
    integrators=("rk4",),
    state_names=("arm [rad]", "rod [rad]", "arm_dot [rad/s]", "rod_dot [rad/s]"),
    observation_names=("cos_arm", "sin_arm", "cos_rod", "sin_rod", "arm_velocity", "rod_velocity"),
    observation_space=spaces.Box(-_HIGH, _HIGH, dtype=np.float32),
    options=Options,
    apply_options=apply_options,
    # A long rod, a heavy arm, a short and light rig, one with given inertias, and a rod with its
    # mass at the tip.
    reference_options=(
        Options(rod_length=0.2),
        Options(arm_mass=0.3, arm_length=0.15, arm_damping=1e-4, rod_damping=2e-5),
        Options(arm_mass=0.02, arm_length=0.04, rod_mass=0.008, rod_length=0.06),
        Options(arm_inertia=1.1e-4, rod_inertia=1.5e-4, rod_center=0.07, arm_damping=0.0),
        Options(arm_mass=0.4, rod_mass=0.04, rod_length=0.2, rod_center=0.18, rod_damping=0.0),
    ),
    initial_bounds=initial_bounds,
    initial_state=initial_state,
    observation=observation,
    reward=reward,
    terminated=terminated,
    goal=goal,
    goal_hold=GOAL_HOLD,
    actuator="quanser-qube-servo-2",
    attributes={
        "dt": Setting.STEP,
        "max_torque": Setting.LARGEST_FORCE,
        "arm_limit": Fixed(ARM_LIMIT),
        "gravity": GRAVITY,
        "arm_mass": mass("arm"),
        "arm_length": ModelNumber("body_pos", "rod", 2, varies=("model.length.arm",)),
        "rod_mass": mass("rod"),
        "rod_length": center_of_mass("rod", 2.0),
    },
    reference_states=ReferenceStates(
        bounds=(ARM_LIMIT, math.pi, 25.0, 35.0),
        edges=(
            (*values_around(ARM_LIMIT), 0.0),
            (*values_around(math.pi), 0.0),
            (-25.0, 0.0, 25.0),
            (-35.0, 0.0, 35.0),
        ),
        # In this run the rod swings through its lowest position.
        start=(0.2, 2.0, 0.0, 0.0),
        steps=20,
        balanced_steps=4,
        horizon=50,
    ),
)
