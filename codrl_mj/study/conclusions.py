"""What a person concludes: written by hand in a file beside a computed page, which includes it."""

from pathlib import Path


def conclusions_section(page: Path) -> str:
    """A page's section of conclusions: what its file says, or that there is none yet.

    Args:
        page: the page; the file of `actuators.md` is `actuators_conclusions.md` beside it, which nothing here writes.
    """
    file = page.with_name(f"{page.stem}_conclusions.md")
    if file.is_file():
        text = file.read_text(encoding="utf-8").strip()
    else:
        text = f"None are written yet: they belong into `{file.name}` beside this page, which includes them."
    return f"## Conclusions\n\n{text}\n"
