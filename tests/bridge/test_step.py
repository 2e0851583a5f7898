"""A tick: what it does with what came, and with what did not."""

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_model.plant import DartPlant
from dart_model.spec import MODELS, load_model
from rig.bridge.free_model import FreeModelEstimator
from rig.bridge.mode_supervisor import Supervisor
from rig.bridge.values import Mode, StepInput, StepOutput, StrutOutput
from tests.bridge.cores import (
    GAINS,
    MS,
    SUPERVISION,
    channels,
    core,
    gains,
    measured,
    run,
    supervised,
)

REST_M = 0.5 - 10.0 * 9.81 / 500.0


def test_nothing_is_said_before_every_strut_was_measured():
    rig = core("quarter_car")
    states, outputs = run(
        rig, [measured(0, None, None), measured(1, 0.29, None), measured(2, None, 0.4)]
    )
    assert [output.mode for output in outputs] == [Mode.WAITING, Mode.WAITING, Mode.RUNNING]
    assert [len(output.struts) for output in outputs] == [0, 0, 2]
    assert [strut.height_m for strut in outputs[2].struts] == pytest.approx([0.29, 0.4])
    assert states[2].estimator.model is not None


def test_the_model_keeps_the_time_of_the_run():
    rig = core()
    states, _ = run(rig, [measured(tick, REST_M) for tick in (2500, 2501)])
    assert states[0].estimator.model.state.t_s == pytest.approx(2.5, abs=1e-12)
    assert states[1].estimator.model.state.t_s == pytest.approx(2.501, abs=1e-12)


def test_a_first_measurement_that_has_grown_old_does_not_start_the_model():
    rig = core("quarter_car")
    _, outputs = run(rig, [measured(0, 0.29, None), measured(50, None, 0.4)])
    assert outputs[-1].mode is Mode.WAITING
    _, outputs = run(rig, [measured(0, 0.29, None), measured(50, 0.28, 0.4)])
    assert outputs[-1].mode is Mode.RUNNING


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
    return supervised(plant, rig.estimator._observers)


def test_the_seed_gains_leave_what_proportional_control_leaves():
    rig = core(observer=gains(1e5, 0.0, 5000.0))
    height_m = REST_M + 0.03
    _, outputs = run(rig, [measured(tick, height_m) for tick in range(4000)])
    (strut,) = outputs[-1].struts
    # K (z_model - rest) = K_P (z - z_model), with the innovation as the unknown.
    assert strut.innovation_m == pytest.approx(500.0 * 0.03 / (500.0 + 1e5), rel=1e-4)


@given(gap=st.integers(1, 9))
@settings(max_examples=10, deadline=None)
def test_between_measurements_the_virtual_force_is_held(gap):
    rig = core()
    inputs = [measured(tick, 0.4 if tick % (gap + 1) == 0 else None) for tick in range(100)]
    _, outputs = run(rig, inputs)
    for tick, (before, after) in enumerate(pairwise(outputs), start=1):
        if not inputs[tick].samples:
            assert after.struts[0].virtual_force_n == before.struts[0].virtual_force_n
            assert after.struts[0].innovation_m == before.struts[0].innovation_m
        assert after.struts[0].height_m != before.struts[0].height_m
        assert after.mode is Mode.RUNNING


def test_the_published_force_is_that_of_spring_damper_and_observer():
    rig = core()
    _, outputs = run(rig, [measured(tick, 0.4 + 1e-4 * tick) for tick in range(50)])
    for output in outputs:
        (strut,) = output.struts
        model_n = -500.0 * (strut.height_m - 0.5) - 100.0 * strut.velocity_m_per_s
        assert strut.force_n == pytest.approx(model_n + strut.virtual_force_n, abs=1e-9)
        body_n = strut.force_n - 10.0 * 9.81
        assert strut.acceleration_m_per_s2 == pytest.approx(body_n / 10.0, abs=1e-9)


