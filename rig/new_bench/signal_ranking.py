"""Which signals of a DBC are likely to be what a bench measures, best first, with the reasons.

A unit decides what a signal may be. Which of them it is follows from words in its name, its
comment and its message's name, from its range, its step and its cycle. The words are English and
German, as DBC files have them; the weights order candidates that were seen in some hundred public
files, where an odometer, a radar's range and a fuel level are lengths too.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from can_dbc.codec import si_range, si_step
from can_dbc.database import Message, Signal
from can_dbc.errors import DatabaseError
from can_dbc.units import Dimension, si_conversion

_NOT_SENT = "VECTOR__INDEPENDENT_SIG_MSG"
"""Name under which DBC editors keep signals that belong to no message."""

_ELSEWHERE = 0.5
"""Weight of a word in a comment or a message's name, of that in the signal's own name."""

_LETTERS_OF_A_PART = 5
"""A shorter word has to begin one: `pos` is no part of `exposure`, nor `ride` of `override`."""

_CLEAR_WORD = 2.0
"""Weight of a word that says by itself what a signal is."""

_LEAST_BITS = 12
"""Of a position that is counted: 4096 steps over a stroke."""

_OTHERS = ("%", "V", "mV", "A", "mA", "bar", "Pa", "kPa", "MPa", "deg", "rad", "Hz", "rpm", "1/min")
"""Units of other quantities of a bench."""

_FINE_M = 1e-4
"""Step of a position sensor; a radar, a level or an odometer counts in millimetres at best."""

_FAST_S, _SLOW_S = 0.02, 0.2
"""Cycles of a sensor by which a strut can be followed, and of one by which it cannot."""


@dataclass(frozen=True)
class Likeness:
    """What a signal of some quantity looks like.

    Attributes:
        words: Weights of words in names; negative for what is measured elsewhere.
        spans: Spans of a range in SI that are usual, that are possible.
        step: Largest step in SI that is of use.
        likely: Least score of a signal that is proposed: a clear word, or unit, range and cycle
            together.
        cycle_weight: Weight of the message's cycle.
    """

    dimension: Dimension
    words: Mapping[str, float]
    spans: tuple[tuple[float, float], tuple[float, float]] | None = None
    step: float | None = None
    likely: float = 3.0
    cycle_weight: float = 1.0


@dataclass(frozen=True)
class RankedSignal:
    """A signal that may be what is looked for; the higher its score, the more likely."""

    message: Message
    signal: Signal
    score: float
    is_likely: bool
    reasons: tuple[str, ...]

    @property
    def name(self) -> str:
        """Message and signal, with a dot between."""
        return full_name(self.message, self.signal)

    @property
    def why(self) -> str:
        """The reasons in one line."""
        return ", ".join(self.reasons)


def _weights(**weighted: str) -> dict[str, float]:
    """Words by weight: `plus_3="susp damper"`, `minus_4="odo trip"`."""
    found: dict[str, float] = {}
    for key, words in weighted.items():
        sign, _, size = key.partition("_")
        weight = float(size.replace("_", "."))
        found |= dict.fromkeys(words.split(), weight if sign == "plus" else -weight)
    return found


HEIGHT = Likeness(
    Dimension.LENGTH,
    _weights(
        plus_3="susp suspension damper daempfer shock strut stroke lvdt drawwire linpot federweg "
        "einfederung federbein ridehgt rideheight ride wire potentiometer pot jounce",
        plus_2="height hght hoehe hauteur hoogte altura altezza travel displacement displ "
        "stringpot weg wegsensor level niveau",
        plus_1="pos position length laenge hub spring feder corner axle achse encoder enc",
        minus_4="odo odometer trip range reichweite altitude gps latitude longitude "
        "lane radar object obj target curve kurve snow rain urea fuel tank tire tyre circumference "
        "throttle brake pedal clutch steer steering rack valve camera cam parking obstacle "
        "pedestrian waypoint path route road gap lateral wheelbase track trk vehicle ahead "
        "mileage km seat injector crank oil oel attitude cloud visibility width potential",
        minus_2="distance dist offset setpoint soll cmd command request req nominal target demand "
        "raw prev model estimated simulated",
    ),
    spans=((0.005, 2.0), (0.0, 20.0)),
    step=1e-3,
)

_NO_BENCH_FORCE = (
    "brake pedal steer steering handle clutch tractive traction propulsion drag aero wind "
    "regen wheel trailer drawbar fifthwheel limit max min"
)

_CLEAR_FORCE, _HARDLY = 1.5, 0.1
"""Of a force, a clear word at least in a comment has to say where it acts; its cycle only orders
forces of which that is known."""

_NOT_MEASURED = "cmd command setpoint soll demand request target"

APPLIED_FORCE = Likeness(
    Dimension.FORCE,
    _weights(
        plus_3="applied excitation erreger anregung shaker actuator aktor cylinder zylinder "
        "exciter input carriage",
        plus_0_5="act force kraft drive piston hydraulic servo",
        minus_2="strut damper estimate estimated",
        minus_3=_NOT_MEASURED,
        minus_4=_NO_BENCH_FORCE,
    ),
    likely=_CLEAR_FORCE,
    cycle_weight=_HARDLY,
)

STRUT_FORCE = Likeness(
    Dimension.FORCE,
    _weights(
        # A load cell may be in the strut or at the cylinder.
        plus_3="load_cell strut damper daempfer shock susp suspension",
        plus_0_5="force kraft meas measured ist sensor loadcell load cell kmd messdose",
        minus_2="applied excitation shaker actuator aktor cylinder zylinder estimate estimated "
        "carriage",
        minus_3=_NOT_MEASURED,
        minus_4=_NO_BENCH_FORCE,
    ),
    likely=_CLEAR_FORCE,
    cycle_weight=_HARDLY,
)

TEMPERATURE = Likeness(
    Dimension.TEMPERATURE,
    _weights(
        plus_3="damper daempfer shock strut federbein stossdaempfer",
        plus_2="oil oel fluid",
        plus_1="temp temperature temperatur",
        minus_2="ambient engine motor battery cell coolant inverter air outside aussen cpu board "
        "gearbox transmission exhaust tire tyre brake set setpoint",
    ),
)

ESTIMATE = Likeness(
    Dimension.FORCE,
    _weights(
        plus_3="estimate estimated estim est geschaetzt schaetz rig model simulated sim "
        "calculated calc",
        plus_1="spring damper strut force kraft cmd out",
        minus_2="measured meas cell load ist setpoint soll max min limit right",
    ),
)


def rank_signals(messages: Iterable[Message], likeness: Likeness) -> list[RankedSignal]:
    """Signals with a unit of the likeness's dimension, the likeliest first."""
    found = [
        _score(message, signal, likeness)
        for message in messages
        if message.name != _NOT_SENT
        for signal in message.signals.values()
        if measures(signal, likeness.dimension)
    ]
    return sorted(found, key=lambda item: -item.score)


