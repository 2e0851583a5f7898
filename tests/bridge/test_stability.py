"""Computed poles against what the simulated loop really does."""

import math

import numpy as np
import pytest
import yaml

from dart_model.plant import DartPlant
from dart_model.spec import MODELS, dump_model, load_model, parse_model
from rig.bridge.mode_supervisor import Supervision
from rig.closed_loop.loop import SampleTiming
from rig.closed_loop.poles import Pole, closed_loop_poles, is_stable
from rig.observers.pi import PiObserver
from tests.bridge.cores import (
    FIRST,
    GAINS,
    MS,
    channels,
    gains,
    measured,
    resting,
    run,
    supervised,
)

REST_M = 0.5 - 10.0 * 9.81 / 500.0
ALWAYS_FRESH = Supervision(stale_after_s=1e6, safe_after_s=1e7)


def reference() -> DartPlant:
    return DartPlant(load_model(MODELS / "reference.yaml"))


def poles(observer: PiObserver, every: int = 1, delay: int = 0) -> list[Pole]:
    return closed_loop_poles(reference(), (observer,), (REST_M,), SampleTiming(MS, every, delay))


def ringing(observer: PiObserver, every: int) -> tuple[float, float]:
    """Decay per measurement and frequency (Hz) of the simulated loop's innovation."""
    rig = supervised(reference(), (observer,), ALWAYS_FRESH)
    inputs = [
        measured(FIRST + tick, REST_M if tick % every == 0 else None) for tick in range(600 * every)
    ]
    _, outputs = run(rig, resting(REST_M + 1e-3) + inputs)
    innovation = np.array([output.struts[0].innovation_m for output in outputs[FIRST::every]])
    # An oscillation obeys x[k+2] = 2 r cos(phi) x[k+1] - r² x[k]; the slow pole is fitted with it.
    window = innovation[5:300]
    rows = np.column_stack([window[2:-1], window[1:-2], window[:-3]])
    coefficients = np.linalg.lstsq(rows, window[3:], rcond=None)[0]
    roots = np.roots([1.0, *-coefficients])
    root = max(roots, key=lambda z: abs(z.imag))
    return abs(root), abs(np.angle(root)) / (2.0 * math.pi * every * 1e-3)


@pytest.mark.parametrize(
    ("gains", "every"),
    [
        (GAINS, 1),
        (gains(2e4, 1e4, 5000.0), 1),
        (gains(1e4, 1e4, 5000.0), 5),
        (gains(5e3, 5e4, 5000.0), 3),
    ],
)
def test_the_loop_rings_as_its_poles_say(gains, every):
    complex_pole = next(pole for pole in poles(gains, every) if pole.damping_ratio < 0.99)
    decay, frequency_hz = ringing(gains, every)
    assert complex_pole.magnitude == pytest.approx(decay, abs=2e-5)
    damped = complex_pole.frequency_hz * math.sqrt(1.0 - complex_pole.damping_ratio**2)
    assert damped == pytest.approx(frequency_hz, rel=1e-3)


def test_without_an_observer_the_poles_are_those_of_the_mass_on_its_spring():
    found = poles(gains(0.0, 0.0, 1.0))
    natural, ratio = math.sqrt(500.0 / 10.0), 100.0 / (2.0 * math.sqrt(500.0 * 10.0))
    oscillating = [pole for pole in found if 0.0 < pole.damping_ratio < 0.999]
    assert len(oscillating) == 2
    for pole in oscillating:
        assert pole.frequency_hz == pytest.approx(natural / (2.0 * math.pi), rel=1e-5)
        assert pole.damping_ratio == pytest.approx(ratio, rel=1e-5)
        assert pole.magnitude == pytest.approx(math.exp(-ratio * natural * 1e-3), rel=1e-8)


def test_the_gains_of_the_seed_are_stable_and_hardly_damped():
    slowest = max(poles(GAINS), key=lambda pole: pole.magnitude)
    assert slowest.magnitude < 1.0
    least = min(pole.damping_ratio for pole in poles(GAINS))
    assert 0.0 < least < 0.06


@pytest.mark.parametrize(
    ("gains", "every", "delay"),
    [(GAINS, 1, 1), (GAINS, 10, 0), (gains(1e5, 1e6, 5000.0), 1, 0)],
)
def test_a_loop_that_runs_away_has_a_pole_outside(gains, every, delay):
    assert max(pole.magnitude for pole in poles(gains, every, delay)) > 1.0


