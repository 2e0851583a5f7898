"""The `rig` command: arguments, printing and exit codes.

What a command needs is imported when it runs: DART, numba and matplotlib take seconds, and nobody
who asks for help should wait for them.
"""

import contextlib
import itertools
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Generator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from can_dbc.errors import DatabaseError
from dart_model.yaml_file import InputError

if TYPE_CHECKING:
    from rig.core.types import Mode
    from rig.demo import Case
    from rig.diagnosis.outcome import Diagnosis
    from rig.runs import Ended

OK, FAILED, WRONG_INPUT = 0, 1, 2
STORY = "story"
_REFRESH_NS = 200_000_000

app = typer.Typer(
    name="rig",
    help="Bridge between a shock-absorber bench on CAN and a DART multibody model.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
console = Console()

ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML file.")]


def main() -> None:
    """Run the command; a wrong input is one line on standard error and exit code 2."""
    try:
        app()
    except (ValueError, OSError) as error:
        if not _is_of_input(error):
            raise
        Console(stderr=True).print(f"rig: {error}", style="red", markup=False, soft_wrap=True)
        sys.exit(WRONG_INPUT)


def _is_of_input(error: Exception) -> bool:
    """Whether the user's input is at fault, and not the program."""
    if isinstance(error, (InputError, DatabaseError)):
        return True
    from rig.bench.schema import BenchConfigError
    from rig.diagnosis.recording import RecordingError
    from rig.io.bus import BusError

    return isinstance(error, (BenchConfigError, BusError, RecordingError))


@app.command(
    epilog="Examples: `rig demo` · `rig demo --seed 7` · "
    "`rig demo --case seed --lockstep --out /tmp/seed`"
)
def demo(
    case: Annotated[
        str,
        typer.Option(help=f"{STORY}: the whole story; or a plain case: seed, quarter_car, dyno."),
    ] = STORY,
    seed: Annotated[
        int, typer.Option(min=0, help="Draws the effect that the story's bench carries.")
    ] = 1,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder to write into; rig-demo by default."),
    ] = None,
    lockstep: Annotated[
        bool, typer.Option("--lockstep", help="Simulated time, as fast as the machine allows.")
    ] = False,
    duration_s: Annotated[
        float | None, typer.Option("--duration-s", min=1.0, help="Length of a run in s.")
    ] = None,
) -> None:
    """Run a simulated bench and the bridge on this machine, over virtual CAN.

    The story: a bench with an effect that nobody declared, logged by the bridge, diagnosed,
    corrected, and run again.
    """
    from rig.demo import CASES, run_case

    if case not in (STORY, *CASES):
        raise InputError(f"--case {case!r}: expected one of {', '.join((STORY, *CASES))}")
    out = out or _free_folder("rig-demo")
    _refuse_full(out)
    if case == STORY:
        _tell(seed, out, lockstep=lockstep, duration_s=duration_s)
        return
    with _stoppable() as stop, _progress(duration_s) as progress:
        done = run_case(
            case, out, lockstep=lockstep, duration_s=duration_s, stop=stop, progress=progress
        )
    _print_case(done)
    _print_ended(done.run, with_timing=not lockstep)
    console.print(f"Written: {out}/summary.json, a picture of each strut, and the run {out}/run")


def _tell(seed: int, out: Path, *, lockstep: bool, duration_s: float | None) -> None:
    from rig.story import tell

    with _stoppable() as stop, _progress(duration_s) as progress, _bar() as bar:
        story = tell(
            seed,
            out,
            duration_s=duration_s,
            lockstep=lockstep,
            stop=stop,
            chapter=lambda text: console.print(f"- {text}"),
            progress=progress,
            diagnosis_progress=bar,
        )
    _print_ended(story.first_run, with_timing=not lockstep)
    _print_diagnosis(story.diagnosis, struts=1)
    before, after = story.virtual_force_rms_n
    parameters = ", ".join(f"{key} {value:.4g}" for key, value in story.effect.parameters.items())
    console.print(
        f"On a fresh run the virtual force falls from {before:.2f} N to {after:.2f} N RMS.\n"
        f"What the bench carried, and nobody had told the diagnosis: {story.effect.name} "
        f"(family {story.family}): {parameters}.\n"
        f"Report: {out}/diagnosis/report.html"
    )


