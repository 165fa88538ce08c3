"""Written motors act in the other simulators' own classes as their torque-speed lines."""

import ast
import importlib.util
import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from codrl_mj.actuators import Drive, ServoFriction, TorqueSpeed
from codrl_mj.arrays import write_motor
from codrl_mj.arrays.written_losses import steady_torque
from codrl_mj.arrays.written_models import bam_torque, torque_speed_line, winding_of
from codrl_mj.catalogue import motor_entry

MOTORS = {
    "line": TorqueSpeed(stall_torque=2.0, no_load_speed=30.0, max_torque=1.5),
    "drive": Drive.from_motor_parameters(motor_entry("maxon-ec45-flat-50w").parameters).replaced(
        {"motor.gear_ratio": 20.0, "motor.gear_efficiency": 0.8, "controller.max_current": 10.0}
    ),
}
NUM_POINTS = 2000


def random_points(motor):
    """Return speeds and commands up to beyond the corner of the line, and the line's torques."""
    line, random = torque_speed_line(motor), np.random.default_rng(0)
    speeds = random.uniform(-2.5, 2.5, NUM_POINTS) * line.no_load_speed
    commands = random.uniform(-1.5, 1.5, NUM_POINTS) * line.stall_torque
    return speeds, commands, steady_torque(line, commands, speeds)


def assert_equal_to_the_line(torques, expected):
    """Compare torques that the other simulator computed in 32-bit floats."""
    gap = np.abs(np.asarray(torques, dtype=float) - expected).max() / np.abs(expected).max()
    print("largest gap", gap, "of the largest torque")
    assert gap < 1e-6


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("motor", MOTORS.values(), ids=MOTORS)
def test_mjlab_clips_as_the_line(motor):
    torch = pytest.importorskip("torch", reason="NOT RUN: torch is not installed: make simulators")
    pytest.importorskip("mjlab", reason="NOT RUN: mjlab is not installed: make simulators")
    from mjlab.actuator import DcMotorActuator
    from mjlab.actuator.actuator import ActuatorCmd

    namespace = {}
    exec(write_motor(motor, "mjlab", "hip").text, namespace)
    configuration = namespace["ACTUATOR"]
    speeds, commands, expected = random_points(motor)
    speed, command = (
        torch.tensor(values, dtype=torch.float32)[None] for values in (speeds, commands)
    )
    zero = torch.zeros_like(speed)
    numbers = {
        "stiffness": configuration.stiffness,
        "damping": configuration.damping,
        "saturation_effort": configuration.saturation_effort,
        "velocity_limit_motor": configuration.velocity_limit,
        "force_limit": configuration.effort_limit,
    }
    assert set(numbers) == set(DcMotorActuator.param_names)
    torques = DcMotorActuator.control_law(
        {name: torch.full_like(speed, value) for name, value in numbers.items()},
        ActuatorCmd(
            position_target=zero,
            velocity_target=zero,
            effort_target=command,
            pos=zero,
            vel=speed,
        ),
    )
    assert_equal_to_the_line(torques[0], expected)
    assert configuration.armature == pytest.approx(motor.additions.armature)
    assert configuration.frictionloss == pytest.approx(motor.additions.friction)


@pytest.mark.parametrize("motor", MOTORS.values(), ids=MOTORS)
def test_newton_clamps_as_the_line(motor):
    warp = pytest.importorskip("warp", reason="NOT RUN: Warp is not installed: make simulators")
    newton = pytest.importorskip(
        "newton", reason="NOT RUN: Newton is not installed: make simulators"
    )
    from newton.actuators import ClampingDCMotor

    builder, namespace = newton.ModelBuilder(), {}
    body = builder.add_link(mass=1.0, inertia=warp.mat33(np.eye(3)))
    joint = builder.add_joint_revolute(-1, body, label="robot/hip")
    builder.add_articulation([joint])
    exec(write_motor(motor, "newton", "hip").text, namespace)
    namespace["add_motors"](builder)
    assert builder.joint_armature[0] == pytest.approx(motor.additions.armature)
    assert builder.joint_friction[0] == pytest.approx(motor.additions.friction)
    model = builder.finalize(device="cpu")
    (actuator,) = model.actuators
    (clamping,) = actuator.clamping
    assert isinstance(clamping, ClampingDCMotor)
    speeds, commands, expected = random_points(motor)
    # One motor per point, with the numbers that the builder gave to the written one.
    many = ClampingDCMotor(
        *(
            warp.array(np.repeat(values.numpy(), NUM_POINTS), dtype=float, device="cpu")
            for values in (
                clamping.saturation_effort,
                clamping.velocity_limit,
                clamping.max_motor_effort,
            )
        )
    )
    indices = warp.array(np.arange(NUM_POINTS), dtype=warp.uint32, device="cpu")
    source, speed = (warp.array(values, dtype=float, device="cpu") for values in (commands, speeds))
    torques = warp.zeros_like(source)
    many.modify_forces(source, torques, speed, speed, indices, indices, "cpu")
    assert_equal_to_the_line(torques.numpy(), expected)


def classes_of(folder, name):
    """Return the classes that a module defines, as syntax trees, by name."""
    tree = ast.parse((folder / f"{name}.py").read_text())
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


