"""Runs whose frames were thought up beforehand, without a bench or a bus."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from msgspec.structs import replace

from can_dbc.codec import compile_encoder
from can_dbc.frame import Frame
from can_dbc.protection import compile_protector
from can_dbc.units import Dimension
from rig.bridge.counts import Conditions
from rig.bridge.values import Request
from rig.bus.link import LinkFigures
from rig.machine.clock import VirtualClock
from rig.plan.build import build_bridge
from rig.plan.plan import Plan
from rig.run.logged_run import Endpoint, run_with_log
from rig.run.loop import RunControl

MS = 1_000_000


class ListPort:
    """Frames, and requests of operators, that were thought up beforehand, tick by tick."""

    def __init__(
        self,
        frames: Mapping[int, list[Frame]],
        requests: Mapping[int, Request] = MappingProxyType({}),
    ) -> None:
        self._frames = frames
        self._requests = requests

    def receive(self, t_ns: int) -> tuple[Sequence[Frame], Conditions]:
        tick = t_ns // MS
        return self._frames.get(tick, []), Conditions(request=self._requests.get(tick))

    def send(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        return frames


def bench_frames(ready: Plan, ticks: int, faults: dict[int, str]) -> dict[int, list[Frame]]:
    """Frames of a bench at 1 kHz, with faults at some ticks."""
    message = ready.database.message("BENCH_MEASUREMENT")
    assert message.protection is not None
    encode = compile_encoder(
        message, ["HEIGHT", "APPLIED_FORCE"], [Dimension.LENGTH, Dimension.FORCE]
    )
    found: dict[int, list[Frame]] = {}
    for tick in range(ticks):
        payload, _ = encode((0.4 + 0.02 * math.sin(0.02 * tick), 30.0 * math.sin(0.01 * tick)))
        data = compile_protector(message.protection)(payload, tick)
        frame = Frame(max(tick * MS - 1000, 0), message.arbitration_id, data)
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
        "flipped": [replace(frame, data=flipped)],
        "short": [replace(frame, data=frame.data[:-1])],
        "foreign": [replace(frame, arbitration_id=0x7FF), frame],
        "error": [replace(frame, arbitration_id=0x4, data=b"", is_error=True), frame],
        "again": [replace(frame, is_extended=True), frame],
    }.get(fault, [frame])


def live(ready: Plan, folder: Path, port: ListPort) -> None:
    """The run as the loop does it."""
    endpoint = Endpoint(port, VirtualClock(), LinkFigures())
    run_with_log(ready, build_bridge(ready), endpoint, folder, RunControl())
