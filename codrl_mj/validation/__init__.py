"""Cross-validation of the MuJoCo port against dynamics that are not ours."""

from codrl_mj.validation.checks import validate
from codrl_mj.validation.outcome import Check, Curve, Plot

__all__ = ["Check", "Curve", "Plot", "validate"]