class IsaacLabActuator:
    """Stand-in for the base of `DCMotor`, which stores the limits."""

    def __init__(self, cfg):
        """Store the limits of a configuration."""
        self.cfg, self._joint_names, self._num_envs, self._device = cfg, ["hip"], 1, "cpu"
        self.actuator_velocity_limit = cfg.actuator_velocity_limit
        self.actuator_effort_limit = cfg.actuator_effort_limit


@pytest.mark.parametrize("motor", MOTORS.values(), ids=MOTORS)
def test_isaac_lab_clips_as_the_line(motor):
    """Run the class `DCMotor` alone, because its package needs Isaac Sim."""
    torch = pytest.importorskip("torch", reason="NOT RUN: torch is not installed: make simulators")
    package = importlib.util.find_spec("isaaclab")
    if package is None:
        pytest.skip("NOT RUN: Isaac Lab is not installed: pip install --no-deps isaaclab==3.0.0")
    folder = Path(package.submodule_search_locations[0]) / "actuators"
    future = ast.parse("from __future__ import annotations").body
    module = ast.Module([*future, classes_of(folder, "actuator_pd")["DCMotor"]], [])
    namespace = {
        "torch": torch,
        "IdealPDActuator": IsaacLabActuator,
        "resolve_joint_parameter": lambda value, *_: torch.tensor(value),
    }
    exec(compile(module, "actuator_pd.py", "exec"), namespace)

    text = write_motor(motor, "isaaclab", "hip").text.split("\n", 1)[1]
    written = {"DCMotorCfg": lambda **values: SimpleNamespace(**values)}
    exec(text, written)
    configuration = written["ACTUATOR"]
    known = [
        classes_of(folder, "actuator_base_cfg")["ActuatorBaseCfg"],
        classes_of(folder, "actuator_pd_cfg")["DCMotorCfg"],
    ]
    fields = {
        node.target.id for cls in known for node in cls.body if isinstance(node, ast.AnnAssign)
    }
    assert vars(configuration).keys() <= fields
    assert configuration.armature == pytest.approx(motor.additions.armature)
    speeds, commands, expected = random_points(motor)
    speed, command = (torch.tensor(values, dtype=torch.float32) for values in (speeds, commands))
    actuator = namespace["DCMotor"](configuration)
    assert_equal_to_the_line(actuator._clip_effort(command, speed), expected)


@pytest.mark.parametrize("max_current", [2.5, 10.0, math.inf])
def test_bam_loads_the_file_and_computes_its_torque(tmp_path, max_current):
    reason = "NOT RUN: BAM is not installed: pip install --no-deps better-actuator-models"
    load_model = pytest.importorskip("bam.model", reason=reason).load_model

    motor = MOTORS["drive"].replaced(
        {
            "motor.stribeck_friction": 0.004,
            "motor.stribeck_speed": 3.0,
            "motor.torque_constant": 0.03,
            "controller.max_current": max_current,
        }
    )
    file = tmp_path / "motor.json"
    file.write_text(write_motor(motor, "bam").text)
    model = load_model(str(file))
    # No parameter of the model keeps BAM's default.
    assert set(model.get_parameters()) <= set(json.loads(file.read_text()))
    assert model.actuator.get_extra_inertia() == pytest.approx(motor.additions.armature)
    speeds, commands, _ = random_points(motor)
    winding = winding_of(motor, "bam")
    # The numbers that the table of losses asks to set.
    model.actuator.vin, model.actuator.max_pwm = winding.voltage, 1.0
    if math.isfinite(max_current):
        model.actuator.max_current = winding.max_current
    # BAM's command is a position, so the voltage is the one that its gains make of an error.
    duty = (winding.volts_per_force * commands + winding.volts_per_speed * speeds) / winding.voltage
    error = duty / (model.actuator.kp * model.actuator.error_gain)
    volts = model.actuator.compute_control(error, 0.0, speeds, 0.001)
    torque = model.actuator.compute_torque(volts, True, 0.0, speeds)
    losses = [model.compute_frictions(t, 0.0, s)[0] for t, s in zip(torque, speeds, strict=True)]
    net = torque - (np.array(losses) - motor.additions.friction) * np.sign(speeds)
    np.testing.assert_allclose(net, bam_torque(motor, commands, speeds), rtol=0.0, atol=1e-7)


def test_bam_loads_the_friction_of_servos_and_computes_its_limit(tmp_path):
    reason = "NOT RUN: BAM is not installed: pip install --no-deps better-actuator-models"
    load_model = pytest.importorskip("bam.model", reason=reason).load_model

    numbers = 0.1, 0.02, 0.15, 0.5, 1.3, 0.2, 0.1, 0.05, 0.1, 0.01, 0.02
    friction = ServoFriction(*numbers)
    motor = MOTORS["drive"].replaced({"motor.gear_efficiency": 1.0, "motor.coulomb_friction": 0.0})
    file = tmp_path / "motor.json"
    file.write_text(write_motor(motor.replaced({"friction": friction}), "bam").text)
    model, random = load_model(str(file)), np.random.default_rng(0)
    speeds, torques, loads = random.uniform(-3.0, 3.0, (3, 500))
    loss, damping = model.compute_frictions(torques, loads, speeds)
    expected = friction.limit(speeds, torques, loads)
    np.testing.assert_allclose(loss + damping * np.abs(speeds), expected, rtol=0.0, atol=1e-9)