def test_a_slow_measurement_that_runs_away_does_so_at_the_speed_of_its_pole():
    fastest = max(pole.magnitude for pole in poles(GAINS, 10))
    bench = channels(1, interval_ns=10 * MS)
    rig = supervised(reference(), (gains(1e5, 1e4, 1e12),), ALWAYS_FRESH, bench)
    began = 10 * (FIRST - 1)
    heights_m = [REST_M + 1e-6 * (tick <= began) for tick in range(began + 611)]
    inputs = [
        measured(tick, height_m if tick % 10 == 0 else None)
        for tick, height_m in enumerate(heights_m)
    ]
    _, outputs = run(rig, inputs)
    peaks = np.abs([output.struts[0].innovation_m for output in outputs[began + 10 :: 10]])
    growth = (peaks[40:59].max() / peaks[20:39].max()) ** (1.0 / 20.0)
    assert growth == pytest.approx(fastest, rel=0.02)


def test_each_strut_of_the_quarter_car_brings_its_poles():
    plant = DartPlant(load_model(MODELS / "quarter_car.yaml"))
    found = closed_loop_poles(plant, (GAINS, GAINS), (0.29, 0.35), SampleTiming(MS))
    # Position, velocity and integral of each; what is held is determined by them.
    assert len(found) == 6
    assert max(pole.magnitude for pole in found) < 1.0


def test_the_memory_of_effects_has_poles_too():
    text = (MODELS / "reference.yaml").read_text("utf-8")
    law = "{name: maxwell, parameters: {stiffness_n_per_m: 1000.0, relaxation_time_s: 0.02}}"
    spec = parse_model(text.replace("effects: []", f"effects: [{law}]"), "maxwell.yaml")
    found = closed_loop_poles(DartPlant(spec), (gains(0.0, 0.0, 1.0),), (0.3,), SampleTiming(MS))
    # The branch relaxes in 20 ms, a little faster for the mass that it drives: a real, fast pole.
    fast = min(pole.magnitude for pole in found)
    assert 0.9 < fast < 0.97


def with_effects(*effects: dict[str, object]) -> DartPlant:
    spec = load_model(MODELS / "reference.yaml")
    content = yaml.safe_load(dump_model(spec))
    content["struts"][0]["effects"] = list(effects)
    return DartPlant(parse_model(yaml.safe_dump(content), "with effects"))


COULOMB = {
    "name": "coulomb_friction",
    "parameters": {"coulomb_force_n": 40.0, "rounding_velocity_m_per_s": 0.003},
}
ROOT = {
    "name": "power_damping",
    "parameters": {"force_at_1_m_per_s_n": 100.0, "exponent": 0.5},
}


@pytest.mark.parametrize("proportional", [1e4, 2e4, 3e4, 5e4])
def test_elements_that_stick_keep_what_they_remember(proportional):
    """Where the motion is slow, Iwan's elements neither grow nor forget: their poles are at 1."""
    law = {
        "name": "iwan",
        "parameters": {"yield_force_n": 30.0, "yield_displacement_m": 0.004},
    }
    observer = (gains(proportional, 1e4, 5000.0),)
    found = closed_loop_poles(with_effects(law), observer, (REST_M,), SampleTiming(MS))
    assert sum(pole.magnitude == 1.0 for pole in found) >= 6
    assert is_stable(found)


@pytest.mark.parametrize(("every", "delay"), [(1, 0), (2, 0), (1, 3)])
def test_friction_which_is_steep_at_rest_leaves_the_poles_of_motion(every: int, delay: int) -> None:
    timing = SampleTiming(MS, every, delay)
    observer = (gains(2e4, 1e4, 5000.0),)
    plain = closed_loop_poles(with_effects(), observer, (REST_M,), timing)
    rubbing = closed_loop_poles(with_effects(COULOMB), observer, (REST_M,), timing)
    expected, found = ([pole.magnitude for pole in poles] for poles in (plain, rubbing))
    assert found == pytest.approx(expected, abs=2e-4)


def test_a_root_of_the_speed_damps_as_its_slope_in_motion() -> None:
    """At 0.1 m/s the slope of 100 N sqrt(v) is 158 N s/m."""
    timing, observer = SampleTiming(MS), (gains(2e4, 1e4, 5000.0),)
    linear = {"name": "linear_damping", "parameters": {"damping_n_s_per_m": 50.0 / 0.1**0.5}}
    root, slope = (
        closed_loop_poles(with_effects(effect), observer, (REST_M,), timing)
        for effect in (ROOT, linear)
    )
    expected = [pole.magnitude for pole in slope]
    assert [pole.magnitude for pole in root] == pytest.approx(expected, abs=1e-3)
