"""Back end that writes C: one text for a C compiler, for CUDA, and for Warp on a CPU.

Every intermediate result is a constant with its own name, and every loop has its own variables. The
text uses doubles and 64-bit integers, and computes exactly what the source computes in Python.
"""

import inspect
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Literal, NamedTuple

from codrl_mj.actuators import ActuatorModel, Family, Inputs, family_name, parameters_type
from codrl_mj.arrays.family import read_advance
from codrl_mj.arrays.scalars import Kind, Replacement, Scalar, ScalarLoop

Real = Literal["double", "float"]
"""Type of floats in C."""
_TYPES: dict[Kind, str] = {"bool": "int", "int": "long long"}
_INFIX = {
    "add": "+",
    "sub": "-",
    "mul": "*",
    "div": "/",
    "and": "&",
    "or": "|",
    "xor": "^",
    "shr": ">>",
    "lt": "<",
    "le": "<=",
    "gt": ">",
    "ge": ">=",
    "eq": "==",
    "ne": "!=",
}
_BOOL_RESULTS = {"lt", "le", "gt", "ge", "eq", "ne", "not", "isinf", "isnan", "isfinite"}
_WRAPPING = {"add": "+", "sub": "-", "mul": "*", "shl": "<<"}
"""Operations on ints that may overflow. C defines this for unsigned integers only."""
# glibc exports an old function named `advance`, which a shared library would call instead.
DEFAULT_NAME = "advance_actuator"
"""Name of the C function, unless the user chooses another."""
_MAX_INT = "9223372036854775807LL"
_MAX_FLOAT = 3.4028234663852886e38
"""Largest number of a 32-bit float."""


