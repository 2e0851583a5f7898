"""What holds for all tests."""

import os

# Two workers on two cores: with threads in each, linear algebra takes five times as long. numpy
# reads the variable when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from hypothesis import settings

# A busy machine is no fault of what is tested, and every day draws the same examples.
settings.register_profile("patient", deadline=None, derandomize=True)
settings.load_profile("patient")
