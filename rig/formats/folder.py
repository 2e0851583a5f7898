"""A whole folder of foreign tables, each as a CSV of its own; one that is wrong stops no other."""

from collections.abc import Callable, Iterator
from pathlib import Path

from can_dbc.errors import InputError
from rig.formats.foreign_table import import_table
from rig.formats.import_report import ImportReport
from rig.formats.mapping import Mapping


def import_folder(
    source: Path, mapping_of: Callable[[Path], Mapping], out: Path
) -> Iterator[tuple[Path, ImportReport | InputError]]:
    """Turn every file of a folder into a CSV, in the order of their names.

    Args:
        source: The folder; folders within are left alone, and so are hidden files.
        mapping_of: What a file means.
        out: Folder for the CSV files, which are called as their sources; new or empty.

    Yields:
        File, and what was made of it or why it was refused.

    Raises:
        InputError: There is no file, two would have one name, or `out` holds something.
    """
    files = sorted(
        path for path in source.iterdir() if path.is_file() and not path.name.startswith(".")
    )
    if not files:
        raise InputError(f"{source}: holds no file, expected tables")
    stems = [path.stem for path in files]
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice is not None:
        raise InputError(f"{source}: two files are called {twice}, expected names of their own")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out {out}: holds something, expected a new or empty folder")
    for path in files:
        try:
            yield path, import_table(path, mapping_of(path), out / f"{path.stem}.csv")
        except InputError as error:
            yield path, error
