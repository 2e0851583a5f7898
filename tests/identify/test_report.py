"""The report: every verdict said in a sentence, no network, nothing executed from a file's name."""

import math
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_model.effects import CATALOGUE
from rig.identify.diagnosis import (
    BeforeAfter,
    Diagnosis,
    Estimate,
    FoundEffect,
    HeldOut,
    NoiseFloor,
    RejectedEffect,
    RunFigures,
    Verdict,
    White,
)
from rig.identify.report import (
    FittedSeries,
    HeldOutSeries,
    Ranked,
    ReportError,
    ReportInput,
    page,
    sentence,
    write_report,
)
from rig.identify.report.quantities import label, quantity, value_and_interval
from rig.identify.report.series import cloud, envelope, spectrum, surface
from rig.identify.report.words import EFFECTS, FAMILIES

FRICTION = FoundEffect(
    "friction",
    "coulomb_friction",
    "strut",
    0.93,
    {
        "coulomb_force_n": Estimate(12.08, 11.83, 12.36),
        "rounding_velocity_m_per_s": Estimate(0.005, 0.004, 0.006),
    },
    11.8,
)
STIFFNESS = FoundEffect(
    "stiffness",
    "linear_stiffness",
    "strut",
    0.9,
    {"stiffness_n_per_m": Estimate(61.0, math.nan, math.nan)},
    4.0,
)
TABLE = FoundEffect(
    "restoring_surface",
    "restoring_surface",
    "strut",
    0.5,
    {p.name: Estimate(1.5, 1.0, 2.0) for p in CATALOGUE["restoring_surface"].parameters},
    4.0,
)
FALLS = BeforeAfter(2.31e-3, 10.4e-6)
RANKING = (
    Ranked("coulomb_friction", "friction", "strut", 0.93, ""),
    Ranked("dahl", "hysteresis", "strut", 0.71, "explains less on held-out blocks"),
    Ranked("delay", "delay", "strut", None, "its best fit explains nothing"),
)


def found(
    verdict: Verdict = "explained",
    effects: tuple[FoundEffect, ...] = (FRICTION,),
    height: BeforeAfter = FALLS,
    ambiguous_with: tuple[str, ...] = (),
    suggested: str | None = None,
    run: str = "sweep.csv",
) -> Diagnosis:
    force = BeforeAfter(11.8, 0.37)
    return Diagnosis(
        verdict=verdict,
        effects=effects,
        rejected=(RejectedEffect("hysteresis", "dahl", "explains less"),),
        ambiguous_with=ambiguous_with,
        suggested_excitation=suggested,
        held_out=HeldOut(height, force, None, (RunFigures("t", height, force, None),), "runs"),
        noise_floor=NoiseFloor(1e-5, 0.33),
        residual_white=White(before=False, after=True),
        sentence="",
        runs=(run,),
        model="seed",
    )


def fitted(count: int = 3000, run: str = "sweep.csv") -> FittedSeries:
    random = np.random.default_rng(7)
    t_s = np.arange(count) * 1e-3
    height = 0.4 + 0.05 * np.sin(2 * np.pi * 1.3 * t_s)
    velocity = 0.05 * 2 * np.pi * 1.3 * np.cos(2 * np.pi * 1.3 * t_s)
    noise = random.normal(0.0, 0.3, count)
    return FittedSeries(
        run, "strut", t_s, height, velocity, noise - 12.0 * np.sign(velocity), noise,
        np.full(count, 0.3),
    )  # fmt: skip


def held_out(count: int = 3000, run: str = "test.csv") -> HeldOutSeries:
    random = np.random.default_rng(8)
    t_s = np.arange(count) * 1e-3
    height = 0.4 + 0.05 * np.sin(2 * np.pi * 1.3 * t_s)
    measured = height + random.normal(0.0, 1e-5, count)
    measured[100:120] = np.nan
    return HeldOutSeries(run, "strut", t_s, measured, height + 2e-3, height)


def report(diagnosis: Diagnosis | None = None, **changes: object) -> ReportInput:
    whole = ReportInput(diagnosis or found(), (fitted(),), (held_out(),), RANKING)
    return replace(whole, **changes)


