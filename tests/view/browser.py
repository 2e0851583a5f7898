"""A browser for the tests of the page: Debian's Chromium, driven by Playwright."""

import contextlib
import shutil

import pytest

playwright = pytest.importorskip(
    "playwright.sync_api", reason="no playwright: pip install -e '.[browser]'"
)

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser") if (path := shutil.which(name))), None
)
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium: apt-get install chromium"
)


@contextlib.contextmanager
def browser():
    """Chromium without a window."""
    with playwright.sync_playwright() as driver:
        made = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        try:
            yield made
        finally:
            made.close()


@contextlib.contextmanager
def page(made, server, width=1400, height=900, scheme="light", path=""):
    """The page of a server, with all that its console says as errors."""
    opened = made.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
    errors = []
    opened.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.set_default_timeout(30_000)
    opened.goto(server.address + path)
    try:
        yield opened
        assert errors == [], errors
    finally:
        opened.close()


def until(opened, holds):
    """Wait until an expression is true; the page's own policy forbids that it asks itself."""
    for _ in range(15_000):  # some minutes: a slow machine diagnoses for one
        if opened.evaluate(holds):
            return
        opened.wait_for_timeout(20)
    pytest.fail(f"never so: {holds}")


def drawn(opened, more_than=0):
    """Wait until the page has drawn."""
    until(opened, f"Number(document.body.dataset.frames) > {more_than}")


def frames(opened):
    return int(opened.evaluate("Number(document.body.dataset.frames)"))


def in_sight(opened):
    """Begin and end of what is shown, in s."""
    return tuple(opened.evaluate("[view.begin, view.end]"))
