"""The error for whatever comes from outside and is wrong."""


class InputError(ValueError):
    """An input is wrong; one line names file, key, value and what was expected.

    Every package derives its own from this one, so that a caller catches them all at once; the
    command prints the line and ends with exit code 2.
    """
