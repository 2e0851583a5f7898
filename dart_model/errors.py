"""Error of a model."""

from can_dbc.errors import InputError


class ModelError(InputError):
    """A model, or a file that it names, cannot be used; one line: file, key, expectation."""
