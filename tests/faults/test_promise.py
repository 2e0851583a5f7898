"""What VALID promises, event by event and for every kind of observer, as a node on the bus sees it.

The node decodes the bridge's frames with cantools; the run's log and the bridge's own values are
not used. `pytest tests/faults -n 0 --promise-table FILE` writes what was measured.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import cantools
import numpy as np
import pytest
from msgspec.structs import replace

from can_dbc.codec import compile_decoder, compile_encoder
from can_dbc.database import DEFAULT_DATABASE
from can_dbc.frame import Frame
from can_dbc.protection import compile_protector
from can_dbc.units import Dimension
from rig.bridge.counts import Conditions
from rig.bridge.values import Mode, Request
from rig.observers.error_filter import ErrorFilter
from rig.observers.kalman import KalmanObserver
from rig.observers.pi import PiObserver
from rig.plan.build import build_bridge
from rig.simulated_bench.trajectory import simulate
from tests.faults.trial import BEGIN_MS, MS, Gateway, Switches, Trial, trial_with_auxiliary

DBC = cantools.database.load_file(DEFAULT_DATABASE)
ESTIMATE, STATUS = DBC.get_message_by_name("RIG_ESTIMATE"), DBC.get_message_by_name("RIG_STATUS")
UNCERTAINTY = DBC.get_message_by_name("RIG_UNCERTAINTY")
FILTER = ErrorFilter(bandwidth_hz=19.0, noise_std_m=2e-6)
OBSERVERS = {
    "published PI": None,
    "damped PI": PiObserver(
        proportional_n_per_m=2e4,
        integral_n_per_m_s=1e4,
        derivative_n_s_per_m=600.0,
        filter=ErrorFilter(bandwidth_hz=60.0, noise_std_m=2e-6),
    ),
    "noise-aware": KalmanObserver("kalman", FILTER),
}
END_MS = BEGIN_MS + 4800
LAST_MS = BEGIN_MS + 2500
MOST = 3.0
"""Largest error of a valid force, over the largest of the settled run."""


class Event(NamedTuple):
    """An event, and what it does to a run.

    Attributes:
        words: What happens.
        duty: What the bench has to do itself.
        frames: Time of a tick in ms and the bench's frames -> those that arrive.
        conditions: Time of a tick in ms -> what the loop knows.
        missed: First and last of the ticks that do not take place.
        supervision: Settings.
        begin_ms: When it begins.
    """

    words: str
    duty: str = "nothing"
    frames: Callable[[int, list[Frame]], list[Frame]] = lambda _ms, frames: frames
    conditions: Callable[[int], Conditions] = lambda _ms: Conditions()
    missed: range = range(0)
    supervision: dict[str, object] = {}  # noqa: RUF012 - never changed
    begin_ms: int = BEGIN_MS


class Received(NamedTuple):
    """What the node received at a tick; mode and standard deviation are those received last.

    Attributes:
        std_n: Stated standard deviation of the force; NaN where none is published.
    """

    ms: int
    is_valid: bool
    force_n: float
    mode: Mode
    std_n: float


def follow(trial: Trial, event: Event, end_ms: int = END_MS, first_ms: int = 0) -> list[Received]:
    """Run a trial through an event; returns what a node on the bus received."""
    received: list[Received] = []
    mode, std_n, missed = Mode.INIT, math.nan, 0
    queue: list[Frame] = []
    trial.state = trial.bridge.init(first_ms * MS)
    for ms in range(end_ms):
        queue += event.frames(ms, trial.bench.update(ms * MS)[0])
        if ms < first_ms:
            queue = []
            continue
        if ms in event.missed:
            missed += 1
            continue
        conditions = event.conditions(ms)
        if missed:
            conditions = conditions._replace(overruns=missed)
        trial.state, result = trial.bridge.tick(trial.state, ms * MS, queue, conditions)
        queue, missed = [], 0
        for frame in result.frames:
            if frame.arbitration_id == STATUS.frame_id:
                mode = Mode(STATUS.decode(frame.data, decode_choices=False)["STATE"])
        [data] = [it.data for it in result.frames if it.arbitration_id == ESTIMATE.frame_id]
        values = ESTIMATE.decode(data, decode_choices=False)
        for frame in result.frames:
            if frame.arbitration_id == UNCERTAINTY.frame_id:
                std_n = UNCERTAINTY.decode(frame.data)["FORCE_STD"]
        received.append(
            Received(
                ms,
                bool(values["VALID"]),
                values["SPRING_DAMPER_FORCE"],
                mode,
                std_n,
            )
        )
    return received


@pytest.fixture(scope="module")
def truth_n():
    return simulate(Trial().bench.config, END_MS * MS, MS).strut_force_n[:, 0]


@pytest.fixture(scope="module")
def settled_n(truth_n):
    """Largest error of each observer's settled run, and the time from which it is valid."""
    found = {}
    for name, observer in OBSERVERS.items():
        received = follow(Trial(observer=observer), Event("none"))
        errors_n = [abs(it.force_n - truth_n[it.ms]) for it in received if it.is_valid]
        found[name] = max(errors_n)
    return found


