"""The guide's pictures of pages: `python -m tests.guide.pictures`.

Runs a demo, benches in several modes and two damper tests, and writes what a browser shows of them.
Requires Chromium and Playwright. The pictures `before-...` are those of version 0.2, kept as files.
"""

import contextlib
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

import rig.guide
from rig.dyno.faults import name_faults
from rig.dyno.master import master_of
from rig.dyno.report import DamperReport
from rig.dyno.tolerance import BandPoint, ToleranceBand, evaluate_band
from rig.pages.characteristics_page import write_characteristics_page
from rig.pages.run_report import write_run_report
from tests.dyno.population import SCATTER, Damper, characterised, replace
from tests.view.browser import browser, drawn
from tests.view.serving import make_run, serving
from tests.view.states import STATES, make_state, touch

IMAGES = Path(rig.guide.__file__).parent / "pages" / "images"
MODES = ("waiting", "hold", "safe_innovation", "ready")
"""States whose banners a page of the guide shows."""


def shoot_page(
    made, run: Path, path: Path, height: int, token: str | None = "secret", width: int = 1600
) -> None:
    """The live page of a run."""
    with serving(run, token=token) as server:
        page = made.new_page(viewport={"width": width, "height": height})
        touch(run)
        page.goto(f"{server.address}#{token}")
        drawn(page)
        for _ in range(3):
            touch(run)
            page.wait_for_timeout(500)
        page.screenshot(path=path, clip={"x": 0, "y": 0, "width": width, "height": height})
        page.close()


def shoot_report(made, report: Path, path: Path, height: int = 900) -> None:
    """The first screen of a report."""
    page = made.new_page(viewport={"width": 1240, "height": height})
    page.goto(report.absolute().as_uri())
    page.wait_for_timeout(500)
    page.screenshot(path=path)
    page.close()


def write_sheet(folder: Path) -> Path:
    """The sheet of a damper that has lost gas, against a master and a band."""
    good = characterised(Damper(), 1)
    lost = characterised(replace(Damper(), gas_n=0.45 * Damper().gas_n), 2)
    points = []
    for step in good.steps[1:]:
        limits = {"velocity_m_per_s": step.peak_speed_m_per_s}
        for side in ("compression", "rebound"):
            force_n = getattr(step, side).force_at_peak_velocity_n.value
            half_n = 20.0 + 0.08 * abs(force_n)
            limits |= {f"{side}_low_n": force_n - half_n, f"{side}_high_n": force_n + half_n}
        points.append(BandPoint(**limits))
    band = ToleranceBand(name="band", points=tuple(points))
    named = name_faults(lost, master_of(good), SCATTER)
    report = DamperReport(lost, evaluate_band(lost.steps, band), named, good)
    labels = {"damper": "DTC 46 rear", "serial": "0815", "operator": "M. Berg"}
    write_characteristics_page([report], folder / "sheet.html", labels)
    return folder / "sheet.html"


def shrink(path: Path, width: int = 1000) -> None:
    """Make a picture of a whole screen small enough for a page beside another."""
    image = Image.open(path).convert("RGB")
    image = image.resize(
        (width, round(image.height * width / image.width)), Image.Resampling.LANCZOS
    )
    # By coverage: small areas, such as the band of modes, keep their colour.
    image.quantize(128, Image.Quantize.MAXCOVERAGE).save(path, optimize=True)


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
        shoot_report(made, write_sheet(Path(folder)), IMAGES / "sheet.png", 1180)
        for name in ("waiting", "safe_silent"):
            path = IMAGES / f"after-{name.replace('_', '-')}.png"
            shoot_page(made, make_state(Path(folder) / f"{name}_2", name), path, 990)
            shrink(path)
        finished = make_run(Path(folder) / "finished", 6000)
        shoot_page(made, finished, IMAGES / "after-phone.png", 844, token=None, width=390)
        shrink(IMAGES / "after-phone.png", 390)
        with contextlib.chdir(folder):
            ended = make_state(Path("ended"), "safe_silent", ended=True).absolute()
        write_run_report(ended, Path(folder) / "run.html")
        shoot_report(made, Path(folder) / "run.html", IMAGES / "after-run-report.png")
        shrink(IMAGES / "after-run-report.png")


if __name__ == "__main__":
    main()
