"""The page of a report."""

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from plotly import offline

from rig.identify.diagnosis import write_text
from rig.identify.report import tables
from rig.identify.report.figures import (
    Plot,
    curves,
    held_out_force_plot,
    held_out_plot,
    left_plot,
    residual_plot,
    surface_plot,
)
from rig.identify.report.inputs import (
    FittedSeries,
    HeldOutForce,
    HeldOutSeries,
    ReportInput,
    check_series,
)
from rig.identify.report.words import effect_words, nearest_rival, sentence

_HERE = Path(__file__).parent
_POINTS = 4000
_POINTS_OF_ALL = 24_000
_FEWEST_POINTS = 600

_BADGES = {
    "nothing_missing": ("good", "✓", "Nothing missing"),
    "explained": ("good", "✓", "Explained"),
    "partly_explained": ("part", "◐", "Partly explained"),
    "ambiguous": ("part", "?", "Ambiguous"),
    "not_explained": ("bad", "✕", "Not explained"),
}

_ASSUMPTIONS = (
    "Height is the length of the strut; forces are positive where they push its two bodies apart.",
    "Masses, gravity, free length, spring rate and damping are those of the model as given; the "
    "correction only adds the effects listed under “Parameters”.",
    "Spring, damper and effect act between the same two bodies, so only their sum can be seen: a "
    "share is given to one of them because of the law it follows.",
    "The sensor's noise is not told but estimated from the data, and taken as white; the noise "
    "floor is what it alone would leave.",
    "95 % intervals hold if the law that is named is the right one.",
)

_OF_A_FREE_MOTION = (
    "Held-out data had no part in choosing or fitting; the open-loop height has the applied force "
    "as its only input, so nothing pulls the model back to the measurement.",
)


@dataclass(frozen=True)
class _StrutPlots:
    name: str
    plots: tuple[Plot, ...]


def write_report(report: ReportInput, path: Path) -> None:
    """Write the page as one file that needs no network.

    Args:
        report: What it shows.
        path: File to write; it is replaced at once, never left half written.

    Raises:
        ReportError: `report` does not fit together.
        OSError: The file cannot be written.
    """
    write_text(path, page(report))


def page(report: ReportInput) -> str:
    """The page, the same for the same input.

    Raises:
        ReportError: `report` does not fit together.
    """
    found = report.diagnosis
    for series in (*report.fitted, *report.held_out):
        check_series(series)
    struts = _strut_names(report)
    plotly_script = offline.get_plotlyjs()
    own_script = (_HERE / "page.js").read_text("utf-8")
    tone, sign, badge = _BADGES[found.verdict]
    rival = nearest_rival(report.ranking)
    environment = Environment(
        loader=FileSystemLoader(_HERE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html").render(
        found=found,
        sentence=sentence(found, len(struts)),
        tone=tone,
        sign=sign,
        badge=badge,
        held_out_runs=_names(report.held_out),
        struts=struts,
        errors=tables.errors(found),
        runs=tables.runs(found),
        run_columns=tables.run_columns(found),
        strut_plots=_plots(report, struts),
        effects=tables.effects(found),
        ranking=tables.ranking(report.ranking, found),
        rivals=tables.rivals(found),
        nearest=None if rival is None else effect_words(rival.name),
        nearest_why="" if rival is None else rival.why.rstrip("."),
        assumptions=(*_ASSUMPTIONS, *_of_motion(report), *report.assumptions),
        style=(_HERE / "page.css").read_text("utf-8"),
        plotly_script=plotly_script,
        own_script=own_script,
        script_hashes=(_hash(plotly_script), _hash(own_script)),
    )


def _of_motion(report: ReportInput) -> tuple[str, ...]:
    imposed = any(isinstance(item, HeldOutForce) for item in report.held_out)
    return () if imposed else _OF_A_FREE_MOTION


def _hash(script: str) -> str:
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"


def _names(series: Sequence[FittedSeries | HeldOutSeries | HeldOutForce]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(item.run for item in series))


def _strut_names(report: ReportInput) -> tuple[str, ...]:
    return tuple(dict.fromkeys(item.strut for item in (*report.fitted, *report.held_out)))


def _plots(report: ReportInput, struts: Sequence[str]) -> tuple[_StrutPlots, ...]:
    points = max(min(_POINTS, _POINTS_OF_ALL // max(len(struts), 1)), _FEWEST_POINTS)
    corrected = bool(report.diagnosis.effects)
    shown = curves(corrected=corrected)
    floor = report.diagnosis.noise_floor
    floor_m, floor_n = floor.height_rmse_m, floor.residual_force_rmse_n
    groups: list[_StrutPlots] = []
    for index, strut in enumerate(struts):
        fitted = [item for item in report.fitted if item.strut == strut]
        held_out = [item for item in report.held_out if item.strut == strut]
        heights = [item for item in held_out if isinstance(item, HeldOutSeries)]
        forces = [item for item in held_out if isinstance(item, HeldOutForce)]
        plots: list[Plot | None] = []
        if heights:
            plots.append(held_out_plot(f"held-out-{index}", heights, floor_m, shown, points))
        if forces:
            plots.append(held_out_force_plot(f"held-out-{index}", forces, floor_n, shown, points))
        if fitted:
            plots.append(residual_plot(f"residual-{index}", fitted, shown, points))
            if corrected:
                plots.append(left_plot(f"left-{index}", fitted, points))
            plots.append(surface_plot(f"surface-{index}", fitted, shown))
        groups.append(_StrutPlots(strut, tuple(plot for plot in plots if plot is not None)))
    return tuple(groups)
