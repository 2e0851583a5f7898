"""`rig docs`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from rig.cli.terminal import print_text

EXAMPLES = "Example: `rig docs reference`, then open reference/index.html"


def docs(
    context: typer.Context,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to write into.")],
) -> None:
    """Write the reference: every effect, every key of a configuration, every command."""
    from rig.guide.reference import write_reference

    texts = dict(_texts(context.parent))
    print_text(f"Written: {write_reference(folder, texts)}")


def _texts(parent: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Name and help of every command; the name of a command in a group begins with the group's."""
    for name in parent.command.list_commands(parent):
        command = parent.command.get_command(parent, name)
        if hasattr(command, "list_commands"):
            group = command.make_context(name, [], parent=parent, resilient_parsing=True)
            yield from _texts(group, f"{prefix}{name} ")
        else:
            yield f"{prefix}{name}", _help(parent, name)


def _help(parent: Any, name: str) -> str:
    """Usage, arguments and options of a command, as plain text."""
    command = parent.command.get_command(parent, name)
    made = command.make_context(name, [], parent=parent, resilient_parsing=True)
    lines = [command.get_usage(made), "", (command.help or "").strip(), ""]
    for parameter in command.get_params(made):
        record = parameter.get_help_record(made)
        name, text = record or (parameter.make_metavar(made), getattr(parameter, "help", "") or "")
        lines.append(f"  {name:34} {text}")
    return "\n".join(lines)
