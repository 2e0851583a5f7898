"""Tables of a report, as texts."""

import math
from typing import NamedTuple

from dart_model.effects import CATALOGUE, Effect, effect
from dart_model.effects.restoring_surface import FIRST_FORCE, RESTORING_SURFACE
from rig.diagnosis.outcome import ChannelCorrection, Diagnosis, Estimate, ModelErrors, RunFigures
from rig.pages.number_formats import (
    change,
    label,
    percent,
    quantity,
    ratio,
    share,
    value_and_interval,
    with_unit,
)
from rig.pages.report.words import (
    LINEAR,
    acting_words,
    difference,
    evidence_words,
    is_prescribed,
    linear_label,
    missing,
)

Row = tuple[str, ...]
"""Texts of the cells of a row."""


class EffectTable(NamedTuple):
    """One effect; a row holds a parameter's name, nominal value, value, interval, meaning, key."""

    law: Effect
    note: str
    rows: tuple[Row, ...]


def errors(diagnosis: Diagnosis) -> tuple[Row, ...]:
    """Name, nominal, best linear and corrected model, change, noise floor and ratio of each error.

    Each is followed by its shares of the signal.
    """
    held_out, floor = diagnosis.held_out, diagnosis.noise_floor
    cell = "Strut force against the load cell"
    if is_prescribed(diagnosis):
        # The residual force is then the load cell's force less the model's.
        floor_n = floor.residual_force_rmse_n
        rows = ((f"{cell}, motion prescribed", held_out.strut_force_rmse_n, floor_n, "N"),)
    else:
        rows = (
            ("Height, free-run simulation", held_out.height_rmse_m, floor.height_rmse_m, "m"),
            ("Residual force", held_out.residual_force_rmse_n, floor.residual_force_rmse_n, "N"),
            (cell, held_out.strut_force_rmse_n, math.nan, "N"),
        )
    texts: list[Row] = []
    for name, x, least, unit in rows:
        if x is None or not math.isfinite(x.before):
            continue
        over = ratio(x.after, least)
        texts.append((name, *_each(x, unit), change(x), quantity(least, unit), over))
        if x.signal > 0.0:
            shares = (share(it / x.signal) for it in (x.before, x.linear, x.after))
            signal = f"as a share of the signal, {quantity(x.signal, unit)} RMS"
            texts.append((signal, *shares, "", share(least / x.signal), ""))
    return tuple(texts)


class Bar(NamedTuple):
    """A bar: its name, what it is (`given`, `chosen` or `rival`), and its share of the scale."""

    name: str
    kind: str
    share: float


_RIVALS = 3
"""Nearest rivals that are drawn."""


def bars(diagnosis: Diagnosis) -> tuple[Bar, ...]:
    """Residuals of the best linear and the chosen model and of the nearest rivals.

    As shares of that of the best linear model; none where no law is chosen.
    """
    lacking = missing(diagnosis)
    if diagnosis.left is None or not lacking:
        return ()
    rivals = [
        Bar(effect(item.name).words, "rival", item.left)
        for item in diagnosis.rejected
        if item.left is not None
    ][:_RIVALS]
    words = " and ".join(effect(item.name).words for item in lacking)
    return (
        Bar("best linear model", "given", 1.0),
        *rivals[::-1],
        Bar(f"chosen: {words}", "chosen", diagnosis.left),
    )


def run_columns(diagnosis: Diagnosis) -> Row:
    """Heads of the columns of `run_cells`, of which each has three."""
    return ("Height, free run", "Residual force", "Strut force")[2 * is_prescribed(diagnosis) :]


def run_cells(run: RunFigures, columns: int) -> Row:
    """Errors on one held-out run: the last columns, of nominal, linear and corrected model."""
    heights, forces = _each(run.height_rmse_m, "m"), _each(run.residual_force_rmse_n, "N")
    return (*heights, *forces, *_each(run.strut_force_rmse_n, "N"))[-3 * columns :]


def _each(errors: ModelErrors | None, unit: str) -> tuple[str, str, str]:
    if errors is None:
        return "–", "–", "–"
    before, linear, after = errors.before, errors.linear, errors.after
    return quantity(before, unit), quantity(linear, unit), quantity(after, unit)


