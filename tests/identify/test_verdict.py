"""A verdict does not outlive the held-out data that it fails on."""

import math

import pytest

from rig.identify.diagnosis import BeforeAfter
from rig.identify.verdict import confirmed


@pytest.mark.parametrize(
    ("verdict", "before_um", "after_um", "left"),
    [
        ("explained", 900.0, 11.0, "explained"),
        ("explained", 900.0, 60.0, "partly_explained"),
        ("ambiguous", 900.0, 60.0, "partly_explained"),
        ("explained", 900.0, 1200.0, "not_explained"),
        ("partly_explained", 900.0, 1200.0, "not_explained"),
        ("partly_explained", 900.0, 901.0, "partly_explained"),
        ("explained", 900.0, math.nan, "not_explained"),
        ("explained", 900.0, math.inf, "not_explained"),
        ("partly_explained", 900.0, 60.0, "partly_explained"),
        ("not_explained", 900.0, 60.0, "not_explained"),
        ("nothing_missing", 60.0, 60.0, "nothing_missing"),
    ],
)
def test_held_out_data_decide(verdict, before_um, after_um, left):
    error_m = BeforeAfter(before_um * 1e-6, after_um * 1e-6)
    assert confirmed(verdict, error_m, 1e-5) == left
