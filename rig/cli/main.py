"""The command line: every command, and the exit codes of wrong inputs and interruptions."""

import platform
import sys
from typing import Annotated, cast

import typer
from rich.console import Console

from can_dbc.errors import InputError
from rig.cli import (
    bench,
    characterise,
    check,
    compare,
    demo,
    diagnose,
    docs,
    export,
    fleet,
    import_,
    init,
    replay,
    report,
    run,
    sensor,
    timing,
    tune,
    view,
    zero,
)
from rig.cli import set as set_
from rig.cli.terminal import FAILED, OK, WRONG_INPUT, escape_controls
from rig.log.errors import DamageError
from rig.machine.installed_versions import version_of

__all__ = ["app", "main"]

_GROUPS = ("sensor", "fleet")
"""Groups of commands."""

app = typer.Typer(
    name="rig",
    help="Bridge between a shock-absorber bench on CAN and a DART multibody model.",
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
app.command("demo", epilog=demo.EXAMPLES)(demo.demo)
app.command("init", epilog=init.EXAMPLES)(init.init)
app.command("zero", epilog=zero.EXAMPLES)(zero.zero_command)
app.command("check", epilog=check.EXAMPLES)(check.check_command)
app.add_typer(sensor.app, name=_GROUPS[0])
app.command("run", epilog=run.EXAMPLES)(run.run)
app.command("bench", epilog=bench.EXAMPLES)(bench.bench)
app.command("view", epilog=view.EXAMPLES)(view.view)
app.command("set", epilog=set_.EXAMPLES)(set_.set_command)
app.command("tune", epilog=tune.EXAMPLES)(tune.tune_command)
app.command("characterise", epilog=characterise.EXAMPLES)(characterise.characterise_command)
app.command("compare", epilog=compare.EXAMPLES)(compare.compare_command)
app.command("timing", epilog=timing.EXAMPLES)(timing.timing)
app.command("replay", epilog=replay.EXAMPLES)(replay.replay_command)
app.command("diagnose", epilog=diagnose.EXAMPLES)(diagnose.diagnose)
app.add_typer(fleet.app, name=_GROUPS[1])
app.command("import", epilog=import_.EXAMPLES)(import_.import_command)
app.command("export", epilog=export.EXAMPLES)(export.export_command)
app.command("docs", epilog=docs.EXAMPLES)(docs.docs)
app.command("report", epilog=report.EXAMPLES)(report.report)


def _show_version(is_requested: bool) -> None:
    if is_requested:
        for name in ("rig", "dartpy", "python-can", "numpy"):
            typer.echo(f"{name} {version_of(name)}")
        typer.echo(f"Python {platform.python_version()}")
        raise typer.Exit


@app.callback()
def _options(
    *,
    _version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_show_version,
            is_eager=True,
            help="Versions of rig and of the packages it uses.",
        ),
    ] = False,
) -> None:
    """Options that stand before a command."""


_INTERRUPTED = 130
"""Exit code of a program that Ctrl-C ended: 128 and the number of SIGINT."""


# Typer includes click and exports only this one of click's errors.
_UsageError = cast(
    "type[typer.BadParameter]",
    next(base for base in typer.BadParameter.__mro__ if base.__name__ == "UsageError"),
)


def main() -> None:
    """Run the command; a wrong input is one line on standard error and exit code 2."""
    if sys.argv[1:] in ([], *([name] for name in _GROUPS)):
        sys.argv.append("--help")
    try:
        ended = app(standalone_mode=False)
    except DamageError as error:
        _print_error(str(error))
        sys.exit(FAILED)
    except InputError as error:
        _refuse(str(error))
    except OSError as error:
        if error.filename is None:
            raise
        _refuse(f"{error.filename}: {error.strerror}")
    except (KeyboardInterrupt, typer.Abort):
        _print_error("interrupted")
        sys.exit(_INTERRUPTED)
    except _UsageError as error:
        _refuse(error.format_message())
    else:
        sys.exit(ended if isinstance(ended, int) else OK)


def _refuse(why: str) -> None:
    _print_error(why)
    sys.exit(WRONG_INPUT)


def _print_error(text: str) -> None:
    # A name from outside may hold line breaks and control characters.
    line = escape_controls(" ".join(text.splitlines()))
    Console(stderr=True).print(f"rig: {line}", style="red", markup=False, soft_wrap=True)
