"""The certificate as files: JSON, and a page with plots."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from codrl_mj.runs.files import check_writable, atomic_write
from codrl_mj.validation.certificate import GROUPS, Certificate, verdict, versions
from codrl_mj.validation.mutations import Caught, as_mapping, unfailed
from codrl_mj.viz.pages import page

JSON_NAME, HTML_NAME = "certificate.json", "certificate.html"
_CHECKS = ("check", "oracle", "samples", "worst", "allowed", "margin", "unit", "where", "verdict")


def html(certificate: Certificate, caught: Sequence[Caught] = ()) -> str:
    """The page of what was found, and of what mutations did, if they were tried."""
    top = [page.judged(certificate.passed, certificate.verdict, "p", "verdict")]
    if certificate.quick:
        top.append(
            page.note("The quick form: fewer states, runs and step sizes than in the full one.")
        )
    top.append(
        page.paragraph(
            "Each check has an oracle, a tolerance, and the worst case that was found. The margin"
            " is tolerance over worst case: a check passes while it is at least 1."
        )
    )
    software = page.definitions(versions().items())
    top.append(page.folded(f"Made in {certificate.seconds:.0f} s, with this software", software))
    sections = [_group(name, title, certificate) for name, title in GROUPS.items()]
    skipped = [(skip.name, skip.group, skip.reason) for skip in certificate.skipped]
    left = (
        page.table("What was not checked", ("what", "group", "why"), skipped, cards=True)
        if skipped
        else Markup()
    )
    sections += [_mutations(certificate, caught)] if caught else []
    sections.append(page.Section("skipped", "Not checked", left))
    return page.page(
        f"Is the port right? {certificate.subject}",
        "Certificate of validation",
        page.joined(top),
        sections,
    )


def _group(name: str, title: str, certificate: Certificate) -> page.Section:
    checks = [check for check in certificate.checks if check.group == name]
    body = [page.paragraph(f"{title}.")] if checks else []
    for task in dict.fromkeys(check.task for check in checks):
        own = [check for check in checks if check.task == task]
        body.append(page.heading(task) if task else Markup())
        caption = f"Checks of {name}{f', {task}' if task else ''}"
        failed = (place for place, check in enumerate(own) if not check.passed)
        rows = [
            (
                *(
                    check.name,
                    check.oracle,
                    f"{check.samples:,}",
                    f"{check.worst:.2g}",
                    f"{check.tolerance:.2g}",
                ),
                *(
                    check.margin,
                    check.unit,
                    f"{check.where}. {check.fault}" if check.fault else check.where,
                ),
                page.judged(check.passed, "passed" if check.passed else "FAILED"),
            )
            for check in own
        ]
        body.append(page.table(caption, _CHECKS, rows, range(2, 6), True, failed))
        body.append(page.plots(plot for check in own for plot in check.plots))
    good = sum(check.passed for check in checks)
    mark = Markup("({})").format(
        page.judged(good == len(checks), f"{good} of {len(checks)}", "span")
    )
    return page.Section(name, name.capitalize(), page.joined(body), mark)


def _mutations(certificate: Certificate, caught: Sequence[Caught]) -> page.Section:
    rows = []
    for one in caught:
        clearest, cells = (
            one.clearest,
            [one.mutation, one.task or "the motor", f"{len(one.failed)} of {one.made}"],
        )
        found = ["none", "", "", ""]
        if clearest is not None:
            values = (clearest.worst, clearest.tolerance, clearest.beyond)
            found = [f"{clearest.group}: {clearest.name}", *(f"{value:.2g}" for value in values)]
        said = page.judged(clearest is not None, "MISSED" if clearest is None else "caught")
        rows.append((*cells, *found, said))
    columns = "fault", "in", "failed", "clearest check", "worst", "allowed", "beyond", "verdict"
    blind = unfailed(certificate.checks, caught)
    told = "; ".join(f"{check.group}, {check.task}: {check.name}" for check in blind)
    body = (
        page.paragraph(
            "The certificate put to the test: each fault was made on purpose, and the quick checks"
            " were run with it. “Beyond” is how many times its tolerance the clearest of the failed"
            " checks was."
        ),
        page.table(
            "Faults made on purpose",
            columns,
            rows,
            numbers=(2, 4, 5, 6),
            cards=True,
            failed=(place for place, one in enumerate(caught) if not one.failed),
        ),
        (
            page.note(f"✗ No fault fails these checks: {told}", bad=True)
            if blind
            else page.paragraph(
                "Every check of the certificate is failed by at least one of the faults."
            )
        ),
    )
    return page.Section("mutations", "Mutations", page.joined(body))


def summary(content: Mapping[str, Any]) -> Markup:
    """What a `certificate.json` says, in short."""
    checks = content["checks"]
    rows = []
    for name in dict.fromkeys(check["group"] for check in checks):
        own = [check for check in checks if check["group"] == name]
        good = sum(check["passed"] for check in own)
        rows.append((name, GROUPS.get(name, ""), f"{good} of {len(own)}"))
    passed = content["verdict"] == "passed"
    whole = verdict([check["passed"] for check in checks])
    return page.joined(
        (
            page.judged(passed, whole, "p", "verdict"),
            page.paragraph(
                f"Of {content['subject']}, made"
                f" {content['made']}{', the quick form' * content['quick']}."
            ),
            page.table("Checks passed", ("group", "what", "passed"), rows, numbers=(2,)),
        )
    )


def write(
    certificate: Certificate, folder: Path, caught: Sequence[Caught] = ()
) -> tuple[Path, Path]:
    """Write `certificate.json` and `certificate.html` into a folder, whole or not at all; older ones are replaced."""
    text = (
        json.dumps(
            certificate.as_mapping() | as_mapping(certificate, caught), indent=2, allow_nan=False
        )
        + "\n"
    )
    found = html(certificate, caught)
    check_writable(folder)
    with atomic_write(folder / JSON_NAME) as json_file, atomic_write(folder / HTML_NAME) as html_file:
        json_file.write_text(text, encoding="utf-8")
        html_file.write_text(found, encoding="utf-8")
    return folder / JSON_NAME, folder / HTML_NAME
