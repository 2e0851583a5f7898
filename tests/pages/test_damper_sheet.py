"""The damper sheet and the page of a comparison: verdict, finding, properties, identity."""

from dataclasses import replace as with_changes

import numpy as np
import pytest
from typer.testing import CliRunner

from can_dbc.errors import InputError
from rig.cli.main import app
from rig.dyno.characterise import ForceRecord, characterise_record
from rig.dyno.faults import MasterComparison, NamedFault
from rig.dyno.report import DamperReport
from rig.dyno.stroke_force import Figure
from rig.dyno.tolerance import BandPoint, PointVerdict, ToleranceBand, evaluate_band
from rig.pages.characteristics_page import find, property_rows, write_characteristics_page
from rig.pages.comparison_page import summarise_differences
from rig.pages.damper_pictures import RECORD_COLOURS, VERDICT_MARKS
from rig.pages.identity import identity_rows, parse_labels
from tests.dyno.test_characteristics import written
from tests.dyno.test_comparison import columns, state
from tests.pages.test_colours import contrast


def point(verdict, value=100.0, low=80.0, high=120.0):
    force = None if verdict == "not measured" else Figure(value, value - 1.0, value + 1.0, "step")
    return PointVerdict(0.1, "rebound", force, low, high, verdict)


def against(*, is_good=True, named=(), not_compared=()):
    return MasterComparison(tuple(named), is_good, 1.0, tuple(not_compared))


GAS = NamedFault("gas pressure", "relative loss", "", Figure(0.52, 0.4, 0.65, "profile"), 80.0)


@pytest.mark.parametrize(
    ("points", "comparison", "standing"),
    [
        ((), None, None),
        (("pass", "pass"), None, "pass"),
        (("pass", "open"), None, "open"),
        (("pass", "not measured"), None, "open"),
        (("open", "fail"), None, "fail"),
        ((), against(), "pass"),
        ((), against(not_compared=["±25 mm"]), "open"),
        ((), against(is_good=False, named=[GAS]), "fail"),
        ((), against(is_good=False), "fail"),
        (("pass",), against(is_good=False, named=[GAS]), "fail"),
        (("open",), against(), "open"),
    ],
)
def test_a_damper_passes_only_if_everything_does(points, comparison, standing):
    report = DamperReport(state(1), [point(verdict) for verdict in points], comparison)
    assert report.standing == standing


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (GAS, "gas pressure 52 % lost (95 %: 40 to 65 %)"),
        (
            GAS._replace(size=Figure(-0.3, -0.4, -0.2, "profile")),
            "gas pressure 30 % too high (95 %: 20 to 40 %)",
        ),
        (
            NamedFault("seal friction", "increase", "N", Figure(35.2, 30.1, 40.4, "p"), 50.0),
            "seal friction 35 N higher (95 %: 30 to 40 N)",
        ),
        (
            NamedFault("play", "width", "mm", Figure(8.0, 6.0, np.inf, "p"), 50.0),
            "play of at least 8 mm",
        ),
        (
            NamedFault(
                "changed damping in rebound", "relative change at all speeds", "",
                Figure(-0.15, -0.2, -0.1, "p"), 50.0,
            ),
            "changed damping in rebound: 15 % lower (95 %: 10 to 20 %)",
        ),
    ],
)  # fmt: skip
def test_a_fault_is_a_sentence_with_its_interval(fault, words):
    assert fault.words().replace("\u00a0", " ") == words


def test_the_margin_is_the_distance_to_the_nearer_limit():
    assert point("pass", 100.0, 90.0, 200.0).margin_n == pytest.approx(10.0)
    assert point("pass", 195.0, 90.0, 200.0).margin_n == pytest.approx(5.0)
    assert point("fail", 78.0).margin_n == pytest.approx(-2.0)
    assert point("not measured").margin_n is None


def test_the_finding_names_the_worst_point():
    points = [point("pass"), point("fail", 75.0), point("fail", 60.0)]
    assert find(DamperReport(state(1), points)) == (
        "2 of 3 points outside the tolerance, rebound at 0.1\u00a0m/s by 20.0\u00a0N."
    )
    assert find(DamperReport(state(1), [point("pass")])) == "All 1 points within the tolerance."
    assert "in rebound at" in find(DamperReport(state(1)))


