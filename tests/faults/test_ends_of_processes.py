"""The ends of a real `rig run` on a real bus, as an independent process receives them."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
STOP = "do not use the force while VALID is 0"
ALONE = f"detect that the frames stop; {STOP}"
SIGNALS = ("SIGKILL", "SIGSTOP", "SIGTERM", "SIGHUP", "SIGINT")


@pytest.fixture(scope="module")
def ends(tmp_path_factory):
    """What followed each signal; the bus is in a network that no other process is in."""
    isolated = [shutil.which("unshare") or "unshare", "-rn"]
    try:
        subprocess.run([*isolated, "true"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this machine lets nobody make a network of their own (unshare -rn)")
    if shutil.which("ip") is None:
        pytest.skip("ip is not installed (iproute2)")
    folder = tmp_path_factory.mktemp("ends")
    command = [*isolated, sys.executable, "-P", "-m", "tests.faults.on_a_network", str(folder)]
    # `-P` leaves out the working directory, and with it the tests.
    found = subprocess.run(
        [*command, *SIGNALS],
        check=True,
        capture_output=True,
        text=True,
        timeout=300.0,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    return {end["signal"]: end for end in map(json.loads, found.stdout.splitlines())}


@pytest.mark.parametrize("name", SIGNALS)
def test_the_last_that_the_bus_receives_is_invalid(ends, name):
    end = ends[name]
    assert end["last_valid"] == 0
    assert end["in_sequence"]
    assert end["invalid_frames"] >= 3


def test_how_soon(ends, promise):
    """In order at the next tick; killed, within a second; a standstill after `safe_after_s`."""
    assert all(ends[name]["first_invalid_s"] < 0.2 for name in ("SIGTERM", "SIGHUP", "SIGINT"))
    assert ends["SIGKILL"]["first_invalid_s"] < 0.5
    assert 0.45 < ends["SIGSTOP"]["first_invalid_s"] < 1.0
    in_order_s = max(ends[name]["first_invalid_s"] for name in ("SIGTERM", "SIGHUP", "SIGINT"))
    for order, (words, within_s, duty) in enumerate(
        (
            ("Ctrl-C, SIGTERM, a closed terminal", in_order_s, STOP),
            ("SIGKILL of the bridge, with its watchdog", ends["SIGKILL"]["first_invalid_s"], ALONE),
            ("SIGSTOP of the bridge, with its watchdog", ends["SIGSTOP"]["first_invalid_s"], ALONE),
        ),
        start=70,
    ):
        promise(order, words, [], f"after {1e3 * within_s:.0f} ms", "", {}, duty)


def test_the_exit_codes(ends):
    assert ends["SIGKILL"]["exit"] == -9
    assert [ends[name]["exit"] for name in ("SIGTERM", "SIGHUP", "SIGINT")] == [0, 0, 0]
    # Woken up again it finds that ticks are missing: the safe state.
    assert ends["SIGSTOP"]["exit"] == 1