@app.command(
    name="diagnose",
    epilog="Example: `rig diagnose runs/7 --model bench.yaml --held-out runs/8 --out found`",
)
def diagnose_command(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="Folders of runs, or CSV files.")
    ],
    model: Annotated[
        str,
        typer.Option("--model", metavar="MODEL", help="Model file, or the name of a shipped one."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write into.")],
    held_out: Annotated[
        list[Path] | None,
        typer.Option("--held-out", metavar="RUN", help="Run to judge on; once for each."),
    ] = None,
) -> None:
    """Trace what the model lacks to named effects, correct it, and judge it on other data."""
    from dart_model.spec import load_model, model_file
    from rig.diagnosis.command import diagnose_runs
    from rig.pages.report import write_report

    spec = load_model(model_file(model, Path()))
    with _bar() as bar:
        result = diagnose_runs(runs, spec, held_out or [], out, bar)
        write_report(result, out / "report.html")
    _print_diagnosis(result.diagnosis, struts=len(spec.struts))
    console.print(f"Written: {out}/diagnosis.json, {out}/corrected.yaml, {out}/report.html")


@app.command(epilog="Examples: `rig run rig.yaml` · `rig run rig.yaml --out runs/7 --listen-only`")
def run(
    config: ConfigFile,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="Folder of the run; by default runs/ and the time."
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            metavar="MODEL",
            help="Another model than the configuration's, e.g. a corrected one.",
        ),
    ] = None,
    duration_s: Annotated[
        float | None,
        typer.Option(
            "--duration-s",
            min=0.001,
            help="Length of the run in s; else the configuration's, or until Ctrl-C.",
        ),
    ] = None,
    listen_only: Annotated[bool, typer.Option("--listen-only", help="Send nothing.")] = False,
) -> None:
    """Run the bridge on a bus; Ctrl-C ends it in order."""
    from rig.config import load_setup
    from rig.core.types import Mode
    from rig.runs import live

    ready = load_setup(config, model=model, duration_s=duration_s)
    folder = out or Path("runs") / time.strftime("%Y-%m-%d_%H-%M-%S")
    with _stoppable() as stop, _progress(ready.config.duration_s) as progress:
        ended = live(ready, folder, listen_only=listen_only, stop=stop, progress=progress)
    _print_ended(ended, with_timing=True)
    (folder / "summary.json").write_text(json.dumps(ended.summary(), indent=2) + "\n", "utf-8")
    console.print(f"Run: {folder}")
    if ended.state.rig.mode is Mode.SAFE:
        console.print("The run ended in its safe state.", style="red")
        raise typer.Exit(FAILED)


