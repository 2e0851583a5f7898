"""Limits on measurements and estimates, and what is done beyond them."""

from collections.abc import Iterable, Mapping, Sequence
from enum import Enum, IntEnum
from math import inf, nan
from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, model_validator

from can_dbc.yaml_file import Finite, Seconds
from rig.bridge.force_history import ForceHistory
from rig.bridge.values import StrutOutput


class Action(IntEnum):
    """What is done beyond a limit, the severest last.

    WARN reports it in the status. REFUSE also drops the measurement, with all of its frame. HOLD
    also marks the estimate invalid as long as it lasts. SAFE enters the safe state. HOLD and SAFE
    for a measurement drop it too.
    """

    WARN = 1
    REFUSE = 2
    HOLD = 3
    SAFE = 4


class LimitedValue(Enum):
    """What a limit is set on: the first five of a measurement, the others of the estimate."""

    MEASURED_HEIGHT_M = "measured_height_m"
    MEASURED_RATE_M_PER_S = "measured_rate_m_per_s"
    MEASURED = "measured"
    MEASURED_RATE_PER_S = "measured_rate_per_s"
    UNCHANGED_S = "unchanged_s"
    HEIGHT_M = "height_m"
    FORCE_N = "force_n"
    VIRTUAL_FORCE_N = "virtual_force_n"
    INNOVATION_M = "innovation_m"
    FORCE_STD_N = "force_std_n"
    FORCE_RATE_N_PER_S = "force_rate_n_per_s"
    FORCE_DIFFERENCE_N = "force_difference_n"

    @property
    def is_measured(self) -> bool:
        """Whether it is of the measurement."""
        return self in _MEASURED


_CROSSING_S = 1.0
"""Between two zero crossings of a motion of 0.5 Hz, slower than which few tests are."""

_MEASURED = (
    LimitedValue.MEASURED_HEIGHT_M,
    LimitedValue.MEASURED_RATE_M_PER_S,
    LimitedValue.MEASURED,
    LimitedValue.MEASURED_RATE_PER_S,
    LimitedValue.UNCHANGED_S,
)
_OF_CHANNELS = _MEASURED[2:]
_OF_CHANNELS_ALONE = (LimitedValue.MEASURED, LimitedValue.MEASURED_RATE_PER_S)


