"""Identified parameters in MuJoCo's native DC motor reproduce the log."""

import math

import mujoco
import numpy as np
import pytest

from codrl_mj.identify import identify
from tests.identify import draws

STEP = 2e-5


def simulate_dcmotor(log, result, duration=1.0, **changes):
    """Return the position of an identified `<dcmotor>` under the voltage of a log, at its rows."""
    parameters = {estimate.name: estimate.value for estimate in result.estimates} | changes
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><option timestep="{STEP}" gravity="0 0 0"/><worldbody><body>
        <joint name="hinge" damping="{parameters["viscous_friction"]}" frictionloss="{parameters["coulomb_friction"]}"
        solreffriction="0.0001 1" armature="{parameters["inertia"] - 1e-9}"/>
        <inertial mass="1e-6" pos="0 0 0" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody></mujoco>"""
    )
    # MuJoCo steps the current by Euler's method: this inductance makes its step exact.
    decay = -math.expm1(-STEP * parameters["resistance"] / parameters["inductance"])
    spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target="hinge").set_to_dcmotor(
        motorconst=[parameters["torque_constant"], parameters["back_emf_constant"]],
        resistance=parameters["resistance"],
        inductance=[parameters["resistance"] * STEP / decay, 0.0],
        ctrlspec=int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE),
    )
    model = spec.compile()
    data, rows = mujoco.MjData(model), round(duration / log.step)
    position = np.empty(rows)
    for row in range(rows):
        position[row] = data.qpos[0]
        data.ctrl[0] = log.signals["voltage"][row]
        for _ in range(round(log.step / STEP)):
            mujoco.mj_step(model, data)
    return position


@pytest.mark.matrix
@pytest.mark.parametrize("draw", [0, 1])
def test_a_dcmotor_with_identified_parameters_reproduces_the_log(draw):
    """The error in half a second is a thousandth of the motion; 5 % more resistance is visible."""
    log = draws.make_log(draw, voltage="together")
    result = identify([log], "free")
    expected = log.signals["position"][: round(0.5 / log.step)]

    def error(**changes):
        return np.abs(simulate_dcmotor(log, result, 0.5, **changes) - expected).mean() / np.ptp(
            expected
        )

    assert error() < 0.001
    assert error(resistance=1.05 * result["resistance"].value) > 5.0 * error()
