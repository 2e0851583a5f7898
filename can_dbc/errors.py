"""The error of this package."""


class DatabaseError(ValueError):
    """A DBC file, or what is asked of it, is wrong; the message is one line naming the place."""
