"""Arming, interlock, enable signal, ramps and delayed limits, on the reference bench."""

import itertools
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.bridge.arming import Arming
from rig.bridge.counts import Conditions
from rig.bridge.mode_supervisor import Event
from rig.bridge.operation import Operation, OperationState
from rig.bridge.supervision_limits import (
    Delay,
    Limit,
    LimitedValue,
    find_violations,
    update_delays,
    values_of_estimate,
)
from rig.bridge.values import Mode, Request, StepInput, StepOutput, StrutOutput
from rig.channels.channel import Sample
from rig.channels.measured_quantities import ENABLE, INTERLOCK
from tests.faults.trial import (
    BEGIN_MS,
    MS,
    SWITCH_CYCLE_MS,
    Switches,
    Trial,
    trial_with_auxiliary,
)

SAFE_AFTER_MS = 500


def request(what):
    return lambda _t_ns: Conditions(request=what)


def modes(ticks):
    return [tick.mode for tick in ticks]


def test_a_bridge_armed_by_hand_waits_until_it_is_and_can_be_disarmed():
    trial = Trial(arming="manual", settling_s=0.0)
    ticks = trial.run(BEGIN_MS)
    assert modes(ticks)[-1] is Mode.READY
    assert not any(tick.is_valid for tick in ticks)
    armed = trial.run(BEGIN_MS + 1, conditions=request(Request.ARM))[-1]
    assert armed.is_valid
    assert all(tick.is_valid for tick in trial.run(BEGIN_MS + 20)[BEGIN_MS:])
    assert trial.run(BEGIN_MS + 21, conditions=request(Request.DISARM))[-1].mode is Mode.READY
    assert trial.run(BEGIN_MS + 30)[-1].mode is Mode.READY
    # The same numbers as those of a bridge that is armed by itself, but for their validity.
    plain = Trial(settling_s=0.0).run(BEGIN_MS + 30)
    assert [tick.force_n for tick in trial.ticks[50:]] == [tick.force_n for tick in plain[50:]]


def test_the_safe_state_disarms_and_a_hold_does_not():
    trial = Trial(arming="manual", settling_s=0.0)
    trial.run(BEGIN_MS)
    trial.run(BEGIN_MS + 1, conditions=request(Request.ARM))
    trial.run(BEGIN_MS + 50, inject=lambda _t_ns, _frames: [])
    assert trial.ticks[-1].mode is Mode.HOLD
    assert trial.run(BEGIN_MS + 100)[-1].is_valid
    trial.run(BEGIN_MS + 800, inject=lambda _t_ns, _frames: [])
    assert trial.ticks[-1].mode is Mode.SAFE
    trial.run(BEGIN_MS + 850, conditions=request(Request.ARM))
    assert trial.ticks[-1].mode is Mode.SAFE
    trial.run(BEGIN_MS + 851, conditions=request(Request.ACKNOWLEDGE))
    assert trial.run(BEGIN_MS + 900)[-1].mode is Mode.READY
    assert trial.run(BEGIN_MS + 901, conditions=request(Request.ARM))[-1].is_valid


def test_an_open_interlock_leads_to_the_safe_state_until_it_is_closed_and_acknowledged():
    trial = trial_with_auxiliary("interlock", settling_s=0.0)
    switches = Switches(trial, interlock=True)
    assert trial.run(BEGIN_MS, switches)[-1].is_valid
    switches.closed["interlock"] = False
    ticks = trial.run(BEGIN_MS + 100, switches)[BEGIN_MS:]
    # The first frame that reports it is that of this tick.
    assert set(modes(ticks)) == {Mode.SAFE}
    cause = trial.state.supervised.first_cause
    assert (cause.event, cause.quantity, cause.value) == (Event.INTERLOCK_OPEN, "interlock", 0.0)
    acknowledge = request(Request.ACKNOWLEDGE)
    assert trial.run(BEGIN_MS + 200, switches, acknowledge)[-1].mode is Mode.SAFE
    switches.closed["interlock"] = True
    trial.run(BEGIN_MS + 211, switches)
    assert trial.ticks[-1].mode is Mode.SAFE
    trial.run(BEGIN_MS + 212, switches, acknowledge)
    assert trial.run(BEGIN_MS + 260, switches)[-1].is_valid


