"""A Chromium for tests, or how to get one."""

import contextlib
import os
import shutil

import pytest

NAMES = "chromium", "chromium-browser", "google-chrome", "chrome"
FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
)


@contextlib.contextmanager
def browser():
    """A headless Chromium: that of $CHROMIUM, one in the path, or Playwright's own."""
    from playwright.sync_api import Error, sync_playwright

    path = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    with sync_playwright() as playwright:
        try:
            started = playwright.chromium.launch(executable_path=path, args=list(FLAGS))
        except Error as error:
            pytest.fail(
                f"no Chromium can be started ({path or 'none in the path'}): apt-get install chromium, or python -m "
                f"playwright install chromium, or set CHROMIUM to one: {error}",
                pytrace=False,
            )
        yield started
        started.close()


@contextlib.contextmanager
def opened(started, file, width=1280, scheme="light", **options):
    """A page of a file, which must neither complain nor ask anything of anybody.

    Args:
        started: the browser.
        file: the page's.
        width: of the window [px].
        scheme: light or dark.
        **options: of the browser's context.
    """
    context = started.new_context(viewport={"width": width, "height": 800}, color_scheme=scheme, **options)
    page, complaints, asked = context.new_page(), [], []
    page.on(
        "console", lambda message: complaints.append(message.text) if message.type in ("error", "warning") else None
    )
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(file.as_uri())
    yield page
    assert complaints == []
    assert [url for url in asked if not url.startswith(("data:", "blob:")) and url != file.as_uri()] == []
    context.close()
