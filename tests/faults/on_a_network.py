"""Bench, bridge and listener as three processes on a bus of a network of their own.

Run within `unshare`, as root of its own namespaces: whatever is sent reaches no other machine. It
prints what an independent listener received, decoded by cantools, as JSON: one line for each way to
end.
"""

import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import can
import cantools

from rig.log.file_names import EVENTS_FILE
from rig.plan.config import CONFIGS
from tests.slow_reference import SLOW_DBC, running, write_slow_bridge, write_slow_dbc

GROUP = "239.74.163.2"
RIG = (sys.executable, "-P", "-m", "rig")
_LONGEST_WAIT_S = 60.0


def write_files(folder: Path) -> Path:
    """The reference case at 100 Hz on the network; returns its configuration."""
    write_slow_dbc(folder)
    bus = {"interface": "udp_multicast", "channel": GROUP}
    ages = {"stale_after_s": 0.2, "safe_after_s": 0.5, "settling_s": 0.2}
    return write_slow_bridge(folder / "rig.yaml", bus, ages)


class Listener:
    """What an independent node receives of the bridge's estimate: time, and whether it is valid."""

    def __init__(self, dbc: Path) -> None:
        self._message = cantools.database.load_file(dbc).get_message_by_name("RIG_ESTIMATE")
        self._bus = can.Bus(interface="udp_multicast", channel=GROUP, fd=True)
        self._ended = threading.Event()
        self.received: list[tuple[float, int, int]] = []
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self) -> None:
        while not self._ended.is_set():
            frame = self._bus.recv(0.05)
            if frame is not None and frame.arbitration_id == self._message.frame_id:
                values = self._message.decode(frame.data, decode_choices=False)
                entry = (time.monotonic(), int(values["VALID"]), int(values["COUNTER"]))
                self.received.append(entry)

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._bus.shutdown()


def wait_for(is_true: object, what: str) -> None:
    end_s = time.monotonic() + _LONGEST_WAIT_S
    while not is_true():  # pyright: ignore
        if time.monotonic() > end_s:
            raise TimeoutError(what)
        time.sleep(0.02)


def end_by(name: str, config: Path, folder: Path) -> dict[str, object]:
    """Run a bridge until its estimate is valid, send it a signal, and see what follows."""
    listener = Listener(config.parent / SLOW_DBC)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with running([*RIG, "run", config, "--out", folder], **quiet) as bridge:
        wait_for(lambda: sum(valid for _, valid, _ in listener.received[-50:]) > 40, "valid")
        begun_s = time.monotonic()
        bridge.send_signal(signal.Signals[name])
        if name == "SIGSTOP":
            time.sleep(1.5)
            # Ended before it has taken another tick it would not know that it stood still.
            bridge.send_signal(signal.SIGCONT)
            events = folder / EVENTS_FILE
            wait_for(lambda: "ticks_missing" in events.read_text(), "an event")
        else:
            bridge.wait(60.0)
            time.sleep(0.5)
    listener.close()
    after = [entry for entry in listener.received if entry[0] > begun_s]
    first = next((time_s - begun_s for time_s, valid, _ in after if not valid), None)
    if name == "SIGSTOP":
        # What follows when it was woken up again is another matter.
        after = [entry for entry in after if entry[0] < begun_s + 1.4]
    counters = [counter for _, _, counter in after]
    return {
        "signal": name,
        "exit": bridge.returncode,
        "last_valid": after[-1][1] if after else None,
        "invalid_frames": sum(not valid for _, valid, _ in after),
        "first_invalid_s": first,
        "in_sequence": all((b - a) % 16 == 1 for a, b in itertools.pairwise(counters)),
    }


def main() -> None:
    """End bridges by the signals that are named, one after the other."""
    folder, *names = sys.argv[1:]
    config = write_files(Path(folder))
    subprocess.run(["ip", "link", "set", "lo", "up", "multicast", "on"], check=True)
    subprocess.run(["ip", "route", "add", "224.0.0.0/4", "dev", "lo"], check=True)
    bench = [*RIG, "bench", CONFIGS / "reference_bench.yaml", "--interface", "udp_multicast"]
    bench += ["--channel", GROUP, "--dbc", config.parent / SLOW_DBC]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with running(bench, **quiet):
        for name in names:
            print(json.dumps(end_by(name, config, Path(folder) / name)), flush=True)


if __name__ == "__main__":
    os.environ["PYTHONSAFEPATH"] = "1"
    main()
