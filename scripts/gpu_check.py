"""Check and time our motors in mujoco_warp on a GPU, in at most twelve minutes.

    python scripts/gpu_check.py --out gpu_check.json

The environment of `make simulators` has what is needed. The script

- compares the kernels of four motors, in doubles and in floats, with our engine;
- lets a motor turn a pendulum for 500 steps, and compares the angles with our engine's;
- times 4,096 HalfCheetahs with six motors and without, step by step and as a captured graph.

It prints the results with the name of the device, writes them as JSON, and returns 1 if a
comparison failed. `--device cpu` is a dry run with fewer worlds. Its results say what it left out.
"""

import argparse
import functools
import json
import platform
import time
import warnings
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import mujoco_warp
import numpy as np
import warp as wp

import codrl_mj
from codrl_mj.actuators import (
    ActuatorModel,
    DCMotorActuator,
    Drive,
    Inputs,
    Servo,
    ServoLoop,
    parameter_paths,
    resolve,
)
from codrl_mj.arrays import prepare_model
from codrl_mj.arrays.c_code import Real
from codrl_mj.arrays.mujoco_warp import attach_motors
from codrl_mj.arrays.warp import StepArrays, WarpActuators
from codrl_mj.engine.families import compiled_advance
from mujoco_warp_cheetahs import MOTOR, TIMESTEP, Cheetahs

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.002"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
NUM_PENDULUM_STEPS = 500
NUM_KERNEL_STEPS = 4
SHARE = 0.999
"""Share of the errors in floats that must be within the bar."""
BARS: Mapping[Real, float] = {"double": 1e-9, "float": 3e-5}
"""Largest error of a torque, relative to the largest torque. GPUs round sums of products once."""
PENDULUM_BAR = 1e-4
"""Largest difference of an angle [rad]; mujoco_warp computes in 32-bit floats."""
NO_GPU = (
    "no GPU was used: the kernels were compiled for the CPU",
    "the graph was a recording of Warp on the CPU, not a CUDA graph",
    "the times are those of a CPU, and of fewer worlds",
)
"""Limits of a dry run."""


class Sizes(NamedTuple):
    """Numbers of lanes, worlds and timed steps."""

    lanes: int
    worlds: int
    steps: int


FULL, DRY = Sizes(10_000, 4096, 200), Sizes(200, 8, 3)


def motors() -> dict[str, ActuatorModel]:
    """Return the motors whose kernels are compared."""
    drive = resolve(MOTOR, None, "the check").replaced(
        {"motor.gear_ratio": 9.0, "motor.gear_efficiency": 0.85, "controller.max_current": 6.0}
    )
    assert isinstance(drive, Drive)
    loop = ServoLoop(servo_rate=500.0, position_gain=8.0, velocity_gain=0.05)
    return {
        "drive": drive,
        "drive with a delayed loop": drive.replaced({"controller.delayed": True}),
        "servo": Servo(drive.motor, drive.controller, drive.supply, loop),
        "current loop with noise": DCMotorActuator().replaced({"controller.current_noise": 0.05}),
    }


