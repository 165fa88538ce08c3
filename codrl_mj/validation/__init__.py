"""Cross-validation of the MuJoCo port against dynamics that are not ours."""

from codrl_mj.validation.checks import Check, validate

__all__ = ["Check", "validate"]
