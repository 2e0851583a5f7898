"""The table of limits, and the way into the safe state and out of it."""

import dataclasses
import itertools
import math

import cantools.database
import pytest
from msgspec.structs import replace

from can_dbc.codec import compile_decoder
from can_dbc.database import DEFAULT_DATABASE
from can_dbc.errors import InputError
from can_dbc.protection import compile_protector
from can_dbc.units import Dimension
from can_dbc.yaml_file import load_yaml
from rig.bridge.counts import Conditions
from rig.bridge.mode_supervisor import TRANSITIONS, Event, next_mode
from rig.bridge.supervision_limits import Action, Limit, LimitedValue, judge_measurement
from rig.bridge.values import Mode, Request
from rig.closed_loop.loop import SampleTiming
from rig.closed_loop.settling import settling_times_ns
from rig.plan.build import build_plant
from rig.plan.config import CONFIGS, RunConfig
from tests.bridge.cores import FIRST
from tests.faults.trial import (
    BEGIN_MS,
    BEGIN_NS,
    MEASUREMENT,
    MS,
    SWITCH_CYCLE_MS,
    Switches,
    Trial,
    after,
    measurements_only,
)

STATUS = 0x300


def status_flags(trial, first_ms, last_ms):
    """Every status frame of a time, decoded."""
    names = [
        "STATE",
        "LIMIT_FAULT",
        "MEASUREMENT_FAULT",
        "BUS_FAULT",
        "LOG_FAULT",
        "REFUSED_FRAMES",
    ]
    decode = compile_decoder(
        trial.ready.database.message("RIG_STATUS"), names, [Dimension.NUMBER] * 6
    )
    return [
        dict(zip(names, decode(frame.data), strict=True))
        for tick in trial.ticks[first_ms:last_ms]
        for frame in tick.result.frames
        if frame.arbitration_id == STATUS
    ]


def limit(value, action, low=None, high=None):
    return {"value": value, "low": low, "high": high, "action": action}


def test_warn_tells_of_it_and_changes_nothing_else():
    plain = Trial(settling_s=0.0)
    warned = Trial(limits=[limit("force_n", "warn", high=100.0)], settling_s=0.0)
    forces = [[tick.force_n for tick in trial.run(900)[FIRST:]] for trial in (plain, warned)]
    assert forces[0] == forces[1]
    beyond = sum(force > 100.0 for force in forces[0])
    assert warned.ticks[-1].counts.limited == beyond > 100
    assert {flags["LIMIT_FAULT"] for flags in status_flags(plain, 0, 900)} == {0.0}
    assert 1.0 in {flags["LIMIT_FAULT"] for flags in status_flags(warned, 0, 900)}


@pytest.mark.slow
@pytest.mark.parametrize("value", ["height_m", "force_n", "virtual_force_n", "innovation_m"])
def test_hold_marks_the_estimate_invalid_as_long_as_it_lasts(value):
    """No longer: the estimate has not lost what it had settled to."""
    reference = Trial().run(BEGIN_MS + 1000)[BEGIN_MS:]
    field = {"height_m": 0.35, "force_n": 100.0, "virtual_force_n": 0.0, "innovation_m": 0.0}[value]
    values = [getattr(tick.result.output.struts[0], value) for tick in reference]
    expected = [number <= field for number in values]
    assert 50 < sum(expected) < 950
    trial = Trial(limits=[limit(value, "hold", high=field)])
    ticks = trial.run(BEGIN_MS + 1000)[BEGIN_MS:]
    assert [tick.is_valid for tick in ticks] == expected
    assert {tick.mode for tick in ticks} == {Mode.RUNNING, Mode.HOLD}


