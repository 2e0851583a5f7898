"""The site of the guide: complete, without a network, and true where code knows better."""

import json
import re
import sys

import pytest

from can_dbc.errors import InputError
from dart_model.effects import CATALOGUE, FAMILY_WORDS
from rig.guide import site as guide
from rig.guide.site import PAGES, build_site
from tests.guide.conftest import build_by_command


def text_of(site, page):
    return (site / f"{page}.html").read_text("utf-8")


def test_every_page_is_in_the_navigation(site):
    pages = {path.relative_to(PAGES).with_suffix(".html") for path in PAGES.rglob("*.md")}
    assert pages == {path.relative_to(site) for path in site.rglob("*.html")} - {
        path.relative_to(site) for path in site.glob("404.html")
    }
    first = (site / "index.html").read_text("utf-8")
    listed = set(re.findall(r'href="([\w/-]+\.html)"', first))
    assert len(listed) > 5


def test_nothing_is_loaded_from_a_network(site):
    for path in site.rglob("*.html"):
        text = path.read_text("utf-8")
        loaded = re.findall(
            r'<(?:script|img|link|iframe)\b[^>]*\b(?:src|href)="(https?:[^"]*)"', text
        )
        assert loaded == [], path


def test_every_effect_has_its_formula_and_its_picture(site):
    text = text_of(site, "reference/effects")
    for name, effect in CATALOGUE.items():
        if effect.family in FAMILY_WORDS:  # all but the null partner of all effects
            assert f'id="{name}"' in text
    assert text.count("<img ") > 30
    pictures = set(re.findall(r'src="\.\./(generated/\w+\.svg)"', text))
    assert all((site / picture).stat().st_size > 1000 for picture in pictures)


def test_every_key_has_a_meaning(site):
    text = text_of(site, "reference/configuration")
    for key in ("rate_hz", "bus.bitrate", "supervision.limits[].action", "filter.bandwidth_hz",
                "observers.STRUT.kind", "signals.QUANTITY.tare_n"):  # fmt: skip
        assert f"<code>{key}</code>" in text
    for page in ("configuration", "model-file", "mapping", "simulated-bench"):
        for row in re.findall(
            r"<tr>\s*(<td>.*?)</tr>", text_of(site, f"reference/{page}"), re.DOTALL
        ):
            key, *_, meaning = re.findall(r"<td>(.*?)</td>", row, re.DOTALL)
            assert meaning.strip(), (page, key)


def test_the_search_knows_what_an_engineer_looks_for(site):
    index = json.loads((site / "search" / "search_index.json").read_text("utf-8"))
    texts = [f"{doc['title']} {doc['text']}" for doc in index["docs"]]
    for word in ("bandwidth_hz", "pinching", "E2E"):
        assert any(word.lower() in text.lower() for text in texts), word


def test_a_site_that_cannot_be_written_is_one_line(tmp_path, monkeypatch, capsys):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    assert build_by_command(tmp_path / "full", monkeypatch) == 2
    assert "full: is not empty, expected a new folder" in capsys.readouterr().err
    assert build_by_command(tmp_path / "full" / "mine.txt", monkeypatch) == 2
    assert "mine.txt" in capsys.readouterr().err


def test_a_missing_generator_and_a_link_that_leads_nowhere_are_one_line(tmp_path, monkeypatch):
    pages = tmp_path / "pages"
    pages.mkdir()
    (pages / "index.md").write_text("# One\n\n[nowhere](nowhere.md)\n")
    monkeypatch.setattr(guide, "PAGES", pages)
    monkeypatch.setattr(guide, "_NAVIGATION", {})
    with pytest.raises(InputError, match=r"cannot be built: .*nowhere\.md"):
        build_site(tmp_path / "site", {})
    (pages / "index.md").write_text("# One\n\n<!-- generated: nothing -->\n<!-- end -->\n")
    with pytest.raises(InputError, match=r"index\.md: no generated part 'nothing'"):
        build_site(tmp_path / "other", {})
    monkeypatch.setitem(sys.modules, "material", None)
    with pytest.raises(
        InputError, match=r"requires MkDocs Material: `pip install -e '\.\[guide\]'`"
    ):
        build_site(tmp_path / "third", {})
