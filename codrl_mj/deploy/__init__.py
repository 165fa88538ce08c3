"""A trained policy, taken out of the simulator: as ONNX, as C, and with all that it assumes of its controller."""

from codrl_mj.deploy.board import Board, BoardTest, Link, OnnxPolicy, board_test, instructions
from codrl_mj.deploy.c_code import c_files
from codrl_mj.deploy.compare import RigComparison, compare
from codrl_mj.deploy.contract import Contract, Interface
from codrl_mj.deploy.export import export, onnx_model
from codrl_mj.deploy.log import LogCheck, check_log, read_rows, write_log
from codrl_mj.deploy.loops import current_loop
from codrl_mj.deploy.network import Network, network_of
from codrl_mj.deploy.run import BoardRun, run_board
from codrl_mj.deploy.tiles import Tiles
from codrl_mj.deploy.wire import Wire

__all__ = [
    "Board",
    "BoardRun",
    "BoardTest",
    "RigComparison",
    "Contract",
    "Interface",
    "Link",
    "LogCheck",
    "Network",
    "OnnxPolicy",
    "Tiles",
    "Wire",
    "board_test",
    "c_files",
    "check_log",
    "compare",
    "current_loop",
    "export",
    "instructions",
    "network_of",
    "onnx_model",
    "read_rows",
    "run_board",
    "write_log",
]
