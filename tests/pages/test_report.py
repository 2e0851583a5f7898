"""The report: every verdict said in a sentence, no network, nothing executed from a file's name."""

import math
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.errors import InputError
from dart_model.effects import CATALOGUE, FAMILY_WORDS
from dart_model.spec import MODELS, load_model
from rig.diagnosis.outcome import (
    ActingRange,
    DamperForce,
    Diagnosis,
    Estimate,
    ExistingEffect,
    FittedSeries,
    FoundEffect,
    HeldOut,
    HeldOutSeries,
    LinearCorrection,
    ModelErrors,
    NoiseFloor,
    RejectedEffect,
    Result,
    RunFigures,
    Verdict,
    White,
)
from rig.diagnosis.recording_bounds import (
    DelayBound,
    Determinable,
    FamilyBound,
    LinearBound,
    RecordingFacts,
)
from rig.pages.number_formats import label, quantity, value_and_interval
from rig.pages.report import page, sentence, write_report
from rig.pages.report.series import cloud, envelope, spectrum, surface
from rig.pages.report.words import BLOCKS, acting_words

FRICTION = FoundEffect(
    "friction",
    "coulomb_friction",
    "strut",
    0.93,
    11.8,
    {
        "coulomb_force_n": Estimate(12.08, 11.83, 12.36),
        "rounding_velocity_m_per_s": Estimate(0.005, 0.004, 0.006),
    },
)
STIFFNESS = FoundEffect(
    "stiffness",
    "linear_stiffness",
    "strut",
    0.9,
    4.0,
    {"stiffness_n_per_m": Estimate(-117.0, None, None)},
)
TABLE = FoundEffect(
    "restoring_surface",
    "restoring_surface",
    "strut",
    0.5,
    4.0,
    {p.name: Estimate(1.5, 1.0, 2.0) for p in CATALOGUE["restoring_surface"].parameters},
)
SOFTER = LinearCorrection("strut", "stiffness_n_per_m", 900.0, Estimate(783.0, 771.0, 795.0), 0.38)
PRELOAD = LinearCorrection("strut", "preload_n", 0.0, Estimate(12.3, 11.9, 12.7), 0.38)
DAMPING = LinearCorrection("strut", "damping_n_s_per_m", 20.0, Estimate(23.1, None, None), None)
MASS = LinearCorrection("strut", "mass_kg", 10.0, Estimate(9.55, 9.5, 9.6), None)
GAIN = LinearCorrection("strut", "input_gain", 1.0, Estimate(1.05, 1.04, 1.06), None)
FALLS = ModelErrors(2.31e-3, 2.31e-3, 10.4e-6, math.nan)
REJECTED = (
    RejectedEffect("hysteresis", "dahl", "strut", "explains less on held-out blocks", 0.29),
    RejectedEffect("delay", "delay", "strut", "the motion cannot show it", None),
)


def found(
    verdict: Verdict = "explained",
    effects: tuple[FoundEffect, ...] = (FRICTION,),
    height: ModelErrors = FALLS,
    ambiguous_with: tuple[str, ...] = (),
    suggested: str | None = None,
    run: str = "sweep.csv",
    linear: tuple[LinearCorrection, ...] = (),
) -> Diagnosis:
    force = ModelErrors(11.8, 11.8, 0.37, math.nan)
    return Diagnosis(
        verdict=verdict,
        linear=linear,
        effects=effects,
        existing=(),
        rejected=REJECTED,
        ambiguous_with=ambiguous_with,
        suggested_excitation=suggested,
        held_out=HeldOut(height, force, None, (RunFigures("t", height, force, None),), "runs"),
        noise_floor=NoiseFloor(1e-5, 0.33),
        residual_white=White(before=False, after=True),
        notes=(),
        runs=(run,),
        model="reference case",
    )


def fitted(count: int = 3000, run: str = "sweep.csv") -> FittedSeries:
    random = np.random.default_rng(7)
    t_s = np.arange(count) * 1e-3
    height = 0.4 + 0.05 * np.sin(2 * np.pi * 1.3 * t_s)
    velocity = 0.05 * 2 * np.pi * 1.3 * np.cos(2 * np.pi * 1.3 * t_s)
    noise = random.normal(0.0, 0.3, count)
    return FittedSeries(
        run, "strut", t_s, height, velocity, noise - 12.0 * np.sign(velocity), noise,
        np.full(count, 0.3), -100.0 * velocity, -100.0 * velocity - 12.0 * np.sign(velocity),
    )  # fmt: skip


