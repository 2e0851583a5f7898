"""Observers, one file each. A further one is a file here and a line in the table below."""

from collections.abc import Mapping
from types import MappingProxyType

from rig.observers.kalman import KalmanObserver
from rig.observers.none import NoObserver
from rig.observers.pi import PiObserver
from rig.observers.protocol import AnyObserver

OBSERVERS: Mapping[str, type[AnyObserver]] = MappingProxyType(
    {"pi": PiObserver, "kalman": KalmanObserver, "none": NoObserver}
)
"""`kind` in a configuration -> a frozen pydantic dataclass that is an `Observer`."""

DEFAULT_KIND = "pi"
"""What an observer without `kind` is."""