def linear(diagnosis: Diagnosis) -> tuple[Row, ...]:
    """Name, key, strut, nominal, value, interval and difference of each linear correction."""
    rows: list[Row] = []
    for item in diagnosis.linear:
        unit = LINEAR[item.parameter][1]
        values = quantity(item.nominal, unit), *value_and_interval(item.total, unit)
        rows.append((linear_label(item), item.parameter, item.strut, *values, difference(item)))
    return tuple(rows)


def channels(diagnosis: Diagnosis) -> tuple[Row, ...]:
    """Channel, key, nominal, value and interval of each correction of the measurement."""
    return tuple(
        (item.channel, item.parameter, *_channel_values(item)) for item in diagnosis.channels
    )


def _channel_values(item: ChannelCorrection) -> tuple[str, str, str]:
    unit = "s" if item.parameter == "delay_s" else ""
    return quantity(item.nominal, unit), *value_and_interval(item.total, unit)


def effects(diagnosis: Diagnosis) -> tuple[EffectTable, ...]:
    """Missing effects, with their parameters."""
    tables: list[EffectTable] = []
    lacking = missing(diagnosis)
    overlap = " (such shares overlap)" * (len(lacking) > 1)
    for item in lacking:
        law = effect(item.name)
        note = (
            f"family {item.family}, strut {item.strut}, {quantity(item.force_rms_n, 'N')} RMS, "
            f"explains {percent(item.explained_fraction, 0)} of the residual force without it"
            f"{overlap}"
        )
        if item.evidence is not None:
            note += f". {evidence_words(item.evidence, diagnosis.level)}"
        if item.where is not None:
            note += f". {acting_words(item.where)}"
        tables.append(EffectTable(law, note, _parameters(law, item.parameters, {})))
    return tuple(tables)


def damper(diagnosis: Diagnosis) -> tuple[Row, ...]:
    """Strut, velocity, force and its interval, damping and its interval, for each velocity."""
    unit = LINEAR["damping_n_s_per_m"][1]
    rows: list[Row] = []
    for item in diagnosis.damper:
        direction = "rebound" if item.velocity_m_per_s > 0.0 else "compression"
        # A round speed, which has no digits to spare.
        speed = f"{direction} {with_unit(f'{abs(item.velocity_m_per_s):g}', 'm/s')}"
        force = value_and_interval(item.force_n, "N")
        slope = value_and_interval(item.damping_n_s_per_m, unit)
        rows.append((item.strut, speed, *force, *slope))
    return tuple(rows)


def existing(diagnosis: Diagnosis) -> tuple[EffectTable, ...]:
    """Effects of the nominal model that the data change."""
    tables: list[EffectTable] = []
    for item in diagnosis.existing:
        law = effect(item.name)
        superfluous = (
            "superfluous on these data: without it, and with the others refitted, the error is the "
            "same; it remains in corrected.yaml"
        )
        note = f"strut {item.strut}, {'refitted' if item.change == 'refitted' else superfluous}"
        tables.append(EffectTable(law, note, _parameters(law, item.parameters, item.nominal)))
    return tuple(tables)


def _parameters(
    law: Effect, estimates: dict[str, Estimate], nominal: dict[str, float]
) -> tuple[Row, ...]:
    is_table = law is RESTORING_SURFACE
    rows: list[Row] = []
    for parameter in law.parameters[: FIRST_FORCE if is_table else None]:
        if parameter.name in estimates:
            before = quantity(nominal.get(parameter.name, math.nan), parameter.unit)
            values = value_and_interval(estimates[parameter.name], parameter.unit)
            rows.append((label(parameter), before, *values, parameter.meaning, parameter.name))
    names = [parameter.name for parameter in law.parameters[FIRST_FORCE:]]
    forces = [estimates[name].value for name in names if name in estimates]
    if is_table and forces:
        reach = f"{quantity(min(forces), 'N')} to {quantity(max(forces), 'N')}"
        meaning = f"{len(forces)} forces over height and velocity, listed in corrected.yaml"
        rows.append(("forces", "–", reach, "–", meaning, "force_…_n"))
    return tuple(rows)


def excitations(family: str) -> str:
    """Excitation that a recording needs for the laws of a family to be visible."""
    texts = {law.excitation: None for law in CATALOGUE.values() if law.family == family}
    return "; ".join(texts) or "–"
