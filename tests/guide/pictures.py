"""The guide's pictures of pages: `python -m tests.guide.pictures`.

Runs a demo and benches in several modes, and writes what a browser shows of them. Requires Chromium
and Playwright.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import rig.guide
from tests.view.browser import browser, drawn
from tests.view.serving import serving
from tests.view.states import STATES, make_state, touch

IMAGES = Path(rig.guide.__file__).parent / "pages" / "images"
MODES = ("waiting", "hold", "safe_innovation", "ready")
"""States whose banners a page of the guide shows."""


def shoot_page(made, run: Path, path: Path, height: int, token: str | None = "secret") -> None:
    """The live page of a run."""
    with serving(run, token=token) as server:
        page = made.new_page(viewport={"width": 1600, "height": height})
        touch(run)
        page.goto(f"{server.address}#{token}")
        drawn(page)
        for _ in range(3):
            touch(run)
            page.wait_for_timeout(500)
        page.screenshot(path=path, clip={"x": 0, "y": 0, "width": 1600, "height": height})
        page.close()


def shoot_report(made, report: Path, path: Path) -> None:
    """The first screen of a report."""
    page = made.new_page(viewport={"width": 1240, "height": 900})
    page.goto(report.absolute().as_uri())
    page.wait_for_timeout(500)
    page.screenshot(path=path)
    page.close()


def main() -> None:
    """Write the pictures."""
    assert set(MODES) <= set(STATES)
    with tempfile.TemporaryDirectory() as folder, browser() as made:
        tour = Path(folder) / "tour"
        demo = ["demo", "--lockstep", "--duration-s", "8", "--out", str(tour)]
        subprocess.run([sys.executable, "-P", "-m", "rig", *demo], check=True)
        shoot_report(made, tour / "diagnosis" / "report.html", IMAGES / "report.png")
        shoot_page(made, make_state(Path(folder) / "running", "running"), IMAGES / "view.png", 990)
        for name in MODES:
            run = make_state(Path(folder) / name, name)
            shoot_page(made, run, IMAGES / f"mode-{name.replace('_', '-')}.png", 190)


if __name__ == "__main__":
    main()
