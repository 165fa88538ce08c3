"""Waiting for a page whose own policy forbids Playwright's way, which evaluates text."""

import pytest


def until(page, condition):
    """Wait for a condition, JavaScript, for at most 10 s."""
    for _ in range(200):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    pytest.fail(f"not within 10 s: {condition}")
