"""A configuration proposed from a DBC: which signals look like what the bridge needs.

What is proposed is safe to start with: an observer that is slow and stable until it is tuned, a
signal that marks the estimate as invalid, and limits on what a height sensor can send.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum

from can_dbc.codec import si_step
from can_dbc.database import Database, Message, Signal, alive_counter
from can_dbc.errors import DatabaseError, InputError, expected_name
from can_dbc.units import Dimension
from rig.bridge.published_quantities import COUNTER, FORCE, STATUS_MESSAGE, VALID
from rig.bus.bus import WITHOUT_BIT_RATE, BusConfig
from rig.channels.measured_quantities import (
    APPLIED_FORCE,
    HEIGHT,
    LOAD_CELL_FORCE,
    TEMPERATURE,
    Quantity,
)
from rig.new_bench import signal_ranking
from rig.new_bench.signal_ranking import (
    Likeness,
    RankedSignal,
    full_name,
    measures,
    rank_signals,
    words_without_unit,
)
from rig.observers.kalman import KalmanObserver

STRUT = "strut"
"""Strut of the model that is proposed."""

_UNKNOWN_NOISE_M, _UNKNOWN_INTERVAL_NS = 1e-5, 10_000_000
"""Where the DBC does not state a step or a cycle."""

_LEAST_RATE_HZ, _LARGEST_RATE_HZ, _USUAL_RATE_HZ = 100.0, 2000.0, 1000.0
"""Rates of the bridge: that of the height where it lies between, else the usual one."""

_VALID_WORDS = ("valid", "vld", "gueltig", "geldig", "qual", "ok", "healthy")
_OK_CHOICES = ("ok", "valid", "good", "gueltig", "gültig", "geldig", "válid", "healthy")
_WORKS = "(?:healthy|valid[eoa]?|válid[oa]|ok|good|in order|gueltig|gültig|geldig)"
_FAULT_WORDS = ("fault", "error", "fehler", "invalid", "fail")
_COUNTER_BITS = range(2, 9)
"""Bits of a message counter: two (the least that shows a repetition) to eight."""

_COUNTER_WORDS = (
    "counter", "cnt", "alive", "rolling", "zaehler", "bz", "ctr", "msgcount", "seq", "compteur",
    "teller", "contador", "contatore",
)  # fmt: skip
_COUNTS = re.compile("counter|count|zähler|zaehler|compteur|teller|contador|contatore|rolling")
"""Words of a comment on a counter of messages."""

_STATE_WORDS = ("state", "mode", "status", "zustand")
_ELSEWHERE = -1.0
"""Score below which a force is that of another place, such as a brake's, or a command."""

_LEAST_STATE_BITS = 3
"""A mode is a number from 0 to 6."""

_FIRST_OWN_ID, _LAST_OWN_ID = 0x680, 0x700
"""Identifiers for a message of the estimate: CANopen leaves them free (CiA 301, 7.3.3)."""

_STALE_CYCLES = 3
"""Cycles after which a height is stale: two frames in a row may be lost."""

_LEAST_STALE_S = 0.01
"""Time by which an ordinary kernel may delay frames of a faster sensor."""

_LARGEST_RATE_M_PER_S = 10.0
"""Of a height: several times what a damper is tested at."""

_FROZEN_S = 1.0
"""A reading that is the same for longer is taken for frozen: noise changes it in some samples."""

_MOST_OTHERS = 4
"""Other candidates that are named in a comment."""


class Force(Enum):
    """Where a force acts that the bench measures."""

    APPLIED = APPLIED_FORCE
    IN_STRUT = LOAD_CELL_FORCE

    @property
    def quantity(self) -> Quantity:
        """Its quantity."""
        return self.value

    @property
    def option(self) -> str:
        """Option of `rig init` that names its signal."""
        return "--applied-force" if self is Force.APPLIED else "--load-cell"


@dataclass(frozen=True)
class Choice:
    """A signal that was chosen for a quantity, with the others that may be it.

    Attributes:
        why: Why it was chosen.
    """

    quantity: Quantity
    message: Message
    signal: Signal
    why: str
    others: tuple[str, ...]

    @property
    def name(self) -> str:
        """Message and signal, with a dot between."""
        return full_name(self.message, self.signal)

    @property
    def comment(self) -> str:
        """Why, and what else it may be."""
        others = ", ".join(self.others[:_MOST_OTHERS])
        more = ", ..." if len(self.others) > _MOST_OTHERS else ""
        return self.why + (f"; or {others}{more}" if others else "")