def missing(length):
    return lambda ms, frames: [] if BEGIN_MS <= ms < BEGIN_MS + length else frames


def gateway(held, every):
    hold = Gateway(held, every)
    return lambda ms, frames: hold(ms * MS, frames) if BEGIN_MS <= ms < LAST_MS else frames


class Frozen:
    """The height of one moment for 600 ms, in frames that are right in all else.

    A subclass may freeze, or change, the applied force instead.
    """

    def __init__(self, begin_ms: int = BEGIN_MS) -> None:
        self._begin_ms = begin_ms
        message = Trial().ready.database.message("BENCH_MEASUREMENT")
        names, dimensions = ["HEIGHT", "APPLIED_FORCE"], [Dimension.LENGTH, Dimension.FORCE]
        self._decode = compile_decoder(message, names, dimensions)
        self._encode = compile_encoder(message, names, dimensions)
        self._protect = compile_protector(message.protection)
        self._height_m = None

    def change(self, height_m: float) -> float:
        self._height_m = height_m if self._height_m is None else self._height_m
        return self._height_m

    def change_both(self, height_m: float, applied_n: float) -> tuple[float, float]:
        return self.change(height_m), applied_n

    def __call__(self, ms, frames):
        if not self._begin_ms <= ms < self._begin_ms + 600:
            return frames
        found = []
        for frame in frames:
            if frame.arbitration_id == 0x100:
                data = self._encode(self.change_both(*self._decode(frame.data)))[0]
                frame = replace(frame, data=self._protect(data, frame.data[1] & 0x0F))  # noqa: PLW2901
            found.append(frame)
        return found


class FrozenForce(Frozen):
    """The applied force of one moment for 600 ms."""

    def change_both(self, height_m, applied_n):
        return height_m, self.change(applied_n)


def acknowledged(ms):
    """An operator who acknowledges once a second."""
    is_asked = ms > BEGIN_MS and ms % 1000 == 900
    return Conditions(request=Request.ACKNOWLEDGE if is_asked else None)


def overloaded(ms):
    return Conditions(overruns=3 if BEGIN_MS <= ms < BEGIN_MS + 500 else 0)


def disk_full(ms):
    is_full = BEGIN_MS <= ms < BEGIN_MS + 500
    return acknowledged(ms)._replace(log_fault=is_full)


