"""The tables of faults and of what VALID promises: `python -m tests.faults [--page]`.

Runs the tests that fill these tables, in this process, and prints what they measured.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import pytest

from tests.evidence import add_page_option, command_line, write_evidence

FOLDER = Path(__file__).parent

FAULTS_TEXT = """
The bridge runs at 1 kHz with the bench of the reference case. In each row, a test injects one
fault. Faults of frames, bench, bus, clock and devices are injected in simulated time, 2 s after the
start; faults of disk and process in runs with a log on the disk. *Within* is the time from the
beginning of the fault to the first tick that shows it (for a stuck value and a bench that stops
sending, to the safe state); if only some of the frames are affected, it includes the wait for the
first of these. *Loss* states which data are lost. The force error is the RMS difference
between the estimated force and that of the simulated bench, over the valid ticks after the
beginning of the fault; *instead of* is the error of the same run without the fault. Combinations
of faults are not in this table.
"""

PROMISE_TEXT = """
For each event, the table shows when `VALID` becomes 0 and when it is 1 again, and the largest error
of a force with `VALID` = 1. A node on the bus decodes the bridge's frames with cantools; neither
the log nor internal values of the bridge are used. The bench is the reference case in simulated
time, and most events begin 2 s after the start. *The settled run* is the same run without an event.
The test fails if a force with `VALID` = 1 has an error of more than three times the largest error
of a valid force in the settled run.

- *First invalid frame* and *valid again* are times since the beginning of the event; these and the
  modes are those of the noise-aware observer. The modes are those in `RIG_STATUS`, which is sent
  every 100 ms: a mode that begins and ends between two of these frames is not listed. With the
  wrong scale, SETTLING and HOLD alternate; each is listed once.
- *Then acknowledged*: the safe state is acknowledged 0.8 to 0.9 s after the beginning of the event,
  and again every second.
- *Largest valid error* is relative to that of the settled run, for the PI observer with the
  published gains / a damped PI observer / the noise-aware observer (their parameters are on the
  page [What VALID promises](../explanation/validity.md#settling)); a dash: no force was valid.
- In the last three rows, the bridge is a real process at 100 Hz that receives a signal of the
  operating system, on a bus over UDP multicast in a separate network namespace; the errors of the
  forces are not evaluated. Of several signals in one row, the longest time is stated.
- The last column states what the bench itself has to do.
"""


class TablesOnly:
    """Keeps the tests that fill a table."""

    def pytest_collection_modifyitems(self, items: list[pytest.Function]) -> None:
        """Leave out all others."""
        items[:] = [item for item in items if {"rows", "promises"} & set(item.fixturenames)]


def measure(folder: Path) -> tuple[int, str, str]:
    """Exit code of the tests, and both tables."""
    faults, promise = folder / "faults.md", folder / "promise.md"
    options = ["-q", "-n", "0", "-m", "long or not long", "-p", "no:cacheprovider"]
    options += ["--fault-table", str(faults), "--promise-table", str(promise)]
    code = pytest.main([str(FOLDER), *options], plugins=[TablesOnly()])
    return code, faults.read_text("utf-8").strip(), promise.read_text("utf-8").strip()


def main() -> int:
    """Run the tests, print their tables, and give their exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_page_option(parser)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        code, faults, promise = measure(Path(folder))
    print(faults, promise, sep="\n\n")
    if given.page and code == 0:
        title = "What VALID promises: the evidence"
        write_evidence(
            "faults", "Measured reactions to faults", FAULTS_TEXT, [faults], command_line()
        )
        write_evidence("promise", title, PROMISE_TEXT, [promise], command_line(), with_load=False)
    return code


if __name__ == "__main__":
    sys.exit(main())