@pytest.mark.parametrize(
    ("name", "lost"),
    [("interlock", Mode.SAFE), ("enable", Mode.READY)],
    ids=["interlock", "enable"],
)
def test_a_switch_that_is_silent_counts_as_open(name, lost):
    trial = trial_with_auxiliary(name, settling_s=0.0)
    switches = Switches(trial, **{name: True})
    trial.run(BEGIN_MS + 1, switches)
    switches.is_silent = True
    ticks = trial.run(BEGIN_MS + SAFE_AFTER_MS + 20, switches)[BEGIN_MS:]
    valid = [tick.is_valid for tick in ticks]
    assert valid == [True] * (SAFE_AFTER_MS + 1) + [False] * 19
    assert ticks[-1].mode is lost


@pytest.mark.parametrize(
    ("name", "lost"),
    [("interlock", Mode.SAFE), ("enable", Mode.READY)],
    ids=["interlock", "enable"],
)
@pytest.mark.parametrize("missed", [1, 5, 15])
def test_a_switch_that_opens_while_ticks_are_missed_is_open(name, lost, missed):
    """Its frame comes with several heights, before the last of them."""
    trial = trial_with_auxiliary(name, settling_s=0.0)
    switches = Switches(trial, **{name: True})
    trial.run(BEGIN_MS, switches)
    switches.closed[name] = False
    # The switch reports itself every 10 ms.
    frames = []
    for ms in range(BEGIN_MS, BEGIN_MS + missed + 1):
        frames += switches(ms * MS, trial.bench.update(ms * MS)[0])
    _, result = trial.bridge.tick(
        trial.state, (BEGIN_MS + missed) * MS, frames, Conditions(overruns=missed)
    )
    assert result.output.mode is lost
    assert not result.output.struts[0].valid


def test_another_way_of_arming_begins_unarmed():
    """An operator who armed a run before it was in the safe state has not armed it since."""
    trial = Trial(settling_s=0.0, arming="manual")
    trial.run(BEGIN_MS, conditions=request(Request.ARM))
    assert trial.ticks[-1].is_valid
    t_ns = BEGIN_MS * MS
    bridges = [trial.bridge]
    for arming in ("manual", "automatic", "manual"):
        is_armed = trial.state.operation.arming.is_armed
        assert is_armed is (len(bridges) <= 2)
        supervision = trial.ready.config.supervision.model_copy(update={"arming": arming})
        bridge = bridges[-1].with_settings(trial.bridge.observers, supervision, trial.ready.limits)
        trial.state = bridge.take_over(trial.state, bridges[-1], t_ns)
        bridges.append(bridge)
    trial.bridge = bridges[-1]
    assert not trial.run(BEGIN_MS + 1)[-1].is_valid
    assert trial.run(BEGIN_MS + 2, conditions=request(Request.ARM))[-1].is_valid


@pytest.mark.parametrize("name", ["interlock", "enable"])
def test_nothing_is_valid_before_a_switch_was_ever_received(name):
    trial = trial_with_auxiliary(name, settling_s=0.0)
    switches = Switches(trial, **{name: True})
    switches.is_silent = True
    ticks = trial.run(BEGIN_MS, switches)
    assert not any(tick.is_valid for tick in ticks)
    assert ticks[-1].mode is Mode.READY
    switches.is_silent = False
    assert trial.run(BEGIN_MS + SWITCH_CYCLE_MS + 1, switches)[-1].is_valid