@app.command(
    epilog="Examples: `rig bench seed_bench.yaml --interface socketcan --channel vcan0` · "
    "`rig bench seed_bench.yaml --bridge rig.yaml --out runs/bench`"
)
def bench(
    config: ConfigFile,
    interface: Annotated[
        str, typer.Option(help="python-can's name of the interface.")
    ] = "socketcan",
    channel: Annotated[str, typer.Option(help="Channel of the interface.")] = "vcan0",
    bitrate: Annotated[int, typer.Option(min=1, help="Bit rate in bit/s.")] = 1_000_000,
    dbc: Annotated[
        Path | None, typer.Option(metavar="FILE", help="DBC; the package's own by default.")
    ] = None,
    duration_s: Annotated[
        float | None,
        typer.Option("--duration-s", min=0.001, help="Length in s; until Ctrl-C by default."),
    ] = None,
    bridge: Annotated[
        Path | None,
        typer.Option(
            "--bridge",
            metavar="FILE",
            help="Take bus, DBC and authentication from a bridge's configuration instead.",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write summary.json there.")
    ] = None,
) -> None:
    """Run a simulated bench on a bus, in real time."""
    from rig.bench.config import load_bench_config
    from rig.config import load_authentication, load_setup
    from rig.io.bus import BusConfig
    from rig.runs import run_bench

    bench_config = load_bench_config(config)
    bus, authentication = BusConfig(interface, channel, bitrate), None
    if bridge is not None:
        ready = load_setup(bridge)
        bus, dbc = ready.config.bus.config(), ready.database.path
        authentication = load_authentication(ready)
    with _stoppable() as stop, _progress(duration_s) as progress:
        sent = run_bench(
            bench_config,
            bus,
            dbc,
            authentication=authentication,
            duration_s=duration_s,
            stop=stop,
            progress=progress,
        )
    console.print(f"Sent {sent} frames.")
    if out is not None:
        _write_summary(out, {"bench": bench_config.name, "frames": sent})


@app.command(name="check", epilog="Example: `rig check rig.yaml`")
def check_command(
    config: ConfigFile,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write summary.json there.")
    ] = None,
) -> None:
    """Say what is wrong before a bench moves: signals, units, rate, bus load, poles."""
    from rig.check import Severity, check
    from rig.config import load_setup

    findings = check(load_setup(config))
    table = Table("", "What", "Finding", title=f"Check of {config}")
    styles = {Severity.OK: "green", Severity.WARNING: "yellow", Severity.ERROR: "red"}
    for finding in findings:
        style = styles[finding.severity]
        table.add_row(f"[{style}]{finding.severity.value}[/]", finding.what, finding.text)
    console.print(table)
    if out is not None:
        _write_summary(out, {"findings": [finding.as_dict() for finding in findings]})
    if any(finding.severity is Severity.ERROR for finding in findings):
        raise typer.Exit(FAILED)


@app.command(name="replay", epilog="Example: `rig replay rig-demo/run`")
def replay_command(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write summary.json there.")
    ] = None,
) -> None:
    """Compute a run again from its frames and compare it with its log, bit for bit."""
    from rig.replay import replay

    with _progress(None) as progress:
        result = replay(folder, progress=progress)
    summary: dict[str, object] = {
        "ticks": result.steps.num_rows,
        "logged_ticks": result.logged,
        "different_ticks": result.different,
        "first_different_ns": result.first_different_ns,
        "refused_frames": result.refused_frames,
    }
    table = Table("Replay", str(folder))
    for name, value in summary.items():
        table.add_row(name.replace("_", " "), "-" if value is None else str(value))
    console.print(table)
    if out is not None:
        _write_summary(out, summary)
    if result.different:
        console.print("The replay differs from the log.", style="red")
        raise typer.Exit(FAILED)


@app.command(
    name="import",
    epilog="Examples: `rig import bench.txt --mapping bench.yaml --out bench.csv` · "
    "`rig import bus.blf --config rig.yaml --out runs/9` · `rig import run.mf4 --out runs/10`",
)
def import_command(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="Table, bus log or export.")],
    out: Annotated[
        Path, typer.Option("--out", metavar="PATH", help="CSV file, or folder of the run.")
    ],
    mapping: Annotated[
        Path | None,
        typer.Option("--mapping", metavar="FILE", help="Columns and units of a foreign table."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", metavar="FILE", help="Signals of a bus log, with its DBC."),
    ] = None,
) -> None:
    """Make a CSV of a foreign table, or a run of a bus log or of an export.

    A table wants --mapping, a bus log (BLF, ASC, candump, TRC, MF4) --config; what `rig export`
    wrote wants neither.
    """
    from rig.config import load_setup
    from rig.export import import_run
    from rig.imports import import_log, import_table, load_mapping

    if mapping is not None and config is not None:
        raise InputError("--mapping and --config: expected one of them")
    if mapping is not None:
        report = import_table(source, load_mapping(mapping), out)
    elif config is not None:
        with _progress(None) as progress:
            report = import_log(source, load_setup(config), out, progress)
    else:
        import_run(source, out)
        console.print(f"Run: {out}")
        return
    console.print(
        f"{report.samples} samples, {report.duration_s:.3f} s at {report.rate_hz:g} a second: "
        f"{', '.join(report.columns)}"
    )
    for line in report.assumptions:
        console.print(f"- {line}", markup=False)
    console.print(f"Written: {report.out}")