STOP = "do not use the force while VALID is 0"
SILENCE = "detect that the frames stop"
EVENTS = [
    Event("frames missing for 5 ms", frames=missing(5)),
    Event("frames missing for 100 ms", STOP, missing(100)),
    Event("frames missing for 200 ms", STOP, missing(200)),
    Event("frames missing for 1 s, then acknowledged", STOP, missing(1000), acknowledged),
    Event("frames delayed by 8 ms in a gateway, every 2 s", STOP, gateway(8, 2000)),
    Event("frames delayed by 20 ms in a gateway, every 2 s", STOP, gateway(20, 2000)),
    Event("the loop stands still for 100 ms", SILENCE, missed=range(BEGIN_MS, BEGIN_MS + 100)),
    Event(
        "the loop stands still for 2 s, then acknowledged",
        f"{SILENCE}; {STOP}",
        conditions=acknowledged,
        missed=range(BEGIN_MS, BEGIN_MS + 2000),
    ),
    Event("most ticks are missed for 500 ms (overload)", STOP, conditions=overloaded),
    Event(
        "the height is frozen for 600 ms (limit `unchanged_s: 0.02`), then acknowledged",
        STOP,
        Frozen(),
        acknowledged,
        supervision={"limits": [{"value": "unchanged_s", "high": 0.02, "action": "refuse"}]},
    ),
    Event(
        "the applied force is frozen for 600 ms (limit `unchanged_s: 0.004`), then acknowledged",
        STOP,
        FrozenForce(BEGIN_MS + 75),
        acknowledged,
        supervision={
            "limits": [
                {
                    "channel": "applied_force",
                    "value": "unchanged_s",
                    "high": 0.004,
                    "action": "refuse",
                }
            ]
        },
        begin_ms=BEGIN_MS + 75,
    ),
    Event(
        "the disk is full for 500 ms (`log_fault: safe`), then acknowledged",
        STOP,
        conditions=disk_full,
        supervision={"log_fault": "safe"},
    ),
]


def largest_error_n(received, truth_n):
    return max(abs(it.force_n - truth_n[it.ms]) for it in received if it.is_valid)


def covered_share(received, truth_n):
    """Share of the valid ticks whose error is within 1.96 of the stated standard deviations."""
    valid = [item for item in received if item.is_valid]
    within = [abs(it.force_n - truth_n[it.ms]) <= 1.96 * it.std_n for it in valid]
    return sum(within) / len(within) if within else 1.0


def modes_of(received, begin_ms):
    """Modes that followed one another."""
    modes = []
    for item in received:
        if item.ms >= begin_ms and item.mode.name not in modes[-1:]:
            modes.append(item.mode.name)
    return modes


def describe(received, begin_ms):
    """Modes that followed, when a frame was invalid first, and when one was valid again."""
    modes = modes_of(received, begin_ms)
    first = next((it.ms for it in received if it.ms >= begin_ms and not it.is_valid), None)
    if first is None:
        return modes, "none", ""
    again = next(it.ms for it in received if it.ms > first and it.is_valid)
    return modes, f"after {first - begin_ms} ms", f"after {again - begin_ms} ms"


def reaction(receive, truth_n, settled_n, begin_ms=BEGIN_MS):
    """Modes, times and largest valid errors (over the settled ones) of a row of the table.

    `receive` returns what the node received of a run with an observer. The stated deviation of the
    noise-aware one, the last, has to be true meanwhile.
    """
    ratios = {}
    for name, observer in OBSERVERS.items():
        received = receive(observer)
        ratios[name] = largest_error_n(received, truth_n) / settled_n[name]
        assert ratios[name] <= MOST
        assert received[-1].is_valid
    behind = [item for item in received if begin_ms <= item.ms < begin_ms + 1500]
    assert covered_share(received, truth_n) >= 0.95
    assert covered_share(behind, truth_n) >= 0.95
    return (*describe(received, begin_ms), ratios)


@pytest.mark.slow
@pytest.mark.parametrize("order", range(len(EVENTS)), ids=lambda order: EVENTS[order].words)
def test_no_valid_force_errs_by_more_than_three_times_the_settled_one(
    order, promise, truth_n, settled_n
):
    event = EVENTS[order]

    def receive(observer):
        return follow(Trial(observer=observer, **event.supervision), event)

    found = reaction(receive, truth_n, settled_n, event.begin_ms)
    promise(order, event.words, *found, event.duty)


