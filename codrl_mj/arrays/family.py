"""Reading of a family's `advance`, and the check that it can be read."""

from collections.abc import Callable, Mapping
from typing import NamedTuple, cast

from codrl_mj.actuators import Family, Inputs, parameters_type
from codrl_mj.actuators import model as actuator_model
from codrl_mj.arrays.reader import Reader
from codrl_mj.arrays.scalars import (
    DryRun,
    Operand,
    RefusedError,
    Scalar,
    ScalarBackend,
    UnsupportedError,
    leaves,
    with_leaves,
)
from codrl_mj.user_code import check_form, source_location


class AdvanceOperands(NamedTuple):
    """Result of `advance` as a back end represents it: floats."""

    state: list[Operand]
    torque: Operand
    signals: list[Operand]


def read_advance(
    family: Family,
    backend: ScalarBackend,
    parameters: Mapping[str, object],
    timestep: object,
    state: Mapping[str, object],
    inputs: Mapping[str, object],
) -> AdvanceOperands:
    """Pass the operations of a family's `advance` to a back end.

    Args:
        family: the family.
        backend: the back end.
        parameters: symbols, or known numbers, by name as in `parameters_type`.
        timestep: mechanical step [s].
        state: entries of the family's `State` by name.
        inputs: entries of `Inputs` by name.

    Raises:
        UnsupportedError: the source contains a construct that the reader does not take.
        ValueError: `advance` does not return what the family declares.
    """
    reader, advance = Reader(backend), family.advance
    arguments = (
        parameters_type(family)(**parameters),
        timestep,
        cast(Callable[..., object], family.State)(**state),
        Inputs(**inputs),  # type: ignore[arg-type]
    )
    try:
        result = reader.read(advance, arguments)
    except RefusedError as error:
        raise UnsupportedError(f"{source_location(advance)}: {error}") from error
    zeros = with_leaves(result, iter([0.0] * len(leaves(result))))
    check_form(advance, zeros, *actuator_model.advance_signature(family))
    after, torque, signals = cast(tuple[object, object, object], result)
    return AdvanceOperands(
        [reader.operand(number, "float") for number in leaves(after)],
        reader.operand(torque, "float"),
        [reader.operand(number, "float") for number in leaves(signals)],
    )


def check_family(family: Family) -> None:
    """Raise if other back ends than numba cannot run a family's `advance`.

    The check reads the source of `advance` and of all functions that it calls, and computes
    nothing. Numba may compile functions that this check refuses.

    Args:
        family: a subclass of `ActuatorModel`.

    Raises:
        UnsupportedError: the source contains a construct that the reader does not take; the message
            has file, line, construct and remedy.
        ValueError: the family is not complete; see `ActuatorModel`.
    """
    actuator_model.check_family(family)
    unknown = Scalar("float", None)
    parts = (parameters_type(family), family.State, Inputs)
    parameters, state, inputs = (dict.fromkeys(part._fields, unknown) for part in parts)
    read_advance(family, DryRun(), parameters, unknown, state, inputs)