def test_an_enable_signal_is_followed_at_its_level():
    trial = trial_with_auxiliary("enable", settling_s=0.0)
    switches = Switches(trial, enable=False)
    assert trial.run(BEGIN_MS, switches)[-1].mode is Mode.READY
    for cycle in range(4):
        switches.closed["enable"] = cycle % 2 == 0
        ticks = trial.run(BEGIN_MS + (cycle + 1) * 50, switches)
        assert ticks[-1].is_valid == switches.closed["enable"]


def test_a_switch_within_a_late_frame_counts_at_once():
    """A frame that was held back has samples of the past, and a switch of now."""
    trial = trial_with_auxiliary("interlock", settling_s=0.0)
    switches = Switches(trial, interlock=True)
    kept = []

    def hold_back(t_ns, frames):
        kept.extend(switches(t_ns, frames))
        if BEGIN_MS <= t_ns // MS < BEGIN_MS + 5:
            return []
        arriving, kept[:] = list(kept), []
        return arriving

    trial.run(BEGIN_MS, hold_back)
    assert trial.ticks[-1].is_valid
    switches.closed["interlock"] = False
    ticks = trial.run(BEGIN_MS + 8, hold_back)[BEGIN_MS:]
    assert [tick.mode for tick in ticks][5:] == [Mode.SAFE] * 3


def test_the_force_fades_in_linearly_and_is_valid_only_then():
    trial = Trial(settling_s=0.0, fade_in_s=0.2)
    plain = Trial(settling_s=0.0).run(BEGIN_MS)
    ticks = trial.run(BEGIN_MS)
    first = modes(ticks).index(Mode.READY)
    fading = ticks[first : first + 200]
    assert set(modes(fading)) == {Mode.READY}
    for number, tick in enumerate(fading, start=1):
        expected = number / 200 * plain[first + number - 1].force_n
        assert tick.force_n == pytest.approx(expected, abs=1e-9)
    assert ticks[first + 199].force_n == pytest.approx(plain[first + 199].force_n)
    assert all(tick.is_valid for tick in ticks[first + 200 :])


def test_a_force_that_is_lost_moves_to_the_safe_output_at_its_rate():
    trial = Trial(settling_s=0.0, slew_n_per_s=2000.0)
    trial.run(BEGIN_MS)
    last_n = trial.ticks[-1].force_n
    ticks = trial.run(BEGIN_MS + 700, inject=lambda _t_ns, _frames: [])[BEGIN_MS:]
    begin = modes(ticks).index(Mode.HOLD)
    before_n = ticks[begin - 1].force_n if begin else last_n
    for number, tick in enumerate(ticks[begin:], start=1):
        left_n = max(abs(before_n) - 2.0 * number, 0.0)
        assert abs(tick.force_n) == pytest.approx(left_n, abs=1e-9)
    assert ticks[-1].mode is Mode.SAFE


