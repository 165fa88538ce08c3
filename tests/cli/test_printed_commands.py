"""Commands that verbs print work in a shell when they are pasted, for any path."""

import ast
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

import codrl_mj
from codrl_mj.catalogue import motor_entry
from codrl_mj.cli import main
from codrl_mj.fields import command
from codrl_mj.training import folder

NAMES = ["my run", 'it\'s "new" $HOME', "plain"]


def printed(text):
    """Return the words of every command line in a text, split as by a shell."""
    return [shlex.split(line)[1:] for line in re.findall(r"codrl-mj (?!error)[^;\n]*", text)]


@pytest.mark.parametrize("name", NAMES)
def test_a_shell_splits_a_command_into_its_words(name):
    line = command("board", "check", Path(name), f"{name}.csv", trust=True)
    result = subprocess.run(
        ["sh", "-c", line.replace("codrl-mj", "printf '%s\\n'", 1)], capture_output=True, text=True
    )
    assert result.stdout.splitlines() == ["board", "check", name, f"{name}.csv", "--trust"]


def test_commands_printed_after_training_and_export_work(capsys, trained):
    run = shutil.copytree(trained, NAMES[1])
    assert main(["train", "--resume", str(run)]) == 0
    (following,) = printed(capsys.readouterr().out.partition("next: ")[2])
    assert following == ["evaluate", str(run)]
    assert main([*following, "--episodes", "2"]) == 0
    assert main(["export", str(run), "--out", "c of it", "--episodes", "1"]) == 0
    (following,) = printed(capsys.readouterr().out.partition("try: ")[2])
    assert following[:3] == ["board", "test", "c of it"]
    main([*following, "--episodes", "1", "--log", "the log.csv"])
    (following,) = printed(capsys.readouterr().out.partition("try: ")[2])
    assert following == ["board", "check", "c of it", "the log.csv"]
    assert main(following) == 0


def test_the_command_printed_for_a_new_motor_works(capsys):
    with pytest.raises(ValueError, match="no such file") as error:
        motor_entry("my motor.toml")
    (following,) = printed(str(error.value).removesuffix(" writes one"))
    assert main(following) == 0
    (following,) = printed(capsys.readouterr().out)
    assert following == ["motor", "show", "my motor.toml"]


def test_the_command_that_continues_a_run_works_and_has_trust_if_needed(trained, capsys):
    half = Path(shutil.copytree(trained, "half a run"))
    (half / "result.json").unlink()
    assert main(["evaluate", str(half)]) == 2
    (following,) = printed(capsys.readouterr().err.partition(", or ")[0])
    assert following == ["train", "--resume", "half a run"]
    text = (half / "config.json").read_text()
    (half / "config.json").write_text(text.replace('"task": "cartpole"', '"task": "nobodys:TASK"'))
    assert printed(folder.resume_command(half)) == [["train", "--resume", "half a run", "--trust"]]


def test_all_commands_with_paths_are_built_by_one_function():
    """Check that only quoting functions insert text after `codrl-mj`."""
    # `rig` is a flag, not a path.
    quoted = {"shlex.quote", "rig"}
    for file in Path(codrl_mj.__file__).parent.rglob("*.py"):
        text = file.read_text()
        for node in ast.walk(ast.parse(text)) if "codrl-mj " in text else ():
            if not isinstance(node, ast.JoinedStr) or file.name == "__init__.py":
                continue
            in_command = False
            for part in node.values:
                if isinstance(part, ast.Constant):
                    in_command = in_command or re.search(r"codrl-mj [a-z]", part.value) is not None
                    continue
                call = part.value.func if isinstance(part.value, ast.Call) else part.value
                assert not in_command or ast.unparse(call) in quoted, (
                    f"{file}:{node.lineno}: use codrl_mj.fields.command"
                )
