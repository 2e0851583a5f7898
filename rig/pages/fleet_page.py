"""Page of a store of many runs: changes and drifts, with the series that show them."""

from datetime import date
from pathlib import Path

from rig.files.pictures import AutoDateLocator, ConciseDateFormatter, new_figure
from rig.fleet.overview import Overview, Series
from rig.fleet.sentences import alarm_sentences, power_rows, series_name
from rig.pages.html import render_report, svg_url, write_page

_MOST = 12
"""Series that are drawn, the most certain first."""

_OTHERS_DRAWN = 60
"""Other dampers that are drawn for comparison."""

_COLOUR, _CHANGED, _OTHERS = "#0072b2", "#d55e00", "#c8ced6"


def write_fleet_page(overview: Overview, path: Path) -> None:
    """Write the page.

    Raises:
        InputError: The file cannot be written.
    """
    verdicts = sorted({verdict for counts in overview.verdicts.values() for verdict in counts})
    drawn = [item for item in overview.series if item.is_change]
    drawn.sort(key=lambda item: item.change.p if item.change else 1.0)
    drawn += [item for item in overview.series if item.is_drift]
    text = render_report(
        "fleet.html",
        alarms=alarm_sentences(overview),
        verdicts=verdicts,
        overview=overview,
        powers=power_rows(overview),
        pictures=[(series_name(item), _picture(overview, item)) for item in drawn[:_MOST]],
        left_out=max(0, len(drawn) - _MOST),
    )
    write_page(text, path)


def _picture(overview: Overview, item: Series) -> str:
    """A series and those of the other dampers, as an SVG in a data URL."""
    style = {"axes.grid": True, "grid.alpha": 0.3, "svg.hashsalt": "rig", "font.size": 9}
    with new_figure((9.0, 2.8), style) as figure:
        axes = figure.subplots()
        others = [s for s in overview.series if s.quantity == item.quantity and s is not item]
        others = others[:: -(-len(others) // _OTHERS_DRAWN)] if others else []
        for k, other in enumerate(others):
            label = "others" if k == 0 else None
            axes.plot(*_columns(other), color=_OTHERS, linewidth=0.7, zorder=1, label=label)
        days, values = _columns(item)
        label = "damper " + item.where.damper.replace("$", r"\$")
        axes.plot(days, values, "o-", color=_COLOUR, markersize=3, linewidth=1, label=label)
        change = item.change
        if item.is_change and change is not None:
            low, day, high = map(_date, (change.low, change.day, change.high))
            axes.axvspan(low, high, color=_CHANGED, alpha=0.15, linewidth=0)
            axes.axvline(day, color=_CHANGED, label=f"{change.kind}, with its 95 % interval")
        locator = AutoDateLocator()
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))
        axes.set_ylabel(item.quantity.parameter)
        axes.legend(fontsize="small", frameon=False, loc="upper left")
        return svg_url(figure)


def _columns(item: Series) -> tuple[list[date], list[float]]:
    return [_date(point.day) for point in item.points], [point.value for point in item.points]


def _date(day: float) -> date:
    return date.fromordinal(round(day))