def test_the_end_of_a_run_has_its_ramp():
    trial = Trial(settling_s=0.0, slew_n_per_s=2000.0)
    trial.run(BEGIN_MS)
    before_n, t_ns, state = trial.ticks[-1].force_n, BEGIN_MS * MS, trial.state
    count = 0
    while count == 0 or not trial.bridge.is_at_rest(state):
        state, frames = trial.bridge.end(state, t_ns)
        assert frames
        t_ns += MS
        count += 1
    assert count == -(-abs(before_n) // 2.0)
    stopped = trial.bridge.stop_ramp(trial.state)
    assert trial.bridge.is_at_rest(trial.bridge.end(stopped, t_ns)[0])


def test_an_acknowledgement_during_the_ramp_is_refused():
    limits = [{"value": "height_m", "low": 0.3, "action": "safe"}]
    trial = Trial(limits=limits, settling_s=0.0, slew_n_per_s=100.0)
    trial.run(760)
    assert trial.ticks[-1].mode is Mode.SAFE
    assert trial.ticks[-1].force_n
    assert trial.run(761, conditions=request(Request.ACKNOWLEDGE))[-1].mode is Mode.SAFE


STRUT = StrutOutput(5.0, 1.0, True, 0.4, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("mode", [Mode.SETTLING, Mode.READY, Mode.RUNNING, Mode.HOLD, Mode.SAFE])
def test_without_ramps_what_is_published_is_the_output_itself(mode):
    operation = Operation(Arming("manual", (), 500 * MS), 0.0, None)
    assert operation.is_used
    output = StepOutput(mode, (STRUT,))
    state, shown = operation.publish(OperationState(0), MS, output, [0.0])
    assert shown is output
    assert state == OperationState(MS)
    assert operation.is_at_rest(state, [0.0])


def test_a_force_has_faded_in_at_its_time_exactly_whatever_the_ticks():
    operation = Operation(Arming("automatic", (), 500 * MS), 0.01, None)
    state, output = OperationState(0), StepOutput(Mode.READY, (STRUT,))
    shares = []
    for t_ms in (3, 6, 9, 12):
        state, shown = operation.publish(state, t_ms * MS, output, [0.0])
        shares.append(shown.struts[0].force_n / STRUT.force_n)
        assert operation.is_withheld(state, t_ms * MS) is (t_ms < 10)
    assert shares[:3] == pytest.approx([0.3, 0.6, 0.9])
    assert shares[3] == 1.0


@settings(max_examples=200, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([Mode.SETTLING, Mode.READY, Mode.RUNNING, Mode.HOLD, Mode.SAFE]),
            st.floats(-100.0, 100.0),
        ),
        min_size=1,
        max_size=80,
    ),
    st.sampled_from([0.0, 0.01, 0.05]),
    st.sampled_from([500.0, 5000.0]),
)
def test_no_force_moves_faster_than_its_ramps_but_the_valid_one(drawn, fade_in_s, slew_n_per_s):
    operation = Operation(Arming("automatic", (), 500 * MS), fade_in_s, slew_n_per_s)
    state, before_n, share = OperationState(0), 0.0, 0.0
    for number, (mode, force_n) in enumerate(drawn, start=1):
        output = StepOutput(mode, (STRUT.__class__(force_n, 0.0, False, 0.4, 0.0, 0.0, 0.0),))
        state, shown = operation.publish(state, number * MS, output, [0.0])
        published_n = shown.struts[0].force_n
        if mode is Mode.RUNNING:
            assert published_n == force_n
        elif mode is Mode.READY:
            # A share of the estimate, and a rest between what there was and the safe output.
            share = state.share
            rest_n = state.rest_n[0]
            assert published_n == pytest.approx(share * force_n + (1.0 - share) * rest_n)
            assert 0.0 < share <= 1.0
        else:
            assert abs(published_n - before_n) <= slew_n_per_s * 1e-3 * (1 + 1e-9)
            assert abs(published_n) <= abs(before_n) + 1e-12
            assert state.share == 0.0
        before_n = published_n


@given(st.lists(st.booleans(), max_size=60), st.integers(1, 20))
def test_a_delayed_limit_acts_after_its_time_and_ends_after_it(is_beyond, delay_ms):
    """The definition, straight: it counts as passed, or not, as the last `delay_ms` all were."""
    row = Limit(value=LimitedValue.FORCE_N, high=10.0, for_s=delay_ms * 1e-3, action="hold")
    delays, passed = (Delay(is_passed=False, since_ns=0),), False
    history = [False] * (delay_ms + 1)
    for number, beyond in enumerate(is_beyond, start=1):
        strut = StrutOutput(20.0 if beyond else 0.0, 0.0, True, 0.4, 0.0, 0.0, 0.0)
        delays = update_delays([(0, row)], delays, [values_of_estimate(strut)], number * MS)
        history = [*history[1:], beyond]
        # Since the last tick that was otherwise, as long as the delay has gone by.
        if all(it is not passed for it in history[1:]):
            passed = not passed
        assert bool(find_violations([(0, row)], delays, is_settled=True)) is passed


