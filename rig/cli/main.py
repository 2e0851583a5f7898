"""The command line: every command, and the exit codes of wrong inputs and interruptions."""

import platform
import re
import sys
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, cast

import typer
from rich.console import Console

from can_dbc.errors import InputError, expected_name
from rig.cli import (
    bench,
    characterise,
    check,
    compare,
    demo,
    diagnose,
    docs,
    evaluate,
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
from rig.cli.plain_help import PlainCommand, PlainGroup
from rig.cli.terminal import FAILED, OK, WRONG_INPUT, escape_controls
from rig.log.errors import DamageError
from rig.machine.installed_versions import version_of

__all__ = ["app", "main"]

_SET_UP, _RUN, _EVALUATE, _EXCHANGE = (
    "Set up a bench",
    "Run the bridge",
    "Evaluate",
    "Exchange and read",
)
"""Heads of the commands in the help."""

_GROUPS = {"sensor": (sensor.app, _SET_UP), "fleet": (fleet.app, _EVALUATE)}
"""Groups of commands, and their heads in the help."""

app = typer.Typer(
    name="rig",
    cls=PlainGroup,
    help="Bridge between a shock-absorber bench on CAN and a DART multibody model.",
    epilog="`rig docs guide` builds the guide; begin with its tutorial of your own bench.",
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
for _name, _function, _examples, _panel in (
    ("demo", demo.demo, demo.EXAMPLES, _RUN),
    ("init", init.init, init.EXAMPLES, _SET_UP),
    ("zero", zero.zero_command, zero.EXAMPLES, _SET_UP),
    ("check", check.check_command, check.EXAMPLES, _SET_UP),
    ("tune", tune.tune_command, tune.EXAMPLES, _SET_UP),
    ("run", run.run, run.EXAMPLES, _RUN),
    ("bench", bench.bench, bench.EXAMPLES, _RUN),
    ("view", view.view, view.EXAMPLES, _RUN),
    ("set", set_.set_command, set_.EXAMPLES, _RUN),
    ("diagnose", diagnose.diagnose, diagnose.EXAMPLES, _EVALUATE),
    ("evaluate", evaluate.evaluate_command, evaluate.EXAMPLES, _EVALUATE),
    ("characterise", characterise.characterise_command, characterise.EXAMPLES, _EVALUATE),
    ("compare", compare.compare_command, compare.EXAMPLES, _EVALUATE),
    ("report", report.report, report.EXAMPLES, _EVALUATE),
    ("replay", replay.replay_command, replay.EXAMPLES, _EVALUATE),
    ("timing", timing.timing, timing.EXAMPLES, _EVALUATE),
    ("import", import_.import_command, import_.EXAMPLES, _EXCHANGE),
    ("export", export.export_command, export.EXAMPLES, _EXCHANGE),
    ("docs", docs.docs, docs.EXAMPLES, _EXCHANGE),
):
    app.command(_name, epilog=_examples, rich_help_panel=_panel, cls=PlainCommand)(_function)
for _name, (_group, _panel) in _GROUPS.items():
    app.add_typer(_group, name=_name, rich_help_panel=_panel)


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
        _refuse(_name_value(error.format_message(), sys.argv[1:]))
    else:
        sys.exit(ended if isinstance(ended, int) else OK)


_INVALID = re.compile(
    r"Invalid value for '(?:[^']* / )?(--?[\w-]+|\[?[A-Z]+\]?)[^']*': (?:Input should be )?(.*)"
)


def _name_value(message: str, words: Sequence[str]) -> str:
    """A usage error with the value that is wrong, and what was expected."""
    unknown = re.fullmatch(r"No such command '(.*)'\.", message)
    if unknown is not None:
        name = unknown[1]
        return f"no command {name!r}, {expected_name(name, _commands(words))}"
    found = _INVALID.fullmatch(message)
    if found is None:
        return message
    option, expected = found[1].strip("[]"), found[2]
    expected = re.sub(r"^a valid (\w+),.*", r"a \1 alone, without a unit", expected)
    values = [after for word, after in pairwise(words) if word == option]
    value = f" {values[-1]}" if values else ""
    return f"{option}{value}: expected {expected}"


def _commands(words: Sequence[str]) -> list[str]:
    """Names of the commands, or of those of the group that was called."""
    called, _ = _GROUPS.get(words[0] if words else "", (app, ""))
    names = [str(item.name) for item in called.registered_commands]
    return names if called is not app else [*names, *_GROUPS]


def _refuse(why: str) -> None:
    _print_error(why)
    sys.exit(WRONG_INPUT)


def _print_error(text: str) -> None:
    # A name from outside may hold line breaks and control characters.
    line = escape_controls(" ".join(text.splitlines()))
    Console(stderr=True).print(f"rig: {line}", style="red", markup=False, soft_wrap=True)
