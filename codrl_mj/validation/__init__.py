"""Certificate of the port: checks against independent oracles, and faults that must fail them."""

from codrl_mj.validation.certificate import GROUPS, Certificate, validate, validate_model
from codrl_mj.validation.mutations import MUTATIONS, Mutation, MutationResult, try_mutations
from codrl_mj.validation.table import Check, Skipped

__all__ = [
    "GROUPS",
    "MUTATIONS",
    "MutationResult",
    "Certificate",
    "Check",
    "Mutation",
    "Skipped",
    "try_mutations",
    "validate",
    "validate_model",
]
