"""What the bridge counts, held against what was done to it, and what the status says of it."""

import itertools

import cantools.database
import msgspec
import pytest

from can_dbc.database import DEFAULT_DATABASE
from can_dbc.frame import Frame
from rig.bridge import (
    bridge,
    counts,
    estimator,
    frame_checks,
    free_model,
    mode_supervisor,
    prescribed_motion,
    values,
)
from rig.bridge.counts import Conditions, Counts, TimingFigures, count_tick
from rig.bridge.supervision_limits import Action
from rig.bridge.values import Mode, StepOutput
from rig.simulated_bench.trajectory import simulate
from tests.faults.trial import BEGIN_MS, BEGIN_NS, MS, Trial, after

STATUS = cantools.database.load_file(DEFAULT_DATABASE).get_message_by_name("RIG_STATUS")


def last_status(ticks):
    frames = [f for t in ticks for f in t.result.frames if f.arbitration_id == STATUS.frame_id]
    return STATUS.decode(frames[-1].data, decode_choices=False)


def test_ticks_in_hold_are_stale():
    def gap(t_ns, frames):
        return [] if t_ns < BEGIN_NS + 40 * MS else frames

    ticks = Trial().run(BEGIN_MS + 400, after(BEGIN_NS, gap))
    held = [tick for tick in ticks if tick.mode is Mode.HOLD]
    # Too old after 10 ms, and the model starts again with the twelfth of the next measurements.
    assert [held[0].t_ns - BEGIN_NS, held[-1].t_ns - BEGIN_NS] == [10 * MS, 50 * MS]
    assert len(held) == 41
    assert ticks[-1].counts.stale == len(held)
    assert last_status(ticks)["STALE_FRAMES"] == len(held)


def test_missed_ticks_and_ticks_with_a_fault_of_the_bus_add_up():
    def conditions(t_ns):
        bus_fault = 300 * MS <= t_ns < 310 * MS
        return Conditions(overruns=3 * (t_ns in (100 * MS, 200 * MS)), bus_fault=bus_fault)

    ticks = Trial().run(700, conditions=conditions)
    assert ticks[-1].counts.overruns == 6
    assert ticks[-1].counts.bus_faulty == 10
    assert last_status(ticks)["OVERRUNS"] == 6


def test_ticks_beyond_a_limit_are_counted():
    limits = [{"value": "force_n", "high": 20.0, "action": "warn"}]
    ticks = Trial(limits=limits, settling_s=0.0).run(1000)
    beyond = [tick for tick in ticks if tick.is_valid and tick.force_n > 20.0]
    assert beyond
    assert ticks[-1].counts.limited == len(beyond)


def test_a_count_beyond_its_signal_stays_at_the_largest_value():
    def conditions(t_ns):
        return Conditions(overruns=10**7 * (t_ns == 100 * MS))

    ticks = Trial().run(400, conditions=conditions)
    status = last_status(ticks)
    assert status["OVERRUNS"] == STATUS.get_signal_by_name("OVERRUNS").maximum
    assert status["ENCODING_SATURATED"] == 0


def test_a_state_of_the_core_cannot_be_changed():
    modules = [
        bridge,
        estimator,
        frame_checks,
        free_model,
        prescribed_motion,
        counts,
        mode_supervisor,
        values,
    ]
    structs = {
        value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, msgspec.Struct)
    } - {msgspec.Struct}
    assert len(structs) > 10
    assert all(made.__struct_config__.frozen for made in structs)


def statuses(ticks):
    return [
        (frame.t_ns, STATUS.decode(frame.data, decode_choices=False))
        for tick in ticks
        for frame in tick.result.frames
        if frame.arbitration_id == STATUS.frame_id
    ]


