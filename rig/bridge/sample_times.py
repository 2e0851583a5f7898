"""When a message's values were sampled: by the sender's clock, not by the arrival of the frame.

A frame may wait in a gateway, a switch or an adapter. Its time signal, or its counter and the
message's cycle time, give the sender's time up to an offset and a drift: arrivals are the sender's
time on a line, and a wait, which is never negative. The line is the lower envelope of the arrivals;
a frame was *due* on it.

The envelope is followed frame by frame. An arrival before the line lowers it at once. After each
block of cycles the line goes through the block's lowest arrival, its slope being that since the
lowest of four blocks before. For a sender whose frames do not wait, a frame is due when it arrives.

Three things are no wait. Frames that all come later by the same time were delayed by the sender,
and frames that all come well before the line show that those before them had waited: the line goes
through them. And where the lowest arrivals of blocks scatter as much as the frames within a block,
the sender waits between frames instead of following a clock, and its counter states no time: then
arrivals are all there is.

Reference: Moon, Skelly, Towsley, "Estimation and removal of clock skew from network delay
measurements" (INFOCOM 1999): the line below all arrivals.
"""

from collections.abc import Callable
from enum import Enum

from msgspec import Struct
from msgspec.structs import replace

_BLOCK = 64
"""Cycles of a block: of as many waits spread over a range, the least is a 64th of it."""

_LEAST_APART = _BLOCK // 2
"""Cycles between two arrivals that show the step between frames."""

_BLOCKS = 4
"""Blocks over which the slope is measured: by the least of their waits, it errs by less than a
hundredth of the waits' range in a block."""

_FIRST_DRIFT = 100
"""A hundredth: how fast the line may rise in a cycle before the drift is known. Controllers without
a crystal are within it."""

LATE_FRAMES = 8
"""Frames in a row that come late by the same time, after which the line goes through them."""

_EARLY_FRAMES = 3
"""Frames in a row that come early by the same time, after which the line goes through them. One or
two are another sender's, such as random frames of which one in 256 has the right CRC."""

_MOST_CYCLES = 8
"""Cycles between two frames that the counter alone determines; it goes round after 15 or more."""

_SCATTER = 0.4
"""How far the lowest arrival of a block is from where the line had it, over the mean wait in it:
1.2 in the median where the sender waits at random between frames, 0.1 where frames wait."""

_UNSTEADY = 3
"""Blocks with such a scatter, less those without, from which the counter states no time."""

_MOST_DOUBT = 6
"""As many of them are remembered."""


class FrameTime(Enum):
    """What is known of the time at which a frame was due.

    IN_TIME: what its clock says. LATE: it came more than a cycle after that, and only a frame
    behind it shows whether it had waited. EARLY: it contradicts the clock: it came before the line,
    or after a silence at a time that does not fit.
    """

    IN_TIME = "in_time"
    LATE = "late"
    EARLY = "early"


# Looking up a member of an enum costs as much as the CRC of a frame.
IN_TIME, LATE, EARLY = FrameTime.IN_TIME, FrameTime.LATE, FrameTime.EARLY

Point = tuple[int, int]
"""Arrival in ns, and cycles of the sender's until then."""

Lowest = tuple[int, int, int]
"""The lowest arrival of a block so far: ns above the line, and its point."""


class Line(Struct, frozen=True, gc=False):
    """The line during a block.

    Attributes:
        step_ns: How much later a frame is due than the one before it.
        ends_at: Cycles of the sender's at which the block ends.
        is_believed: Whether frames are due on the line.
        before: Lowest arrivals of the blocks before; fewer after a beginning.
        is_step_known: Whether blocks have shown the step.
        doubt: Blocks whose lowest arrival was far from where the line had it, less the others.
        is_clock: Whether the counter states times.
        alike: Frames in a row off the line by the same time.
        is_guess: Whether the number of cycles since the last frame on the line is a guess.
    """

    step_ns: int
    ends_at: int
    is_believed: bool = True
    before: tuple[Point, ...] = ()
    is_step_known: bool = False
    doubt: int = 0
    is_clock: bool = True
    alike: int = 0
    is_guess: bool = False


