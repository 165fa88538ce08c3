"""C99 code of a policy and of the current loop that it commands, for a microcontroller.

The code allocates no memory and uses only tanh, atan2 and fabs of the C library.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

import codrl_mj
from codrl_mj.deploy.contract import Contract
from codrl_mj.deploy.network import Network
from codrl_mj.deploy.tiles import Tiles
from codrl_mj.fields import check_names
from codrl_mj.user_code import asset_path

FILES = ("controller.h", "controller.c", "main.c", "wire.h", "wire.c", "board.c", "board.ld")
# Board -> bytes of flash memory, bytes of RAM, and True for an AVR. An AVR keeps constants in RAM,
# and its double has only 4 bytes.
BOARDS = {
    "arduino-uno": (32_256, 2_048, True),
    "arduino-due": (524_288, 98_304, False),
    "nucleo-f446re": (524_288, 131_072, False),
    "raspberry-pi-pico": (2_097_152, 270_336, False),
    "teensy-4.1": (8_126_464, 1_048_576, False),
}
# Bytes of flash memory in addition to the weights: 2,400 of code with tanhf, for a Cortex-M4 by
# gcc -O2, and the rest for start-up code and drivers.
CODE_BYTES = 6_000


def c_files(network: Network | Tiles, contract: Contract) -> dict[str, str]:
    """Return the C files of a policy and of the current loop that it commands.

    Args:
        network: the policy.
        contract: its contract, with the golden values, the parameters of the loop and the number
            type of the C code.

    Returns:
        Name -> content of each of `FILES`.
    """
    # Only the export needs jinja2.
    import jinja2

    loop, double = contract.controller["loop"], contract.controller["real"] == "double"
    suffix = "" if double else "f"

    def number(value: float) -> str:
        # 9 digits restore any float, and repr any double. C reads "1" as an integer, so a decimal
        # point is added.
        text = repr(float(value)) if double else f"{float(np.float32(value)):.9g}"
        return (text if set(text) & set(".en") else f"{text}.0") + suffix

    def array(values: ArrayLike, format_value: Callable[[float], str] = number) -> str:
        return "{" + ", ".join(format_value(value) for value in np.ravel(values).tolist()) + "}"

    golden = contract.golden
    levels = contract.levels
    # The values of a third-party environment's discrete actions are unknown; the command is the
    # index.
    if network.low is None and levels is None:
        levels = np.arange(network.choices, dtype=np.float64)[:, None]
    context = {
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
            (index, entry["name"], *contract.limits[entry["name"]])
            for index, entry in enumerate(contract.observations)
            if entry["name"] in contract.limits
        ],
        "tolerance": golden["tolerance"],
        "late_after": f"{round(1e6 * contract.late['after'])}u",
        "safe": contract.late["command"],
        "golden_seen": golden["observations"],
        "golden_commands": contract.to_commands(np.array(golden["actions"])),
        **_sizes(
            network,
            8 if double else 4,
            3 * len(contract.actions) if levels is None else levels.size,
        ),
    }
    templates = jinja2.Environment(
        undefined=jinja2.StrictUndefined, keep_trailing_newline=True, autoescape=False
    )
    return {
        name: templates.from_string(asset_path(f"deploy/{name}.jinja").read_text()).render(context)
        for name in FILES
    }


def _sizes(network: Network | Tiles, size: int, num_extra: int) -> dict[str, int]:
    """Return the bytes of constants, stack and state, and the operations of a step.

    Args:
        network: the policy.
        size: bytes of a number.
        num_extra: number of constants in addition to the policy's.
    """
    constants = size * (network.size + len(network.factors) + num_extra)
    sizes = {"constants": constants, "stack": size * network.num_working_values, "state": 2 * size}
    if isinstance(network, Tiles):
        tilings, axes = network.coder.displacements.shape
        return sizes | {"products": tilings * (axes + network.choices), "tanhs": 0}
    tanhs = sum(len(layer.bias) for layer in network.layers if layer.activation == "Tanh")
    return sizes | {"products": sum(layer.weight.size for layer in network.layers), "tanhs": tanhs}


def check_board(board: str, network: Network | Tiles, double: bool = False) -> None:
    """Raise a ValueError with both sizes if a policy does not fit a board of `BOARDS`."""
    check_names([board], BOARDS, "board")
    size = 8 if double else 4
    flash, ram, avr = BOARDS[board]
    if avr and double:
        raise ValueError(
            f"board {board}: its double has 4 bytes: leave out --float64, or name a larger board"
        )
    needs = (
        ("flash", size * network.size + CODE_BYTES, flash),
        ("RAM", size * (network.num_working_values + avr * network.size), ram),
    )
    smaller = "tilings 4" if isinstance(network, Tiles) else "hidden 32 32"
    for memory, needed, available in needs:
        if needed > available:
            raise ValueError(
                f"board {board}: the policy needs about {needed} bytes of {memory}, must be at most"
                f" {available}: train a smaller one (--agent.{smaller}), or name a larger board"
            )
