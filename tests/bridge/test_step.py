"""A tick: what it does with what came, and with what did not."""

import dataclasses
import math
import random
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from can_dbc.database import DEFAULT_DATABASE, load_database
from dart_model.plant import DartPlant
from dart_model.spec import MODELS, load_model
from rig.bridge.free_model import FreeModelEstimator
from rig.bridge.mode_supervisor import Event, Reports, Supervisor
from rig.bridge.supervision_limits import Action
from rig.bridge.values import Mode, Request, StepInput, StepOutput, StrutOutput
from rig.channels.channel import Channel
from rig.observers.error_filter import ErrorFilter
from rig.observers.kalman import KalmanObserver
from tests.bridge.cores import (
    FIRST,
    GAINS,
    MS,
    SUPERVISION,
    applied_force,
    channels,
    core,
    gains,
    measured,
    resting,
    run,
    settle_at_once,
    silent,
    supervised,
)

REST_M = 0.5 - 10.0 * 9.81 / 500.0


def test_nothing_is_said_before_every_strut_was_measured():
    rig = core("quarter_car")
    inputs = [measured(0, None, None), measured(1, 0.29, None)]
    inputs += [measured(tick, 0.29, 0.4) for tick in range(2, FIRST + 1)]
    inputs.append(measured(FIRST + 1, None, 0.4))
    states, outputs = run(rig, inputs)
    *before, started = outputs
    assert before == [StepOutput(Mode.WAITING, ())] * (FIRST + 1)
    assert started.mode is Mode.RUNNING
    assert [strut.height_m for strut in started.struts] == pytest.approx([0.29, 0.4])
    assert [state.estimator.model is not None for state in states[-2:]] == [False, True]


def test_the_model_keeps_the_time_of_the_run():
    rig = core()
    states, _ = run(rig, resting(REST_M, begin=2501 - FIRST, ticks=FIRST + 1))
    assert states[-3].estimator.model is None
    assert states[-2].estimator.model.state.t_s == pytest.approx(2.5, abs=1e-12)
    assert states[-1].estimator.model.state.t_s == pytest.approx(2.501, abs=1e-12)


def test_a_first_measurement_that_has_grown_old_does_not_start_the_model():
    rig = core("quarter_car")
    tyre = [measured(tick, 0.29, None) for tick in range(FIRST)]
    suspension = [measured(tick, None, 0.4) for tick in range(50, 50 + FIRST)]
    _, outputs = run(rig, tyre + suspension)
    assert outputs[-1].mode is Mode.WAITING
    _, outputs = run(rig, tyre + resting(0.28, 0.4, begin=50))
    assert [output.mode for output in outputs[-2:]] == [Mode.WAITING, Mode.RUNNING]
    assert outputs[-1].struts[0].height_m == pytest.approx(0.28)


def test_a_model_starts_with_its_applied_force_and_not_without():
    rig = core()
    states, outputs = run(rig, [measured(tick, 0.4, applied_n=None) for tick in range(50)])
    assert {output.mode for output in outputs} == {Mode.WAITING}
    states, (output,) = run(rig, [measured(50, 0.4, applied_n=25.0)], states[-1])
    assert output.mode is Mode.RUNNING
    assert output.struts[0].acceleration_m_per_s2 == pytest.approx(
        (-500.0 * (0.4 - 0.5) + 25.0) / 10.0 - 9.81
    )


def test_an_applied_force_that_stays_away_is_a_missing_measurement():
    rig = core()
    inputs = resting(0.4)
    inputs += [measured(tick, 0.4, applied_n=None) for tick in range(FIRST, FIRST + 600)]
    _, outputs = run(rig, inputs)
    modes = [output.mode for output in outputs[FIRST - 1 :]]
    # As old as a height may be, counted from the tick of the last one.
    assert modes[:11] == [Mode.RUNNING] * 11
    assert modes[11:501] == [Mode.HOLD] * 490
    assert set(modes[501:]) == {Mode.SAFE}


def test_an_estimate_is_valid_when_it_has_settled():
    rig = core(settling_times=lambda observers: [30 * MS] * len(observers))
    _, outputs = run(rig, resting(0.4, ticks=60))
    started = FIRST - 1
    modes = [output.mode for output in outputs[started:]]
    assert modes == [Mode.SETTLING] * 30 + [Mode.RUNNING] * (60 - started - 30)
    valid = [output.struts[0].valid for output in outputs[started:]]
    assert valid == [mode is Mode.RUNNING for mode in modes]


