"""The page in a browser, by mouse and by keyboard alone."""

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from rig.dyno.faults import MasterComparison
from rig.dyno.report import DamperReport
from rig.dyno.tolerance import BandPoint, ToleranceBand, evaluate_band
from rig.log.file_names import EVENTS_FILE, STEPS_FILE
from rig.log.reader import read_run
from rig.pages.browser_print import print_page
from rig.pages.characteristics_page import write_characteristics_page
from rig.pages.number_formats import number
from rig.pages.report import page as page_of
from rig.pages.run_report import write_run_report
from rig.run.changed_settings import read_changes
from rig.run.replay import replay
from tests.dyno.test_comparison import state
from tests.pages.test_report import report
from tests.view.browser import browser, drawn, frames, in_sight, needs_chromium, page, until
from tests.view.serving import COUNT, make_run, serving
from tests.view.states import make_state, touch

pytestmark = needs_chromium

axe = pytest.importorskip(
    "axe_playwright_python.sync_playwright", reason="no axe-playwright-python"
)

END_S = (COUNT - 1) * 1e-3


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("browser") / "reference")


@pytest.fixture(scope="module")
def made():
    with browser() as chromium:
        yield chromium


@pytest.fixture(scope="module")
def server(run):
    with serving(run, run) as two:
        yield two


@pytest.fixture
def opened(made, run):
    with serving(run) as one, page(made, one) as found:
        drawn(found)
        yield found


def test_a_finished_run_is_shown_whole(opened):
    assert in_sight(opened) == pytest.approx((0.0, END_S), abs=2e-3)
    assert opened.title().startswith("reference")
    assert opened.locator(".pill").inner_text() == "ended"
    assert opened.locator(".banner .word").inner_text() == "ENDED"
    for heading in ("Height", "Strut force", "Virtual force", "Height error (innovation)"):
        assert opened.get_by_role("heading", name=heading, exact=True).first.is_visible()
    until(opened, "document.querySelectorAll('#figures dt').length > 1")
    points = opened.evaluate("charts['plane-height'].chart.data[1][0].length")
    assert points > 50


def test_a_stretch_that_is_drawn_is_zoomed_in_all_charts(opened):
    box = opened.locator("#force .u-over").bounding_box()
    opened.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 50)
    opened.mouse.down()
    opened.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 50, steps=5)
    opened.mouse.up()
    until(opened, "view.end - view.begin < 0.3")
    begin, end = in_sight(opened)
    assert (begin, end) == pytest.approx((0.25 * END_S, 0.5 * END_S), abs=0.01)
    until(opened, f"Math.abs(charts.height.chart.scales.x.max - {end}) < 1e-6")
    opened.locator("#innovation .u-over").dblclick()
    until(opened, "view.begin === 0")


def test_the_keyboard_reaches_everything(opened):
    opened.keyboard.press("+")
    until(opened, f"view.end - view.begin < {0.6 * END_S}")
    end = in_sight(opened)[1]
    opened.keyboard.press("ArrowLeft")
    assert in_sight(opened)[1] < end
    opened.keyboard.press("-")
    opened.keyboard.press("Home")
    until(opened, "view.begin === 0 && view.follow")
    opened.keyboard.press(" ")
    assert opened.locator("#pause").get_attribute("aria-pressed") == "true"
    opened.keyboard.press("End")
    assert opened.locator("#pause").get_attribute("aria-pressed") == "false"
    reached = set()
    for _ in range(16):
        opened.keyboard.press("Tab")
        reached.add(opened.evaluate("document.activeElement.id"))
    assert {
        "span",
        "pause",
        "back",
        "forth",
        "closer",
        "wider",
        "whole",
        "newest",
        "reference",
        "link",
        "units",
        "theme",
    } <= reached


def test_values_stand_under_the_cursor_with_their_units(opened):
    box = opened.locator("#height .u-over").bounding_box()
    opened.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 40)
    values = opened.locator('[data-chart="height"] .u-value')
    until(opened, "charts.height.chart.cursor.idx !== null")
    assert re.fullmatch(r"[\d.]+ mm", values.nth(1).inner_text())
    # The cursors of the charts over time stand at one time.
    forces = opened.locator('[data-chart="force"] .u-value')
    assert re.fullmatch(r"−?[\d.]+ N", forces.last.inner_text())