def test_properties_stand_beside_the_masters():
    report = DamperReport(state(2, gas_n=160.0), (), against(), state(1))
    rows = {row.name: row for row in property_rows(report)}
    assert rows["gas force"].change.startswith("\u221239.")
    assert rows["gas force"].change.endswith("differs")
    assert "differs" not in rows["friction"].change
    assert {row.master for row in property_rows(DamperReport(state(1)))} == {""}


def test_the_sheet_shows_stamp_master_and_labels(tmp_path):
    band = ToleranceBand(
        name="band",
        points=(
            BandPoint(
                velocity_m_per_s=0.3, compression_low_n=600.0, compression_high_n=700.0,
                rebound_low_n=-100.0, rebound_high_n=-50.0,
            ),
        ),
    )  # fmt: skip
    record = state(1)
    report = DamperReport(record, evaluate_band(record.steps, band), against(), state(3))
    path = tmp_path / "report.html"
    write_characteristics_page([report], path, {"serial": "0815", "operator": "<M. Berg>"})
    text = path.read_text()
    assert "<title>FAIL: state1</title>" in text
    assert "FAIL" in text
    assert "&lt;M. Berg&gt;" in text
    assert text.count('class="blank"') == 3  # damper, date, bench; the signature has its own class
    assert "Not as its master" not in text
    assert len(text) < 1_500_000


def test_the_comparison_counts_what_it_compared(tmp_path):
    same = summarise_differences([], [state(1), state(2)])
    assert (
        same == "no figures differ; no figures equal within the interval; every step was compared"
    )
    slow = with_changes(state(2), steps=state(2).steps[:1])
    fast = with_changes(state(1), steps=state(1).steps[2:])
    assert "the tests share no step" in summarise_differences([], [slow, fast])
    assert "2 items not comparable" in summarise_differences([], [state(1), slow])
    files = [
        str(written(tmp_path / f"{gas}.csv", columns(gas, gas_n=float(gas)))) for gas in (150, 200)
    ]
    out = tmp_path / "out"
    ended = CliRunner().invoke(app, ["compare", *files, "--out", str(out), "--label", "bench=B4"])
    assert ended.exit_code == 0, ended.output
    text = (out / "report.html").read_text()
    assert "Differs (" in text
    assert "Equal within the interval (" in text
    assert "B4" in text
    assert (out / "comparison.json").exists()


@pytest.mark.parametrize("given", ["operator", "=x", "operator=", "a=" + "x" * 300])
def test_a_label_without_name_or_text_is_refused(given):
    with pytest.raises(InputError, match="expected NAME=TEXT"):
        parse_labels([given])


def test_labels_keep_their_order_after_the_usual_rows():
    labels = parse_labels(["order=4711", "serial = 0815 "])
    titles = [row.title for row in identity_rows(labels)]
    assert titles == ["Damper", "Serial number", "Date", "Operator", "Bench", "Order"]
    with pytest.raises(InputError, match="given twice"):
        parse_labels(["a=1", "a=2"])


def test_a_mean_curve_that_leaves_its_samples_is_noted():
    """A knock within a quarter of a millimetre, which no smooth curve follows."""
    t_s, height_m, force_n = columns(1)
    knock_n = 900.0 * np.exp(-(((height_m - 0.312) / 2e-4) ** 2))
    plain, knocked = (
        characterise_record(ForceRecord("r", t_s, height_m, force)).quality
        for force in (force_n, force_n + knock_n)
    )
    assert not any("leaves its samples" in text for text in plain)
    assert any("leaves its samples" in text and "+11.8 mm" in text for text in knocked)


def test_marks_and_records_have_contrast_on_white():
    colours = [mark.colour for mark in VERDICT_MARKS.values()] + list(RECORD_COLOURS)
    for colour in colours:
        assert contrast(colour, "#ffffff") >= 3.0, colour  # of lines and marks (WCAG 2.1, 1.4.11)
    for mark in VERDICT_MARKS.values():
        assert contrast(mark.colour, "#fdeeec") >= 4.5, mark  # of the table's texts
    assert len({mark.marker for mark in VERDICT_MARKS.values()}) == len(VERDICT_MARKS)
