"""A folder of foreign tables, each as one CSV; a wrong one does not stop the others."""

from collections.abc import Callable, Iterator
from pathlib import Path

from can_dbc.errors import InputError
from rig.files.folders import refuse_full
from rig.formats.foreign_table import import_table
from rig.formats.import_report import ImportReport
from rig.formats.mapping import TableMapping


def import_folder(
    source: Path, find_mapping: Callable[[Path], TableMapping], out: Path
) -> Iterator[tuple[Path, ImportReport | InputError]]:
    """Turn every file of a folder into a CSV, in the order of their names.

    Args:
        source: The folder; folders within and hidden files are ignored.
        find_mapping: Gives the mapping of a file.
        out: Folder for the CSV files, which are called as their sources; new or empty.

    Yields:
        File, and the report of its import or the error by which it was refused.

    Raises:
        InputError: There is no file, two would have one name, or `out` is not empty.
    """
    files = sorted(
        path for path in source.iterdir() if path.is_file() and not path.name.startswith(".")
    )
    if not files:
        raise InputError(f"{source}: holds no file, expected tables")
    stems = [path.stem for path in files]
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice is not None:
        raise InputError(f"{source}: two files are called {twice}, expected different names")
    refuse_full(out)
    for path in files:
        try:
            yield path, import_table(path, find_mapping(path), out / f"{path.stem}.csv")
        except InputError as error:
            yield path, error
