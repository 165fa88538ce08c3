"""Logs of one joint of a robot whose other joint moves, too: nothing in them may be believed."""

import mujoco
import numpy as np
import pytest

from codrl_mj.identify import Log, check, identify

ARM = """<mujoco><option timestep="5e-4" integrator="implicitfast"/><worldbody>
<body><joint name="shoulder" axis="0 1 0" damping="0.05" frictionloss="0.2"/>
<inertial mass="0.6" pos="0 0 -0.2" diaginertia="0.01 0.01 0.001"/>
<body pos="0 0 -0.2"><joint name="elbow" axis="0 1 0" damping="0.01" frictionloss="0.02"/>
<inertial mass="0.6" pos="0 0 -0.25" diaginertia="0.006 0.006 0.001"/></body></body></worldbody></mujoco>"""


def elbow_log(separate, shared, frequencies, duration=6.0):
    """Return a log of an elbow under a torque, while a servo moves the shoulder.

    Args:
        separate: amplitude of the part of the torque [N*m] that has phases of its own.
        shared: amplitude of the part [N*m] that has the phases of the shoulder's motion.
        frequencies: of both motions [Hz].
        duration: of the log [s].
    """
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    time = 5e-4 * np.arange(round(duration / 5e-4))
    phases = np.random.default_rng(0).uniform(0.0, 6.28, (2, len(frequencies)))
    angles = 2.0 * np.pi * np.outer(time, frequencies)
    shoulder, elbow = (np.sin(angles + phase).sum(axis=1) for phase in phases)
    torque = shared * shoulder + separate * elbow
    position = np.empty(len(time))
    for row in range(len(time)):
        position[row] = data.qpos[1]
        servo = 6.0 * (0.25 * shoulder[row] - data.qpos[0]) - 0.3 * data.qvel[0]
        data.qfrc_applied[:] = servo, torque[row]
        mujoco.mj_step(model, data)
    signals = {"position": np.round(position[::4] / 2e-4) * 2e-4, "torque": torque[::4]}
    return Log("elbow", time[::4], signals, {"position": 2e-4})


def test_a_joint_that_another_moves_is_no_clear_error_of_sign():
    """The elbow swings against its torque, as if its sign were wrong."""
    (finding,) = (
        finding
        for finding in check(elbow_log(0.0, 0.1, (1.5, 2.3, 3.1)), rig="pendulum")
        if finding.check == "sign"
    )
    assert finding.message.endswith("Its sign is wrong, or another joint moves the shaft")
    assert finding.remedy.startswith("if this joint moves alone, give the torque")
    assert finding.remedy.endswith("otherwise log it while the other joints are held")


def test_a_torque_that_resists_slowly_and_accelerates_fast_has_its_sign():
    """Something pulls at 0.7 Hz, and the motor resists by half; at 8 Hz it accelerates."""
    time = 1e-3 * np.arange(8000)
    pull, fast = 0.5 * np.sin(4.4 * time), 0.2 * np.sin(50.3 * time)
    torque = fast - 0.5 * pull
    # J q'' = torque + pull, integrated twice; the means that would make the shaft drift are 0.
    inertia = 0.01
    position = -(0.5 * 0.5 * np.sin(4.4 * time) / 4.4**2 + 0.2 * np.sin(50.3 * time) / 50.3**2)
    signals = {"position": np.round(position / inertia / 1e-4) * 1e-4, "torque": torque}
    findings = check(Log("pulled", time, signals, {"position": 1e-4}), rig="free")
    assert [finding for finding in findings if finding.severity == "error"] == []
    (finding,) = (
        finding for finding in findings if "something else moves the shaft" in finding.message
    )
    assert finding.severity == "warning"
    assert "leave the sign of the torque" in finding.remedy


@pytest.mark.matrix
@pytest.mark.parametrize(("separate", "shared"), [(0.1, -0.1), (0.1, 0.0)])
def test_nothing_is_identified_from_a_joint_that_another_moves(separate, shared):
    """The elbow's inertia is 0.0435 kg*m^2 and its weight 1.47 N*m if the shoulder is held."""
    result = identify([elbow_log(separate, shared, (0.4, 0.9, 1.6))], "pendulum")
    assert "identified" not in {estimate.status for estimate in result.estimates}
    for name, truth in (("inertia", 0.0435), ("mgl", 1.4715)):
        estimate = result[name]
        is_right = estimate.low <= truth <= estimate.high
        assert estimate.status == "refused" or is_right, estimate