@pytest.mark.parametrize("safe_output", ["zero", "last"])
def test_safe_is_held_with_its_defined_output_until_it_is_acknowledged(safe_output):
    # The bench's height falls below 0.3 m at 0.5 s, and is above it again at 0.75 s.
    limits = [limit("height_m", "safe", low=0.3)]
    trial = Trial(limits=limits, safe_output=safe_output, settling_s=0.0)
    ticks = trial.run(800)
    first = next(index for index, tick in enumerate(ticks) if tick.mode is Mode.SAFE)
    assert ticks[first - 1].result.output.struts[0].height_m >= 0.3
    assert all(tick.mode is Mode.SAFE for tick in ticks[first:])
    held = 0.0 if safe_output == "zero" else ticks[first - 1].force_n
    assert {tick.force_n for tick in ticks[first:]} == {held}
    assert not any(tick.is_valid for tick in ticks[first:])
    # Acknowledged, the bridge starts from the measurements that have come meanwhile.
    trial.run(801, conditions=lambda _t_ns: Conditions(request=Request.ACKNOWLEDGE))
    again = trial.run(803)[800:]
    assert [tick.mode for tick in again] == [Mode.WAITING] + [Mode.RUNNING] * 2
    assert again[-1].is_valid


def test_a_bridge_that_misses_most_of_its_ticks_is_not_running():
    trial = Trial(settling_s=0.0)
    trial.run(BEGIN_MS)
    ticks = trial.run(BEGIN_MS + 200, conditions=lambda _t_ns: Conditions(overruns=3))[BEGIN_MS:]
    # Three of four are missed: their fading share passes a half after 200 ln 3 of them.
    first = next(index for index, tick in enumerate(ticks) if tick.mode is Mode.HOLD)
    assert first * 4 == pytest.approx(200 * math.log(3.0), abs=8)
    assert {tick.mode for tick in ticks[first:]} == {Mode.HOLD}
    cause = trial.state.supervised.first_cause
    assert (cause.event, cause.quantity, cause.limit) == (Event.OVERLOADED, "missed_share", 0.5)
    again = trial.run(BEGIN_MS + 400)[BEGIN_MS + 200 :]
    assert again[-1].mode is Mode.RUNNING


@pytest.mark.parametrize(
    ("log_fault", "expected"), [("continue", Mode.RUNNING), ("safe", Mode.SAFE)]
)
def test_a_log_that_cannot_be_written_is_what_the_user_makes_of_it(log_fault, expected):
    trial = Trial(settling_s=0.0, log_fault=log_fault)
    trial.run(BEGIN_MS)
    lost = Conditions(log_fault=True)
    ticks = trial.run(BEGIN_MS + 50, conditions=lambda _t_ns: lost)[BEGIN_MS:]
    assert {tick.mode for tick in ticks} == {expected}
    # As long as it lasts, an acknowledgement does not leave the safe state.
    acknowledged = Conditions(request=Request.ACKNOWLEDGE, log_fault=True)
    assert trial.run(BEGIN_MS + 51, conditions=lambda _t_ns: acknowledged)[-1].mode is expected
    acknowledged = Conditions(request=Request.ACKNOWLEDGE)
    again = trial.run(BEGIN_MS + 52, conditions=lambda _t_ns: acknowledged)[-1]
    assert again.mode is (Mode.RUNNING if expected is Mode.RUNNING else Mode.WAITING)


