"""The certificate as files: JSON, and one self-contained HTML page with plots."""

import json
import math
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from codrl_mj.runs.files import writing
from codrl_mj.validation.certificate import GROUPS, Certificate, versions
from codrl_mj.validation.mutations import Caught, margin, unfailed
from codrl_mj.validation.outcome import Check

JSON_NAME, HTML_NAME = "certificate.json", "certificate.html"


def check_writable(folder: Path) -> None:
    """Find out before hours of work whether `folder` can hold the certificate; makes nothing.

    Raises:
        OSError: it is a file, or lies below one, or below a folder that may not be written to.
    """
    present = folder.absolute()
    while not present.exists():
        present = present.parent
    if not present.is_dir():
        raise NotADirectoryError(f"cannot write to {folder}: {present} is not a folder")
    if not os.access(present, os.W_OK | os.X_OK):
        raise PermissionError(f"cannot write to {folder}: no permission to write in {present}")


def margin_text(check: Check) -> str:
    """Tolerance over worst case, as text."""
    if check.worst == 0.0:
        return "exact"
    if not math.isfinite(check.worst) or check.tolerance == 0.0:
        return "0"
    ratio = check.tolerance / check.worst
    return f"{ratio:.2g}" if ratio >= 1.005 or ratio < 1.0 else f"{ratio:.4g}"


def _groups(certificate: Certificate) -> list[dict[str, Any]]:
    """The checks by group and task, in order."""
    found = []
    for name, title in GROUPS.items():
        checks = [check for check in certificate.checks if check.group == name]
        tasks = [
            {
                "name": task,
                "checks": [check for check in checks if check.task == task],
                "plots": [plot for check in checks if check.task == task for plot in check.plots],
            }
            for task in dict.fromkeys(check.task for check in checks)
        ]
        if checks:
            failed = sum(not check.passed for check in checks)
            found.append({"name": name, "title": title, "checks": len(checks), "failed": failed, "tasks": tasks})
    return found


def html(certificate: Certificate, caught: Sequence[Caught] = ()) -> str:
    """The page: one file that needs nothing else.

    Args:
        certificate: what was found.
        caught: what mutations did, if they were tried.

    Raises:
        ModuleNotFoundError: jinja2 is not installed.
    """
    import jinja2

    from codrl_mj.validation.svg_plot import legend, svg

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    source = Path(__file__).with_name("certificate.html.jinja").read_text(encoding="utf-8")
    return environment.from_string(source).render(
        certificate=certificate,
        verdict="passed" if certificate.passed else "FAILED",
        passed=sum(check.passed for check in certificate.checks),
        made=time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        versions=versions(),
        groups=_groups(certificate),
        caught=caught,
        unfailed=unfailed(certificate.checks, caught),
        margin=margin_text,
        beyond=margin,
        svg=svg,
        legend=legend,
    )


def caught_mapping(caught: Sequence[Caught]) -> list[dict[str, Any]]:
    """What mutations did, for JSON."""
    rows = []
    for outcome in caught:
        clearest = outcome.clearest
        row: dict[str, Any] = {"mutation": outcome.mutation, "task": outcome.task, "made": outcome.made}
        row["failed"] = [f"{check.group}: {check.name}" for check in outcome.failed]
        if clearest is not None:
            worst = clearest.worst if math.isfinite(clearest.worst) else str(clearest.worst)
            row |= {"clearest": f"{clearest.group}: {clearest.name}", "worst": worst, "allowed": clearest.tolerance}
        rows.append(row)
    return rows


def write(certificate: Certificate, folder: Path, caught: Sequence[Caught] = ()) -> tuple[Path, Path]:
    """Write `certificate.json` and `certificate.html` into a folder, whole or not at all; older ones are replaced.

    Returns:
        The two files.

    Raises:
        OSError: the folder cannot be written to.
        ModuleNotFoundError: jinja2 is not installed.
    """
    content = certificate.as_mapping()
    if caught:
        content |= {
            "mutations": caught_mapping(caught),
            "failed by no mutation": [
                f"{check.group}: {check.task}: {check.name}" for check in unfailed(certificate.checks, caught)
            ],
        }
    text, page = json.dumps(content, indent=2, allow_nan=False) + "\n", html(certificate, caught)
    check_writable(folder)
    with writing(folder / JSON_NAME) as json_file, writing(folder / HTML_NAME) as html_file:
        json_file.write_text(text, encoding="utf-8")
        html_file.write_text(page, encoding="utf-8")
    return folder / JSON_NAME, folder / HTML_NAME
