"""A policy, and the current loop behind it, as C99 for a microcontroller: no malloc, of libm tanh, atan2 and fabs."""

from collections.abc import Callable
from typing import Any

import numpy as np

import codrl_mj
from codrl_mj.deploy.contract import Contract
from codrl_mj.deploy.network import Network
from codrl_mj.deploy.tiles import Tiles
from codrl_mj.fields import check_names
from codrl_mj.user_code import asset_path

FILES = ("controller.h", "controller.c", "main.c", "wire.h", "wire.c", "board.c", "board.ld")
# name -> bytes of flash memory for a program, of RAM; whether an AVR: constants lie in RAM, a
# double has 4
BOARDS = {
    "arduino-uno": (32_256, 2_048, True),
    "arduino-due": (524_288, 98_304, False),
    "nucleo-f446re": (524_288, 131_072, False),
    "raspberry-pi-pico": (2_097_152, 270_336, False),
    "teensy-4.1": (8_126_464, 1_048_576, False),
}
# bytes beside the weights: 2,400 with tanhf, of a Cortex-M4 by gcc -O2; the rest for start-up and
# drivers
CODE = 6_000


def c_files(network: Network | Tiles, contract: Contract) -> dict[str, str]:
    """The C files of a policy, and of the current loop behind it.

    Args:
        network: the policy.
        contract: what it assumes, with the golden numbers, the loop's, and in which numbers it
            computes.

    Returns:
        Name -> content, of `FILES`.
    """
    import jinja2

    loop, double = contract.controller["loop"], contract.controller["real"] == "double"
    suffix = "" if double else "f"

    def number(value: float) -> str:
        text = repr(float(value)) if double else f"{float(np.float32(value)):.9g}"
        return (text if set(text) & set(".en") else f"{text}.0") + suffix

    def array(values: Any, form: Callable[[float], str] = number) -> str:
        return "{" + ", ".join(form(value) for value in np.ravel(values).tolist()) + "}"

    golden = contract.golden
    levels = contract.levels
    if (
        network.low is None and levels is None
    ):  # an environment of others: what they stand for is their index
        levels = np.arange(network.choices, dtype=np.float64)[:, None]
    known = {
        "version": codrl_mj.__version__,
        "real": contract.controller["real"],
        "number": number,
        "array": array,
        "exact": repr,
        "current": loop,
        "clamps": (
            levels is None
            or bool(loop and (loop["voltage"] is not None or loop["most"] is not None))
        ),
        "kept": "error" if loop and loop["kind"] == "pid" else "pending",
        "servo": loop and loop["servo"],
        "tanh": f"tanh{suffix}",
        "fabs": f"fabs{suffix}",
        "network": network,
        "tiles": isinstance(network, Tiles),
        "angles": network.angles if isinstance(network, Tiles) else 0,
        "levels": levels,
        **{name: getattr(contract, name) for name in ("task", "agent", "rate", "observations")},
        "commands": contract.actions,
        "limits": [
            (place, one["name"], *contract.limits[one["name"]])
            for place, one in enumerate(contract.observations)
            if one["name"] in contract.limits
        ],
        "tolerance": golden["tolerance"],
        "late_after": f"{round(1e6 * contract.late['after'])}u",
        "safe": contract.late["command"],
        "golden_seen": golden["observations"],
        "golden_commands": contract.commands(np.array(golden["actions"])),
        **_sizes(
            network,
            8 if double else 4,
            3 * len(contract.actions) if levels is None else levels.size,
        ),
    }
    made = jinja2.Environment(
        undefined=jinja2.StrictUndefined, keep_trailing_newline=True, autoescape=False
    )
    return {
        name: made.from_string(asset_path(f"deploy/{name}.jinja").read_text()).render(known)
        for name in FILES
    }


def _sizes(network: Network | Tiles, size: int, further: int) -> dict[str, int]:
    """Bytes of constants, stack and state by those of a number, and how many operations a step takes."""
    constants = size * (network.size + len(network.factors) + further)
    told = {"constants": constants, "stack": size * network.working, "state": 2 * size}
    if isinstance(network, Tiles):
        tilings, axes = network.coder.displacements.shape
        return told | {"products": tilings * (axes + network.choices), "tanhs": 0}
    tanhs = sum(len(layer.bias) for layer in network.layers if layer.activation == "Tanh")
    return told | {"products": sum(layer.weight.size for layer in network.layers), "tanhs": tanhs}


def check_board(board: str, network: Network | Tiles, double: bool = False) -> None:
    """Refuse a policy that does not fit a board of `BOARDS`, with both sizes."""
    check_names([board], BOARDS, "board")
    size = 8 if double else 4
    flash, ram, avr = BOARDS[board]
    if avr and double:
        raise ValueError(
            f"board {board}: its double has 4 bytes: leave out --float64, or name a larger board"
        )
    needs = (
        ("flash", size * network.size + CODE, flash),
        ("RAM", size * (network.working + avr * network.size), ram),
    )
    smaller = "tilings 4" if isinstance(network, Tiles) else "hidden 32 32"
    for what, needed, there in needs:
        if needed > there:
            raise ValueError(
                f"board {board}: the policy needs about {needed} bytes of {what}, must be at most"
                f" {there}: train a smaller one (--agent.{smaller}), or name a larger board"
            )
