"""The table of faults, filled by the tests: `pytest tests/faults -n 0 --fault-table FILE`."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest


class Row(NamedTuple):
    """One fault, as measured.

    Attributes:
        order: Where it stands in the table.
        fault: What was done to the bridge.
        reaction: What the bridge does.
        within: After what time.
        lost: What is lost.
    """

    order: int
    fault: str
    reaction: str
    within: str
    lost: str


_HEAD = ("Fault", "Reaction of the bridge", "Within", "Loss")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fault-table", metavar="FILE", help="write the table of faults there")
    parser.addoption("--promise-table", metavar="FILE", help="write what VALID promises there")


@pytest.fixture(scope="session")
def rows(request: pytest.FixtureRequest) -> Iterator[list[Row]]:
    """What the tests measured; written at the end, if asked for."""
    found: list[Row] = []
    yield found
    target = request.config.getoption("--fault-table")
    if target:
        lines = [_line(_HEAD), _line(("---",) * 4), *[_line(row[1:]) for row in sorted(found)]]
        Path(target).write_text("\n".join(lines) + "\n", "utf-8")


def _line(cells: tuple[str, ...]) -> str:
    return f"| {' | '.join(cells)} |"


@pytest.fixture
def row(rows: list[Row]) -> Callable[..., None]:
    """Adds a row."""

    def add(order: int, fault: str, reaction: str, within_ms: float | str, lost: str) -> None:
        within = within_ms if isinstance(within_ms, str) else f"{within_ms:.0f} ms"
        rows.append(Row(order, fault, reaction, within, lost))

    return add


_PROMISE = (
    "Event",
    "Modes",
    "First invalid frame",
    "Valid again",
    "Largest valid error",
    "Duty of the bench",
)


@pytest.fixture(scope="session")
def promises(request: pytest.FixtureRequest) -> Iterator[list[tuple[int, tuple[str, ...]]]]:
    """What the tests of the promise measured; written at the end, if asked for."""
    found: list[tuple[int, tuple[str, ...]]] = []
    yield found
    target = request.config.getoption("--promise-table")
    if target:
        lines = [_line(_PROMISE), _line(("---",) * 6), *[_line(row) for _, row in sorted(found)]]
        Path(target).write_text("\n".join(lines) + "\n", "utf-8")


@pytest.fixture
def promise(promises: list[tuple[int, tuple[str, ...]]]) -> Callable[..., None]:
    """Adds a row; times are those of the noise-aware observer, errors those of all.

    An error is NaN where no force was valid.
    """

    def add(
        order: int,
        event: str,
        modes: list[str],
        within: str,
        again: str,
        ratios: dict[str, float],
        duty: str,
    ) -> None:
        errors = " / ".join(f"{it:.2f}" if not math.isnan(it) else "–" for it in ratios.values())
        promises.append((order, (event, ", ".join(modes), within, again, errors, duty)))

    return add