def test_a_delayed_limit_holds_the_estimate_and_names_its_cause():
    limits = [{"value": "innovation_m", "high": 1e-9, "for_s": 0.02, "action": "hold"}]
    ticks = Trial(limits=limits, settling_s=0.0).run(BEGIN_MS)
    ticks = [tick for tick in ticks if tick.result.output.struts]
    innovations = [tick.result.output.struts[0].innovation_m > 1e-9 for tick in ticks]
    stretches = [(key, len(list(group))) for key, group in itertools.groupby(innovations)]
    assert any(key and length > 20 for key, length in stretches)
    held = [tick.mode is Mode.HOLD for tick in ticks]
    passed, since, expected = False, 0, []
    for number, beyond in enumerate(innovations):
        if beyond is passed:
            since = number
        elif number - since >= 20:
            passed, since = not passed, number
        expected.append(passed)
    assert held == expected
    assert any(held)


def test_only_an_operator_of_a_bridge_armed_by_hand_and_its_switches_count():
    channels = [
        SimpleNamespace(index=3, quantity=INTERLOCK),
        SimpleNamespace(index=4, quantity=ENABLE),
    ]
    arming = Arming("manual", channels, 500 * MS)
    assert arming.switches == {3, 4}
    state = arming.update(OperationState(0).arming, StepInput(0, (Sample(3, 1.0, 0),), Request.ARM))
    assert not arming.permits(state, MS)
    state = arming.update(state, StepInput(MS, (Sample(4, 1.0, MS),)))
    assert arming.permits(state, MS)
    assert arming.permits(state, 500 * MS)
    assert not arming.permits(state, 501 * MS)
    assert arming.find_open(state, 500 * MS) is None
    found = arming.find_open(state, 501 * MS)
    assert found == ("age_s", pytest.approx(0.501), pytest.approx(0.5))
    later = arming.update(state, StepInput(100 * MS, (Sample(3, 1.0, 100 * MS),)))
    assert arming.find_open(later, 700 * MS).value == pytest.approx(0.6)


@pytest.mark.parametrize("quantity", [ENABLE, INTERLOCK])
def test_a_switch_may_be_the_first_channel(quantity):
    arming = Arming("automatic", [SimpleNamespace(index=0, quantity=quantity)], 500 * MS)
    assert arming.switches == {0}
    assert arming.is_used is True
    before = OperationState(0).arming
    assert arming.permits(before, 0) is False
    closed = arming.update(before, StepInput(0, (Sample(0, 1.0, 0),)))
    assert arming.permits(closed, 0) is True
    assert arming.permits(arming.update(closed, StepInput(MS, (Sample(0, 0.0, MS),))), MS) is False


def test_without_switches_and_by_itself_nothing_has_to_permit():
    assert OperationState(0).arming.is_armed is False
    arming = Arming("automatic", (), 500 * MS)
    assert arming.switches == frozenset()
    assert arming.is_used is False
    assert arming.permits(OperationState(0).arming, 10**12) is True
    assert arming.find_open(OperationState(0).arming, 10**12) is None


def test_an_estimate_that_is_no_longer_permitted_does_not_fade_in():
    arming = Arming("manual", (), 500 * MS)
    operation = Operation(arming, 0.1, None)
    armed = arming.update(OperationState(0).arming, StepInput(0, (), Request.ARM))
    output = StepOutput(Mode.READY, (STRUT,))
    state, shown = operation.publish(OperationState(0, armed), 50 * MS, output, [0.0])
    assert (state.share, shown.struts[0].force_n) == (pytest.approx(0.5), pytest.approx(2.5))
    disarmed = arming.update(armed, StepInput(0, (), Request.DISARM))
    state, shown = operation.publish(OperationState(0, disarmed, 0.5), 50 * MS, output, [0.0])
    assert (state.share, shown.struts[0].force_n) == (0.0, 0.0)