def test_an_estimate_that_never_settles_is_never_valid():
    _, outputs = run(core(settling_times=lambda _observers: [None]), resting(0.4, ticks=3000))
    assert {output.mode for output in outputs[FIRST - 1 :]} == {Mode.SETTLING}


def test_a_virtual_force_at_its_limit_has_to_settle_again():
    """A bench that jumps by a millimetre asks for more than 50 N until the model is there."""
    times = {"settling_times": lambda observers: [30 * MS] * len(observers)}
    rig = core(observer=gains(1e5, 0.0, 50.0), **times)
    inputs = resting(REST_M, ticks=60) + resting(REST_M + 1e-3, begin=60, ticks=300)
    _, outputs = run(rig, inputs)
    limited = [
        tick
        for tick, output in enumerate(outputs)
        if output.struts and abs(output.struts[0].virtual_force_n) == 50.0
    ]
    assert limited[0] == 60
    assert limited[-1] < 300
    modes = [output.mode for output in outputs]
    assert modes[59] is Mode.RUNNING
    for tick in limited:
        assert set(modes[tick : tick + 30]) == {Mode.SETTLING}
    assert modes[limited[-1] + 30] is Mode.RUNNING


def test_up_to_five_measurement_intervals_the_model_goes_on():
    inputs = resting(0.4, ticks=50) + silent(50, 54) + resting(0.402, begin=54, ticks=10)
    states, outputs = run(core(), inputs)
    assert {output.mode for output in outputs[FIRST - 1 :]} == {Mode.RUNNING}
    assert outputs[54].struts[0].height_m == pytest.approx(0.4, abs=1e-3)
    assert states[54].estimator.observers.struts[0].integral_m_s > 0.0


def test_after_a_longer_gap_model_and_observer_start_again_from_measurements():
    """What was published last stands until then, as invalid."""
    inputs = resting(0.4, ticks=50) + silent(50, 55) + resting(0.402, begin=55, ticks=40)
    states, outputs = run(core(), inputs)
    modes = [output.mode for output in outputs]
    assert set(modes[FIRST - 1 : 55]) == {Mode.RUNNING}
    starts = 55 + FIRST - 1
    assert set(modes[55:starts]) == {Mode.SETTLING, Mode.HOLD}
    held = (replace(outputs[54].struts[0], valid=False),)
    assert {output.struts for output in outputs[55:starts]} == {held}
    assert set(modes[starts:]) == {Mode.RUNNING}
    (strut,) = outputs[starts].struts
    assert (strut.height_m, strut.velocity_m_per_s) == pytest.approx((0.402, 0.0), abs=1e-9)
    assert states[starts].estimator.observers.struts[0].integral_m_s == 0.0


def test_a_constant_unknown_force_leaves_no_steady_innovation():
    """A bench that rests 3 cm beside the model's own rest position: the integral takes it all."""
    rig = core(observer=gains(1e4, 1e6, 5000.0), supervision=SUPERVISION)
    rig = damped(rig)
    height_m = REST_M + 0.03
    _, outputs = run(rig, [measured(tick, height_m) for tick in range(6000)])
    (strut,) = outputs[-1].struts
    assert abs(strut.innovation_m) < 1e-7
    assert strut.virtual_force_n == pytest.approx(500.0 * 0.03, abs=0.01)
    # The strut carries the weight, whatever the model thought of the spring.
    assert strut.force_n == pytest.approx(10.0 * 9.81, abs=0.001)


def damped(rig: Supervisor) -> Supervisor:
    """The same with a damper that lets a high integral gain settle."""
    spec = rig.estimator._plant.spec
    strut = spec.struts[0].model_copy(update={"damping_n_s_per_m": 2000.0})
    plant = DartPlant(spec.model_copy(update={"struts": (strut,)}))
    return supervised(plant, rig.estimator.observers)


def test_the_seed_gains_leave_what_proportional_control_leaves():
    rig = core(observer=gains(1e5, 0.0, 5000.0))
    height_m = REST_M + 0.03
    _, outputs = run(rig, [measured(tick, height_m) for tick in range(4000)])
    (strut,) = outputs[-1].struts
    # K (z_model - rest) = K_P (z - z_model), with the innovation as the unknown.
    assert strut.innovation_m == pytest.approx(500.0 * 0.03 / (500.0 + 1e5), rel=1e-4)


