"""A policy, and the current loop behind it, as C99 for a microcontroller: no malloc, and of libm tanh alone."""

import contextlib
from typing import Any

import numpy as np

import codrl_mj
from codrl_mj.actuators import Actuator, Drive, Servo, sampled
from codrl_mj.actuators.sampled_loop import DEFAULT_BANDWIDTH
from codrl_mj.deploy.contract import Contract
from codrl_mj.deploy.network import Network
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import check_names
from codrl_mj.tasks.assets import asset_path

FILES = ("controller.h", "controller.c", "main.c", "wire.h", "wire.c", "board.c", "board.ld")
BOARDS = {  # name -> bytes of flash memory for a program, and of RAM
    "arduino-uno": (32_256, 2_048),
    "arduino-due": (524_288, 98_304),
    "nucleo-f446re": (524_288, 131_072),
    "raspberry-pi-pico": (2_097_152, 270_336),
    "teensy-4.1": (8_126_464, 1_048_576),
}
CODE = 6_000  # bytes beside the weights: 2,400 with tanhf, of a Cortex-M4 by gcc -O2; the rest for start-up and drivers


def current_loop(env: EnvConfig) -> dict[str, Any] | None:
    """The numbers of the loop that all motors share; None where there is none to be computed on a board.

    Those of a `codrl_mj.actuators.Drive` at 25 degC, whose gains are computed as it computes them, of a `Servo`, or of
    the paper's `Actuator`. Amperes for a command, limits [A] and [V], gains, and the rate of its samples [Hz].
    """
    first: Any = env.actuators[0]
    asked = ("position", "velocity") if type(first) is Servo else ("force", "current")
    if type(first) not in (Drive, Servo, Actuator) or any(one != first for one in env.actuators):
        return None
    if env.action not in asked:
        return None
    motor, loop = first.motor, first.controller
    forced = env.action == "force"
    shared = {
        "unit": "N or N*m" if forced else "A",
        "amperes": first.arm_radius / motor.torque_constant if forced else 1.0,
        "most": None,
        "voltage": first.voltage_limit,
        "sag": 0.0 if first.supply is None else first.supply.resistance,
        "servo": None,
    }
    if type(first) is Actuator:
        with contextlib.closing(env.make()) as made:
            model = getattr(made.unwrapped, "model", None)
        return None if model is None else shared | _paper_loop(first, float(model.opt.timestep) / loop.substeps)
    kp, ki = loop.kp, loop.ki / loop.sample_rate
    if loop.kp == 0.0 and loop.ki == 0.0:
        bandwidth = 2.0 * np.pi * (loop.bandwidth or DEFAULT_BANDWIDTH * loop.sample_rate)
        kp, ki = sampled.designed_gains(motor.resistance, motor.inductance, 1.0 / loop.sample_rate, bandwidth)
    return shared | {
        "kind": "sampled",
        "rate": loop.sample_rate,
        "most": loop.max_current if np.isfinite(loop.max_current) else None,
        "kp": kp,
        "ki": ki,
        "tracking": ki / (kp + ki) if kp + ki > 0.0 else 0.0,
        "back_emf": motor.back_emf_constant if loop.bemf_compensation else 0.0,
        "anti_windup": loop.anti_windup,
        "delayed": loop.delayed,
        "servo": _outer_loops(first) if type(first) is Servo else None,
    }


def _paper_loop(actuator: Actuator, period: float) -> dict[str, Any]:
    """The numbers of `codrl_mj.actuators.electrical_step` at its electrical step [s]; None: no limit."""
    loop, supply = actuator.controller, actuator.supply
    limits = {"voltage": actuator.voltage_limit, "most_voltage": loop.max_voltage}
    if supply is not None and supply.resistance:  # it sags from what the supply has without a current
        limits["voltage"] = supply.voltage if np.isfinite(supply.voltage) else loop.max_voltage
    return {name: value if np.isfinite(value) else None for name, value in limits.items()} | {
        "kind": "pid",
        "sag": 0.0 if supply is None or np.isinf(limits["voltage"]) else supply.resistance,
        "rate": 1.0 / period,
        "period": period,
        **{name: getattr(loop, name) for name in ("kp", "ki", "kd", "kff")},
        "back_emf": actuator.motor.back_emf_constant * float(loop.bemf_compensation),
        "leak": 1.0 + loop.integral_leak * period,
        "lag": loop.derivative_time_constant,
    }


