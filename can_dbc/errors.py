"""Errors of inputs: the base class of the whole project, and those of this package."""


class InputError(ValueError):
    """An input is wrong; one line names file, key, value and what was expected.

    Every package derives its own error from this one, so that a caller catches all of them at
    once; the command prints the line and ends with exit code 2. It stands in the lowest package,
    because every other one raises it.
    """


def missing_package(package: str, remedy: str) -> str:
    """What an error says of a package that is not installed; `remedy` is the command to type."""
    return f"the package {package} is not installed, expected `{remedy}` in the clone of rig"


class DatabaseError(InputError):
    """A DBC file, or a signal requested of it, is wrong."""


class FileError(InputError):
    """A text or YAML file cannot be read, or its content does not fit the schema."""
