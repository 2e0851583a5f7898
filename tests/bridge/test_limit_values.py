"""Limits by themselves: what is within, the bound that is passed, and the range that they leave."""

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from pydantic import ValidationError

from rig.bridge.supervision_limits import (
    COMPARED,
    Action,
    Delay,
    Excess,
    Limit,
    LimitedValue,
    Plausibility,
    explain_measurement,
    find_excess,
    find_violations,
    inherit_delays,
    judge_measurement,
    range_of_estimate,
    update_delays,
    values_of_estimate,
    worst_action,
)
from rig.bridge.values import StrutOutput

MS = 1_000_000
OUTPUT = StrutOutput(20.0, 3.0, True, 0.4, 0.0, 0.0, 0.001, 5.0)
"""Force 20 ± 5 N, virtual force 3 N, height 0.4 m, innovation 1 mm."""


def estimate(**changes):
    return values_of_estimate(replace(OUTPUT, **changes))


STRUT = estimate()

ESTIMATES = {
    "height_m": 0.4,
    "force_n": 20.0,
    "virtual_force_n": 3.0,
    "innovation_m": 0.001,
    "force_std_n": 5.0,
}
MEASURED = ("measured_height_m", "measured_rate_m_per_s", "unchanged_s")
OF_CHANNELS = ("measured", "measured_rate_per_s", "unchanged_s")
bounds = st.one_of(st.none(), st.floats(-10.0, 10.0))


def row(value, action="warn", low=None, high=None):
    return Limit(value=LimitedValue(value), low=low, high=high, action=action)


def test_every_value_is_of_the_measurement_or_of_the_estimate():
    measured = {item.value for item in LimitedValue if item.is_measured}
    assert measured == {*MEASURED, *OF_CHANNELS}
    estimates = {item.value for item in LimitedValue if not item.is_measured}
    assert estimates - {item.value for item in COMPARED} == set(ESTIMATES)


def test_actions_are_ordered_by_their_severity_and_none_is_no_action():
    assert [action.name for action in sorted(Action)] == ["WARN", "REFUSE", "HOLD", "SAFE"]
    assert all(Action)


@pytest.mark.parametrize("value", MEASURED)
def test_a_measurement_can_be_refused(value):
    assert row(value, "refuse", high=1.0).action_at(2.0) == Action.REFUSE


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        ({"low": 1.0, "high": 1.0}, "expected less than high"),
        ({"low": 1.0, "high": 2.0, "strut": ""}, "at least 1 character"),
        ({"low": 1.0, "high": 2.0, "strut": "s" * 256}, "at most 255 characters"),
        ({"low": 1.0, "hihg": 2.0}, "hihg"),
        ({"low": math.inf}, "finite"),
    ],
)
def test_a_row_that_cannot_be(cells, expected):
    with pytest.raises(ValidationError, match=expected):
        Limit(**{"value": "force_n", "action": "warn"} | cells)


def test_a_name_of_a_strut_may_have_as_many_characters_as_one_of_the_dbc():
    assert len(Limit(value="force_n", high=1.0, action="warn", strut="s" * 255).strut) == 255


def test_the_bound_is_the_one_that_the_value_is_beyond():
    within = row("force_n", low=-2.0, high=5.0)
    assert [within.bound_beyond(value) for value in (-2.1, 5.1, math.nan)] == [-2.0, 5.0, 5.0]
    above, below = row("force_n", low=-2.0), row("force_n", high=5.0)
    assert [above.bound_beyond(value) for value in (-2.1, math.nan)] == [-2.0, -2.0]
    assert [below.bound_beyond(value) for value in (5.1, math.nan)] == [5.0, 5.0]


@given(bounds, bounds, st.floats(-11.0, 11.0))
def test_what_is_beyond_a_limit_is_beyond_its_bound(low, high, value):
    if (low is None and high is None) or (None not in (low, high) and low >= high):
        return
    limit = row("force_n", "safe", low, high)
    bound = limit.bound_beyond(value)
    is_low, is_high = low is not None and value < low, high is not None and value > high
    assert limit.action_at(value) == (Action.SAFE if is_low or is_high else 0)
    if is_low or is_high:
        assert bound == (low if is_low else high)


