"""`rig set`."""

from pathlib import Path
from typing import Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.terminal import JsonFlag, print_json, print_text

EXAMPLES = (
    "Examples: `rig set runs/7 observers.strut.proportional_n_per_m=2e5` · "
    "`rig set runs/7 --acknowledge` · `rig set runs/7 --arm` · "
    '`rig set runs/7 --mark "valve opened"`'
)


def set_command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run in progress.")],
    assignments: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="KEY=VALUE",
            help="New values for keys of the configuration under observers or supervision, except "
            "kind and filter of an observer.",
        ),
    ] = None,
    acknowledge: Annotated[
        bool, typer.Option("--acknowledge", help="Acknowledge the safe state.")
    ] = False,
    arm: Annotated[bool, typer.Option("--arm", help="Arm the bridge (`arming: manual`).")] = False,
    disarm: Annotated[
        bool, typer.Option("--disarm", help="Disarm the bridge: no estimate is valid.")
    ] = False,
    mark: Annotated[
        str | None,
        typer.Option("--mark", metavar="TEXT", help="Mark the present time in the run's events."),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Apply the change although `rig check` finds an error.")
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Change gains or limits of a run in progress, acknowledge, arm, or mark a time."""
    from rig.run.change_requests import ask
    from rig.run.changed_settings import parse_assignments
    from rig.run.operator import user_name

    given = {"acknowledge": acknowledge, "arm": arm, "disarm": disarm}
    requests = [request for request, is_given in given.items() if is_given]
    named = [f"--{request}" for request in requests]
    named += ["--mark"] * (mark is not None) + ["KEY=VALUE"] * bool(assignments)
    if not named:
        raise InputError("expected KEY=VALUE, --acknowledge, --arm, --disarm or --mark")
    if len(named) > 1:
        raise InputError(f"{' and '.join(named)}: expected one of them")
    if requests:
        ask(run, {"request": requests[0], "by": user_name()})
        if as_json:
            print_json({"requested": requests[0]})
        else:
            print_text(f"Requested: {requests[0]}.")
        return
    if mark is not None:
        marked = ask(run, {"mark": mark, "by": user_name()}).get("marked", mark)
        if as_json:
            print_json({"marked": marked})
        else:
            print_text(f"Marked: {marked}.")
        return
    found = ask(run, {"set": parse_assignments(assignments or ())}, force=force)
    since_s = found.get("t_ns", 0) * 1e-9
    if as_json:
        print_json({"changed_from_s": since_s})
    else:
        print_text(f"Changed from {since_s:.3f} s on.")
