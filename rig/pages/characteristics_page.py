"""The damper sheet: verdict, finding, plots and properties on one A4 page, methods on the next."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rig.diagnosis.outcome import Estimate
from rig.dyno.characterise import Characteristics
from rig.dyno.comparison import Difference, compare_dampers
from rig.dyno.report import DamperReport
from rig.dyno.stroke_force import Figure
from rig.dyno.tolerance import PointVerdict
from rig.pages.damper_pictures import VERDICT_MARKS, draw_account, draw_damper
from rig.pages.html import render_report, write_page
from rig.pages.identity import identity_rows
from rig.pages.number_formats import (
    capital,
    number,
    plus_minus,
    three_digits,
    value_and_interval,
    with_unit,
)

SIGNS = (
    "Forces are positive when the strut pushes its ends apart: compression damping is positive, "
    "rebound damping negative. Velocity and height are positive in rebound."
)
KIND_WORDS = {
    "warm_up": "warm-up",
    "quasi_static": "quasi-static",
    "velocity_step": "velocity step",
}
"""Name of a kind of step in a sentence."""

_STAMPS = {
    "pass": ("good", "✓", "PASS"),
    "open": ("part", "?", "OPEN"),
    "fail": ("bad", "✕", "FAIL"),
}
_ORDER = ("fail", "not measured", "open", "pass")
"""Verdicts by urgency."""

_MOST_POINTS = 16
"""Points beside the plot on one page; those of more urgent verdicts and smaller margins first."""


_MISSING = "–"

_MOST_NAMED = 3
"""Points that a sentence names."""


class PointRow(NamedTuple):
    """A point of the band as a row: its side, verdict with colour and sign, and texts."""

    side: str
    verdict: str
    colour: str
    sign: str
    speed: str
    force: str
    limits: str
    margin: str
    method: str


class PropertyRow(NamedTuple):
    """A property of the damper, of its master, and the difference with its interval."""

    name: str
    value: str
    master: str
    change: str


def write_characteristics_page(
    reports: Sequence[DamperReport], path: Path, labels: Mapping[str, str] | None = None
) -> None:
    """Write the sheet of one record, or of several superimposed, with its labels as identity.

    Raises:
        InputError: The file cannot be written.
    """
    first = reports[0]
    standings = [report.standing for report in reports]
    worst = next((it for it in ("fail", "open", "pass") if it in standings), None)
    build = first.characteristics.build if len(reports) == 1 else dict[str, str]()
    text = render_report(
        "characteristics.html",
        names=[report.characteristics.name for report in reports],
        identity=identity_rows({**build, **(labels or {})}),
        stamp=None if worst is None else _STAMPS[worst],
        findings=[find(report) for report in reports],
        pictures=draw_damper(reports),
        draw_account=draw_account,
        points=_urgent_points(first.points) if len(reports) == 1 else [],
        further_points=max(0, len(first.points) - _MOST_POINTS),
        properties=property_rows(first) if len(reports) == 1 else [],
        has_master=first.master is not None,
        signs=SIGNS,
        reports=reports,
        point_rows=point_rows,
        kinds=KIND_WORDS,
        damper_rows=damper_rows,
        with_half=with_half,
        number=number,
        three_digits=three_digits,
    )
    write_page(text, path)


def find(report: DamperReport) -> str:
    """What a record shows of its damper, as a sentence."""
    comparison = report.against_master
    texts: list[str] = []
    if comparison is not None:
        texts.append(capital(comparison.words()))
    if report.points:
        texts.append(_words_of_points(report.points))
    if not texts:
        texts.append(_forces(report.characteristics))
    if any(it.is_clipped for step in report.characteristics.steps for it in step.strokes):
        texts.append("The load cell was clipped: forces that reach its limit are bounds")
    return "".join(f"{text}. " for text in texts).rstrip()


def _words_of_points(points: Sequence[PointVerdict]) -> str:
    """How many points lie beyond the band or are not proven, and the worst of them."""
    for verdict, words in (
        ("fail", "outside the tolerance"),
        ("not measured", "not measured"),
        ("open", "not proven, since the interval of the force contains a limit"),
    ):
        mine = [point for point in points if point.verdict == verdict]
        if mine:
            count = f"{len(mine)} of {len(points)} points {words}"
            worst = min(mine, key=lambda point: point.margin_n or 0.0)
            if verdict != "fail" or worst.margin_n is None:
                return f"{count}: {', '.join(_place(point) for point in mine[:_MOST_NAMED])}"
            beyond = with_unit(three_digits(-worst.margin_n), "N")
            return f"{count}, {_place(worst)} by {beyond}"
    return f"All {len(points)} points within the tolerance"


def _forces(record: Characteristics) -> str:
    fastest = max(record.steps, key=lambda step: step.peak_speed_m_per_s)
    forces = (
        with_unit(three_digits(figure.value) if figure.is_bounded else with_half(figure), "N")
        for figure in (
            fastest.compression.force_at_peak_velocity_n,
            fastest.rebound.force_at_peak_velocity_n,
        )
    )
    steps = "one step" if len(record.steps) == 1 else f"{len(record.steps)} steps"
    speed = with_unit(three_digits(fastest.peak_speed_m_per_s), "m/s")
    return f"{' in compression and '.join(forces)} in rebound at {speed}, {steps}"


def _place(point: PointVerdict) -> str:
    return f"{point.side} at {with_unit(f'{point.velocity_m_per_s:.3g}', 'm/s')}"


def _urgent_points(points: Sequence[PointVerdict]) -> list[PointRow]:
    """Rows of as many points as a page has room for, the most urgent ones."""
    by_urgency = sorted(points, key=lambda it: (_ORDER.index(it.verdict), it.margin_n or 0.0))
    return point_rows(by_urgency[:_MOST_POINTS])


def point_rows(points: Sequence[PointVerdict]) -> list[PointRow]:
    """Rows of a band's points by side and speed."""
    ordered = sorted(points, key=lambda it: (it.side, it.velocity_m_per_s))
    return [_point_row(point) for point in ordered]


