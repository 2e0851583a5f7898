"""Curves and figures of the visible stretch of a run."""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from dart_model.effects import AMBIENT_C
from dart_model.plant.strut import Strut, struts_of
from dart_model.spec import ModelSpec
from rig.channels.measured_quantities import TEMPERATURE
from rig.log.candump import LATEST_S, parse_frame
from rig.log.file_names import FRAMES_FILE, parts
from rig.log.follower import RunFollower
from rig.pages.plotted_quantities import (
    ESTIMATED_FORCE,
    LOAD_CELL,
    MOTION_COLUMNS,
    VIRTUAL_FORCE_CURVE,
)

Array = NDArray[np.float64]

LONGEST_S = 60.0
"""Length of the end of a stretch that is evaluated; a longer one is cut."""

_ACROSS, _UP = 240, 160
"""Cells of the plane in which points are drawn, one point a cell."""

_LINE_POINTS = 81
"""Points of a law's curve: a few pixels apart in a chart."""

_SPECTRUM_POINTS = 4096
_LINES_READ = 60_000
"""Bytes of the frames' log from which the bus load is computed."""


def rows_between(follower: RunFollower, begin_s: float, end_s: float) -> Array:
    """Steps of a stretch's end, shape (N, columns)."""
    begin_s = max(begin_s, end_s - LONGEST_S)
    rows = follower.rows(*follower.between(begin_s, end_s))
    return rows[(rows[:, 0] >= begin_s * 1e9) & (rows[:, 0] <= end_s * 1e9 + 0.5)]


def planes(
    follower: RunFollower, rows: Array, strut: str, *, with_cell: bool
) -> dict[str, list[list[float]]]:
    """Points of force over velocity and over height: of the estimate, and of the load cell.

    `rows` are of `rows_between`; `with_cell` if the load cell is that strut's.
    """
    columns = follower.columns
    force = _column(rows, columns, ESTIMATED_FORCE.column_of(strut))
    cell = _column(rows, columns, LOAD_CELL.column_of(strut))
    points: dict[str, list[list[float]]] = {}
    for name in MOTION_COLUMNS:
        motion = _column(rows, columns, f"{strut}.{name}")
        points[f"{name}:{ESTIMATED_FORCE.origin}"] = _points(motion, force)
        points[f"{name}:{LOAD_CELL.origin}"] = _points(motion, cell) if with_cell else [[], []]
    return points


def laws(
    models: Mapping[str, ModelSpec], follower: RunFollower, rows: Array, strut: str
) -> dict[str, dict[str, list[list[float]]]]:
    """The force of each model that has the strut, with internal states of zero.

    Over height it is the force at rest, over velocity the force at mid-stroke.
    """
    columns = follower.columns
    height = _range(_column(rows, columns, f"{strut}.height_m"))
    velocity = _range(_column(rows, columns, f"{strut}.velocity_m_per_s"))
    if height is None or velocity is None:
        return {}
    middle = 0.5 * (height[0] + height[1])
    measured_c = _column(rows, columns, TEMPERATURE.column)
    mean_c = float(np.nanmean(measured_c)) if np.isfinite(measured_c).any() else AMBIENT_C
    heights = np.linspace(*height, _LINE_POINTS)
    velocities = np.linspace(*velocity, _LINE_POINTS)
    curves: dict[str, dict[str, list[list[float]]]] = {}
    for name, spec in models.items():
        struts = struts_of(spec)
        law = next((item for item in struts if item.name == strut), None)
        if law is not None:
            rest = [0.0] * sum(item.states for item in struts)
            still, amid = np.zeros(_LINE_POINTS), np.full(_LINE_POINTS, middle)
            with contextlib.suppress(ArithmeticError, ValueError):  # outside the law's domain
                curves[name] = {
                    "height_m": _line(law, rest, heights, still, heights, mean_c),
                    "velocity_m_per_s": _line(law, rest, amid, velocities, velocities, mean_c),
                }
    return curves


