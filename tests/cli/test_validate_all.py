"""`codrl-mj validate` without tasks validates all of them.

Its help and docs/validation.md say so.
"""

from codrl_mj import validation
from codrl_mj.cli import main


def test_validates_every_task_if_none_is_named(monkeypatch):
    tasks_seen = []

    def raise_early(tasks, **_):
        tasks_seen.append(tasks)
        raise ValueError("far enough")

    monkeypatch.setattr(validation, "validate", raise_early)
    assert main(["validate", "--quick"]) == 2
    assert main(["validate", "cartpole", "--quick"]) == 2
    assert tasks_seen == [None, ("cartpole",)]
