"""`rig import` and `rig export`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.progress import progress_bar, progress_line
from rig.cli.terminal import WRONG_INPUT, console

if TYPE_CHECKING:
    from collections.abc import Callable

    from rig.formats.mapping import Mapping

IMPORT_EXAMPLES = (
    "Examples: `rig import bench.txt --mapping bench.yaml --out bench.csv` · "
    "`rig import specimen.dat --rebound positive --out dyno.csv` · "
    "`rig import bus.blf --config rig.yaml --out runs/9` · `rig import run.mf4 --out runs/10` · "
    "`rig import strut.fmu --fmu --mass-kg 10 --out model`"
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
    fmu: Annotated[
        bool,
        typer.Option(
            "--fmu",
            help="SOURCE is an FMU, of which a model is made; --mapping says what its variables "
            "are, if they are not called as in an FMU of `rig export`.",
        ),
    ] = False,
    mass_kg: Annotated[
        float | None,
        typer.Option("--mass-kg", metavar="KG", help="With --fmu: what a strut alone carries."),
    ] = None,
) -> None:
    """Make a CSV of a foreign table, a run of a bus log or of an export, a model of an FMU.

    A table (text, XLSX, TDMS, MF4, MTS) wants --mapping, or --rebound if it is of MTS; a bus log
    (BLF, ASC, candump, TRC, MF4) wants --config; what `rig export` wrote wants neither. With --fmu,
    SOURCE is a functional mock-up unit: a program, which from then on may run on this machine.
    """
    from rig.formats.bus_log import import_log
    from rig.formats.export import import_run
    from rig.formats.foreign_table import import_table
    from rig.formats.mapping import load_mapping
    from rig.plan.setup import load_setup

    if fmu:
        if config is not None or rebound is not None:
            raise InputError("--config and --rebound: expected none of them with --fmu")
        _import_model(source, mapping, mass_kg, out)
        return
    if mass_kg is not None:
        raise InputError("--mass-kg: expected --fmu with it")
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


def _import_model(source: Path, mapping: Path | None, mass_kg: float | None, out: Path) -> None:
    """Make a model of an FMU."""
    from rig.fmu.import_fmu import MODEL_FILE, import_fmu

    if mass_kg is not None and not 0.0 < mass_kg < float("inf"):
        raise InputError(f"--mass-kg {mass_kg}: expected a mass")
    model = import_fmu(source, mapping, mass_kg, out)
    (strut,) = model.struts
    given = {} if strut.fmu is None else strut.fmu.model_dump(exclude_none=True, mode="json")
    for key in ("height", "velocity", "force", "acceleration", "temperature", "applied_force"):
        if key in given:
            console.print(f"{key}: {given[key]}", markup=False)
    if "acceleration" in given:
        console.print(f"mass: {given['mass_kg']:.6g} kg along the height, from the FMU")
    console.print(f"Model: {out / MODEL_FILE}", markup=False)


def _refuse_without_meaning(source: Path) -> None:
    """Refuse a table, or a folder of tables, whose columns nobody told the meaning of."""
    from rig.formats.mts import is_mts

    if is_mts(source):
        raise InputError(f"{source}: a file of MTS, expected --rebound positive or negative")
    if source.is_dir() and not any(source.glob("*.parquet")):
        raise InputError(f"{source}: a folder of tables, expected --mapping FILE or --rebound")


def _import_folder(source: Path, out: Path, mapping_of: "Callable[[Path], Mapping]") -> None:
    """Import every file of a folder; exit code 2 if one is refused."""
    from rig.formats.folder import import_folder

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
    from rig.formats.mts import is_mts, mts_mapping

    if rebound not in ("positive", "negative"):
        raise InputError(f"--rebound {rebound!r}: expected positive or negative")
    if not is_mts(source):
        raise InputError(f"{source}: is no file of MTS, expected --mapping FILE")
    return mts_mapping(source, "positive" if rebound == "positive" else "negative")


EXPORT_EXAMPLES = (
    "Examples: `rig export runs/7 --format mf4 --out run.mf4` · "
    "`rig export runs/7 --format candump --out run.log` · "
    "`rig export runs/7 --format csv --smoothed --out run.csv` · "
    "`rig export out/corrected.yaml --fmu --out strut.fmu` · "
    "`rig export out/corrected.yaml --fmu --bench --fmi 3.0 --out bench.fmu`"
)


def export_command(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="Folder of a run; with --fmu a model file.")
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="PATH", help="New file; for Parquet a folder.")
    ],
    kind: Annotated[
        str | None, typer.Option("--format", help="Of a run: mf4, parquet, csv or candump.")
    ] = None,
    smoothed: Annotated[
        bool,
        typer.Option(
            "--smoothed",
            help="With --format csv: also the forces smoothed over the whole run.",
        ),
    ] = False,
    fmu: Annotated[
        bool, typer.Option("--fmu", help="A strut of a model as a functional mock-up unit.")
    ] = False,
    fmi: Annotated[str, typer.Option("--fmi", help="With --fmu: 2.0 or 3.0.")] = "2.0",
    strut: Annotated[
        str | None, typer.Option("--strut", help="With --fmu: which strut, if there are several.")
    ] = None,
    bench: Annotated[
        bool,
        typer.Option("--bench", help="With --fmu: the whole bench, if one guided degree moves."),
    ] = False,
) -> None:
    """Write a run or a model for other programs.

    A run becomes MF4, Parquet, CSV or candump; a model, with --fmu, a functional mock-up unit for
    Model Exchange and Co-Simulation, with its C sources and with binaries for Linux, Windows and
    macOS.
    """
    if fmu == (kind is not None):
        raise InputError("--format and --fmu: expected one of them")
    if smoothed and fmu:
        raise InputError("--smoothed: expected --format csv with it")
    if fmu:
        _export_model(source, out, fmi, strut, bench)
        return
    if bench or strut is not None:
        raise InputError("--bench and --strut: expected --fmu with them")
    for path in _export_run(source, kind or "", out, smoothed):
        console.print(f"Written: {path}", markup=False)


def _export_run(source: Path, kind: str, out: Path, smoothed: bool) -> list[Path]:
    """Write a run in another format."""
    from rig.formats.export import export_run

    if not smoothed:
        return export_run(source, kind, out)
    if kind != "csv":
        raise InputError("--smoothed: expected --format csv: the others are read back as they were")
    from rig.formats.smoothed import read_smoothed

    with progress_bar() as bar:
        return export_run(source, kind, out, lambda folder: read_smoothed(folder, bar))


def _export_model(source: Path, out: Path, fmi: str, strut: str | None, bench: bool) -> None:
    """Write a model as an FMU."""
    from dart_model.spec import load_model
    from rig.fmu.export import export_fmu

    if bench and strut is not None:
        raise InputError("--bench and --strut: expected one of them")
    spec = load_model(source)
    with console.status("compiling") as status:
        made = export_fmu(
            spec, out, fmi, strut, bench, lambda target: status.update(f"{target} compiled")
        )
    console.print(made.meaning, markup=False)
    for kind in ("input", "state", "output"):
        names = [item.name for _, item in made.of(kind)]
        console.print(f"{kind}s: {', '.join(names) or 'none'}", markup=False)
    console.print(f"Written: {out}", markup=False)