def words_without_unit(messages: Iterable[Message], likeness: Likeness) -> list[str]:
    """Signals whose names fit and which the DBC gives no unit, the best first."""
    found = [
        (sum(weights.values()), full_name(message, signal))
        for message in messages
        for signal in message.signals.values()
        if not signal.unit and signal.length_bits > 1
        if (weights := _words(likeness.words, signal.name)) and sum(weights.values()) >= _CLEAR_WORD
    ]
    return [name for _, name in sorted(found, key=lambda item: -item[0])]


def counts(messages: Iterable[Message]) -> list[tuple[Message, Signal]]:
    """Signals whose unit is none of a quantity, as that of an encoder's increments: fast and fine.

    Counters and checksums have too few bits, a mileage is sent too rarely.
    """
    return [
        (message, signal)
        for message in messages
        if message.cycle_time_ns is None or _is_fast(message)
        for signal in message.signals.values()
        if signal.unit and signal.length_bits >= _LEAST_BITS and is_count(signal)
    ]


def is_count(signal: Signal) -> bool:
    """Whether a signal has no unit, or one of no quantity, such as increments."""
    units = (dimension for dimension in Dimension if dimension is not Dimension.NUMBER)
    return signal.unit not in _OTHERS and not any(measures(signal, unit) for unit in units)


def full_name(message: Message, signal: Signal) -> str:
    """Message and signal, with a dot between."""
    return f"{message.name}.{signal.name}"


def measures(signal: Signal, dimension: Dimension) -> bool:
    """Whether a signal's unit is one of a dimension."""
    try:
        si_conversion(signal.unit, dimension)
    except DatabaseError:
        return False
    return True


