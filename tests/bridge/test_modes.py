"""The state machine under any sequence of events: what is never valid, and what is kept."""

import math
import random

import pytest
from msgspec.structs import replace
from pydantic import ValidationError

from rig.bridge.arming import OpenInterlock
from rig.bridge.estimator import Estimate
from rig.bridge.mode_supervisor import (
    CAUSE_NUMBERS,
    NO_REPORTS,
    Cause,
    Event,
    Reports,
    Supervision,
    Supervisor,
)
from rig.bridge.supervision_limits import Action, Excess, Limit, LimitedValue
from rig.bridge.values import Divergence, Mode, Request, StepInput, StrutOutput
from rig.channels.channel import Channel, Role
from rig.channels.measured_quantities import LOAD_CELL_FORCE

MS = 1_000_000
SUPERVISION = Supervision(stale_after_s=0.01, safe_after_s=0.05)
STRUT = StrutOutput(5.0, 1.0, True, 0.4, 0.0, 0.0, 0.0)


class Scripted:
    """An estimator whose estimates are given to it before each step.

    Its state is the height of its model; it has none before the model starts.
    """

    struts = 1
    observers = ()

    def __init__(self):
        self.estimate = None
        self.can_start = False

    def init(self, t_ns):
        return None

    def unsettle(self, state, t_ns):
        return state

    def restart(self, state, t_ns):
        return None

    def step(self, state, step_input):
        return (None if self.estimate is None else step_input.t_ns * 1e-9), self.estimate

    def collect(self, state, step_input):
        assert state is None
        return state, self.can_start

    def discard(self, before, after):
        return before

    def heights_m(self, state):
        return () if state is None else (state,)


EXCESS = Excess(0, LimitedValue.HEIGHT_M, 0.9, 0.7)


class Drawn:
    """What one tick shows, drawn at random; a fault lasts, as faults do."""

    def __init__(self, rng, before, t_ns):
        calm = before is None
        self.age_ns = rng.choice((0, 0, 0, 2, 10, 11, 30, 50, 51, 200)) * MS
        self.is_settled = rng.random() < 0.7
        self.diverged = 0 if rng.random() < 0.02 else -1
        self.has_model = rng.random() < 0.9
        self.can_start = rng.random() < 0.5
        self.acknowledged = rng.random() < 0.1
        self.action = rng.choice((0, 0, 0, 0, Action.WARN, Action.HOLD, Action.SAFE))
        self.faulty_device = rng.choice((-1, -1, -1, -1, -1, 0))
        self.gap_ns = rng.choice((0, 0, 0, 0, 0, 0, 50, 60)) * MS
        self.is_log_lost = rng.random() < 0.03
        self.is_withheld = rng.random() < 0.1
        self.open_interlock = OpenInterlock("interlock", 0.0) if rng.random() < 0.03 else None
        self.missed_share = rng.choice((0.0,) * 12 + (0.7,))
        if not calm and rng.random() < 0.5:
            self.age_ns, self.action = before.age_ns, before.action
            self.faulty_device = before.faulty_device
            self.is_withheld, self.open_interlock = before.is_withheld, before.open_interlock
        self.t_ns, self.measured_ns = t_ns, t_ns - self.age_ns

    def reports(self):
        reports = Reports(
            self.action,
            EXCESS if self.action else None,
            self.gap_ns,
            self.missed_share,
            self.faulty_device,
            self.is_log_lost,
            self.is_withheld,
            self.open_interlock,
        )
        return NO_REPORTS if reports == NO_REPORTS else reports

    def losses(self, before):
        """Why an estimate is lost that there was, or could have been, in the order of causes.

        Without a model the age is that of the last estimate, and nothing is said of the model.
        """
        age_ns = self.age_ns if self.has_model else self.t_ns - before.measured_ns
        stale_ns, safe_ns = SUPERVISION.stale_after_ns, SUPERVISION.safe_after_ns
        is_behind = self.gap_ns > safe_ns and before.mode is not Mode.WAITING
        shown = (
            (is_behind, Event.TICKS_MISSING, (-1, "gap_s", self.gap_ns * 1e-9, 0.05)),
            (age_ns > safe_ns, Event.TIMEOUT, (-1, "age_s", age_ns * 1e-9, 0.05)),
            (stale_ns < age_ns <= safe_ns, Event.STALE, (-1, "age_s", age_ns * 1e-9, 0.01)),
            (
                self.has_model and self.missed_share > 0.0,
                Event.OVERLOADED,
                (-1, "missed_share", self.missed_share, 0.5),
            ),
            (self.has_model and self.diverged == 0, Event.DIVERGED, (0,)),
            (self.action == Action.HOLD, Event.BEYOND_HOLD, (0, "height_m", 0.9, 0.7)),
            (self.action == Action.SAFE, Event.BEYOND_SAFE, (0, "height_m", 0.9, 0.7)),
            (self.faulty_device == 0, Event.DEVICE_FAULT, (-1, "", math.nan, math.nan, 0)),
            (self.is_log_lost, Event.LOG_LOST, ()),
            (self.open_interlock is not None, Event.INTERLOCK_OPEN, (-1, "interlock", 0.0)),
        )
        return [Cause(event, *details) for applies, event, details in shown if applies]


