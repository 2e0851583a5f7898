"""J1939 devices: found by their claims, followed when they move, and values that are none."""

import json
import math
import struct

import pytest
from msgspec.structs import replace

from can_dbc.codec import compile_decoder, si_range
from can_dbc.database import load_database
from can_dbc.frame import Frame
from can_dbc.units import Dimension
from rig.bridge.values import Mode
from rig.bus.bus import BusConfig
from rig.plan.build import build_bridge
from rig.plan.load import load_plan
from rig.sensors.j1939 import AddressClaim, address_claims, group_messages, group_number
from rig.sensors.proposed_config import configuration_text, dbc_text
from tests.bridge.cores import FIRST
from tests.faults.trial import height_of

MS = 1_000_000
NAME = 0x8000_2E05_1234_5678
LEVELS = 0x18FE5900
BUS = BusConfig("virtual", "j1939", 250_000)


def claim(address, name=NAME, t_ns=0):
    return Frame(t_ns, 0x18EEFF00 | address, name.to_bytes(8, "little"), is_extended=True)


def levels(address, height_m, t_ns=0):
    raw = round((height_m * 1e3 + 3200.0) / 0.1)
    return Frame(t_ns, LEVELS | address, struct.pack("<4H", *(raw,) * 4), is_extended=True)


def test_a_name_is_taken_apart():
    # SAE J1939-81: identity 21 bits, manufacturer 11, instances 8, function 8, ...
    name = 0x12345 | 0x155 << 21 | 0x2E << 40 | 1 << 63
    (found,) = address_claims([claim(0x80, name)])
    assert (found.address, found.identity, found.manufacturer, found.function) == (
        0x80,
        0x12345,
        0x155,
        0x2E,
    )


def test_the_last_claim_of_a_name_counts():
    assert address_claims([claim(0x80), claim(0x81)]) == (AddressClaim(0x81, NAME),)
    assert address_claims([claim(0xFE)]) == ()


@pytest.mark.parametrize(
    ("arbitration_id", "number"), [(0x18FE5920, 65113), (0x18EEFF20, 0xEE00), (0x0CF00400, 61444)]
)
def test_group_numbers(arbitration_id, number):
    assert group_number(arbitration_id) == number


@pytest.fixture
def ready(tmp_path):
    """A bridge to a level sensor at address 32."""
    heard = [claim(0x20), levels(0x20, 0.4)]
    found, known = group_messages(heard), address_claims(heard)
    (tmp_path / "sensors.dbc").write_text(dbc_text((), found))
    (tmp_path / "rig.yaml").write_text(configuration_text((), found, known, BUS))
    return load_plan(tmp_path / "rig.yaml")


def test_levels_are_described(ready):
    message = ready.database.message("ASC3_FROM_32")
    assert message.is_j1939
    decode = compile_decoder(message, ["RELATIVE_LEVEL_REAR_LEFT"], [Dimension.LENGTH])
    assert decode(levels(0x20, 0.4321).data)[0] == pytest.approx(0.4321)
    low, high = si_range(message, "RELATIVE_LEVEL_FRONT_LEFT", Dimension.LENGTH)
    assert (low, high) == (pytest.approx(-3.2), pytest.approx(3.2255))
    entry = ready.config.devices["ADDRESS_32"]
    assert (entry.j1939_name, entry.source_address) == (NAME, 0x20)


def driven(ready, given):
    """Ticks with frames by tick."""
    bridge = build_bridge(ready)
    state = bridge.init(0)
    results = []
    for index in range(max(given) + 1):
        t_ns = index * ready.period_ns
        frames = [replace(frame, t_ns=t_ns) for frame in given.get(index, [])]
        state, result = bridge.tick(state, t_ns, frames)
        results.append(result)
    return results, state


def test_a_value_that_is_none_is_refused(ready):
    error = Frame(0, LEVELS | 0x20, b"\x00\xfe" * 4, is_extended=True)
    absent = Frame(0, LEVELS | 0x20, b"\xff\xff" * 4, is_extended=True)
    results, state = driven(ready, {0: [levels(0x20, 0.4)], 1: [error], 2: [absent]})
    assert [height_of(result) is None for result in results] == [False, True, True]
    assert (state.counts.no_value, state.counts.refused) == (2, 2)


def test_a_device_that_moves_is_followed(ready):
    given = {
        0: [levels(0x20, 0.4)],
        1: [claim(0x21), levels(0x21, 0.41)],
        2: [levels(0x20, 0.9)],  # somebody else's now
        3: [levels(0x21, 0.42)],
    }
    results, _ = driven(ready, given)
    used = [height_of(result) for result in results]
    heights = [None if item is None else round(item.value, 4) for item in used]
    assert heights == [0.4, 0.41, None, 0.42]


def test_an_address_that_somebody_else_takes_is_not_believed(ready):
    last = FIRST - 1
    given = {tick: [levels(0x20, 0.4)] for tick in range(FIRST)} | {
        last + 1: [claim(0x20, name=5)],
        last + 2: [levels(0x20, 0.9)],
        last + 3: [claim(0x30), levels(0x30, 0.4)],
    }
    results, _ = driven(ready, given)
    assert results[last].output.mode is Mode.SETTLING
    assert results[last + 1].device_faults == ((0, "has no address"),)
    assert results[last + 1].output.mode is Mode.HOLD
    assert height_of(results[last + 2]) is None
    assert height_of(results[last + 3]) is not None
    assert results[last + 3].device_faults == ()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_float_that_is_no_number_is_refused(tmp_path, value):
    (tmp_path / "float.dbc").write_text(
        'VERSION ""\nBU_: BENCH RIG\nBO_ 256 M: 8 BENCH\n'
        ' SG_ H : 0|32@1- (1,0) [0|0] "m" RIG\n SG_ X : 32|32@1- (1,0) [0|0] "N" RIG\n'
        "SIG_VALTYPE_ 256 H : 1;\nSIG_VALTYPE_ 256 X : 1;\n"
    )
    config = {"dbc": "float.dbc", "signals": {"height": {"message": "M", "signal": "H"}}}
    (tmp_path / "rig.yaml").write_text(json.dumps(config))
    ready = load_plan(tmp_path / "rig.yaml")
    assert load_database(tmp_path / "float.dbc").message("M").signals["H"].is_float
    bad = Frame(0, 256, struct.pack("<2f", value, 0.0))
    good = Frame(0, 256, struct.pack("<2f", 0.5, math.nan))  # what is not read may be anything
    results, state = driven(ready, {0: [good], 1: [bad]})
    assert height_of(results[0]).value == 0.5
    assert height_of(results[1]) is None
    assert state.counts.no_value == 1


def test_who_lost_an_address_has_none():
    low, high = 5, 9
    frames = [claim(32, low), claim(32, high), claim(32, low), claim(0xFE, high)]
    assert address_claims(frames) == (AddressClaim(32, low),)
    assert address_claims([claim(32, high), claim(32, low)]) == (AddressClaim(32, low),)
