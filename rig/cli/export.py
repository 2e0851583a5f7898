"""`rig export`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from can_dbc.errors import InputError
from rig.cli.added_sensors import ADDED_HELP, read_sensors
from rig.cli.progress import progress_bar
from rig.cli.terminal import JsonFlag, print_json, print_text

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rig.log.reader import RunFolder
    from rig.plan.config import VirtualSensorConfig

EXAMPLES = (
    "Examples: `rig export runs/7 --format mf4 --out run.mf4` · "
    "`rig export runs/7 --format candump --out run.log` · "
    "`rig export runs/7 --format csv --smoothed --out run.csv` · "
    "`rig export out/corrected.yaml --fmu --out strut.fmu` · "
    "`rig export out/corrected.yaml --fmu --bench --fmi 3.0 --out bench.fmu` · "
    "`rig export out/corrected.yaml --fmu --bench --add 'seat: {acceleration_of: body}' --out "
    "bench.fmu`"
)


_Added = Annotated[
    list[str] | None,
    typer.Option(
        "--add",
        metavar="SENSOR",
        help=f"With --bench: virtual sensor that is an output of the FMU: {ADDED_HELP}",
    ),
]


def export_command(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="Folder of a run; with --fmu a model file.")
    ],
    out: Annotated[
        Path, typer.Option(metavar="PATH", help="New file; with --format parquet, a new folder.")
    ],
    kind: Annotated[
        str | None,
        typer.Option(
            "--format", metavar="FORMAT", help="Format for a run: mf4, parquet, csv or candump."
        ),
    ] = None,
    smoothed: Annotated[
        bool,
        typer.Option(
            "--smoothed",
            help="With --format csv: add the force of each strut, smoothed over the whole run.",
        ),
    ] = False,
    fmu: Annotated[
        bool,
        typer.Option("--fmu", help="Export a strut of a model as a functional mock-up unit (FMU)."),
    ] = False,
    fmi: Annotated[
        str, typer.Option(metavar="VERSION", help="With --fmu: version of FMI, 2.0 or 3.0.")
    ] = "2.0",
    strut: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="With --fmu: strut to export, if there are several."),
    ] = None,
    bench: Annotated[
        bool,
        typer.Option(
            "--bench",
            help="With --fmu: export the whole bench; it must have one guided degree of freedom.",
        ),
    ] = False,
    add: _Added = None,
    as_json: JsonFlag = False,
) -> None:
    """Export a run or a model to other programs.

    A run is written as MF4, Parquet, CSV or candump. With --fmu, a model is written as a functional
    mock-up unit for Model Exchange and Co-Simulation, with its C sources and with binaries for
    Linux, Windows and macOS.
    """
    if fmu == (kind is not None):
        raise InputError("--format and --fmu: expected one of them")
    if smoothed and kind != "csv":
        raise InputError(
            "--smoothed: expected --format csv with it: the other formats are read back as runs"
        )
    if add and not bench:
        raise InputError("--add: expected --fmu --bench with it; for a run use rig replay --add")
    if fmu:
        if bench and strut is not None:
            raise InputError("--bench and --strut: expected one of them")
        _export_model(source, out, fmi, strut, bench, read_sensors(add or []), as_json=as_json)
        return
    if bench or strut is not None:
        raise InputError("--bench and --strut: expected --fmu with them")
    from rig.log.checksums import find_damage, refuse_damage

    paths, differences_n = _export_run(source, kind or "", out, smoothed)
    written = [str(path) for path in paths]
    if as_json:
        compared = {"rms_from_smoothed_n": differences_n} if smoothed else {}
        print_json({"written": written, **compared})
    else:
        for name, rms_n in differences_n.items():
            print_text(
                f"{name}: the estimate of the run differs from the smoothed force by {rms_n:.3g} N "
                "RMS while it is valid."
            )
        print_text("\n".join(f"Written: {path}" for path in written))
    refuse_damage(source, find_damage(source))


def _export_run(
    source: Path, kind: str, out: Path, smoothed: bool
) -> tuple[list[Path], dict[str, float]]:
    """What was written, and how far the estimates of the run are from its smoothed forces."""
    from rig.formats.export import export_run

    if not smoothed:
        return export_run(source, kind, out), {}
    from rig.formats.smoothed import compare_published, read_with_smoothed_forces

    differences_n: dict[str, float] = {}

    def read(folder: Path) -> "RunFolder":
        with progress_bar() as bar:
            run = read_with_smoothed_forces(folder, bar)
        differences_n.update(compare_published(run))
        return run

    return export_run(source, kind, out, read), differences_n


def _export_model(
    source: Path,
    out: Path,
    fmi: str,
    strut: str | None,
    bench: bool,
    sensors: "Mapping[str, VirtualSensorConfig]",
    *,
    as_json: bool,
) -> None:
    from dart_model.spec import load_model
    from rig.fmu.export import export_fmu

    spec = load_model(source)
    with Console(stderr=True).status("compiling") as status:
        component = export_fmu(
            spec,
            out,
            fmi,
            strut,
            bench,
            lambda target: status.update(f"{target} compiled"),
            sensors,
        )
    kinds = ("input", "state", "output")
    names = {f"{kind}s": [item.name for _, item in component.of(kind)] for kind in kinds}
    if as_json:
        print_json({"written": [str(out)], "meaning": component.meaning, **names})
        return
    print_text(component.meaning)
    for kind, of_kind in names.items():
        print_text(f"{kind}: {', '.join(of_kind) or 'none'}")
    print_text(f"Written: {out}")
