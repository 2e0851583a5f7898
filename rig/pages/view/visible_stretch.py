"""Curves and figures of the visible stretch of a run."""

import contextlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from dart_model.effects import AMBIENT_C
from dart_model.plant.strut import Strut, struts_of
from dart_model.spec import ModelSpec
from rig.bridge.values import Mode
from rig.channels.measured_quantities import TEMPERATURE
from rig.log.candump import LATEST_S, parse_frame
from rig.log.file_names import FRAMES_FILE, parts
from rig.log.follower import FORCE_ERROR, RunFollower
from rig.pages.plotted_quantities import (
    ESTIMATED_FORCE,
    HEIGHT_ERROR_CURVE,
    LOAD_CELL,
    MEASURED_HEIGHT,
    MODE_COLUMN,
    MODEL_HEIGHT,
    MOTION_COLUMNS,
    VIRTUAL_FORCE_CURVE,
)

Array = NDArray[np.float64]

LATEST_WINDOW_S = 1.0
"""Length of the stretch whose root mean squares are shown as present: some periods of a motion."""

FORCE_STD = "force_std_n"

LONGEST_S = 60.0
"""Length of the end of a stretch that is evaluated; a longer one is cut."""

_FOLLOWING = (Mode.SETTLING, Mode.RUNNING, Mode.READY)
"""Modes in which the model's motion is that of the bench."""

_ACROSS, _UP = 240, 160
"""Cells of the plane in which points are drawn, one point a cell."""

_LINE_POINTS = 81
"""Points of a law's curve: a few pixels apart in a chart."""

_CYCLE_POINTS = 400
"""Points of the last cycle's line."""

_SPECTRUM_POINTS = 4096
_LINES_READ = 60_000
"""Bytes of the frames' log from which the bus load is computed."""


def rows_between(follower: RunFollower, begin_s: float, end_s: float) -> Array:
    """Steps of a stretch's end, shape (N, columns)."""
    begin_s = max(begin_s, end_s - LONGEST_S)
    rows = follower.rows(*follower.between(begin_s, end_s))
    return rows[(rows[:, 0] >= begin_s * 1e9) & (rows[:, 0] <= end_s * 1e9 + 0.5)]


def latest(follower: RunFollower, strut: str, end_s: float) -> dict[str, float]:
    """Figures of the second before a time, by name; what was not measured is absent.

    Last values of the measured and the model height, of the force and its standard deviation, and
    of the mode's number; the age of the measured height in s; root mean squares of height error and
    force error, and the load cell's largest force.
    """
    rows = follower.rows(*follower.between(end_s - LATEST_WINDOW_S, end_s))
    rows = rows[(rows[:, 0] > 1e9 * (end_s - LATEST_WINDOW_S)) & (rows[:, 0] <= end_s * 1e9 + 0.5)]

    def finite(name: str) -> Array:
        values = _column(rows, follower.columns, name)
        return values[np.isfinite(values)]

    last = {
        MEASURED_HEIGHT.column: finite(MEASURED_HEIGHT.column_of(strut)),
        MODEL_HEIGHT.column: finite(MODEL_HEIGHT.column_of(strut)),
        ESTIMATED_FORCE.column: finite(ESTIMATED_FORCE.column_of(strut)),
        FORCE_STD: finite(f"{strut}.{FORCE_STD}"),
    }
    last["mode"] = finite(MODE_COLUMN)
    found = {name: float(values[-1]) for name, values in last.items() if len(values)}
    sampled_ns = finite(f"{strut}.measured_t_ns")
    if len(sampled_ns):
        found["measured_age_s"] = 1e-9 * float(rows[-1, 0] - sampled_ns[-1])
    for name, column in (
        ("height_error_rms_m", HEIGHT_ERROR_CURVE.column_of(strut)),
        ("force_error_rms_n", FORCE_ERROR),
    ):
        if len(values := finite(column)):
            found[name] = float(np.sqrt(np.mean(values**2)))
    if len(values := finite(LOAD_CELL.column)):
        found["load_cell_peak_n"] = float(np.abs(values).max())
    return found