@app.command(
    name="export",
    epilog="Examples: `rig export runs/7 --format mf4 --out run.mf4` · "
    "`rig export runs/7 --format candump --out run.log`",
)
def export_command(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")],
    out: Annotated[
        Path, typer.Option("--out", metavar="PATH", help="New file; for Parquet a folder.")
    ],
    kind: Annotated[str, typer.Option("--format", help="One of mf4, parquet, csv, candump.")],
) -> None:
    """Write a run for other programs: MF4, Parquet, CSV or candump."""
    from rig.export import export_run

    for path in export_run(folder, kind, out):
        console.print(f"Written: {path}")


@app.command(
    name="scoreboard",
    epilog="Example: `rig scoreboard --data measured --set emps --out scores`",
)
def scoreboard_command(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write into.")],
    data: Annotated[
        Path | None,
        typer.Option(
            "--data",
            metavar="DIR",
            help="Folder with folders silverbox, emps, brfd, mr_damper, any of them.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME", help="Only this set; may be given several times."),
    ] = None,
) -> None:
    """Diagnose published measured sets and print our figures beside the published ones."""
    from rig.scoreboard.run import run_scoreboard

    with _bar() as bar:
        rows = run_scoreboard(data, out, bar, only or ())
    table = Table("set", "test", "model", "figure", "source", title="Measured sets")
    for row in rows:
        figure = "-" if row.value is None else f"{row.value:.4g} {row.unit}"
        table.add_row(row.dataset, row.test, row.model, figure, row.source)
    console.print(table)
    console.print(f"Written: {out}/scoreboard.csv, {out}/scoreboard.md")


@contextlib.contextmanager
def _stoppable() -> Generator[Callable[[], bool]]:
    """Ctrl-C and SIGTERM ask the loop to end in order instead of breaking it off."""
    asked = False

    def ask(_number: int, _frame: FrameType | None) -> None:
        nonlocal asked
        asked = True

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _bar() -> Generator[Callable[[str, float], None]]:
    """A bar for the diagnosis, which has no tick to miss."""
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    shown = Console(stderr=True)
    # Where it cannot be rewritten it would leave an empty line behind.
    with Progress(*columns, console=shown, transient=True, disable=not shown.is_terminal) as bars:
        task = bars.add_task("diagnosis", total=1.0, visible=False)

        def show(what: str, share: float) -> None:
            bars.update(task, description=what, completed=share, visible=share < 1.0)

        yield show


@contextlib.contextmanager
def _progress(duration_s: float | None) -> Generator[Callable[[int, "Mode"], None]]:
    """One line that is rewritten; a single write, because the loop itself calls it."""
    shown = sys.stderr.isatty()
    due_ns = 0
    total = "" if duration_s is None else f" of {duration_s:g} s"

    def show(t_ns: int, mode: "Mode") -> None:
        nonlocal due_ns
        if shown and t_ns >= due_ns:
            due_ns = t_ns + _REFRESH_NS
            os.write(2, f"\r{t_ns * 1e-9:9.1f} s{total}  {mode.name:<8}".encode())

    try:
        yield show
    finally:
        if shown:
            os.write(2, b"\r\x1b[K")


def _free_folder(name: str) -> Path:
    """`name`, or with the first number that makes it new."""
    numbered = (Path(f"{name}-{number}") for number in itertools.count(2))
    return next(path for path in itertools.chain([Path(name)], numbered) if not path.exists())


def _refuse_full(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"--out {folder}: is not empty, expected a new or an empty folder")