class SenderClock(Struct, frozen=True, gc=False):
    """What is known of the clock of a message's sender, at a frame of the message.

    Attributes:
        arrival_ns: Its arrival.
        due_ns: When it was due.
        cycles: Cycles of the sender's since the first frame.
        lowest: Lowest arrival of the block so far.
        wait_ns: Sum of the waits in the block so far.
        line: The line.
        timing: What is known of the time at which it was due.
        stamp_ns: The sender's time, where a signal holds it.
        phase_ns: How much later than a whole number of cycles after the first frame that is.
    """

    arrival_ns: int
    due_ns: int
    cycles: int
    lowest: Lowest
    wait_ns: int
    line: Line
    timing: FrameTime = IN_TIME
    stamp_ns: int = 0
    phase_ns: int = 0


Follower = Callable[[SenderClock | None, int, int], SenderClock]
"""Clock at the last frame, arrival of the next one in ns, and cycles between them (one, and one for
each frame that was lost) or the sender's time in ns -> the clock at that frame. A sender that
starts again has none before."""


def compile_follower(cycle_ns: int) -> Follower:
    """Build what follows the clock of a message's sender, for the message's cycle time."""
    quarter_ns = cycle_ns // 4
    first_line = Line(cycle_ns + cycle_ns // _FIRST_DRIFT, _BLOCK)

    def follow(clock: SenderClock | None, arrival_ns: int, cycles: int) -> SenderClock:
        if clock is None:
            return SenderClock(arrival_ns, arrival_ns, 0, (0, arrival_ns, 0), 0, first_line)
        line, lowest, wait_ns = clock.line, clock.lowest, clock.wait_ns
        due_ns = clock.due_ns + cycles * line.step_ns
        late_ns = arrival_ns - due_ns
        at = clock.cycles + cycles
        if late_ns < 0:
            due_ns, lowest = arrival_ns, (0, arrival_ns, at)
        else:
            wait_ns += late_ns
            if late_ns < lowest[0]:
                lowest = (late_ns, arrival_ns, at)
        after = SenderClock(arrival_ns, due_ns, at, lowest, wait_ns, line)
        is_usual = line.is_believed and -quarter_ns <= late_ns <= quarter_ns
        if is_usual and at < line.ends_at:
            return after
        if not line.is_clock:
            after = replace(after, due_ns=arrival_ns)
        elif not is_usual:
            after = _judge(clock, after, late_ns, cycle_ns)
        if at < after.line.ends_at or after.timing is EARLY:
            return after
        return _end_block(after, cycle_ns)

    return follow


def compile_follower_of_times(cycle_ns: int, round_ns: int) -> Follower:
    """Build what follows the clock of a sender whose frames hold its time.

    The frames are followed as if each had been sampled, and had arrived, at the whole cycle nearest
    to its time: waits are the same there.

    Args:
        cycle_ns: Time between two samples, about.
        round_ns: Time after which the sender's time begins again; 0 if it does not.
    """
    follow_cycles = compile_follower(cycle_ns)

    def follow(clock: SenderClock | None, arrival_ns: int, stamp_ns: int) -> SenderClock:
        if clock is None:
            return replace(follow_cycles(None, arrival_ns, 0), stamp_ns=stamp_ns)
        elapsed_ns = stamp_ns - clock.stamp_ns
        if round_ns:
            # As many rounds as come nearest to the arrival.
            missing_ns = arrival_ns - clock.arrival_ns - elapsed_ns
            elapsed_ns += round_ns * ((2 * missing_ns + round_ns) // (2 * round_ns))
        if elapsed_ns == 0:
            # The same frame once more, however often: it shows nothing of the sender's clock.
            return replace(clock, timing=EARLY)
        before_ns = clock.phase_ns
        cycles = (2 * (before_ns + elapsed_ns) + cycle_ns) // (2 * cycle_ns)
        phase_ns = before_ns + elapsed_ns - cycles * cycle_ns
        whole = replace(
            clock, arrival_ns=clock.arrival_ns - before_ns, due_ns=clock.due_ns - before_ns
        )
        after = follow_cycles(whole, arrival_ns - phase_ns, cycles)
        due_ns = after.due_ns + phase_ns
        return replace(
            after, arrival_ns=arrival_ns, due_ns=due_ns, stamp_ns=stamp_ns, phase_ns=phase_ns
        )

    return follow


def _judge(clock: SenderClock, after: SenderClock, late_ns: int, cycle_ns: int) -> SenderClock:
    """Clock at a frame that is off the line, or behind one that was."""
    line, quarter_ns, cycles = clock.line, cycle_ns // 4, after.cycles - clock.cycles
    is_on_line = -quarter_ns <= late_ns <= quarter_ns
    # After a silence the counter has gone round: the number of cycles is a guess of the arrival.
    is_guess = line.is_guess or (cycles > _MOST_CYCLES and not is_on_line)
    if is_on_line and not is_guess:
        return replace(after, line=replace(line, alike=0, is_believed=line.is_clock))
    change_ns = after.arrival_ns - clock.arrival_ns - cycles * cycle_ns
    alike = line.alike + 1 if line.alike and abs(change_ns) < cycle_ns // 8 else 1
    if alike >= (LATE_FRAMES if late_ns > 0 and not is_guess else _EARLY_FRAMES):
        return _begin_again(after)
    line = replace(line, alike=alike, is_guess=is_guess, is_believed=False)
    if is_guess or late_ns < 0:
        # It leaves the line where it is.
        due_ns = after.arrival_ns - late_ns
        return replace(after, due_ns=due_ns, lowest=clock.lowest, line=line, timing=EARLY)
    is_late = late_ns > cycle_ns and change_ns > -quarter_ns
    return replace(after, line=line, timing=LATE if is_late else IN_TIME)


def _begin_again(clock: SenderClock) -> SenderClock:
    """Clock whose line goes through its last frame; the blocks before show nothing of it."""
    at, arrival_ns = clock.cycles, clock.arrival_ns
    line = replace(clock.line, before=(), ends_at=at + _BLOCK, alike=0, is_guess=False)
    line = _with_doubt(line, is_unsteady=True)
    return replace(clock, due_ns=arrival_ns, lowest=(0, arrival_ns, at), wait_ns=0, line=line)


def _end_block(clock: SenderClock, cycle_ns: int) -> SenderClock:
    """Clock whose line goes through the lowest arrival of the block that ends."""
    line, step_ns, (_, lowest_ns, lowest_at) = clock.line, clock.line.step_ns, clock.lowest
    is_unsteady, is_step_known = False, line.is_step_known
    if line.before:
        newest_ns, newest_at = line.before[-1]
        off_ns = abs(lowest_ns - newest_ns - (lowest_at - newest_at) * step_ns)
        least_ns = max(_SCATTER * clock.wait_ns, cycle_ns) / _BLOCK
        is_unsteady = line.is_step_known and off_ns > least_ns
        oldest_ns, oldest_at = line.before[0]
        # Of two that are close to each other the waits would make a step of any size.
        if lowest_at - oldest_at >= _LEAST_APART:
            # Rounded up: the frames of a sender that drifts are due when they arrive.
            step_ns = -((oldest_ns - lowest_ns) // (lowest_at - oldest_at))
            step_ns = min(max(step_ns, cycle_ns * 7 // 8), cycle_ns * 9 // 8)
            is_step_known = True
    line = replace(
        _with_doubt(line, is_unsteady=is_unsteady),
        step_ns=step_ns,
        ends_at=clock.cycles + _BLOCK,
        before=(*line.before[1 - _BLOCKS :], (lowest_ns, lowest_at)),
        is_step_known=is_step_known,
    )
    arrival_ns, due_ns = clock.arrival_ns, lowest_ns + (clock.cycles - lowest_at) * step_ns
    due_ns = min(arrival_ns, due_ns) if line.is_clock else arrival_ns
    return replace(
        clock,
        due_ns=due_ns,
        lowest=(arrival_ns - due_ns, arrival_ns, clock.cycles),
        wait_ns=0,
        line=line,
    )


def _with_doubt(line: Line, *, is_unsteady: bool) -> Line:
    """Line that was as expected, or was not, in one more block."""
    doubt = min(line.doubt + 1, _MOST_DOUBT) if is_unsteady else max(line.doubt - 1, 0)
    is_clock = doubt < _UNSTEADY if line.is_clock else doubt == 0
    is_believed = is_clock and not line.alike
    return replace(line, doubt=doubt, is_clock=is_clock, is_believed=is_believed)
