"""Every component answers its whole protocol: a further one is walked here without being named."""

import json
import math
from dataclasses import asdict
from functools import partial

import numpy as np
import pytest
from pydantic import TypeAdapter

from dart_model.plant import DartPlant, PrescribedStrut
from dart_model.spec import MODELS, load_model
from rig.bridge.counts import Conditions, Counts, Report
from rig.bridge.free_model import FreeModelEstimator
from rig.bridge.prescribed_motion import PrescribedMotionEstimator
from rig.bridge.published_quantities import STATUS, STRUT, TIMING
from rig.bridge.values import Mode, StepInput, StepOutput, StrutOutput
from rig.channels.channel import Sample
from rig.channels.measured_quantities import (
    APPLIED_FORCE,
    BENCH_QUANTITIES,
    LOAD_CELL_FORCE,
    STRUT_QUANTITIES,
)
from rig.observers import OBSERVERS
from rig.observers.protocol import Innovation, SensorStep, Start, TuningTask
from rig.observers.strut_sensors import STRUT_SENSORS, Instant, StrutErrors
from rig.plan.build import ENGINES
from tests.bridge.cores import (
    FIRST,
    GAINS,
    MEASURED,
    MS,
    applied_force,
    bench_sample,
    channels,
)

START = Start(0, 0.1, MS, 0, 50.0, 10.0)
EXAMPLES = {
    "pi": {},
    "kalman": {"kind": "kalman", "filter": {"bandwidth_hz": 20.0, "noise_std_m": 2e-5}},
    "none": {"kind": "none"},
}
TUNABLE = [kind for kind, made in OBSERVERS.items() if hasattr(made, "search")]


def observer(kind):
    return TypeAdapter(OBSERVERS[kind]).validate_python(EXAMPLES[kind])


@pytest.mark.parametrize("kind", OBSERVERS)
def test_an_observer_steps_from_its_settings(kind):
    made = observer(kind)
    assert made.kind == kind
    assert TypeAdapter(OBSERVERS[kind]).validate_json(json.dumps(asdict(made))) == made
    for state in (made.init(START), made.steady_state(START)):
        assert state.virtual_force_n == 0.0
        assert state.left_out == ()
        assert made.with_numbers(state, made.numbers(state)).virtual_force_n == 0.0
        after = made.step(state, MS, Innovation(1e-4, MS))
        assert made.step(after, 2 * MS, None).measured_ns >= after.measured_ns
        assert math.isfinite(after.virtual_force_n)
        assert math.isnan(after.force_std_n) is not made.knows_std
    assert (made.measurements_to_start > 0) is made.requires_height
    assert made.can_continue(observer(kind))
    assert not any(made.can_continue(observer(other)) for other in OBSERVERS if other != kind)
    assert made.remark_on_step(SensorStep(1e-9, None)).is_warning is False
    remark = made.remark_on_rate(1000.0)
    assert remark is None or not remark.is_warning


