"""The error of this package."""

from rig.inputs.errors import InputError


class DatabaseError(InputError):
    """A DBC file, or what is asked of it, is wrong; the message is one line naming the place."""
