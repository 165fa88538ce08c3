"""Chromium, and a fixture that opens pages and checks their errors and requests."""

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
    """Return the browser."""
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
    """Yield a function that opens an address.

    At the end no page may have had an error or a request to another host.
    """
    pages, problems = [], []

    def open_page(address, width=1280, height=800, scheme="light", **options):
        page = chromium.new_page(
            viewport={"width": width, "height": height}, color_scheme=scheme, **options
        )
        page.emulate_media(reduced_motion="reduce")
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on(
            "console", lambda message: message.type == "error" and problems.append(message.text)
        )

        def check_request(request):
            if not request.url.startswith(
                ("data:", "blob:", "file:", "http://127.0.0.1:", "ws://127.0.0.1:")
            ):
                problems.append(f"request to {request.url}")

        page.on("request", check_request)
        page.goto(address)
        pages.append(page)
        return page

    yield open_page
    for page in pages:
        page.close()
    assert problems == []
