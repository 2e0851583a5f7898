"""`rig import` and `rig export`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.output import WRONG_INPUT, console
from rig.cli.watching import progress_line
from rig.inputs.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rig.exchange.mapping import Mapping

IMPORT_EXAMPLES = (
    "Examples: `rig import bench.txt --mapping bench.yaml --out bench.csv` · "
    "`rig import specimen.dat --rebound positive --out dyno.csv` · "
    "`rig import bus.blf --config rig.yaml --out runs/9` · `rig import run.mf4 --out runs/10`"
)


def import_command(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="Table or folder of tables, bus log, export.")
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="PATH", help="CSV file, or folder: of a run, of many.")
    ],
    mapping: Annotated[
        Path | None,
        typer.Option("--mapping", metavar="FILE", help="Columns and units of a foreign table."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", metavar="FILE", help="Signals of a bus log, with its DBC."),
    ] = None,
    rebound: Annotated[
        str | None,
        typer.Option(
            "--rebound",
            metavar="SIGN",
            help="positive or negative: sign of the force in rebound, for an MTS file without "
            "--mapping, whose names and units are then its own.",
        ),
    ] = None,
) -> None:
    """Make a CSV of a foreign table, or a run of a bus log or of an export.

    A table (text, XLSX, TDMS, MF4, MTS) wants --mapping, or --rebound if it is of MTS; a bus log
    (BLF, ASC, candump, TRC, MF4) wants --config; what `rig export` wrote wants neither.
    """
    from rig.exchange.bus_log import import_log
    from rig.exchange.exported import import_run
    from rig.exchange.foreign_table import import_table
    from rig.exchange.mapping import load_mapping
    from rig.operation.setup import load_setup

    if sum(given is not None for given in (mapping, config, rebound)) > 1:
        raise InputError("--mapping, --config and --rebound: expected one of them")
    if source.is_dir() and config is None and (mapping is not None or rebound is not None):
        given = None if mapping is None else load_mapping(mapping)
        _import_folder(source, out, lambda path: given or _of_mts(path, rebound or ""))
        return
    if rebound is not None:
        report = import_table(source, _of_mts(source, rebound), out)
    elif mapping is not None:
        report = import_table(source, load_mapping(mapping), out)
    elif config is not None:
        with progress_line(None) as progress:
            report = import_log(source, load_setup(config), out, progress)
    else:
        _refuse_without_meaning(source)
        import_run(source, out)
        console.print(f"Run: {out}", markup=False)
        return
    console.print(
        f"{report.samples} samples, {report.duration_s:.3f} s at {report.rate_hz:g} a second: "
        f"{', '.join(report.columns)}"
    )
    for line in report.assumptions:
        console.print(f"- {line}", markup=False)
    console.print(f"Written: {report.out}", markup=False)


def _refuse_without_meaning(source: Path) -> None:
    """Refuse a table, or a folder of tables, whose columns nobody told the meaning of."""
    from rig.exchange.mts import is_mts

    if is_mts(source):
        raise InputError(f"{source}: a file of MTS, expected --rebound positive or negative")
    if source.is_dir() and not any(source.glob("*.parquet")):
        raise InputError(f"{source}: a folder of tables, expected --mapping FILE or --rebound")


def _import_folder(source: Path, out: Path, mapping_of: "Callable[[Path], Mapping]") -> None:
    """Import every file of a folder; exit code 2 if one is refused."""
    from rig.exchange.folder import import_folder

    refused = 0
    for path, made in import_folder(source, mapping_of, out):
        if isinstance(made, InputError):
            refused += 1
            console.print(f"refused: {made}", markup=False, style="red")
        else:
            console.print(f"{path.name}: {made.samples} samples, {made.out}", markup=False)
    if refused:
        console.print(f"{refused} refused, the others are in {out}", markup=False)
        raise typer.Exit(WRONG_INPUT)


def _of_mts(source: Path, rebound: str) -> "Mapping":
    """What an MTS file says of itself."""
    from rig.exchange.mts import is_mts, mts_mapping

    if rebound not in ("positive", "negative"):
        raise InputError(f"--rebound {rebound!r}: expected positive or negative")
    if not is_mts(source):
        raise InputError(f"{source}: is no file of MTS, expected --mapping FILE")
    return mts_mapping(source, "positive" if rebound == "positive" else "negative")


EXPORT_EXAMPLES = (
    "Examples: `rig export runs/7 --format mf4 --out run.mf4` · "
    "`rig export runs/7 --format candump --out run.log`"
)


def export_command(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")],
    out: Annotated[
        Path, typer.Option("--out", metavar="PATH", help="New file; for Parquet a folder.")
    ],
    kind: Annotated[str, typer.Option("--format", help="One of mf4, parquet, csv, candump.")],
) -> None:
    """Write a run for other programs: MF4, Parquet, CSV or candump."""
    from rig.exchange.exported import export_run

    for path in export_run(folder, kind, out):
        console.print(f"Written: {path}", markup=False)
