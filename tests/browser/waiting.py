"""Waiting for a page, or for the simulation behind it, on a busy machine."""

import pytest


def until(page, condition):
    """Wait until a condition, a function or JavaScript, is true, for at most 30 s.

    Playwright's own function evaluates text, which the policy of our pages forbids.
    """
    for _ in range(600):
        if condition() if callable(condition) else page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    pytest.fail(f"not within 30 s: {condition}")