def test_a_late_measurement_is_compared_with_the_model_of_its_own_time():
    rig = core()
    states, _ = run(rig, [measured(tick, 0.4) for tick in range(20)])
    late_ns = 600_000
    _, fresh, _ = rig.step(states[-1], measured(20, 0.41))
    _, late, _ = rig.step(states[-1], measured(20, 0.41, late_ns=late_ns))
    # The model's velocity before the correction is the same in both.
    free = rig.step(states[-1], measured(20, None))[1].struts[0].velocity_m_per_s
    difference = late.struts[0].innovation_m - fresh.struts[0].innovation_m
    assert difference == pytest.approx(free * late_ns * 1e-9, rel=1e-6)


def gone(start: int, stop: int) -> list[StepInput]:
    """Ticks for which no frame came."""
    return [measured(tick, None) for tick in range(start, stop)]


def test_a_stale_measurement_freezes_the_integral_and_then_leads_to_the_safe_state():
    rig = core()
    ticks = [measured(tick, 0.4) for tick in range(10)]
    states, outputs = run(rig, ticks + gone(10, 600))
    modes = [output.mode for output in outputs]
    # The last measurement is that of tick 9: fresh to 19, stale to 509, then safe.
    assert modes[:20] == [Mode.RUNNING] * 20
    assert modes[20:510] == [Mode.HOLD] * 490
    assert set(modes[510:]) == {Mode.SAFE}
    assert {states[k].estimator.observers[0].integral_m_s for k in range(9, 600)} == {
        states[9].estimator.observers[0].integral_m_s
    }
    assert [output.struts[0].valid for output in outputs[:21]] == [True] * 20 + [False]


def test_a_fresh_measurement_ends_the_hold():
    rig = core()
    _, outputs = run(rig, [measured(0, 0.4), *gone(1, 30), measured(30, 0.4)])
    assert outputs[-2].mode is Mode.HOLD
    assert outputs[-1].mode is Mode.RUNNING
    assert outputs[-1].struts[0].valid


@pytest.mark.parametrize("safe_output", ["zero", "last"])
def test_the_safe_output_is_held_until_it_is_acknowledged(safe_output):
    rig = core(supervision=SUPERVISION.model_copy(update={"safe_output": safe_output}))
    running = [measured(tick, 0.4) for tick in range(10)]
    _, outputs = run(rig, running)
    last_valid = outputs[-1].struts[0].force_n
    states, outputs = run(rig, running + gone(10, 520))
    safe = outputs[-1].struts[0]
    # Held through fresh measurements, because nobody has acknowledged.
    states, outputs = run(rig, [measured(tick, 0.45) for tick in range(520, 560)], states[-1])
    assert {output.mode for output in outputs} == {Mode.SAFE}
    assert {output.struts[0] for output in outputs} == {safe}
    before_stale = run(rig, running + gone(10, 20))[1][-1].struts[0].force_n
    assert safe == StrutOutput(
        before_stale if safe_output == "last" else 0.0, 0.0, False, safe.height_m, 0.0, 0.0, 0.0
    )
    assert math.isfinite(last_valid)
    acknowledged = StepInput(560 * MS, acknowledged=True)
    states, outputs = run(rig, [acknowledged, measured(561, 0.45)], states[-1])
    assert [output.mode for output in outputs] == [Mode.WAITING, Mode.RUNNING]
    assert outputs[1].struts[0].height_m == pytest.approx(0.45)


def test_an_acknowledgement_means_nothing_elsewhere():
    rig = core()
    states, _ = run(rig, [measured(tick, 0.4) for tick in range(10)])
    plain = measured(10, 0.4)
    acknowledged = StepInput(plain.t_ns, plain.samples, acknowledged=True)
    assert rig.step(states[-1], acknowledged) == rig.step(states[-1], plain)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e308])
