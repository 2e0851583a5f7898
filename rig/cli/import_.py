"""`rig import`."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.progress import progress_line
from rig.cli.terminal import WRONG_INPUT, JsonFlag, console, print_json, print_text

if TYPE_CHECKING:
    from collections.abc import Callable

    from rig.formats.import_report import ImportReport
    from rig.formats.mapping import TableMapping

EXAMPLES = (
    "Examples: `rig import bench.txt --mapping bench.yaml --out bench.csv` · "
    "`rig import specimen.dat --rebound positive --out dyno.csv` · "
    "`rig import bus.blf --config rig.yaml --out runs/9` · `rig import run.mf4 --out runs/10` · "
    "`rig import strut.fmu --fmu --mass-kg 10 --out model`"
)


Rebound = Annotated[
    str | None,
    typer.Option(
        metavar="SIGN",
        help="Sign of the force in rebound, positive or negative, for an MTS file without "
        "--mapping; names and units are then those of the file.",
    ),
]
FmuFlag = Annotated[
    bool,
    typer.Option(
        "--fmu",
        help="Make a model from SOURCE, an FMU. --mapping assigns the variables to their roles; it "
        "is not required for an FMU of `rig export`.",
    ),
]


def import_command(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE", help="Table, folder of tables, bus log, exported run, or FMU."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="PATH",
            help="New CSV file for a table; new folder for a run, tables or a model.",
        ),
    ],
    mapping: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Mapping with the columns and units of a table."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Configuration with the DBC and signals of a bus log."),
    ] = None,
    rebound: Rebound = None,
    fmu: FmuFlag = False,
    mass_kg: Annotated[
        float | None,
        typer.Option(
            metavar="KG",
            help="With --fmu: mass that the strut carries; for the FMU of a whole bench, the "
            "moving mass, which is otherwise computed from the FMU.",
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Import a table as CSV, a bus log or an export as a run, or an FMU as a model.

    A table (text, XLSX, TDMS, MF4) requires --mapping; an MTS table requires either --mapping or
    --rebound. A bus log (BLF, ASC, candump, TRC, MF4) requires --config. A run that `rig export`
    wrote as MF4 or Parquet requires neither; a run that it wrote as CSV need not be imported. With
    --fmu, SOURCE is a functional mock-up unit (FMU). An FMU contains a program:
    importing the FMU permits this program to run on this machine.
    """
    if fmu:
        if config is not None or rebound is not None:
            raise InputError("--config and --rebound: expected none of them with --fmu")
        _import_model(source, mapping, mass_kg, out, as_json=as_json)
        return
    if mass_kg is not None:
        raise InputError("--mass-kg: expected --fmu with it")
    if sum(option is not None for option in (mapping, config, rebound)) > 1:
        raise InputError("--mapping, --config and --rebound: expected one of them")
    if config is not None:
        _import_bus_log(source, config, out, as_json=as_json)
    elif mapping is not None or rebound is not None:
        _import_tables(source, _mapping_finder(mapping, rebound or ""), out, as_json=as_json)
    else:
        from rig.formats.export import import_run

        import_run(source, out)
        if as_json:
            print_json({"run": str(out)})
        else:
            print_text(f"Run: {out}")


def _import_model(
    source: Path, mapping: Path | None, mass_kg: float | None, out: Path, *, as_json: bool
) -> None:
    from rig.fmu.import_fmu import MODEL_FILE, import_fmu, variables_of

    roles = import_fmu(source, mapping, mass_kg, out).struts[0].fmu
    if as_json:
        variables = {} if roles is None else variables_of(roles)
        carried_kg = None if roles is None or roles.acceleration is None else roles.mass_kg
        print_json({"model": str(out / MODEL_FILE), "variables": variables, "mass_kg": carried_kg})
        return
    if roles is not None:
        for role, variable in variables_of(roles).items():
            print_text(f"{role}: {variable}")
        if roles.acceleration is not None:
            console.print(f"mass: {roles.mass_kg:.6g} kg along the height, from the FMU")
    print_text(f"Model: {out / MODEL_FILE}")


def _import_bus_log(source: Path, config: Path, out: Path, *, as_json: bool) -> None:
    from rig.formats.bus_log import import_log
    from rig.plan.load import load_plan

    with progress_line(None) as progress:
        report = import_log(source, load_plan(config), out, progress)
    _print_report(report, as_json=as_json)


def _mapping_finder(mapping: Path | None, rebound: str) -> "Callable[[Path], TableMapping]":
    """The mapping of any file: the one that is given, or of an MTS file its own."""
    if mapping is None:
        from rig.formats.mts import mts_mapping

        return lambda path: mts_mapping(path, rebound)
    from rig.formats.mapping import load_mapping

    loaded = load_mapping(mapping)
    return lambda _: loaded


def _import_tables(
    source: Path,
    find_mapping: "Callable[[Path], TableMapping]",
    out: Path,
    *,
    as_json: bool,
) -> None:
    """Import a table, or every table of a folder; exit code 2 if one of these is refused."""
    from rig.formats.foreign_table import import_folder, import_table

    if not source.is_dir():
        _print_report(import_table(source, find_mapping(source), out), as_json=as_json)
        return
    refused: list[str] = []
    imported: list[dict[str, object]] = []
    for path, result in import_folder(source, find_mapping, out):
        if isinstance(result, InputError):
            refused.append(str(result))
            if not as_json:
                print_text(f"refused: {result}", style="red")
        else:
            imported.append(_as_dict(result))
            if not as_json:
                print_text(f"{path.name}: {result.samples} samples, {result.out}")
    if as_json:
        print_json({"imported": imported, "refused": refused})
    elif refused:
        print_text(f"{len(refused)} refused, the others are in {out}")
    if refused:
        raise typer.Exit(WRONG_INPUT)


def _as_dict(report: "ImportReport") -> dict[str, object]:
    return {**asdict(report), "out": str(report.out)}


def _print_report(report: "ImportReport", *, as_json: bool) -> None:
    if as_json:
        print_json(_as_dict(report))
        return
    console.print(
        f"{report.samples} samples, {report.duration_s:.3f} s at {report.rate_hz:g} a second: "
        f"{', '.join(report.columns)}"
    )
    for line in report.assumptions:
        print_text(f"- {line}")
    print_text(f"Written: {report.out}")