@given(gap=st.integers(1, 4))
@settings(max_examples=10, deadline=None)
def test_between_measurements_the_virtual_force_is_held(gap):
    rig = core()
    heights = [0.4 if tick % (gap + 1) == 0 else None for tick in range(100)]
    inputs = [measured(tick, height_m) for tick, height_m in enumerate(heights, start=FIRST)]
    _, outputs = run(rig, resting(0.4) + inputs)
    for height_m, (before, after) in zip(heights, pairwise(outputs[FIRST - 1 :]), strict=True):
        if height_m is None:
            assert after.struts[0].virtual_force_n == before.struts[0].virtual_force_n
            assert after.struts[0].innovation_m == before.struts[0].innovation_m
        assert after.struts[0].height_m != before.struts[0].height_m
        assert after.mode is Mode.RUNNING


def test_the_published_force_is_that_of_spring_damper_and_observer():
    rig = core()
    _, outputs = run(rig, [measured(tick, 0.4 + 1e-4 * tick) for tick in range(50 + FIRST)])
    for output in outputs[FIRST - 1 :]:
        (strut,) = output.struts
        model_n = -500.0 * (strut.height_m - 0.5) - 100.0 * strut.velocity_m_per_s
        assert strut.force_n == pytest.approx(model_n + strut.virtual_force_n, abs=1e-9)
        body_n = strut.force_n - 10.0 * 9.81
        assert strut.acceleration_m_per_s2 == pytest.approx(body_n / 10.0, abs=1e-9)


def test_a_late_measurement_is_compared_with_the_model_of_its_own_time():
    rig = core()
    states, outputs = run(rig, [measured(tick, 0.4) for tick in range(20)])
    late_ns = 600_000
    _, fresh, _ = rig.step(states[-1], measured(20, 0.41))
    _, late, _ = rig.step(states[-1], measured(20, 0.41, late_ns=late_ns))
    # The model's velocities at both ticks, before the correction, are the same in both.
    before = outputs[-1].struts[0].velocity_m_per_s
    free = rig.step(states[-1], measured(20, None))[1].struts[0].velocity_m_per_s
    late_s = late_ns * 1e-9
    fallen_m = free * late_s - 0.5 * (free - before) / (MS * 1e-9) * late_s**2
    difference = late.struts[0].innovation_m - fresh.struts[0].innovation_m
    assert difference == pytest.approx(fallen_m, rel=1e-4)


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 0.73, 0.9])
def test_a_fast_loop_is_stable_whenever_between_two_ticks_its_heights_are_measured(share):
    """A virtual force that is left out of the height between two ticks acts as an error of it."""
    filter_ = ErrorFilter.within(115.0, 1e-5)
    rig = core(observer=KalmanObserver("kalman", filter_, 1e5))
    noise = random.Random(5)
    heights = [REST_M + noise.gauss(0.0, 1e-5) for _ in range(300)]
    heights += [REST_M] * 1500
    inputs = [measured(k, h, late_ns=round(share * MS)) for k, h in enumerate(heights)]
    _, outputs = run(rig, inputs)
    forces = [abs(output.struts[0].virtual_force_n) for output in outputs if output.struts]
    assert max(forces) < 2000.0
    assert forces[-1] < 1e-3


def test_a_stale_measurement_freezes_the_integral_and_then_leads_to_the_safe_state():
    rig = core()
    started = FIRST - 1
    states, outputs = run(rig, resting(0.4, ticks=started + 10) + silent(started + 10, 620))
    states, outputs = states[started:], outputs[started:]
    modes = [output.mode for output in outputs]
    # The last measurement is that of tick 9: its force is used to 14, it is fresh to 19, stale to
    # 509, then the mode is safe.
    assert modes[:15] == [Mode.RUNNING] * 15
    assert modes[15:20] == [Mode.SETTLING] * 5
    assert modes[20:510] == [Mode.HOLD] * 490
    assert set(modes[510:]) == {Mode.SAFE}
    assert {state.estimator.observers.struts[0].integral_m_s for state in states[9:]} == {
        states[9].estimator.observers.struts[0].integral_m_s
    }
    assert [output.struts[0].valid for output in outputs[:16]] == [True] * 15 + [False]


