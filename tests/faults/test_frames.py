"""Faults of single frames and of the bench, between bench and bridge, at 1 kHz."""

import itertools
import random

import numpy as np
import pytest
from msgspec.structs import replace

from can_dbc.codec import compile_decoder
from can_dbc.protection import compile_protector
from can_dbc.units import Dimension
from rig.bridge.frame_checks import SECOND_SENDER_FRAMES
from rig.bridge.sample_times import LATE_FRAMES
from rig.bridge.values import Mode
from tests.faults.trial import (
    BEGIN_MS,
    BEGIN_NS,
    MEASUREMENT,
    MS,
    Gateway,
    Trial,
    after,
    first_ms,
    force_error_n,
    height_of,
    measurements_only,
)

NOTHING_RECEIVED = "nothing that was received"
END_MS = BEGIN_MS + 1000


@pytest.fixture(scope="module")
def undisturbed_n():
    """RMS error of the force without any fault."""
    ticks = Trial().run(END_MS)
    assert all(tick.is_valid for tick in ticks[BEGIN_MS:])
    return force_error_n(ticks)


def genuine_heights(trial):
    """Every height the bench can have sent so far: a twin of it, heard without a fault."""
    twin = Trial()
    message = twin.ready.database.message("BENCH_MEASUREMENT")
    decode = compile_decoder(message, ["HEIGHT"], [Dimension.LENGTH])
    frames = twin.bench.update(len(trial.ticks) * MS)[0]
    return {decode(frame.data)[0] for frame in frames if frame.arbitration_id == MEASUREMENT}


def assert_only_genuine_heights_were_used(trial):
    genuine = genuine_heights(trial)
    used = [height_of(tick.result) for tick in trial.ticks]
    assert {item.value for item in used if item is not None} <= genuine


def test_loss(row, undisturbed_n):
    rng = random.Random(1)
    trial = Trial()
    ticks = trial.run(
        END_MS, after(BEGIN_NS, measurements_only(lambda f: [] if rng.random() < 0.1 else [f]))
    )
    assert {tick.mode for tick in ticks[BEGIN_MS:]} == {Mode.RUNNING}
    error_n = force_error_n(ticks)
    assert error_n < 1.5 * undisturbed_n
    row(
        1,
        "loss: 10 % of the measurements",
        f"counts every lost frame ({ticks[-1].counts.lost}); force error {error_n:.1f} N "
        f"instead of {undisturbed_n:.1f} N RMS",
        first_ms(ticks, lambda tick: tick.counts.lost > 0),
        NOTHING_RECEIVED,
    )


def test_repetition(row, undisturbed_n):
    trial = Trial()
    ticks = trial.run(END_MS, after(BEGIN_NS, measurements_only(lambda frame: [frame, frame])))
    counts = ticks[-1].counts
    assert counts.repeated == counts.refused == END_MS - BEGIN_MS
    assert force_error_n(ticks) == undisturbed_n
    row(
        2,
        "repetition: every measurement twice",
        "refuses and counts every repetition; the estimate does not change, bit for bit",
        first_ms(ticks, lambda tick: tick.counts.repeated > 0),
        "the repetitions",
    )


def test_reordering(row, undisturbed_n):
    held = []

    def swap(frame):
        if held:
            return [frame, held.pop()]
        held.append(frame)
        return []

    trial = Trial()
    ticks = trial.run(END_MS, after(BEGIN_NS, measurements_only(swap)))
    assert ticks[-1].counts.out_of_sequence > 490
    assert_only_genuine_heights_were_used(trial)
    error_n = force_error_n(ticks)
    row(
        3,
        "reordering: every second measurement after its successor",
        f"refuses the late ones and counts them; force error {error_n:.1f} N "
        f"instead of {undisturbed_n:.1f} N RMS",
        first_ms(ticks, lambda tick: tick.counts.out_of_sequence > 0),
        "the refused frames",
    )