def test_runs_are_laid_over_one_another(made, server):
    with page(made, server) as opened:
        drawn(opened)
        assert opened.locator(".run").count() == 2
        assert opened.locator(".banner").count() == 2
        assert opened.evaluate("charts.virtual.chart.series.length") == 3
        # Each curve has its own look: measured ones are dashed, and each run has its colour.
        looks = opened.evaluate(
            "charts.height.chart.series.slice(1).map((s) => [s.stroke(), String(s.dash)].join())"
        )
        assert len(set(looks)) == len(looks) == 4


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1400, 390])
def test_nothing_keeps_anybody_out(made, run, scheme, width):
    with serving(run) as one, page(made, one, width=width, scheme=scheme) as opened:
        drawn(opened)
        assert opened.evaluate("document.documentElement.dataset.theme") == scheme
        found = axe.Axe().run(opened).response["violations"]
        serious = [item for item in found if item["impact"] in ("serious", "critical")]
        assert serious == [], [(item["id"], item["nodes"][0]["html"]) for item in serious]
        assert opened.evaluate("document.documentElement.scrollWidth <= innerWidth")


@pytest.mark.slow
@pytest.mark.parametrize("width", [1100, 390])
@pytest.mark.parametrize("kind", ["run", "diagnosis"])
def test_reports_keep_nobody_out(made, run, tmp_path, kind, width):
    path = tmp_path / "report.html"
    if kind == "run":
        write_run_report(run, path)
    else:
        path.write_text(page_of(report()), "utf-8")
    opened, errors = made.new_page(viewport={"width": width, "height": 900}), []
    opened.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.goto(path.as_uri())
    assert opened.locator("canvas").count() > 2
    found = axe.Axe().run(opened).response["violations"]
    serious = [item for item in found if item["impact"] in ("serious", "critical")]
    assert serious == [], [(item["id"], item["nodes"][0]["html"]) for item in serious]
    assert opened.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert errors == []
    opened.close()


A4 = {"width": 703, "height": 1032}
"""The area of an A4 page within margins of 12 mm, in px of 1/96 in."""


def printed(made, path):
    """A report as it is laid out on paper."""
    opened = made.new_page(viewport=A4)
    opened.goto(path.as_uri())
    opened.emulate_media(media="print")
    opened.evaluate("dispatchEvent(new Event('beforeprint'))")
    opened.wait_for_timeout(300)
    return opened


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["run", "diagnosis"])
def test_no_chart_is_cut_on_paper(made, run, tmp_path, kind):
    path = tmp_path / "report.html"
    if kind == "run":
        write_run_report(run, path)
    else:
        path.write_text(page_of(report()), "utf-8")
    opened = printed(made, path)
    heights = opened.evaluate(
        "[...document.querySelectorAll('.figure')].map((f) => f.getBoundingClientRect().height)"
    )
    assert len(heights) >= 1
    assert max(heights) < A4["height"]
    assert opened.evaluate("document.documentElement.scrollWidth") <= A4["width"]
    opened.close()


def sheet(tmp_path, speeds):
    """The sheet of a damper with a band at some speeds and a master."""
    record = state(1)
    limits = {"compression_low_n": 0.0, "compression_high_n": 700.0}
    limits |= {"rebound_low_n": -300.0, "rebound_high_n": 300.0}
    band = ToleranceBand(
        name="band", points=tuple(BandPoint(velocity_m_per_s=v, **limits) for v in speeds)
    )
    good = MasterComparison((), True, 1.0)
    path = tmp_path / "report.html"
    points = evaluate_band(record.steps, band)
    write_characteristics_page(
        [DamperReport(record, points, good, state(3))], path, {"serial": "0815"}
    )
    return path


@pytest.mark.slow
@pytest.mark.parametrize("points", [1, 8, 20])
def test_a_damper_sheet_is_one_page_of_a4(made, tmp_path, points):
    opened = printed(made, sheet(tmp_path, np.linspace(0.02, 0.29, points).round(4).tolist()))
    end = opened.evaluate("document.querySelector('.sheet').getBoundingClientRect().bottom")
    assert end < A4["height"]
    methods = opened.locator(".next-page").first
    assert methods.evaluate("(e) => getComputedStyle(e).breakBefore") == "page"
    assert opened.get_by_text("Signature").is_visible()
    opened.close()
    if points == 8:
        path = tmp_path / "report.pdf"
        print_page(tmp_path / "report.html", path)
        assert path.read_bytes().count(b"/Type /Page\n") == 2


