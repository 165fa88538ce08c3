"""Logs of known motors from independent simulations: scipy's matrix exponential, and MuJoCo."""

import mujoco
import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

from codrl_mj.identify import Log, read_log
from codrl_mj.identify.parameters import ShaftParameters
from codrl_mj.identify.simulation import simulate_shaft
from tests.published import published_folder

PENDULUM = "time=time:s,position=position:rad,torque=torque:N*m"
SERVO = (
    "time=timestamp:s,position=position:rad,voltage=twos_complement(load,16)/885*input_volts:V,bus=input_volts:V,"
    "command=goal_position:rad,only=torque_enable"
)
RESISTANCE, CONSTANT, INDUCTANCE = 1.2, 0.05, 0.6e-3
INERTIA, VISCOUS = 2e-5, 1e-4
LOOP = 20000.0


def pendulum_log(name):
    """Return a published log of a real pendulum."""
    return read_log(published_folder("dfki_pendulum") / f"{name}.csv", PENDULUM)


def prbs(time, random, clock=2e-3):
    """Return random signs that change at a clock [s]."""
    bits = random.choice([-1.0, 1.0], int(time[-1] / clock) + 1)
    return bits[(time / clock + 1e-9).astype(int)]


def motor_log(
    kind="prbs", rate=5000, duration=2.0, noise=0.01, step=0.0, seed=0, mean=True, clock=2e-3
):
    """Return an exact log, x' = A x + B u, of a DC motor under a voltage that changes at 20 kHz.

    The motor has viscous friction and is free or locked.

    Args:
        kind: `prbs` with a slow sine, `sine`, or `locked`, a PRBS on a held shaft.
        rate: of the rows [Hz].
        duration: of the log [s].
        noise: standard deviation of the current over its largest value.
        step: of the encoder [rad]; 0: exact.
        seed: of the PRBS and the noise.
        mean: True if rows have the mean voltage, False if they have the instantaneous one.
        clock: of the PRBS [s].
    """
    random = np.random.default_rng(seed)
    time = np.arange(round(duration * LOOP)) / LOOP
    slow, fast = 3.0 * np.sin(np.pi * time), 3.0 * prbs(time, random, clock)
    volts = {"prbs": slow + fast, "sine": 2.0 * slow, "locked": fast}[kind]
    system = np.zeros((4, 4))
    system[0] = [-RESISTANCE / INDUCTANCE, -CONSTANT / INDUCTANCE, 0.0, 1.0 / INDUCTANCE]
    if kind != "locked":
        system[1, :2], system[2, 1] = [CONSTANT / INERTIA, -VISCOUS / INERTIA], 1.0
    exact = expm(system / LOOP)
    poles, modes = np.linalg.eig(exact[:3, :3])
    gains = np.linalg.solve(modes, exact[:3, 3])
    # The decoupled modes are first-order filters, which are fast at 20 kHz.
    mode_states = [
        lfilter([0.0, gain], [1.0, -pole], volts) for gain, pole in zip(gains, poles, strict=True)
    ]
    states = np.real(modes @ mode_states).T
    stride = round(LOOP / rate)
    current, position = states[::stride, 0], states[::stride, 2]
    current = current + noise * np.abs(states[:, 0]).max() * random.standard_normal(len(current))
    if step:
        position = np.round(position / step) * step
    voltage = volts.reshape(-1, stride).mean(axis=1) if mean else volts[::stride]
    return Log(
        kind,
        time[::stride],
        {"voltage": voltage, "current": current, "position": position},
        {"position": step},
        mean,
    )


def geared_pendulum(efficiency, seed=0):
    """Return a log at 2 ms of a pendulum of 0.19 kg*m^2 and 3.6 N*m behind a gear."""
    time = np.linspace(0.0, 6.0, 12001)
    torque = np.sum(
        [
            1.5 * np.sin(2.0 * np.pi * rate * time + (1 + seed) * rate)
            for rate in (0.25, 0.6, 0.95, 1.4)
        ],
        axis=0,
    )
    shaft = ShaftParameters(0.19, 3.6, 0.0, 0.05, 0.01, efficiency, 0.0, 1.0, 2.0, 0.0, 1.0, 0.0)
    position = (
        np.round(simulate_shaft(time, torque, np.zeros(12001), 0.0, 0.0, shaft)[0][::4] / 3e-3)
        * 3e-3
    )
    return Log(
        f"geared{seed}",
        time[::4],
        {"position": position, "torque": torque[::4]},
        {"position": 3e-3},
    )


def mujoco_pendulum(
    seed=0, duration=8.0, coulomb=0.15, viscous=0.01, step=3e-3, stride=10, effort="torque"
):
    """Return a log of a pendulum of 0.19 kg*m^2 and 3.6 N*m in MuJoCo, at steps of 0.2 ms.

    Smooth torques move it against friction.

    Args:
        seed: of the torques.
        duration: of the log [s].
        coulomb: friction [N*m].
        viscous: friction [N*m*s/rad].
        step: of the encoder [rad].
        stride: simulation steps per row.
        effort: name of the logged torque; `current` for that of a motor with 1 N*m/A.
    """
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="2e-4" integrator="implicitfast"/><worldbody><body>
        <joint name="hinge" axis="0 1 0" damping="{viscous}" frictionloss="{coulomb}" solreffriction="0.0005 1"/>
        <inertial mass="1" pos="0 0 {-3.6 / 9.81}" diaginertia="0.06 {0.19 - (3.6 / 9.81) ** 2} 0.06"/>
        </body></worldbody><actuator><motor joint="hinge"/></actuator></mujoco>"""
    )
    data = mujoco.MjData(model)
    random = np.random.default_rng(seed)
    phases, rates = (
        random.uniform(0.0, 2.0 * np.pi, 4),
        np.array([0.25, 0.6, 0.95, 1.4]) * random.uniform(0.9, 1.1, 4),
    )
    count = round(duration / 2e-4)
    time = np.arange(count) * 2e-4
    torque = np.sum(0.9 * np.sin(2.0 * np.pi * np.outer(time, rates) + phases), axis=1)
    position = np.empty(count)
    for row in range(count):
        position[row] = data.qpos[0]
        data.ctrl[0] = torque[row]
        mujoco.mj_step(model, data)
    rows = slice(None, None, stride)
    measured = np.round(position[rows] / step) * step
    return Log(
        f"swing{seed}", time[rows], {"position": measured, effort: torque[rows]}, {"position": step}
    )
