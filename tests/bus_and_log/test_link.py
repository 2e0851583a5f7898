"""A bus that goes away and comes back, frames' times, and what the controller tells."""

import pytest
from msgspec.structs import replace

from can_dbc.frame import Frame
from rig.bus.bus import BusError, BusFullError
from rig.bus.link import FIRST_PAUSE_NS, SENDING_FAILED_NS, Link
from tests.bus_and_log.at_once import AtOnce

TICK_NS = 10_000_000
PASSIVE = Frame(0, 0x004, bytes([0, 0x20, 0, 0, 0, 0, 0, 0]), is_error=True)
ACTIVE_AGAIN = Frame(0, 0x004, bytes([0, 0x40, 0, 0, 0, 0, 0, 0]), is_error=True)
BUS_OFF = Frame(0, 0x040, bytes(8), is_error=True)


class ScriptedBus:
    """Answers each poll with the next of `polls`, and with nothing after them."""

    def __init__(self, *polls, sending=None, listens_only=False):
        self.epoch_ns = 0
        self.listens_only = listens_only
        self.sending = sending
        self.sent = []
        self.closed = False
        self._polls = list(polls)

    def receive(self, elapsed_ns):
        assert elapsed_ns > 0
        answer = self._polls.pop(0) if self._polls else []
        if isinstance(answer, Exception):
            raise answer
        return [replace(frame, t_ns=frame.t_ns - self.epoch_ns) for frame in answer]

    def send(self, frame):
        if self.sending is not None:
            raise self.sending
        self.sent.append(frame)

    def close(self):
        self.closed = True


def link_of(*buses, epoch_now_ns=lambda: 0):
    """A link whose openings give one of `buses` after the other; an error is raised."""
    waiting = list(buses)

    def open_bus():
        bus = waiting.pop(0)
        if isinstance(bus, Exception):
            raise bus
        return bus

    return Link(open_bus, epoch_now_ns, AtOnce())


def ticks(link, first, last):
    """Receive at every tick; returns the ticks that had a fault."""
    faulty = []
    for index in range(first, last):
        link.receive(index * TICK_NS)
        if link.fault is not None:
            faulty.append(index)
    return faulty


def test_an_interface_that_cannot_be_opened_at_the_start_is_an_error():
    with pytest.raises(BusError, match="no such device"):
        link_of(BusError("no such device"))


def test_a_bus_that_goes_is_opened_again_with_growing_pauses_and_the_gap_is_kept():
    gone = BusError("receiving failed: Network is down")
    first = ScriptedBus([], [], gone)
    still_down = [ScriptedBus(gone), BusError("cannot be opened"), ScriptedBus(gone)]
    back = ScriptedBus([Frame(0, 0x100, b"\1")])
    link = link_of(first, *still_down, back)
    faulty = ticks(link, 0, 200)
    assert first.closed
    assert faulty[0] == 2
    # 50 + 100 + 200 + 400 ms of pauses, and a tick or two to open each time.
    assert faulty[-1] < 2 + 75 + 3 * 4
    assert faulty == list(range(2, faulty[-1] + 1))
    assert link.fault is None
    (gap,) = link.figures.gaps
    assert (gap.from_ns, gap.to_ns) == (2 * TICK_NS, (faulty[-1] + 1) * TICK_NS)
    assert "Network is down" in gap.why


def test_ten_gaps_are_ten_gaps_and_each_begins_with_the_first_pause():
    gone = BusError("receiving failed: Network is down")
    link = link_of(*[ScriptedBus([], gone) for _ in range(10)], ScriptedBus())
    ticks(link, 0, 10 * (2 + FIRST_PAUSE_NS // TICK_NS + 3))
    assert len(link.figures.gaps) == 10
    lengths = {gap.to_ns - gap.from_ns for gap in link.figures.gaps}
    assert len(lengths) == 1
    assert link.fault is None


def test_nothing_is_sent_while_the_bus_is_away_and_what_was_sent_is_told():
    link = link_of(ScriptedBus(BusError("gone")), ScriptedBus())
    frame = Frame(0, 0x110, b"\1")
    assert list(link.send([frame])) == [frame]
    link.receive(0)
    assert list(link.send([frame])) == []


def test_a_bus_that_only_listens_sends_nothing():
    bus = ScriptedBus(listens_only=True)
    link = link_of(bus)
    assert list(link.send([Frame(0, 0x110, b"\1")])) == []
    assert bus.sent == []


def test_a_full_queue_is_a_fault_but_no_reason_to_open_anew():
    bus = ScriptedBus(sending=BusFullError("sending failed: Transmit buffer full"))
    link = link_of(bus)
    for index in range(200):
        link.receive(index * TICK_NS)
        assert list(link.send([Frame(0, 0x110, b"\1")])) == []
    assert link.fault is not None
    assert link.figures.unsent == 200
    assert not bus.closed
    bus.sending = None
    assert len(link.send([Frame(0, 0x110, b"\1")])) == 1
    assert link.fault is None


def test_a_bus_on_which_nothing_can_be_sent_for_long_is_opened_anew():
    broken = ScriptedBus(sending=BusError("sending failed: No such device"))
    link = link_of(broken, ScriptedBus())
    for index in range(2 + SENDING_FAILED_NS // TICK_NS):
        assert not broken.closed
        link.receive(index * TICK_NS)
        link.send([Frame(0, 0x110, b"\1")])
    assert broken.closed


def test_error_frames_are_counted_and_a_passive_controller_is_a_fault_until_it_is_active_again():
    link = link_of(
        ScriptedBus(
            [PASSIVE], [Frame(0, 0x100, b"")], [ACTIVE_AGAIN], [BUS_OFF], [], [Frame(0, 0x100, b"")]
        )
    )
    assert ticks(link, 0, 7) == [0, 1, 3, 4]
    figures = link.figures
    assert (figures.error_frames, figures.passive, figures.bus_off) == (3, 1, 1)


def times(link, tick):
    return [frame.t_ns for frame in link.receive(tick * TICK_NS)]


def test_a_frame_arrived_after_the_last_tick_and_at_the_latest_at_this_one():
    stamps = [5, TICK_NS - 4, TICK_NS + 1500]
    link = link_of(ScriptedBus([], [Frame(t, 0x100, b"") for t in stamps], [Frame(3, 0x100, b"")]))
    link.receive(0)
    assert times(link, 1) == [5, TICK_NS - 4, TICK_NS]
    assert times(link, 2) == [TICK_NS + 1]


@pytest.mark.parametrize("step_s", [-3600, -1, 1, 3600])
def test_setting_the_systems_clock_moves_no_frame(step_s):
    step_ns = step_s * 1_000_000_000
    wall = [0]
    stamped = [[Frame(index * TICK_NS - 7, 0x100, b"")] for index in range(1, 6)]
    stamped += [[Frame(index * TICK_NS - 7 + step_ns, 0x100, b"")] for index in range(6, 12)]
    link = link_of(ScriptedBus([], *stamped), epoch_now_ns=lambda: wall[0])
    link.receive(0)
    for index in range(1, 12):
        wall[0] = step_ns if index > 5 else 0
        assert times(link, index) == [index * TICK_NS - 7]
    assert link.figures.clock_steps == 1


def test_a_bus_that_is_opened_when_the_run_has_ended_is_closed():
    late = ScriptedBus()
    link = link_of(ScriptedBus(BusError("gone")), late)
    link.receive(0)
    link.receive(FIRST_PAUSE_NS)
    assert not late.closed
    link.close()
    assert late.closed
