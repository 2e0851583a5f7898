"""The picture of a run's timing: what stands in its bins, and that it is written."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.pages.timing_picture import Distribution, _merge_bins, draw_timing

BINS = 20_000
PNG = b"\x89PNG\r\n\x1a\n"


@given(us=st.lists(st.integers(0, BINS - 1), max_size=100))
def test_merge_bins_bins_hold_every_tick_at_its_place(us):
    fine = np.bincount(np.array(us, dtype=np.intp), minlength=BINS)
    edges, ticks = _merge_bins(fine)
    assert ticks.sum() == len(us)
    assert edges[-1] == BINS
    for value in us:
        # A bin of the fine histogram reaches from its value to the next; the first from 0.
        place = np.searchsorted(edges, max(value, 0.5), side="right") - 1
        assert ticks[place] > 0


@pytest.mark.parametrize("levels", [{}, {"p50": 1.0, "p99": 2.0, "p99_9": 300.0, "max": 70_000.0}])
def test_it_is_written_whatever_there_is_to_draw(tmp_path, levels):
    ticks = np.zeros(BINS, dtype=np.int64)
    ticks[[0, 1, 299, BINS - 1]] = (1000, 30, 2, 1) if levels else 0
    path = tmp_path / "timing.png"
    draw_timing(path, "a run", (Distribution("Lateness", ticks, levels),) * 2, 1000.0)
    assert path.read_bytes().startswith(PNG)