def test_a_bridge_that_misses_every_third_tick_is_running():
    trial = Trial(settling_s=0.0)
    trial.run(BEGIN_MS)

    def conditions(t_ns):
        return Conditions(overruns=1 if t_ns // MS % 2 else 0)

    ticks = trial.run(BEGIN_MS + 500, conditions=conditions)[BEGIN_MS:]
    assert {tick.mode for tick in ticks} == {Mode.RUNNING}


def thermometer_of(trial, temperature_c):
    return Switches(trial, Dimension.TEMPERATURE, temperature=temperature_c)


HOT = {"channel": "temperature", "value": "measured", "high": 80.0}


def test_a_limit_on_a_slow_signal_holds_from_one_frame_to_the_next():
    trial = Trial(limits=[HOT | {"action": "hold"}], settling_s=0.0)
    thermometer = thermometer_of(trial, 20.0)
    assert trial.run(BEGIN_MS, thermometer)[-1].is_valid
    thermometer.closed["temperature"] = 120.0
    ticks = trial.run(BEGIN_MS + 200, thermometer)[BEGIN_MS:]
    first = next(index for index, tick in enumerate(ticks) if tick.mode is Mode.HOLD)
    assert first < SWITCH_CYCLE_MS
    assert {tick.mode for tick in ticks[first:]} == {Mode.HOLD}
    cause = trial.state.supervised.cause
    assert (cause.event, cause.value, cause.limit) == (Event.BEYOND_HOLD, 120.0, 80.0)
    # Not a frame that is missing ends it: one within the limit does.
    thermometer.is_silent = True
    assert trial.run(BEGIN_MS + 400, thermometer)[-1].mode is Mode.HOLD
    thermometer.is_silent = False
    thermometer.closed["temperature"] = 79.0
    # Its counter stood still meanwhile: some frames show its sender's clock again.
    assert trial.run(BEGIN_MS + 400 + 10 * SWITCH_CYCLE_MS, thermometer)[-1].is_valid


def test_the_safe_state_is_not_left_between_two_frames_beyond_a_limit():
    trial = Trial(limits=[HOT | {"action": "safe"}], settling_s=0.0)
    thermometer = thermometer_of(trial, 120.0)

    def acknowledge(_t_ns):
        return Conditions(request=Request.ACKNOWLEDGE)

    trial.run(BEGIN_MS, thermometer)
    ticks = trial.run(BEGIN_MS + 200, thermometer, acknowledge)
    first = next(index for index, tick in enumerate(ticks) if tick.mode is Mode.SAFE)
    assert {tick.mode for tick in ticks[first:]} == {Mode.SAFE}
    thermometer.closed["temperature"] = 79.0
    ticks = trial.run(BEGIN_MS + 300, thermometer, acknowledge)
    assert ticks[-1].is_valid


def test_what_a_signal_is_beyond_stays_so_as_long_as_it_has_a_limit():
    trial = Trial(limits=[HOT | {"action": "hold"}], settling_s=0.0)
    assert trial.run(BEGIN_MS, thermometer_of(trial, 120.0))[-1].mode is Mode.HOLD
    frames = trial.bench.update(BEGIN_MS * MS)[0]
    heights = [frame for frame in frames if frame.arbitration_id == MEASUREMENT]
    for limits, expected in (
        ([HOT | {"high": 90.0, "action": "hold"}], Mode.HOLD),
        ([], Mode.RUNNING),
    ):
        content = trial.ready.config.model_dump(mode="json")
        content["supervision"]["limits"] = limits
        ready = trial.ready.with_config(trial.ready.config.model_validate(content))
        supervision = ready.config.supervision
        bridge = trial.bridge.with_settings(trial.bridge.observers, supervision, ready.limits)
        state = bridge.take_over(trial.state, trial.bridge, BEGIN_MS * MS)
        assert bridge.tick(state, BEGIN_MS * MS, heights)[1].output.mode is expected


@pytest.mark.parametrize("missed", [(0, 1), (3, 0, 0), (0, 0, 25)])
def test_the_share_of_missed_ticks_fades_by_a_two_hundredth_at_each(missed):
    """Twenty of one pause count: ages judge a pause, however long it is."""
    trial = Trial(settling_s=0.0, overload_share=1.0)
    pattern = itertools.islice(itertools.cycle(missed), 60)
    of_ticks = [0] * 60 + list(pattern) + [0] * 1400
    share, shares, expected = 0.0, [], []
    for index, count in enumerate(of_ticks):
        trial.state, _ = trial.bridge.tick(trial.state, index * MS, [], Conditions(overruns=count))
        shares.append(trial.state.missed_share)
        for _ in range(min(count, 20)):
            share += (1.0 - share) / 200.0
        share -= share / 200.0
        # Less than a thousandth is none.
        share = share if share > 1e-3 else 0.0
        expected.append(share)
    assert shares == pytest.approx(expected, rel=1e-9)
    assert max(shares) > 0.1
    assert shares[-1] == 0.0


def test_an_implausible_height_is_refused_with_all_of_its_frame():
    limits = [limit("measured_height_m", "refuse", low=0.38, high=0.45)]
    trial = Trial(limits=limits)
    ticks = trial.run(300)
    used = [tick.result.step_input for tick in ticks]
    refused = [item for item in used if trial.value(item, "strut") is None]
    assert refused
    assert all(trial.value(item, "applied_force") is None for item in refused)
    assert all(0.38 <= trial.value(item, "strut") <= 0.45 for item in used if item not in refused)
    assert ticks[-1].counts.implausible == len(refused)
    assert status_flags(trial, 0, 300)[-1]["REFUSED_FRAMES"] > 0


def row(value, low, high, action):
    return Limit(value=LimitedValue(value), low=low, high=high, action=action)


def seen_after(limits, *measured):
    seen, actions = None, []
    for height_m, t_ms in measured:
        seen, action = judge_measurement(limits, seen, height_m, t_ms * MS)
        actions.append(action)
    return actions


def test_a_jump_is_refused_until_the_time_allows_for_it():
    rate = [row("measured_rate_m_per_s", -1.0, 1.0, "refuse")]
    jumped = [(0.5, 0), (0.5005, 1), (0.51, 2), (0.51, 3), (0.51, 10), (0.51, 11)]
    assert seen_after(rate, *jumped) == [0, 0, Action.REFUSE, Action.REFUSE, Action.REFUSE, 0]


def test_a_height_may_stay_the_same_for_as_long_as_the_limit_says():
    stuck = [row("unchanged_s", 0.0, 0.002, "hold")]
    same = [(0.5, 0), (0.5, 1), (0.5, 2), (0.5, 3), (0.5, 4), (0.50001, 5), (0.50001, 6)]
    assert seen_after(stuck, *same) == [0, 0, 0, Action.HOLD, Action.HOLD, 0, 0]


def test_the_severest_action_counts():
    rows = [
        row("measured_height_m", 0.2, 0.8, "warn"),
        row("measured_height_m", 0.1, 0.9, "safe"),
    ]
    assert seen_after(rows, (0.5, 0), (0.85, 1), (0.95, 2)) == [0, Action.WARN, Action.SAFE]


def test_a_measurement_beyond_a_safe_limit_enters_the_safe_state_at_once():
    trial = Trial(limits=[limit("measured_height_m", "safe", low=0.05)])
    message = trial.ready.database.message("BENCH_MEASUREMENT")
    zero = bytes(8)
    protect = compile_protector(message.protection)

    def broken_sensor(frame):
        return [replace(frame, data=protect(zero, frame.data[1] & 0x0F))]

    ticks = trial.run(BEGIN_MS + 100, after(BEGIN_NS, measurements_only(broken_sensor)))
    assert ticks[BEGIN_MS - 1].mode is Mode.RUNNING
    assert ticks[BEGIN_MS].mode is Mode.SAFE


def test_what_is_sent_before_the_first_valid_measurement_says_waiting_and_invalid():
    trial = Trial()
    ticks = trial.run(200, lambda _t_ns, frames: [replace(f, data=bytes(8)) for f in frames])
    assert {tick.mode for tick in ticks} == {Mode.WAITING}
    states = [flags["STATE"] for flags in status_flags(trial, 0, 200)]
    assert states == [Mode.WAITING] * len(states) != []
    database = cantools.database.load_file(DEFAULT_DATABASE)
    for name in ("RIG_ESTIMATE", "RIG_KINEMATICS"):
        message = database.get_message_by_name(name)
        sent = [
            message.decode(frame.data, decode_choices=False)
            for tick in ticks
            for frame in tick.result.frames
            if frame.arbitration_id == message.frame_id
        ]
        assert len(sent) >= 200 // message.cycle_time
        for values in sent:
            del values["CRC"], values["COUNTER"]
            assert ("VALID" in values) == (name == "RIG_ESTIMATE")
            assert set(values.values()) == {0}


@pytest.mark.parametrize(
    ("away_ms", "overruns", "expected"),
    [(600, 599, Mode.SAFE), (400, 399, Mode.RUNNING), (600, 0, Mode.RUNNING)],
)
def test_a_bench_that_was_left_alone_for_too_long_is_not_taken_up_again(
    away_ms, overruns, expected
):
    """Whatever came meanwhile: all measurements are there. Without missed ticks it was no gap."""
    trial = Trial()
    assert trial.run(BEGIN_MS)[-1].mode is Mode.RUNNING
    t_ns = (BEGIN_MS - 1 + away_ms) * MS
    frames = trial.bench.update(t_ns)[0]
    assert len(frames) > away_ms
    trial.state, result = trial.bridge.tick(
        trial.state, t_ns, frames, Conditions(overruns=overruns)
    )
    assert result.output.mode is expected


def test_with_other_gains_the_estimate_settles_again_and_with_other_ages_it_does_not():
    trial = Trial()
    assert trial.run(BEGIN_MS)[-1].mode is Mode.RUNNING
    ages = trial.ready.config.supervision.model_copy(update={"stale_after_s": 0.02})
    (observer,) = trial.bridge.observers
    softer = dataclasses.replace(observer, proportional_n_per_m=5e4)
    patient = trial.bridge.with_settings(trial.bridge.observers, ages, trial.ready.limits)
    trial.state = patient.take_over(trial.state, trial.bridge, BEGIN_NS)
    trial.bridge = patient
    assert trial.run(BEGIN_MS + 1)[-1].mode is Mode.RUNNING
    changed = patient.with_settings((softer,), ages, trial.ready.limits)
    since_ms = BEGIN_MS + 1
    trial.state = changed.take_over(trial.state, patient, since_ms * MS)
    trial.bridge = changed
    ticks = trial.run(since_ms + 2000)[since_ms:]
    settled = [tick.mode for tick in ticks].index(Mode.RUNNING)
    plant, rest_m = build_plant(trial.ready), [trial.ready.struts[0].free_length_m]
    (settling_ns,) = settling_times_ns(plant, (softer,), rest_m, SampleTiming(MS))
    assert settled * MS == settling_ns
    assert {tick.mode for tick in ticks[:settled]} == {Mode.SETTLING}
    assert {tick.mode for tick in ticks[settled:]} == {Mode.RUNNING}


def test_every_way_out_of_the_safe_state_is_somebodys_decision():
    ways = {event for (mode, event) in TRANSITIONS if mode is Mode.SAFE}
    assert ways == {Event.ACKNOWLEDGED}


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        ({"value": "force_n", "action": "warn"}, "expected low, high or both"),
        ({"value": "force_n", "low": 2, "high": 1, "action": "warn"}, "expected less than high"),
        ({"value": "force_n", "high": 1, "action": "refuse"}, "expected warn, hold or safe"),
        ({"value": "force_kn", "high": 1, "action": "warn"}, "measured_height_m"),
        (
            {"value": "force_n", "high": 1, "action": "explode"},
            "expected one of warn, refuse, hold, safe",
        ),
        ({"value": "force_n", "high": ".nan", "action": "warn"}, "high"),
        ({"value": "force_n", "high": 1, "action": "warn", "unit": "N"}, "unknown key"),
    ],
)
def test_a_wrong_row_is_one_line_that_names_it(tmp_path, row, expected):
    text = (CONFIGS / "reference.yaml").read_text()
    cells = ", ".join(f"{key}: {value}" for key, value in row.items())
    path = tmp_path / "rig.yaml"
    path.write_text(f"{text}\nsupervision: {{limits: [{{{cells}}}]}}\n")
    with pytest.raises(InputError, match=expected) as caught:
        load_yaml(RunConfig, path)
    assert str(caught.value).startswith(f"{path}: supervision.limits.0")
    assert "\n" not in str(caught.value)