def test_a_fresh_measurement_ends_the_hold():
    """A measurement may be old before the model has to start again."""
    rig = core(supervision=SUPERVISION.model_copy(update={"stale_after_s": 0.003}))
    last = FIRST - 1
    _, outputs = run(rig, [*resting(0.4), *silent(FIRST, last + 5), measured(last + 5, 0.4)])
    assert [output.mode for output in outputs[last + 2 : last + 5]] == [
        Mode.RUNNING,
        Mode.RUNNING,
        Mode.HOLD,
    ]
    assert outputs[-2].mode is Mode.HOLD
    assert outputs[-1].mode is Mode.RUNNING
    assert outputs[-1].struts[0].valid


@pytest.mark.parametrize("safe_output", ["zero", "last"])
def test_the_safe_output_is_held_until_it_is_acknowledged(safe_output):
    rig = core(supervision=SUPERVISION.model_copy(update={"safe_output": safe_output}))
    running = resting(0.4, ticks=20)
    _, outputs = run(rig, running)
    last_valid = outputs[-1].struts[0].force_n
    states, outputs = run(rig, running + silent(20, 540))
    safe = outputs[-1].struts[0]
    # Held through fresh measurements, because nobody has acknowledged.
    states, outputs = run(rig, resting(0.45, begin=540, ticks=40), states[-1])
    assert {output.mode for output in outputs} == {Mode.SAFE}
    assert {output.struts[0] for output in outputs} == {safe}
    before_stale = run(rig, running + silent(20, 25))[1][-1].struts[0].force_n
    assert safe == StrutOutput(
        before_stale if safe_output == "last" else 0.0, 0.0, False, safe.height_m, 0.0, 0.0, 0.0
    )
    assert math.isfinite(last_valid)
    acknowledged = StepInput(580 * MS, request=Request.ACKNOWLEDGE)
    states, outputs = run(rig, [acknowledged, *resting(0.45, begin=581)], states[-1])
    # The measurements of the safe state start the model at once.
    assert [output.mode for output in outputs] == [Mode.WAITING] + [Mode.RUNNING] * FIRST
    assert outputs[1].struts[0].height_m == pytest.approx(0.45)


def test_an_acknowledgement_means_nothing_elsewhere():
    rig = core()
    states, outputs = run(rig, resting(0.4, ticks=20))
    assert outputs[-1].mode is Mode.RUNNING
    plain = measured(20, 0.4)
    acknowledged = StepInput(plain.t_ns, plain.samples, request=Request.ACKNOWLEDGE)
    assert rig.step(states[-1], acknowledged) == rig.step(states[-1], plain)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e308])
@pytest.mark.parametrize("model", ["reference", "quarter_car"])
def test_a_model_that_diverges_goes_to_the_safe_state(model, bad, capfd):
    rig = core(model)
    heights = (0.4,) if model == "reference" else (0.29, 0.4)
    states, outputs = run(rig, resting(*heights, ticks=20))
    good = outputs[-1].struts
    inputs = [measured(20, *heights, applied_n=bad), *resting(*heights, begin=21, ticks=3)]
    states, outputs = run(rig, inputs, states[-1])
    capfd.readouterr()  # what DART prints of it
    assert outputs[-1].mode is Mode.SAFE
    for strut, last in zip(outputs[-1].struts, good, strict=True):
        assert strut.force_n == 0.0
        assert not strut.valid
        assert strut.height_m == pytest.approx(last.height_m, abs=1e-3)
    # What led there is over when a start's worth of good measurements has come.
    every = [
        StepInput(item.t_ns, item.samples, request=Request.ACKNOWLEDGE)
        for item in resting(*heights, begin=24, ticks=FIRST)
    ]
    _, outputs = run(rig, every, states[-1])
    modes = [output.mode for output in outputs]
    assert modes[:8] == [Mode.SAFE] * 8
    assert modes[8:10] == [Mode.WAITING, Mode.RUNNING]


def test_a_measurement_that_is_no_number_goes_to_the_safe_state(capfd):
    rig = core()
    states, outputs = run(rig, resting(0.4, ticks=20))
    assert outputs[-1].mode is Mode.RUNNING
    _, output, _ = rig.step(states[-1], measured(20, math.nan))
    capfd.readouterr()
    assert output.mode is Mode.SAFE
    assert math.isfinite(output.struts[0].height_m)


