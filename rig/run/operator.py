"""Requests of operators to a run: from its folder, from the page, and by a signal."""

import getpass
import os
from collections import deque
from typing import NamedTuple

from rig.bridge.values import Request


class Asked(NamedTuple):
    """A request, and who made it."""

    request: Request
    by: str


class Operator:
    """Requests on their way to the loop, which takes one a tick; any thread may make them."""

    def __init__(self) -> None:
        self.waiting: deque[Asked] = deque()
        self.last: Asked | None = None
        """The request that was taken last."""

    def ask(self, request: Request, by: str) -> None:
        """Request something at the next tick that has nothing else to do."""
        self.waiting.append(Asked(request, by))

    def take(self) -> Request | None:
        """The next request; None if there is none."""
        if not self.waiting:
            return None
        self.last = self.waiting.popleft()
        return self.last.request


def user_name() -> str:
    """Name of the user who runs this process; the number where it has no name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):  # as Python's versions have it
        return f"user {os.getuid()}"