class Limit(BaseModel):
    """One entry of the list of limits.

    Attributes:
        strut: Strut to which the limit applies; every strut if absent.
        channel: Measured signal to which the limit applies, other than one under
            `signals.height`: a key of `signals` such as `applied_force`, or a further sensor as
            `STRUT.SENSOR`. If absent, the limit applies to a height or an estimate.
        value: Limited value, in SI units. Of a measured height: `measured_height_m`,
            `measured_rate_m_per_s`, or `unchanged_s` (time for which the reading stays exactly the
            same). Of another measured signal (`channel`): `measured`, `measured_rate_per_s` or
            `unchanged_s`. Of the estimate: `height_m`, `force_n`, `virtual_force_n` or
            `innovation_m`. Of an estimate that has settled: `force_std_n` (its standard deviation),
            `force_rate_n_per_s` (its change since the last tick, per second) or
            `force_difference_n` (estimated force less that of the load cell).
        low: Smallest permitted value; a limit has `low`, `high` or both.
        high: Largest permitted value.
        for_s: Time for which a value of the estimate has to be beyond the limit before the action
            begins.
        clear_s: Time for which a value of the estimate has to be within the limit before the action
            ends (the safe state lasts until it is acknowledged); by default `for_s`, and at least
            1 s for `force_difference_n`, because a wrong force that oscillates crosses the right
            one.
        action: Every action sets `limit_fault` in the status, counts the ticks beyond the limit
            (`limited` in `run.yaml`), and begins an excerpt if `log.most_captures` permits one;
            `warn` does not affect the estimate. `refuse` also refuses the frame of a measurement.
            `hold` makes the estimate invalid while the value is beyond the limit; `safe` enters
            the safe state. For a measurement, `hold` and `safe` refuse its frame, too.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    strut: Annotated[str, Field(min_length=1, max_length=255)] | None = None
    channel: Annotated[str, Field(min_length=1, max_length=511)] | None = None
    value: LimitedValue
    low: Finite | None = None
    high: Finite | None = None
    for_s: Seconds = 0.0
    clear_s: Seconds | None = None
    action: Literal["warn", "refuse", "hold", "safe"]

    @model_validator(mode="after")
    def _sensible(self) -> "Limit":
        if self.low is None and self.high is None:
            raise ValueError(f"{self.value.value}: expected low, high or both")
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ValueError(f"low {self.low}: expected less than high ({self.high})")
        if self.value is LimitedValue.UNCHANGED_S and (
            (self.low or 0.0) > 0.0 or (self.high or 0.0) <= 0.0
        ):
            raise ValueError("unchanged_s: expected high, more than 0, and no low")
        if self.action == "refuse" and not self.value.is_measured:
            raise ValueError(
                f"action refuse of {self.value.value}: expected warn, hold or safe, "
                "because only a measurement can be refused"
            )
        of_channel = self.channel is not None
        if of_channel and (self.strut is not None or self.value not in _OF_CHANNELS):
            names = ", ".join(value.value for value in _OF_CHANNELS)
            raise ValueError(
                f"{self.value.value} of channel {self.channel}: expected one of {names}, and no "
                "strut"
            )
        if not of_channel and self.value in _OF_CHANNELS_ALONE:
            raise ValueError(f"{self.value.value}: expected the key channel, such as applied_force")
        for key, time_s in (("for_s", self.for_s), ("clear_s", self.clear_s)):
            if time_s and self.value.is_measured:
                raise ValueError(
                    f"{key} of {self.value.value}: expected none, because a measurement is judged "
                    "by itself; unchanged_s is a time already"
                )
        return self

    @property
    def cleared_after_s(self) -> float:
        """How long an estimate has to be within the limit until the action ends."""
        if self.clear_s is not None:
            return self.clear_s
        is_difference = self.value is LimitedValue.FORCE_DIFFERENCE_N
        return max(self.for_s, _CROSSING_S) if is_difference else self.for_s

    @property
    def has_memory(self) -> bool:
        """Whether the action begins or ends later than a value passes the limit."""
        return self.for_s > 0.0 or self.cleared_after_s > 0.0

    def action_at(self, value: float) -> int:
        """Action at a value, 0 within the limit; a value that is not a number is beyond it."""
        is_high_enough = self.low is None or value >= self.low
        if is_high_enough and (self.high is None or value <= self.high):
            return 0
        return self.severity

    @property
    def severity(self) -> int:
        """The action as a number that grows with its severity."""
        return Action[self.action.upper()]

    def bound_beyond(self, value: float) -> float:
        """The bound that a value is beyond; one that is no number is beyond either."""
        is_low = self.low is not None and value < self.low
        bound = self.low if is_low or self.high is None else self.high
        return nan if bound is None else bound


LimitsByStrut = Sequence[Sequence[Limit]]
"""The limits of each strut, in the model's order."""


class Limits(NamedTuple):
    """The limits of a bridge.

    Attributes:
        struts: Of each strut, in the model's order; those on its measured height included.
        channels: Of each channel of the bench those on what it measures.
    """

    struts: LimitsByStrut
    channels: Sequence[Sequence[Limit]]


class Excess(NamedTuple):
    """A value beyond a limit: its strut, what it is, and the bound that it is beyond.

    Attributes:
        channel: The channel that measured it, where the limit names one.
    """

    strut: int
    value: LimitedValue
    number: float
    bound: float
    channel: str = ""

    @property
    def quantity(self) -> str:
        """What it is, in words of the configuration."""
        return f"{self.channel} {self.value.value}".lstrip()


class Plausibility(NamedTuple):
    """Last value of a channel that was used, its time, and since when it is the same.

    Attributes:
        shortest_ns: Time between two measurements at least: half a cycle.
    """

    value: float
    t_ns: int
    since_ns: int
    shortest_ns: int = 1