INPUTS = st.lists(
    st.tuples(
        st.none() | st.floats(0.2, 0.6),
        st.none() | st.floats(0.2, 0.6),
        st.none() | st.floats(-100.0, 100.0),
        st.booleans(),
    ),
    min_size=2,
    max_size=16,
)


@settings(max_examples=25, deadline=None)
@given(
    drawn=INPUTS,
    cut=st.integers(0, 15),
    stride=st.sampled_from([1, 7, 40]),
    begun=st.sampled_from([0, FIRST - 4, FIRST]),
)
def test_a_run_continues_identically_from_any_of_its_states(drawn, cut, stride, begun):
    """From before the model's start, from behind it, and from a start that is under way."""
    inputs = resting(0.29, 0.4, ticks=begun) + [
        StepInput(
            (begun + tick * stride) * MS,
            measured(begun + tick * stride, tyre, suspension, applied_n=applied_n).samples,
            request=Request.ACKNOWLEDGE if acknowledged else None,
        )
        for tick, (tyre, suspension, applied_n, acknowledged) in enumerate(drawn)
    ]
    cut = begun + min(cut, len(drawn) - 1)
    states, outputs = run(core("quarter_car"), inputs)
    # Another core, whose DART has seen nothing of it.
    _, again = run(core("quarter_car"), inputs[cut + 1 :], states[cut])
    assert again == outputs[cut + 1 :]


def test_every_tick_says_something_whether_or_not_a_frame_came():
    rig = core()
    _, outputs = run(rig, [*resting(0.4), *silent(FIRST, 1000)])
    assert len(outputs) == 1000
    assert all(len(output.struts) == 1 for output in outputs[FIRST - 1 :])


def strut_alone(index: int) -> Supervisor:
    """A core of one strut of the quarter car, with the same gains."""
    spec = load_model(MODELS / "quarter_car.yaml")
    body = spec.skeleton.bodies[index]
    joint = body.joint.model_copy(update={"parent": "world"})
    skeleton = spec.skeleton.model_copy(
        update={"bodies": (body.model_copy(update={"joint": joint}),)}
    )
    strut = spec.struts[index].model_copy(update={"between": ("world", body.name)})
    alone = spec.model_copy(update={"skeleton": skeleton, "struts": (strut,)})
    return supervised(DartPlant(alone), (GAINS,))


@pytest.mark.parametrize("index", [0, 1])
def test_an_observer_is_the_same_alone_and_in_the_quarter_car(index):
    """Given the same innovations it gives the same forces, bit for bit."""
    heights = [(0.29 + 1e-5 * tick, 0.4 - 3e-5 * tick) for tick in range(200 + FIRST)]
    states, _ = run(
        core("quarter_car"), [measured(tick, *pair) for tick, pair in enumerate(heights)]
    )
    alone = strut_alone(index)
    begun, _ = run(
        alone, [measured(tick, pair[index]) for tick, pair in enumerate(heights[:FIRST])]
    )
    state = begun[-1]
    for tick, quarter in enumerate(states[FIRST:], start=FIRST):
        # The height that makes the same innovation at the model that is alone.
        state_free, free, _ = alone.step(state, measured(tick, None))
        target = quarter.estimator.observers.struts[index]
        model_m = free.struts[0].height_m
        state, output, _ = alone.step(state, measured(tick, model_m + target.innovation_m))
        assert state_free.mode is state.mode
        assert output.struts[0].innovation_m == pytest.approx(target.innovation_m, abs=1e-15)
        assert output.struts[0].virtual_force_n == pytest.approx(target.virtual_force_n, abs=1e-8)


def test_one_observer_hears_only_its_own_strut():
    rig = core("quarter_car")
    states, _ = run(rig, resting(0.29, 0.4, ticks=20))
    other, _, _ = rig.step(states[-1], measured(20, None, 0.41))
    before, after = states[-1].estimator.observers.struts, other.estimator.observers.struts
    assert after[0] == before[0]
    assert after[1] != before[1]


