"""Counts what a reader of the package has to hold in mind, against the limits in `[tool.house]` of pyproject.toml.

    python scripts/house.py [FOLDER]

Exits with 1 where a count is above its limit. A change that needs more raises the limit in the same
commit and says why; a count that falls because names were shortened or files glued together says
nothing.
"""

import ast
import collections
import graphlib
import io
import itertools
import re
import sys
import tokenize
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from plain_words import count_words

ROOT = Path(__file__).parents[1]
RECURRING = {"State", "Signals", "Options", "ReferenceEnv"}
"""Names of classes that each family of actuators, or each task, has for itself."""
SCREEN, FILE = 75, 570
"""Lines of 100 characters that a function, and a file, may have."""
KINDS = r"\w*Config|\w*EnvSource|Task|MotorsAddedEnv|ActuatedEnv"
"""Kinds of environments and configurations: what asks which of them something is, is a fork."""
BLOCK = re.compile(r"(Args|Returns|Raises):")


class Module(NamedTuple):
    """One file of the package."""

    name: str
    path: Path
    text: str
    tree: ast.Module


def modules(root: Path) -> list[Module]:
    """All of a package, but for the models that a wheel has beside them."""
    found = []
    for path in sorted(root.rglob("*.py")):
        name = ".".join((root.name, *path.relative_to(root).with_suffix("").parts)).removesuffix(
            ".__init__"
        )
        if "_assets" not in path.parts:
            found.append(Module(name, path, path.read_text(), ast.parse(path.read_text())))
    return found


def imports(module: Module, known: set[str]) -> set[str]:
    """Modules of the package that one imports, wherever in it, by what names they are imported."""
    named: set[str] = set()
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Import):
            named |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            package = (
                module.name if module.path.stem == "__init__" else module.name.rpartition(".")[0]
            )
            above = package.split(".")[: package.count(".") + 2 - node.level] if node.level else []
            base = ".".join([*above, *filter(None, [node.module])])
            named |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    return (named & known) - {module.name}


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Circles of what needs what, one after the other: each is cut where it was found."""
    found, left = [], {name: set(needs) for name, needs in graph.items()}
    while True:
        try:
            graphlib.TopologicalSorter(left).prepare()
        except graphlib.CycleError as error:
            circle = error.args[1]
            found.append(circle)
            left[circle[1]].discard(circle[0])
        else:
            return found


def lines_of_code(module: Module) -> int:
    """Lines that are neither empty nor comment nor docstring."""
    silent = {
        tokenize.COMMENT,
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENDMARKER,
    }
    rows: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(module.text).readline):
        if token.type not in silent:
            rows.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(module.tree):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            rows.difference_update(range(node.lineno, (node.end_lineno or 0) + 1))
    return len(rows)


def public_names(package: list[Module]) -> set[str]:
    """What the package and its rooms offer: in `__all__` of their `__init__`, or in the package's lazy names."""
    assigned = [
        node.value
        for module in package
        if module.path.stem == "__init__"
        for node in ast.walk(module.tree)
        if isinstance(node, ast.Assign)
        and any(getattr(target, "id", "") in ("__all__", "_PUBLIC") for target in node.targets)
    ]
    constants = (
        node for value in assigned for node in ast.walk(value) if isinstance(node, ast.Constant)
    )
    return {node.value for node in constants if isinstance(node.value, str)}