@dataclass(frozen=True)
class Signals:
    """What is measured on a bench, by signals of its DBC.

    Attributes:
        unclear: Forces of which nothing says whether they act on the body or in the strut.
        unknown: Names of signals whose unit is not understood.
    """

    height: Choice
    forces: tuple[Choice, ...]
    temperature: Choice | None
    unclear: tuple[RankedSignal, ...] = ()
    unknown: tuple[str, ...] = ()

    @property
    def choices(self) -> tuple[Choice, ...]:
        """All of them."""
        last = () if self.temperature is None else (self.temperature,)
        return (self.height, *self.forces, *last)

    def measures(self, force: Force) -> bool:
        """Whether a force is measured there."""
        return any(choice.quantity is force.quantity for choice in self.forces)


def find_height(database: Database, named: str | None) -> Choice:
    """The signal that is the height, by its name (`MESSAGE.SIGNAL`) or the likeliest one.

    Raises:
        InputError: There is no such signal, or none that looks like the height of a strut.
    """
    messages = list(database.messages.values())
    ranked = rank_signals(messages, signal_ranking.HEIGHT)
    if named is not None:
        return _named(database, HEIGHT, named, ranked, "--height")
    if not ranked:
        unitless = words_without_unit(messages, signal_ranking.HEIGHT)
        raise InputError(
            f"{database.path}: no signal has a unit of length, expected the height of a strut"
            + (
                f": if it is {' or '.join(unitless[:_MOST_OTHERS])}, give it its unit in the DBC"
                if unitless
                else ": is this the DBC of the bench? `rig sensor scan` finds sensors without one"
            )
        )
    if ranked[0].is_likely:
        return _choice(HEIGHT, ranked[0], ranked)
    fine = [item for item in ranked if signal_ranking.is_fast_and_fine(item)]
    if len(fine) == 1:
        why = "the only length that is sent often, in fine steps"
        return replace(_choice(HEIGHT, fine[0], ranked), why=why)
    lengths = ", ".join(item.name for item in ranked[:_MOST_OTHERS])
    more = ", ..." if len(ranked) > _MOST_OTHERS else ""
    counts = unknown_units(database)
    counts += [it for it in words_without_unit(messages, signal_ranking.HEIGHT) if it not in counts]
    counts = counts[:_MOST_OTHERS]
    unknown = f"; {' or '.join(counts)} has no unit that is known" if counts else ""
    raise InputError(
        f"{database.path}: no length looks like the height of a strut (there are {lengths}"
        f"{more}{unknown}): name it with --height MESSAGE.SIGNAL"
    )


def unknown_units(database: Database) -> list[str]:
    """Names of signals that could be a height or a force, but for their unit."""
    return [full_name(*item) for item in signal_ranking.counts(database.messages.values())]


def find_force(database: Database, force: Force, named: str | None) -> Choice | None:
    """The signal of a force, by its name or if its name or comment says where it acts.

    Raises:
        InputError: There is no such signal.
    """
    likeness = _force_likeness(force)
    ranked = rank_signals(database.messages.values(), likeness)
    if named is not None:
        return _named(database, force.quantity, named, ranked, force.option)
    estimates = _estimates(database)
    likely = [item for item in ranked if item.is_likely and item.name not in estimates]
    return _choice(force.quantity, likely[0], likely) if likely else None


def unclear_forces(database: Database, taken: Iterable[Choice]) -> list[RankedSignal]:
    """Measured forces of which nothing says where they act, the likeliest first.

    A force that another node could take from the bridge is none of them.
    """
    messages = list(database.messages.values())
    names = {choice.name for choice in taken} | _estimates(database)
    ranked = [
        sorted(rank_signals(messages, kind), key=lambda item: item.name)
        for kind in (signal_ranking.APPLIED_FORCE, signal_ranking.STRUT_FORCE)
    ]
    found = [max(same, key=lambda item: item.score) for same in zip(*ranked, strict=True)]
    likely = [{it.name for it in same if it.is_likely} for same in ranked]
    suits_both = likely[0] & likely[1]
    free = [
        item
        for item in found
        if item.name not in names
        and ((item.score > _ELSEWHERE and not item.is_likely) or item.name in suits_both)
    ]
    return sorted(free, key=lambda item: -item.score)


