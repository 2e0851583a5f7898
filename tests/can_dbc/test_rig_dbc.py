"""The bench's bus: what its messages have to be able to carry."""

from collections import Counter
from itertools import combinations

import cantools.database
import pytest

from can_dbc.codec import compile_decoder, compile_encoder
from can_dbc.database import DEFAULT_DATABASE, Database
from can_dbc.protection import Profile
from can_dbc.units import Dimension

PHYSICAL = {
    "m": Dimension.LENGTH,
    "m/s": Dimension.VELOCITY,
    "m/s^2": Dimension.ACCELERATION,
    "N": Dimension.FORCE,
    "degC": Dimension.TEMPERATURE,
    "s": Dimension.TIME,
    "": Dimension.NUMBER,
}


@pytest.mark.parametrize(
    ("message", "signal", "resolution", "limits"),
    [
        ("BENCH_MEASUREMENT", "HEIGHT", 2e-6, (0.0, 1.0)),
        ("BENCH_MEASUREMENT", "APPLIED_FORCE", 0.02, (-600.0, 600.0)),
        ("BENCH_MEASUREMENT_2", "HEIGHT", 2e-6, (0.0, 1.0)),
        ("DYNO_MEASUREMENT", "HEIGHT", 2e-7, (0.0, 1.5)),
        ("DYNO_MEASUREMENT", "STRUT_FORCE", 0.005, (-40000.0, 40000.0)),
        ("BENCH_AUXILIARY", "LOAD_CELL_FORCE", 0.02, (-1000.0, 1000.0)),
        ("BENCH_AUXILIARY", "TEMPERATURE", 0.1, (-40.0, 200.0)),
        ("RIG_ESTIMATE", "SPRING_DAMPER_FORCE", 0.02, (-1000.0, 1000.0)),
        ("RIG_ESTIMATE", "VIRTUAL_FORCE", 0.02, (-1000.0, 1000.0)),
        ("RIG_KINEMATICS", "MODEL_HEIGHT", 5e-5, (0.0, 1.0)),
        ("RIG_KINEMATICS", "MODEL_VELOCITY", 2e-3, (-4.0, 4.0)),
        ("RIG_KINEMATICS", "MODEL_ACCELERATION", 0.1, (-200.0, 200.0)),
        ("RIG_KINEMATICS", "INNOVATION", 5e-6, (-0.01, 0.01)),
        ("RIG_UNCERTAINTY", "FORCE_STD", 1e-3, (0.0, 1000.0)),
    ],
)
def test_range_and_resolution(
    rig: Database, message: str, signal: str, resolution: float, limits: tuple[float, float]
) -> None:
    entry = rig.message(message).signal(signal)
    assert entry.scale <= resolution
    assert entry.minimum is not None
    assert entry.maximum is not None
    assert entry.minimum <= limits[0]
    assert entry.maximum >= limits[1]


@pytest.mark.parametrize(
    ("message", "cycle_ms", "sender"),
    [
        ("BENCH_MEASUREMENT", 1, "BENCH"),
        ("BENCH_MEASUREMENT_2", 1, "BENCH"),
        ("DYNO_MEASUREMENT", 1, "BENCH"),
        ("RIG_UNCERTAINTY", 10, "RIG"),
        ("RIG_UNCERTAINTY_2", 10, "RIG"),
        ("BENCH_AUXILIARY", 10, "BENCH"),
        ("RIG_ESTIMATE", 1, "RIG"),
        ("RIG_ESTIMATE_2", 1, "RIG"),
        ("RIG_KINEMATICS", 1, "RIG"),
        ("RIG_KINEMATICS_2", 1, "RIG"),
        ("RIG_STATUS", 100, "RIG"),
        ("RIG_TIMING", 1000, "RIG"),
    ],
)
def test_cycle_time_and_sender(rig: Database, message: str, cycle_ms: int, sender: str) -> None:
    entry = rig.message(message)
    assert entry.cycle_time_ns == cycle_ms * 1_000_000
    assert entry.sender == sender
    assert entry.length_bytes == 8
    assert not entry.is_fd
    assert not entry.is_extended


def test_state_names(rig: Database) -> None:
    choices = rig.message("RIG_STATUS").signal("STATE").choices
    names = ["INIT", "WAITING", "RUNNING", "HOLD", "SAFE"]
    assert [choices[raw] for raw in range(5)] == names


def test_urgent_messages_win_arbitration(rig: Database) -> None:
    order = sorted(rig.messages.values(), key=lambda message: message.arbitration_id)
    kinds = [message.name.removesuffix("_2") for message in order]
    assert list(dict.fromkeys(kinds)) == [
        "BENCH_MEASUREMENT",
        "DYNO_MEASUREMENT",
        "BENCH_ROAD",
        "RIG_ESTIMATE",
        "RIG_KINEMATICS",
        "RIG_UNCERTAINTY",
        "BENCH_AUXILIARY",
        "RIG_STATUS",
        "RIG_TIMING",
    ]


@pytest.mark.parametrize(
    "name", ["BENCH_MEASUREMENT", "RIG_ESTIMATE", "RIG_KINEMATICS", "RIG_UNCERTAINTY"]
)
def test_second_strut_has_the_same_signals(rig: Database, name: str) -> None:
    first, second = rig.message(name), rig.message(f"{name}_2")
    assert dict(first.signals) == dict(second.signals)
    assert first.arbitration_id != second.arbitration_id


def test_every_message_is_protected_by_ids_of_its_own(rig: Database) -> None:
    identities = [message.protection.identity for message in rig.messages.values()]
    assert {identity.profile for identity in identities} == {Profile.P02}
    for one, other in combinations(identities, 2):
        assert all(a != b for a, b in zip(one.data_ids, other.data_ids, strict=True))
    for identity in identities:
        assert max(Counter(identity.data_ids).values()) == 1


def test_everything_is_explained() -> None:
    database = cantools.database.load_file(DEFAULT_DATABASE)
    for message in database.messages:
        assert message.comment
        for signal in message.signals:
            assert signal.comment, signal.name
            assert signal.minimum is not None


def test_every_signal_comes_back_within_half_a_step(rig: Database) -> None:
    checked = 0
    for message in rig.messages.values():
        for signal in message.signals.values():
            dimension = PHYSICAL[signal.unit]
            encode = compile_encoder(message, [signal.name], [dimension])
            decode = compile_decoder(message, [signal.name], [dimension])
            span = signal.maximum - signal.minimum
            for fraction in (0.0, 0.1234567, 0.5, 0.7654321, 1.0):
                value = signal.minimum + fraction * span
                data, saturated = encode([value])
                assert not saturated
                assert abs(decode(bytes(data))[0] - value) <= 0.5 * signal.scale * (1 + 1e-9)
                checked += 1
    assert checked > 100
