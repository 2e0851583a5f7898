"""A working directory in which somebody left modules with the names of well-known ones."""

NAMES = ("pickle", "yaml")
"""What a process of Python imports when it starts, and what rig imports."""


class ForeignModules:
    """Modules in a folder, each of which leaves a mark beside the folder when it is imported."""

    def __init__(self, folder):
        self.folder = folder
        self._marks = [folder.with_name(f"{name}.imported") for name in NAMES]
        folder.mkdir()
        for name, mark in zip(NAMES, self._marks, strict=True):
            (folder / f"{name}.py").write_text(
                f"open({str(mark)!r}, 'w').close()\nraise SystemExit(3)\n"
            )

    @property
    def imported(self):
        """Marks of those that were imported."""
        return [mark.name for mark in self._marks if mark.exists()]
