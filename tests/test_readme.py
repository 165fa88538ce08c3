"""What the README tells a reader to type works as it stands."""

import contextlib
import re
import shlex
from pathlib import Path

import pytest

from codrl_mj import cli

README = (Path(__file__).parent.parent / "README.md").read_text()


def test_the_python_examples_run(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(blocks) >= 3
    namespace = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), namespace)  # one after the other, as a reader would
    desired, actual, current, voltage, saturated = capsys.readouterr().out.split()
    assert float(desired) == 10.0
    assert 0 < float(actual) < float(desired)  # the weak loop's first step
    assert float(current) > 0
    assert float(voltage) > 0
    assert saturated == "False"
    for name in ("envs", "vec_env", "env"):
        namespace[name].close()


@pytest.mark.parametrize("command", re.findall(r"^\$ codrl-mj (.*)$", README, re.MULTILINE))
def test_the_commands_are_understood(command, monkeypatch):
    parsed = []
    for verb in cli.VERBS.values():
        monkeypatch.setattr(verb, "run", lambda self: parsed.append(self) or 0)
    with contextlib.suppress(SystemExit):
        assert cli.main(shlex.split(command)) == 0
    assert len(parsed) == 1


def test_every_file_that_it_links_exists():
    links = re.findall(r"\]\(([^)#]+)\)", README)
    assert links
    for link in links:
        assert (Path(__file__).parent.parent / link).exists(), link
