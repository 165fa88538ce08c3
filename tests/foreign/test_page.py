"""What docs/foreign.md tells a reader to type works as it stands."""

import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "foreign.md").read_text()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_examples_run(capsys):
    blocks = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    namespace = {}
    for block in blocks:
        exec(compile(block, "foreign.md", "exec"), namespace)  # one after the other, as a reader would
    assert len(blocks) == 3
    assert len(capsys.readouterr().out.split("\n")) > 3
