"""The estimated force against its own past and against the load cell, for limits on both.

A load cell contradicts what no other signal does: a scale of the height that is wrong in the DBC, a
mass of the model that is not the bench's. Its sample is compared with the estimate of the time at
which it was taken, which lies between two ticks.
"""

from collections.abc import Sequence
from itertools import pairwise
from math import nan

from msgspec import Struct

from rig.bridge.measurement_age import age_limit_ns, is_too_old
from rig.bridge.values import StrutOutput
from rig.channels.channel import Channel, Sample

_LATEST_NS = 100_000_000
"""Age up to which a sample can be compared: frames wait by less."""

Forces = tuple[float, ...]
"""Estimated force of each strut in N."""


class ForceHistory(Struct, frozen=True, gc=False):
    """Estimated forces of the last ticks, and what the load cell contradicts of them.

    Attributes:
        forces: Times of ticks, and forces there, the newest first.
        cell_ns: Time of the newest sample of the load cell that was compared; 0 before the first.
        differences_n: Of each strut the estimated force less the load cell's, at that sample.
        rates_n_per_s: Change of each strut's force since the tick before; 0 at the first.
    """

    forces: tuple[tuple[int, Forces], ...] = ()
    cell_ns: int = 0
    differences_n: Forces = ()
    rates_n_per_s: Forces = ()


NO_HISTORY = ForceHistory()


class ForceComparison:
    """What compares forces with those before, and with a load cell.

    Args:
        cell: Channel of the load cell; None where there is none.
        stale_after_ns: Age of a height from which it is too old.
    """

    def __init__(self, cell: Channel | None, stale_after_ns: int) -> None:
        self._cell = cell
        interval_ns = 0 if cell is None else cell.interval_ns
        self._stale_after_ns = age_limit_ns(interval_ns, stale_after_ns)
        self._latest_ns = 0 if cell is None else _LATEST_NS

    def update(
        self,
        history: ForceHistory,
        t_ns: int,
        struts: Sequence[StrutOutput],
        samples: Sequence[Sample],
    ) -> ForceHistory:
        """History after a tick with an estimate and what arrived with it.

        A difference is NaN without a fresh sample of the load cell.
        """
        forces_n = tuple([strut.force_n for strut in struts])
        kept = [(t_ns, forces_n)]
        for item in history.forces:
            if item[0] < t_ns:
                kept.append(item)
            if t_ns - item[0] >= self._latest_ns:
                break
        rates_n_per_s = (0.0,) * len(struts)
        if len(kept) > 1:
            before_ns, before_n = kept[1]
            elapsed_s = (t_ns - before_ns) * 1e-9
            rates_n_per_s = tuple(
                [(new - old) / elapsed_s for new, old in zip(forces_n, before_n, strict=True)]
            )
        cell_ns, differences_n = history.cell_ns, history.differences_n
        for sample in samples:
            if self._cell is not None and sample.channel == self._cell.index:
                estimated_n = _forces_at(kept, sample.t_ns)
                if estimated_n is not None and sample.t_ns >= cell_ns:
                    cell_ns = sample.t_ns
                    differences_n = tuple([force_n - sample.value for force_n in estimated_n])
        if is_too_old(cell_ns, t_ns, self._stale_after_ns) or not differences_n:
            differences_n = (nan,) * len(struts)
        return ForceHistory(tuple(kept), cell_ns, differences_n, rates_n_per_s)


def _forces_at(forces: Sequence[tuple[int, Forces]], t_ns: int) -> Forces | None:
    """Forces at a time, linear between two ticks; None outside them. The newest tick comes first.

    Before the second tick, its own forces are those of the time before it.
    """
    if len(forces) == 1:
        return forces[0][1]
    for (after_ns, after_n), (before_ns, before_n) in pairwise(forces):
        if before_ns <= t_ns <= after_ns:
            share = (t_ns - before_ns) / (after_ns - before_ns)
            return tuple(
                [old + share * (new - old) for new, old in zip(after_n, before_n, strict=True)]
            )
    return None