class Reader(HTMLParser):
    """What a browser would load or execute, and the text it would show."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.tags: list[str] = []
        self.scripts: list[str] = []
        self.shown: list[str] = []
        self.heading = ""
        self._inside = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs) -> None:
        self.tags.append(tag)
        self._inside = tag
        self.loaded += [
            value or "" for name, value in attrs if name in {"src", "href", "srcset", "action"}
        ]
        if tag == "script":
            self.scripts.append(dict(attrs).get("type") or "code")

    def handle_endtag(self, tag) -> None:
        del tag
        self._inside = ""

    def handle_data(self, data) -> None:
        if self._inside in {"script", "style"}:
            return
        self.shown.append(data)
        if self._inside == "h1":
            self.heading += data


@pytest.mark.parametrize(
    ("diagnosis", "said"),
    [
        (
            found("nothing_missing", (), BeforeAfter(1e-5, 1e-5)),
            ["Nothing is missing", "10.0 µm on held-out data", "at the noise floor"],
        ),
        (
            found(),
            [
                "dry friction (Coulomb)",
                "Coulomb force 12.08 N",
                "95 % interval 11.83 to 12.36 N",
                "falls from 2.31 mm to 10.4 µm",
                "at the noise floor of 10.0 µm",
            ],
        ),
        (
            found("partly_explained", height=BeforeAfter(2.31e-3, 1e-4)),
            ["dry friction", "something more that is not explained", "10 times the noise floor"],
        ),
        (
            found(
                "ambiguous", (STIFFNESS,), FALLS, ("damping", "inertia"), "A run with two sines."
            ),
            [
                "linear stiffness, stiffness 61.0 N/m",
                "not bounded by the data",
                "or else another damping or another inertia",
                "cannot tell them apart (what would tell: a run with two sines)",
                "2.31 mm to 10.4 µm",
            ],
        ),
        (
            found("not_explained", (), BeforeAfter(2.31e-3, 2.31e-3)),
            ["no law in the catalogue describes", "2.31 mm", "230 times the noise floor"],
        ),
        (
            found("not_explained", (TABLE,), BeforeAfter(2.31e-3, 1e-3)),
            ["a table of force over height and velocity, which names no cause", "to 1.00 mm"],
        ),
    ],
)
def test_every_verdict_is_one_sentence_with_its_figures(
    diagnosis: Diagnosis, said: list[str]
) -> None:
    heading = Reader(page(report(diagnosis))).heading
    for words in said:
        assert words in heading.replace("\u00a0", " ")
    assert heading == sentence(diagnosis, 1)
    assert heading.endswith(".")
    assert ". " not in heading


def test_a_strut_is_named_where_there_are_several() -> None:
    assert "strut “strut”" not in sentence(found(), 1)
    assert "in strut “strut”" in sentence(found(), 2)


def test_an_imposed_motion_is_judged_by_its_force() -> None:
    unknown = BeforeAfter(math.nan, math.nan)
    text = sentence(found(height=unknown), 1).replace("\u00a0", " ")
    assert "residual force on held-out data falls from 11.8 N to 0.370 N" in text


def test_page_has_every_part() -> None:
    reader = Reader(page(report(found(ambiguous_with=("damping",), suggested="two sines"))))
    shown = " ".join(" ".join(reader.shown).split())
    for part in (
        "Before and after, on held-out data",
        "Noise floor",
        "Parameters",
        "sliding friction",
        "Armstrong-Hélouvry",
        "What else it could be",
        "two sines",
        "The model running alone".lower(),
        "What force is missing",
        "Restoring-force surface",
        "Ranking of all candidates",
        "explains less on held-out blocks",
        "its best fit explains nothing",
        "What was assumed",
    ):
        assert part.lower() in shown.lower()


def test_page_loads_nothing_and_forbids_it() -> None:
    text = page(report())
    reader = Reader(text)
    assert reader.loaded == []
    assert not {"link", "img", "iframe", "object", "embed", "base"} & set(reader.tags)
    assert "default-src 'none'" in text.split("<title>")[0]
    assert "@import" not in text.split("</style>")[0]


HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'.csv"


def test_names_from_files_are_never_markup() -> None:
    series = (fitted(run=HOSTILE), fitted(run=HOSTILE))
    tests = (held_out(run=HOSTILE), held_out(run="other"))
    ranking = (Ranked("dahl", "hysteresis", HOSTILE, 0.1, HOSTILE),)
    diagnosis = replace(found(run=HOSTILE), model=HOSTILE, suggested_excitation=HOSTILE)
    hostile = report(
        diagnosis, fitted=series, held_out=tests, ranking=ranking, assumptions=(HOSTILE,)
    )
    reader = Reader(page(hostile))
    plain = Reader(page(report(fitted=(fitted(), fitted()), held_out=(held_out(), held_out()))))
    assert reader.scripts == plain.scripts
    assert "img" not in reader.tags
    assert HOSTILE in "".join(reader.shown)


def test_page_is_the_same_for_the_same_input(tmp_path: Path) -> None:
    write_report(report(), tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text("utf-8") == page(report())
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_ten_minutes_at_1_khz_stay_below_8_mb() -> None:
    text = page(report(fitted=(fitted(600_000),), held_out=(held_out(600_000),)))
    assert len(text.encode("utf-8")) < 8_000_000


@pytest.mark.parametrize(
    ("series", "said"),
    [
        (replace(fitted(), height_m=np.zeros(3)), r"'sweep.csv', strut 'strut': height_m: shape"),
        (replace(fitted(), t_s=np.zeros(3000)), "t_s: expected times that increase"),
        (replace(fitted(), t_s=np.zeros(1)), "t_s: shape"),
    ],
)
def test_series_that_do_not_fit_together_are_refused(series: FittedSeries, said: str) -> None:
    with pytest.raises(ReportError, match=said):
        page(report(fitted=(series,)))


def test_a_report_without_series_or_ranking_still_says_what_was_found() -> None:
    text = page(report(fitted=(), held_out=(), ranking=()))
    assert "dry friction" in Reader(text).heading
    assert "explains less" in text


def test_runs_without_motion_or_samples_give_a_page() -> None:
    still = np.full(30, 0.4)
    nothing = np.full(30, np.nan)
    t_s = np.arange(30) * 1e-3
    rest = FittedSeries("rest", "strut", t_s, still, 0 * still, nothing, nothing, nothing)
    page(
        report(fitted=(rest,), held_out=(HeldOutSeries("x", "strut", t_s, nothing, still, still),))
    )


def test_every_effect_and_family_has_words() -> None:
    assert set(EFFECTS) == set(CATALOGUE)
    assert set(FAMILIES) == {law.family for law in CATALOGUE.values()} - {"none"}


@pytest.mark.parametrize("law", CATALOGUE.values(), ids=lambda law: law.name)
def test_every_law_can_be_reported(law) -> None:
    values = {p.name: Estimate(1.0, 0.9, 1.1) for p in law.parameters}
    item = FoundEffect(law.family, law.name, "strut", 0.9, values, 1.0)
    text = sentence(found(effects=(item,)), 1)
    assert EFFECTS[law.name] in text
    for parameter in law.parameters:
        assert "_" not in label(parameter)
        assert label(parameter)


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.0123456, "m", "12.3 mm"),
        (1.04e-5, "m", "10.4 µm"),
        (0.0, "m", "0 m"),
        (2.51e-4, "s", "251 µs"),
        (-52340.0, "N/m", "−52\u202f300 N/m"),
        (1.5, "", "1.50"),
        (math.nan, "N", "–"),
        (1e-6, "N", "1.00e−06 N"),
    ],
)
def test_quantities_are_written_as_engineers_do(value: float, unit: str, text: str) -> None:
    assert quantity(value, unit).replace("\u00a0", " ") == text


def test_a_value_has_the_digits_that_its_interval_allows() -> None:
    value, interval = value_and_interval(Estimate(0.262134, 0.26195, 0.2623), "m")
    assert value.replace("\u00a0", " ") == "262.13 mm"
    assert interval.replace("\u00a0", " ") == "261.95 to 262.30 mm"


def test_a_value_far_smaller_than_its_interval_is_not_shown_as_zero() -> None:
    value, interval = value_and_interval(Estimate(0.0189, 0.0017, 0.2101), "m/s")
    assert value.replace("\u00a0", " ") == "0.019 m/s"
    assert interval.replace("\u00a0", " ") == "0.002 to 0.210 m/s"


@given(
    st.lists(st.floats(-1e6, 1e6) | st.just(math.nan), min_size=1, max_size=400),
    st.integers(4, 50),
)
def test_an_envelope_keeps_ends_extremes_and_order(values: list[float], limit: int) -> None:
    array = np.array(values)
    kept = envelope(array, limit)
    assert len(kept) <= limit + 2
    assert np.all(np.diff(kept) > 0)
    assert kept[0] == 0
    assert kept[-1] == len(array) - 1
    if np.any(np.isfinite(array)):
        assert np.nanmax(array[kept]) == np.nanmax(array)
        assert np.nanmin(array[kept]) == np.nanmin(array)


def test_a_cloud_keeps_extremes_of_every_column() -> None:
    random = np.random.default_rng(1)
    against, values = random.normal(size=20_000), random.normal(size=(20_000, 2))
    kept = cloud(against, values, 1000)
    assert len(kept) <= 1100
    for column in values.T:
        assert column[kept].max() == column.max()
        assert column[kept].min() == column.min()


def test_a_spectrum_has_the_power_of_its_residual() -> None:
    t_s = np.arange(20_000) * 1e-3
    tone = 3.0 * np.sin(2 * np.pi * 20.0 * t_s)
    random = np.random.default_rng(2)
    noise = random.normal(0.0, 0.5, len(t_s))
    zero = np.zeros(len(t_s))
    density = spectrum((FittedSeries("r", "s", t_s, zero, zero, tone, noise, zero),))
    assert density is not None
    width = density.frequency_hz[1] - density.frequency_hz[0]
    peak = density.frequency_hz[np.argmax(density.before_n_per_sqrt_hz)]
    assert peak == pytest.approx(20.0, abs=width)
    assert np.sum(density.before_n_per_sqrt_hz**2) * width == pytest.approx(4.5, rel=0.02)
    assert np.sum(density.after_n_per_sqrt_hz**2) * width == pytest.approx(0.25, rel=0.05)


def test_a_surface_is_empty_where_there_are_too_few_samples() -> None:
    series = fitted()
    found_surface = surface((series,))
    assert found_surface is not None
    few = found_surface.samples < found_surface.least_count
    assert np.all(np.isnan(found_surface.before_n[few]))
    assert np.all(np.isfinite(found_surface.before_n[~few]))
    assert found_surface.samples.sum() == len(series.t_s)
    # Friction pulls together while the bodies part.
    rising = found_surface.velocity_m_per_s > 0.1
    assert np.nanmax(found_surface.before_n[rising]) < -10.0