HOLDS = (Event.STALE, Event.OVERLOADED, Event.BEYOND_HOLD, Event.DEVICE_FAULT)
"""What holds the estimate; everything else that it is lost to leads to the safe state."""


def drive(seed, steps=200):
    rng = random.Random(seed)
    estimator = Scripted()
    supervisor = Supervisor(estimator, SUPERVISION, [SUPERVISION.limits])
    state, drawn, t_ns = supervisor.init(0), None, 0
    for _ in range(steps):
        t_ns += MS
        drawn = Drawn(rng, drawn, t_ns)
        estimator.can_start = drawn.can_start
        estimator.estimate = (
            Estimate((STRUT,), drawn.measured_ns, drawn.is_settled, drawn.diverged)
            if drawn.has_model
            else None
        )
        before = state
        request = Request.ACKNOWLEDGE if drawn.acknowledged else None
        step_input = StepInput(t_ns, (), request)
        state, output, _ = supervisor.step(before, step_input, drawn.reports())
        yield before, drawn, state, output


def same(cause, expected):
    return (cause.event, cause.strut, cause.quantity, cause.device) == (
        expected.event,
        expected.strut,
        expected.quantity,
        expected.device,
    ) and [cause.value, cause.limit] == pytest.approx(
        [expected.value, expected.limit], rel=1e-12, nan_ok=True
    )


def expected_mode(before, drawn):
    """Mode after a tick, by the severest of what it shows, and why an estimate was lost."""
    if before.mode is Mode.SAFE:
        is_over = (
            drawn.can_start
            and drawn.action < Action.HOLD
            and drawn.faulty_device < 0
            and not drawn.is_log_lost
            and drawn.open_interlock is None
        )
        return (Mode.WAITING if drawn.acknowledged and is_over else Mode.SAFE), None
    is_fresh = drawn.has_model and drawn.age_ns <= SUPERVISION.stale_after_ns
    if before.mode is Mode.WAITING and not is_fresh:
        # Nothing can be lost before there is an estimate of fresh measurements.
        return Mode.WAITING, None
    losses = drawn.losses(before)
    if losses:
        first = next((cause for cause in losses if cause.event not in HOLDS), losses[0])
        return (Mode.HOLD if first.event in HOLDS else Mode.SAFE), first
    if not drawn.has_model:
        return (Mode.HOLD if before.mode is Mode.HOLD else Mode.SETTLING), None
    if not drawn.is_settled:
        return Mode.SETTLING, None
    return (Mode.READY if drawn.is_withheld else Mode.RUNNING), None


def check(before, drawn, state, output):
    mode, cause = expected_mode(before, drawn)
    assert state.mode is output.mode is mode
    is_valid = any(strut.valid for strut in output.struts)
    assert is_valid == (mode is Mode.RUNNING)
    assert state.t_ns == drawn.t_ns
    is_lost_now = mode is not before.mode and cause is not None
    if is_lost_now:
        assert same(state.cause, cause)
    elif mode is before.mode:
        assert state.cause is before.cause
    else:
        assert state.cause.event not in CAUSE_NUMBERS
    # The first cause stays until the bridge runs again.
    if mode is Mode.RUNNING:
        assert state.first_cause is None
    elif before.first_cause is not None:
        assert state.first_cause is before.first_cause
    else:
        assert state.first_cause is (state.cause if is_lost_now else None)
    number = 0 if state.first_cause is None else CAUSE_NUMBERS[state.first_cause.event]
    assert output.first_cause == number
    if drawn.has_model and drawn.diverged == 0 and before.mode is not Mode.SAFE:
        assert state.diverged == Divergence(0, drawn.t_ns)
    else:
        assert state.diverged is before.diverged
    check_what_stands(before, drawn, state, output)


def check_what_stands(before, drawn, state, output):
    """The model of the safe state stands where it was, with no motion and no force."""
    if state.mode is not Mode.SAFE:
        assert state.stopped_m == ()
        return
    if before.mode is Mode.SAFE:
        assert state.stopped_m == before.stopped_m
    else:
        is_worthless = state.cause.event in (Event.TIMEOUT, Event.DIVERGED)
        stopped = before.estimator if is_worthless else drawn.t_ns * 1e-9
        if not drawn.has_model:
            stopped = None
        last = [strut.height_m for strut in before.last_valid]
        assert list(state.stopped_m) == (last if stopped is None else [stopped])
    assert output.struts == tuple(
        StrutOutput(0.0, 0.0, False, height_m, 0.0, 0.0, 0.0) for height_m in state.stopped_m
    )


