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
The bridge runs at 1 kHz with the bench of the reference case, and each row is one fault that a test
puts between them, or into the machine. Faults of frames, bench and devices are injected tick by
tick in simulated time, 2 s after the start; those of disk and process are real runs. `Within` is
the time from the fault to the first tick that shows it, or to the state that is named. A force
error is the RMS difference to the simulated bench over the valid ticks, compared with the same run
without the fault. Faults in combination are not in this table.
"""

PROMISE_TEXT = """
A node on the bus decodes the bridge's frames with cantools; neither the log nor the bridge's own
values are used. The bench is the reference case, in simulated time, and most events begin 2 s after
the start. No force with `VALID` = 1 may err by more than three times the largest error of the
settled run; the test fails otherwise. Modes and times are those of the noise-aware observer. The
largest valid error is over that of the settled run, for published PI, damped PI and noise-aware
observer. The rows about signals are of real processes at 100 Hz with a bus in a network of their
own, and only `VALID` is decoded there. The last column is what the bench has to do itself.
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
        title = "What VALID promises"
        write_evidence("faults", "Faults", FAULTS_TEXT, [faults], command_line())
        write_evidence("promise", title, PROMISE_TEXT, [promise], command_line())
    return code


if __name__ == "__main__":
    sys.exit(main())
