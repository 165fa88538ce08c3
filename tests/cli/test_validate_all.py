"""`codrl-mj validate` alone validates every task, as its help and docs/validation.md say."""

from codrl_mj import validation
from codrl_mj.cli import main


def test_validates_everything_if_no_task_is_named(monkeypatch):
    asked = []

    def stopped(tasks, **_):
        asked.append(tasks)
        raise ValueError("far enough")

    monkeypatch.setattr(validation, "validate", stopped)
    assert main(["validate", "--quick"]) == 2
    assert main(["validate", "cartpole", "--quick"]) == 2
    assert asked == [None, ("cartpole",)]