def held_out(count: int = 3000, run: str = "test.csv", unit: str = "m") -> HeldOutSeries:
    random = np.random.default_rng(8)
    t_s = np.arange(count) * 1e-3
    height = 0.4 + 0.05 * np.sin(2 * np.pi * 1.3 * t_s)
    velocity = 0.05 * 2 * np.pi * 1.3 * np.cos(2 * np.pi * 1.3 * t_s)
    measured = height + random.normal(0.0, 1e-5, count)
    measured[100:120] = np.nan
    return HeldOutSeries(run, "strut", unit, t_s, measured, height + 2e-3, height, height, velocity)


CORRECTED = load_model(MODELS / "reference.yaml")


def report(diagnosis: Diagnosis | None = None, **changes: object) -> Result:
    whole = Result(diagnosis or found(), CORRECTED, (fitted(),), (held_out(),))
    return replace(whole, **changes)


def shown(result: Result) -> str:
    return " ".join(" ".join(Reader(page(result)).shown).split())


class Reader(HTMLParser):
    """What a browser would load or execute, and the text it would show."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.tags: list[str] = []
        self.scripts: list[str] = []
        self.shown: list[str] = []
        self.heading = ""
        self.finding = ""
        self._inside = ""
        self._id = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs) -> None:
        self.tags.append(tag)
        self._inside, self._id = tag, dict(attrs).get("id") or ""
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
        if self._inside and self._id == "finding":
            self.finding += data


@pytest.mark.parametrize(
    ("diagnosis", "said"),
    [
        (
            found("nothing_missing", (), ModelErrors(1e-5, 1e-5, 1e-5, math.nan)),
            ["Nothing is missing", "on held-out data is 10.0 µm", "at the noise floor"],
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
            found("partly_explained", height=ModelErrors(2.31e-3, 2.31e-3, 1e-4, math.nan)),
            ["dry friction", "a part of the residual is not explained", "10 times the noise floor"],
        ),
        (
            found(
                "ambiguous", (STIFFNESS,), FALLS, ("damping", "inertia"), "A run with two sines."
            ),
            [
                "linear stiffness, stiffness −117 N/m",
                "not identifiable from these data",
                "or else a different damping or a different inertia",
                "do not distinguish them (to distinguish them: a run with two sines)",
                "2.31 mm to 10.4 µm",
            ],
        ),
        (
            found("not_explained", (), ModelErrors(2.31e-3, 2.31e-3, 2.31e-3, math.nan)),
            ["no law in the catalogue describes", "2.31 mm", "230 times the noise floor"],
        ),
        (
            found("not_explained", (TABLE,), ModelErrors(2.31e-3, 2.31e-3, 1e-3, math.nan)),
            [
                "a table of force over height and velocity, which names no cause, is offered",
                "to 1.00 mm",
            ],
        ),
        (
            found("explained", (STIFFNESS,), linear=(SOFTER,)),
            [
                "The model's linear part is off: stiffness 13 % below the given model's, 783 N/m "
                "(95 % interval 771 to 795 N/m); nothing is missing: with this correction the RMS",
                "falls from 2.31 mm to 10.4 µm",
            ],
        ),
        (
            found("explained", (FRICTION,), linear=(SOFTER, PRELOAD)),
            [
                "The model lacks dry friction (Coulomb)",
                "in addition to linear corrections (stiffness 13 % below the given model's, "
                "preload 12.3 N above",
                "with these corrections the RMS free-run height error",
            ],
        ),
    ],
)
def test_every_verdict_is_one_sentence_with_its_figures(
    diagnosis: Diagnosis, said: list[str]
) -> None:
    heading = Reader(page(report(diagnosis))).finding
    for words in said:
        assert words in heading.replace("\u00a0", " ")
    assert heading == sentence(diagnosis, 1)
    assert heading.endswith(".")
    assert ". " not in heading


def test_a_strut_is_named_where_there_are_several() -> None:
    assert "strut “strut”" not in sentence(found(), 1)
    assert "in strut “strut”" in sentence(found(), 2)


def test_a_prescribed_motion_is_judged_by_its_force() -> None:
    unknown = ModelErrors(math.nan, math.nan, math.nan, math.nan)
    text = sentence(found(height=unknown), 1).replace("\u00a0", " ")
    assert "residual force on held-out data falls from 11.8 N to 0.370 N" in text


def test_page_has_every_part() -> None:
    text = shown(report(found(ambiguous_with=("damping",), suggested="two sines")))
    for part in (
        "Before and after, on held-out data",
        "Noise floor",
        "Missing effects",
        "sliding friction",
        "Armstrong-Hélouvry",
        "What else it could be",
        "two sines",
        "Held-out data: free-run simulation",
        "Residual force",
        "Restoring-force surface",
        "Ranking of the rejected candidates",
        "explains less on held-out blocks",
        "the motion cannot show it",
        "Assumptions",
        "With the nominal model, the residual is not white by the test; "
        "with the corrected model, the residual is white by the test.",
    ):
        assert part.lower() in text.lower()
    assert "Linear part" not in text
    assert "Notes" not in text
    assert BLOCKS not in text


def test_linear_corrections_stand_apart_from_what_is_missing() -> None:
    corrections = (SOFTER, PRELOAD, DAMPING, MASS, GAIN)
    text = shown(report(found(linear=corrections))).replace("\u00a0", " ")
    linear, missing = text.split("Linear part", 1)[1].split("Missing effects", 1)
    for part in (
        "stiffness about mid-stroke (380.0 mm)",
        "900 N/m 783 N/m 771 to 795 N/m 13 % below the given model's",
        "preload about mid-stroke (380.0 mm)",
        "0 N 12.30 N 11.90 to 12.70 N 12.3 N above the given model's",
        "damping damping_n_s_per_m 20.0 N·s/m 23.1 N·s/m not identifiable from these data "
        "16 % above",
        "9.500 to 9.600 kg 4.5 % below the given model's",
        "input gain",
        "1.040 to 1.060 5.0 % above the given model's",
    ):
        assert part in linear
    assert "dry friction" not in linear
    assert "dry friction" in missing.split("What else")[0].lower()


def test_a_linear_correction_is_not_listed_as_missing_too() -> None:
    text = shown(report(found("explained", (STIFFNESS,), linear=(SOFTER,))))
    assert "Linear part" in text
    assert "Missing effects" not in text
    elsewhere = replace(SOFTER, strut="other")
    text = shown(report(found("explained", (STIFFNESS,), linear=(elsewhere,))))
    assert "Missing effects" in text


def test_effects_of_the_nominal_model_that_the_data_change_are_listed() -> None:
    existing = (
        ExistingEffect(
            "coulomb_friction",
            "strut",
            "refitted",
            {"coulomb_force_n": 10.0},
            {"coulomb_force_n": Estimate(12.08, 11.83, 12.36)},
        ),
        ExistingEffect("bump_stop", "strut", "superfluous", {"contact_height_m": 0.3}, {}),
    )
    diagnosis = replace(found(effects=()), existing=existing)
    text = shown(report(diagnosis)).replace("\u00a0", " ")
    listed = text.split("Effects of the nominal model that the data change")[1]
    assert "strut strut, refitted" in listed
    assert "10.0 N 12.08 N 11.83 to 12.36 N" in listed
    assert "superfluous on these data: without it" in listed
    said = sentence(diagnosis, 1)
    assert "effect “coulomb_friction” is refitted; its effect “bump_stop” is superfluous" in said
    assert "changes of its effects (“coulomb_friction” refitted" in sentence(
        replace(found(), existing=existing), 1
    )


def test_notes_are_shown_as_they_are() -> None:
    note = "The data cannot separate mass and stiffness."
    text = shown(report(replace(found(), notes=(note,))))
    assert f"Notes {note}" in text


def test_the_picture_of_an_ambiguous_result_is_one_law_among_others() -> None:
    text = " ".join(shown(report(found(ambiguous_with=("friction", "stop")))).split())
    said = "The correction is that of the law named first; friction or an end stop describes"
    assert said in text
    assert "named first" not in shown(report())


def test_a_damper_is_stated_in_figures() -> None:
    figures = DamperForce("s", -0.3, Estimate(31.2, 30.1, 32.3), Estimate(60.4, 58.9, 61.9))
    text = shown(report(replace(found(), damper=(figures,))))
    for part in ("Compression 0.3 m/s", "31.2 N", "30.1 to 32.3 N", "60.4 N·s/m"):
        assert part in text
    assert "Damper of the corrected model" not in shown(report())


def test_held_out_blocks_are_named_as_such() -> None:
    diagnosis = found()
    blocks = replace(diagnosis, held_out=replace(diagnosis.held_out, source="blocks"))
    assert f"Held out {BLOCKS}" in shown(report(blocks))


@pytest.mark.parametrize(("count", "folded"), [(8, 0), (9, 1), (30, 22)])
def test_the_ranking_shows_eight_candidates_and_folds_the_rest(count: int, folded: int) -> None:
    names = [name for name in CATALOGUE if name != "none"][:count]
    rejected = tuple(
        RejectedEffect("x", name, "strut", f"reason {index}", 0.5)
        for index, name in enumerate(names)
    )
    text = page(report(replace(found(), rejected=rejected)))
    ranking = text[text.index("<h2>Ranking of the rejected candidates</h2>") :]
    open_part, more, closed = ranking.partition(f"<details><summary>{folded} more</summary>")
    assert bool(more) == bool(folded)
    assert sum(f"reason {index}<" in open_part for index in range(count)) == count - folded
    assert sum(f"reason {index}<" in closed for index in range(count)) == folded


def test_held_out_forces_are_shown_along_the_prescribed_motion() -> None:
    force = ModelErrors(11.8, 11.8, 0.37, math.nan)
    unknown = ModelErrors(math.nan, math.nan, math.nan, math.nan)
    runs = tuple(RunFigures(name, unknown, force, force) for name in ("a", "b"))
    diagnosis = replace(found(), held_out=HeldOut(unknown, force, force, runs, "runs"))
    text = shown(report(diagnosis, held_out=(held_out(unit="N"), held_out(unit="N"))))
    assert "Held-out data: force along the prescribed motion" in text
    assert "Strut force against the load cell, motion prescribed" in text
    assert "Height, free" not in text
    assert "the measured inputs alone" not in text


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
    diagnosis = replace(
        found(run=HOSTILE),
        model=HOSTILE,
        suggested_excitation=HOSTILE,
        rejected=(RejectedEffect("hysteresis", "dahl", HOSTILE, HOSTILE, 0.1),),
        linear=(replace(SOFTER, strut=HOSTILE),),
        notes=(HOSTILE,),
    )
    reader = Reader(page(report(diagnosis, fitted=series, held_out=tests)))
    plain = Reader(page(report(fitted=(fitted(), fitted()), held_out=(held_out(), held_out()))))
    assert reader.scripts == plain.scripts
    assert "img" not in reader.tags
    assert HOSTILE in "".join(reader.shown)


def test_page_is_the_same_for_the_same_input(tmp_path: Path) -> None:
    write_report(report(), tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text("utf-8") == page(report())
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_a_file_that_cannot_be_written_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent/report.html: cannot be written"):
        write_report(report(), tmp_path / "absent" / "report.html")


def test_ten_minutes_at_1_khz_stay_below_1_5_mb() -> None:
    text = page(report(fitted=(fitted(600_000),), held_out=(held_out(600_000),)))
    assert len(text.encode("utf-8")) < 1_500_000


@pytest.mark.parametrize(
    ("series", "said"),
    [
        (
            replace(fitted(), height_m=np.zeros(3)),
            r"'sweep.csv', strut 'strut': height_m: expected an array",
        ),
        (replace(fitted(), t_s=np.zeros(3000)), "t_s: expected two or more times"),
        (replace(fitted(), t_s=np.zeros(1)), "t_s: expected two or more"),
    ],
)
def test_series_that_do_not_fit_together_are_refused(series: FittedSeries, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        page(report(fitted=(series,)))


def test_a_report_without_series_or_ranking_still_says_what_was_found() -> None:
    text = page(report(replace(found(), rejected=()), fitted=(), held_out=()))
    assert Reader(text).heading == "Dry friction (Coulomb) missing"
    assert "No candidate was rejected" in text


def test_recordings_without_motion_or_samples_give_a_page() -> None:
    still = np.full(30, 0.4)
    nothing = np.full(30, np.nan)
    t_s = np.arange(30) * 1e-3
    rest = FittedSeries("rest", "strut", t_s, still, 0 * still, *[nothing] * 5)
    for unit in ("m", "N"):
        lost = HeldOutSeries("x", "strut", unit, t_s, nothing, still, still, nothing, nothing)
        page(report(fitted=(rest,), held_out=(lost,)))


def test_every_family_has_words() -> None:
    assert set(FAMILY_WORDS) >= {law.family for law in CATALOGUE.values()} - {"none"}


@pytest.mark.parametrize("law", CATALOGUE.values(), ids=lambda law: law.name)
def test_every_law_can_be_reported(law) -> None:
    values = {p.name: Estimate(1.0, 0.9, 1.1) for p in law.parameters}
    item = FoundEffect(law.family, law.name, "strut", 0.9, 1.0, values)
    text = sentence(found(effects=(item,)), 1)
    assert law.words in text
    assert all(key in values for key in law.shown)
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
        (5.87e-4, "N", "0.000587 N"),
        (1e-7, "N", "1.00e−07 N"),
    ],
)
def test_quantities_are_written_as_engineers_do(value: float, unit: str, text: str) -> None:
    assert quantity(value, unit).replace("\u00a0", " ") == text


def test_a_value_has_the_digits_that_its_interval_allows() -> None:
    value, interval = value_and_interval(Estimate(0.262134, 0.26195, 0.2623), "m")
    assert value.replace("\u00a0", " ") == "262.13 mm"
    assert interval.replace("\u00a0", " ") == "261.95 to 262.30 mm"


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [
        (None, None, "not identifiable from these data"),
        (math.nan, math.inf, "not identifiable from these data"),
        (771.0, None, "above 771 N/m, upper end not identifiable from these data"),
        (None, 795.0, "below 795 N/m, lower end not identifiable from these data"),
    ],
)
def test_an_interval_without_an_end_says_so(
    low: float | None, high: float | None, said: str
) -> None:
    value, interval = value_and_interval(Estimate(783.0, low, high), "N/m")
    assert value.replace("\u00a0", " ") == "783 N/m"
    assert interval.replace("\u00a0", " ") == said


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
    density = spectrum((FittedSeries("r", "s", t_s, zero, zero, tone, noise, zero, zero, zero),))
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


STOP = ActingRange(((0.35, 0.358),), ((-0.41, 0.41),), (0.35, 0.45), (-0.41, 0.41))


def test_a_bar_and_a_sentence_show_where_an_effect_acts():
    result = report(found(effects=(replace(FRICTION, where=STOP),)))
    assert (
        "It shows at heights from 350 mm to 358 mm (recorded from 350 mm to 450 mm), and at all "
        "recorded velocities (from −0.410 m/s to 0.410 m/s)"
    ) in shown(result)
    # Friction steps with the velocity, which is the abscissa.
    assert '"acting": [[-0.41, 0.41]]' in page(result)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ((), "no place of its own over the recorded heights"),
        (((0.35, 0.36), (0.44, 0.45)), "from 350 mm to 360 mm and from 440 mm to 450 mm"),
    ],
)
def test_parts_of_the_stroke_are_named(parts, words):
    assert words in " ".join(acting_words(replace(STOP, height_m=parts)).split())


def test_what_the_recordings_determine_is_a_section():
    facts = RecordingFacts(
        "sweep.csv", "strut", 3.0, 1000.0, 0.0, 0.0, 0.35, 0.45, 0.3, 0.3, 0.5, (1.0, 9.0), 1e-5,
        None,
    )  # fmt: skip
    friction = FamilyBound("friction", "strut", 0.2, 0.01, "hysteresis", 4.5, "slow strokes")
    mass = LinearBound("strut", "mass_kg", 10.0, 0.02, 0.5, None)
    late = DelayBound("height_m:strut", 3e-3, 1e-4, 1e-3)
    bounds = Determinable((facts,), (mass,), (friction,), ("fade",), (late,), ("A gap of 1 s.",))
    text = shown(report(determinable=bounds))
    assert "What these recordings can determine" in text
    assert "Friction 0.200 N 1.0 % hysteresis 4.50 N" in text.replace("\N{NO-BREAK SPACE}", " ")
    assert "height_m:strut seems 3.00 ms late" in text.replace("\N{NO-BREAK SPACE}", " ")
    assert "A gap of 1 s." in text
    assert "Fade of the damper: no law acts on these recordings." in text
    assert "What these recordings can determine" not in shown(report())
