"""Error of a run's folder."""

from can_dbc.errors import InputError


class LogError(InputError):
    """A run's folder is damaged, none, or cannot be written; one line: file, line, expectation."""


class DamageError(LogError):
    """Files of a run are not what was written: nothing is concluded from what is left of them."""
