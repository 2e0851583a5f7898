"""Errors of the model's motion, as innovations show them: lines, noise and what has both."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from dart_model.protocol import MotionGains
from rig.bridge.estimator import FollowedError
from rig.bridge.motion_errors import InnovationBlock, MotionErrorTracker, block_for
from rig.bridge.virtual_sensors import products_of, stds_by_force
from rig.observers.protocol import Innovation

MS, BLOCK = 1_000_000, 20
NOTHING_FOLLOWED = np.zeros((1, 2, 1, 1))


class Reader:
    """A position and a velocity of twice a strut's height."""

    has_constant_gains = True

    def __init__(self, by_heights=((2.0,), (2.0,)), by_motions=(), directly=()):
        empty = np.zeros((2, 0))
        self.gains = MotionGains(
            np.array(by_heights),
            np.array(by_motions) if by_motions else empty,
            np.array(directly) if directly else empty,
        )

    def motion_gains(self, _loaded, _struts):
        return self.gains


def track(values_m, reader=None, followed=NOTHING_FOLLOWED, channels=(0,), motion_errors=()):
    """Deviations of position and velocity after innovations at 1 kHz, (ticks, channels)."""
    reader = reader or Reader()
    tracker = MotionErrorTracker(
        reader, (0, 1), (0,), channels, (False, True), InnovationBlock(BLOCK * MS), followed
    )
    now = SimpleNamespace()
    estimator = SimpleNamespace(
        innovations=lambda _state: now.innovations,
        motion_errors=lambda _state: motion_errors,
        model_of=lambda _state: None,
    )
    tracked = tracker.init(0, None)
    for tick, row in enumerate(np.reshape(values_m, (len(values_m), -1)).tolist(), start=1):
        now.innovations = [
            None if math.isnan(value) else Innovation(value, tick * MS) for value in row
        ]
        tracked = tracker.update(tracked, tick * MS, estimator, None)
    return np.array(tracked.errors.stds)


def test_an_offset_and_a_slope_are_the_errors_of_height_and_rate():
    t_s = 1e-3 * np.arange(1, 2001)
    np.testing.assert_allclose(track(3e-4 + 0.0 * t_s), [6e-4, 0.0], atol=1e-12)
    # Each block has another mean; their slope is one.
    sawtooth = 0.02 * (t_s - 0.02 * np.ceil(t_s / 0.02 - 1e-9))
    assert track(sawtooth)[1] == pytest.approx(0.04, rel=1e-6)


def test_white_noise_alone_is_no_error_of_the_model():
    """What is left of a line's own deviation is what chance leaves of 64 blocks' mean square."""
    rng = np.random.default_rng(1)
    stds = [track(1e-5 * rng.standard_normal(4000)) for _ in range(40)]
    of_lines = 2e-5 / math.sqrt(BLOCK), 2e-5 * math.sqrt(12.0 / BLOCK**3) / 1e-3
    assert np.all(np.median(stds, axis=0) < 0.5 * np.array(of_lines))


@pytest.mark.parametrize("noise_m", [0.0, 2e-5])
def test_a_swing_slower_than_a_block_has_its_rms(noise_m):
    t_s = 1e-3 * np.arange(1, 6001)
    swing = 1e-4 * np.sin(2.0 * math.pi * 3.3 * t_s)
    noise = noise_m * np.random.default_rng(2).standard_normal(len(t_s))
    rms = 2e-4 / math.sqrt(2.0) * np.array([1.0, 2.0 * math.pi * 3.3])
    np.testing.assert_allclose(track(swing + noise), rms, rtol=0.15)


def test_an_error_that_occurs_once_is_stated_where_it_occurs():
    """And forgotten afterwards: the mean square over 64 blocks alone would hide it."""
    quiet = np.zeros(4000)
    quiet[2990:3000] = 1e-3
    after = track(quiet[:3000])[0]
    assert after > 0.5e-3
    assert track(np.append(quiet, np.zeros(8000)))[0] < 0.2 * after


def test_noise_that_the_model_follows_is_an_error_that_no_innovation_shows():
    rng = np.random.default_rng(3)
    followed = np.array([[[[0.25]], [[900.0]]]])
    found = np.array([track(1e-5 * rng.standard_normal(4000), None, followed) for _ in range(20)])
    without = np.array([track(1e-5 * rng.standard_normal(4000)) for _ in range(20)])
    squares = np.median(found, axis=0) ** 2 - np.median(without, axis=0) ** 2
    np.testing.assert_allclose(squares, np.array([1e-10, 3.6e-7]), rtol=0.15)


