"""A configuration proposed from a DBC by what its names say."""

from pathlib import Path

from can_dbc.database import Database, load_database
from rig.bus.bus import BusConfig
from rig.new_bench.proposal import (
    Force,
    Proposal,
    Signals,
    find_force,
    find_height,
    find_temperature,
    unclear_forces,
)


def find_signals(database: Database) -> Signals:
    height = find_height(database, None)
    forces = [it for force in Force if (it := find_force(database, force, None)) is not None]
    temperature = find_temperature(database, height.message.sender, None)
    return Signals(height, tuple(forces), temperature, tuple(unclear_forces(database, forces)))


def propose(path: Path, model: str = "reference") -> str:
    database = load_database(path)
    return Proposal(
        database,
        find_signals(database),
        BusConfig("socketcan", "can0", 500_000),
        is_motion_prescribed=False,
    ).text(path.name, model)
