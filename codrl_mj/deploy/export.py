"""A folder with all that a controller needs of a policy: an ONNX model, which any runtime reads, and its contract."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.deploy.c_code import c_files, check_board
from codrl_mj.deploy.contract import Contract
from codrl_mj.deploy.network import Network, network_of
from codrl_mj.deploy.tiles import Tiles
from codrl_mj.envs.config import EnvConfig
from codrl_mj.runs.files import atomic_folder
from codrl_mj.runs.policies import Policy, check_spaces

ONNX, TABLE = "policy.onnx", "table.csv"
OPSET = 17
IR = 9  # read by onnxruntime 1.16 and later


def onnx_model(network: Network | Tiles, about: Mapping[str, Any]) -> Any:
    """The model: `observation`, float32 (N, k), to `action`, float32 (N, m) or int64 (N,).

    Args:
        network: the policy.
        about: its metadata, by name; what is no text is kept as JSON.

    Returns:
        An `onnx.ModelProto` that `onnx.checker` accepts.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    constants: list[Any] = []
    nodes: list[Any] = []

    def node(kind: str, *inputs: str | np.ndarray, **attributes: Any) -> str:
        """Another node, by names of what goes in, or constants; the name of what it gives."""
        names = []
        for one in inputs:
            names.append(one if isinstance(one, str) else f"constant_{len(constants)}")
            if not isinstance(one, str):
                constants.append(numpy_helper.from_array(np.ascontiguousarray(one), names[-1]))
        nodes.append(helper.make_node(kind, names, [f"values_{len(nodes)}"], **attributes))
        return str(nodes[-1].output[0])

    network.graph(node)
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
        for name, value in about.items()
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
    """Write `policy.onnx`, `contract.json` and C99 into a new folder, whole or not at all.

    The C is `controller.h`, `controller.c` and `main.c`, which computes the golden commands again;
    the loops are in it where all motors have the same `codrl_mj.actuators.Drive`, `Servo` or the
    paper's `DCMotorActuator`.

    Args:
        policy: as `codrl_mj.runs.policies.load_policy` returns it, of PPO, SAC, TD3, DDPG, DQN
            or SARSA, whose weights are written as `table.csv` too.
        env: what it was trained in.
        agent: the name of what trained it.
        out: the folder; it must not exist, or be empty.
        episodes: how many are run for the golden numbers.
        seed: of the first of them.
        double: whether the C computes in double, not float.
        board: what it is to fit, one of `codrl_mj.deploy.c_code.BOARDS`; None for any.
        limits: as for `Contract.of`.

    Returns:
        The contract, as it was written.

    Raises:
        FileExistsError: the folder holds something.
        ValueError: the policy cannot be exported, does not fit the board, or what was written does
            not act as it does.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(
            f"--out {out}: it exists, and is no empty folder: name another, or delete it"
        )
    check_spaces(policy, env)
    network = network_of(policy)
    if board is not None:
        check_board(board, network, double)
    contract = Contract.of(policy, env, agent, episodes, seed, limits, double)
    about: dict[str, Any] = {
        name: getattr(contract, name)
        for name in ("task", "agent", "rate", "observations", "actions", "versions")
    }
    golden = contract.golden
    acted = network(np.array(golden["observations"], np.float32))
    if (worst := np.abs(acted - np.array(golden["actions"])).max()) > golden["tolerance"]:
        raise ValueError(
            f"the exported policy's actions differ by {worst:.3g} from the policy's own, must be at"
            f" most {golden['tolerance']:g}: it is not what its class says"
        )
    with atomic_folder(out) as folder:
        (folder / ONNX).write_bytes(onnx_model(network, about).SerializeToString())
        contract.write(folder)
        for name, content in c_files(network, contract).items():
            (folder / name).write_text(content)
        if isinstance(network, Tiles):
            (folder / TABLE).write_text(
                network.as_csv([one["name"] for one in contract.observations])
            )
    return contract