@pytest.mark.slow
@pytest.mark.parametrize("name", OBSERVERS)
def test_a_height_that_freezes_anywhere_in_its_motion(name, truth_n, settled_n):
    """Fast, or at a turning point: before the observer has turned it into a force."""
    limits = [{"value": "unchanged_s", "high": 0.02, "action": "refuse"}]
    for begin_ms in range(BEGIN_MS + 100, BEGIN_MS + 730, 105):
        trial = Trial(observer=OBSERVERS[name], limits=limits)
        received = follow(trial, Event("", frames=Frozen(begin_ms)), begin_ms + 300)
        assert largest_error_n(received, truth_n) <= MOST * settled_n[name]
        assert not received[-1].is_valid


@pytest.mark.parametrize("name", OBSERVERS)
def test_a_height_that_stays_frozen_is_never_believed_without_any_limit(name):
    frozen = Frozen()
    received = follow(Trial(observer=OBSERVERS[name]), Event("", frames=frozen), BEGIN_MS + 590)
    # The first frozen height is the right one.
    assert not any(it.is_valid for it in received if it.ms > BEGIN_MS)


@pytest.mark.slow
@pytest.mark.parametrize("offset_m", [-0.05, 0.001, 0.05])
def test_a_height_that_jumps(offset_m, truth_n, settled_n):
    """A foot that slips, another zero: valid again when the observer has followed."""
    for name, observer in OBSERVERS.items():
        jump = Frozen()
        jump.change = lambda height_m: height_m + offset_m
        received = follow(Trial(observer=observer), Event("", frames=jump), BEGIN_MS + 400)
        invalid = [it.ms for it in received if it.ms >= BEGIN_MS and not it.is_valid]
        assert invalid[0] == BEGIN_MS
        errors_n = [
            abs(it.force_n - truth_n[it.ms])
            for it in received
            if it.is_valid and it.ms < BEGIN_MS + 30
        ]
        assert max(errors_n) <= MOST * settled_n[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", OBSERVERS)
@pytest.mark.parametrize(("offset_m", "length"), [(0.0005, 66), (0.005, 40), (0.02, 66)])
def test_a_height_that_jumps_and_is_right_again_while_the_estimate_settles(
    name, offset_m, length, truth_n, settled_n
):
    jump = Frozen()
    jump.change = lambda height_m: height_m + offset_m

    def frames(ms, frames):
        return jump(ms, frames) if ms < BEGIN_MS + length else frames

    received = follow(Trial(observer=OBSERVERS[name]), Event("", frames=frames), END_MS - 500)
    assert largest_error_n(received, truth_n) <= MOST * settled_n[name]
    assert received[-1].is_valid


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gap", "offset_m"), [(6, 0.0005), (10, 0.005), (20, 0.02), (30, 0.05), (80, 0.05)]
)
def test_a_height_that_has_another_zero_behind_a_gap(gap, offset_m, truth_n, settled_n):
    """What the filter knew of the motion contradicts the first height: it begins again there."""
    jump = Frozen()
    jump.change = lambda height_m: height_m + offset_m

    def frames(ms, frames):
        return jump(ms, frames) if not BEGIN_MS <= ms < BEGIN_MS + gap else []

    trial = Trial(observer=OBSERVERS["noise-aware"])
    received = follow(trial, Event("", frames=frames), BEGIN_MS + 900)
    assert largest_error_n(received, truth_n) <= MOST * settled_n["noise-aware"]
    assert received[-1].is_valid


CELL_LIMIT = {"value": "force_difference_n", "low": -45.0, "high": 45.0, "action": "hold"}