def _estimates(database: Database) -> set[str]:
    """Forces that are likely to be an estimate, which nothing measures."""
    ranked = rank_signals(database.messages.values(), signal_ranking.ESTIMATE)
    return {item.name for item in ranked if item.is_likely}


def find_temperature(database: Database, sender: str | None, named: str | None) -> Choice | None:
    """The temperature of the damper: named, clear by its name, or of the height's sender.

    Raises:
        InputError: There is no signal of that name.
    """
    ranked = rank_signals(database.messages.values(), signal_ranking.TEMPERATURE)
    if named is not None:
        return _named(database, TEMPERATURE, named, ranked, "--temperature")
    likely = [
        item
        for item in ranked
        if item.is_likely or (item.score > 0.0 and item.message.sender == sender)
    ]
    return _choice(TEMPERATURE, likely[0], likely) if likely else None


def _force_likeness(force: Force) -> Likeness:
    return signal_ranking.APPLIED_FORCE if force is Force.APPLIED else signal_ranking.STRUT_FORCE


def _named(
    database: Database, quantity: Quantity, name: str, ranked: Sequence[RankedSignal], option: str
) -> Choice:
    message_name, dot, signal_name = name.partition(".")
    if not dot:
        or_none = "" if quantity is HEIGHT else ", or none"
        raise InputError(f"{option} {name}: expected MESSAGE.SIGNAL{or_none}")
    message = database.message(message_name)
    signal = message.signal(signal_name)
    if not measures(signal, quantity.dimension):
        names = [item.name for item in ranked]
        unit = f"has the unit {signal.unit!r}" if signal.unit else "has no unit"
        if signal_ranking.is_count(signal):
            line = _line_with_unit(signal, quantity.dimension)
            raise InputError(
                f"{option} {name}: {unit}, expected one of {quantity.dimension.name.lower()}: "
                f"state scale and unit in a copy of the DBC, in {message.name}: {line} and the "
                "receivers as before"
            )
        raise InputError(
            f"{option} {name}: {unit}, expected one of {quantity.dimension.name.lower()}"
            + (f": {expected_name(name, names)}" if names else "")
        )
    return Choice(quantity, message, signal, "as named", ())


def _line_with_unit(signal: Signal, dimension: Dimension) -> str:
    """What to write into the DBC for a signal whose unit is not known."""
    kind = f"{'0' if signal.is_big_endian else '1'}{'-' if signal.is_signed else '+'}"
    unit = "mm" if dimension is Dimension.LENGTH else dimension.value
    return (
        f"`SG_ {signal.name} : {signal.start}|{signal.length_bits}@{kind} (SCALE,0) [0|0] "
        f'"{unit}"`, with SCALE in {unit} per count'
    )


def _choice(quantity: Quantity, best: RankedSignal, ranked: Sequence[RankedSignal]) -> Choice:
    others = tuple(item.name for item in ranked if item is not best)
    return Choice(quantity, best.message, best.signal, best.why, others)


@dataclass(frozen=True)
class Proposal:
    """What a bench's configuration is made of.

    Attributes:
        is_motion_prescribed: Whether the bench is a dyno.
    """

    database: Database
    signals: Signals
    bus: BusConfig
    is_motion_prescribed: bool

    def text(self, dbc: str, model: str) -> str:
        """YAML of the configuration, with the reasons in comments.

        Args:
            dbc: The DBC's path, from the configuration's folder.
            model: The model's path, likewise.
        """
        signals, bus = self.signals, self.bus
        message, signal = signals.height.message, signals.height.signal
        observer = (
            ["prescribed_motion: {settling_s: 0.002}   # a dyno: the bench moves the strut"]
            if self.is_motion_prescribed
            else propose_observer(
                si_step(message, signal.name, HEIGHT.dimension), message.cycle_time_ns
            )
        )
        lines = [
            f"# Proposed from {self.database.path.name}: read it before a bench moves.",
            *_rate(message.cycle_time_ns),
            f"model: {model}",
            f"dbc: {dbc}",
            _bus_line(bus),
            "signals:",
            *(line for choice in signals.choices for line in _signal_lines(choice)),
            *(
                f"  # {item.name}: a force; applied_force (on the body) or load_cell_force?"
                for item in signals.unclear[:_MOST_OTHERS]
            ),
            *_propose_publish(self.database, signals),
            *observer,
            *_supervision(signals),
        ]
        return "\n".join(lines) + "\n"


