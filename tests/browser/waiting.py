"""Waiting for a page, or for the simulation behind it, on a machine that may be busy."""

import pytest


def until(page, condition):
    """Wait for a condition, a function or JavaScript, for at most 30 s.

    Playwright's own way evaluates text, which our pages' policy forbids.
    """
    for _ in range(600):
        if condition() if callable(condition) else page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    pytest.fail(f"not within 30 s: {condition}")