def is_fast_and_fine(item: RankedSignal) -> bool:
    """Whether a length has the cycle and the step of a position sensor, as no radar has."""
    step = si_step(item.message, item.signal.name, Dimension.LENGTH)
    return _is_fast(item.message) and 0.0 < step <= _FINE_M


def _is_fast(message: Message) -> bool:
    """Whether the DBC gives a message a cycle by which a strut can be followed."""
    return message.cycle_time_ns is not None and message.cycle_time_ns * 1e-9 <= _FAST_S


def _score(message: Message, signal: Signal, likeness: Likeness) -> RankedSignal:
    own = _words(likeness.words, signal.name)
    around = _words(likeness.words, f"{signal.comment} {message.name}")
    around = {word: weight for word, weight in around.items() if word not in own}
    score = sum(own.values()) + _ELSEWHERE * sum(around.values())
    reasons = [
        f"{words} in its {where}"
        for weights, where in ((own, "name"), (around, "comment or message"))
        if (words := ", ".join(f"'{word}'" for word, weight in weights.items() if weight > 0))
    ]
    for found, why in (
        _unit_score(signal, likeness),
        _range_score(message, signal, likeness),
        _step_score(message, signal, likeness),
        _cycle_score(message, likeness),
    ):
        score += found
        reasons += [why] if why else []
    return RankedSignal(message, signal, score, score >= likeness.likely, tuple(reasons))


_Scored = tuple[float, str]


def _unit_score(signal: Signal, likeness: Likeness) -> _Scored:
    if likeness.dimension is not Dimension.LENGTH:
        return 0.0, f"in {signal.unit}"
    metres = si_conversion(signal.unit, Dimension.LENGTH).factor
    if metres > 100.0:
        return -6.0, ""
    return (1.0 if metres < 0.1 else 0.0), f"in {signal.unit}"


def _range_score(message: Message, signal: Signal, likeness: Likeness) -> _Scored:
    low, high = si_range(message, signal.name, likeness.dimension)
    span = high - low
    if likeness.spans is None or signal.minimum is None or not 0.0 < span < float("inf"):
        return 0.0, ""
    (least, most), (_, possible) = likeness.spans
    if least <= span <= most:
        return 1.0, f"range {signal.minimum:g} to {signal.maximum:g} {signal.unit}"
    # A range that is that of the bits says nothing of the sensor.
    step = si_step(message, signal.name, likeness.dimension)
    is_of_bits = span >= 0.99 * step * (2**signal.length_bits - 1)
    return (-3.0 if span > possible and not is_of_bits else 0.0), ""


def _step_score(message: Message, signal: Signal, likeness: Likeness) -> _Scored:
    if likeness.step is None:
        return 0.0, ""
    step = si_step(message, signal.name, likeness.dimension)
    if step > 10.0 * likeness.step:
        return -2.0, ""
    if step > likeness.step:
        return -1.0, ""
    return 0.5, f"steps of {step * 1e3:.3g} mm" if step else ""


def _cycle_score(message: Message, likeness: Likeness) -> _Scored:
    if message.cycle_time_ns is None:
        return 0.0, ""
    cycle_s = message.cycle_time_ns * 1e-9
    why = f"every {cycle_s * 1e3:g} ms"
    if _is_fast(message):
        return likeness.cycle_weight, why
    return (-likeness.cycle_weight if cycle_s >= _SLOW_S else 0.0), why


def _words(weights: Mapping[str, float], text: str) -> dict[str, float]:
    """Words of a text, with their weights: parts of it, or beginnings of parts if short."""
    plain = text.lower()
    parts = split_name(text)
    found = {
        word: weight
        for word, weight in weights.items()
        if any(part.startswith(word) for part in parts)
        or (len(word) >= _LETTERS_OF_A_PART and word in plain)
    }
    # `suspension` holds `susp`: one of them counts.
    return {
        word: weight
        for word, weight in found.items()
        if not any(word != other and word in other for other in found)
    }


def split_name(text: str) -> Sequence[str]:
    """Words of a name in camel case or with underscores, in lower case."""
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", text)
    return [word.lower() for word in re.findall(r"[^\W\d_]+", spaced)]
