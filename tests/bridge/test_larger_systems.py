"""Observers of struts on a trailing arm and in a quarter car.

Each bench has equations of its own, those of the diagnosis' tests.
"""

import numpy as np
import pytest

from dart_model.plant import DartPlant
from dart_model.spec import MODELS, load_model
from rig.bridge.mode_supervisor import Supervision
from rig.bridge.values import StepInput
from rig.channels.channel import Sample
from rig.channels.measured_quantities import APPLIED_FORCE
from rig.observers.error_filter import ErrorFilter
from rig.observers.kalman import KalmanObserver
from rig.observers.none import NoObserver
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from tests.bridge.cores import bench_sample, channels, supervised
from tests.diagnosis.mechanisms import QuarterCar, TrailingArm

SUPERVISION = Supervision(stale_after_s=0.03, safe_after_s=0.5)
OBSERVER = KalmanObserver(
    "kalman", ErrorFilter(bandwidth_hz=25.0, noise_std_m=1e-5), force_limit_n=20_000.0
)
RATE_HZ = 1000


def follow(plant, heights_m, applied_n, observers=None, rate_hz=RATE_HZ):
    """Published forces, shape (N, struts), NaN before the model started."""
    count = heights_m.shape[1]
    period_ns = round(1e9 / rate_hz)
    bench = channels(count, interval_ns=period_ns)
    core = supervised(plant, observers or (OBSERVER,) * count, SUPERVISION, bench)
    state = core.init(0)
    found = np.full(heights_m.shape, np.nan)
    for tick, (heights, force) in enumerate(zip(heights_m, applied_n, strict=True)):
        t_ns = tick * period_ns
        samples = [Sample(i, float(h), t_ns) for i, h in enumerate(heights) if not np.isnan(h)]
        samples.append(bench_sample(count, APPLIED_FORCE, float(force), t_ns))
        state, output, _ = core.step(state, StepInput(t_ns, tuple(samples)))
        for index, strut in enumerate(output.struts):
            found[tick, index] = strut.force_n
    return found


def noisy(heights_m, seed=1):
    return heights_m + 1e-5 * np.random.default_rng(seed).standard_normal(heights_m.shape)


def error(found, truth):
    """RMS error of each strut's force over the deviation of that force, after half a second."""
    return np.sqrt(np.mean((found - truth)[500:] ** 2, axis=0)) / np.std(truth[500:], axis=0)


def wrong(model, share=0.7, names=None):
    """The same model with springs and dampers too weak."""
    struts = tuple(
        strut.model_copy(
            update={
                "stiffness_n_per_m": share * strut.stiffness_n_per_m,
                "damping_n_s_per_m": share * strut.damping_n_s_per_m,
            }
        )
        if names is None or strut.name in names
        else strut
        for strut in model.struts
    )
    return DartPlant(model.model_copy(update={"struts": struts}))


@pytest.mark.slow
def test_a_strut_on_a_trailing_arm(tmp_path):
    arm = TrailingArm()
    t_s, heights_m = arm.heights(duration_s=4.0, rate_hz=RATE_HZ)
    applied_n = np.array([arm.load_n(t) for t in t_s])
    velocity = np.gradient(heights_m[:, 0], t_s)
    truth = -arm.stiffness * (heights_m[:, 0] - arm.free_m) - arm.damping * velocity
    found = follow(wrong(arm.model(tmp_path)), noisy(heights_m), applied_n)
    assert error(found, truth[:, None])[0] < 0.06


def quarter_car(duration_s=4.0):
    """The shipped quarter car; heights, applied force and strut forces of its bench."""
    model, car = load_model(MODELS / "quarter_car.yaml"), QuarterCar()
    t_s, heights_m = car.heights(duration_s=duration_s, rate_hz=RATE_HZ)
    applied_n = np.array([car.load_n(t) for t in t_s])
    rates = np.gradient(heights_m, t_s, axis=0)
    rest = np.array([car.tyre_free_m, car.free_m])
    stiffness = np.array([car.tyre, car.stiffness])
    damping = np.array([car.tyre_damping, car.damping])
    return model, heights_m, applied_n, -stiffness * (heights_m - rest) - damping * rates


@pytest.mark.slow
def test_errors_of_two_struts_are_corrected_at_once():
    """With the shipped observers: the noise-aware ones, one a strut, are unstable in this car."""
    observers = load_plan(CONFIGS / "quarter_car.yaml").observers
    model, heights_m, applied_n, truth = quarter_car()

    def errors(plant):
        return error(follow(plant, noisy(heights_m), applied_n, observers), truth)

    right, both = errors(DartPlant(model)), errors(wrong(model))
    alone = [errors(wrong(model, names=[name])) for name in ("tyre", "suspension")]
    # As a share of each force's deviation; the better the model, the less is left to observe.
    assert max(right) < 0.05
    assert max(map(max, alone)) < 0.2
    assert max(both) < 0.45


@pytest.mark.slow
def test_a_tyre_that_nobody_measures_is_what_its_law_says():
    model, heights_m, applied_n, forces_n = quarter_car(duration_s=6.0)
    truth = forces_n[:, 1]
    seen = noisy(heights_m)
    seen[:, 0] = np.nan
    plant = wrong(model, names=["suspension"])
    found = follow(plant, seen, applied_n, (NoObserver("none"), OBSERVER))
    # Its height at the start is not known, the model begins at rest on it.
    missed = (found[:, 1] - truth)[1000:]
    assert np.sqrt(np.mean(missed**2)) < 0.1 * np.std(truth)


def test_a_height_that_no_observer_uses_corrects_nothing():
    model, heights_m, applied_n, _ = quarter_car(duration_s=1.0)
    observers = NoObserver("none"), OBSERVER
    plant = wrong(model, names=["tyre"])
    measured = noisy(heights_m)
    unmeasured = measured.copy()
    unmeasured[:, 0] = np.nan
    found = [follow(plant, seen, applied_n, observers) for seen in (measured, unmeasured)]
    assert np.array_equal(*found, equal_nan=True)
