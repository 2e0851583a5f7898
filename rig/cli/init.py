"""`rig init`."""

from pathlib import Path
from typing import Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.terminal import print_text, refuse_existing

EXAMPLES = "Example: `rig init --dbc my.dbc --out my.yaml`, then `rig zero my.yaml --length-m 0.36`"


def init(
    dbc: Annotated[Path, typer.Option(metavar="FILE", help="DBC of the bench's bus.")],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="New file in the DBC's folder; printed if absent."),
    ] = None,
) -> None:
    """Propose a configuration from a DBC: height, forces, temperature, and where to publish."""
    from can_dbc.database import load_database
    from rig.plan.proposal import propose

    text = propose(load_database(dbc))
    if out is None:
        typer.echo(text, nl=False)
        return
    refuse_existing(out, option="--out ")
    if out.resolve().parent != dbc.resolve().parent:
        raise InputError(f"--out {out}: expected a file in the folder of {dbc}")
    try:
        out.write_text(text, "utf-8")
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written: {error.strerror}") from error
    print_text(f"Written: {out}. Read it, and set bus and model.")
    print_text(f"Next, with the strut's length now: `rig zero {out} --length-m LENGTH`")
