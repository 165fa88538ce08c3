"""Identification of motors from bench logs."""

from codrl_mj.identify.checks import check
from codrl_mj.identify.identify import identify
from codrl_mj.identify.log import Finding, Log
from codrl_mj.identify.parameters import PARAMETERS
from codrl_mj.identify.proposal import Proposal, propose_columns
from codrl_mj.identify.reading import read_log
from codrl_mj.identify.result import Estimate, Identified, Prediction

__all__ = [
    "PARAMETERS",
    "Estimate",
    "Finding",
    "Identified",
    "Log",
    "Prediction",
    "Proposal",
    "check",
    "identify",
    "propose_columns",
    "read_log",
]
