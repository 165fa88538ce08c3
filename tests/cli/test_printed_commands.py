"""What a verb prints to be typed next is what a shell has to be given, whatever the paths are called."""

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
    """The words of every command line in a text, as a shell takes them."""
    return [shlex.split(line)[1:] for line in re.findall(r"codrl-mj (?!error)[^;\n]*", text)]


@pytest.mark.parametrize("name", NAMES)
def test_a_shell_reads_the_words_of_a_command_as_they_were(name):
    line = command("board", "check", Path(name), f"{name}.csv", trust=True)
    said = subprocess.run(
        ["sh", "-c", line.replace("codrl-mj", "printf '%s\\n'", 1)], capture_output=True, text=True
    )
    assert said.stdout.splitlines() == ["board", "check", name, f"{name}.csv", "--trust"]


def test_after_a_training_and_an_export_the_next_verb_takes_what_is_printed(capsys, trained):
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


def test_a_motor_that_is_written_is_shown_by_what_is_printed(capsys):
    with pytest.raises(ValueError, match="no such file") as told:
        motor_entry("my motor.toml")
    (following,) = printed(str(told.value).removesuffix(" writes one"))
    assert main(following) == 0
    (following,) = printed(capsys.readouterr().out)
    assert following == ["motor", "show", "my motor.toml"]


def test_a_run_is_continued_by_what_is_printed_and_evaluated_with_trust_where_it_needs_it(
    trained, capsys
):
    half = Path(shutil.copytree(trained, "half a run"))
    (half / "result.json").unlink()
    assert main(["evaluate", str(half)]) == 2
    (following,) = printed(capsys.readouterr().err.partition(", or take")[0])
    assert following == ["train", "--resume", "half a run"]
    text = (half / "config.json").read_text()
    (half / "config.json").write_text(text.replace('"task": "cartpole"', '"task": "nobodys:TASK"'))
    assert printed(folder.resume_command(half)) == [["train", "--resume", "half a run", "--trust"]]


def test_commands_with_paths_in_them_are_made_in_one_place():
    """Nothing is put into a text after `codrl-mj` but by what quotes it."""
    quoted = {"shlex.quote", "rig"}  # `rig` is a flag of ours
    for file in Path(codrl_mj.__file__).parent.rglob("*.py"):
        text = file.read_text()
        for node in ast.walk(ast.parse(text)) if "codrl-mj " in text else ():
            if not isinstance(node, ast.JoinedStr) or file.name == "__init__.py":
                continue
            begun = False
            for part in node.values:
                if isinstance(part, ast.Constant):
                    begun = begun or re.search(r"codrl-mj [a-z]", part.value) is not None
                    continue
                call = part.value.func if isinstance(part.value, ast.Call) else part.value
                assert not begun or ast.unparse(call) in quoted, (
                    f"{file}:{node.lineno}: use codrl_mj.fields.command"
                )
