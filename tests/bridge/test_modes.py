"""The state machine under any sequence of events: what is never valid, and what is kept."""

import random

import pytest

from rig.bridge.arming import OpenInterlock
from rig.bridge.estimator import Estimate
from rig.bridge.mode_supervisor import NO_REPORTS, Event, Reports, Supervision, Supervisor
from rig.bridge.supervision_limits import Action
from rig.bridge.values import Mode, Request, StepInput, StrutOutput

MS = 1_000_000
SUPERVISION = Supervision(stale_after_s=0.01, safe_after_s=0.05)
STRUT = StrutOutput(5.0, 1.0, True, 0.4, 0.0, 0.0, 0.0)


class Scripted:
    """An estimator whose estimates are given to it before each step."""

    struts = 1
    observers = ()

    def __init__(self):
        self.estimate = None
        self.can_start = False

    def init(self, t_ns):
        return "waiting"

    def unsettle(self, state, t_ns):
        return state

    def restart(self, state, t_ns):
        return "waiting"

    def step(self, state, step_input):
        return ("waiting" if self.estimate is None else "moving"), self.estimate

    def collect(self, state, step_input):
        assert state == "waiting"
        return state, self.can_start

    def discard(self, before, after):
        return before

    def heights_m(self, state):
        return (0.4,)


class Drawn:
    """What one tick shows, drawn at random; a fault lasts, as faults do."""

    def __init__(self, rng, before, t_ns):
        calm = before is None
        self.age_ns = rng.choice((0, 0, 0, 2, 9, 11, 30, 49, 51, 200)) * MS
        self.is_settled = rng.random() < 0.7
        self.diverged = 0 if rng.random() < 0.02 else -1
        self.has_model = rng.random() < 0.9
        self.can_start = rng.random() < 0.5
        self.acknowledged = rng.random() < 0.1
        self.action = rng.choice((0, 0, 0, 0, Action.WARN, Action.HOLD, Action.SAFE))
        self.faulty_device = rng.choice((-1, -1, -1, -1, -1, 0))
        self.gap_ns = rng.choice((0, 0, 0, 0, 0, 0, 5, 60)) * MS
        self.is_log_lost = rng.random() < 0.03
        self.is_withheld = rng.random() < 0.1
        self.open_interlock = OpenInterlock("interlock", 0.0) if rng.random() < 0.03 else None
        self.missed_share = rng.choice((0.0,) * 12 + (0.7,))
        if not calm and rng.random() < 0.5:
            self.age_ns, self.action = before.age_ns, before.action
            self.faulty_device = before.faulty_device
            self.is_withheld, self.open_interlock = before.is_withheld, before.open_interlock
        self.measured_ns = t_ns - self.age_ns

    def reports(self):
        reports = Reports(
            self.action,
            None,
            self.gap_ns,
            self.missed_share,
            self.faulty_device,
            self.is_log_lost,
            self.is_withheld,
            self.open_interlock,
        )
        return NO_REPORTS if reports == NO_REPORTS else reports

    def is_sound(self, mode):
        """Whether an estimate of this tick may be believed, after a mode.

        While the bridge waits for a bench, ticks that are missing harm nothing.
        """
        return (
            self.has_model
            and self.is_settled
            and self.diverged < 0
            and self.age_ns <= SUPERVISION.stale_after_ns
            and self.action < Action.HOLD
            and self.faulty_device < 0
            and not self.missed_share
            and not self.is_log_lost
            and not self.is_withheld
            and self.open_interlock is None
            and (mode is Mode.WAITING or self.gap_ns <= SUPERVISION.safe_after_ns)
        )


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


def check(before, drawn, state, output):
    assert state.mode is output.mode
    is_valid = any(strut.valid for strut in output.struts)
    assert is_valid == (state.mode is Mode.RUNNING)
    if is_valid:
        assert drawn.is_sound(before.mode)
        assert before.mode is not Mode.SAFE
    elif before.mode is Mode.RUNNING:
        assert not drawn.is_sound(before.mode)
    if before.mode is Mode.SAFE and state.mode is not Mode.SAFE:
        assert state.mode is Mode.WAITING
        assert drawn.acknowledged
        assert drawn.can_start
        assert drawn.action < Action.HOLD
        assert drawn.faulty_device < 0
        assert not drawn.is_log_lost
        assert drawn.open_interlock is None
    if before.first_cause is not None:
        # The first cause stays until the bridge runs again.
        assert state.first_cause is before.first_cause or (
            state.first_cause is None and state.mode is Mode.RUNNING
        )
    if state.mode in (Mode.HOLD, Mode.SAFE):
        assert state.first_cause is not None
    if state.mode is not before.mode:
        assert state.cause is not None
    if state.mode is Mode.SAFE:
        assert [strut.force_n for strut in output.struts] == [0.0]


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