def spectrum(follower: RunFollower, rows: Array, strut: str) -> dict[str, list[float]]:
    """Amplitude density of the virtual force, by Welch's method, frequencies above zero.

    Reference: Welch, "The use of fast Fourier transform for the estimation of power spectra", IEEE
    Transactions on Audio and Electroacoustics 15 (1967).
    """
    force = _column(rows, follower.columns, VIRTUAL_FORCE_CURVE.column_of(strut))
    valid = np.isfinite(force)
    if valid.sum() < 256:
        return {"frequency_hz": [], "density": []}
    t_s = rows[:, 0] * 1e-9
    step_s = float(np.median(np.diff(t_s)))
    even = np.arange(t_s[0], t_s[-1], step_s)
    force = np.interp(even, t_s[valid], force[valid])
    frequency, power = signal.welch(force, 1.0 / step_s, nperseg=min(_SPECTRUM_POINTS, len(force)))
    return {
        "frequency_hz": _numbers(frequency[1:]),
        "density": _numbers(np.sqrt(np.maximum(power[1:], 1e-30))),
    }


def bus_load(
    folder: Path,
    epoch_ns: int,
    frame_times_s: Mapping[tuple[int, bool], float],
    end_s: float,
) -> dict[str, float]:
    """Frame rate in the log and bus load by these frames, before a time.

    Frames that the bridge neither reads nor sends are not in the log, and not counted.
    """
    count, busy_s, first_ns, last_ns = 0, 0.0, 0, 0
    for line in _lines_before(folder, epoch_ns, round(end_s * 1e9)):
        try:
            frame, _ = parse_frame(line.decode("ascii", "replace"), epoch_ns)
        except (ValueError, IndexError):
            continue
        first_ns = frame.t_ns if count == 0 else first_ns
        last_ns, count = frame.t_ns, count + 1
        busy_s += frame_times_s.get((frame.arbitration_id, frame.is_extended), 0.0)
    duration_s = (last_ns - first_ns) * 1e-9
    if duration_s <= 0.0:
        return {}
    return {"frames_per_s": count / duration_s, "load": busy_s / duration_s}


def _lines_before(folder: Path, epoch_ns: int, end_ns: int) -> Sequence[bytes]:
    """The last lines of the frames' log up to a time, found by bisection."""
    for path in reversed(parts(folder, FRAMES_FILE)):
        if not path.is_file():
            continue
        try:
            size = path.stat().st_size
            with path.open("rb") as file:
                if _stamp_ns(file.readline(), epoch_ns) > end_ns:
                    continue
                low, high = 0, size
                while high - low > _LINES_READ // 8:
                    middle = (low + high) // 2
                    file.seek(middle)
                    file.readline()
                    stamp = _stamp_ns(file.readline(), epoch_ns)
                    low, high = (middle, high) if stamp <= end_ns else (low, middle)
                file.seek(max(0, high - _LINES_READ))
                lines = file.read(high - file.tell()).split(b"\n")[1:-1]
        except OSError:
            continue
        if lines:
            return lines
    return ()


def _stamp_ns(line: bytes, epoch_ns: int) -> int:
    try:
        return parse_frame(line.decode("ascii", "replace"), epoch_ns)[0].t_ns
    except (ValueError, IndexError):
        return LATEST_S * 1_000_000_000


def _column(rows: Array, columns: Sequence[str], name: str) -> Array:
    return rows[:, columns.index(name)] if name in columns else np.full(len(rows), np.nan)


def _range(values: Array) -> tuple[float, float] | None:
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if len(finite) else None


def _points(x: Array, y: Array) -> list[list[float]]:
    """One point of each cell of the plane that is not empty."""
    both = np.isfinite(x) & np.isfinite(y)
    x, y = x[both], y[both]
    if not len(x):
        return [[], []]
    cell = _cell(x, _ACROSS) * _UP + _cell(y, _UP)
    _, first = np.unique(cell, return_index=True)
    return [_numbers(x[first]), _numbers(y[first])]


def _cell(values: Array, cells: int) -> NDArray[np.int64]:
    low, high = float(values.min()), float(values.max())
    return ((values - low) / max(high - low, 1e-300) * (cells - 1)).astype(np.int64)


def _line(
    law: Strut,
    rest: list[float],
    heights: Array,
    velocities: Array,
    along: Array,
    temperature_c: float,
) -> list[list[float]]:
    force = [
        law.force_n(float(h), float(v), rest, 0.0, 0.0, temperature_c, list(rest))
        for h, v in zip(heights, velocities, strict=True)
    ]
    return [_numbers(along), _numbers(np.array(force))]


def _numbers(values: Array) -> list[float]:
    """Values rounded to six digits, which is more than a screen shows."""
    return [float(f"{value:.6g}") for value in values]
