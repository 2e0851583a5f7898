"""`rig replay`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.added_sensors import ADDED_HELP, read_sensors
from rig.cli.progress import progress_line
from rig.cli.summary_file import SummaryFolder, write_summary
from rig.cli.terminal import (
    FAILED,
    JsonFlag,
    RunFolder,
    console,
    print_json,
    print_table,
    print_text,
)

if TYPE_CHECKING:
    from rig.run.replay import Replay

EXAMPLES = (
    "Examples: `rig replay rig-demo/run`; `rig replay rig-demo/run --add 'seat: {acceleration_of: "
    "body}'`"
)

_Added = Annotated[
    list[str] | None,
    typer.Option(
        "--add",
        metavar="SENSOR",
        help="Virtual sensor that is computed and kept beside the log, where exports and "
        f"`rig.open_run` find it: {ADDED_HELP}",
    ),
]


def replay_command(
    folder: RunFolder,
    add: _Added = None,
    out: SummaryFolder = None,
    as_json: JsonFlag = False,
) -> None:
    """Compute a run again from its frames and compare the result with its log, bit for bit."""
    from rig.log.checksums import refuse_damage
    from rig.log.reader import find_changed_files
    from rig.run.replay import replay

    sensors = read_sensors(add or [])
    with progress_line(None) as progress:
        result = replay(folder, sensors=sensors, progress=progress)
    if sensors:
        _keep_sensors(folder, result, sensors)
    summary: dict[str, object] = {
        "ticks": result.steps.num_rows,
        "logged_ticks": result.logged,
        "different_ticks": result.different,
        "first_different_ns": result.first_different_ns,
        "refused_frames": result.refused_frames,
    }
    missing = result.logged - result.steps.num_rows
    changed = find_changed_files(folder)
    write_summary(out, summary)
    if as_json:
        print_json({**summary, "changed_files": changed})
    else:
        rows = [
            (name.replace("_", " "), "-" if value is None else str(value))
            for name, value in summary.items()
        ]
        print_table(("Replay", str(folder)), rows)
        if result.steps.num_rows == 0:
            console.print("The run holds no tick: nothing was compared.", style="red")
        elif missing > 0:
            console.print(f"{missing} steps have no frames and were not compared.", style="yellow")
        for name in changed:
            console.print(f"{name} is not the one that ran: its hash differs.", style="yellow")
        if result.different:
            console.print("The replay differs from the log.", style="red")
        if sensors:
            _print_sensors(folder, result, sensors)
    refuse_damage(folder, result.damage)
    if result.different or changed or result.steps.num_rows == 0:
        raise typer.Exit(FAILED)


def _columns_of(names: Sequence[str], sensors: Mapping[str, object]) -> list[str]:
    """Columns of some virtual sensors among those of recomputed steps."""
    return [name for name in names if name.partition(".")[0] in sensors]


def _keep_sensors(folder: Path, result: "Replay", sensors: Mapping[str, object]) -> None:
    from can_dbc.errors import InputError
    from rig.log.added_columns import write_added

    names = _columns_of(result.steps.schema.names, sensors)
    try:
        write_added(folder, result.steps, names, result.logged)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error


def _print_sensors(folder: Path, result: "Replay", sensors: Mapping[str, object]) -> None:
    import numpy as np

    from rig.log.file_names import ADDED_FILE

    rows: list[tuple[str, ...]] = []
    for name in _columns_of(result.steps.schema.names, sensors):
        values = result.steps[name].to_numpy()
        values = values[np.isfinite(values)]
        if len(values) and "_std_" not in name:
            figures = values.mean(), values.std(), values.min(), values.max()
            rows.append((name, *(f"{it:.4g}" for it in figures)))
    print_table(("virtual sensor", "mean", "RMS about it", "smallest", "largest"), rows)
    print_text(f"Kept in {folder / ADDED_FILE}; the log is as it was.")