def test_a_report_is_shown_in_other_units_and_back(made, tmp_path):
    opened = made.new_page(viewport={"width": 1100, "height": 900})
    opened.goto(sheet(tmp_path, [0.1, 0.2]).as_uri())
    before = opened.locator("main").inner_text()
    shown = [opened.locator(f".sheet img.{system}").first for system in ("si", "us")]
    assert [image.is_visible() for image in shown] == [True, False]
    opened.locator("#units").select_option("US")
    assert [image.is_visible() for image in shown] == [False, True]
    text = opened.locator("main").inner_text()
    force_n, half_n = opened.evaluate(
        "[...document.querySelectorAll('.points tbody td')][1].textContent.split('±')"
        ".map((part) => Number(part.replace('\u2212', '-')))"
    )
    record = state(1)
    true_n = evaluate_band(record.steps, one_point_band())[0].force.value
    assert force_n == pytest.approx(true_n / 4.4482216152605, abs=0.06)
    assert half_n > 0.0
    assert "lbf/in" in text
    assert not re.search(r"\d\u00a0N\b", text)
    opened.locator("#units").select_option("SI")
    assert opened.locator("main").inner_text() == before
    opened.close()


def one_point_band():
    return ToleranceBand(
        name="band",
        points=(
            BandPoint(
                velocity_m_per_s=0.1,
                compression_low_n=0.0,
                compression_high_n=700.0,
                rebound_low_n=-300.0,
                rebound_high_n=300.0,
            ),
        ),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "converted"),
    [
        ("9 160 ± 910 N", "2 059 ± 205 lbf"),
        ("12.08 N (95 %: 11.83 to 12.36 N)", "2.716 lbf (95 %: 2.659 to 2.779 lbf)"),
        ("Height error 2.31 → 0.0104 mm", "Height error 0.0909 → 0.000409 in"),
        ("−500 N/m³ and 3 kg", "−500 N/m³ and 3 kg"),
        ("at 0.5 m/s, 100 N·s/m", "at 19.7 in/s, 0.571 lbf·s/in"),
    ],
)
def test_quantities_in_a_text_are_converted(made, tmp_path, text, converted):
    opened = made.new_page()
    opened.goto(sheet(tmp_path, [0.1]).as_uri())
    assert opened.evaluate("(text) => Units.quantities(text)", text) == converted
    opened.close()


def test_the_charts_of_a_report_change_their_units(made, tmp_path):
    path = tmp_path / "report.html"
    path.write_text(page_of(report()), "utf-8")
    opened, errors = made.new_page(viewport={"width": 1100, "height": 900}), []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.goto(path.as_uri())
    ends = "drawnPanels[0].chart.scales.y.max"
    newtons = opened.evaluate(ends)
    opened.locator("#units").select_option("US")
    assert opened.evaluate(ends) == pytest.approx(newtons / 4.4482216152605, rel=1e-3)
    assert "lbf" in opened.evaluate("drawnPanels[0].chart.axes[1].label")
    assert errors == []
    opened.close()


@pytest.mark.slow
@pytest.mark.parametrize("width", [1100, 390])
def test_a_damper_sheet_keeps_nobody_out(made, tmp_path, width):
    opened = made.new_page(viewport={"width": width, "height": 900})
    opened.goto(sheet(tmp_path, [0.1, 0.2]).as_uri())
    found = axe.Axe().run(opened).response["violations"]
    serious = [item for item in found if item["impact"] in ("serious", "critical")]
    assert serious == [], [(item["id"], item["nodes"][0]["html"]) for item in serious]
    assert opened.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert opened.locator(".stamp").inner_text().endswith("PASS")
    assert not opened.get_by_text("Signature").is_visible()
    opened.close()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", ["waiting", "safe_innovation"])
def test_a_live_page_keeps_nobody_out(made, states, scheme, name):
    with (
        serving(states[name], token="secret") as one,
        page(made, one, scheme=scheme, path="#secret") as opened,
    ):
        shown_live(opened, states[name])
        found = axe.Axe().run(opened).response["violations"]
        serious = [item for item in found if item["impact"] in ("serious", "critical")]
        assert serious == [], [(item["id"], item["nodes"][0]["html"]) for item in serious]