def test_a_measured_motion_is_one_more_channel_and_its_own_noise():
    """What is faster than a block moves the moved body alone."""
    still = np.zeros((400, 2))
    hangs, stands = ([[1.0], [1.0]], [[0.0], [0.0]]), ([[1.0], [1.0]], [[1.0], [1.0]])
    # Samples of 10 um, an interval of 1 ms, and what the filter makes of them.
    motion = FollowedError(1e-10, np.array([0.5e-10, 4e-6]), np.zeros(2), 1e-3, 0.0)
    slow = [1e-10 / BLOCK, 12.0 * 1e-10 / BLOCK**3 / 1e-6]
    for (by_motions, directly), expected in ((hangs, slow), (stands, [0.5e-10, 4e-6])):
        reader = Reader(by_motions=by_motions, directly=directly)
        found = track(still, reader, channels=(0, 1), motion_errors=[motion])
        np.testing.assert_allclose(found, np.sqrt(expected), rtol=1e-9)
    nothing = FollowedError(0.0, np.zeros(2), np.zeros(2), 1e-3, 0.0)
    both = np.column_stack([np.full(400, -1e-4), np.full(400, 2e-4)])
    assert track(both, Reader(by_motions=hangs[0], directly=hangs[1]), channels=(0, 1),
                 motion_errors=[nothing])[0] == pytest.approx(0.0, abs=1e-12)  # fmt: skip


def test_what_the_heights_do_not_determine_has_no_deviation():
    assert np.isnan(track(np.zeros(100), Reader(by_heights=((2.0,), (math.nan,))))).tolist() == [
        False,
        True,
    ]
    # Nothing is known before the first block, nor of a channel without samples.
    assert np.isnan(track(np.zeros(BLOCK - 1))).all()
    assert np.isnan(track(np.full(1000, math.nan))).all()


def test_a_block_waits_for_the_slowest_channel():
    rare = np.full(400, math.nan)
    rare[::10] = 3e-4
    assert track(rare)[0] == pytest.approx(6e-4)


def test_nothing_is_known_while_a_channel_is_silent_and_a_gap_is_forgotten():
    before, gap = np.full(400, 1e-4), np.full(400, math.nan)
    assert track(np.append(before, gap[: BLOCK - 1]))[0] == pytest.approx(2e-4)
    assert np.isnan(track(np.append(before, gap[:BLOCK]))).all()
    assert np.isfinite(track(np.concatenate([before, gap, before]))).all()
    # Samples from before the gap are in no line with those behind it.
    jump = np.concatenate([np.full(110, 1e-2), gap, np.full(3000, 1e-4)])
    assert track(jump)[0] < 5e-3


def test_a_block_lasts_as_long_as_the_observers_take():
    assert block_for([50.0, 100.0], [MS]).length_ns == 20 * MS
    assert block_for([1e4], [MS, 5 * MS]).length_ns == 25 * MS
    assert block_for([], [2 * MS]).length_ns == 32 * MS


def test_a_line_shows_a_swing_at_the_corner_as_stated():
    """The least-squares line through a sine, over all phases."""
    corner_per_s = 2.0 * math.pi * 15.0
    block = block_for([corner_per_s], [MS // 100])
    t_s = np.linspace(0.0, 1e-9 * block.length_ns, 2001)
    centred = t_s - t_s.mean()
    swings = [np.sin(corner_per_s * t_s + phase) for phase in np.linspace(0.0, 6.28, 50)]
    means = np.abs([swing.mean() for swing in swings]).max()
    slopes = np.abs([swing @ centred / (centred @ centred) for swing in swings]).max()
    assert (means, slopes / corner_per_s) == pytest.approx(block.shown, rel=2e-3)


def test_a_sensor_needs_only_the_forces_that_it_depends_on():
    gains = np.array([[1.0, 0.0], [1.0, 2.0], [0.5, 1e-14]])
    covariance = np.array([[4.0, math.nan], [math.nan, math.nan]])
    found = stds_by_force(products_of(gains), covariance)
    assert found[0] == 2.0
    assert math.isnan(found[1])
    assert found[2] == 1.0


def test_a_sensor_has_the_same_deviation_bit_for_bit_beside_others():
    rng = np.random.default_rng(6)
    for struts in (1, 2, 8):
        root = rng.standard_normal((struts, struts))
        gains, covariance = rng.standard_normal((12, struts)), root @ root.T
        every = stds_by_force(products_of(gains), covariance)
        for count in range(1, 12):
            assert stds_by_force(products_of(gains[:count]), covariance) == every[:count]
        assert every[0] == pytest.approx(math.sqrt(gains[0] @ covariance @ gains[0]))
