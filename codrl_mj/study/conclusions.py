"""What a person concludes: written by hand in a file beside a computed page, which includes it."""

from pathlib import Path


def conclusions_file(page: Path) -> Path:
    """The file of a page's conclusions, which nothing here writes: `mismatch_conclusions.md` of `mismatch.md`."""
    return page.with_name(f"{page.stem}_conclusions.md")


def conclusions_section(page: Path) -> str:
    """The page's section of conclusions: what the file says, or that there is none yet."""
    file = conclusions_file(page)
    if file.is_file():
        text = file.read_text(encoding="utf-8").strip()
    else:
        text = f"None are written yet: they belong into `{file.name}` beside this page, which includes them."
    return f"## Conclusions\n\n{text}\n"
