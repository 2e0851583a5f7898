"""What recordings can determine, as tables of texts and as advice."""

import math

from dart_model.effects import FAMILY_WORDS
from rig.diagnosis.recording_bounds import (
    DelayBound,
    Determinable,
    FamilyBound,
    LinearBound,
    RecordingFacts,
)
from rig.pages.number_formats import capital, number, percent, quantity, share
from rig.pages.report.words import LINEAR

Row = tuple[str, ...]

_MISSING, _COARSE = 0.05, 3.0
"""Share of missing heights, and resolution over noise, from which on a recording is warned of."""
_ONE_WAY = 0.05
"""Share of the way in a direction below which a recording has the other direction alone."""
_ONE_FREQUENCY = 1.3
"""Ratio of the ends of a band below which it is one frequency."""
_UNITS = {"delay_s": "s", "gain": ""}
_CHANNELS = {"delay_s": "delay", "gain": "gain of the height"}


def recordings(found: Determinable) -> tuple[tuple[str, tuple[Row, ...]], ...]:
    """Name of each recording and strut, and its facts: name and value."""
    return tuple((f"{it.recording}, strut {it.strut}", _facts(it)) for it in found.recordings)


def _facts(it: RecordingFacts) -> tuple[Row, ...]:
    way = percent(it.rebound_share, 0)
    resolution = "below the noise" if it.resolution_m is None else quantity(it.resolution_m, "m")
    return (
        ("samples", f"{quantity(it.duration_s, 's')} at {number(it.rate_hz, 0)} Hz"),
        ("heights missing, cut off", f"{percent(it.missing, 1)}, {percent(it.clipped, 2)}"),
        ("stroke", f"{number(1e3 * it.low_m, 1)} to {number(1e3 * it.high_m, 1)} mm"),
        ("speed in compression", quantity(it.compression_m_per_s, "m/s")),
        ("speed in rebound", f"{quantity(it.rebound_m_per_s, 'm/s')}, {way} of the way"),
        ("frequencies", f"{number(it.band_hz[0], 1)} to {number(it.band_hz[1], 1)} Hz"),
        ("noise of the height", quantity(it.noise_m, "m")),
        ("resolution of the height", resolution),
    )


def linear(found: Determinable) -> tuple[Row, ...]:
    """Parameter, strut, nominal value, least and prior standard deviation, and what it is like."""
    rows: list[Row] = []
    for it in found.linear:
        unit = _UNITS.get(it.parameter) or LINEAR.get(it.parameter, ("", ""))[1]
        values = (quantity(x, unit) for x in (it.nominal, it.std, it.prior_std))
        rows.append((it.parameter, it.strut, *values, it.alike or "–"))
    return tuple(rows)


def delays(found: Determinable) -> tuple[Row, ...]:
    """Channel, its estimated delay, and the standard deviation of that."""
    return tuple(
        (it.channel, quantity(it.delay_s, "s"), quantity(it.std_s, "s")) for it in found.delays
    )


def families(found: Determinable) -> tuple[Row, ...]:
    """Family, strut, least force, its share, the family that is most alike, and apart from when."""
    return tuple(
        (
            capital(FAMILY_WORDS[it.family]),
            it.strut,
            quantity(it.least_n, "N"),
            share(it.least_share),
            "–" if it.rival is None else FAMILY_WORDS[it.rival],
            quantity(it.apart_n, "N") if math.isfinite(it.apart_n) else "never",
        )
        for it in found.families
    )


def warnings(found: Determinable) -> tuple[str, ...]:
    """What the recordings do not determine, each with what to record in addition."""
    texts: list[str] = []
    for it in found.recordings:
        texts += _of_recording(it)
    texts += found.gaps
    texts += [_of_delay(it) for it in found.delays if it.is_late]
    texts += [_of_parameter(it) for it in found.linear if not it.is_determined or it.alike]
    texts += [_of_family(it) for it in found.families if not it.is_determined]
    texts += [
        f"{capital(FAMILY_WORDS[it])}: no law acts on these recordings." for it in found.unexcited
    ]
    return tuple(texts)


def _of_recording(it: RecordingFacts) -> list[str]:
    texts: list[str] = []
    if it.missing > _MISSING:
        texts.append(f"{percent(it.missing, 1)} of the heights are missing.")
    if it.clipped > 0.0:
        cut = percent(it.clipped, 2)
        texts.append(
            f"{cut} of the heights are cut off at an end of the sensor's range: mount it so that "
            "the whole stroke is within its range."
        )
    if it.resolution_m is not None and it.resolution_m > _COARSE * it.noise_m:
        texts.append(
            f"The resolution of {quantity(it.resolution_m, 'm')} is far coarser than the noise: "
            "choose a finer factor of the signal."
        )
    if not _ONE_WAY < it.rebound_share < 1.0 - _ONE_WAY:
        texts.append(
            "One direction of travel: friction and a preload, stiffness and free length are alike. "
            "Record motion in both directions."
        )
    low, high = it.band_hz
    if high < _ONE_FREQUENCY * max(low, 1e-300):
        texts.append(
            f"One frequency ({number(high, 2)} Hz): a delay, stiffness and damping are alike. "
            "Record a sweep or noise."
        )
    return [f"{it.recording}, strut {it.strut}: {text}" for text in texts]


def _of_delay(it: DelayBound) -> str:
    what = "late" if it.delay_s > 0.0 else "early"
    return (
        f"{it.channel} seems {quantity(abs(it.delay_s), 's')} {what}: find out whether it is, and "
        "state `delay_s` in the configuration. A law that the model lacks may look like that, too."
    )


def _of_parameter(it: LinearBound) -> str:
    where = f"{capital(_words(it.parameter))} of strut {it.strut}"
    if it.is_determined:
        return (
            f"{where} is hardly distinguished from {_words(it.alike)}: only their combination is "
            "determined."
        )
    return (
        f"{where} is not determined: the model file's value decides. State its tolerance, or "
        "record a motion with higher frequencies and a larger stroke."
    )


def _words(parameter: str | None) -> str:
    """A parameter in words, as “the mass”."""
    return "the " + _CHANNELS.get(parameter or "", LINEAR.get(parameter or "", ("", ""))[0])


def _of_family(it: FamilyBound) -> str:
    name = capital(FAMILY_WORDS[it.family])
    if it.apart_n > 2.0 * it.least_n and it.rival is not None:
        least = quantity(it.apart_n, "N")
        what = f"is distinguished from {FAMILY_WORDS[it.rival]} only from {least} RMS on"
    else:
        what = f"is found only from {quantity(it.least_n, 'N')} RMS on"
    return f"{name} of strut {it.strut} {what}. Record {it.excitation}."