def test_a_fault_of_the_bus_is_set_in_one_status_and_clear_in_the_next():
    estimate = 0x110

    def second_sender(t_ns, frames):
        ours = [Frame(t_ns, estimate, bytes(8))] if t_ns == 450 * MS else []
        return [*frames, *ours]

    ticks = Trial().run(1000, second_sender)
    assert ticks[-1].counts.second_sender == 1
    set_at = [t_ns // MS for t_ns, values in statuses(ticks) if values["BUS_FAULT"]]
    assert len(set_at) == 1
    assert 450 <= set_at[0] <= 550


def test_an_error_frame_and_a_stranger_s_are_nobodys_under_our_ids():
    def others(t_ns, frames):
        error = Frame(t_ns, 0x110, bytes(8), is_error=True)
        stranger = Frame(t_ns, 0x6FF, bytes(8))
        return [*frames, error, stranger]

    ticks = Trial().run(300, others)
    assert ticks[-1].counts.second_sender == 0


def test_a_height_that_cannot_be_is_counted_once():
    limits = [{"value": "measured_height_m", "low": 0.1, "high": 0.4, "action": "refuse"}]
    trial = Trial(limits=limits)
    ticks = trial.run(800)
    truth = simulate(trial.bench.config, 799 * MS, MS)
    beyond = int((truth.height_m[:, 0] > 0.4).sum())
    assert beyond > 20
    counts = ticks[-1].counts
    assert counts.implausible == counts.refused
    assert abs(counts.implausible - beyond) <= 2  # a sensor's step at either end


def test_the_strut_that_ran_away_is_named():
    right = values.StrutOutput(1.0, 0.0, True, 0.5, 0.0, 0.0, 0.0)
    for wrong in ({"force_n": float("nan")}, {"height_m": 1e30}, {"velocity_m_per_s": -1e30}):
        away = msgspec.structs.replace(right, **wrong)
        assert estimator.find_divergence((right, away)) == 1
        assert estimator.find_divergence((away, right)) == 0


def test_nothing_is_counted_at_the_start_and_exactly_what_came_afterwards():
    trial = Trial()
    assert set(trial.state.counts) == {0}

    def faults(t_ns, frames):
        heights = [frame for frame in frames if frame.arbitration_id == 0x100]
        if t_ns in (400 * MS, 450 * MS):
            return [*frames, *heights]  # twice
        if t_ns in (500 * MS, 550 * MS, 600 * MS):
            return [
                msgspec.structs.replace(f, data=f.data[:3]) if f in heights else f for f in frames
            ]
        return frames

    counts = trial.run(800, faults)[-1].counts
    assert counts.repeated == 2
    assert counts.wrong_length == 3
    assert counts.refused == 5
    assert counts.lost == 3  # the counters of those that were cut short
    assert counts.out_of_sequence == counts.masquerade == counts.wrong_crc == 0
    assert counts.implausible == counts.saturated == counts.second_sender == 0


@pytest.mark.parametrize("mode", Mode)
def test_a_tick_counts_each_thing_that_is_not_as_it_should_be(mode):
    before = Counts(*range(100, 100 + len(Counts._fields)))
    for action, overruns, bus_fault, left_out, faulty in itertools.product(
        (0, *Action), (0, 3), (False, True), ((), (7,), (7, 9)), (0, 1, 2)
    ):
        output = StepOutput(mode, (), left_out)
        conditions = Conditions(overruns, bus_fault=bus_fault)
        after = count_tick(before, output, action, conditions, faulty)
        more = {name: a - b for name, a, b in zip(Counts._fields, after, before, strict=True)}
        assert {name: number for name, number in more.items() if number} == {
            name: number
            for name, number in {
                "limited": int(action >= Action.WARN),
                "overruns": overruns,
                "bus_faulty": int(bus_fault),
                "left_out": len(left_out),
                "device_faulty": faulty,
                "stale": int(mode is Mode.HOLD),
            }.items()
            if number
        }
        # The state of a tick at which all is well is not built anew.
        assert (after is before) == (not any(more.values()))


def test_a_refusal_counts_twice_in_all_and_by_its_cause():
    counts = Counts(lost=4).plus_refusal("repeated").plus_refusal("untimed").plus(lost=2)
    assert counts == Counts(lost=6, refused=2, repeated=1, untimed=1)


def test_before_anything_is_known_of_a_tick_all_is_well():
    assert not any(value for name, value in Conditions()._asdict().items() if name != "timing")
    assert Conditions().timing == TimingFigures()
    assert TimingFigures() == ((0.0,) * 4, (0.0,) * 4, 0.0)