def _values_of_measurement(
    last: Plausibility, value: float, t_ns: int
) -> Mapping[LimitedValue, float]:
    """What limits on measurements are set on, of a new one."""
    change = value - last.value
    # Measurements with one time stamp, as of a queue that is read late, are not simultaneous.
    rate_per_s = change / (max(t_ns - last.t_ns, last.shortest_ns) * 1e-9)
    return {
        LimitedValue.MEASURED_HEIGHT_M: value,
        LimitedValue.MEASURED: value,
        LimitedValue.MEASURED_RATE_M_PER_S: rate_per_s,
        LimitedValue.MEASURED_RATE_PER_S: rate_per_s,
        LimitedValue.UNCHANGED_S: 0.0 if change else (t_ns - last.since_ns) * 1e-9,
    }


def explain_measurement(
    limits: Sequence[Limit],
    last: Plausibility,
    measured: tuple[int, float],
    t_ns: int,
    action: int,
) -> Excess | None:
    """Why a new value (its strut's index, and SI) requires an action; None if it does not."""
    strut, value = measured
    return _first_excess(limits, strut, _values_of_measurement(last, value, t_ns), action)


def judge_measurement(
    limits: Sequence[Limit], memory: Plausibility | None, value: float, t_ns: int
) -> tuple[Plausibility, int]:
    """Memory of a channel after a new value, and the severest action required, 0 if none.

    Before the first measurement there is no memory; `t_ns` is the time of arrival.
    """
    last = memory or Plausibility(value, t_ns, t_ns)
    values = _values_of_measurement(last, value, t_ns)
    action = max([limit.action_at(values[limit.value]) for limit in limits], default=0)
    if action >= Action.REFUSE:
        # What was used last stays the reference, but only for as long as the rate allows for.
        return last, action
    since_ns = last.since_ns if value == last.value else t_ns
    return last._replace(value=value, t_ns=t_ns, since_ns=since_ns), action


RANGED = (LimitedValue.HEIGHT_M, LimitedValue.FORCE_N)
"""Values of an estimate that `range_of_estimate` holds the limits of."""


RANGES_OF_MEASUREMENTS = (LimitedValue.MEASURED_HEIGHT_M, LimitedValue.MEASURED)
"""Values of a measurement that `range_of_measurement` holds the limits of."""


def range_of_estimate(limits: Sequence[Limit]) -> tuple[float, float, float, float]:
    """Range of height in m, then of force in N, within which none of a strut's limits is passed."""
    low_m, high_m = _common_range(row for row in limits if row.value is LimitedValue.HEIGHT_M)
    low_n, high_n = _common_range(row for row in limits if row.value is LimitedValue.FORCE_N)
    return low_m, high_m, low_n, high_n


def range_of_measurement(limits: Sequence[Limit]) -> tuple[float, float]:
    """Range of a channel's value within which none of its limits on it is passed."""
    return _common_range(row for row in limits if row.value in RANGES_OF_MEASUREMENTS)


def _common_range(limits: Iterable[Limit]) -> tuple[float, float]:
    rows = list(limits)
    low = max([row.low for row in rows if row.low is not None], default=-inf)
    return low, min([row.high for row in rows if row.high is not None], default=inf)


EstimateValues = Mapping[LimitedValue, float]
"""What limits on estimates are set on, of one strut."""


def values_of_estimate(strut: StrutOutput) -> EstimateValues:
    """The values of a strut's estimate that need nothing else."""
    return {
        LimitedValue.HEIGHT_M: strut.height_m,
        LimitedValue.FORCE_N: strut.force_n,
        LimitedValue.VIRTUAL_FORCE_N: strut.virtual_force_n,
        LimitedValue.INNOVATION_M: strut.innovation_m,
        LimitedValue.FORCE_STD_N: strut.force_std_n,
    }


COMPARED = (LimitedValue.FORCE_RATE_N_PER_S, LimitedValue.FORCE_DIFFERENCE_N)
"""Values of an estimate that need its history."""

OF_SETTLED = (LimitedValue.FORCE_STD_N, *COMPARED)
"""Values of an estimate that require nothing before it has settled."""


