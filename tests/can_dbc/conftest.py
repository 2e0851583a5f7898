"""Fixtures: DBC files written from text, and the bus of the bench."""

from collections.abc import Callable
from itertools import count
from pathlib import Path

import pytest
from hypothesis import settings

from can_dbc.database import DEFAULT_DATABASE, Database, load_database

# The same examples in every run, on every machine.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

HEADER = 'VERSION ""\nNS_ :\nBS_:\nBU_: BENCH RIG\n'
ATTRIBUTES = """
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG",\
"reserved","reserved","reserved","reserved","reserved","reserved","reserved","reserved",\
"reserved","reserved","StandardCAN_FD","ExtendedCAN_FD";
BA_DEF_ BO_ "E2EProfile" STRING ;
BA_DEF_ BO_ "E2EDataIds" STRING ;
BA_DEF_ BO_ "E2ECrcSignal" STRING ;
BA_DEF_ BO_ "E2ECounterSignal" STRING ;
BA_DEF_ BO_ "E2EMaxDeltaCounter" INT 0 100;
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
"""


@pytest.fixture(scope="session")
def rig() -> Database:
    return load_database(DEFAULT_DATABASE)


@pytest.fixture(scope="session")
def write_dbc(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Write messages and, after the attribute definitions, further statements into a file."""
    folder = tmp_path_factory.mktemp("dbc")
    numbers = count()

    def write(messages: str, statements: str = "") -> Path:
        path = folder / f"{next(numbers)}.dbc"
        text = f"{HEADER}\n{messages}\n{ATTRIBUTES}\n{statements}\n"
        path.write_text(text, encoding="utf-8")
        return path

    return write
