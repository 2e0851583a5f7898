"""Mutated frames: no crash, and nothing used from what was refused.

What the counter and an 8-bit CRC let through is bounded: all changes of one, two and three bits of
every message are counted in the tests of `can_dbc`; here frames are changed in any way.
"""

import random
from math import isfinite

import pytest
from msgspec.structs import replace

from can_dbc.codec import compile_decoder
from can_dbc.protection import FrameStatus, check_crc
from can_dbc.units import Dimension
from tests.faults.trial import Trial

LENGTHS = (0, 1, 7, 8, 9, 12, 64)


def mutated(rng, frame):
    """A frame with one thing about it changed."""
    data = bytearray(frame.data)
    for _ in range(rng.randrange(1, 6)):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    changes = (
        {"data": rng.randbytes(len(data))},
        {"data": rng.randbytes(rng.choice(LENGTHS))},
        {"data": bytes(data)},
        {"arbitration_id": rng.choice((0x100, 0x101, 0x110, 0x200, 0x300))},
        {"is_extended": True, "arbitration_id": rng.getrandbits(29)},
        {"is_error": True, "arbitration_id": rng.getrandbits(9)},
        {"t_ns": frame.t_ns + rng.randrange(-(10**9), 10**9)},
    )
    return replace(frame, **rng.choice(changes))


def fuzz(ticks, seed):
    """A run in which three of four frames are mutated; every height used is accounted for."""
    rng = random.Random(seed)
    trial = Trial(limits=[{"value": "innovation_m", "low": -10, "high": 10, "action": "warn"}])
    bridge = trial.bridge
    heights_of = {
        item.message.arbitration_id: (
            item.message.protection,
            compile_decoder(item.message, ["HEIGHT"], [Dimension.LENGTH]),
        )
        for item in bridge.incoming
        if item.struts
    }
    frames = 0
    for index in range(ticks):
        genuine = trial.bench.update(index * 1_000_000)[0]
        given = [mutated(rng, f) if rng.random() < 0.75 else f for f in genuine for _ in range(4)]
        frames += len(given)
        before = trial.state.counts
        trial.state, result = bridge.tick(trial.state, index * 1_000_000, given)
        counts = trial.state.counts
        heights = {_height(frame, heights_of.get(frame.arbitration_id)) for frame in given}
        used = {item.value for item in result.step_input.samples if item.channel == 0}
        assert used <= heights - {None}
        assert counts.refused - before.refused <= len(given)
        for strut in result.output.struts:
            assert isfinite(strut.force_n)
    return frames, trial.state.counts


def _height(frame, how):
    """Height of a frame of the measurement that passes its CRC, else None."""
    if how is None or frame.is_error or frame.is_extended:
        return None
    protection, decode = how
    return decode(frame.data)[0] if check_crc(frame.data, protection) else None


def test_mutated_frames():
    frames, counts = fuzz(3000, seed=1)
    assert frames > 13_000
    causes = [verdict.value for verdict in FrameStatus if not verdict.is_accepted]
    assert all(getattr(counts, cause) > 0 for cause in causes)
    # Frames that are repeated or held back contradict their sender's clock too.
    assert sum(getattr(counts, cause) for cause in causes) + counts.untimed == counts.refused


@pytest.mark.long
def test_a_million_mutated_frames():
    frames, _ = fuzz(230_000, seed=2)
    assert frames > 1_000_000
