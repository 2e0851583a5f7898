"""`added.arrow`: columns that were computed from a run after it had ended, one row a logged tick.

They are virtual sensors that the run did not have. The log itself stays as it was written.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from can_dbc.atomic_file import replacing
from rig.log.errors import LogError
from rig.log.file_names import ADDED_FILE


def write_added(folder: Path, steps: pa.Table, names: Sequence[str], rows: int) -> None:
    """Keep columns of recomputed steps beside a run of `rows` logged ticks.

    Columns of these names that were added before are replaced; others stay.

    Raises:
        OSError: The folder cannot be written.
    """
    before = read_added(folder, rows)
    columns = {
        name: before.column(name).to_numpy() for name in before.schema.names if name not in names
    }
    for name in names:
        values = np.full(rows, np.nan)
        known = steps.column(name).to_numpy()[:rows]
        values[: len(known)] = known
        columns[name] = values
    schema = pa.schema([(name, pa.float64()) for name in columns])
    table = pa.Table.from_arrays([pa.array(item) for item in columns.values()], schema=schema)
    with (
        replacing(folder / ADDED_FILE) as temporary,
        pa.OSFile(str(temporary), "wb") as sink,
        pa.ipc.new_stream(sink, table.schema) as stream,
    ):
        stream.write_table(table)


def read_added(folder: Path, rows: int) -> pa.Table:
    """Columns that were added to a run of `rows` logged ticks; none where there is no file.

    Raises:
        LogError: The file is damaged, or of another run.
    """
    path = folder / ADDED_FILE
    if not path.is_file():
        return pa.schema([]).empty_table()
    try:
        with pa.OSFile(str(path), "r") as source:
            table = pa.ipc.open_stream(source).read_all()
        table.validate(full=True)
    except (pa.ArrowException, OSError) as error:
        raise LogError(
            f"{path}: cannot be read: {error}; delete it, and add the sensors again with `rig "
            "replay --add`"
        ) from error
    if table.num_rows != rows or any(kind != pa.float64() for kind in table.schema.types):
        raise LogError(
            f"{path}: {table.num_rows} rows, expected {rows} rows of numbers as in the log: delete "
            "it, and add the sensors again with `rig replay --add`"
        )
    return table
