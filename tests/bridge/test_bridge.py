"""What a bridge computes beside its parts: the share of missed ticks, due times, filters."""

import pytest

from can_dbc.addressing import Filter
from rig.bridge.bridge import (
    _filters,  # pyright: ignore[reportPrivateUsage]
    _next_due_ns,  # pyright: ignore[reportPrivateUsage]
    _share_of_overruns,  # pyright: ignore[reportPrivateUsage]
)
from rig.bridge.devices import Device

CLAIMS = Filter(0x18EEFF00, 0x03FFFF00, is_extended=True)


@pytest.mark.parametrize("missed", [0, 1, 3, 10, 20, 21, 10**9])
def test_the_share_of_missed_ticks_is_a_mean_that_fades_over_two_hundred(missed):
    """Tick by tick: a missed one adds a two-hundredth of what is left, another one takes it."""
    share, expected = 0.2, 0.2
    for _ in range(min(missed, 20)):  # a pause of any length counts as twenty
        expected += (1.0 - expected) / 200.0
    expected -= expected / 200.0
    assert _share_of_overruns(share, missed) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("missed", [1, 3])
def test_of_a_loop_that_misses_the_same_number_again_and_again_the_share_is_theirs(missed):
    share = 0.0
    for _ in range(5000):
        share = _share_of_overruns(share, missed)
    assert share == pytest.approx(missed / (missed + 1), abs=0.01)


def test_a_share_fades_to_nothing():
    assert _share_of_overruns(0.0, 0) == 0.0
    share, ticks = 1.0, 0
    while share:
        share, ticks = _share_of_overruns(share, 0), ticks + 1
    assert 1000 < ticks < 10_000


@pytest.mark.parametrize(
    ("due", "now", "period", "expected"),
    [(0, 0, 10, 10), (0, 9, 10, 10), (0, 10, 10, 20), (3, 27, 10, 33), (7, 7, 0, 7), (7, 9, 0, 9)],
)
def test_a_message_is_due_on_its_own_grid(due, now, period, expected):
    assert _next_due_ns(due, now, period) == expected


@pytest.mark.parametrize(
    ("device", "expected"),
    [
        (Device("A", 1, 0x81, 0), {0x81, 0x701}),
        (Device("A", 0, 0, 0, j1939_name=5, address=3), {CLAIMS}),
    ],
)
def test_frames_of_devices_are_heard_and_claims_where_a_name_is_known(device, expected):
    filters = _filters((), (), (device,))
    found = {item if item == CLAIMS else item.arbitration_id for item in filters}
    assert found == expected
    assert all(item.is_extended == (item == CLAIMS) for item in filters)
    assert _filters((), (), ()) == ()