def _bus_line(bus: BusConfig) -> str:
    rate = "" if bus.interface in WITHOUT_BIT_RATE else f", bitrate: {bus.bitrate}"
    return f"bus: {{interface: {bus.interface}, channel: {bus.channel}{rate}}}"


def _rate(interval_ns: int | None) -> list[str]:
    rate_hz = None if interval_ns is None else 1e9 / interval_ns
    if rate_hz is None or not _LEAST_RATE_HZ <= rate_hz <= _LARGEST_RATE_HZ:
        return [f"rate_hz: {_USUAL_RATE_HZ:g}"]
    return [f"rate_hz: {rate_hz:g}   # that of the height"]


def _signal_lines(choice: Choice) -> list[str]:
    keys = {"message": choice.message.name, "signal": choice.signal.name}
    checks = _frame_checks(choice)
    entry = ", ".join(f"{key}: {value}" for key, value in (keys | checks).items())
    hints = _hints_at_checks(choice, checks)
    return [f"  # {choice.comment}", *hints, f"  {choice.quantity.key}: {{{entry}}}"]


def _hints_at_checks(choice: Choice, found: Mapping[str, str]) -> list[str]:
    """Comments on what of a message may state its validity and count its frames, if not found."""
    small = [
        item
        for item in choice.message.signals.values()
        if not item.unit and not item.is_float and item.name != choice.signal.name
    ]
    bits = [item.name for item in small if item.length_bits == 1]
    counters = [item for item in small if item.length_bits in _COUNTER_BITS]
    # What its comment calls a counter comes first.
    counters = [it.name for it in sorted(counters, key=lambda item: not _counts(item))]
    hints: list[str] = []
    if "valid" not in found and bits:
        hints.append(
            f"  # if a bit marks it as valid, add: valid: {{signal: {bits[0]}, value: 1}}"
            + _or_others(bits)
        )
    if "counter" not in found and counters and choice.message.protection is None:
        hints.append(
            f"  # if a signal counts its frames, add: counter: {counters[0]}" + _or_others(counters)
        )
    return hints


def _frame_checks(choice: Choice) -> dict[str, str]:
    """Keys of what a message contains about its frames: validity and counter."""
    found: dict[str, str] = {}
    message = choice.message
    valid = _find_flag(message, choice.signal)
    if valid is not None:
        name, value = valid
        found["valid"] = f"{{signal: {name}, value: {value}}}"
    if message.protection is None:
        counters = [item for item in message.signals.values() if _is_counter(message, item)]
        if len(counters) == 1:
            found["counter"] = counters[0].name
    return found


def _find_flag(message: Message, measured: Signal) -> tuple[str, int] | None:
    """A signal that says whether a message's values hold, with the value that says they do."""
    flags = [
        signal
        for signal in message.signals.values()
        if not signal.unit and not signal.is_float and signal.length_bits <= 2
        if _states_validity(signal) or _has_word(signal, _FAULT_WORDS)
    ]
    # The signal's own, or one that belongs to no other signal; a counter is of the whole message.
    own = [item for item in flags if _shares_a_word(item.name, measured.name)]
    others = [
        item.name
        for item in message.signals.values()
        if item not in (*flags, measured) and not _is_counter(message, item)
    ]
    common = [it for it in flags if not any(_shares_a_word(it.name, other) for other in others)]
    chosen = own or common
    if len(chosen) != 1:
        return None
    (flag,) = chosen
    for raw, text in flag.choices.items():
        if text.lower().startswith(_OK_CHOICES):
            return flag.name, raw
    return flag.name, 0 if _has_word(flag, _FAULT_WORDS) else 1


def _is_described_as_valid(signal: Signal) -> bool:
    """Whether a comment says that 1 is the value of something that works."""
    return (
        re.match(rf"1\s*[:=]?\s*(?:\w+\s+)?(?:is\s+)?{_WORKS}\b", signal.comment.lower())
        is not None
    )


def _counts(signal: Signal) -> bool:
    return _COUNTS.search(signal.comment.lower()) is not None


def _states_validity(signal: Signal) -> bool:
    """Whether name, comment or values of a signal say that it marks something as valid."""
    values = [text.lower() for text in signal.choices.values()]
    return (
        _has_word(signal, _VALID_WORDS)
        or _is_described_as_valid(signal)
        or any(value.startswith(_OK_CHOICES) for value in values)
    )


def _shares_a_word(one: str, other: str) -> bool:
    return bool(set(signal_ranking.split_name(one)) & set(signal_ranking.split_name(other)))


