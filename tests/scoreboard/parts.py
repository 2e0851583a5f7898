"""Parts of published tables as recordings."""

from pathlib import Path
from typing import NamedTuple

from rig.formats.foreign_table import import_table
from rig.formats.mapping import TableMapping


class Part(NamedTuple):
    """Rows of a table.

    Attributes:
        name: What they are called.
        first: First row.
        last: Last row, excluded.
    """

    name: str
    first: int
    last: int


def imported(source: Path, mapping: TableMapping, part: Part | None, out: Path) -> Path:
    """A table, or a part of it, as a CSV file that a diagnosis reads."""
    if part is not None:
        rows = {"first_row": part.first, "rows": part.last - part.first}
        mapping = mapping.model_copy(update={"table": mapping.table.model_copy(update=rows)})
    out.parent.mkdir(parents=True, exist_ok=True)
    out.unlink(missing_ok=True)
    import_table(source, mapping, out)
    return out