class CCode:
    """Back end whose operands are the names of C variables, and constants.

    Args:
        portable: True to write `expm1`, `log1p`, `hypot` and `copysign` in terms of other
            functions, because Warp has none of them on a CPU. The results then differ in the last
            digits.
        real: type of floats; with `float`, no statement computes with doubles.
    """

    replacements: Mapping[Callable[..., object], Replacement] = {}

    def __init__(self, portable: bool = False, real: Real = "double") -> None:
        """Start with no statements."""
        self.lines: list[str] = []
        """Statements, one a line."""
        self._portable = portable
        self._types: dict[Kind, str] = {**_TYPES, "float": real}
        self._suffix = "f" if real == "float" else ""
        self._count = 0
        self._indent = 1

    def constant(self, value: float, kind: Kind) -> str:
        """Return a literal."""
        if kind != "float":
            text = f"{abs(int(value))}LL" if kind == "int" else f"{int(value)}"
        elif math.isnan(value):
            return f"({self._number(0.0)} / {self._number(0.0)})"
        elif math.isinf(value) or (self._suffix and abs(value) > _MAX_FLOAT):
            # Warp has no HUGE_VAL on a CPU, and strict C compilers warn of the overflow.
            huge = f"1e{30 if self._suffix else 300}{self._suffix}"
            text = f"({huge} * {huge})" if self._portable or self._suffix else "HUGE_VAL"
        else:
            text = f"{abs(float(value))!r}{self._suffix}"
        return f"(-{text})" if math.copysign(1.0, value) < 0.0 else text

    def _number(self, value: float) -> str:
        """Return the literal of a float that is written in a replacement of a function."""
        return self.constant(value, "float")

    def convert(self, operand: str, old: Kind, new: Kind) -> str:
        """Write a conversion, and return the name of its result."""
        if new == "bool":
            return self._define("bool", f"{operand} != 0")
        if (old, new) != ("float", "int"):
            return self._define(new, f"({self._types[new]}){operand}")
        # C leaves the result undefined if the float is NaN or too large for an int.
        limit = self._number(9.2e18)
        return self._define(
            "int",
            f"{operand} != {operand} ? 0LL : {operand} >= {limit} ? {_MAX_INT}"
            f" : {operand} <= -{limit} ? -{_MAX_INT} : (long long){operand}",
        )

    def operation(self, name: str, kind: Kind, *operands: str) -> str:
        """Write an operation, and return the name of its result."""
        if name in ("floordiv", "mod"):
            return self._divide(name, kind, *operands)
        if self._portable and name in _REPLACEMENTS:
            return _REPLACEMENTS[name](self, *operands)
        return self._define(
            "bool" if name in _BOOL_RESULTS else kind, self._text(name, kind, *operands)
        )

    def _text(self, name: str, kind: Kind, *operands: str) -> str:
        """Return an expression."""
        first, last = operands[0], operands[-1]
        if kind == "int" and name in _WRAPPING:
            return (
                f"(long long)((unsigned long long){first} {_WRAPPING[name]}"
                f" (unsigned long long){last})"
            )
        if name in _INFIX:
            return f"{first} {_INFIX[name]} {last}"
        if name in ("min", "max"):
            # Python returns the first argument unless the second is smaller, or larger.
            return f"{last} {'<' if name == 'min' else '>'} {first} ? {last} : {first}"
        if name == "abs" and kind == "int":
            return f"{first} < 0 ? -{first} : {first}"
        infinity = self.constant(math.inf, "float")
        expressions = {
            "neg": f"-{first}",
            "not": f"!{first}",
            "abs": f"{self._function('fabs')}({first})",
            "isinf": f"{first} == {infinity} || {first} == -{infinity}",
            "isnan": f"{first} != {first}",
            "isfinite": f"{first} - {first} == {self._number(0.0)}",
        }
        return expressions.get(name, f"{self._function(name)}({', '.join(operands)})")

    def _function(self, name: str) -> str:
        """Return the name of a function of the math library for the type of floats."""
        return name + self._suffix

    def _divide(self, name: str, kind: Kind, left: str, right: str) -> str:
        """Write Python's floor division or remainder, which has the sign of the divisor."""
        if kind == "int":
            quotient = self._define("int", f"{right} == 0 ? 0LL : {left} / {right}")
            remainder = self._define("int", f"{right} == 0 ? 0LL : {left} % {right}")
            is_below = self._define(
                "bool", f"{remainder} != 0 && ({remainder} < 0) != ({right} < 0)"
            )
            if name == "floordiv":
                return self._define("int", f"{quotient} - {is_below}")
            return self._define("int", f"{is_below} ? {remainder} + {right} : {remainder}")
        # The same steps as in Python, which are exact to the last bit.
        zero, half, unit = map(self._number, (0.0, 0.5, 1.0))
        remainder = self._define("float", f"{self._function('fmod')}({left}, {right})")
        is_below = self._define(
            "bool", f"{remainder} != {zero} && ({remainder} < {zero}) != ({right} < {zero})"
        )
        if name == "mod":
            return self._define("float", f"{is_below} ? {remainder} + {right} : {remainder}")
        quotient = self._define("float", f"({left} - {remainder}) / {right} - {is_below}")
        whole = self._define("float", f"{self._function('floor')}({quotient})")
        return self._define("float", f"{quotient} - {whole} > {half} ? {whole} + {unit} : {whole}")

    def branch(
        self,
        condition: str,
        then: Callable[[], list[str]],
        otherwise: Callable[[], list[str]],
        kinds: list[Kind],
    ) -> list[str]:
        """Write `if` and `else`, and return the names of the variables that they set."""
        outer, sides = self.lines, []
        self._indent += 1
        for side in (then, otherwise):
            self.lines = []
            sides.append((side(), self.lines))
        self._indent -= 1
        self.lines = outer
        (then_values, then_lines), (other_values, other_lines) = sides
        if not then_lines and not other_lines:
            return [
                self._define(kind, f"{condition} ? {left} : {right}")
                for kind, left, right in zip(kinds, then_values, other_values, strict=True)
            ]
        names = [self._declare(kind) for kind in kinds]
        self._line(f"if ({condition}) {{")
        self._set(names, then_values, then_lines)
        self._line("} else {")
        self._set(names, other_values, other_lines)
        self._line("}")
        return names

    def loop(self, loop: ScalarLoop) -> list[str]:
        """Write a loop, and return the names of its variables."""
        names = [self._declare(*pair) for pair in zip(loop.kinds, loop.initial, strict=True)]
        self._line("while (1) {")
        self._indent += 1
        # The body reads the values from before the iteration while it computes the next ones.
        before = [self._define(kind, name) for name, kind in zip(names, loop.kinds, strict=True)]
        self._line(f"if (!{loop.condition(before)}) break;")
        after = loop.body(before)
        self._indent -= 1
        self._set(names, after, [])
        self._line("}")
        return names

    def _set(self, names: list[str], values: list[str], lines: list[str]) -> None:
        """Write statements, and assignments to variables after them."""
        self.lines += lines
        self._indent += 1
        for name, value in zip(names, values, strict=True):
            self._line(f"{name} = {value};")
        self._indent -= 1

    def _declare(self, kind: Kind, value: str = "") -> str:
        """Write the declaration of a variable, and return its name."""
        self._count += 1
        name = f"v{self._count}"
        self._line(f"{self._types[kind]} {name}{f' = {value}' if value else ''};")
        return name

    def _define(self, kind: Kind, text: str) -> str:
        """Write the definition of a constant, and return its name."""
        self._count += 1
        self._line(f"const {self._types[kind]} v{self._count} = {text};")
        return f"v{self._count}"

    def _line(self, text: str) -> None:
        self.lines.append("    " * self._indent + text)

    def _expm1(self, x: str) -> str:
        """Write Kahan's formula for exp(x) - 1, whose error is a few units in the last place."""
        unit, large = self._number(1.0), self._number(1e30)
        u = self._define("float", f"{self._function('exp')}({x})")
        text = f"{u} == {unit} ? {x} : {u} - {unit} == -{unit} || {u} > {large} ? {u} - {unit}"
        return self._define(
            "float", f"{text} : ({u} - {unit}) * {x} / {self._function('log')}({u})"
        )

    def _log1p(self, x: str) -> str:
        """Write Kahan's formula for log(1 + x)."""
        zero, unit, log = self._number(0.0), self._number(1.0), self._function("log")
        u = self._define("float", f"{unit} + {x}")
        text = f"{u} == {unit} ? {x} : {u} - {u} != {zero} || {u} <= {zero} ? {log}({u})"
        return self._define("float", f"{text} : {log}({u}) * {x} / ({u} - {unit})")

    def _hypot(self, x: str, y: str) -> str:
        """Write the length of a vector, scaled against overflow."""
        fabs, zero = self._function("fabs"), self._number(0.0)
        large = self._define("float", f"{fabs}({x}) > {fabs}({y}) ? {fabs}({x}) : {fabs}({y})")
        divisor = self._define(
            "float",
            f"{large} > {zero} && {large} - {large} == {zero} ? {large} : {self._number(1.0)}",
        )
        a, b = (self._define("float", f"{value} / {divisor}") for value in (x, y))
        return self._define("float", f"{divisor} * {self._function('sqrt')}({a} * {a} + {b} * {b})")

    def _copysign(self, x: str, y: str) -> str:
        """Write x with the sign of y; 1/y tells the sign of a zero."""
        fabs, zero, unit = self._function("fabs"), self._number(0.0), self._number(1.0)
        is_negative = f"{y} < {zero} || ({y} == {zero} && {unit} / {y} < {zero})"
        return self._define("float", f"{is_negative} ? -{fabs}({x}) : {fabs}({x})")


