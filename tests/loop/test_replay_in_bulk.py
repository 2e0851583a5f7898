"""A replay in bulk gives what the bridge gave frame by frame, whatever came over the bus."""

import math
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.codec import compile_encoder
from can_dbc.frame import Frame
from can_dbc.protection import protect
from can_dbc.units import Dimension
from rig.config import CONFIGS, Setup, build_bridge, load_setup
from rig.core.messages import Conditions
from rig.core.supervisor import Supervision
from rig.io.clock import VirtualClock
from rig.io.link import LinkFigures
from rig.replay import replay
from rig.runs import logged

MS = 1_000_000
FAULTS = ("lost", "repeated", "flipped", "short", "late", "foreign", "error", "again", "silent")


class ListPort:
    """Frames that were thought up beforehand, tick by tick."""

    def __init__(self, frames: dict[int, list[Frame]], acknowledged: set[int]) -> None:
        self._frames = frames
        self._acknowledged = acknowledged

    def receive(self, t_ns: int) -> tuple[Sequence[Frame], Conditions]:
        return self._frames.get(t_ns // MS, []), Conditions(
            acknowledged=t_ns // MS in self._acknowledged
        )

    def send(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        return frames


def bench_frames(ready: Setup, ticks: int, faults: dict[int, str]) -> dict[int, list[Frame]]:
    """Frames of a bench at 1 kHz, with faults at some ticks."""
    message = ready.database.message("BENCH_MEASUREMENT")
    assert message.protection is not None
    encode = compile_encoder(
        message, ["HEIGHT", "APPLIED_FORCE"], [Dimension.LENGTH, Dimension.FORCE]
    )
    found: dict[int, list[Frame]] = {}
    for tick in range(ticks):
        payload, _ = encode((0.4 + 0.02 * math.sin(0.02 * tick), 30.0 * math.sin(0.01 * tick)))
        data = protect(payload, tick, message.protection)
        frame = Frame(tick * MS - 1000, message.arbitration_id, data)
        fault = faults.get(tick, "")
        found.setdefault(tick, [])
        if fault == "late":
            found.setdefault(tick + 1, []).append(frame)
        elif fault not in ("lost", "silent"):
            found[tick] += disturbed(frame, fault)
    for tick, fault in faults.items():
        if fault == "silent":
            for silent in range(tick, tick + 700):
                found.pop(silent, None)
    return found


def disturbed(frame: Frame, fault: str) -> list[Frame]:
    """What a fault makes of a frame."""
    flipped = bytes([frame.data[0], frame.data[1], frame.data[2] ^ 0x10, *frame.data[3:]])
    return {
        "repeated": [frame, frame],
        "flipped": [frame._replace(data=flipped)],
        "short": [frame._replace(data=frame.data[:-1])],
        "foreign": [frame._replace(arbitration_id=0x7FF), frame],
        "error": [frame._replace(arbitration_id=0x4, data=b"", is_error=True), frame],
        "again": [frame._replace(is_extended=True), frame],
    }.get(fault, [frame])


def live(ready: Setup, folder: Path, port: ListPort) -> None:
    """The run as the loop does it."""
    logged(
        ready,
        build_bridge(ready),
        port,
        VirtualClock(),
        folder,
        figures=LinkFigures(),
        stop=lambda: False,
        progress=lambda _t, _mode: None,
    )


def ready_for(ticks: int) -> Setup:
    return load_setup(CONFIGS / "seed.yaml", duration_s=ticks / 1000)


@settings(max_examples=20, deadline=None)
@given(
    faults=st.dictionaries(st.integers(0, 299), st.sampled_from(FAULTS), max_size=30),
    acknowledged=st.sets(st.integers(0, 299), max_size=3),
)
def test_faults_of_every_kind_are_replayed_bit_by_bit(faults, acknowledged):
    ready = ready_for(300)
    port = ListPort(bench_frames(ready, 300, faults), acknowledged)
    with TemporaryDirectory() as name:
        live(ready, Path(name) / "run", port)
        found = replay(Path(name) / "run")
    assert found.logged == len(found.steps) == 300
    assert found.different == 0


@pytest.mark.parametrize("fault", FAULTS)
def test_no_fault_changes_the_number_of_ticks(fault, tmp_path):
    ready = ready_for(200)
    faults = dict.fromkeys(range(50, 60), fault)
    live(ready, tmp_path / "run", ListPort(bench_frames(ready, 200, faults), set()))
    found = replay(tmp_path / "run")
    assert found.steps.column("t_ns").to_pylist() == [k * MS for k in range(200)]
    assert found.different == 0


def test_a_safe_state_and_its_acknowledgement_are_replayed(tmp_path):
    ready = ready_for(1000)
    port = ListPort(bench_frames(ready, 1000, {100: "silent"}), {900})
    live(ready, tmp_path / "run", port)
    found = replay(tmp_path / "run")
    modes = found.steps.column("mode").to_pylist()
    assert {2, 3, 4} <= set(modes)
    assert modes[-1] == 2
    assert found.different == 0


def test_refused_frames_are_counted_as_they_were_live(tmp_path):
    ready = ready_for(100)
    faults = {20: "flipped", 21: "flipped", 40: "short", 60: "repeated"}
    live(ready, tmp_path / "run", ListPort(bench_frames(ready, 100, faults), set()))
    assert replay(tmp_path / "run").refused_frames == 4


def test_the_default_supervision_is_what_these_tests_assume():
    supervision = ready_for(1).config.supervision.supervision()
    assert supervision == Supervision(10 * MS, 500 * MS, safe_holds_last=False)