def test_an_open_limit_has_no_end():
    open_below = row("force_n", None, 5.0, "warn")
    assert [open_below.action_at(value) for value in (-1e300, 5.0, 5.1)] == [0, 0, Action.WARN]
    open_above = row("force_n", 5.0, None, "safe")
    assert [open_above.action_at(value) for value in (4.9, 5.0, 1e300)] == [Action.SAFE, 0, 0]
    assert open_above.action_at(float("nan")) == Action.SAFE


LOSSES = {
    Event.STALE: Mode.HOLD,
    Event.OVERLOADED: Mode.HOLD,
    Event.BEYOND_HOLD: Mode.HOLD,
    Event.DEVICE_FAULT: Mode.HOLD,
    Event.TIMEOUT: Mode.SAFE,
    Event.TICKS_MISSING: Mode.SAFE,
    Event.DIVERGED: Mode.SAFE,
    Event.BEYOND_SAFE: Mode.SAFE,
    Event.LOG_LOST: Mode.SAFE,
    Event.INTERLOCK_OPEN: Mode.SAFE,
}
"""What a model that follows its bench loses its estimate by."""

NEXT = {
    Mode.INIT: {},
    Mode.WAITING: {Event.FRESH: Mode.SETTLING},
    Mode.SETTLING: {Event.SETTLED: Mode.RUNNING, Event.WITHHELD: Mode.READY, **LOSSES},
    Mode.READY: {Event.SETTLED: Mode.RUNNING, Event.UNSETTLED: Mode.SETTLING, **LOSSES},
    Mode.RUNNING: {Event.WITHHELD: Mode.READY, Event.UNSETTLED: Mode.SETTLING, **LOSSES},
    Mode.HOLD: {
        Event.FRESH: Mode.SETTLING,
        Event.TIMEOUT: Mode.SAFE,
        Event.TICKS_MISSING: Mode.SAFE,
        Event.DIVERGED: Mode.SAFE,
        Event.BEYOND_SAFE: Mode.SAFE,
        Event.LOG_LOST: Mode.SAFE,
        Event.INTERLOCK_OPEN: Mode.SAFE,
    },
    Mode.SAFE: {Event.ACKNOWLEDGED: Mode.WAITING},
}
"""Mode -> event -> next mode, without the events that change nothing."""

