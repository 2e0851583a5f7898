"""The band of what is new in an innovation: what is usual is learnt, and what is not is seen."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.bridge.innovation_band import InnovationBand, restart_band, update_band

MS = 1_000_000
SENSOR = (2e-6, MS)
NOTHING = InnovationBand()


def follow(innovations_m, band=NOTHING, begin=0, *, is_settled=True):
    """Bands after each of some innovations, a millisecond apart."""
    bands = []
    for number, innovation_m in enumerate(innovations_m, start=begin + 1):
        band = update_band(band, number, float(innovation_m), number * MS, SENSOR, is_settled)
        bands.append(band)
    return bands


def noise(count, std_m=1e-5, seed=0):
    return np.random.default_rng(seed).normal(0.0, std_m, count)


@pytest.mark.parametrize("seed", range(5))
def test_noise_is_within_and_its_change_is_learnt(seed):
    """The second difference of white noise has six times its variance."""
    bands = follow(noise(5000, seed=seed))
    assert not any(band.is_left for band in bands)
    changes_m = np.sqrt([band.square for band in bands[2000:]]) * 1e-3
    assert np.mean(changes_m) == pytest.approx(1e-5 * np.sqrt(6.0), rel=0.1)


@pytest.mark.parametrize("height_m", [1e-3, -1e-3, 0.1])
def test_a_jump_is_seen_at_its_first_sample(height_m):
    band = follow(noise(1000))[-1]
    assert follow([height_m], band, 1000)[0].is_left


def test_a_ramp_that_begins_is_seen_at_its_first_sample():
    """A sensor that freezes while its bench moves at 0.5 m/s."""
    band = follow(noise(1000, 1e-6))[-1]
    assert follow([band.innovation_m + 5e-4], band, 1000)[0].is_left


def test_a_smooth_change_of_any_size_is_within():
    t_s = np.arange(6000) * 1e-3
    amplitude_m = np.where(t_s < 3.0, 1e-4, 1e-4 * (1.0 + 10.0 * (t_s - 3.0)))
    bands = follow(amplitude_m * np.sin(2.0 * np.pi * 2.0 * t_s))
    assert not any(band.is_left for band in bands)


def test_a_bench_that_moves_more_gets_a_wider_band():
    """Each excess doubles the band: forty times as much noise is usual after four of them."""
    band = follow(noise(2000))[-1]
    bands = follow(noise(3000, 4e-4, seed=1), band, 2000)
    left = [number for number, item in enumerate(bands) if item.is_left]
    assert 2 <= len(left) <= 6
    assert left[-1] < 100


def test_rounding_alone_is_within():
    steps_m = 2e-6 * np.random.default_rng(2).integers(-1, 2, 3000)
    bands = follow([*np.zeros(1000), *steps_m])
    assert not any(band.is_left for band in bands)


def test_nothing_is_judged_before_there_is_a_mean():
    assert not any(band.is_left for band in follow([*np.zeros(40), 0.1, -0.1]))
    assert not any(band.is_left for band in follow(np.zeros(40), is_settled=False))


def test_an_observers_own_transient_is_not_outside_while_the_estimate_settles():
    band = follow(noise(1000))[-1]
    t_s = np.arange(200) * 1e-3
    transient_m = 0.1 * np.exp(-60.0 * t_s) * np.cos(80.0 * t_s)
    (jump,) = follow(transient_m[:1], band, 1000)
    assert jump.is_left
    settling = follow(transient_m[1:], jump, 1001, is_settled=False)
    assert not any(item.is_left for item in settling)
    # What was usual is still.
    assert {item.square for item in settling} == {jump.square}


def test_a_height_that_jumps_back_while_the_estimate_settles_is_outside_again():
    band = follow(noise(1000))[-1]
    t_s = np.arange(60) * 1e-3
    away_m = 5e-3 * np.exp(-60.0 * t_s)
    (jump,) = follow(away_m[:1], band, 1000)
    settling = follow([*away_m[1:], *-away_m], jump, 1001, is_settled=False)
    assert [number for number, item in enumerate(settling) if item.is_left] == [59]


def test_a_model_that_starts_again_has_no_innovation_before():
    band = restart_band(follow(noise(1000))[-1])
    assert not any(item.is_left for item in follow([0.1, 0.2, 0.1], band, 1000))
    assert follow([0.1], band, 1000)[0].innovation_m == 0.1


@given(st.integers(1, 4))
def test_missing_samples_are_no_excess(missing):
    """Of a smooth innovation: its rate changes for longer."""
    t_ms = np.arange(1500)
    innovation_m = 1e-4 * np.sin(2.0 * np.pi * 5.0 * t_ms * 1e-3)
    band = InnovationBand()
    left = []
    for t in t_ms:
        if t > 1000 and t % 50 < missing:
            continue
        band = update_band(band, t, innovation_m[t], int(t + 1) * MS, SENSOR, True)
        left.append(band.is_left)
    assert not any(left)


def test_a_gap_teaches_nothing():
    """Over a second the rate hardly changes: that is not usual from one sample to the next."""
    band = follow(noise(1000))[-1]
    behind = update_band(band, 0.0, band.innovation_m, 2000 * MS, SENSOR, True)
    assert behind.square == band.square
    assert not any(item.is_left for item in follow(noise(500, seed=4), behind, 2000))


def test_a_sample_that_is_not_newer_changes_nothing():
    band = follow(noise(100))[-1]
    assert update_band(band, 0.0, 1.0, band.t_ns, SENSOR, True) is band


def test_a_height_that_is_frozen_does_not_return_to_its_band():
    band = follow(noise(1000))[-1]
    band = update_band(band, 0.3, 0.1, 1001 * MS, SENSOR, True)
    for number in range(1002, 3000):
        band = update_band(band, 0.3, 0.1, number * MS, SENSOR, False)
        assert band.is_left
    assert not update_band(band, 0.3 + 2e-6, 0.1, 3000 * MS, SENSOR, False).is_left


def advance(band, change_m_per_s, elapsed_ns=MS, *, height_m=0.0, is_settled=True):
    """The band after an innovation whose rate has changed by so much."""
    rate = band.rate_m_per_s + change_m_per_s
    innovation_m = band.innovation_m + rate * elapsed_ns * 1e-9
    return update_band(band, height_m, innovation_m, band.t_ns + elapsed_ns, SENSOR, is_settled)


USUAL_M_PER_S = 0.02


def usual(count, band=NOTHING):
    """A band after changes of one size, to and fro."""
    for number in range(count):
        band = advance(band, USUAL_M_PER_S * (-1) ** number)
    return band


def test_up_to_a_second_the_mean_is_that_of_all_changes():
    innovations_m = noise(800, 1e-4)
    rates = np.diff([0.0, *innovations_m]) / 1e-3
    changes = np.diff([0.0, *rates])
    band = follow(innovations_m)[-1]
    least = SENSOR[0] / 1e-3  # of a sensor with steps
    assert band.square == pytest.approx(np.mean(np.maximum(np.abs(changes), least) ** 2), rel=1e-9)
    assert band.count == 800
    assert (band.innovation_m, band.t_ns) == (innovations_m[-1], 800 * MS)
    assert band.rate_m_per_s == pytest.approx(rates[-1])


def test_behind_it_older_changes_fade_within_a_second():
    band = usual(1500)
    for number in range(1000):
        band = advance(band, 2.0 * USUAL_M_PER_S * (-1) ** number)
    share = (1.0 - 1e-3) ** 1000
    assert band.square == pytest.approx(USUAL_M_PER_S**2 * (4.0 - 3.0 * share), rel=1e-6)


@pytest.mark.parametrize(("times", "is_left"), [(7.9, False), (8.1, True)])
def test_eight_times_what_is_usual_is_outside(times, is_left):
    before = usual(1000)
    after = advance(before, times * USUAL_M_PER_S)
    assert after.is_left is is_left
    if is_left:
        assert after.square == 4.0 * before.square
        assert (after.count, after.t_ns) == (before.count, before.t_ns + MS)


@pytest.mark.parametrize(("count", "is_left"), [(49, False), (50, True)])
def test_fifty_changes_are_a_mean(count, is_left):
    assert advance(usual(count), 20.0 * USUAL_M_PER_S).is_left is is_left


@pytest.mark.parametrize(("cycles", "is_learnt"), [(1.0, True), (1.4, True), (1.6, False)])
def test_what_comes_after_a_missing_sample_is_judged_and_not_learnt(cycles, is_learnt):
    before = usual(1000)
    after = advance(before, 2.0 * USUAL_M_PER_S, round(cycles * MS))
    assert (after.square != before.square) is is_learnt
    assert after.count == before.count + is_learnt


@pytest.mark.parametrize(("times", "is_left"), [(23.0, False), (25.0, True)])
def test_over_three_cycles_the_rate_may_change_three_times_as_much(times, is_left):
    assert advance(usual(1000), times * USUAL_M_PER_S, 3 * MS).is_left is is_left


def test_while_the_estimate_settles_the_last_innovation_is_kept():
    before = usual(1000)
    after = advance(before, 1.0, height_m=0.3, is_settled=False)
    assert after.rate_m_per_s == pytest.approx(before.rate_m_per_s + 1.0)
    assert after.innovation_m == pytest.approx(before.innovation_m + after.rate_m_per_s * 1e-3)
    assert (after.square, after.count) == (before.square, before.count)
    # The same height as before is no sign of a fault by itself.
    calm = advance(before, 0.0, height_m=0.3, is_settled=False)
    assert not advance(calm, 0.0, height_m=0.3, is_settled=False).is_left