_REPLACEMENTS: dict[str, Callable[..., str]] = {
    "expm1": CCode._expm1,
    "log1p": CCode._log1p,
    "hypot": CCode._hypot,
    "copysign": CCode._copysign,
}


def replacement_functions(real: Real, statements: Sequence[str]) -> list[str]:
    """Return C++ functions for those that Warp lacks on a CPU and that statements call.

    The functions are lambdas, so that other functions may contain them. A compiler would compute
    the formulas for all actuators, also where a branch is not taken, if they were in its place.
    """
    suffix, functions = "f" if real == "float" else "", []
    for name, replacement in _REPLACEMENTS.items():
        if any(re.search(rf"\b{name}{suffix}\(", line) for line in statements):
            backend = CCode(portable=True, real=real)
            _, *arguments = inspect.signature(replacement).parameters
            result = replacement(backend, *arguments)
            declared = ", ".join(f"{real} {argument}" for argument in arguments)
            head = f"[]({declared}) __attribute__((noinline)) -> {real}"
            functions += [
                f"const auto {name}{suffix} = {head} {{",
                *backend.lines,
                f"    return {result};",
                "};",
            ]
    return functions


class CProgram(NamedTuple):
    """A family's `advance` as C: statements, and the expressions of their results.

    The statements read variables `p_NAME` (parameters), `s_NAME` (state), `x_NAME` (inputs) and
    `timestep`, all of them doubles, or floats if the program is one of floats.
    """

    statements: list[str]
    """Lines of C."""
    state: list[str]
    """Expressions of the entries of the new state."""
    torque: str
    """Expression of the torque."""
    signals: list[str]
    """Expressions of the signals."""