@pytest.mark.parametrize("kind", TUNABLE)
def test_a_tunable_observer_is_searched_within_what_a_configuration_accepts(kind):
    task = TuningTask(10.0, 2e-5, 1e-3, 5000.0)
    search = OBSERVERS[kind].search(task)
    assert 1 <= search.starts <= len(search.candidates)
    assert search.gain_margin > 1.0
    for x in search.candidates:
        made = search.observer(x)
        assert made.kind == kind
        assert made.force_limit_n == 5000.0
        rounded = made.to_four_digits()
        assert rounded.to_four_digits() == rounded
        assert rounded.bandwidth_hz(0.1) == pytest.approx(made.bandwidth_hz(0.1), rel=1e-3)
        assert TypeAdapter(OBSERVERS[kind]).validate_json(json.dumps(asdict(rounded))) == rounded
    middle = search.observer(search.candidates[len(search.candidates) // 2])
    faster = middle.with_bandwidth(1.5)
    assert faster.bandwidth_hz(0.1) == pytest.approx(1.5 * middle.bandwidth_hz(0.1), rel=1e-12)


SETTLING_TICKS = 18
"""Of both estimators: nine time constants of the dyno's filter."""


def estimators():
    spec = load_model(MODELS / "reference.yaml")
    bench = channels(1)
    settling_times = partial(map, lambda _: SETTLING_TICKS * MS)
    inputs = applied_force(bench)
    yield FreeModelEstimator(DartPlant(spec), (GAINS,), bench, inputs, 10 * MS, settling_times)
    yield PrescribedMotionEstimator(PrescribedStrut(spec), 0.002, bench, 10 * MS)


@pytest.mark.parametrize("estimator", list(estimators()), ids=lambda made: type(made).__name__)
def test_an_estimator_waits_starts_stops_and_waits_again(estimator):
    def measured(t_ns, age_ns=0):
        cell = bench_sample(1, LOAD_CELL_FORCE, 5.0, t_ns)
        applied = bench_sample(1, APPLIED_FORCE, 5.0, t_ns)
        return StepInput(t_ns, (Sample(0, 0.4, t_ns - age_ns), cell, applied))

    def fed(estimator, state, begin, age_ns=0):
        """State and estimate after as many measurements as any needs to start."""
        for tick in range(begin, begin + FIRST):
            state, estimate = estimator.step(state, measured(tick * MS, age_ns))
        return state, estimate

    state, estimate = estimator.step(estimator.init(0), StepInput(0))
    assert estimate is None
    assert list(estimator.heights_m(state)) == []
    before, estimate = fed(estimator, state, 1)
    assert estimate is not None
    assert len(estimate.struts) == estimator.struts
    found = (estimate.measured_ns, estimate.diverged, estimate.left_out)
    assert found == (FIRST * MS, -1, ())
    assert list(estimator.heights_m(before)) == pytest.approx([0.4])
    after, _ = estimator.step(before, measured((FIRST + 1) * MS))
    assert list(estimator.heights_m(estimator.discard(before, after))) == pytest.approx([0.4])
    waiting = estimator.restart(after, (FIRST + 1) * MS)
    assert estimator.step(waiting, StepInput((FIRST + 2) * MS))[1] is None
    # Measurements that are too old start nothing.
    assert fed(estimator, waiting, 60, 47 * MS)[1] is None
    same = estimator.with_settings((GAINS,), 100 * MS, None)
    assert fed(same, waiting, 60, 47 * MS)[1] is not None


@pytest.mark.parametrize("estimator", list(estimators()), ids=lambda made: type(made).__name__)
def test_an_estimator_has_settled_after_some_time_and_again_after_a_change(estimator):
    def settled(state, begin):
        """The first tick with a settled estimate, and the state then."""
        for tick in range(begin, begin + 100):
            bench = [bench_sample(1, item, 5.0, tick * MS) for item in MEASURED]
            given = StepInput(tick * MS, (Sample(0, 0.4, tick * MS), *bench))
            state, estimate = estimator.step(state, given)
            if estimate is not None and estimate.is_settled:
                return tick, state
        return None

    first, state = settled(estimator.init(0), 0)
    assert first in (SETTLING_TICKS, FIRST - 1 + SETTLING_TICKS)
    assert settled(state, first + 1)[0] == first + 1
    changed = estimator.unsettle(state, first * MS)
    assert settled(changed, first + 1)[0] == first + SETTLING_TICKS


@pytest.mark.parametrize("engine", ENGINES)
def test_a_plant_answers_by_its_arguments_alone(engine):
    plant = ENGINES[engine](load_model(MODELS / "quarter_car.yaml"))
    state = plant.init((0.29, 0.4), (0.1, -0.1))
    loaded = plant.load(state, (1.0, 2.0), (30.0,), 20.0)
    first = plant.step(loaded, 1e-3, (31.0,))
    plant.step(plant.load(plant.init((0.2, 0.3)), (0.0, 9.0), (0.0,), 60.0), 5e-3, (0.0,))
    assert plant.step(loaded, 1e-3, (31.0,)).struts == first.struts
    again = plant.state_of(plant.numbers(state))
    assert np.allclose(again.struts, state.struts, rtol=0.0, atol=1e-12)
    assert len(loaded.forces_n) == len(loaded.accelerations_m_per_s2) == plant.struts == 2
    assert (loaded.inputs, loaded.temperature_c) == ((30.0,), 20.0)
    assert isinstance(plant.is_constant, bool)


@pytest.mark.parametrize(
    "publication", [*STRUT, *STATUS, *TIMING], ids=lambda item: f"{item.key}-{item.signal}"
)
def test_a_publication_reads_every_report(publication):
    strut = StrutOutput(1.0, 2.0, True, 0.4, 0.1, 0.2, 1e-3, 3.0, 4.0)
    output = StepOutput(Mode.RUNNING, (strut, strut))
    report = Report(output, Counts(), Counts(), Conditions(), 0)
    assert math.isfinite(publication.value(report, 1))
    assert publication.key
    assert publication.signal.isupper()
    if publication.attribute:
        assert publication.value(report, 0) == getattr(strut, publication.attribute)


def test_every_quantity_of_a_strut_has_a_sensor():
    assert set(STRUT_SENSORS) == set(STRUT_QUANTITIES.values())
    instant = Instant(0, ((0.4, 0.1),), (50.0,))
    for key, quantity in STRUT_QUANTITIES.items():
        assert quantity.key == key
        assert quantity.noise is not None
        assert 0.0 < quantity.noise.low < quantity.noise.high
        # The unit of the noise is the quantity's own.
        assert quantity.column == f"{key}_{quantity.noise.key.removeprefix('noise_std_')}"
        sensor = STRUT_SENSORS[quantity]
        assert math.isfinite(sensor.reading(instant, 0))
        rows = StrutErrors(*np.eye(3))
        assert np.array_equal(sensor.error(rows), getattr(rows, key))
    assert all(quantity.noise is None for quantity in BENCH_QUANTITIES)