def counts(root: Path) -> tuple[dict[str, int], dict[str, list[str]]]:
    """All counts of a package; and of some of them what was counted."""
    package = modules(root)
    names, offered = {module.name for module in package}, public_names(package)
    everything = "\n".join(module.text for module in package)
    mentions = collections.Counter(re.findall(r"\b\w+\b", everything))
    told: dict[str, list[str]] = collections.defaultdict(list)
    classes: dict[str, int] = collections.Counter()
    functions = documented = 0
    for module in package:
        owner: dict[int, str] = {}
        top = set(map(id, module.tree.body))
        for node in ast.walk(module.tree):
            if isinstance(node, ast.ClassDef):
                classes[node.name] += 1
                owner |= {id(child): node.name for child in node.body}
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            functions += 1
            where, inner = (
                f"{module.name}.{node.name}",
                not {node.name, owner.get(id(node))} & offered,
            )
            if inner:
                text = (ast.get_docstring(node) or "").splitlines()
                documented += len(
                    list(itertools.dropwhile(lambda line: not BLOCK.match(line), text))
                )
            if (node.end_lineno or 0) - node.lineno > SCREEN:
                told["long_functions"].append(where)
            if len(node.args.posonlyargs) + len(node.args.args) + len(node.args.kwonlyargs) > 8:
                told["wide_functions"].append(where)
            if inner and not node.decorator_list and not node.name.startswith("__"):
                if mentions[node.name] == 1:
                    told["named_once"].append(where)
                elif mentions[node.name] == 2 and id(node) in top:
                    told["used_in_one_place"].append(where)
    graph = {module.name: imports(module, names) for module in package}
    users = collections.Counter(itertools.chain.from_iterable(graph.values()))
    above = {name: name.rpartition(".")[0] for name in names}
    sizes = {module.name: module.text.count("\n") for module in package}
    plain = [module.name for module in package if module.path.stem != "__init__"]
    told["imported_by_one"] = [n for n in plain if users[n] - (n in graph.get(above[n], ())) <= 1]
    told["homonyms"] = [n for n, count in classes.items() if count > 1 and n not in RECURRING]
    told["forks"] = re.findall(
        rf"(?:isinstance|issubclass)\([^()]*,\s*(?:{KINDS})\b|is_gymnasium_id\(|is_foreign\w*\(",
        everything,
    )
    # a package's __init__ that offers its modules' names is no circle by itself
    needs = {n: {m for m in found if above[n] != m and above[m] != n} for n, found in graph.items()}
    told["circles"] = [" -> ".join(circle) for circle in circles(needs)]
    told["long_files"] = [n for n in sizes if sizes[n] > FILE]
    told["short_modules"] = [n for n in plain if sizes[n] < 60]
    data = [
        path
        for path in root.rglob("*")
        if path.suffix in (".js", ".css", ".html", ".j2", ".toml", ".yaml")
    ]
    numbers = {
        "lines": sum(sizes.values()),
        "code": sum(map(lines_of_code, package)),
        "web_and_data": sum(path.read_text().count("\n") for path in data),
        "modules": len(package),
        "classes": sum(classes.values()),
        "functions": functions,
        "inner_doc_lines": documented,
        "raises": sum(
            isinstance(node, ast.Raise) for module in package for node in ast.walk(module.tree)
        ),
        "any": mentions["Any"],
    }
    return numbers | {name: len(found) for name, found in told.items()}, told


def check_counts(root: Path, limits: dict[str, Any]) -> bool:
    """Print each count of the package with its limit, and what is above one; return True if any is."""
    found, told = counts(root)
    if limits.keys() != found.keys():
        raise ValueError(
            "[tool.house] and the counts differ in"
            f" {', '.join(sorted(limits.keys() ^ found.keys()))}"
        )
    over = [name for name, value in found.items() if value > limits[name]]
    for name, value in found.items():
        print(f"{name:18}{value:8,}  at most {limits[name]:,}" + "  TOO MANY" * (name in over))
    for name in over:
        print(
            f"{name}: {', '.join(told.get(name, []))}"
            if told.get(name)
            else f"{name} is above its limit"
        )
    return bool(over)


def check_words(folder: Path, limits: dict[str, float]) -> bool:
    """Print a folder's counts of words with their limits; return True if one is beyond its limit.

    A limit whose name ends with `_per_k` is a lower one: a folder may have too few comments.
    """
    words, is_beyond = count_words(folder), False
    for name, limit in limits.items():
        value, is_lower = words.counts[name], name.endswith("_per_k")
        is_wrong = value < limit if is_lower else value > limit
        bound = f"at least {limit:,}" if is_lower else f"at most {limit:,}"
        print(f"{folder.name} {name}".ljust(28) + f"{value:8,}  {bound}" + "  WRONG" * is_wrong)
        if is_wrong:
            print("\n".join(f"  {place}" for place in words.places.get(name, [])))
        is_beyond |= is_wrong
    return is_beyond


def main(arguments: list[str]) -> int:
    """Compare all counts with their limits; return 1 if one is beyond its limit."""
    root = Path(arguments[0]) if arguments else ROOT / "codrl_mj"
    limits: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["house"]
    limits_of_words = limits.pop("words")
    results = [check_counts(root.resolve(), limits)]
    results += [check_words(ROOT / folder, bounds) for folder, bounds in limits_of_words.items()]
    return int(any(results))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
