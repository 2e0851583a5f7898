"""Clocks that a run waits on."""

from rig.machine.clock import OccupiedClock, VirtualClock


def test_a_wait_begins_with_what_there_is_to_do():
    clock, seen = VirtualClock(), []
    occupied = OccupiedClock(clock, lambda t_ns: seen.append((t_ns, clock.now_ns())))
    assert [occupied.wait_until(t_ns) for t_ns in (5, 9)] == [5, 9]
    assert seen == [(5, 0), (9, 5)]
    assert occupied.now_ns() == 9
    assert occupied.epoch_ns == occupied.epoch_now_ns() == 0
