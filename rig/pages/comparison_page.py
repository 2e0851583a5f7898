"""The page of a comparison: what differs, what is equal within its interval, what is missing."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rig.dyno.build_notes import differing_notes
from rig.dyno.characterise import Characteristics
from rig.dyno.comparison import Difference, Match, Trend, list_not_comparable, pair_steps
from rig.dyno.report import DamperReport
from rig.pages.characteristics_page import SIGNS, signed, text_of
from rig.pages.damper_pictures import draw_damper
from rig.pages.html import render_report, write_page
from rig.pages.identity import identity_rows
from rig.pages.number_formats import three_digits, with_unit


class Row(NamedTuple):
    """A figure as a row of texts."""

    figure: str
    cells: Sequence[str]


class ComparisonTable(NamedTuple):
    """A table of a comparison, with how many figures it lists in its title."""

    title: str
    heads: Sequence[str]
    rows: Sequence[Row]


def write_comparison_page(
    records: Sequence[Characteristics],
    summary: str,
    tables: Sequence[ComparisonTable],
    path: Path,
    labels: Mapping[str, str],
) -> None:
    """Write the page of two states, or of several over a dose.

    Raises:
        InputError: The file cannot be written.
    """
    text = render_report(
        "comparison.html",
        names=[record.name for record in records],
        identity=identity_rows(labels),
        summary=summary,
        pictures=draw_damper([DamperReport(record) for record in records]),
        tables=[table for table in tables if table.rows],
        missing=list_not_comparable(records),
        notes=notes_on(records),
        signs=SIGNS,
    )
    write_page(text, path)


def notes_on(records: Sequence[Characteristics]) -> list[str]:
    """Notes of their build that differ, and what in the records may mislead, with its record."""
    return [
        *(f"built differently, {text}" for text in differing_notes([it.build for it in records])),
        *(f"{record.name}: {note}" for record in records for note in record.quality),
    ]


def summarise_differences(
    differences: Sequence[Difference], records: Sequence[Characteristics]
) -> str:
    """How many figures differ, are equal within their intervals, and steps have no partner."""
    differing = sum(item.differs for item in differences)
    return (
        f"{_count(differing, 'figure')} {'differs' if differing == 1 else 'differ'}; "
        f"{_count(len(differences) - differing, 'figure')} equal within the interval; "
        f"{_not_comparable(records)}"
    )


def summarise_trends(trends: Sequence[Trend], records: Sequence[Characteristics]) -> str:
    """How many figures change over a dose, do not, and how many steps have no partner."""
    changing = sum(item.differs for item in trends)
    return (
        f"{_count(changing, 'figure')} {'changes' if changing == 1 else 'change'} over the dose; "
        f"{_count(len(trends) - changing, 'figure')} not shown to change; "
        f"{_not_comparable(records)}"
    )


def difference_tables(
    differences: Sequence[Difference], before: str, after: str
) -> tuple[ComparisonTable, ComparisonTable]:
    """What differs, and what is equal within an interval."""
    differing = [item for item in differences if item.differs]
    equal = [item for item in differences if not item.differs]
    return (
        ComparisonTable(
            f"Differs ({len(differing)})",
            ("Figure", before, after, "Difference, 95 % interval"),
            [_row(item, signed(item.change, item.unit)) for item in differing],
        ),
        ComparisonTable(
            f"Equal within the interval ({len(equal)})",
            ("Figure", before, after, "Differs by at most"),
            [_row(item, _most(item)) for item in equal],
        ),
    )


def trend_tables(trends: Sequence[Trend]) -> tuple[ComparisonTable, ComparisonTable]:
    """What changes over the dose, and what is not shown to."""
    changing = [item for item in trends if item.differs]
    steady = [item for item in trends if not item.differs]
    return (
        _trend_table("Changes over the dose", changing),
        _trend_table("Not shown to change", steady),
    )


def match_table(matches: Sequence[Match], left: str, right: str) -> ComparisonTable:
    """How far two dampers are apart at the points of a band, the farthest first."""
    rows = [
        Row(
            f"{item.side} at {with_unit(f'{item.velocity_m_per_s:.3g}', 'm/s')}",
            (
                text_of(item.left, "N"),
                text_of(item.right, "N"),
                signed(item.share.scaled(100.0), "%"),
            ),
        )
        for item in matches
    ]
    largest = max((abs(item.share.value) for item in matches), default=0.0)
    title = f"Match: at most {100.0 * largest:.0f} % of the band apart"
    return ComparisonTable(title, ("Point", left, right, "Difference over the band"), rows)


def _trend_table(title: str, trends: Sequence[Trend]) -> ComparisonTable:
    heads = ("Figure", "Per unit of dose, 95 % interval", "At zero", "Line")
    rows = [
        Row(
            item.figure,
            (
                signed(item.slope, item.unit),
                with_unit(three_digits(item.at_zero), item.unit),
                "straight" if item.is_straight else "bent: no straight line",
            ),
        )
        for item in trends
    ]
    return ComparisonTable(f"{title} ({len(trends)})", heads, rows)


def _row(item: Difference, last: str) -> Row:
    return Row(item.figure, (text_of(item.before, item.unit), text_of(item.after, item.unit), last))


def _most(item: Difference) -> str:
    """The largest difference that the intervals leave possible."""
    return with_unit(three_digits(max(abs(item.change.low), abs(item.change.high))), item.unit)


def _not_comparable(records: Sequence[Characteristics]) -> str:
    """How many steps and forces are not comparable, or that the tests have no step in common."""
    first, *others = records
    shared = [
        all(pair is not None for pair in of)
        for of in zip(*([pair for _, pair in pair_steps(first, it)] for it in others), strict=True)
    ]
    if not any(shared):
        return "the tests share no step"
    missing = len(list_not_comparable(records))
    return f"{_count(missing, 'item')} not comparable" if missing else "every step was compared"


def _count(number: int, what: str) -> str:
    return f"{number or 'no'} {what}{'' if number == 1 else 's'}"