def values_with_history(
    struts: Sequence[StrutOutput], history: ForceHistory
) -> list[EstimateValues]:
    """The values of each strut's estimate, and those that need what was before."""
    return [
        {
            **values_of_estimate(strut),
            LimitedValue.FORCE_RATE_N_PER_S: rate_n_per_s,
            LimitedValue.FORCE_DIFFERENCE_N: difference_n,
        }
        for strut, rate_n_per_s, difference_n in zip(
            struts, history.rates_n_per_s, history.differences_n, strict=True
        )
    ]


def find_excess(
    limits: LimitsByStrut, values: Sequence[EstimateValues], action: int
) -> Excess | None:
    """The first estimate that requires an action, and its limit."""
    for index, own in enumerate(values):
        excess = _first_excess(limits[index], index, own, action)
        if excess is not None:
            return excess
    return None


def _first_excess(
    limits: Sequence[Limit], strut: int, values: Mapping[LimitedValue, float], action: int
) -> Excess | None:
    """The first value of a strut that requires an action, and its limit."""
    for limit in limits:
        number = values[limit.value]
        if limit.action_at(number) == action:
            return excess_of(limit, strut, number)
    return None


def excess_of(limit: Limit, strut: int, number: float) -> Excess:
    """What counts as beyond a limit; the value itself may be within it again."""
    bound, channel = limit.bound_beyond(number), limit.channel or ""
    return Excess(strut, limit.value, number, bound, channel)


def worst_action(limits: Sequence[Limit], values: EstimateValues) -> int:
    """The severest action that limits on estimates require of a strut, 0 if it is within them."""
    return max([limit.action_at(values[limit.value]) for limit in limits], default=0)


class Delay(NamedTuple):
    """State of a limit with a delay: whether it counts as passed, and since when it is not so."""

    is_passed: bool
    since_ns: int


def update_delays(
    rows: Sequence[tuple[int, Limit]],
    delays: Sequence[Delay],
    values: Sequence[EstimateValues],
    t_ns: int,
) -> tuple[Delay, ...]:
    """State of limits with a delay, each with the index of its strut, after a step.

    Without a state, as after a change of the limits, none of them counts as passed.
    """
    if len(delays) != len(rows):
        delays = [Delay(is_passed=False, since_ns=t_ns)] * len(rows)
    return tuple(
        _update_delay(delay, row, values[strut][row.value], t_ns)
        for delay, (strut, row) in zip(delays, rows, strict=True)
    )


def _update_delay(delay: Delay, row: Limit, number: float, t_ns: int) -> Delay:
    if bool(row.action_at(number)) is delay.is_passed:
        return Delay(delay.is_passed, t_ns)
    time_s = row.cleared_after_s if delay.is_passed else row.for_s
    if t_ns - delay.since_ns < round(time_s * 1e9):
        return delay
    return Delay(not delay.is_passed, t_ns)


def inherit_delays(
    rows: Sequence[tuple[int, Limit]],
    known: Sequence[tuple[tuple[int, Limit], Delay]],
    t_ns: int,
) -> tuple[Delay, ...]:
    """State of limits with a delay after others, whose states are known, were replaced by them.

    A limit that is the same continues; another one on the same value of the same strut counts as
    passed if one of those did.
    """

    def find(strut: int, row: Limit) -> Delay:
        for (other, old), delay in known:
            if other == strut and old == row:
                return delay
        passed = [
            delay.is_passed
            for (other, old), delay in known
            if other == strut and old.value is row.value
        ]
        return Delay(any(passed), t_ns)

    return tuple(find(strut, row) for strut, row in rows)


def find_violations(
    rows: Sequence[tuple[int, Limit]], delays: Sequence[Delay], *, is_settled: bool
) -> list[tuple[int, Limit]]:
    """The limits that count as passed, each with the index of its strut."""
    return [
        (strut, row)
        for (strut, row), delay in zip(rows, delays, strict=True)
        if delay.is_passed and (is_settled or row.value not in OF_SETTLED)
    ]
