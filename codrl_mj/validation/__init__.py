"""Certificate of the port of Gymnasium's tasks to MuJoCo.

Its checks compare simulations with independent references, called oracles. Deliberate faults show
that each check can fail.
"""

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
