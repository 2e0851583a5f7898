"""Versions of what is installed, by the names that logs and reports use."""

from importlib.metadata import version

DISTRIBUTION = "shock-rig"
"""Name under which pip knows rig: `rig` itself is another project's on the public index."""


def version_of(package: str) -> str:
    """Version of an installed package; rig is known as `rig`, not as its distribution."""
    return version(DISTRIBUTION if package == "rig" else package)
