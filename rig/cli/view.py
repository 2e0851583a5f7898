"""`rig view`."""

import secrets
import time
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.progress import stoppable
from rig.cli.terminal import console, print_text
from rig.log.file_names import RUN_FILE

EXAMPLES = (
    "Examples: `rig view runs/7` while it runs · `rig view before after --model corrected.yaml`"
)

_PORT, _FOXGLOVE_PORT = 8321, 8765


Port = Annotated[
    int | None,
    typer.Option(
        metavar="PORT",
        min=0,
        max=65535,
        help=f"Port on this machine; 0 takes a free one. {_PORT} by default, "
        f"{_FOXGLOVE_PORT} with --foxglove.",
    ),
]
ControlFlag = Annotated[
    bool,
    typer.Option(
        "--control",
        help="Let the page change gains and limits of a run in progress, acknowledge and arm, and "
        "start a diagnosis of a finished run. No browser is opened: open the printed address.",
    ),
]
FoxgloveFlag = Annotated[
    bool,
    typer.Option(
        "--foxglove",
        help="Publish the runs to Foxglove or Lichtblick instead of showing a page; requires the "
        "extra `foxglove`.",
    ),
]


def view(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN", help="Run folders.")],
    model: Annotated[
        list[str] | None,
        typer.Option(
            metavar="MODEL", help="Also draw the strut force of this model; may be repeated."
        ),
    ] = None,
    port: Port = None,
    control: ControlFlag = False,
    no_browser: Annotated[
        bool,
        typer.Option(
            "--no-browser", help="Print the address of the page without opening a browser."
        ),
    ] = False,
    foxglove: FoxgloveFlag = False,
) -> None:
    """Show runs in the browser, during the run or afterwards; Ctrl-C ends the program."""
    from dart_model.spec import load_named_model
    from rig.pages.view.server import ViewServer

    if foxglove:
        if control or model:
            raise InputError("--foxglove: expected neither --control nor --model with it")
        _publish(runs, _FOXGLOVE_PORT if port is None else port)
        return
    for run in runs:
        if run.is_file():
            raise InputError(f"{run}: is a file, expected a run's folder")
    models = {name: load_named_model(name, Path()) for name in model or ()}
    token = secrets.token_urlsafe(16) if control else None
    server = ViewServer(runs, models, _PORT if port is None else port, token)
    server.start_thread()
    # Behind the hash, which a browser never sends.
    address = server.address if token is None else f"{server.address}#{token}"
    console.print(f"{address} (on this machine only; Ctrl-C ends it)", soft_wrap=True)
    for run in runs:
        if not (run / RUN_FILE).exists():
            print_text(f"{run}: no run yet; the page shows it when it begins")
    # Every user of the machine can read a browser's command line, and the token on it.
    if not no_browser and token is None:
        webbrowser.open(address)
    with stoppable() as stop:
        while not stop():
            time.sleep(0.1)
    server.shutdown()
    server.server_close()


def _publish(runs: list[Path], port: int) -> None:
    from rig.pages.view.foxglove import FoxgloveView

    with stoppable() as stop:
        view = FoxgloveView(runs, port)
        console.print(
            f"{view.address} (open it in Foxglove or Lichtblick as a Foxglove WebSocket; on this "
            "machine only, to whoever connects; Ctrl-C ends it)",
            soft_wrap=True,
        )
        view.publish_until(stop)
