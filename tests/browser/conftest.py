"""Chromium, and pages that say what they asked for and what went wrong."""

import os
import shutil

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
QUIET = (
    *(
        "--no-sandbox",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-sync",
    ),
    *("--disable-component-update", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)


@pytest.fixture(scope="session")
def chromium():
    """The browser."""
    from playwright.sync_api import sync_playwright

    path = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.fail(
            f"there is no browser: none of {', '.join(NAMES)} is on the path; install one (Debian,"
            " Ubuntu: apt-get install chromium) or name it in CHROMIUM"
        )
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(QUIET))
        yield browser
        browser.close()


@pytest.fixture
def opened(chromium):
    """Opens an address; after the test nothing may have gone wrong in any page, nor been asked of another host."""
    pages, wrong = [], []

    def open_page(address, width=1280, height=800, scheme="light", **options):
        page = chromium.new_page(
            viewport={"width": width, "height": height}, color_scheme=scheme, **options
        )
        page.emulate_media(reduced_motion="reduce")
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda message: message.type == "error" and wrong.append(message.text))

        def asked(request):
            if not request.url.startswith(
                ("data:", "blob:", "file:", "http://127.0.0.1:", "ws://127.0.0.1:")
            ):
                wrong.append(f"asked for {request.url}")

        page.on("request", asked)
        page.goto(address)
        pages.append(page)
        return page

    yield open_page
    for page in pages:
        page.close()
    assert wrong == []
