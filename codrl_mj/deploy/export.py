"""Export of a policy into a folder with an ONNX model, C code and the contract."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.boundary import Json, JsonObject
from codrl_mj.deploy.c_code import c_files, check_board
from codrl_mj.deploy.contract import Contract
from codrl_mj.deploy.network import Network, extract_network
from codrl_mj.deploy.tiles import Tiles
from codrl_mj.envs.config import EnvConfig
from codrl_mj.runs.files import atomic_folder
from codrl_mj.runs.policies import Policy

# onnx is optional, and mypy does not read it.
OnnxMessage = Any
"""Message of `onnx`, such as its `ModelProto`, a node or a constant."""
ONNX, TABLE = "policy.onnx", "table.csv"
OPSET = 17
"""Version of the ONNX operators."""
IR = 9
"""Version of the ONNX file format, which onnxruntime 1.16 and later read."""


def onnx_model(network: Network | Tiles, metadata: Mapping[str, Json]) -> OnnxMessage:
    """Return the ONNX model from `observation`, float32 (N, k), to `action`.

    The action is float32 (N, m), or int64 (N,) for discrete actions.

    Args:
        network: the policy.
        metadata: metadata by name; values other than text are stored as JSON.

    Returns:
        An `onnx.ModelProto` that `onnx.checker` accepts.
    """
    # Only the export needs onnx.
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    constants: list[OnnxMessage] = []
    nodes: list[OnnxMessage] = []

    def node(kind: str, *inputs: str | np.ndarray, **attributes: int) -> str:
        """Add a node with inputs by name or as constants, and return the name of its output."""
        names = []
        for operand in inputs:
            names.append(operand if isinstance(operand, str) else f"constant_{len(constants)}")
            if not isinstance(operand, str):
                constants.append(numpy_helper.from_array(np.ascontiguousarray(operand), names[-1]))
        nodes.append(helper.make_node(kind, names, [f"values_{len(nodes)}"], **attributes))
        return str(nodes[-1].output[0])

    network.add_to_graph(node)
    nodes[-1].output[0] = "action"
    kind, shape = (
        (TensorProto.INT64, ["N"])
        if network.low is None
        else (TensorProto.FLOAT, ["N", len(network.low)])
    )
    graph = helper.make_graph(
        nodes,
        "policy",
        [
            helper.make_tensor_value_info(
                "observation", TensorProto.FLOAT, ["N", len(network.factors)]
            )
        ],
        [helper.make_tensor_value_info("action", kind, shape)],
        constants,
    )
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR,
        producer_name="codrl_mj",
    )
    texts = {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in metadata.items()
    }
    helper.set_model_props(model, texts)
    onnx.checker.check_model(model, full_check=True)
    return model


def export(
    policy: Policy,
    env: EnvConfig,
    agent: str,
    out: Path,
    episodes: int = 5,
    seed: int = 0,
    double: bool = False,
    board: str | None = None,
    limits: Mapping[str, float] | None = None,
) -> Contract:
    """Write `policy.onnx`, `contract.json` and C99 code into a new folder atomically.

    The C code is `controller.h`, `controller.c` and `main.c`, which recomputes the golden commands.
    It includes the current loop, and a servo's outer loops, if all motors have the same actuator
    and that is a `codrl_mj.actuators.Drive`, a `Servo` or the paper's `DCMotorActuator`.

    Args:
        policy: as `codrl_mj.runs.policies.load_policy` returns it, of PPO, SAC, TD3, DDPG, DQN or
            SARSA. SARSA's weights are also written as `table.csv`.
        env: the environment of the training.
        agent: name of the agent that trained the policy.
        out: the folder; it must not exist, or be empty.
        episodes: number of episodes for the golden values.
        seed: seed of the first episode.
        double: True if the C code computes in double, False for float.
        board: board that the policy must fit, of `codrl_mj.deploy.c_code.BOARDS`; None for any.
        limits: as for `Contract.from_policy`.

    Returns:
        The written contract.

    Raises:
        FileExistsError: the folder is not empty.
        ValueError: the policy cannot be exported, does not fit the board, or acts differently once
            exported.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(
            f"--out {out}: it exists and is not an empty folder: name another, or delete it"
        )
    network = extract_network(policy)
    if board is not None:
        check_board(board, network, double)
    contract = Contract.from_policy(policy, env, agent, episodes, seed, limits, double)
    metadata: JsonObject = {
        name: getattr(contract, name)
        for name in ("task", "agent", "rate", "observations", "actions", "versions")
    }
    golden = contract.golden
    actions = network(np.array(golden["observations"], np.float32))
    if (max_error := np.abs(actions - np.array(golden["actions"])).max()) > golden["tolerance"]:
        raise ValueError(
            f"the exported policy's actions differ by {max_error:.3g} from the original's, must be"
            f" at most {golden['tolerance']:g}: its class has operations that"
            " are not exported"
        )
    with atomic_folder(out) as folder:
        (folder / ONNX).write_bytes(onnx_model(network, metadata).SerializeToString())
        contract.write(folder)
        for name, content in c_files(network, contract).items():
            (folder / name).write_text(content)
        if isinstance(network, Tiles):
            (folder / TABLE).write_text(
                network.as_csv([entry["name"] for entry in contract.observations])
            )
    return contract