def test_each_strut_has_one_observer():
    with pytest.raises(ValueError, match="1 observers for 2 struts"):
        FreeModelEstimator(
            DartPlant(load_model(MODELS / "quarter_car.yaml")),
            (GAINS,),
            channels(2),
            applied_force(channels(2)),
            10 * MS,
            settle_at_once,
        )


def test_output_before_the_model_runs_is_empty():
    assert run(core(), silent(0, 3))[1] == [StepOutput(Mode.WAITING, ())] * 3


# --- Starts that must not be -----------------------------------------------------------------


@pytest.mark.parametrize("spacing_ns", [0, 20_000])
def test_measurements_that_waited_in_a_queue_start_no_model(spacing_ns):
    """Their times are those of their reading: no velocity follows from them."""
    rig = core()
    bunched = [
        replace(measured(0, 0.4 + 1e-3 * number), t_ns=number * spacing_ns)
        for number in range(FIRST)
    ]
    bunched = [
        replace(
            item,
            samples=tuple(replace(sample, t_ns=item.t_ns) for sample in item.samples),
        )
        for item in bunched
    ]
    states, outputs = run(rig, bunched)
    assert {output.mode for output in outputs} == {Mode.WAITING}
    _, outputs = run(rig, resting(0.4, begin=1), states[-1])
    started = [output.mode for output in outputs].index(Mode.RUNNING)
    # As many as a burst may have are among the twelve. The queue alone would give 50 m/s.
    assert started >= FIRST - 4
    assert abs(outputs[started].struts[0].velocity_m_per_s) < 5.0


def untimed(channel: Channel) -> Channel:
    """A channel whose message has no cycle time in the DBC."""
    message = load_database(DEFAULT_DATABASE).message("BENCH_MEASUREMENT")
    return dataclasses.replace(channel, message=dataclasses.replace(message, cycle_time_ns=None))


def test_without_a_cycle_time_the_measurements_themselves_say_how_often_they_come():
    """Heights every 7 ms and an applied force every 50 ms, of which the DBC says nothing."""
    plant = DartPlant(load_model(MODELS / "reference.yaml"))
    bench = [untimed(channel) for channel in channels(1)]
    supervision = SUPERVISION.model_copy(update={"stale_after_s": 0.06})
    rig = supervised(plant, (GAINS,), supervision, bench)

    def applied_n(tick):
        return 0.0 if tick % 50 == 0 and tick <= 400 else None

    inputs = [
        measured(tick, 0.4 if tick % 7 == 0 else None, applied_n=applied_n(tick))
        for tick in range(600)
    ]
    states, outputs = run(rig, inputs)
    started = 7 * (FIRST - 1)
    assert {output.mode for output in outputs[:started]} == {Mode.WAITING}
    assert {output.mode for output in outputs[started:461]} == {Mode.RUNNING}
    # What the DBC gives no cycle of is missing when a height would be.
    assert {output.mode for output in outputs[461:]} == {Mode.HOLD}
    assert states[-1].estimator.longest_gaps_ns == (5 * 7 * MS,)


# --- While a model starts again --------------------------------------------------------------

SEVERE = Reports(Action.SAFE)


def test_a_measured_limit_stops_a_bridge_whose_model_starts_again():
    rig = core()
    states, outputs = run(rig, resting(0.4, ticks=40) + silent(40, 60) + [measured(60, 0.4)])
    assert outputs[-1].mode is Mode.HOLD
    after, output, _ = rig.step(states[-1], measured(61, 0.4), SEVERE)
    assert output.mode is Mode.SAFE
    assert after.first_cause.event is Event.STALE
    assert after.cause.event is Event.BEYOND_SAFE


@pytest.mark.parametrize("safe_output", ["zero", "last"])
def test_a_timeout_while_the_model_starts_again_has_the_safe_output(safe_output):
    rig = core(supervision=SUPERVISION.model_copy(update={"safe_output": safe_output}))
    inputs = resting(0.4, ticks=40) + silent(40, 60) + [measured(60, 0.4)] + silent(61, 700)
    states, outputs = run(rig, inputs)
    assert outputs[-1].mode is Mode.SAFE
    (strut,) = outputs[-1].struts
    assert strut.height_m == pytest.approx(0.4, abs=1e-3)
    last_n = states[-1].last_valid[0].force_n
    assert strut.force_n == (last_n if safe_output == "last" else 0.0)
    assert rig.end(states[-1]).struts == outputs[-1].struts
