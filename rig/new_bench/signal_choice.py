"""Which signals of a DBC a new bench uses: those that options name, or the likeliest ones."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from can_dbc.database import Database
from can_dbc.errors import InputError
from rig.new_bench.proposal import (
    Force,
    Signals,
    find_force,
    find_height,
    find_temperature,
    unclear_forces,
    unknown_units,
)
from rig.new_bench.signal_ranking import RankedSignal

_NONE = "none"
"""Instead of a signal's name: the bench does not measure it."""


class SignalNames(NamedTuple):
    """Signals that options name, each None if it does not."""

    height: str | None
    applied_force: str | None
    load_cell: str | None
    temperature: str | None


def choose_signals(
    database: Database,
    given: SignalNames,
    ask: Callable[[str], Force | None] | None,
    *,
    is_dyno: bool,
) -> Signals:
    """Choose height, forces and temperature among the signals of a DBC.

    Args:
        database: The DBC.
        given: Signals that are named; the others are ranked.
        ask: Asks where a force of a name acts (None: at neither place), where neither name nor
            comment shows it; None where there is no terminal.
        is_dyno: Whether the bench prescribes the motion, which requires a load cell.

    Raises:
        InputError: There is no height, a named signal does not suit, or it is not clear where a
            force acts.
    """
    found = find_height(database, given.height)
    names = {
        Force.APPLIED: given.applied_force or (_NONE if is_dyno else None),
        Force.IN_STRUT: given.load_cell,
    }
    forces = {
        force: None if name == _NONE else find_force(database, force, name)
        for force, name in names.items()
    }
    chosen_names = [choice.name for choice in forces.values() if choice]
    if len(set(chosen_names)) < len(chosen_names):  # one signal suits both: the user decides
        if None not in names.values():
            raise InputError(
                f"--load-cell {given.load_cell}: is the applied force, expected another"
            )
        forces = {
            force: choice if names[force] is not None else None for force, choice in forces.items()
        }
    open_forces = [force for force, name in names.items() if name is None and not forces[force]]
    unclear = unclear_forces(database, [it for it in forces.values() if it]) if open_forces else []
    if is_dyno and len(unclear) == 1 and not forces[Force.IN_STRUT]:
        # A dyno measures no other force.
        forces[Force.IN_STRUT] = find_force(database, Force.IN_STRUT, unclear.pop().name)
    if unclear and ask is not None:
        for item in unclear[: len(open_forces)]:
            force = ask(item.name)
            if force in open_forces:
                forces[force] = find_force(database, force, item.name)
        unclear = []
    if unclear and len(open_forces) == len(names):
        raise InputError(_ask_for_place(unclear))
    chosen = tuple(choice for choice in forces.values() if choice is not None)
    if is_dyno and not any(choice.quantity is Force.IN_STRUT.quantity for choice in chosen):
        raise InputError("--dyno: requires the force in the strut: --load-cell MESSAGE.SIGNAL")
    temperature = None
    if given.temperature != _NONE:
        temperature = find_temperature(database, found.message.sender, given.temperature)
    unknown = tuple(name for name in unknown_units(database) if name != found.name)
    return Signals(found, chosen, temperature, tuple(unclear), unknown)


_MOST_LISTED, _LONGEST_COMMENT = 6, 50
"""Forces that a message lists, and characters of their comments: a message of about six lines."""


def _ask_for_place(unclear: Sequence[RankedSignal]) -> str:
    """The forces of which it is not clear where they act, and what is expected."""
    if len(unclear) == 1:
        name = unclear[0].name
        return (
            f"{name} is a force, and it is not clear where it acts: expected --applied-force "
            f"{name} for a force on the body, or --load-cell {name} for one in the strut (or none)"
        )
    listed = "; ".join(
        f"{item.name} ({item.signal.comment[:_LONGEST_COMMENT]})"
        if item.signal.comment
        else item.name
        for item in unclear[:_MOST_LISTED]
    )
    return (
        "these are forces, and it is not clear where they act: "
        f"{listed}; expected --applied-force NAME with the one on the body, and --load-cell NAME "
        "with the one in the strut, or none"
    )