@pytest.fixture(scope="module")
def states(tmp_path_factory):
    """Runs as they look while they are recorded."""
    folder = tmp_path_factory.mktemp("states")
    names = ("running", "waiting", "hold", "safe_silent", "safe_innovation", "ready")
    return {name: make_state(folder / name, name) for name in names}


def shown_live(opened, run):
    """Wait until the page shows a run that is being recorded."""
    for _ in range(200):
        touch(run)
        if opened.evaluate("runs[0]?.state === 'live' && Boolean(document.body.dataset.frames)"):
            return
        opened.wait_for_timeout(50)
    pytest.fail("not shown as live")


BANNERS = {
    "running": ("RUNNING", r"since 0\.1 s\. Force output valid\.", None),
    "waiting": ("WAITING", r"for BENCH_MEASUREMENT on rig, 5 s\. .*invalid\.", None),
    "hold": ("HOLD", r"since 4\.0 s: no valid measurement for 11 ms \(limit 10 ms\)\. .*", None),
    "safe_silent": (
        "SAFE",
        r"since 4\.5 s: no valid measurement for 501 ms \(limit 500 ms\)\. .*",
        "Acknowledge",
    ),
    "safe_innovation": (
        "SAFE",
        r"since 1\.2 s: height error \(innovation\) 0\.101 mm \(limit 0\.1 mm\)\. .*",
        "Acknowledge",
    ),
    "ready": ("READY", r"since 0\.1 s: settled, and withheld until armed\. .*", "Arm"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BANNERS)
def test_the_banner_states_mode_cause_and_action(made, states, name):
    word, text, action = BANNERS[name]
    with (
        serving(states[name], token="secret") as one,
        page(made, one, width=1600, height=1000, path="#secret") as opened,
    ):
        shown_live(opened, states[name])
        assert opened.locator(".banner .word").inner_text() == word
        assert re.fullmatch(text, opened.locator(".banner .text").inner_text().replace("\xa0", " "))
        buttons = opened.locator(".banner button")
        assert buttons.all_inner_texts() == ([action] if action else [])
        # All that decides is in sight without scrolling.
        for item in (".banner", "#tile-force-error", '[data-chart="band"]'):
            box = opened.locator(item).first.bounding_box()
            assert box["y"] + box["height"] <= 1000
        force = opened.locator("#tile-force .sub").inner_text()
        assert (force == "invalid") == (name != "running")


@pytest.mark.long
def test_the_banner_changes_within_a_second_of_the_mode(made, states, tmp_path):
    """Real time: from the write of the steps to the word on the page."""
    whole = states["safe_silent"]
    run = shutil.copytree(whole, tmp_path / "growing")
    size = (run / STEPS_FILE).stat().st_size
    os.truncate(run / STEPS_FILE, size // 2)
    events = (run / EVENTS_FILE).read_text().splitlines(keepends=True)
    before = [line for line in events if json.loads(line)["t_s"] < 3.0]
    (run / EVENTS_FILE).write_text("".join(before))
    with serving(run) as one, page(made, one) as opened:
        shown_live(opened, run)
        assert opened.locator(".banner .word").inner_text() == "RUNNING"
        with (run / EVENTS_FILE).open("a") as file:
            file.writelines(events[len(before) :])
        begin = time.monotonic()
        with (run / STEPS_FILE).open("ab") as file:
            file.write((whole / STEPS_FILE).read_bytes()[size // 2 :])
        opened.locator(".banner .word", has_text="SAFE").wait_for()
        took_s = time.monotonic() - begin
        assert "no valid measurement for 501" in opened.locator(".banner .text").inner_text()
        print(f"banner after {took_s:.2f} s")
        assert took_s < 1.0


def test_tiles_hold_what_the_log_holds(made, states):
    steps = read_run(states["running"]).steps
    last = {name: steps.column(name).to_numpy() for name in steps.schema.names}
    error_n = (last["strut.force_n"] - last["strut_force_n"])[last["t_ns"] > last["t_ns"][-1] - 1e9]
    error_n = error_n[np.isfinite(error_n)]
    with serving(states["running"]) as one, page(made, one) as opened:
        shown_live(opened, states["running"])
        big = {it: opened.locator(f"#tile-{it} .big").inner_text() for it in ("height", "force")}
        height_m = last["strut.measured_height_m"]
        height_m = height_m[np.isfinite(height_m)][-1]
        assert big["height"] == f"{1e3 * height_m:.2f} mm"
        assert big["force"] == f"{last['strut.force_n'][-1]:.1f} N".replace("-", "−")
        rms_n = float(np.sqrt(np.mean(error_n**2)))
        assert opened.locator("#tile-force-error .big").inner_text() == f"{rms_n:.1f} N"
        opened.select_option("#units", "US")
        until(opened, "document.querySelector('#tile-height .big').textContent.includes('in')")
        shown = opened.locator("#tile-height .big").inner_text()
        assert float(shown.removesuffix(" in")) == pytest.approx(height_m / 0.0254, abs=1e-4)


def test_numbers_are_written_as_in_the_reports(opened):
    """The page's script and the reports have one rule in two languages."""
    rng = np.random.default_rng(11)
    values = (rng.standard_normal(300) * 10.0 ** rng.uniform(-3.0, 6.0, 300)).tolist()
    decimals = rng.integers(0, 5, 300).tolist()
    given = list(zip(values, decimals, strict=True))
    shown = opened.evaluate("(pairs) => pairs.map(([v, d]) => Charts.fixed(v, d))", given)
    expected = [number(value, count) for value, count in given]
    # A value that rounds to zero has no sign on the page.
    assert shown == [
        text.lstrip("\u2212") if not re.search("[1-9]", text) else text for text in expected
    ]


def test_tabs_are_reached_by_keyboard(opened):
    opened.locator("#of-tab-virtual").focus()
    opened.keyboard.press("ArrowRight")
    assert opened.evaluate("document.activeElement.id") == "of-tab-spectrum"
    assert opened.locator("#tab-spectrum").is_visible()
    assert not opened.locator("#tab-virtual").is_visible()
    opened.keyboard.press("End")
    assert opened.locator("#tab-diagnosis").is_visible()
    opened.keyboard.press("Home")
    assert opened.locator("#tab-virtual").is_visible()


def test_a_chart_is_saved_as_picture_and_as_numbers(opened, run):
    figure = opened.locator('[data-chart="force"]')
    figure.locator("summary").click()
    with opened.expect_download() as saved:
        figure.get_by_role("button", name="PNG").click()
    assert saved.value.suggested_filename == "reference-force.png"
    assert Path(saved.value.path()).read_bytes().startswith(b"\x89PNG")
    figure.locator("summary").click()
    with opened.expect_download() as saved:
        figure.get_by_role("button", name="CSV").click()
    found = np.genfromtxt(saved.value.path(), delimiter=",", names=True)
    steps = read_run(run).steps
    assert len(found) == steps.num_rows
    expected = steps.column("strut.force_n").to_numpy()
    assert np.allclose(found["strutforce_n"], expected, rtol=1e-8, equal_nan=True)


def test_a_second_cursor_shows_differences(opened):
    box = opened.locator("#height .u-over").bounding_box()
    opened.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 40)
    opened.keyboard.press("m")
    assert opened.locator("#reference").get_attribute("aria-pressed") == "true"
    opened.mouse.move(box["x"] + 0.75 * box["width"], box["y"] + 40)
    text = '[data-chart="height"] .u-value'
    until(opened, f"document.querySelectorAll('{text}')[1].textContent.includes('Δ')")
    value, base = opened.evaluate(
        "(() => { const { chart } = charts.height; const at = chart.cursor.idx;"
        " return [chart.data[1][at], chart.data[1][chart.valToIdx(Charts.reference.x)]]; })()"
    )
    shown = opened.locator(text).nth(1).inner_text().replace("−", "-")
    assert float(shown.split("Δ ")[1].rstrip(")")) == pytest.approx(value - base, abs=2e-2)


def test_any_logged_quantity_gets_a_chart_that_stays(made, run):
    with serving(run) as one, contextlib.closing(made.new_context()) as context:
        opened = context.new_page()
        opened.goto(one.address)
        drawn(opened)
        opened.locator("#of-tab-more").click()
        opened.select_option("#quantity", "strut.acceleration_m_per_s2")
        opened.get_by_role("button", name="Add a chart").click()
        until(opened, "Boolean(charts['more-0'])")
        opened.reload()
        until(opened, "Boolean(charts['more-0']) && charts['more-0'].chart.data[0].length > 100")
        assert opened.locator("#added h2").inner_text() == "strut.acceleration_m_per_s2"
        opened.get_by_role("button", name="Remove the chart").click()
        until(opened, "!charts['more-0']")


def test_a_link_holds_what_is_shown(made, run):
    with serving(run) as one, page(made, one, path="?begin=0.2&end=0.4&strut=strut") as opened:
        drawn(opened)
        until(opened, "Math.abs(view.end - 0.4) < 1e-9")
        assert in_sight(opened) == pytest.approx((0.2, 0.4))


def test_an_event_is_shown_by_a_click(made, states):
    with serving(states["safe_silent"]) as one, page(made, one) as opened:
        drawn(opened)
        opened.locator("#of-tab-events").click()
        until(opened, "document.querySelectorAll('#events button').length > 3")
        opened.locator("#events button").first.click()
        until(opened, "view.end - view.begin < 1.1")
        assert "HOLD → SAFE" in opened.locator("#event").inner_text()
        assert in_sight(opened) == pytest.approx((4.0, 5.0))


def test_a_phone_shows_banner_tiles_and_force_first(made, states):
    with serving(states["running"]) as one, page(made, one, width=390, height=844) as opened:
        shown_live(opened, states["running"])
        items = (".banner", ".tiles", '[data-chart="force"]', '[data-chart="height"]')
        tops = [opened.locator(item).first.bounding_box()["y"] for item in items]
        assert tops == sorted(tops)
        assert not opened.locator("#pause").is_visible()
        opened.locator("#menu").click()
        assert opened.locator("#pause").is_visible()


def test_a_name_is_never_executed(made, run, tmp_path):
    bad = "<img src=x onerror=document.body.dataset.hit=1>"
    folder = tmp_path / bad.replace("/", "")
    shutil.copytree(run, folder)
    for name in ("model.yaml", "run.yaml"):
        text = (folder / name).read_text()
        (folder / name).write_text(text.replace("reference_case", bad))
    content = yaml.safe_load((folder / "model.yaml").read_text())
    content["name"] = "x"
    header = yaml.safe_load((folder / "run.yaml").read_text())
    header["ending"]["status"] = bad
    header["ending"]["diverged"] = {"strut": bad, "t_s": 0.1}
    header["ending"]["counts"] = {bad: 3}
    (folder / "run.yaml").write_text(yaml.safe_dump(header))
    with serving(folder) as one, page(made, one) as opened:
        drawn(opened)
        until(opened, "document.querySelectorAll('#figures dt').length > 1")
        assert opened.locator("#runs b").inner_text() == folder.name
        assert bad in opened.locator("#figures").inner_text()
        assert opened.evaluate("document.body.dataset.hit") is None
        assert opened.locator("img").count() == 0


@contextlib.contextmanager
def command(run, port):
    """`rig view` as a process of its own."""
    call = ["from rig.cli.main import main; main()", "view", run, "--port", port, "--no-browser"]
    whole = [sys.executable, "-c", *map(str, call)]
    with subprocess.Popen(whole, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process.stdout.readline()
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 0


@pytest.mark.long
def test_a_page_goes_on_when_the_server_is_back(made, run):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with contextlib.closing(made.new_page()) as opened:
        with command(run, port) as said:
            assert said.startswith(f"http://127.0.0.1:{port}/ (on this machine only")
            opened.goto(f"http://127.0.0.1:{port}/")
            drawn(opened)
        until(opened, "document.getElementById('message').textContent.includes('No answer')")
        with command(run, port):
            until(opened, "document.getElementById('message').hidden")


@pytest.mark.long
def test_a_live_run_is_followed(made, tmp_path):
    """Real time: what is shown is at most 0.3 s old, and a pause holds."""
    bench = [sys.executable, "-m", "tests.realtime", "--out", tmp_path / "live"]
    # What follows takes some 20 s; a slow machine needs twice as long.
    process = subprocess.Popen([*map(str, bench), "--seconds", "60", "--busy", "0"])
    try:
        live = tmp_path / "live" / "run"
        with serving(live, token="secret") as one, page(made, one, path="#secret") as opened:
            drawn(opened)
            until(opened, "runs[0].state === 'live'")
            epoch_s = float(opened.evaluate("Number(runs[0].epoch_ns) * 1e-9"))
            ages, count = [], frames(opened)
            begin = time.monotonic()
            while time.monotonic() < begin + 5.0:
                drawn(opened, frames(opened))
                ages.append(time.time() - epoch_s - in_sight(opened)[1])
            print(f"{(frames(opened) - count) / 5.0:.1f} frames a second, oldest {max(ages):.3f} s")
            assert sorted(ages)[len(ages) // 2] < 0.3
            opened.keyboard.press(" ")
            held = in_sight(opened)
            opened.wait_for_timeout(1000)
            assert in_sight(opened) == held
            opened.keyboard.press("End")
            until(opened, f"view.end > {held[1] + 1.0}")
            # A second browser, and one that asks and never reads, slow nobody.
            with socket.create_connection(one.server_address) as stalled, page(made, one) as other:
                asked = "GET /stretch?run=0&begin=0&end=9&points=4000&columns=mode HTTP/1.1\r\n"
                stalled.sendall(
                    (asked + f"Host: 127.0.0.1:{one.server_address[1]}\r\n\r\n").encode()
                )
                drawn(other, 20)
                drawn(opened, frames(opened) + 20)
            opened.locator("#of-tab-control").click()
            opened.select_option("#key", "observers.strut.proportional_n_per_m")
            opened.fill("#value", "-1")
            opened.click("#change button")
            until(
                opened,
                "document.getElementById('answer').textContent.includes('expected 0 or more')",
            )
            opened.fill("#value", "5e4")
            opened.click("#change button")
            until(opened, "document.getElementById('answer').textContent.startsWith('Changed')")
            said = opened.locator("#answer").inner_text()
            assert process.wait(120) in (0, 1)  # 1: a tick was missed
            until(opened, "runs[0].state !== 'live'")
        ((t_ns, assignments),) = read_changes(live)
        assert said == f"Changed from {t_ns * 1e-9:.3f} s on."
        assert assignments == {"observers.strut.proportional_n_per_m": 50_000}
        assert replay(live).different == 0
    finally:
        if process.poll() is None:
            process.terminate()
            process.wait()


@pytest.mark.long
def test_a_button_diagnoses_a_finished_run(made, tmp_path):
    run = make_run(tmp_path / "bench", 3000)
    with serving(run, token="secret") as one, page(made, one, path="#secret") as opened:
        drawn(opened)
        until(opened, "!document.getElementById('diagnosis').hidden")
        opened.locator("#of-tab-diagnosis").click()
        opened.get_by_role("button", name="Diagnose").click()
        until(opened, "!document.getElementById('progress-of').hidden")
        assert opened.get_by_role("button", name="Cancel").is_visible()
        until(opened, "!document.getElementById('report-of').hidden")
        found = json.loads((tmp_path / "bench-diagnosis/diagnosis.json").read_text())
        said = found["verdict"].replace("_", " ")
        assert opened.locator("#outcome").inner_text() == f"Verdict: {said}."
        with opened.context.expect_page() as popped:
            opened.get_by_role("link", name="Open the report").click()
        report_page, errors = popped.value, []
        report_page.wait_for_load_state()
        report_page.on("pageerror", lambda error: errors.append(str(error)))
        report_page.on(
            "console", lambda said: errors.append(said.text) if said.type == "error" else None
        )
        report_page.reload()
        assert report_page.locator("#finding").is_visible()
        until(report_page, "document.querySelectorAll('canvas').length > 3")
        assert report_page.evaluate("origin") == "null"  # it reads nothing of the page
        assert errors == []
    # Whoever may only look sees what was found.
    with serving(run) as one, page(made, one) as opened:
        drawn(opened)
        opened.locator("#of-tab-diagnosis").click()
        until(opened, "!document.getElementById('report-of').hidden")
        assert not opened.get_by_role("button", name="Diagnose").is_visible()
    with serving(run, token="secret") as one, page(made, one, path="#secret") as opened:
        until(opened, "!document.getElementById('report-of').hidden")
        found = axe.Axe().run(opened).response["violations"]
        assert [item["id"] for item in found if item["impact"] in ("serious", "critical")] == []
