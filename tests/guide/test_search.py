"""The site in a browser, opened from a file: its search, and whether everyone can use it."""

import pytest

from tests.view.browser import browser, needs_chromium, until

pytestmark = needs_chromium

axe = pytest.importorskip(
    "axe_playwright_python.sync_playwright", reason="no axe-playwright-python"
)

PAGES = ("index", "tutorials/own-bench", "reference/effects", "reference/commands",
         "explanation/diagnosis")  # fmt: skip


@pytest.fixture(scope="module")
def chromium():
    with browser() as made:
        yield made


@pytest.mark.slow
@pytest.mark.parametrize(
    ("word", "found"),
    [
        ("bandwidth_hz", "explanation/observers.html"),
        ("pinching", "reference/glossary.html"),
        ("E2E", "reference/"),
    ],
)
def test_the_search_works_from_a_file(site, chromium, word, found):
    page = chromium.new_page(viewport={"width": 1400, "height": 900})
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"file://{site}/index.html")
    page.locator("input.md-search__input").first.click()
    page.keyboard.type(word)
    until(page, f"document.querySelector('.md-search-result__item a[href*=\"{found}\"]') !== null")
    assert errors == []
    page.close()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", PAGES)
def test_axe_finds_nothing_serious(site, chromium, name, scheme):
    page = chromium.new_page(viewport={"width": 1400, "height": 900}, color_scheme=scheme)
    page.goto(f"file://{site}/{name}.html")
    found = axe.Axe().run(page).response["violations"]
    serious = [
        (item["id"], [node["target"] for node in item["nodes"]][:3])
        for item in found
        if item["impact"] in ("serious", "critical")
    ]
    page.close()
    assert serious == []
