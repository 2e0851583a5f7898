"""Why fitted laws are not believed."""

from types import SimpleNamespace

import numpy as np
import pytest

from rig.diagnosis.problem.grid import Track
from rig.diagnosis.problem.problem import LinearParameter
from rig.diagnosis.search import validity
from rig.diagnosis.search.criteria import CRITERIA

T_S = np.arange(20_000) / 500.0
ZERO = np.zeros(len(T_S))


def track(applied_n=ZERO, height_m=ZERO):
    return Track(T_S, height_m[np.newaxis], ZERO[np.newaxis], applied_n, ZERO + 20.0)


@pytest.mark.parametrize(("frequency_hz", "order"), [(2.359, 3), (3.934, 5), (1.1, None)])
def test_a_multiple_of_a_sine_is_the_drives(frequency_hz, order):
    sine = 40.0 * np.sin(2.0 * np.pi * 0.7867 * T_S + 0.4)
    assert validity.harmonic_of_drive(frequency_hz, 0, track(applied_n=sine)) == order
    assert validity.harmonic_of_drive(frequency_hz, 0, track(height_m=1e-3 * sine)) == order


def test_a_drive_of_many_lines_has_no_multiples():
    noise = np.random.default_rng(2).normal(size=len(T_S))
    sweep = np.sin(2.0 * np.pi * (0.5 + 0.1 * T_S) * T_S)
    for drive in (noise, sweep):
        assert validity.harmonic_of_drive(2.0, 0, track(applied_n=drive)) is None


MASS = LinearParameter(0, "mass", 10.0, 0.5, -9.0)
STIFFNESS = LinearParameter(0, "stiffness", 2000.0, 400.0, -2000.0)
DAMPING = LinearParameter(0, "damping", 100.0, 40.0, -100.0)


def reason(changes, law, lawless=(0.0, 0.0, 0.0), linear=(MASS, STIFFNESS, DAMPING)):
    problem = SimpleNamespace(linear=linear, motions=(None,))
    return validity.find_improbable_linear_part(
        problem, [(0, law)], np.array(changes), np.array(lawless), CRITERIA
    )


def test_laws_that_need_an_improbable_mass_are_not_believed():
    assert reason((1.9, 0.0, 0.0), "coulomb_friction") is None
    why = reason((2.1, 0.0, 0.0), "coulomb_friction")
    assert why is not None
    assert "mass_kg 12.1, 4.2 standard deviations from the model file's 10" in why


GAIN = LinearParameter(0, "gain", 1.0, 0.02, -0.95)


@pytest.mark.parametrize(
    ("changes", "is_gain"),
    [
        ((2.2, 440.0, 22.0, 0.0), True),
        ((2.2, 440.0 + 39.0, 22.0 - 3.9, 0.0), True),
        ((2.2, 440.0 + 41.0, 22.0, 0.0), False),
        ((2.2, 440.0, 22.0 + 4.1, 0.0), False),
        ((2.2, 0.0, 0.0, 0.0), False),
    ],
)
def test_a_linear_part_in_one_proportion_is_a_gain_of_the_applied_force(changes, is_gain):
    linear = (MASS, STIFFNESS, DAMPING, GAIN)
    why = reason(changes, "bouc_wen", (0.0,) * 4, linear)
    assert (why is None) == is_gain
    assert reason(changes[:3], "bouc_wen") is not None  # Where no force is applied.


def test_a_correction_that_no_law_makes_larger_says_nothing_against_the_law():
    assert reason((2.1, 0.0, 0.0), "coulomb_friction", lawless=(2.2, 0.0, 0.0)) is None


def test_the_best_linear_model_is_bent_by_what_it_lacks():
    assert reason((2.6, 0.0, 0.0), "coulomb_friction", lawless=(1.9, 0.0, 0.0)) is None
    assert reason((3.1, 0.0, 0.0), "coulomb_friction", lawless=(1.9, 0.0, 0.0)) is not None


def test_a_law_with_memory_does_not_replace_the_spring_but_a_spring_does():
    assert reason((0.0, -1900.0, 0.0), "maxwell") is not None
    assert reason((0.0, -1900.0, 0.0), "gas_spring") is None
    assert reason((0.0, 1900.0, 0.0), "gas_spring") is not None


@pytest.mark.parametrize(
    ("left", "linear_left", "is_linear"),
    [(1.0, 4.0, False), (1.0, 1.4, True), (1.3, 4.0, True)],
    ids=["at floor alone", "as the linear model", "not at floor"],
)
def test_a_law_that_is_linear_to_half_a_percent_is_one_where_only_it_reaches_the_floor(
    left, linear_left, is_linear
):
    """The best linear model explains up to 1.2 floors, 1.44 in the mean square."""
    z = 0.3 + 0.02 * np.sin(T_S)
    along = [track(height_m=z)._replace(velocities_m_per_s=0.02 * np.cos(T_S)[np.newaxis])]
    force_n = 300.0 - 8000.0 * (z - 0.3) + 0.1 * np.sin(3.0 * T_S)
    candidate = SimpleNamespace(kept=(), new=((0, "gas_spring"),))
    fits = tuple(
        SimpleNamespace(candidate=candidate, model=None, mean_square=it)
        for it in (left, linear_left)
    )
    problem = SimpleNamespace(floor_level=lambda _: 1.0)
    why = validity._find_linear_law(problem, fits, [(0, force_n)], along, CRITERIA)
    assert (why is not None) == is_linear
