"""The integrator and its steps, without DART."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_model.plant.integrator import Course, Linearised, advance, exact_step_s, stable_step_s


def moved(q, v, h):
    return q + h * v


def oscillator(omega, ratio, begin=0.0, end=0.0):
    """``q'' + 2 ratio omega q' + omega² q = u``, with a state that follows the velocity.

    The input u is linear over all steps.
    """

    def slope(q, v, internal, _t_s, share):
        u = begin + share * (end - begin)
        acceleration = u - 2.0 * ratio * omega * v - omega * omega * q
        return acceleration, [v - 3.0 * internal[0]] if internal else []

    return slope


def after(steps, internal=(), omega=7.0, ratio=0.1, duration_s=1.0, inputs=(0.0, 2.0)):
    slope = oscillator(omega, ratio, *inputs)
    first = slope(0.3, -1.0, internal, 0.0, 0.0)
    start = (0.3, -1.0, internal)
    return advance(slope, moved, start, first, Course(0.0, duration_s, steps))


@pytest.mark.parametrize("internal", [(), (0.2,)])
def test_it_is_of_third_order(internal):
    """Also for a linear input and for internal states."""
    exact = np.hstack(after(6400, internal))
    errors = [np.linalg.norm(np.hstack(after(steps, internal)) - exact) for steps in (50, 100, 200)]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert orders == pytest.approx([3.0, 3.0], abs=0.2)


@given(split=st.integers(1, 39))
def test_steps_on_end_are_the_same_as_steps_of_two_calls(split):
    slope = oscillator(7.0, 0.1, 1.0, 1.0)
    whole = after(40, inputs=(1.0, 1.0))
    q, v, internal = 0.3, -1.0, ()
    for steps, begin in ((split, 0), (40 - split, split)):
        first = slope(q, v, internal, begin / 40, 0.0)
        q, v, internal = advance(
            slope,
            moved,
            (q, v, internal),
            first,
            Course(begin / 40, steps / 40, steps),
        )
    assert (q, v) == pytest.approx(whole[:2], abs=1e-12)


def test_floats_and_arrays_are_computed_alike():
    scalar = after(50)
    slope = oscillator(7.0, 0.1, 0.0, 2.0)
    start = (np.array([0.3, 0.3]), np.array([-1.0, -1.0]), ())
    first = slope(*start, 0.0, 0.0)
    q, v, _ = advance(slope, moved, start, first, Course(0.0, 1.0, 50))
    assert q.tolist() == [scalar[0]] * 2
    assert v.tolist() == [scalar[1]] * 2


def one(mass, stiffness, damping):
    return Linearised(*(np.array([[value]]) for value in (mass, damping, stiffness)))


@given(
    mass=st.floats(0.1, 100.0),
    omega=st.floats(0.1, 1e4),
    ratio=st.floats(0.0, 20.0),
)
def test_the_step_follows_natural_frequency_and_fastest_pole(mass, omega, ratio):
    linear = one(mass, mass * omega**2, 2.0 * ratio * omega * mass)
    fastest = omega * (ratio + math.sqrt(ratio**2 - 1.0)) if ratio > 1.0 else omega
    assert np.max(np.abs(linear.poles())) == pytest.approx(fastest, rel=1e-6)
    assert exact_step_s(linear) == pytest.approx(min(0.1 / omega, 0.5 / fastest), rel=1e-6)
    assert stable_step_s(linear) == pytest.approx(1.6 / fastest, rel=1e-6)


@settings(max_examples=40, deadline=None)
@given(omega=st.floats(1.0, 1e4), ratio=st.floats(0.02, 5.0))
def test_at_that_step_the_free_response_is_off_by_less_than_a_thousandth(omega, ratio):
    """What `_FREQUENCY_STEP` and `_POLE_STEP` say, over sixty radians of the mode."""
    linear = one(1.0, omega**2, 2.0 * ratio * omega)
    duration_s = 60.0 / omega
    steps = math.ceil(duration_s / exact_step_s(linear))
    slope, h = oscillator(omega, ratio), duration_s / steps
    matrix = np.array([[0.0, 1.0], [-(omega**2), -2.0 * ratio * omega]])
    values, vectors = np.linalg.eig(matrix)
    if abs(values[0] - values[1]) < 1e-3 * omega:
        return  # the closed form below wants two modes
    weights = np.linalg.solve(vectors, [1.0, 0.0])
    q, v = 1.0, 0.0
    for step in range(1, steps + 1):
        first = slope(q, v, (), 0.0, 0.0)
        q, v, _ = advance(slope, moved, (q, v, ()), first, Course(0.0, h, 1))
        exact = (vectors[0] * weights * np.exp(values * step * h)).sum().real
        assert abs(q - exact) < 1e-3
