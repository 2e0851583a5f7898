"""The derivatives of every law, against differences of the law itself."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from dart_model.effects import CATALOGUE, Motion, effect
from dart_model.effects.calling import ArgumentError, force_over_arrays, rates_over_arrays
from dart_model.effects.slopes import force_slopes, rate_slopes, row_size

MOTION = Motion(
    low_m=0.3,
    high_m=0.45,
    speed_m_per_s=0.2,
    top_speed_m_per_s=0.6,
    least_stroke_m=0.12,
    duration_s=20.0,
    step_s=1e-3,
    free_length_m=0.4,
    stiffness_n_per_m=900.0,
    damping_n_s_per_m=60.0,
    mass_kg=10.0,
    force_n=20.0,
    temperatures_c=(15.0, 60.0),
    tones=((3.0, 0.4),),
)
STRUT = (0.4, 900.0, 60.0, 9.81)
POINTS = 60


def draws(item, seed):
    """Motions, states and parameters at which a law is differentiated."""
    rng = np.random.default_rng(seed)
    starts = item.starts(MOTION) or [tuple(0.3 for _ in item.parameters)]
    for start in itertools.islice(itertools.cycle(starts), POINTS):
        parameters = np.array(start, dtype=float)
        for i in item.scaled:
            if i < len(parameters):
                parameters[i] *= rng.uniform(5.0, 50.0)
        motion = (
            rng.uniform(0.0, 20.0),
            rng.uniform(0.3, 0.45),
            0.2 * rng.standard_normal(),
            30.0 * rng.standard_normal(),
            rng.uniform(15.0, 60.0),
        )
        states = 0.5 * np.array(item.state_scales) * rng.standard_normal(item.state_size)
        yield motion, states, parameters


def derivatives(item, motion, states, parameters):
    """Derivatives of force and rates, shape (1 + states, row_size), nothing left unwritten."""
    width = row_size(item)
    force, rates = np.full(width, np.nan), np.full(width * item.state_size, np.nan)
    force_slopes(item)(*motion, states, parameters, STRUT, force)
    rate_slopes(item)(*motion, states, parameters, STRUT, rates)
    return np.vstack([force, rates.reshape(item.state_size, width)])


def values(item, motion, point):
    """Force and rates where height, velocity, states, parameters and strut are those of a point."""
    states, parameters, strut = np.split(
        point[2:], np.cumsum([item.state_size, len(item.parameters)])
    )
    given = (motion[0], point[0], point[1], *motion[3:], states, parameters, strut)
    rates = np.zeros(item.state_size)
    rates_over_arrays(item)(*given, rates)
    return np.append(force_over_arrays(item)(*given), rates)


def laws():
    # A table's forces are read by a computed index: it has derivatives by the motion alone.
    return [name for name in CATALOGUE if name != "restoring_surface"]


@pytest.mark.parametrize("name", laws())
def test_derivatives_are_those_of_differences(name):
    item, compared = effect(name), 0
    for motion, states, parameters in draws(item, seed=len(name)):
        exact = derivatives(item, motion, states, parameters)
        assert np.all(np.isfinite(exact))
        point = np.concatenate([motion[1:3], states, parameters, STRUT])
        here = values(item, motion, point)
        for place in range(row_size(item)):
            size = 1e-6 * max(abs(point[place]), 1e-3)
            step = size * np.eye(len(point))[place]
            ahead, behind = values(item, motion, point + step), values(item, motion, point - step)
            right, left = (ahead - here) / size, (here - behind) / size
            smooth = np.abs(right - left) <= 1e-2 * np.maximum(np.abs(right), np.abs(left))
            rounding = 1e-13 * np.abs(here) / size
            difference = 0.5 * (right + left)
            close = np.isclose(exact[:, place], difference, rtol=1e-3, atol=1e-9 + rounding.max())
            assert np.all(close | ~smooth), (place, exact[:, place], difference)
            compared += int(smooth.sum())
    assert compared > 0.8 * POINTS * row_size(item) * (1 + item.state_size)


def test_a_table_has_derivatives_by_the_motion():
    item = effect("restoring_surface")
    table = np.concatenate([[0.3, 0.45, -0.6, 0.6], np.arange(len(item.parameters) - 4.0)])
    motion = (0.0, 0.361, 0.13, 0.0, 20.0)
    exact = derivatives(item, motion, np.zeros(0), table)[0]
    point = np.concatenate([motion[1:3], table, STRUT])
    for place in (0, 1):
        step = 1e-6 * np.eye(len(point))[place]
        ends = [values(item, motion, point + sign * step)[0] for sign in (1.0, -1.0)]
        assert exact[place] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-6)
    assert not np.any(exact[6:-4])


def odd(velocity_m_per_s):
    while velocity_m_per_s > 1.0:
        velocity_m_per_s = 0.5 * velocity_m_per_s
    return velocity_m_per_s


def stepped(velocity_m_per_s):
    return velocity_m_per_s // 2.0


@pytest.mark.parametrize(
    ("law", "expected"), [(odd, "a statement of a law"), (stepped, "[+] - [*] / or [*][*]")]
)
def test_what_no_law_may_use_is_refused(law, expected):
    item = replace(effect("none"), name=law.__name__, force=law)
    with pytest.raises(ArgumentError, match=expected):
        force_slopes(item)