def _outer_loops(servo: Servo) -> dict[str, Any]:
    """The numbers of a servo's loops at the rotor, as `codrl_mj.actuators.servo.demand` has them; None: no limit."""
    loop, ratio = servo.loop, servo.motor.gear_ratio
    gain = loop.velocity_gain / ratio**2
    limits = {"fastest": loop.max_velocity * ratio, "most": loop.max_torque / ratio}
    return {name: value if np.isfinite(value) else None for name, value in limits.items()} | {
        "controls": loop.controls,
        "rate": loop.servo_rate,
        "per_command": 1.0 / servo.arm_radius,
        "position_gain": loop.position_gain,
        "gain": gain,
        "integral_gain": loop.velocity_integral_gain * gain / loop.servo_rate,
        "velocity_ahead": loop.velocity_feed_forward,
        "torque_ahead": loop.inertia_feed_forward / ratio**2,
        "constant": servo.motor.torque_constant,
    }


def c_files(network: Network, contract: Contract, loop: dict[str, Any] | None, double: bool = False) -> dict[str, str]:
    """The C files of a policy, and of the current loop behind it.

    Args:
        network: the policy.
        contract: what it assumes, with the golden numbers.
        loop: what `current_loop` says; None for the policy alone.
        double: whether to compute in double, not float.

    Returns:
        Name -> content, of `FILES`.
    """
    import jinja2

    kind, suffix = ("double", "") if double else ("float", "f")

    def number(value: float) -> str:
        text = repr(float(value)) if double else f"{float(np.float32(value)):.9g}"
        return (text if set(text) & set(".en") else f"{text}.0") + suffix

    def array(values: Any) -> str:
        return "{" + ", ".join(number(value) for value in np.ravel(values)) + "}"

    golden = contract.golden
    levels = contract.levels
    if network.low is None and levels is None:  # an environment of others: what they stand for is their index
        levels = np.arange(len(network.gains), dtype=np.float64)[:, None]
    acted = np.array(golden["actions"])
    size = 8 if double else 4
    known = {
        "version": codrl_mj.__version__,
        "real": kind,
        "number": number,
        "array": array,
        "current": loop,
        "clamps": levels is None or bool(loop and (loop["voltage"] is not None or loop["most"] is not None)),
        "kept": "error" if loop and loop["kind"] == "pid" else "pending",
        "servo": loop and loop["servo"],
        "tanh": f"tanh{suffix}",
        "fabs": f"fabs{suffix}",
        "width": network.width,
        "levels": levels,
        **{name: getattr(network, name) for name in ("factors", "layers", "gains", "low", "high", "squashed")},
        **{name: getattr(contract, name) for name in ("task", "agent", "rate", "observations")},
        "commands": contract.actions,
        "choices": len(network.layers[-1].bias),
        "tolerance": golden["tolerance"],
        "late_after": f"{round(1e6 * contract.late['after'])}u",
        "safe": contract.late["command"],
        "golden_seen": golden["observations"],
        "golden_commands": contract.commands(acted),
        "constants": size
        * (network.size + len(network.factors) + (3 * len(acted[0]) if levels is None else levels.size)),
        "stack": 2 * size * network.width,
        "state": 2 * size,
        "products": sum(layer.weight.size for layer in network.layers),
        "tanhs": sum(len(layer.bias) for layer in network.layers if layer.activation == "Tanh"),
    }
    made = jinja2.Environment(undefined=jinja2.StrictUndefined, keep_trailing_newline=True, autoescape=False)
    return {name: made.from_string(asset_path(f"deploy/{name}.jinja").read_text()).render(known) for name in FILES}


def check_board(board: str, network: Network, double: bool = False) -> None:
    """Refuse a policy that does not fit a board of `BOARDS`, with both sizes."""
    check_names([board], BOARDS, "board")
    size = 8 if double else 4
    flash, ram = BOARDS[board]
    for what, needed, there in (("flash", size * network.size + CODE, flash), ("RAM", 2 * size * network.width, ram)):
        if needed > there:
            raise ValueError(
                f"board {board}: the policy needs about {needed} bytes of {what}, must be at most {there}: train a "
                "smaller network (--agent.hidden 32 32), or name a larger board"
            )