@pytest.mark.parametrize("first", range(0, 200, 50))
def test_nothing_is_valid_that_should_not_be(first):
    for seed in range(first, first + 50):
        for step in drive(seed):
            check(*step)


@pytest.mark.long
def test_nothing_is_valid_that_should_not_be_in_ten_thousand_sequences():
    for seed in range(10_000):
        for step in drive(1_000_000 + seed):
            check(*step)


def test_every_mode_and_event_is_reached():
    seen = {
        (before.mode, state.mode, state.cause and state.cause.event)
        for seed in range(300)
        for before, _, state, _ in drive(seed)
        if before.mode is not state.mode
    }
    events = {event for _, _, event in seen}
    assert events == set(Event)
    assert {mode for _, mode, _ in seen} == set(Mode) - {Mode.INIT}


def test_a_cause_is_of_no_strut_and_of_no_device_unless_it_says_so():
    cause = Cause(Event.STALE)
    assert (cause.strut, cause.device) == (-1, -1)


@pytest.mark.parametrize(("seconds", "is_right"), [(0.0, True), (60.0, True), (60.1, False)])
def test_a_force_fades_in_within_a_minute(seconds, is_right):
    if is_right:
        assert Supervision(fade_in_s=seconds).fade_in_s == seconds
        return
    with pytest.raises(ValidationError, match="fade_in_s"):
        Supervision(fade_in_s=seconds)


def test_both_ages_may_be_the_same():
    same_age = Supervision(stale_after_s=0.02, safe_after_s=0.02)
    assert same_age.stale_after_ns == same_age.safe_after_ns == 20 * MS
    assert Supervision().stale_after_ns == 10 * MS
    assert Supervision().safe_after_ns == 500 * MS


HOLD_ABOVE = Limit(value="force_n", high=10.0, for_s=0.002, action="hold")


def two_struts(limits, cell=None):
    estimator = Scripted()
    estimator.struts = 2
    return estimator, Supervisor(estimator, SUPERVISION, limits, cell)


def test_a_delayed_limit_is_that_of_its_own_strut():
    estimator, supervisor = two_struts([(), (HOLD_ABOVE,)])
    state, modes = supervisor.init(0), []
    for ms in range(1, 5):
        struts = (replace(STRUT, force_n=90.0), replace(STRUT, force_n=20.0))
        estimator.estimate = Estimate(struts, ms * MS, True)
        state, _, _ = supervisor.step(state, StepInput(ms * MS, ()))
        modes.append(state.mode)
    assert modes == [Mode.RUNNING, Mode.RUNNING, Mode.HOLD, Mode.HOLD]
    assert same(state.cause, Cause(Event.BEYOND_HOLD, 1, "force_n", 20.0, 10.0))


def test_an_estimate_that_is_too_uncertain_is_not_valid_and_settles_without_a_fault():
    """While it settles its deviation is large, and that is no fault of the bench."""
    estimator = Scripted()
    certain = Limit(value="force_std_n", high=100.0, action="hold")
    supervisor, modes = Supervisor(estimator, SUPERVISION, [(certain,)]), []
    state = supervisor.init(0)
    deviations = [(500.0, False), (60.0, True), (466.0, True), (90.0, True)]
    for ms, (std_n, is_settled) in enumerate(deviations, start=1):
        estimator.estimate = Estimate((replace(STRUT, force_std_n=std_n),), ms * MS, is_settled)
        state, _, _ = supervisor.step(state, StepInput(ms * MS, ()))
        modes.append(state.mode)
    assert modes == [Mode.SETTLING, Mode.RUNNING, Mode.HOLD, Mode.RUNNING]


def test_a_load_cell_is_compared_where_a_limit_needs_it():
    cell = Channel(3, Role.BENCH, LOAD_CELL_FORCE, "cell", "cell", -1, MS)
    compared = Limit(value="force_difference_n", high=10.0, action="hold")
    rate = Limit(value="force_rate_n_per_s", high=10.0, action="hold")
    for row, given, expected in (
        (compared, cell, {3}),
        (rate, None, set()),
        (HOLD_ABOVE, cell, set()),
    ):
        assert two_struts([(row,), ()], given)[1].compared == expected


def test_other_limits_before_the_first_estimate_have_nothing_to_keep():
    _, before = two_struts([(HOLD_ABOVE,), ()])
    _, after = two_struts([(HOLD_ABOVE,), (HOLD_ABOVE,)])
    state = before.init(0)
    assert after.take_over(state, before, MS) is state