LAST = Plausibility(0.5, 10 * MS, 4 * MS, MS // 2)
"""0.5 m at 10 ms, and the same since 4 ms; two measurements are half a millisecond apart."""


@pytest.mark.parametrize(
    ("t_ns", "rate_m_per_s"),
    [
        (12 * MS, 0.5),
        (10 * MS + MS // 2, 2.0),
        (10 * MS + 1, 2.0),  # not in a nanosecond, but half a cycle at least
        (10 * MS, 2.0),
        (9 * MS, 2.0),
    ],
)
def test_the_rate_is_the_change_over_the_time_but_half_a_cycle_at_least(t_ns, rate_m_per_s):
    rate = row("measured_rate_m_per_s", "warn", high=0.1)
    excess = explain_measurement([rate], LAST, (3, 0.501), t_ns, Action.WARN)
    assert excess == Excess(3, LimitedValue.MEASURED_RATE_M_PER_S, pytest.approx(rate_m_per_s), 0.1)


def test_a_falling_height_has_a_negative_rate():
    rate = row("measured_rate_m_per_s", "warn", low=-0.1)
    excess = explain_measurement([rate], LAST, (0, 0.498), 12 * MS, Action.WARN)
    assert (excess.number, excess.bound) == (pytest.approx(-1.0), -0.1)


def test_a_height_is_unchanged_since_the_first_of_its_kind():
    stuck = row("unchanged_s", "warn", high=0.001)
    excess = explain_measurement([stuck], LAST, (0, 0.5), 12 * MS, Action.WARN)
    assert (excess.number, excess.bound) == (pytest.approx(0.008), 0.001)
    assert explain_measurement([stuck], LAST, (0, 0.5001), 12 * MS, Action.WARN) is None


def test_the_limit_that_requires_the_action_explains_it():
    rows = [
        row("measured_height_m", "warn", high=0.6),
        row("measured_height_m", "refuse", high=0.7),
        row("measured_height_m", "refuse", high=0.65),
    ]
    at = (1, 0.8), 12 * MS
    height = LimitedValue.MEASURED_HEIGHT_M
    assert explain_measurement(rows, LAST, *at, Action.WARN) == Excess(1, height, 0.8, 0.6)
    assert explain_measurement(rows, LAST, *at, Action.REFUSE) == Excess(1, height, 0.8, 0.7)
    assert explain_measurement(rows, LAST, *at, Action.SAFE) is None


def test_a_height_that_is_used_is_what_the_next_is_compared_with():
    assert judge_measurement([], LAST, 0.6, 12 * MS) == (
        Plausibility(0.6, 12 * MS, 12 * MS, MS // 2),
        0,
    )
    assert judge_measurement([], LAST, 0.5, 12 * MS) == (
        Plausibility(0.5, 12 * MS, 4 * MS, MS // 2),
        0,
    )
    warned = row("measured_height_m", "warn", high=0.55)
    memory, action = judge_measurement([warned], LAST, 0.6, 12 * MS)
    assert (memory.value, action) == (0.6, Action.WARN)


@pytest.mark.parametrize("action", ["refuse", "hold", "safe"])
def test_a_height_that_is_not_used_is_forgotten(action):
    limit = row("measured_height_m", action, high=0.55)
    assert judge_measurement([limit], LAST, 0.6, 12 * MS) == (LAST, Action[action.upper()])


def test_the_first_height_has_no_rate_and_is_unchanged_for_no_time():
    rows = [
        row("measured_rate_m_per_s", "safe", low=-1e-9, high=1e-9),
        row("unchanged_s", "safe", high=1e-12),
    ]
    assert judge_measurement(rows, None, 0.5, 7) == (Plausibility(0.5, 7, 7, 1), 0)


@pytest.mark.parametrize("value", ESTIMATES)
def test_each_limit_on_an_estimate_is_held_against_its_own_quantity(value):
    number = ESTIMATES[value]
    within, beyond = row(value, high=number), row(value, high=0.99 * number)
    assert worst_action([within], STRUT) == 0
    assert worst_action([beyond], STRUT) == Action.WARN
    expected = Excess(0, LimitedValue(value), number, 0.99 * number)
    assert find_excess([[within, beyond]], [STRUT], Action.WARN) == expected


def test_the_severest_limit_on_an_estimate_counts():
    for order in itertools.permutations(
        [row("force_n", "warn", high=1.0), row("height_m", "safe", high=0.3), row("force_n", low=1)]
    ):
        assert worst_action(order, STRUT) == Action.SAFE
    assert worst_action([], STRUT) == 0


def test_the_first_strut_and_its_first_limit_that_require_an_action_are_found():
    limits = [
        [row("force_n", "hold", high=30.0), row("height_m", "hold", high=0.5)],
        [row("force_n", "warn", high=30.0), row("height_m", "hold", high=0.5)],
    ]
    high, pushed = estimate(height_m=0.6), estimate(height_m=0.6, force_n=40.0)
    height, force = LimitedValue.HEIGHT_M, LimitedValue.FORCE_N
    assert find_excess(limits, [STRUT, STRUT], Action.HOLD) is None
    assert find_excess(limits, [STRUT, pushed], Action.HOLD) == Excess(1, height, 0.6, 0.5)
    assert find_excess(limits, [STRUT, pushed], Action.WARN) == Excess(1, force, 40.0, 30.0)
    assert find_excess(limits, [high, pushed], Action.HOLD) == Excess(0, height, 0.6, 0.5)
    assert find_excess(limits, [pushed, pushed], Action.HOLD) == Excess(0, force, 40.0, 30.0)


@given(
    st.lists(st.tuples(st.sampled_from(list(ESTIMATES)), bounds, bounds), max_size=6),
    st.floats(-11.0, 11.0),
    st.floats(-11.0, 11.0),
)
def test_within_the_range_of_an_estimate_no_limit_on_height_or_force_is_passed(
    cells, height_m, force_n
):
    rows = [
        row(value, "warn", low, high)
        for value, low, high in cells
        if (low, high) != (None, None) and (None in (low, high) or low < high)
    ]
    low_m, high_m, low_n, high_n = range_of_estimate(rows)
    strut = estimate(height_m=height_m, force_n=force_n)
    ranged = [item for item in rows if item.value.value in ("height_m", "force_n")]
    is_within = low_m <= height_m <= high_m and low_n <= force_n <= high_n
    assert is_within == (worst_action(ranged, strut) == 0)


def test_of_several_limits_the_narrowest_bounds_the_range_of_an_estimate():
    rows = [row("force_n", "warn", -a, a) for a in (5.0, 3.0, 4.0)]
    rows += [row("height_m", "warn", 0.3 - a, 0.3 + a) for a in (0.1, 0.05, 0.2)]
    assert range_of_estimate(rows) == (0.25, 0.35, -3.0, 3.0)


def test_without_limits_the_range_of_an_estimate_has_no_end():
    others = [row("virtual_force_n", high=1.0), row("innovation_m", low=-1.0)]
    assert range_of_estimate(others) == (-math.inf, math.inf, -math.inf, math.inf)


def delayed(value="force_n", action="hold", for_s=0.01, low=None, high=10.0, clear_s=None):
    return Limit(value=value, low=low, high=high, for_s=for_s, clear_s=clear_s, action=action)


def test_a_delay_is_of_estimates_alone():
    assert row("force_n", high=1.0).for_s == 0.0
    for value in MEASURED:
        assert Limit(value=value, high=1.0, action="warn", for_s=0.0).for_s == 0.0
        for key in ("for_s", "clear_s"):
            with pytest.raises(ValidationError, match=f"{key} .* expected none, because a measure"):
                Limit(value=value, high=1.0, action="warn", **{key: 0.001})
    with pytest.raises(ValidationError, match="for_s"):
        delayed(for_s=-0.001)


def passed_at(limit, *forces_n, begin_ns=0, delays=()):
    """Whether a delayed limit counts as passed, after each of some forces a millisecond apart."""
    found = []
    for number, force_n in enumerate(forces_n):
        struts = [estimate(force_n=force_n)]
        delays = update_delays([(0, limit)], delays, struts, begin_ns + number * MS)
        found.append(delays[0].is_passed)
    return found


@pytest.mark.parametrize("begin_ns", [0, 7 * MS])
def test_a_delayed_limit_is_passed_and_left_when_it_has_been_so_for_its_time(begin_ns):
    limit = delayed(for_s=0.003)
    forces_n = [5.0, *[20.0] * 5, *[5.0] * 5]
    # The last force within came at 0 ms, and the last one beyond at 5 ms.
    expected = [False] * 3 + [True] * 5 + [False] * 3
    assert passed_at(limit, *forces_n, begin_ns=begin_ns) == expected


def test_a_limit_may_be_left_later_than_it_is_passed():
    forces_n = [20.0, *[5.0] * 4]
    assert passed_at(delayed(for_s=0.0, clear_s=0.003), *forces_n) == [True] * 3 + [False] * 2
    assert passed_at(delayed(for_s=0.0), *forces_n) == [True] + [False] * 4
    assert passed_at(delayed(for_s=0.003, clear_s=0.0), *[20.0] * 4, 5.0, begin_ns=MS) == [
        *[False] * 3,
        True,
        False,
    ]


def test_only_a_difference_from_the_load_cell_is_left_after_a_time_of_its_own():
    """By default: a force that swings around the right one is not right where it crosses it."""
    for value, clear_s in (("force_n", 0.0), ("force_difference_n", 1.0)):
        assert delayed(value, for_s=0.0).cleared_after_s == clear_s
        assert delayed(value, for_s=0.0).has_memory == bool(clear_s)
        assert delayed(value, for_s=2.0).cleared_after_s == 2.0
        assert delayed(value, for_s=2.0, clear_s=0.0).cleared_after_s == 0.0
        assert not delayed(value, for_s=0.0, clear_s=0.0).has_memory


def test_before_an_estimate_has_settled_its_history_requires_nothing():
    rows = [(0, delayed("force_rate_n_per_s", "safe")), (0, delayed("force_n", "hold"))]
    passed = (Delay(is_passed=True, since_ns=0),) * 2
    assert find_violations(rows, passed, is_settled=False) == rows[1:]
    assert find_violations(rows, passed, is_settled=True) == rows


def test_a_delay_is_over_to_the_nanosecond_whatever_its_decimals():
    begun, struts = [Delay(is_passed=False, since_ns=0)], [STRUT]
    for for_s, after_ns in ((0.0041, 4_100_000), (3600.0, 3_600_000_000_000)):
        limit = delayed(for_s=for_s)
        for t_ns, is_passed in ((after_ns - 1, False), (after_ns, True)):
            assert update_delays([(0, limit)], begun, struts, t_ns)[0].is_passed == is_passed


def test_a_delayed_limit_forgets_what_was_shorter_than_its_time():
    limit = delayed(for_s=0.003)
    assert not any(passed_at(limit, *[5.0, 20.0, 20.0] * 5))
    begun = [Delay(is_passed=True, since_ns=-MS)]
    assert all(passed_at(limit, *[20.0, 5.0, 5.0] * 5, delays=begun))


def test_each_delayed_limit_is_held_against_its_own_strut_and_quantity():
    rows = [(1, delayed(for_s=0.001)), (0, delayed("height_m", for_s=0.001, high=0.5))]
    struts = [STRUT, estimate(force_n=5.0, height_m=0.6)]
    before = update_delays(rows, (), struts, 0)
    assert before == (Delay(is_passed=False, since_ns=0),) * 2
    assert update_delays(rows, before, struts, MS) == (Delay(is_passed=False, since_ns=MS),) * 2
    struts = [estimate(height_m=0.6), STRUT]
    assert update_delays(rows, before, struts, MS - 1) == before
    assert update_delays(rows, before, struts, MS) == (Delay(is_passed=True, since_ns=MS),) * 2


def test_with_other_limits_every_delay_begins_anew():
    passed = (Delay(is_passed=True, since_ns=0),)
    rows = [(0, delayed()), (0, delayed("height_m"))]
    struts = [estimate(force_n=20.0)]
    assert update_delays(rows, passed, struts, 5) == (Delay(is_passed=False, since_ns=5),) * 2


def test_limits_that_count_as_passed_are_found_with_their_struts():
    rows = [(number, delayed(action=action)) for number, action in enumerate(("warn", "hold"))]
    for is_passed in itertools.product((False, True), repeat=2):
        delays = [Delay(is_passed=item, since_ns=0) for item in is_passed]
        expected = [row for row, passed in zip(rows, is_passed, strict=True) if passed]
        assert find_violations(rows, delays, is_settled=True) == expected


def test_what_counts_as_passed_stays_so_under_other_limits():
    old = [
        (0, delayed("force_n", high=10.0)),
        (1, delayed("force_n", high=10.0)),
        (0, delayed("height_m", high=1.0)),
    ]
    states = [Delay(True, 5), Delay(False, 6), Delay(False, 7)]
    known = list(zip(old, states, strict=True))
    same, stricter = delayed("height_m", high=1.0), delayed("force_n", high=8.0)
    rows = [(0, delayed("innovation_m")), (0, same), (0, stricter), (1, stricter)]
    assert inherit_delays(rows, known, 100) == (
        Delay(False, 100),
        Delay(False, 7),
        Delay(True, 100),
        Delay(False, 100),
    )
    assert inherit_delays(old[::-1], known, 100) == tuple(states[::-1])


@pytest.mark.parametrize("key", ["for_s", "clear_s"])
def test_a_time_that_no_integer_of_nanoseconds_holds_is_refused(key):
    with pytest.raises(ValidationError, match=key):
        Limit(value="force_n", high=1.0, action="warn", **{key: 1e300})