def _point_row(point: PointVerdict) -> PointRow:
    mark, margin_n = VERDICT_MARKS[point.verdict], point.margin_n
    plus = "+" if margin_n is not None and margin_n > 0.0 else ""
    return PointRow(
        point.side,
        point.verdict,
        mark.colour,
        mark.sign,
        f"{point.velocity_m_per_s:.3g}",
        "–" if point.force is None else with_half(point.force),
        f"{number(point.low_n, 0)} to {number(point.high_n, 0)}",
        "–" if margin_n is None else f"{plus}{three_digits(margin_n)}",
        "no step at this speed" if point.force is None else point.force.method,
    )


def property_rows(report: DamperReport) -> list[PropertyRow]:
    """The properties of a damper as a whole; with a master, each against the master's."""
    own = report.characteristics.damper.properties()
    if report.master is None:
        return [
            PropertyRow(name, text_of(figure, unit), "", "") for name, (unit, figure) in own.items()
        ]
    compared = {it.figure: it for it in compare_dampers(report.master, report.characteristics)}
    rows: list[PropertyRow] = []
    for name, (unit, figure) in own.items():
        item = compared.get(name)
        master = "–" if item is None else text_of(item.before, unit)
        change = "–" if item is None else _change_text(item)
        rows.append(PropertyRow(name, text_of(figure, unit), master, change))
    return rows


def _change_text(item: Difference) -> str:
    """A change with its interval, and whether it is significant."""
    text = signed(item.change, item.unit)
    return f"{text}, differs" if item.differs else text


def signed(figure: Figure, unit: str) -> str:
    """A change with its sign, half of its interval and its unit."""
    return f"{'+' if figure.value > 0.0 else ''}{text_of(figure, unit)}"


def damper_rows(item: Characteristics) -> list[tuple[str, str, str, str]]:
    """Figures over all steps and at rest: name, value, interval and method."""
    named = [(name, it, unit) for name, (unit, it) in item.damper.properties().items()]
    named += [
        (f"slope {where} the knee, {side}", figure, "N·s/m")
        for side, both in item.damper.slopes_n_s_per_m.items()
        for where, figure in zip(("below", "above"), both, strict=True)
    ]
    named += [
        (f"change per kelvin, {side}", figure, "N/K")
        for side, figure in item.damper.force_per_kelvin_n_per_k.items()
        if figure is not None
    ]
    named += [
        (f"force at rest, {1e3 * hold.height_m:.1f} mm, at {hold.begin_s:.1f} s", hold.force_n, "N")
        for hold in item.holds
    ]
    return [_row(*of) for of in named]


def _row(name: str, figure: Figure, unit: str) -> tuple[str, str, str, str]:
    estimate = Estimate(figure.value, figure.low, figure.high)
    value, interval = value_and_interval(estimate, unit)
    return name, value, interval, figure.method


def text_of(figure: Figure, unit: str) -> str:
    """A figure with half of its interval and its unit."""
    text = with_half(figure)
    return text if text == _MISSING else with_unit(text, unit)


def with_half(figure: Figure) -> str:
    """A figure with half of its interval, with the digits that the interval justifies.

    A figure with one end is a bound; one without ends is missing.
    """
    if figure.is_bounded:
        return plus_minus(figure.value, figure.half)
    bound = next((end for end in (figure.low, figure.high) if math.isfinite(end)), math.nan)
    if math.isnan(bound):
        return _MISSING
    return f"{'≥' if bound == figure.low else '≤'}\u00a0{three_digits(bound)}"