def _write_summary(folder: Path, summary: dict[str, object]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", "utf-8")
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be written: {error.strerror}") from error


def _print_case(case: "Case") -> None:
    for strut in case.struts:
        table = Table(
            "after the first 0.5 s",
            "model alone",
            "with virtual force",
            title=f"Bench and model, strut “{strut.name}”",
        )
        alone, observed = strut.figures(strut.defective), strut.figures(strut.observed)
        table.add_row(
            "height error, largest",
            f"{alone.height_error_max_m * 1e3:.3f} mm",
            f"{observed.height_error_max_m * 1e3:.3f} mm",
        )
        for name, label in (("force_error_rms_n", "RMS"), ("force_error_max_n", "largest")):
            table.add_row(
                f"force error, {label}",
                *(_share(getattr(item, name), item.force_peak_n) for item in (alone, observed)),
            )
        table.add_row("force of the bench, peak", f"{alone.force_peak_n:.1f} N", "")
        console.print(table)


def _print_diagnosis(diagnosis: "Diagnosis", *, struts: int) -> None:
    from rig.pages.report import sentence

    console.print(f"\n[bold]{diagnosis.verdict.replace('_', ' ')}[/]: ", end="")
    console.print(sentence(diagnosis, struts), markup=False)
    _print_linear(diagnosis, struts=struts)
    _print_effects(diagnosis)
    _print_held_out(diagnosis)
    for note in diagnosis.notes:
        console.print(f"- {note}", markup=False)


def _print_linear(diagnosis: "Diagnosis", *, struts: int) -> None:
    from rig.pages.report.tables import linear

    if diagnosis.linear:
        table = Table(
            "linear correction", "nominal", "corrected", "95 % interval", "", title="Linear part"
        )
        for name, _, strut, *cells in linear(diagnosis):
            table.add_row(f"{name} ({strut})" if struts > 1 else name, *cells)
        console.print(table)


def _print_effects(diagnosis: "Diagnosis") -> None:
    from rig.pages.report.tables import effects, existing

    missing, changed = effects(diagnosis), existing(diagnosis)
    if missing:
        table = Table("effect", "parameter", "value", "95 % interval", title="What is missing")
        for law, _, rows in missing:
            for *_, value, interval, _, key in rows:
                table.add_row(f"{law.family}: {law.name}", key, value, interval)
        console.print(table)
    for law, note, rows in changed:
        values = [f"{key} {before} → {value}" for _, before, value, _, _, key in rows]
        console.print(f"- {law.name}, {'; '.join((note, *values))}", markup=False)


def _print_held_out(diagnosis: "Diagnosis") -> None:
    from rig.pages.report.tables import errors

    table = Table("on held-out data", "before", "after", "noise floor", title="RMS error")
    for name, before, after, _, floor, _ in errors(diagnosis):
        table.add_row(name[:1].lower() + name[1:], before, after, floor)
    console.print(table)


def _share(force_n: float, peak_n: float) -> str:
    return f"{force_n:.2f} N ({force_n / peak_n:.2%} of peak)"


def _print_ended(ended: "Ended", *, with_timing: bool) -> None:
    table = Table("Run", f"{ended.ticks} ticks, ended {ended.state.rig.mode.name}")
    for name, value in ended.state.counts._asdict().items():
        if value or name in ("lost", "refused", "overruns"):
            what = "ticks" if name in ("stale", "overruns") else "frames"
            table.add_row(f"{name.replace('_', ' ')} ({what})", str(value))
    if with_timing:
        timing = ended.timing
        for label, figures in (("lateness", timing.lateness_us()), ("work", timing.work_us())):
            text = " · ".join(f"{level} {value:.0f}" for level, value in figures.items())
            table.add_row(f"{label} of a tick, µs", text)
        table.add_row("longest gap, µs", f"{timing.extremes_ns[2] / 1000:.0f}")
    if ended.log_fault is not None:
        table.add_row("log", f"[red]{ended.log_fault}[/]")
    console.print(table)
    if with_timing:
        _draw_timing(ended)


def _draw_timing(ended: "Ended") -> None:
    from rig.timing_picture import draw_run

    try:
        console.print(f"Histograms of lateness and work: {draw_run(ended)}")
    except OSError as error:  # a disk that is full takes no picture, and the run is over anyway
        console.print(f"No histograms: {error.strerror}", style="yellow")
