"""The page of a diagnosis."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dart_model.effects import FAMILY_WORDS, effect
from dart_model.spec import dump_model
from rig.diagnosis.outcome import Diagnosis, FittedSeries, Result
from rig.machine.installed_versions import version_of
from rig.pages import determinable_tables
from rig.pages.html import render_report, write_page
from rig.pages.identity import identity_rows
from rig.pages.number_formats import capital, percent
from rig.pages.report import tables
from rig.pages.report.figures import (
    Plot,
    corrected_residual_plot,
    curves,
    damper_plot,
    finding_plot,
    held_out_plot,
    residual_plot,
    spectrum_plot,
    surface_plot,
)
from rig.pages.report.finding import find
from rig.pages.report.series import check_series
from rig.pages.report.words import (
    BLOCKS,
    is_prescribed,
    join_words,
    reference_channel,
    sentence,
)

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
    "Gravity is that of the nominal model; a constant force shows as preload.",
    "Spring, damper and effect act between the same two bodies, so only their sum is observable: a "
    "share is attributed to one of them because of the law that it follows.",
    "The noise of the sensors is estimated from the data and assumed to be white; the noise floor "
    "is the RMS that this noise, with that of the applied force, causes with a right model.",
    "95 % intervals hold if the named law is the right one.",
    "Held-out data took no part in the fits; only their initial states are fitted. They decide "
    "whether laws are kept: see the reasons of rejected candidates.",
)
_SPLITS = {
    "runs": "Whole recordings were held out; they took no part in search and fit.",
    "blocks": "No recording was held out: blocks spread over the recordings took no part in search "
    "and fit.",
}
_PACKAGES = ("rig", "dartpy", "numpy", "scipy", "numba")
_OF_A_FREE_RUN = ("Nothing but the measured inputs drives the free-run simulation.",)


def write_report(result: Result, path: Path, labels: Mapping[str, str] | None = None) -> None:
    """Write the page as one file that needs no network; a former one is replaced in one step.

    `labels` are rows of the page's head, such as an operator's name.

    Raises:
        InputError: The file cannot be written.
    """
    write_page(page(result, labels), path)


def page(result: Result, labels: Mapping[str, str] | None = None) -> str:
    """Text of the page, the same for the same input.

    Raises:
        ValueError: The series of `result` do not fit together.
    """
    diagnosis = result.diagnosis
    for series in (*result.fitted, *result.held_out):
        check_series(series)
    struts = tuple(dict.fromkeys(item.strut for item in (*result.fitted, *result.held_out)))
    tone, sign, badge = _BADGES[diagnosis.verdict]
    return render_report(
        "page.html",
        diagnosis=diagnosis,
        identity=identity_rows(labels or {}),
        sentence=sentence(diagnosis, len(struts)),
        tone=tone,
        sign=sign,
        badge=badge,
        blocks=BLOCKS,
        struts=struts,
        is_corrected=_has_corrections(diagnosis),
        tables=tables,
        bounds=_bounds(result),
        capital=capital,
        found=find(result),
        finding_plot=_finding_plot(result),
        corrected=_corrected_text(result),
        view_command=_view_command(result),
        nearest=next((item for item in diagnosis.rejected if item.left is not None), None),
        strut_plots=_plots(result, struts),
        assumptions=_ASSUMPTIONS + (() if is_prescribed(diagnosis) else _OF_A_FREE_RUN),
        effect=effect,
        families=FAMILY_WORDS,
        percent=percent,
        reference=reference_channel(diagnosis),
        sources=result.sources,
        split=_SPLITS[diagnosis.held_out.source],
        versions=[f"{name} {version_of(name)}" for name in _PACKAGES],
    )


def _has_corrections(diagnosis: Diagnosis) -> bool:
    return bool(diagnosis.linear or diagnosis.effects or diagnosis.existing or diagnosis.channels)


def _finding_plot(result: Result) -> Plot | None:
    """The residual force of the strut that lacks most, over the coordinate that shows it best."""
    by_strut: dict[str, list[FittedSeries]] = {}
    for series in result.fitted:
        by_strut.setdefault(series.strut, []).append(series)
    if not by_strut:
        return None
    lacking = {
        strut: sum(float(np.nansum(it.residual_before_n**2)) for it in series)
        for strut, series in by_strut.items()
    }
    most = by_strut[max(lacking, key=lacking.__getitem__)]
    diagnosis = result.diagnosis
    there = (item for item in diagnosis.effects if item.strut == most[0].strut and item.where)
    corrected = _has_corrections(diagnosis)
    drawn = finding_plot("first", most, _POINTS, next(there, None), corrected=corrected)
    if drawn is None or not diagnosis.ambiguous_with:
        return drawn
    rivals = join_words([FAMILY_WORDS[family] for family in diagnosis.ambiguous_with], "or")
    return drawn._replace(
        caption=f"{drawn.caption} The correction is that of the law named first; {rivals} "
        "describes these recordings as well."
    )


def _bounds(result: Result) -> dict[str, object]:
    """What the recordings can determine, as tables of texts; empty where it was not asked."""
    found = result.determinable
    if found is None:
        return {}
    return {
        "warnings": determinable_tables.warnings(found),
        "recordings": determinable_tables.recordings(found),
        "delays": determinable_tables.delays(found),
        "linear": determinable_tables.linear(found),
        "families": determinable_tables.families(found),
    }


def _corrected_text(result: Result) -> str:
    """The corrected model's file; empty where nothing was corrected."""
    return dump_model(result.corrected) if _has_corrections(result.diagnosis) else ""


def _view_command(result: Result) -> str:
    """The command that shows the first run with the corrected model's law; empty without a run."""
    runs = [item.name for item in result.sources if item.role == "fitted"]
    return f"rig view {runs[0]} --model corrected.yaml" if runs else ""


def _plots(result: Result, struts: Sequence[str]) -> tuple[tuple[str, list[Plot]], ...]:
    points = max(min(_POINTS, _POINTS_OF_ALL // max(len(struts), 1)), _FEWEST_POINTS)
    corrected = _has_corrections(result.diagnosis)
    styles = curves(corrected=corrected)
    floor = result.diagnosis.noise_floor
    groups: list[tuple[str, list[Plot]]] = []
    for index, strut in enumerate(struts):
        fitted = [item for item in result.fitted if item.strut == strut]
        held_out = [item for item in result.held_out if item.strut == strut]
        plots: list[Plot | None] = []
        if held_out:
            plots.append(held_out_plot(f"held-out-{index}", held_out, floor, styles, points))
        if fitted:
            plots.append(residual_plot(f"residual-{index}", fitted, styles, points))
            if corrected:
                plots.append(corrected_residual_plot(f"left-{index}", fitted, points))
            plots.append(damper_plot(f"damper-{index}", fitted, styles, points))
            plots.append(surface_plot(f"surface-{index}", fitted, styles))
            plots.append(spectrum_plot(f"spectrum-{index}", fitted, styles))
        groups.append((strut, [plot for plot in plots if plot is not None]))
    return tuple(groups)
