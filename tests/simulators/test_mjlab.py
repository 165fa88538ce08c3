"""Motors in mjlab's own scene and simulation move a pendulum as in our engine."""

import mujoco
import numpy as np
import pytest

from codrl_mj.actuators import UnstableError
from tests.arrays.models import (
    CATALOGUE_MOTOR,
    STEPS,
    our_motion,
    servo,
    square_waves,
    with_our_motors,
)
from tests.simulators.rod import ROD

torch = pytest.importorskip("torch", reason="NOT RUN: torch is not installed: make simulators")
pytest.importorskip("warp", reason="NOT RUN: Warp is not installed: make simulators")
pytest.importorskip("mjlab", reason="NOT RUN: mjlab is not installed: make simulators")
from mjlab.actuator.actuator import TransmissionType  # noqa: E402

# These modules import mjlab.
from codrl_mj.arrays.mjlab import MotorActuatorCfg  # noqa: E402
from tests.simulators.rods import Pendulums  # noqa: E402

pytestmark = [
    pytest.mark.filterwarnings("ignore:the model"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


def our_rods(num, motor, actuator='<motor name="motor" joint="hinge"/>'):
    text = ROD.format(
        option='<option timestep="0.002"/>', actuator=f"<actuator>{actuator}</actuator>"
    )
    return [with_our_motors(mujoco.MjSpec.from_string(text), {"motor": motor})] * num


@pytest.mark.parametrize(
    ("motor", "tolerance"), [(CATALOGUE_MOTOR, 1e-5), ("lag", 3e-4)], ids=["drive", "lag"]
)
def test_a_motor_moves_a_pendulum_as_in_our_engine(motor, tolerance):
    commands = square_waves(STEPS, 4)
    pendulums = Pendulums(4, motor=motor)
    angles = pendulums.push(commands)
    gap = np.abs(angles - our_motion(our_rods(4, motor), commands)[..., 0])
    print("mjlab: largest gap", gap.max(), "range", np.ptp(angles))
    assert gap.max() < tolerance
    additions = pendulums.actuator.motor.additions
    assert pendulums.model.dof_armature[0] == pytest.approx(additions.armature)
    assert pendulums.model.dof_frictionloss[0] == pytest.approx(additions.friction)


def test_targets_of_positions_command_a_torque():
    pendulums = Pendulums(2, motor=CATALOGUE_MOTOR, stiffness=6.0, damping=0.3)
    pendulums.robot.set_joint_position_target(torch.full((2, 1), 0.5))
    angles = np.array([pendulums.step() for _ in range(STEPS)])
    position = '<position name="motor" joint="hinge" kp="6" kv="0.3"/>'
    ours = our_motion(our_rods(2, CATALOGUE_MOTOR, position), np.full((STEPS, 2, 1), 0.5))
    assert np.abs(angles - ours[..., 0]).max() < 1e-5
    assert angles[-1, 0] > 0.2


def test_a_servo_takes_the_target_of_the_position():
    pendulums = Pendulums(1, motor=servo())
    pendulums.robot.set_joint_position_target(torch.full((1, 1), 0.5))
    angles = np.array([pendulums.step() for _ in range(200)])
    ours = our_motion(our_rods(1, servo()), np.full((200, 1, 1), 0.5))
    assert np.abs(angles - ours[..., 0]).max() < 1e-5


def test_a_reset_of_some_environments_brings_their_motors_to_rest():
    pendulums = Pendulums(2, motor="lag")
    pendulums.push(np.full((50, 2, 1), 2.0))
    torque_state = pendulums.actuator.motors.state("torque")
    assert (torque_state.numpy() > 0.5).all()
    pendulums.scene.reset(torch.tensor([1]))
    pendulums.push(np.zeros((1, 2, 1)))
    assert torque_state.numpy()[0] > 0.5
    assert torque_state.numpy()[1] == 0.0


def test_parameters_and_signals_are_tensors_without_a_copy():
    pendulums = Pendulums(2, motor=CATALOGUE_MOTOR, varying=("motor.resistance",))
    current = pendulums.actuator.signal("current")
    pendulums.actuator.parameter("motor.resistance")[1] = 20.0
    pendulums.push(np.full((5, 2, 1), 2.0))
    assert current[0, 0] > current[1, 0] > 0.0


def test_a_motor_that_cannot_be_is_refused():
    with pytest.raises(UnstableError, match=r"unstable at a step of 0.002 s"):
        Pendulums(1, motor={"family": "current_loop", "controller": {"kp": 1e4}})
    with pytest.raises(UnstableError, match="outer loops are unstable"):
        Pendulums(1, motor=servo().replaced({"loop.velocity_gain": 200.0}))
    cfg = MotorActuatorCfg(
        target_names_expr=("rope",), transmission_type=TransmissionType.TENDON, motor="lag"
    )
    with pytest.raises(ValueError, match="motors in mjlab drive joints"):
        cfg.build(None, [0], ["rope"])
