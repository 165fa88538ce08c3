"""What the README tells a reader to type works as it stands."""

import csv
import re
from pathlib import Path

README = (Path(__file__).parent.parent / "README.md").read_text()


def test_the_python_example_runs(capsys):
    (block,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    namespace = {}
    exec(compile(block, "README.md", "exec"), namespace)
    desired, actual, current, voltage, saturated = capsys.readouterr().out.split()
    assert float(desired) == 10.0
    assert 0 < float(actual) < float(desired)  # the weak loop's first step
    assert float(current) > 0
    assert float(voltage) > 0
    assert saturated == "False"
    namespace["env"].close()


def test_of_the_papers_statements_as_many_are_confirmed_as_the_results_say():
    results = Path(__file__).parent.parent / "docs" / "results"
    with (results / "reproduction" / "claims.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["source"] == "paper" and row["counted"] == "yes"]
    confirmed, compatible = (sum(row["verdict"] == one for row in rows) for one in ("confirmed", "compatible"))
    said = (
        f"{len(rows)} statements {confirmed} are confirmed, and {compatible}, read off one run, compatible with ours."
    )
    assert said in README.replace("\n", " ")
    counted = f"**Of {len(rows)} statements: {confirmed} confirmed, {compatible} compatible, "
    assert counted in (results / "reproduction.md").read_text()