def kernel_error(actuator: ActuatorModel, real: Real, num: int, device: str) -> float:
    """Return the error of a motor's kernel, relative to the largest torque.

    In floats it is the error that 99.9 % do not exceed.

    Args:
        actuator: the motor, whose resistance is another one in each lane.
        real: precision.
        num: number of lanes.
        device: device of Warp.
    """
    family, generator = type(actuator), np.random.default_rng(0)
    path = "motor.resistance"
    column = list(parameter_paths(family).values()).index(path)
    parameters = np.tile(np.array(actuator.parameter_values), (num, 1))
    parameters[:, column] *= generator.uniform(0.9, 1.1, num)
    keys = generator.integers(0, 2**24, num)
    kernel = WarpActuators(
        [actuator], num, TIMESTEP, varying=[path], per_world=True, device=device, real=real,
        edge="double",
    )  # fmt: skip
    kernel.parameter(path).assign(parameters[:, column : column + 1])
    kernel.set_noise_keys(keys[:, np.newaxis])
    commands = generator.uniform(-1.0, 1.0, (NUM_KERNEL_STEPS, num))
    speeds = np.tile(generator.uniform(-20.0, 20.0, num), (NUM_KERNEL_STEPS, 1))
    load, arm = 0.02, actuator.arm_radius
    ours, theirs = np.zeros_like(commands), np.zeros_like(commands)
    advance, states = compiled_advance(family), np.zeros((num, len(family.State._fields)))
    arrays = [wp.zeros((num, 1), dtype=wp.float64, device=device) for _ in range(4)]
    inertia = wp.full((1, 1), load, dtype=wp.float64, device=device)
    times = wp.zeros(num, dtype=wp.float64, device=device)
    for step in range(NUM_KERNEL_STEPS):
        times.fill_(TIMESTEP * step)
        desired, position, speed, force = arrays
        desired.assign(commands[step][:, np.newaxis])
        speed.assign(speeds[step][:, np.newaxis])
        kernel.step(StepArrays(times, desired, position, speed, force, inertia))
        theirs[step] = force.numpy()[:, 0]
        factor = 1.0 / arm if family.MOTION else arm
        for lane in range(num):
            inputs = Inputs(
                commands[step, lane] * factor,
                0.0,
                speeds[step, lane] / arm,
                TIMESTEP * step,
                float(keys[lane]),
                load * arm * arm,
            )
            states[lane], torque, _ = advance(parameters[lane], TIMESTEP, states[lane], inputs)
            ours[step, lane] = torque / arm
    errors = np.abs(ours - theirs) / np.abs(ours).max()
    return float(errors.max() if real == "double" else np.quantile(errors, SHARE))


def pendulum_error(device: str) -> float:
    """Return the largest difference of the angle of a pendulum from our engine's [rad]."""
    spec = mujoco.MjSpec.from_string(PENDULUM)
    motor = motors()["drive"]
    ours = codrl_mj.add_motors(spec, {"hinge": motor}).compile()
    robot = prepare_model(spec, {"hinge": motor})
    compiled = robot.spec.compile()
    data = mujoco.MjData(ours)
    with wp.ScopedDevice(device):
        their_model, their_data = mujoco_warp.put_model(compiled), mujoco_warp.make_data(compiled)
        attach_motors(robot, their_model, their_data)
        error = 0.0
        for step in range(NUM_PENDULUM_STEPS):
            command = 2.0 if step // 150 % 2 == 0 else -2.0
            data.ctrl[:] = command
            mujoco.mj_step(ours, data)
            their_data.ctrl.fill_(command)
            mujoco_warp.step(their_model, their_data)
            error = max(error, abs(float(their_data.qpos.numpy()[0, 0]) - float(data.qpos[0])))
    return error


def cheetah_times(sizes: Sizes, device: str) -> dict[str, dict[str, float]]:
    """Return milliseconds a step of HalfCheetahs, launched and as a captured graph.

    `gap` is the largest difference of a position between the two [rad, m].
    """
    options: dict[str, dict[str, Any]] = {
        "without motors": {"with_motors": False},
        "six motors, double": {"real": "double"},
        "six motors, float": {"real": "float"},
    }
    results = {}
    for name, option in options.items():
        cheetahs = Cheetahs(sizes.worlds, device, **option)
        # The first step compiles.
        cheetahs.step()
        with wp.ScopedCapture(device=device) as capture:
            cheetahs.step()
        replay = functools.partial(wp.capture_launch, capture.graph)
        launched, positions = _time_steps(cheetahs, cheetahs.step, sizes.steps)
        captured, again = _time_steps(cheetahs, replay, sizes.steps)
        gap = float(np.abs(positions - again).max())
        results[name] = {"launched_ms": launched, "captured_ms": captured, "gap": gap}
    return results


