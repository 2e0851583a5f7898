"""A run's steps are read while they are written, and thinned without losing a peak."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.log.file_names import part_name
from rig.log.follower import BUCKET, FLAGS, RunFollower
from rig.log.step_columns import END_OF_STREAM, Step, StepRows

MS = 1_000_000
NAMES = ("force_n", "sparse_m")


def written(rows: StepRows) -> bytes:
    content = bytes(rows.batch().serialize())
    rows.clear()
    return content


def stream(values, begin=0, batch=190, step_ns=MS):
    """Schema, and the batches of an Arrow stream of steps."""
    rows = StepRows(NAMES)
    schema = rows.schema.serialize().to_pybytes()
    batches = []
    for i, value in enumerate(values):
        sparse = value if i % 7 == 0 else float("nan")
        rows.append(Step((begin + i) * step_ns, 0, 1, 2, i % 8, (value, sparse)))
        if rows.count == batch:
            batches.append(written(rows))
    if rows.count:
        batches.append(written(rows))
    return schema, batches


def followed(folder):
    follower = RunFollower(folder)
    follower.update(10**9)
    return follower


@pytest.fixture(scope="module")
def long_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("long")
    values = np.random.default_rng(3).standard_normal(200_000).cumsum()
    schema, batches = stream(values)
    (folder / "steps.arrow").write_bytes(schema + b"".join(batches) + END_OF_STREAM)
    return followed(folder), values


def test_all_steps_are_found_again(long_run):
    follower, values = long_run
    assert follower.steps == len(values)
    assert follower.span_s == pytest.approx((0.0, 199.999))
    for begin, end in ((0, 10), (150, 420), (99_990, 100_300), (199_900, 200_100), (5, 200_000)):
        rows = follower.rows(begin, end)
        column = follower.columns.index("force_n")
        np.testing.assert_array_equal(rows[:, column], values[begin:end])
        np.testing.assert_array_equal(rows[:, 0], np.arange(begin, min(end, 200_000)) * MS)


def test_flags_are_columns_of_their_own(long_run):
    follower, _ = long_run
    rows = follower.rows(64, 96)
    for name, bit in FLAGS.items():
        expected = (np.arange(64, 96) % 8 & bit) > 0
        np.testing.assert_array_equal(rows[:, follower.columns.index(name)], expected)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.floats(0.0, 199.0), st.floats(0.001, 200.0), st.integers(1, 3000))
def test_a_window_keeps_the_extremes_at_any_zoom(long_run, begin_s, length_s, points):
    follower, values = long_run
    window = follower.window(["force_n", "none"], begin_s, begin_s + length_s, points)
    t_ns = np.arange(len(values)) * 1e6
    sight = (t_ns >= begin_s * 1e9 - 0.5) & (t_ns <= (begin_s + length_s) * 1e9 + 0.5)
    assert len(window.t_s) <= 2 * points
    assert np.all(np.diff(window.t_s) >= 0.0)
    assert np.isnan(window.values[1]).all()
    if not sight.any():
        return
    inside = values[sight]
    # A long stretch begins and ends with a whole bucket.
    first, last = np.flatnonzero(sight)[[0, -1]]
    wide = values[max(0, first - BUCKET) : last + BUCKET + 1]
    assert wide.min() <= window.values[0].min() <= inside.min()
    assert inside.max() <= window.values[0].max() <= wide.max()


def test_a_column_with_gaps_is_thinned_by_what_is_there(long_run):
    follower, values = long_run
    window = follower.window(["sparse_m"], 0.0, 200.0, 500)
    assert np.isfinite(window.values).all()
    assert window.values.max() == values[::7].max()
    assert window.values.min() == values[::7].min()


def test_a_slope_is_no_staircase(tmp_path):
    schema, batches = stream(np.linspace(100.0, 0.0, 10_000))
    (tmp_path / "steps.arrow").write_bytes(schema + b"".join(batches))
    window = followed(tmp_path).window(["force_n"], 0.0, 10.0, 100)
    assert np.all(np.diff(window.values[0][:-2]) <= 0.0)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(cuts=st.lists(st.integers(0, 40_000), max_size=12))
def test_what_is_written_in_pieces_is_read_in_pieces(tmp_path_factory, cuts):
    """Wherever a write stands when somebody looks, whole batches are there and no half one."""
    folder = tmp_path_factory.mktemp("pieces")
    schema, batches = stream(np.arange(2000.0), batch=150)
    content = schema + b"".join(batches)
    ends = np.cumsum([len(schema), *map(len, batches)])
    follower, path = RunFollower(folder), folder / "steps.arrow"
    follower.update(10**9)  # before there is a file
    for cut in sorted(min(cut, len(content)) for cut in cuts):
        path.write_bytes(content[:cut])
        follower.update(10**9)
        whole = int(np.searchsorted(ends, cut, side="right")) - 1
        assert follower.steps == min(max(whole, 0) * 150, 2000)
    path.write_bytes(content)
    follower.update(10**9)
    column = follower.columns.index("force_n")
    np.testing.assert_array_equal(follower.rows(0, 2000)[:, column], np.arange(2000.0))


def test_a_rotated_run_is_followed_into_its_next_part(tmp_path):
    schema, batches = stream(np.arange(500.0))
    first = tmp_path / "steps.arrow"
    first.write_bytes(schema + b"".join(batches))
    follower = followed(tmp_path)
    assert follower.steps == 500
    first.write_bytes(schema + b"".join(batches) + END_OF_STREAM)
    schema, batches = stream(np.arange(500.0, 800.0), begin=500)
    (tmp_path / part_name("steps.arrow", 1)).write_bytes(schema + b"".join(batches))
    follower.update(10**9)
    follower.update(10**9)
    assert follower.steps == 800
    column = follower.columns.index("force_n")
    np.testing.assert_array_equal(follower.rows(480, 520)[:, column], np.arange(480.0, 520.0))


def test_a_part_that_a_full_disk_left_without_an_end_is_no_end(tmp_path):
    schema, batches = stream(np.arange(500.0))
    (tmp_path / "steps.arrow").write_bytes(schema + b"".join(batches))
    schema, batches = stream(np.arange(500.0, 800.0), begin=500)
    (tmp_path / part_name("steps.arrow", 1)).write_bytes(schema + b"".join(batches))
    follower = followed(tmp_path)
    follower.update(10**9)
    assert follower.steps == 800


@pytest.mark.parametrize("content", [b"", b"no stream at all" * 100, b"\xff" * 4000])
def test_what_is_no_stream_has_no_steps(tmp_path, content):
    (tmp_path / "steps.arrow").write_bytes(content)
    follower = followed(tmp_path)
    assert follower.steps == 0
    assert follower.span_s == (0.0, 0.0)
    assert follower.window(["force_n"], 0.0, 1.0, 10).t_s.size == 0
