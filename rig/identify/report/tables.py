"""The tables of a report: text, ready to be shown."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from dart_model.effects import CATALOGUE, effect
from dart_model.effects.restoring_surface import FIRST_FORCE, RESTORING_SURFACE
from rig.identify.diagnosis import BeforeAfter, Diagnosis, FoundEffect, RunFigures
from rig.identify.report.inputs import Ranked
from rig.identify.report.quantities import (
    change,
    label,
    number,
    quantity,
    ratio,
    value_and_interval,
)
from rig.identify.report.words import effect_words, family_words


@dataclass(frozen=True)
class ErrorRow:
    """One error, before and after."""

    name: str
    before: str
    after: str
    change: str
    floor: str
    over_floor: str


@dataclass(frozen=True)
class RunRow:
    """One held-out run: each figure before and after."""

    run: str
    cells: tuple[str, ...]


@dataclass(frozen=True)
class ParameterRow:
    """One parameter; `symbol` is its key in the model file."""

    name: str
    symbol: str
    value: str
    interval: str
    meaning: str


@dataclass(frozen=True)
class EffectTable:
    """Parameters of one effect that was found."""

    title: str
    family: str
    name: str
    strut: str
    explained: str
    force: str
    reference: str
    rows: tuple[ParameterRow, ...]


@dataclass(frozen=True)
class RankingRow:
    """One candidate; `bar` is the length of its bar in per cent."""

    words: str
    name: str
    strut: str
    score: str
    bar: float
    why: str
    chosen: bool


@dataclass(frozen=True)
class Rival:
    """Another family that the data allow, and what it takes to see it."""

    family: str
    excitation: str


def errors(found: Diagnosis) -> tuple[ErrorRow, ...]:
    """Errors on held-out data beside the noise floor; only those that were measured."""
    held_out, floor = found.held_out, found.noise_floor
    cell = "Strut force against the load cell"
    if is_imposed(found):
        # What the model lacks is then what the load cell shows beyond it.
        floor_n = floor.residual_force_rmse_n
        rows = ((f"{cell}, motion imposed", held_out.strut_force_rmse_n, floor_n, "N"),)
    else:
        rows = (
            ("Height, model running open loop", held_out.height_rmse_m, floor.height_rmse_m, "m"),
            ("Residual force", held_out.residual_force_rmse_n, floor.residual_force_rmse_n, "N"),
            (cell, held_out.strut_force_rmse_n, math.nan, "N"),
        )
    return tuple(
        _error(name, figure, at_least, unit)
        for name, figure, at_least, unit in rows
        if figure is not None and math.isfinite(figure.before)
    )


def is_imposed(found: Diagnosis) -> bool:
    """Whether the motion was imposed, so that there is no height error."""
    return not math.isfinite(found.held_out.height_rmse_m.before)


def run_columns(found: Diagnosis) -> tuple[str, ...]:
    """What `runs` shows of each run, before and after."""
    if is_imposed(found):
        return ("Strut force",)
    return ("Height, open loop", "Residual force", "Strut force")


def _error(name: str, figure: BeforeAfter, floor: float, unit: str) -> ErrorRow:
    return ErrorRow(
        name,
        quantity(figure.before, unit),
        quantity(figure.after, unit),
        change(figure),
        quantity(floor, unit),
        ratio(figure.after, floor),
    )


def runs(found: Diagnosis) -> tuple[RunRow, ...]:
    """Errors on each held-out run."""
    return tuple(
        RunRow(
            run.run,
            _cells(run)[-2 * len(run_columns(found)) :],
        )
        for run in found.held_out.runs
    )


def _cells(run: RunFigures) -> tuple[str, ...]:
    return (
        *_pair(run.height_rmse_m, "m"),
        *_pair(run.residual_force_rmse_n, "N"),
        *_pair(run.strut_force_rmse_n, "N"),
    )


def _pair(figure: BeforeAfter | None, unit: str) -> tuple[str, str]:
    if figure is None:
        return "–", "–"
    return quantity(figure.before, unit), quantity(figure.after, unit)


def effects(found: Diagnosis) -> tuple[EffectTable, ...]:
    """Parameters of every effect that was found."""
    return tuple(_effect(item) for item in found.effects)


def _effect(item: FoundEffect) -> EffectTable:
    law = effect(item.name)
    shown = law.parameters
    table: tuple[ParameterRow, ...] = ()
    if law is RESTORING_SURFACE:
        shown, table = law.parameters[:FIRST_FORCE], _forces(item)
    rows = tuple(
        ParameterRow(
            label(parameter),
            parameter.name,
            *value_and_interval(item.parameters[parameter.name], parameter.unit),
            parameter.meaning,
        )
        for parameter in shown
        if parameter.name in item.parameters
    )
    return EffectTable(
        title=_capital(effect_words(item.name)),
        family=item.family,
        name=item.name,
        strut=item.strut,
        explained=_percent(item.explained_fraction, 0),
        force=quantity(item.force_rms_n, "N"),
        reference=law.reference,
        rows=rows + table,
    )


def _forces(item: FoundEffect) -> tuple[ParameterRow, ...]:
    forces = [
        item.parameters[parameter.name].value
        for parameter in RESTORING_SURFACE.parameters[FIRST_FORCE:]
        if parameter.name in item.parameters
    ]
    if not forces:
        return ()
    reach = f"{quantity(min(forces), 'N')} to {quantity(max(forces), 'N')}"
    meaning = f"{len(forces)} forces over height and velocity, listed in corrected.yaml"
    return (ParameterRow("forces", "force_…_n", reach, "–", meaning),)


def ranking(candidates: Sequence[Ranked], found: Diagnosis) -> tuple[RankingRow, ...]:
    """Every candidate, best first; from the diagnosis alone if there is no ranking."""
    rows = candidates or (
        *(Ranked(x.name, x.family, x.strut, x.explained_fraction, "") for x in found.effects),
        *(Ranked(x.name, x.family, x.strut, None, x.why) for x in found.rejected),
    )
    return tuple(_ranked(item) for item in rows)


def _ranked(item: Ranked) -> RankingRow:
    score = math.nan if item.score is None else item.score
    return RankingRow(
        words=_capital(effect_words(item.name)),
        name=item.name,
        strut=item.strut,
        score=_percent(score, 1),
        bar=round(100.0 * min(max(score, 0.0), 1.0), 1) if math.isfinite(score) else 0.0,
        why=item.why,
        chosen=not item.why,
    )


def _percent(share: float, decimals: int) -> str:
    return f"{number(100.0 * share, decimals)} %" if math.isfinite(share) else "–"


def rivals(found: Diagnosis) -> tuple[Rival, ...]:
    """Families that the data do not tell from what was found."""
    return tuple(
        Rival(_capital(family_words(family)), listed_excitations(family))
        for family in found.ambiguous_with
    )


def listed_excitations(family: str) -> str:
    """What a run must contain for the laws of a family to be seen."""
    texts = {law.excitation: None for law in CATALOGUE.values() if law.family == family}
    return "; ".join(texts) or "–"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
