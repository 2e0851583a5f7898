"""A bench that a sine drives steadily: height and velocity run along one curve, over and over.

Mass, stiffness and what a law imitates of them lie in a long valley there; the laws are found with
the linear part that the model file has, which is the bench's.
"""

import math

import numpy as np
import pytest

from rig.diagnosis.diagnose import diagnose
from rig.recordings.recording import Recording
from tests.diagnosis.driven import driven_by
from tests.diagnosis.integrator import measured
from tests.diagnosis.little_bench import FREE, Nothing, heights, model

AMPLITUDE_N, FREQUENCY_HZ = 25.0, 1.7
SETTLED_S, END_S = 10.0, 20.0


class Cubic(Nothing):
    stiffness_n_per_m3 = 4e5

    def force(self, t, z, v, state):
        return -self.stiffness_n_per_m3 * (z - FREE) ** 3


class Friction(Nothing):
    fine = 32
    coulomb_force_n, rounding_velocity_m_per_s = 4.0, 2e-3

    def force(self, t, z, v, state):
        return -self.coulomb_force_n * math.tanh(v / self.rounding_velocity_m_per_s)


class Digressive(Nothing):
    """A formula that the catalogue does not hold."""

    def force(self, t, z, v, state):
        return -60.0 * 0.08 * math.tanh(v / 0.08)


class Hysteresis(Nothing):
    """Dahl's, of exponent 1."""

    fine, size = 16, 1
    yield_force_n, yield_displacement_m = 6.0, 4e-3

    def force(self, t, z, v, state):
        return -self.yield_force_n * state[0]

    def rate(self, t, z, v, a, state):
        return [(v - abs(v) * state[0]) / self.yield_displacement_m]


def steady_run(effect, seed):
    """The second half of a run, when all that begins has faded."""

    def load_n(t):
        return AMPLITUDE_N * math.sin(2.0 * math.pi * FREQUENCY_HZ * (t + 0.065 * seed))

    t_s, true_m = heights(effect, duration_s=END_S, load=load_n)
    steady = t_s >= SETTLED_S
    noisy_m = measured(true_m, 1e-5, 2e-6, seed)[steady]
    applied_n = np.array([load_n(t) for t in t_s[steady].tolist()])
    times_s = t_s[steady] - SETTLED_S
    return Recording(f"run{seed}", times_s, noisy_m[:, np.newaxis], driven_by(applied_n))


def diagnosed(effect):
    return diagnose(model(), [steady_run(effect, 1)], [steady_run(effect, 2)]).diagnosis


@pytest.mark.parametrize(
    ("effect", "family"),
    [
        pytest.param(Cubic(), "nonlinear_stiffness", marks=pytest.mark.slow),
        (Friction(), "friction"),
        pytest.param(Hysteresis(), "hysteresis", marks=pytest.mark.slow),
    ],
)
def test_a_law_of_the_catalogue_is_found_with_its_parameters(effect, family):
    diagnosis = diagnosed(effect)
    (law,) = diagnosis.effects
    assert diagnosis.verdict == "explained"
    assert law.family == family
    assert not diagnosis.linear
    for name, estimate in law.parameters.items():
        if hasattr(effect, name):
            assert estimate.low <= getattr(effect, name) <= estimate.high


@pytest.mark.slow
def test_a_damper_of_another_formula_is_named_with_the_mass_that_the_file_states():
    diagnosis = diagnosed(Digressive())
    (law,) = diagnosis.effects
    assert diagnosis.verdict == "explained"
    assert law.family == "nonlinear_damping"
    assert {item.parameter for item in diagnosis.linear} <= {"damping_n_s_per_m"}