def _has_word(signal: Signal, words: Sequence[str]) -> bool:
    return any(word in signal.name.lower() for word in words)


def _is_counter(message: Message, signal: Signal) -> bool:
    if signal.unit or not _has_word(signal, _COUNTER_WORDS) or message.cycle_time_ns is None:
        return False
    try:
        alive_counter(message, signal.name)
    except DatabaseError:
        return False
    return True


def _propose_publish(database: Database, signals: Signals) -> list[str]:
    """Lines of what could carry the estimate, its validity and the bridge's mode."""
    bench = signals.height.message.sender
    listened = {choice.message.name for choice in signals.choices}
    messages = [item for item in database.messages.values() if item.name not in listened]
    # A DBC that names no nodes does not determine who sends what.
    free = [item for item in messages if item.sender != bench] or messages
    estimates = [item for item in rank_signals(free, signal_ranking.ESTIMATE) if item.is_likely]
    if not estimates:
        forces = [
            (item, signal)
            for item in free
            for signal in item.signals.values()
            if item.sender != bench and measures(signal, Dimension.FORCE)
        ]
        return [*_hint_at_messages(forces, free), *_lines_of_own_message(database)]
    best = estimates[0]
    line = _publish_line(FORCE.key, best, estimates)
    return _lines_of_estimate(best.message, line, free)


def _lines_of_estimate(message: Message, force: str, free: Sequence[Message]) -> list[str]:
    """Lines that publish the estimate in a message: force, validity, counter, and the mode."""
    lines = ["publish:", force]
    # Validity and mode may have another message, but never one that another node sends.
    near = [message, *(it for it in free if it is not message and it.sender == message.sender)]
    valid = _find_integer(near, _states_validity, lambda bits: bits >= 1)
    lines += (
        [f"  {VALID.key}: {{message: {valid[0].name}, signal: {valid[1].name}}}"]
        if valid
        else [
            *_hint_at_bits(message),
            "  # valid: no signal looks like it; without one a lost estimate looks like a force:",
            "  # unsafe: {publish_without_valid: true} accepts that",
        ]
    )
    if message.protection is None:
        counter = _find_integer(
            [message],
            lambda signal: _has_word(signal, _COUNTER_WORDS) or _counts(signal),
            lambda bits: bits > 1,
        )
        if counter:
            entry = f"{{message: {counter[0].name}, signal: {counter[1].name}}}"
            lines.append(f"  {COUNTER.key}: {entry}")
    state = _find_integer(
        near, lambda signal: _has_word(signal, _STATE_WORDS), lambda bits: bits >= _LEAST_STATE_BITS
    )
    if any(item.name == STATUS_MESSAGE for item in free):
        lines.append(f"status: {STATUS_MESSAGE}")
    elif state:
        entry = f"{{message: {state[0].name}, signal: {state[1].name}}}"
        lines += ["status:", f"  state: {entry}"]
    return lines


def _hint_at_bits(message: Message) -> list[str]:
    """A comment that names the bits of a message, one of which may mark the estimate as valid."""
    bits = [item.name for item in message.signals.values() if item.length_bits == 1]
    if not bits:
        return []
    entry = f"valid: {{message: {message.name}, signal: {bits[0]}}}"
    return [f"  # if this is its bit: {entry}{_or_others(bits)}"]


def _or_others(names: Sequence[str]) -> str:
    """All names but the first, as what it could be instead; empty without any."""
    return f"; or {', '.join(names[1:])}" if names[1:] else ""


def _hint_at_messages(
    forces: Sequence[tuple[Message, Signal]], free: Sequence[Message]
) -> list[str]:
    """A comment that names messages which may carry the estimate, with the lines of the first."""
    if not forces:
        return []
    names = [f"{message.name} ({signal.name})" for message, signal in forces[:_MOST_OTHERS]]
    message, signal = forces[0]
    force = f"  {FORCE.key}: {{message: {message.name}, signal: {signal.name}}}"
    return [
        "# A force in a message that the sender of the height does not send may be meant for the",
        f"# estimate: {', '.join(names)}. If so, remove the # before these lines:",
        *(f"# {line}" for line in _lines_of_estimate(message, force, free)),
    ]


