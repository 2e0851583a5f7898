"""Processes of Python that rig starts.

They import nothing from the working directory, whose files may come with a configuration from
elsewhere: Python would otherwise take modules from there (a `yaml.py`, a `pickle.py`) before its
own.
"""

import multiprocessing
import os
import sys
from multiprocessing.context import SpawnContext

PYTHON = (sys.executable, "-P")
"""Begin of a command that runs a module: this Python, without the working directory."""


def spawn_context() -> SpawnContext:
    """Context of worker processes; none of them takes modules from the working directory.

    Their commands are made by the standard library, which passes `-P` on only where this process
    has it. The variable says the same to every process of Python that is started from now on.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    return multiprocessing.get_context("spawn")