def with_scale(scale):
    """The frames of a sensor whose DBC has another scale, from the beginning."""
    wrong = Frozen(0)
    wrong.change = lambda height_m: scale * height_m
    return lambda _ms, frames: wrong(0, frames)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_a_scale_that_is_wrong_by_two(scale, promise):
    """Nothing but a load cell contradicts it."""
    for observer in OBSERVERS.values():
        trial = trial_with_auxiliary("load_cell_force", observer=observer, limits=[CELL_LIMIT])
        received = follow(trial, Event("", frames=with_scale(scale)))
        assert not any(it.is_valid for it in received)
    if scale == 2.0:
        words = (
            "the scale of the height is wrong by a factor of two, from the start "
            f"(limit `{CELL_LIMIT['value']}`)"
        )
        duty = "use a load cell, or check a known displacement before the run"
        promise(
            60,
            words,
            [*dict.fromkeys(modes_of(received, 0))],
            "after 0 ms",
            "never",
            dict.fromkeys(OBSERVERS, math.nan),
            duty,
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", OBSERVERS)
def test_a_right_scale_passes_the_load_cell(name):
    trial = trial_with_auxiliary("load_cell_force", observer=OBSERVERS[name], limits=[CELL_LIMIT])
    received = follow(trial, Event("none"))
    first = next(it.ms for it in received if it.is_valid)
    assert all(it.is_valid for it in received if it.ms >= first)


@pytest.mark.slow
@pytest.mark.parametrize("first_ms", [700, 1200])
def test_a_bridge_that_joins(first_ms, promise, truth_n, settled_n):
    def receive(observer):
        return follow(Trial(observer=observer), Event("joins"), first_ms=first_ms)

    found = reaction(receive, truth_n, settled_n, first_ms)
    if first_ms == 1200:
        promise(-2, "the bridge joins a moving bench", *found, STOP)


def test_an_interlock_that_opens(promise, truth_n, settled_n):
    def receive(observer):
        trial = trial_with_auxiliary("interlock", observer=observer)
        switches = Switches(trial, interlock=True)

        def frames(ms, frames):
            switches.closed["interlock"] = not BEGIN_MS <= ms < BEGIN_MS + 300
            return switches(ms * MS, frames)

        return follow(trial, Event("", frames=frames, conditions=acknowledged))

    words = "the interlock opens for 300 ms, then acknowledged"
    duty = "switch off by hardware"
    promise(50, words, *reaction(receive, truth_n, settled_n), duty)


@pytest.mark.slow
def test_an_applied_force_of_its_own_message_that_stops(promise, truth_n, settled_n):
    def receive(observer):
        trial = Trial(observer=observer)
        content = trial.ready.config.model_dump(mode="json")
        other = {"message": "BENCH_MEASUREMENT_2", "signal": "APPLIED_FORCE"}
        content["signals"]["applied_force"] = other
        trial.ready = trial.ready.with_config(trial.ready.config.model_validate(content))
        trial.bridge = build_bridge(trial.ready)
        message = trial.ready.database.message("BENCH_MEASUREMENT_2")
        protect = compile_protector(message.protection)

        def frames(ms, frames):
            if BEGIN_MS <= ms < BEGIN_MS + 300:
                return frames
            copies = [
                replace(frame, arbitration_id=0x101, data=protect(frame.data, frame.data[1] & 0x0F))
                for frame in frames
                if frame.arbitration_id == 0x100
            ]
            return [*frames, *copies]

        return follow(trial, Event("", frames=frames))

    words = "the applied force is in a separate message, which stops for 300 ms"
    promise(40, words, *reaction(receive, truth_n, settled_n), STOP)


def test_the_bound_is_one(truth_n, settled_n):
    """Far below the kilonewtons that a height which is wrong at once turns into."""
    peak_n = np.abs(truth_n).max()
    assert all(MOST * error_n < 0.25 * peak_n for error_n in settled_n.values())
