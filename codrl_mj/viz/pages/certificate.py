"""Files of a validation certificate: JSON, and a page with plots."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from markupsafe import Markup

from codrl_mj.boundary import Json
from codrl_mj.runs.files import atomic_write, check_writable
from codrl_mj.validation.certificate import GROUPS, Certificate, verdict, versions
from codrl_mj.validation.mutations import MutationResult, as_mapping, undetected_checks
from codrl_mj.viz.pages import page

JSON_NAME, HTML_NAME = "certificate.json", "certificate.html"
_CHECKS = ("check", "oracle", "samples", "worst", "allowed", "margin", "unit", "where", "verdict")


def html(certificate: Certificate, results: Sequence[MutationResult] = ()) -> str:
    """Return the page of a certificate, with the results of injected faults if there are any."""
    top = [page.mark_verdict(certificate.passed, certificate.verdict, "p", "verdict")]
    if certificate.quick:
        top.append(page.note("Quick form: fewer states, runs and step sizes than the full form."))
    top.append(
        page.paragraph(
            "Each check has an oracle, a tolerance, and a worst case. The margin is the tolerance"
            " divided by the worst case: a check passes if it is at least 1."
        )
    )
    software = page.definitions(versions().items())
    top.append(page.details(f"Made in {certificate.seconds:.0f} s, with this software", software))
    sections = [_group(name, title, certificate) for name, title in GROUPS.items()]
    skipped = [(skip.name, skip.group, skip.reason) for skip in certificate.skipped]
    skipped_table = (
        page.table("Skipped checks", ("check", "group", "reason"), skipped, cards=True)
        if skipped
        else Markup()
    )
    sections += [_mutations(certificate, results)] if results else []
    sections.append(page.Section("skipped", "Not checked", skipped_table))
    return page.page(
        f"Is the port correct? {certificate.subject}",
        "Certificate of validation",
        page.join(top),
        sections,
    )


def _group(name: str, title: str, certificate: Certificate) -> page.Section:
    checks = [check for check in certificate.checks if check.group == name]
    body = [page.paragraph(f"{title}.")] if checks else []
    for task in dict.fromkeys(check.task for check in checks):
        task_checks = [check for check in checks if check.task == task]
        body.append(page.heading(task) if task else Markup())
        caption = f"Checks of {name}{f', {task}' if task else ''}"
        failed = (index for index, check in enumerate(task_checks) if not check.passed)
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
                page.mark_verdict(check.passed, "passed" if check.passed else "FAILED"),
            )
            for check in task_checks
        ]
        body.append(page.table(caption, _CHECKS, rows, range(2, 6), True, failed))
        body.append(page.plots(plot for check in task_checks for plot in check.plots))
    num_passed = sum(check.passed for check in checks)
    mark = Markup("({})").format(
        page.mark_verdict(num_passed == len(checks), f"{num_passed} of {len(checks)}", "span")
    )
    return page.Section(name, name.capitalize(), page.join(body), mark)


def _mutations(certificate: Certificate, results: Sequence[MutationResult]) -> page.Section:
    rows = []
    for outcome in results:
        clearest = outcome.clearest_failure
        cells = [
            outcome.mutation,
            outcome.task or "the motor",
            f"{len(outcome.failed)} of {outcome.num_checks}",
        ]
        clearest_cells = ["none", "", "", ""]
        if clearest is not None:
            values = (clearest.worst, clearest.tolerance, clearest.tolerance_ratio)
            clearest_cells = [
                f"{clearest.group}: {clearest.name}",
                *(f"{value:.2g}" for value in values),
            ]
        mark = page.mark_verdict(clearest is not None, "MISSED" if clearest is None else "caught")
        rows.append((*cells, *clearest_cells, mark))
    columns = "fault", "in", "failed", "clearest check", "worst", "allowed", "beyond", "verdict"
    never_failed = undetected_checks(certificate.checks, results)
    names = "; ".join(f"{check.group}, {check.task}: {check.name}" for check in never_failed)
    body = (
        page.paragraph(
            "A test of the certificate: each fault was injected, and the quick checks were run with"
            " it. “Beyond” is the worst case of the clearest failed check, divided by its"
            " tolerance."
        ),
        page.table(
            "Injected faults",
            columns,
            rows,
            numbers=(2, 4, 5, 6),
            cards=True,
            failed=(index for index, outcome in enumerate(results) if not outcome.failed),
        ),
        (
            page.note(f"✗ These checks fail for no fault: {names}", bad=True)
            if never_failed
            else page.paragraph(
                "Every check of the certificate fails for at least one of the faults."
            )
        ),
    )
    return page.Section("mutations", "Mutations", page.join(body))


def summary(content: Mapping[str, Json]) -> Markup:
    """Return a summary of a `certificate.json` as markup."""
    checks = content["checks"]
    rows = []
    for name in dict.fromkeys(check["group"] for check in checks):
        group_checks = [check for check in checks if check["group"] == name]
        num_passed = sum(check["passed"] for check in group_checks)
        rows.append((name, GROUPS.get(name, ""), f"{num_passed} of {len(group_checks)}"))
    passed = content["verdict"] == "passed"
    verdict_text = verdict([check["passed"] for check in checks])
    return page.join(
        (
            page.mark_verdict(passed, verdict_text, "p", "verdict"),
            page.paragraph(
                f"Of {content['subject']}, made"
                f" {content['made']}{', the quick form' * content['quick']}."
            ),
            page.table("Checks passed", ("group", "content", "passed"), rows, numbers=(2,)),
        )
    )


def write(
    certificate: Certificate, folder: Path, results: Sequence[MutationResult] = ()
) -> tuple[Path, Path]:
    """Write `certificate.json` and `certificate.html` into a folder, replacing older ones.

    Each file is replaced only when it is complete.
    """
    text = (
        json.dumps(
            certificate.as_mapping() | as_mapping(certificate, results),
            indent=2,
            allow_nan=False,
        )
        + "\n"
    )
    # Build both texts before the files are opened, so that an error leaves the older pair in place.
    html_text = html(certificate, results)
    check_writable(folder)
    with (
        atomic_write(folder / JSON_NAME) as json_file,
        atomic_write(folder / HTML_NAME) as html_file,
    ):
        json_file.write_text(text, encoding="utf-8")
        html_file.write_text(html_text, encoding="utf-8")
    return folder / JSON_NAME, folder / HTML_NAME
