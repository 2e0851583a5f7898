"""One free length from two estimates: closed forms of the best linear combination."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.diagnosis.free_length import combine

STD = st.floats(1e-5, 1e-1)


@given(st.floats(0.1, 1.0), st.floats(-1e-3, 1e-3), STD, STD)
def test_independent_estimates_count_by_their_variances(length_m, apart_m, first_m, second_m):
    values = np.array([length_m, length_m + apart_m])
    value, variance = combine(values, np.diag([first_m**2, second_m**2]))
    weights = np.array([first_m**-2, second_m**-2])
    assert value == pytest.approx(float(weights @ values / weights.sum()), rel=1e-6)
    assert variance == pytest.approx(1.0 / weights.sum(), rel=1e-6)


def test_a_common_error_remains():
    """What two estimates have in common, their mean does not reduce."""
    common_m2, own_m2 = 4e-6, 1e-6
    covariance = np.full((2, 2), common_m2) + np.diag([own_m2, own_m2])
    value, variance = combine(np.array([0.486, 0.488]), covariance)
    assert value == pytest.approx(0.487)
    assert variance == pytest.approx(common_m2 + own_m2 / 2)
