"""The inputs of a recording that a single force drives."""

from rig.channels.measured_quantities import APPLIED_FORCE
from rig.recordings.recording import RecordedInput


def driven_by(force_n, gaps=None):
    """Inputs by name, of an applied force (N,)."""
    return {"applied_force": RecordedInput(APPLIED_FORCE, force_n, None, gaps)}