@pytest.mark.parametrize("model", ["reference", "quarter_car"])
def test_a_model_that_diverges_goes_to_the_safe_state(model, bad, capfd):
    rig = core(model)
    heights = (0.4,) if model == "reference" else (0.29, 0.4)
    states, outputs = run(rig, [measured(tick, *heights) for tick in range(5)])
    good = outputs[-1].struts
    inputs = [measured(5, *heights, applied_n=bad)]
    inputs += [measured(tick, *heights) for tick in range(6, 9)]
    states, outputs = run(rig, inputs, states[-1])
    capfd.readouterr()  # what DART prints of it
    assert outputs[-1].mode is Mode.SAFE
    for strut, last in zip(outputs[-1].struts, good, strict=True):
        assert strut.force_n == 0.0
        assert not strut.valid
        assert strut.height_m == pytest.approx(last.height_m, abs=1e-3)
    samples = measured(9, *heights, applied_n=0.0).samples
    acknowledged = StepInput(9 * MS, samples, acknowledged=True)
    _, outputs = run(rig, [acknowledged], states[-1])
    assert outputs[-1].mode is Mode.RUNNING


def test_a_measurement_that_is_no_number_goes_to_the_safe_state(capfd):
    rig = core()
    states, _ = run(rig, [measured(tick, 0.4) for tick in range(5)])
    _, output, _ = rig.step(states[-1], measured(5, math.nan))
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
@given(drawn=INPUTS, cut=st.integers(0, 15), stride=st.sampled_from([1, 7, 40]))
def test_a_run_continues_identically_from_any_of_its_states(drawn, cut, stride):
    inputs = [
        StepInput(
            tick * stride * MS,
            measured(tick * stride, tyre, suspension, applied_n=applied_n).samples,
            acknowledged=acknowledged,
        )
        for tick, (tyre, suspension, applied_n, acknowledged) in enumerate(drawn)
    ]
    cut = min(cut, len(inputs) - 1)
    states, outputs = run(core("quarter_car"), inputs)
    # Another core, whose DART has seen nothing of it.
    _, again = run(core("quarter_car"), inputs[cut + 1 :], states[cut])
    assert again == outputs[cut + 1 :]


def test_every_tick_says_something_whether_or_not_a_frame_came():
    rig = core()
    _, outputs = run(rig, [measured(0, 0.4), *gone(1, 1000)])
    assert len(outputs) == 1000
    assert all(len(output.struts) == 1 for output in outputs)


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
    heights = [(0.29 + 1e-5 * tick, 0.4 - 3e-5 * tick) for tick in range(200)]
    states, _ = run(
        core("quarter_car"), [measured(tick, *pair) for tick, pair in enumerate(heights)]
    )
    alone = strut_alone(index)
    state = alone.init(0)
    for tick, quarter in enumerate(states):
        # The height that makes the same innovation at the model that is alone.
        state_free, free, _ = alone.step(state, measured(tick, None if tick else heights[0][index]))
        target = quarter.estimator.observers[index]
        model_m = free.struts[0].height_m
        state, output, _ = alone.step(state, measured(tick, model_m + target.innovation_m))
        assert state_free.mode is state.mode
        assert output.struts[0].innovation_m == pytest.approx(target.innovation_m, abs=1e-15)
        assert output.struts[0].virtual_force_n == pytest.approx(target.virtual_force_n, abs=1e-8)


def test_one_observer_hears_only_its_own_strut():
    rig = core("quarter_car")
    both = [measured(tick, 0.29, 0.4) for tick in range(5)]
    states, _ = run(rig, both)
    other, _, _ = rig.step(states[-1], measured(5, None, 0.41))
    before, after = states[-1].estimator.observers, other.estimator.observers
    assert after[0] == before[0]
    assert after[1] != before[1]


def test_each_strut_has_one_observer():
    with pytest.raises(ValueError, match="1 observers for 2 struts"):
        FreeModelEstimator(
            DartPlant(load_model(MODELS / "quarter_car.yaml")), (GAINS,), channels(2), 10 * MS
        )


def test_output_before_the_model_runs_is_empty():
    assert run(core(), gone(0, 3))[1] == [StepOutput(Mode.WAITING, ())] * 3
