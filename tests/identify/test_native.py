"""What is fitted, given to MuJoCo's own motor, moves as the log does."""

import math

import mujoco
import numpy as np
import pytest

from codrl_mj.identify import identify
from tests.identify import draws

STEP = 2e-5


def played(log, found, duration=1.0, **changes):
    """Position of a `<dcmotor>` with joint friction of what was identified, under the voltage of a log, at its rows."""
    number = {one.name: one.value for one in found.estimates} | changes
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><option timestep="{STEP}" gravity="0 0 0"/><worldbody><body>
        <joint name="hinge" damping="{number["viscous_friction"]}" frictionloss="{number["coulomb_friction"]}"
        solreffriction="0.0001 1" armature="{number["inertia"] - 1e-9}"/>
        <inertial mass="1e-6" pos="0 0 0" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody></mujoco>"""
    )
    decay = -math.expm1(
        -STEP * number["resistance"] / number["inductance"]
    )  # MuJoCo's step is Euler's
    spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target="hinge").set_to_dcmotor(
        motorconst=[number["torque_constant"], number["back_emf_constant"]],
        resistance=number["resistance"],
        inductance=[number["resistance"] * STEP / decay, 0.0],
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
def test_a_dcmotor_of_what_was_identified_moves_as_the_log_does(draw):
    """Half a second from standstill to a thousandth of the way; with 5 % more resistance it is not."""
    log = draws.logged(draw, voltage="together")
    found = identify([log], "free")
    own = log.signals["position"][: round(0.5 / log.step)]

    def error(**changes):
        return np.abs(played(log, found, 0.5, **changes) - own).mean() / np.ptp(own)

    assert error() < 0.001
    assert error(resistance=1.05 * found["resistance"].value) > 5.0 * error()
