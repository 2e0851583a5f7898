"""numba, without the settings of a `.numba_config.yaml` in the working directory.

Such a file could name the folder from which compiled code is loaded, and so a program to run.
"""

import contextlib
from pathlib import Path
from typing import Any, cast

with contextlib.chdir(Path(__file__).parent):
    import numba
    from numba import typed, types
    from numba.core import config
    from numba.core.errors import NumbaExperimentalFeatureWarning
    from numba.core.typing.templates import Signature

__all__ = ["NumbaExperimentalFeatureWarning", "Signature", "numba", "typed", "types"]

# numba looks for the file again at every compilation; there is none of this name.
cast("Any", config)._config_fname = ""  # noqa: SLF001