FAR_FROM_RUNNING = [Mode.RUNNING, Mode.READY, Mode.SETTLING, Mode.HOLD, Mode.SAFE]
"""Modes in which there is a model, the one that publishes valid estimates first."""


@pytest.mark.parametrize("mode", Mode)
@pytest.mark.parametrize("event", Event)
def test_the_table_of_modes(mode, event):
    """Every pair, as it is written out above."""
    assert next_mode(mode, event) is NEXT[mode].get(event, mode)
    assert ((mode, event) in TRANSITIONS) == (event in NEXT[mode])


_GOOD = (Event.FRESH, Event.SETTLED, Event.WITHHELD, Event.ACKNOWLEDGED)


def test_an_estimate_becomes_valid_by_settling_and_in_no_other_way():
    ways = {pair for pair, after in TRANSITIONS.items() if after is Mode.RUNNING}
    assert ways == {(Mode.SETTLING, Event.SETTLED), (Mode.READY, Event.SETTLED)}


@pytest.mark.parametrize(
    "event",
    [event for event in Event if event not in _GOOD],
)
def test_no_fault_leads_towards_a_valid_estimate(event):
    for mode in FAR_FROM_RUNNING:
        after = next_mode(mode, event)
        assert FAR_FROM_RUNNING.index(after) >= FAR_FROM_RUNNING.index(mode)
    assert next_mode(Mode.WAITING, event) is Mode.WAITING
