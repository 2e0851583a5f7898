"""`rig docs`."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.terminal import EXIT_CODES, JsonFlag, print_json, print_text

if TYPE_CHECKING:
    from rig.guide.site import Block

EXAMPLES = "Example: `rig docs guide`, then open guide/index.html"


def docs(
    context: typer.Context,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="New folder of the site.")],
    as_json: JsonFlag = False,
) -> None:
    """Build the guide as a web site that works without a network.

    Requires the extra `guide`.
    """
    from rig.guide.site import build_site

    index = build_site(folder, guide_blocks(context.parent))
    if as_json:
        print_json({"written": str(index)})
    else:
        print_text(f"Written: {index}")


def guide_blocks(parent: Any) -> dict[str, "Block"]:
    """Generated parts of the guide, those of the command line of a context among them."""
    from rig.guide.reference import generated_blocks

    return generated_blocks(lambda: "\n\n".join(_commands(parent)), EXIT_CODES)


def _commands(parent: Any, prefix: str = "rig") -> Iterator[str]:
    """Markdown of every command: usage, help, arguments, options and examples."""
    for name in parent.command.list_commands(parent):
        command = parent.command.get_command(parent, name)
        made = command.make_context(name, [], parent=parent, resilient_parsing=True)
        if hasattr(command, "list_commands"):
            yield from _commands(made, f"{prefix} {name}")
        else:
            yield _command(f"{prefix} {name}", command, made)


def _command(name: str, command: Any, context: Any) -> str:
    """A command's part of the page."""
    rows: list[str] = []
    arguments: list[str] = []
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        shown, text = record or (parameter.make_metavar(context), parameter.help or "")
        if parameter.param_type_name == "argument":
            name_of_it = shown if parameter.required else f"[{shown}]"
            arguments.append(name_of_it if parameter.nargs == 1 else f"{name_of_it}...")
        rows.append(f"| `{shown}` | {text.replace('|', chr(92) + '|')} |")
    parts = [
        f"## {name}",
        f"    {' '.join((name, '[OPTIONS]', *arguments))}",
        (command.help or "").strip(),
        "\n".join(["| Argument or option | Meaning |", "| --- | --- |", *rows]),
        (command.epilog or "").strip(),
    ]
    return "\n\n".join(part for part in parts if part)
