"""`rig set`."""

from pathlib import Path
from typing import Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.terminal import console

EXAMPLES = (
    "Examples: `rig set runs/7 observers.strut.proportional_n_per_m=2e5` · "
    "`rig set runs/7 --acknowledge`"
)


def set_command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run in progress.")],
    assignments: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[KEY=VALUE...]",
            help="Keys of the configuration under observers or supervision.",
        ),
    ] = None,
    acknowledge: Annotated[
        bool, typer.Option("--acknowledge", help="Acknowledge the safe state.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Change it although `rig check` finds an error.")
    ] = False,
) -> None:
    """Change gains or limits of a run in progress, or acknowledge its safe state."""
    from rig.run.change_requests import ask
    from rig.run.changed_settings import parse_assignments

    if acknowledge == bool(assignments):
        raise InputError("rig set: expected KEY=VALUE, or --acknowledge")
    if acknowledge:
        ask(run, {"acknowledge": True})
        console.print("Acknowledged.")
        return
    found = ask(run, {"set": parse_assignments(assignments or ())}, force=force)
    console.print(f"Changed from {found.get('t_ns', 0) * 1e-9:.3f} s on.")
