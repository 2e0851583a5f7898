"""The page of a report."""

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from dart_model.effects import FAMILY_WORDS, effect
from rig.diagnosis.outcome import Diagnosis, Result
from rig.pages.html import render_report, write_page
from rig.pages.report import tables
from rig.pages.report.figures import (
    Plot,
    corrected_residual_plot,
    curves,
    held_out_plot,
    residual_plot,
    surface_plot,
)
from rig.pages.report.number_formats import percent
from rig.pages.report.series import check_series
from rig.pages.report.words import BLOCKS, is_prescribed, sentence

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
    "Spring, damper and effect act between the same two bodies, so only their sum can be seen: a "
    "share is given to one of them because of the law it follows.",
    "The sensors' noise is estimated from the data and taken as white; the noise floor is what it, "
    "and the applied force's, would leave.",
    "95 % intervals hold if the law that is named is the right one.",
    "Held-out data took no part in the search, only their initial states are fitted. Laws without "
    "which they are at the noise floor are taken back.",
)
_SPLITS = {
    "runs": "Whole recordings were held out; they took no part in search and fit.",
    "blocks": "No recording was held out: blocks spread over the recordings took no part in search "
    "and fit.",
}
_PACKAGES = ("rig", "dartpy", "numpy", "scipy", "numba")
_OF_A_FREE_RUN = ("The free-run simulation has the applied force as its only input.",)


def write_report(result: Result, path: Path) -> None:
    """Write the page as one file that needs no network.

    Args:
        result: What it shows.
        path: File to write; it is replaced at once, never left half written.

    Raises:
        InputError: The file cannot be written.
    """
    write_page(page(result), path)


def page(result: Result) -> str:
    """The page, the same for the same input.

    Raises:
        ValueError: The series of `result` do not fit together.
    """
    found = result.diagnosis
    for series in (*result.fitted, *result.held_out):
        check_series(series)
    struts = tuple(dict.fromkeys(item.strut for item in (*result.fitted, *result.held_out)))
    tone, sign, badge = _BADGES[found.verdict]
    return render_report(
        "page.html",
        found=found,
        sentence=sentence(found, len(struts)),
        tone=tone,
        sign=sign,
        badge=badge,
        held_out=_held_out(found),
        struts=struts,
        errors=tables.errors(found),
        white=_white(found),
        run_columns=tables.run_columns(found),
        run_cells=tables.run_cells,
        linear=tables.linear(found),
        effects=tables.effects(found),
        existing=tables.existing(found),
        nearest=next((item for item in found.rejected if item.left is not None), None),
        strut_plots=_plots(result, struts),
        assumptions=_ASSUMPTIONS + (() if is_prescribed(found) else _OF_A_FREE_RUN),
        capital=tables.capital,
        effect=effect,
        families=FAMILY_WORDS,
        excitations=tables.listed_excitations,
        percent=percent,
        sources=result.sources,
        split=_SPLITS[found.held_out.source],
        versions=[f"{name} {version(name)}" for name in _PACKAGES],
    )


def _held_out(found: Diagnosis) -> str:
    if found.held_out.source == "blocks":
        return BLOCKS
    return ", ".join(run.run for run in found.held_out.runs) or "–"


def _white(found: Diagnosis) -> str:
    white = found.residual_white
    text = (
        f"With the nominal model, the residual is {'' if white.before else 'not '}white by the test"
    )
    if not _is_corrected(found):
        return f"{text}."
    after = f"the residual is {'' if white.after else 'not '}white by the test"
    return f"{text}; with the corrected model, {after}."


def _is_corrected(found: Diagnosis) -> bool:
    return bool(found.linear or found.effects or found.existing)


def _plots(result: Result, struts: Sequence[str]) -> tuple[tuple[str, list[Plot]], ...]:
    points = max(min(_POINTS, _POINTS_OF_ALL // max(len(struts), 1)), _FEWEST_POINTS)
    corrected = _is_corrected(result.diagnosis)
    shown = curves(corrected=corrected)
    floor = result.diagnosis.noise_floor
    groups: list[tuple[str, list[Plot]]] = []
    for index, strut in enumerate(struts):
        fitted = [item for item in result.fitted if item.strut == strut]
        held_out = [item for item in result.held_out if item.strut == strut]
        plots: list[Plot | None] = []
        if held_out:
            plots.append(held_out_plot(f"held-out-{index}", held_out, floor, shown, points))
        if fitted:
            plots.append(residual_plot(f"residual-{index}", fitted, shown, points))
            if corrected:
                plots.append(corrected_residual_plot(f"left-{index}", fitted, points))
            plots.append(surface_plot(f"surface-{index}", fitted, shown))
        groups.append((strut, [plot for plot in plots if plot is not None]))
    return tuple(groups)
