"""A trained policy, taken out of the simulator: as ONNX, as C, and with all that it assumes of its controller."""

from codrl_mj.deploy.board import Board, BoardTest, OnnxPolicy, board_test
from codrl_mj.deploy.c_code import c_files, current_loop
from codrl_mj.deploy.contract import Contract
from codrl_mj.deploy.export import export, onnx_model
from codrl_mj.deploy.log import LogCheck, check_log, write_log
from codrl_mj.deploy.network import Network

__all__ = [
    "Board",
    "BoardTest",
    "Contract",
    "LogCheck",
    "Network",
    "OnnxPolicy",
    "board_test",
    "c_files",
    "check_log",
    "current_loop",
    "export",
    "onnx_model",
    "write_log",
]