def c_program(
    actuator: ActuatorModel | Family,
    portable: bool = False,
    real: Real = "double",
    variables: Collection[str] = (),
    timestep: float | None = None,
) -> CProgram:
    """Return a family's `advance` as statements of C, for a function or a kernel around them.

    Args:
        actuator: an actuator, whose parameters become constants, or a family.
        portable: True to call only functions that Warp has on a CPU; see `CCode`.
        real: type of floats. In 32 bits a noise key is exact below 2**24 only.
        variables: names of parameters that become no constants, as in `parameters_type`.
        timestep: mechanical step [s], which becomes a constant; None leaves it a variable.

    Raises:
        UnsupportedError: the source contains a construct that the reader does not take.
        ValueError: the type is neither double nor float.
    """
    if real not in ("double", "float"):
        raise ValueError(f"real = {real!r}: must be 'double' or 'float'")
    family = _family(actuator)
    backend = CCode(portable, real)
    names = parameters_type(family)._fields
    parameters = _symbols("p", names)
    if isinstance(actuator, ActuatorModel):
        values = zip(names, actuator.parameter_values, strict=True)
        parameters |= {name: value for name, value in values if name not in variables}
    result = read_advance(
        family,
        backend,
        parameters,
        Scalar("float", "timestep") if timestep is None else timestep,
        _symbols("s", family.State._fields),
        _symbols("x", Inputs._fields),
    )
    return CProgram(backend.lines, *result)


def c_function(
    actuator: ActuatorModel | Family, name: str = DEFAULT_NAME, portable: bool = False
) -> str:
    """Return a file of C99 with a function that advances an actuator by a step.

    The function returns the torque at the shaft [N*m] and writes the new state, which may be the
    old one, and the signals. The structs contain doubles only, in the order of the family's `State`
    and `Signals`, of `Inputs` and of `parameters_type`.

    Args:
        actuator: an actuator, whose parameters become constants, or a family, whose parameters
            become an argument.
        name: name of the function, and prefix of the structs' names.
        portable: True to call only functions that Warp has on a CPU; see `CCode`.

    Raises:
        UnsupportedError: the source contains a construct that the reader does not take.
        ValueError: the name cannot be used in C.
    """
    if not (name.isascii() and name.isidentifier()):
        raise ValueError(f"name = {name!r}: expected letters, digits and _, the first no digit")
    family, program = _family(actuator), c_program(actuator, portable)
    parts = {"p": ("parameters", parameters_type(family)._fields)}
    if isinstance(actuator, ActuatorModel):
        parts = {}
    parts |= {"s": ("state", family.State._fields), "x": ("inputs", Inputs._fields)}
    arguments = [f"const struct {name}_{part} *{letter}" for letter, (part, _) in parts.items()]
    arguments.insert(len(arguments) - 2, "double timestep")
    arguments += [f"struct {name}_state *after", f"struct {name}_signals *signals"]
    texts = [*program.statements, *program.state, program.torque, *program.signals]
    used = set(re.findall(r"\w+", " ".join(texts)))
    return "\n".join(
        [
            *_header(actuator, name),
            "#include <math.h>",
            "",
            *(_struct(f"{name}_{part}", fields) for part, fields in parts.values()),
            _struct(f"{name}_signals", family.Signals._fields),
            f"double {name}(",
            ",\n".join(f"    {argument}" for argument in arguments),
            ") {",
            *(
                f"    const double {letter}_{field} = {letter}->{field};"
                for letter, (_, fields) in parts.items()
                for field in fields
                if f"{letter}_{field}" in used
            ),
            *program.statements,
            *_stores("after", family.State._fields, program.state),
            *_stores("signals", family.Signals._fields, program.signals),
            f"    return {program.torque};",
            "}",
            "",
        ]
    )


def _family(actuator: ActuatorModel | Family) -> Family:
    """Return the family of an actuator, or the family itself."""
    return type(actuator) if isinstance(actuator, ActuatorModel) else actuator


def _symbols(letter: str, names: Sequence[str]) -> dict[str, object]:
    return {name: Scalar("float", f"{letter}_{name}") for name in names}


def _header(actuator: ActuatorModel | Family, name: str) -> list[str]:
    """Return a comment on the use of the function."""
    arm = f"{actuator.arm_radius:g}" if isinstance(actuator, ActuatorModel) else "the arm_radius"
    return [
        f"/* Actuator family {family_name(_family(actuator))}, written by codrl_mj.",
        f" * Call {name} once per step [s]. All entries of the state are 0 at the start.",
        " * Inputs and torque are those of the shaft, in SI units:",
        " * angle of the shaft = angle of the joint / arm, torque of the joint = torque / arm,",
        f" * inertia of the shaft = inertia of the joint * arm^2, with arm = {arm}. */",
    ]


def _struct(name: str, fields: Sequence[str]) -> str:
    # C has no empty structs.
    lines = [f"    double {field};" for field in fields or ["unused"]]
    return "\n".join([f"struct {name} {{", *lines, "};", ""])


def _stores(pointer: str, fields: Sequence[str], values: list[str]) -> list[str]:
    """Return assignments to the fields of a struct."""
    return [
        f"    {pointer}->{field} = {value};" for field, value in zip(fields, values, strict=True)
    ]