def last_values(follower: RunFollower, names: Sequence[str], end_s: float) -> dict[str, float]:
    """Values of columns that belong together, by name: of one cycle where it has all of them.

    It is the last cycle before a time with a force error, and the last one for columns that have no
    part in it; what it lacks is absent.
    """
    rows = follower.rows(*follower.between(end_s - LATEST_WINDOW_S, end_s))
    rows = rows[rows[:, 0] <= end_s * 1e9 + 0.5]
    if not len(rows):
        return {}
    compared = np.flatnonzero(np.isfinite(_column(rows, follower.columns, FORCE_ERROR)))
    with_cell = rows[compared[-1]] if len(compared) else rows[-1]
    found: dict[str, float] = {}
    for name in names:
        is_compared = name in (FORCE_ERROR, LOAD_CELL.column) or name.endswith(_FORCE)
        row = with_cell if is_compared else rows[-1]
        if name in follower.columns and np.isfinite(value := row[follower.columns.index(name)]):
            found[name] = float(value)
    return found


_FORCE = f".{ESTIMATED_FORCE.column}"


def csv_of(follower: RunFollower, begin_s: float, end_s: float, names: Sequence[str]) -> str:
    """Cycles of a stretch as CSV, times in s first; a stretch is cut to its last `LONGEST_S`."""
    rows = rows_between(follower, begin_s, end_s)
    columns = [rows[:, 0] * 1e-9, *(_column(rows, follower.columns, name) for name in names)]
    text = io.StringIO()
    header = ",".join(("t_s", *names))
    np.savetxt(text, np.column_stack(columns), "%.10g", ",", header=header, comments="")
    return text.getvalue().replace("nan", "")


def planes(
    follower: RunFollower, rows: Array, strut: str, *, with_cell: bool
) -> dict[str, list[list[float]]]:
    """Points of force over velocity and over height: of the estimate, and of the load cell.

    `rows` are of `rows_between`; `with_cell` if the load cell is that strut's. The last cycle of
    the estimate is a line.
    """
    columns = follower.columns
    force = _column(rows, columns, ESTIMATED_FORCE.column_of(strut))
    cell = _column(rows, columns, LOAD_CELL.column_of(strut))
    follows = np.isin(_column(rows, columns, MODE_COLUMN), _FOLLOWING)
    force, cell = (np.where(follows, values, np.nan) for values in (force, cell))
    last = _last_cycle(_column(rows, columns, f"{strut}.velocity_m_per_s"))
    points: dict[str, list[list[float]]] = {}
    for name in MOTION_COLUMNS:
        motion = _column(rows, columns, f"{strut}.{name}")
        points[f"{name}:{ESTIMATED_FORCE.origin}"] = _points(motion, force)
        points[f"{name}:{LOAD_CELL.origin}"] = _points(motion, cell) if with_cell else [[], []]
        points[f"{name}:recent"] = [_numbers(motion[last]), _numbers(force[last])]
    return points


def _last_cycle(velocity: Array) -> NDArray[np.intp]:
    """Cycles of the bridge in the last cycle of a motion, thinned; none where it does not return.

    A cycle lies between two beginnings of rebound, each after a compression of a tenth of the
    largest speed: noise at a turning point begins none.
    """
    known = np.flatnonzero(np.isfinite(velocity))
    if not len(known):
        return known
    v = velocity[known]
    least = 0.1 * float(np.abs(v).max())
    sides = np.where(v > least, 1, np.where(v < -least, -1, 0))
    clear = np.flatnonzero(sides)
    begins = clear[1:][(sides[clear[1:]] == 1) & (sides[clear[:-1]] == -1)]
    if len(begins) < 2:
        return known[:0]
    cycle = known[begins[-2] : begins[-1] + 1]
    return cycle[:: max(1, len(cycle) // _CYCLE_POINTS)]


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
        law.force_n(float(h), float(v), rest, 0.0, 0.0, temperature_c)
        for h, v in zip(heights, velocities, strict=True)
    ]
    return [_numbers(along), _numbers(np.array(force))]


def _numbers(values: Array) -> list[float]:
    """Values rounded to six digits, which is more than a screen shows."""
    return [float(f"{value:.6g}") for value in values]
