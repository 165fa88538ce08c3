"""Compare counts of the package's complexity with the limits in `[tool.house]` of pyproject.toml.

    python scripts/house.py [FOLDER]

Exits with 1 if a count is above its limit. A commit that needs more raises the limit and says why.
A count that falls because names were shortened or files joined means nothing.
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
"""Class names that each family of actuators, or each task, uses for itself."""
SCREEN, FILE = 75, 570
"""Maximum number of lines of a function and of a file, with lines of up to 100 characters."""
KINDS = r"\w*Config|\w*EnvSource|Task|MotorsAddedEnv|ActuatedEnv"
"""Pattern of the classes of environments and configurations whose type checks count as forks."""
BLOCK = re.compile(r"(Args|Returns|Raises):")


class Module(NamedTuple):
    """File of the package."""

    name: str
    path: Path
    text: str
    tree: ast.Module


def modules(root: Path) -> list[Module]:
    """Parse all files of a package, except the assets that a wheel contains beside them."""
    parsed = []
    for path in sorted(root.rglob("*.py")):
        name = ".".join((root.name, *path.relative_to(root).with_suffix("").parts)).removesuffix(
            ".__init__"
        )
        if "_assets" not in path.parts:
            parsed.append(Module(name, path, path.read_text(), ast.parse(path.read_text())))
    return parsed


def imports(module: Module, known: set[str]) -> set[str]:
    """Return the package's modules that a module imports anywhere, absolutely or relatively."""
    imported: set[str] = set()
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            package = (
                module.name if module.path.stem == "__init__" else module.name.rpartition(".")[0]
            )
            above = package.split(".")[: package.count(".") + 2 - node.level] if node.level else []
            base = ".".join([*above, *filter(None, [node.module])])
            imported |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    return (imported & known) - {module.name}


def named_modules(module: Module, known: set[str]) -> set[str]:
    """Return the package's modules that a module names in strings, as for `import_module`.

    Gymnasium's entry points, `module:NAME`, count too. The package's own name is just a name.
    """
    texts = {
        node.value.partition(":")[0]
        for node in ast.walk(module.tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    return {name for name in texts & known if "." in name} - {module.name}


def local_imports(module: Module, root: str) -> list[int]:
    """Return the lines of imports of the package inside functions and other blocks."""
    return [
        node.lineno
        for node in ast.walk(module.tree)
        if isinstance(node, ast.ImportFrom)
        and node.col_offset > 0
        and (node.module or "").startswith(root)
    ]


def import_cycles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Return the cycles of a graph, one after the other; each is cut where it was found."""
    cycles, remaining = [], {name: set(needs) for name, needs in graph.items()}
    while True:
        try:
            graphlib.TopologicalSorter(remaining).prepare()
        except graphlib.CycleError as error:
            cycle = error.args[1]
            cycles.append(cycle)
            remaining[cycle[1]].discard(cycle[0])
        else:
            return cycles


def lines_of_code(module: Module) -> int:
    """Count the lines that are neither empty nor comment nor docstring."""
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
    """Return the public names of the package and its subpackages: `__all__`, or the lazy names."""
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
    """Compute all counts of a package, and for some of them the names that were counted."""
    package = modules(root)
    names, public = {module.name for module in package}, public_names(package)
    everything = "\n".join(module.text for module in package)
    mentions = collections.Counter(re.findall(r"\b\w+\b", everything))
    counted: dict[str, list[str]] = collections.defaultdict(list)
    classes: dict[str, int] = collections.Counter()
    functions = num_doc_lines = 0
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
            qualified_name = f"{module.name}.{node.name}"
            is_internal = not {node.name, owner.get(id(node))} & public
            # Only what users call needs Args and Returns; elsewhere such blocks are counted as
            # overhead.
            if is_internal:
                text = (ast.get_docstring(node) or "").splitlines()
                num_doc_lines += len(
                    list(itertools.dropwhile(lambda line: not BLOCK.match(line), text))
                )
            if (node.end_lineno or 0) - node.lineno > SCREEN:
                counted["long_functions"].append(qualified_name)
            if len(node.args.posonlyargs) + len(node.args.args) + len(node.args.kwonlyargs) > 8:
                counted["wide_functions"].append(qualified_name)
            if is_internal and not node.decorator_list and not node.name.startswith("__"):
                if mentions[node.name] == 1:
                    counted["named_once"].append(qualified_name)
                elif mentions[node.name] == 2 and id(node) in top:
                    counted["used_in_one_place"].append(qualified_name)
    graph = {module.name: imports(module, names) for module in package}
    users = collections.Counter(itertools.chain.from_iterable(graph.values()))
    above = {name: name.rpartition(".")[0] for name in names}
    sizes = {module.name: module.text.count("\n") for module in package}
    plain = [module.name for module in package if module.path.stem != "__init__"]
    counted["imported_by_one"] = [
        n for n in plain if users[n] - (n in graph.get(above[n], ())) <= 1
    ]
    counted["homonyms"] = [n for n, count in classes.items() if count > 1 and n not in RECURRING]
    counted["forks"] = re.findall(
        rf"(?:isinstance|issubclass)\([^()]*,\s*(?:{KINDS})\b|is_gymnasium_id\(|is_foreign\w*\(",
        everything,
    )
    # A package that exports names of its modules does not form a cycle with them. Other modules
    # that are named in strings count as imported. The root package names everything.
    hidden = {module.name: named_modules(module, names) for module in package}
    counted["hidden"] = [
        f"{module.name}: {', '.join(sorted(hidden[module.name]))}"
        for module in package
        if hidden[module.name] and module.path.stem != "__init__"
    ]
    counted["local_imports"] = [
        f"{module.name}:{line}" for module in package for line in local_imports(module, root.name)
    ]
    needs = {
        name: {m for m in graph[name] | hidden[name] if above[name] != m and above[m] != name}
        for name in graph
        if name != root.name
    }
    counted["circles"] = [" -> ".join(circle) for circle in import_cycles(needs)]
    counted["long_files"] = [n for n in sizes if sizes[n] > FILE]
    counted["short_modules"] = [n for n in plain if sizes[n] < 60]
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
        "inner_doc_lines": num_doc_lines,
        "raises": sum(
            isinstance(node, ast.Raise) for module in package for node in ast.walk(module.tree)
        ),
        "any": mentions["Any"],
    }
    return numbers | {name: len(names) for name, names in counted.items()}, counted


def check_counts(root: Path, limits: dict[str, Any]) -> bool:
    """Print each count with its limit, and what exceeds it; return True if any is exceeded."""
    values, counted = counts(root)
    if limits.keys() != values.keys():
        raise ValueError(
            "[tool.house] and the counts differ in"
            f" {', '.join(sorted(limits.keys() ^ values.keys()))}"
        )
    exceeded = [name for name, value in values.items() if value > limits[name]]
    for name, value in values.items():
        print(f"{name:18}{value:8,}  at most {limits[name]:,}" + "  TOO MANY" * (name in exceeded))
    for name in exceeded:
        print(
            f"{name}: {', '.join(counted.get(name, []))}"
            if counted.get(name)
            else f"{name} is above its limit"
        )
    return bool(exceeded)


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
