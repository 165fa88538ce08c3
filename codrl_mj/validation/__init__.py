"""The certificate that the port is right: named checks against oracles that are not ours, and faults that fail them."""

from codrl_mj.validation.certificate import GROUPS, Certificate, validate, validate_model
from codrl_mj.validation.mutations import MUTATIONS, Caught, Mutation, try_mutations
from codrl_mj.validation.table import Check, Skipped

__all__ = [
    "GROUPS",
    "MUTATIONS",
    "Caught",
    "Certificate",
    "Check",
    "Mutation",
    "Skipped",
    "try_mutations",
    "validate",
    "validate_model",
]