def _time_steps(
    cheetahs: Cheetahs, step: Callable[[], None], count: int
) -> tuple[float, np.ndarray]:
    """Return milliseconds a step after a reset, and the final positions."""
    cheetahs.reset()
    wp.synchronize()
    start = time.perf_counter()
    for _ in range(count):
        step()
    wp.synchronize()
    elapsed = time.perf_counter() - start
    return 1e3 * elapsed / count, cheetahs.data.qpos.numpy().copy()


def check(device: str, sizes: Sizes) -> dict[str, Any]:
    """Return all results, for JSON."""
    started, warp_device = time.perf_counter(), wp.get_device(device)
    kernels = {
        f"{name}, {real}": kernel_error(actuator, real, sizes.lanes, device)
        for name, actuator in motors().items()
        for real in BARS
    }
    failed = [name for name, error in kernels.items() if not error < BARS[_real_of(name)]]
    pendulum = pendulum_error(device)
    failed += [] if pendulum < PENDULUM_BAR else ["pendulum"]
    times = cheetah_times(sizes, device)
    packages = ("warp-lang", "mujoco-warp", "mujoco", "numpy")
    return {
        "device": warp_device.name if warp_device.is_cuda else f"CPU, {platform.machine()}",
        "is_gpu": bool(warp_device.is_cuda),
        "not_done": [] if warp_device.is_cuda else list(NO_GPU),
        "versions": {"codrl-mj": codrl_mj.__version__}
        | {package: metadata.version(package) for package in packages},
        "sizes": sizes._asdict(),
        "kernel_errors": kernels,
        "pendulum_error_rad": pendulum,
        "cheetah_step": times,
        "failed": failed,
        "seconds": time.perf_counter() - started,
    }


def _real_of(name: str) -> Real:
    return "double" if name.endswith("double") else "float"


def report(results: Mapping[str, Any]) -> None:
    """Print the results."""
    print(f"device: {results['device']}")
    for text in results["not_done"]:
        print(f"NOT DONE: {text}")
    for name, error in results["kernel_errors"].items():
        print(f"kernel of {name}: error {error:.1e} of the largest torque")
    print(f"pendulum: largest difference {results['pendulum_error_rad']:.1e} rad")
    base = results["cheetah_step"]["without motors"]
    for name, times in results["cheetah_step"].items():
        launched, captured = times["launched_ms"], times["captured_ms"]
        print(
            f"{results['sizes']['worlds']} HalfCheetahs, {name}: {launched:.3f} ms a step launched"
            f" ({launched / base['launched_ms']:.2f} of without motors), {captured:.3f} ms captured"
            f" ({captured / base['captured_ms']:.2f}), gap {times['gap']:.1e}"
        )
    print(f"failed: {', '.join(results['failed']) or 'nothing'}; {results['seconds']:.0f} s")


def main() -> int:
    """Run the check."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda:0", help="device of Warp, such as cuda:0 or cpu")
    parser.add_argument("--worlds", type=int, help=f"number of cheetahs; {FULL.worlds} on a GPU")
    parser.add_argument("--out", type=Path, default=Path("gpu_check.json"), help="JSON file")
    options = parser.parse_args()
    wp.config.quiet = True
    try:
        is_gpu = wp.get_device(options.device).is_cuda
    except (ValueError, RuntimeError) as error:
        parser.error(f"--device {options.device}: {error}; --device cpu is a dry run")
    sizes = FULL if is_gpu else DRY
    if options.worlds is not None:
        sizes = sizes._replace(worlds=options.worlds)
    # The cheetah has armatures and dampings of its own beside those of the motors.
    warnings.simplefilter("ignore")
    results = check(options.device, sizes)
    report(results)
    options.out.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    return int(bool(results["failed"]))


if __name__ == "__main__":
    raise SystemExit(main())
