"""Counts of what makes a reader stumble: unusual docstrings and words, empty names, few comments.

Python files are read token by token, and Markdown files for the words alone. The counts know no
meaning: a hit is a place to look at, and a new name that only avoids the list is worth nothing.
`scripts/house.py` compares the counts with the limits in pyproject.toml.
"""

import ast
import io
import itertools
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

DIALECT = re.compile(
    r"\b(anew|somebody|anybody|nobody|whoever|thereof|foretold|foretell|begun|whereof|unheard"
    r"|told by|are told|is told|theirs|the very|of one's own|one's own|told apart|which none"
    r"|no less of|no more of)\b",
    re.IGNORECASE,
)
"""Words and phrases that engineers do not use in documentation."""
RIDDLE = re.compile(
    r"(What|Whether|Where|Whose|Whoever|Who|Which|Of|By|That|Those|They|It|How|If|And)\b(?!-)"
)
"""First words of a docstring that is neither an imperative nor a noun phrase."""
EMPTY_NAME = re.compile(
    r"(found|made|kept|told|given|one|other|there|here|place|at|fine|what|whose|how|said|says|alone"
    r"|own|done|asked|wanted|seen|put_into|begun|foretold|namer|letters|longer|unheard|likewise"
    r"|anybodys|most|least|where|taken|several)"
)
"""Names of variables, parameters, functions and classes that do not say what they stand for."""


class Words(NamedTuple):
    """Counts of one folder, and the places that were counted."""

    counts: dict[str, float]
    places: dict[str, list[str]]


def count_words(folder: Path) -> Words:
    """Count the lines of a folder's Python and Markdown files that a reader may stumble over.

    Args:
        folder: a folder, which is searched with all folders in it.

    Returns:
        `riddles` (docstrings), `names`, `dialect` (comments and strings of Python files),
        `dialect_md` (Markdown) and `comments_per_k`, the lines with nothing but a comment in 1,000.
    """
    places: dict[str, list[str]] = defaultdict(list)
    num_lines = num_comments = 0
    for path in sorted(folder.rglob("*.md")):
        for number, line in enumerate(path.read_text().splitlines(), 1):
            places["dialect_md"] += [f"{path}:{number}: {word}" for word in DIALECT.findall(line)]
    # This file holds all the words, as patterns.
    for path in sorted({*folder.rglob("*.py")} - {Path(__file__)}):
        text = path.read_text()
        tree = ast.parse(text)
        num_lines += text.count("\n")
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT and token.line.lstrip().startswith("#"):
                num_comments += 1
            if token.type in (tokenize.COMMENT, tokenize.STRING):
                # What stands in braces is code: the variable of a formatted string.
                words = DIALECT.findall(re.sub(r"\{[^}]*\}", "", token.string))
                places["dialect"] += [f"{path}:{token.start[0]}: {word}" for word in words]
        for line_number, docstring in docstrings(tree):
            if RIDDLE.match(docstring.strip()):
                first_line = docstring.strip().splitlines()[0]
                places["riddles"].append(f"{path}:{line_number}: {first_line}")
        for line_number, name in new_names(tree):
            if EMPTY_NAME.fullmatch(name):
                places["names"].append(f"{path}:{line_number}: {name}")
    counts: dict[str, float] = defaultdict(float)
    counts |= {kind: len(hits) for kind, hits in places.items()}
    counts["comments_per_k"] = round(1000 * num_comments / max(num_lines, 1), 1)
    return Words(counts, places)


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and text of all docstrings, also of those below a field or a constant."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield getattr(node, "lineno", 1), ast.get_docstring(node) or ""
        body = getattr(node, "body", None)
        for statement, text in itertools.pairwise(body) if isinstance(body, list) else ():
            if (
                isinstance(statement, ast.Assign | ast.AnnAssign)
                and isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
                and isinstance(text.value.value, str)
            ):
                yield text.lineno, text.value.value


def new_names(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and name of all variables, parameters, functions and classes that are defined."""
    for node in ast.walk(tree):
        if isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.lineno, node.name.strip("_")
