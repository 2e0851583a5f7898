"""The reference case at 100 Hz, for a bench and a bridge as processes of their own."""

import re
import signal
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import yaml

from can_dbc.database import DEFAULT_DATABASE
from rig.plan.config import CONFIGS

RATE_HZ = 100
"""An emulated kernel takes 370 us to send and receive one frame."""

SLOW_DBC = "slow.dbc"


def write_slow_dbc(folder: Path) -> Path:
    """The package's DBC with cycle times of 10 ms."""
    path = folder / SLOW_DBC
    path.write_text(
        re.sub(r'("GenMsgCycleTime" BO_ \d+) 1;', r"\1 10;", DEFAULT_DATABASE.read_text())
    )
    return path


def write_slow_bridge(path: Path, bus: Mapping[str, str], supervision: object) -> Path:
    """The reference case's bridge, with gains for this rate; the slow DBC is in its folder."""
    config = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
    # Soft enough for two processes whose ticks are up to two cycles apart: at that delay the
    # slowest pole is at 0.986 and the least damping ratio 0.09.
    gains = {"proportional_n_per_m": 2000.0, "integral_n_per_m_s": 5000.0}
    config |= {
        "rate_hz": RATE_HZ,
        "dbc": SLOW_DBC,
        "bus": dict(bus),
        "observers": {"strut": gains | {"force_limit_n": 5000.0}},
        "supervision": supervision,
        "realtime": {"fifo_priority": 0, "lock_memory": False},
    }
    path.write_text(yaml.safe_dump(config))
    return path


@contextmanager
def running(command: Sequence[str | Path], **options: object) -> Iterator[subprocess.Popen[bytes]]:
    """A program that runs meanwhile, and is ended in order, also where it was stopped."""
    process = subprocess.Popen([str(part) for part in command], **options)  # pyright: ignore
    try:
        yield process
    finally:
        process.send_signal(signal.SIGCONT)
        process.terminate()
        process.wait(120.0)
