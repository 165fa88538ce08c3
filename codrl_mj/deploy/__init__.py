"""A trained policy, taken out of the simulator: as ONNX, and with what it and its controller assume of each other."""

from codrl_mj.deploy.contract import Contract
from codrl_mj.deploy.export import export, onnx_model
from codrl_mj.deploy.network import Network

__all__ = ["Contract", "Network", "export", "onnx_model"]
