"""Export of a trained policy as ONNX and C, with a contract that records its assumptions."""

from codrl_mj.deploy.board import Board, BoardTest, Link, OnnxPolicy, board_test, instructions
from codrl_mj.deploy.c_code import c_files
from codrl_mj.deploy.compare import RigComparison, compare
from codrl_mj.deploy.contract import Contract, Interface
from codrl_mj.deploy.export import export, onnx_model
from codrl_mj.deploy.log import LogCheck, check_log, read_rows, write_log
from codrl_mj.deploy.loops import loop_parameters
from codrl_mj.deploy.network import Network, extract_network
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
    "loop_parameters",
    "export",
    "instructions",
    "extract_network",
    "onnx_model",
    "read_rows",
    "run_board",
    "write_log",
]