def _lines_of_own_message(database: Database) -> list[str]:
    """A message for the estimate that the DBC lacks, and how it is published, as comments."""
    used = {message.arbitration_id for message in database.messages.values()}
    free = (number for number in range(_FIRST_OWN_ID, _LAST_OWN_ID) if number not in used)
    own = next(free, _FIRST_OWN_ID)
    return [
        "# No message of the DBC is surely one for the estimate, so it is not published. To",
        "# publish it in one of your own, add these three lines to the DBC, after its last",
        "# message (BO_), with an identifier that is free on your bus (here",
        f"# {own:#x}, that is {own}), and remove the # before publish and the two lines below it:",
        f"# BO_ {own} RIG_ESTIMATE: 5 Vector__XXX",
        '#  SG_ FORCE : 0|32@1- (0.001,0) [-2000000|2000000] "N" Vector__XXX',
        '#  SG_ VALID : 32|1@1+ (1,0) [0|1] "" Vector__XXX',
        "# publish:",
        "#   force: {message: RIG_ESTIMATE, signal: FORCE}",
        "#   valid: {message: RIG_ESTIMATE, signal: VALID}",
    ]


def _publish_line(key: str, best: RankedSignal, found: Sequence[RankedSignal]) -> str:
    others = [item.name for item in found if item is not best][:_MOST_OTHERS]
    comment = best.why + (f"; or {', '.join(others)}" if others else "")
    return f"  {key}: {{message: {best.message.name}, signal: {best.signal.name}}}   # {comment}"


def _find_integer(
    messages: Iterable[Message], is_meant: Callable[[Signal], bool], fits: Callable[[int], bool]
) -> tuple[Message, Signal] | None:
    """The first integer signal without a unit that is meant, and whose bits fit."""
    found = (
        (message, signal)
        for message in messages
        for signal in sorted(message.signals.values(), key=lambda item: item.length_bits)
        if not signal.unit and not signal.is_float and fits(signal.length_bits)
        if is_meant(signal)
    )
    return next(found, None)


def propose_observer(step_m: float, interval_ns: int | None) -> list[str]:
    """Lines of an observer that is stable until it is tuned.

    Args:
        step_m: Step of the height; 0 where it is unknown.
        interval_ns: Time between two heights, if it is known.
    """
    noise_std_m = step_m / math.sqrt(12.0) or _UNKNOWN_NOISE_M
    observer = KalmanObserver.before_tuning(noise_std_m, interval_ns or _UNKNOWN_INTERVAL_NS)
    found = observer.filter
    return [
        "observers:",
        f"  {STRUT}:   # slow and stable; rig tune finds a better one",
        f"    kind: {observer.kind}",
        f"    filter: {{bandwidth_hz: {found.bandwidth_hz:.4g}, "
        f"noise_std_m: {found.noise_std_m:.3e}}}",
    ]


def _supervision(signals: Signals) -> list[str]:
    """Lines of ages and limits that follow from the messages."""
    cycle_s = (signals.height.message.cycle_time_ns or _UNKNOWN_INTERVAL_NS) * 1e-9
    stale_s = max(_LEAST_STALE_S, _STALE_CYCLES * cycle_s)
    rate = _LARGEST_RATE_M_PER_S
    lines = [
        "supervision:",
        f"  stale_after_s: {stale_s:g}",
        f"  safe_after_s: {max(0.5, 5.0 * stale_s):g}",
        "  limits:",
        f"    - {{value: measured_rate_m_per_s, low: {-rate:g}, high: {rate:g}, action: refuse}}",
        "    # A sensor that has frozen; remove the line for one that repeats itself at rest.",
        f"    - {{value: unchanged_s, high: {_FROZEN_S:g}, action: hold}}",
    ]
    lines += [
        "    # An estimate that is less certain than you accept: largest standard deviation, N.",
        "    # - {value: force_std_n, high: 100, action: hold}",
        "    # The travel of the strut, as measured (height_m would be the model's height, which",
        "    # goes beyond that of the bench until the observer is tuned).",
        "    # - {value: measured_height_m, low: 0.1, high: 0.5, action: safe}",
    ]
    if signals.measures(Force.APPLIED):
        lines += [
            "    # The same for the applied force, unless it may be constant for longer.",
            f"    # - {{channel: {APPLIED_FORCE.key}, value: unchanged_s, high: {_FROZEN_S:g}, "
            "action: hold}",
        ]
        if signals.measures(Force.IN_STRUT):
            lines += [
                "    # Against a wrong scale or mass: largest difference to the load cell, N.",
                "    # - {value: force_difference_n, low: -100, high: 100, action: hold}",
            ]
    return lines
