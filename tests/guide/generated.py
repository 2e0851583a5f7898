"""The generated parts of the guide, of the command line as it is."""

import typer

from rig.cli.docs import guide_blocks
from rig.cli.main import app
from rig.guide.site import Block


def blocks() -> dict[str, Block]:
    """Generated parts, by their names."""
    command = typer.main.get_command(app)
    return guide_blocks(typer.Context(command, info_name="rig"))
