"""What the simulated bench sends: sensors, timing and counters."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from can_dbc.codec import compile_decoder
from can_dbc.database import DEFAULT_DATABASE, DatabaseError, load_database
from can_dbc.protection import INITIAL, FrameStatus, check_crc, compile_checker, read_counter
from can_dbc.units import Dimension
from rig.simulated_bench.bench import SimulatedBench
from rig.simulated_bench.schema import BenchConfigError
from rig.simulated_bench.trajectory import simulate
from tests.rig_bench.linear_bench import linear_bench

SECOND_NS = 1_000_000_000
MS_NS = 1_000_000
SINE = {"kind": "sine", "amplitude_n": 40.0, "frequency_hz": 2.0}
HEIGHT = {"signal": "HEIGHT", "strut": "strut"}
FORCE = {"signal": "APPLIED_FORCE"}


@pytest.fixture(scope="module")
def database():
    return load_database(DEFAULT_DATABASE)


def _config(*, auxiliary=False, components=(SINE,), seed=1, height=HEIGHT, force=FORCE, **travel):
    sent = [{"message": "BENCH_MEASUREMENT", "height": height, "applied_force": force, **travel}]
    if auxiliary:
        load_cell = {"signal": "LOAD_CELL_FORCE", "strut": "strut"}
        slow = {"strut_force": load_cell, "temperature": {"signal": "TEMPERATURE"}}
        sent.append({"message": "BENCH_AUXILIARY", **slow})
    return linear_bench(components=components, seed=seed, transmissions=sent)


def _frames(config, database, until_ns, **start):
    return SimulatedBench(config, database, **start).update(until_ns)[0]


def _measured(frames, database):
    """Heights and forces of the measurement frames, shape (frames, 2)."""
    message = database.message("BENCH_MEASUREMENT")
    dimensions = (Dimension.LENGTH, Dimension.FORCE)
    decode = compile_decoder(message, ("HEIGHT", "APPLIED_FORCE"), dimensions)
    return np.array([decode(f.data) for f in frames if f.arbitration_id == message.arbitration_id])


def test_frames_carry_the_truth_to_half_a_step(database):
    config = _config()
    frames = _frames(config, database, SECOND_NS)
    truth = simulate(config, SECOND_NS)
    measured = _measured(frames, database)
    assert [frame.t_ns for frame in frames] == truth.t_ns.tolist()
    assert np.abs(measured[:, 0] - truth.height_m[:, 0]).max() <= 1.0001e-6
    assert np.abs(measured[:, 1] - truth.applied_force_n).max() <= 0.0050001


def test_slow_channels_come_at_their_own_cycle_time(database):
    config = _config(auxiliary=True)
    message = database.message("BENCH_AUXILIARY")
    dimensions = (Dimension.FORCE, Dimension.TEMPERATURE)
    decode = compile_decoder(message, ("LOAD_CELL_FORCE", "TEMPERATURE"), dimensions)
    slow = [
        frame
        for frame in _frames(config, database, SECOND_NS)
        if frame.arbitration_id == message.arbitration_id
    ]
    assert [frame.t_ns for frame in slow] == list(range(0, SECOND_NS + 1, 10 * MS_NS))
    truth = simulate(config, SECOND_NS, period_ns=10 * MS_NS)
    values = np.array([decode(frame.data) for frame in slow])
    assert np.abs(values[:, 0] - truth.strut_force_n[:, 0]).max() <= 0.0025001
    np.testing.assert_allclose(values[:, 1], 20.0)


def test_period_may_differ_from_the_database(database):
    frames = _frames(_config(period_ns=5 * MS_NS), database, 50 * MS_NS)
    assert [frame.t_ns for frame in frames] == list(range(0, 51 * MS_NS, 5 * MS_NS))


def test_every_frame_passes_its_check(database):
    protection = database.message("BENCH_MEASUREMENT").protection
    state, verdicts = INITIAL, []
    for frame in _frames(_config(), database, 100 * MS_NS):
        state, verdict = compile_checker(protection)(state, frame.data, frame.t_ns)
        verdicts.append(verdict)
    assert verdicts == [FrameStatus.FIRST] + [FrameStatus.OK] * 100


def test_counter_goes_on_over_lost_frames(database):
    protection = database.message("BENCH_MEASUREMENT").protection
    frames = _frames(_config(loss_probability=0.3), database, SECOND_NS)
    assert len(frames) < 1001
    for frame in frames:
        assert check_crc(frame.data, protection)
        assert read_counter(frame.data) == frame.t_ns // MS_NS % 16


def test_share_of_lost_frames(database):
    count, share = 5001, 0.2
    frames = _frames(_config(loss_probability=share), database, 5 * SECOND_NS)
    spread = math.sqrt(count * share * (1.0 - share))
    assert abs(count - len(frames) - count * share) < 4.0 * spread


def test_all_frames_can_be_lost(database):
    bench = SimulatedBench(_config(loss_probability=1.0), database)
    assert bench.update(10 * MS_NS) == ([], 11 * MS_NS)


def test_noise_has_its_standard_deviation_and_no_memory(database):
    config = _config(
        height=HEIGHT | {"noise_std_m": 50e-6}, force=FORCE | {"noise_std_n": 0.5}, components=()
    )
    noise = _measured(_frames(config, database, 5 * SECOND_NS), database)
    noise = noise - noise.mean(axis=0)
    np.testing.assert_allclose(noise.std(axis=0), [50e-6, 0.5], rtol=0.05)
    height_m, force_n = noise.T / noise.std(axis=0)[:, None]
    assert abs(np.mean(height_m[1:] * height_m[:-1])) < 0.06
    assert abs(np.mean(height_m * force_n)) < 0.06


def test_noise_of_one_sensor_does_not_depend_on_another(database):
    noisy = HEIGHT | {"noise_std_m": 50e-6}
    quiet = _measured(_frames(_config(height=noisy), database, SECOND_NS), database)
    force = FORCE | {"noise_std_n": 0.5}
    loud = _measured(_frames(_config(height=noisy, force=force), database, SECOND_NS), database)
    np.testing.assert_array_equal(quiet[:, 0], loud[:, 0])
    assert np.abs(quiet[:, 1] - loud[:, 1]).max() > 1.0


def test_latency_delays_the_frame_and_not_the_sample(database):
    late = _frames(_config(latency_ns=2_500_000), database, SECOND_NS)
    prompt = _frames(_config(), database, SECOND_NS)
    assert [frame.t_ns for frame in late] == [f.t_ns + 2_500_000 for f in prompt[:-3]] + [
        frame.t_ns + 2_500_000 for frame in prompt[-3:] if frame.t_ns + 2_500_000 <= SECOND_NS
    ]
    assert [frame.data for frame in late] == [frame.data for frame in prompt[: len(late)]]


def test_jitter_fills_its_range_and_keeps_the_order(database):
    jitter_ns = 400_000
    frames = _frames(_config(jitter_ns=jitter_ns), database, 2 * SECOND_NS)
    late_ns = np.array([frame.t_ns % MS_NS for frame in frames])
    assert late_ns.min() < 0.01 * jitter_ns
    assert 0.99 * jitter_ns < late_ns.max() <= jitter_ns
    assert np.mean(late_ns) == pytest.approx(0.5 * jitter_ns, rel=0.05)
    assert np.std(late_ns) == pytest.approx(jitter_ns / math.sqrt(12.0), rel=0.05)


def test_jitter_beyond_the_period_does_not_reorder(database):
    frames = _frames(_config(jitter_ns=5 * MS_NS), database, 2 * SECOND_NS)
    counters = [read_counter(frame.data) for frame in frames]
    assert counters == [i % 16 for i in range(len(frames))]
    times = [frame.t_ns for frame in frames]
    assert times == sorted(times)


def test_frames_do_not_depend_on_when_they_are_asked_for(database):
    config = _config(
        auxiliary=True,
        height=HEIGHT | {"noise_std_m": 20e-6},
        latency_ns=300_000,
        jitter_ns=900_000,
        loss_probability=0.05,
    )
    at_once = _frames(config, database, SECOND_NS)
    bench, piecewise, now_ns = SimulatedBench(config, database), [], 0
    while now_ns <= SECOND_NS:
        frames, due_ns = bench.update(now_ns)
        piecewise += frames
        assert all(frame.t_ns <= now_ns for frame in frames)
        assert due_ns > now_ns
        now_ns = due_ns
    assert piecewise == at_once
    assert piecewise == _frames(config, database, SECOND_NS)


def test_next_due_time_is_never_late(database):
    config = _config(latency_ns=300_000, jitter_ns=900_000)
    bench, due_ns = SimulatedBench(config, database), 0
    for _ in range(2000):
        frames, next_ns = bench.update(due_ns)
        # Nothing was due before: whatever comes is stamped with the time announced.
        assert all(frame.t_ns == due_ns for frame in frames)
        due_ns = next_ns


def test_seed_changes_noise_alone(database):
    noisy = HEIGHT | {"noise_std_m": 20e-6}
    one, other = (
        _measured(_frames(_config(height=noisy, seed=seed), database, SECOND_NS), database)
        for seed in (1, 2)
    )
    assert np.abs(one[:, 0] - other[:, 0]).max() > 20e-6
    np.testing.assert_array_equal(one[:, 1], other[:, 1])


def test_start_time_shifts_the_stamps(database):
    start_ns = 123_456_789_012_345_678
    shifted = _frames(_config(), database, start_ns + 20 * MS_NS, start_ns=start_ns)
    plain = _frames(_config(), database, 20 * MS_NS)
    assert shifted == [replace(frame, t_ns=frame.t_ns + start_ns) for frame in plain]
    assert SimulatedBench(_config(), database, start_ns=start_ns).update(start_ns - 1) == (
        [],
        start_ns,
    )


def test_a_sample_is_the_motion_bit_for_bit(database):
    config = _config(auxiliary=True)
    bench = SimulatedBench(config, database, start_ns=7)
    motion = simulate(config, SECOND_NS)
    for k in range(0, 1001, 37):
        assert bench._record(k * MS_NS) == [
            motion.height_m[k, 0],
            motion.velocity_m_per_s[k, 0],
            motion.strut_force_n[k, 0],
            motion.applied_force_n[k],
            motion.acting_force_n[k],
            motion.temperature_c[k],
        ]


def test_value_beyond_its_range_is_held_and_counted(database):
    sine = SINE | {"amplitude_n": 8000.0}
    config = _config(components=(sine,), height=None)
    bench = SimulatedBench(config, database)
    frames, _ = bench.update(SECOND_NS)
    message = database.message("BENCH_MEASUREMENT")
    decode = compile_decoder(message, ("APPLIED_FORCE",), (Dimension.FORCE,))
    force_n = np.array([decode(frame.data)[0] for frame in frames])
    assert force_n.max() == pytest.approx(5000.0)
    applied_n = simulate(config, SECOND_NS).applied_force_n
    assert bench.saturated_frames == np.count_nonzero(np.abs(applied_n) > 5000.005)


@pytest.mark.parametrize(
    ("sent", "error", "line"),
    [
        ([], BenchConfigError, "transmissions is empty"),
        ([{"message": "NONE", "height": HEIGHT}], DatabaseError, "no message 'NONE'"),
        (
            [{"message": "BENCH_MEASUREMENT", "height": HEIGHT | {"signal": "LENGTH"}}],
            DatabaseError,
            "no signal 'LENGTH'",
        ),
        (
            [{"message": "BENCH_MEASUREMENT", "height": HEIGHT | {"signal": "APPLIED_FORCE"}}],
            DatabaseError,
            "APPLIED_FORCE",
        ),
        (
            [
                {"message": "BENCH_MEASUREMENT", "height": HEIGHT, "period_ns": 1_000_001},
                {"message": "BENCH_MEASUREMENT_2", "height": HEIGHT},
            ],
            BenchConfigError,
            "common divisor is 1 ns",
        ),
    ],
)
def test_what_does_not_fit_the_bus_is_said_in_one_line(database, sent, error, line):
    with pytest.raises(error, match=line) as raised:
        SimulatedBench(linear_bench(transmissions=sent), database)
    assert "\n" not in str(raised.value)
