"""Writes the generated parts of the guide's pages again: `python -m tests.guide`."""

from rig.guide.site import GENERATED, PAGES, fill_page
from tests.guide.generated import blocks

for page in sorted(PAGES.rglob("*.md")):
    before = page.read_text("utf-8")
    if GENERATED.search(before):
        page.write_text(fill_page(page, blocks(), None), "utf-8")