def test_delay(row, undisturbed_n):
    queue = []

    def late(t_ns, frames):
        queue.append(frames)
        arriving = queue.pop(0) if len(queue) > 3 else []
        return [replace(frame, t_ns=t_ns) for frame in arriving]

    trial = Trial()
    ticks = trial.run(END_MS + 2000, after(BEGIN_NS, late))
    refused = ticks[-1].counts.untimed
    assert 0 < refused < LATE_FRAMES
    settled = [tick for tick in ticks if tick.t_ns > BEGIN_NS + 100 * MS and tick.is_valid]
    # Three milliseconds of the bench's motion are not to be seen in frames that all come so.
    error_n = force_error_n(ticks, settled[0].t_ns)
    assert error_n < 5.0 * undisturbed_n
    # Against the force of the bench three milliseconds before, the error is the usual one.
    later, earlier = ticks[settled[0].t_ns // MS :], ticks[settled[0].t_ns // MS - 3 :]
    rest_n = [a.force_n - b.truth_n for a, b in zip(later, earlier, strict=False)]
    shifted_n = float(np.sqrt(np.mean(np.square(rest_n))))
    assert shifted_n < 1.2 * undisturbed_n
    row(
        4,
        "delay: from one instant on, all frames arrive 3 ms later, stamped on arrival",
        f"refuses {refused} frames that contradict their sender's clock; then the delay is "
        "attributed to the sender, and the estimate settles again: force error "
        f"{error_n:.1f} N RMS, because the estimated force is 3 ms late; the force of the bench "
        f"3 ms earlier differs from it by {shifted_n:.1f} N RMS (state a known delay with "
        "`delay_s`)",
        first_ms(ticks, lambda tick: not tick.is_valid),
        "the refused frames",
    )


def test_held_back(row, undisturbed_n):
    ticks = Trial().run(END_MS, after(BEGIN_NS, Gateway(8, 250)))
    assert ticks[-1].counts.untimed == ticks[-1].counts.lost == 0
    error_n = force_error_n(ticks)
    assert error_n == pytest.approx(undisturbed_n, rel=0.05)
    row(
        4,
        "frames delayed by 8 ms, four times per second, stamped on arrival",
        "is in SETTLING until they arrive, and uses each at the time of its sample; force "
        f"error {error_n:.1f} N instead of {undisturbed_n:.1f} N RMS",
        first_ms(ticks, lambda tick: not tick.is_valid),
        "nothing",
    )


def flipped(frame, bits):
    number = int.from_bytes(frame.data, "big")
    for bit in bits:
        number ^= 1 << bit
    return replace(frame, data=number.to_bytes(len(frame.data), "big"))


@pytest.mark.parametrize(
    ("order", "name", "bits"),
    [
        (5, "corruption: one bit in 10 % of the measurements", lambda rng: [rng.randrange(64)]),
        (
            6,
            "corruption: a burst of up to 8 bits in 10 % of the measurements",
            lambda rng: [rng.randrange(57) + i for i in range(8) if i == 0 or rng.random() < 0.5],
        ),
    ],
)
def test_corruption(row, undisturbed_n, order, name, bits):
    rng = random.Random(order)
    corrupted = []

    def corrupt(frame):
        if rng.random() >= 0.1:
            return [frame]
        where = bits(rng)
        start = where[0]
        corrupted.append(frame)
        return [flipped(frame, [start, *where[1:]])]

    trial = Trial()
    ticks = trial.run(END_MS, after(BEGIN_NS, measurements_only(corrupt)))
    counts = ticks[-1].counts
    assert counts.refused == len(corrupted) > 80
    assert_only_genuine_heights_were_used(trial)
    error_n = force_error_n(ticks)
    assert error_n < 1.5 * undisturbed_n
    row(
        order,
        name,
        f"refuses all {len(corrupted)} and uses no part of them; force error {error_n:.1f} N "
        f"instead of {undisturbed_n:.1f} N RMS",
        first_ms(ticks, lambda tick: tick.counts.refused > 0),
        "the corrupted frames",
    )


def test_masquerade(row):
    trial = Trial()

    def disguise(_t_ns, frames):
        auxiliary = [frame for frame in frames if frame.arbitration_id == 0x200]
        return frames + [replace(frame, arbitration_id=MEASUREMENT) for frame in auxiliary]

    ticks = trial.run(END_MS, after(BEGIN_NS, disguise))
    assert ticks[-1].counts.masquerade == 100
    assert_only_genuine_heights_were_used(trial)
    row(
        7,
        "masquerade: another message's frames under the measurement's id",
        "refuses and counts the frames: their CRC was computed with another data id",
        first_ms(ticks, lambda tick: tick.counts.masquerade > 0),
        "the disguised frames",
    )


def test_a_second_sender_of_the_benchs_id(row):
    trial = Trial()
    protection = trial.ready.database.message("BENCH_MEASUREMENT").protection
    sent = iter(range(5, 100_000))

    def rival(frame):
        return [frame, replace(frame, data=compile_protector(protection)(frame.data, next(sent)))]

    ticks = trial.run(END_MS, after(BEGIN_NS, measurements_only(rival)))
    found_ms = first_ms(ticks, lambda tick: tick.counts.second_sender > 0)
    assert found_ms <= 2 * SECOND_SENDER_FRAMES
    row(
        8,
        "a second sender of the bench's id, with valid frames",
        "uses the frames of one of the two, refuses those of the other, reports a second sender "
        "(BUS_FAULT in RIG_STATUS)",
        found_ms,
        "the refused frames",
    )


def test_a_second_sender_of_our_id(row):
    trial = Trial()
    ours = []

    def echo(_t_ns, frames):
        ours[:] = trial.ticks[-1].result.frames
        return frames + [frame for frame in ours if frame.arbitration_id == 0x110]

    ticks = trial.run(END_MS, after(BEGIN_NS, echo))
    assert ticks[-1].counts.second_sender == END_MS - BEGIN_MS
    row(
        9,
        "a second sender of RIG_ESTIMATE",
        "counts every frame and reports it (BUS_FAULT in RIG_STATUS)",
        first_ms(ticks, lambda tick: tick.counts.second_sender > 0),
        NOTHING_RECEIVED,
    )


def test_flood(row):
    # 20 frames a tick are three times what 1 Mbit/s can carry. A CRC of 8 bits lets 1 in 256 random
    # frames pass and the counter half of these; limits on the height catch nearly all that is left.
    limits = [
        {"value": "measured_height_m", "low": 0.1, "high": 0.7, "action": "refuse"},
        {"value": "measured_rate_m_per_s", "low": -3.0, "high": 3.0, "action": "refuse"},
    ]
    rng = random.Random(3)
    trial = Trial(limits=limits)

    def flood(_t_ns, frames):
        random_ones = [replace(frames[0], data=rng.randbytes(8)) for _ in range(20)]
        return [*random_ones, *frames]

    ticks = trial.run(END_MS, after(BEGIN_NS, flood))
    genuine = genuine_heights(trial)
    used = [height_of(tick.result) for tick in ticks]
    wrong = [item for item in used if item is not None and item.value not in genuine]
    counts, sent = ticks[-1].counts, 20 * (END_MS - BEGIN_MS)
    assert counts.wrong_crc + counts.masquerade > 0.99 * sent
    assert len(wrong) <= sent // 5000
    assert counts.stale < 0.02 * (END_MS - BEGIN_MS)
    error_n = force_error_n(ticks)
    passing = sent - counts.wrong_crc - counts.masquerade
    invalid_ms = first_ms(ticks, lambda tick: not tick.is_valid)
    runs = itertools.groupby(used[BEGIN_MS:], lambda item: item is None)
    longest = max(len(list(run)) for is_missing, run in runs if is_missing)
    row(
        10,
        f"flood: {sent} random frames in a second under the measurement's id (with limits on range "
        "and rate of the height)",
        f"{passing} pass the CRC; {counts.implausible} of these are refused by the limits, "
        f"{passing - counts.implausible - len(wrong)} because of their counter or time; "
        f"{len(wrong)} are used; the estimate is valid for {invalid_ms:.0f} ms, until {longest} "
        f"measurements in a row are refused; force error until then {error_n:.1f} N RMS",
        first_ms(ticks, lambda tick: tick.counts.refused > 0),
        f"{counts.refused - sent} measurements, which contradict the counter or the time of a "
        "random frame before them",
    )


def test_stuck_value(row):
    limits = [{"value": "unchanged_s", "high": 0.02, "action": "refuse"}]
    trial = Trial(limits=limits)
    message = trial.ready.database.message("BENCH_MEASUREMENT")
    protect, last = compile_protector(message.protection), []

    def stuck(frame):
        last.append(frame)
        return [replace(frame, data=protect(last[0].data, frame.data[1] & 0x0F))]

    ticks = trial.run(END_MS, after(BEGIN_NS, measurements_only(stuck)))
    assert ticks[-1].mode is Mode.SAFE
    assert ticks[-1].counts.implausible > 0
    invalid_ms = first_ms(ticks, lambda tick: not tick.is_valid)
    hold_ms = first_ms(ticks, lambda tick: tick.mode is Mode.HOLD)
    safe_ms = first_ms(ticks, lambda tick: tick.mode is Mode.SAFE)
    row(
        11,
        "stuck value: the same height in valid frames (limit `unchanged_s: 0.02`)",
        f"estimate invalid after {invalid_ms:.0f} ms; HOLD after {hold_ms:.0f} ms, as no new "
        "height has been used for 10 ms; refuses the measurement once it has been the same for "
        "20 ms; the safe state 500 ms later",
        safe_ms,
        "the refused measurements",
    )


def test_dead_bench(row):
    trial = Trial()
    ticks = trial.run(END_MS, after(BEGIN_NS, lambda _t_ns, _frames: []))
    invalid_ms = first_ms(ticks, lambda tick: not tick.is_valid)
    hold_ms = first_ms(ticks, lambda tick: tick.mode is Mode.HOLD)
    assert invalid_ms <= hold_ms <= 11
    assert ticks[-1].mode is Mode.SAFE
    assert ticks[-1].force_n == 0.0
    row(
        12,
        "the bench stops sending",
        f"estimate invalid after {invalid_ms:.0f} ms, HOLD after {hold_ms:.0f} ms, then the safe "
        "state: force 0, invalid, until acknowledged",
        first_ms(ticks, lambda tick: tick.mode is Mode.SAFE),
        NOTHING_RECEIVED,
    )
