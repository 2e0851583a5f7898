"""Progress of long work."""

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called with what is being done and the share that is done."""


def within(progress: Progress, first: float, last: float, of: str = "") -> Progress:
    """Progress of a part, a range of shares of the whole; `of` precedes the names of its steps."""

    def part(what: str, share: float) -> None:
        progress(f"{of}: {what}" if of else what, first + (last - first) * share)

    return part


def no_progress(_what: str, _share: float) -> None:
    """A progress callback that does nothing."""
