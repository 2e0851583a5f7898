"""Frames that come later than their steps: used in these, as if they had been in time."""

import numpy as np
import pytest
from msgspec.structs import replace

from rig.bridge.values import Mode
from rig.observers.kalman import KalmanObserver
from tests.faults.trial import BEGIN_MS, BEGIN_NS, MS, Gateway, Trial, after

END_MS = BEGIN_MS + 1000


@pytest.fixture(scope="module")
def undisturbed():
    return Trial().run(END_MS)


@pytest.mark.parametrize("held", [1, 2, 3, 5, 9, 13])
def test_behind_frames_that_were_held_back_all_is_as_if_they_had_not_been(held, undisturbed):
    gateway, holding = Gateway(held, 250), []

    def inject(t_ns, frames):
        arriving = gateway(t_ns, frames)
        holding.append(gateway.is_holding)
        return arriving

    trial = Trial()
    ticks = trial.run(END_MS, after(BEGIN_NS, inject))
    assert ticks[-1].counts.untimed == 0
    compared = 0
    for tick, other, is_held in zip(ticks[BEGIN_MS:], undisturbed[BEGIN_MS:], holding, strict=True):
        if not is_held:
            # To the last bit; a limit on what was published meanwhile changes no estimate.
            assert tick.force_n == other.force_n
            assert tick.result.output.struts[0].height_m == other.result.output.struts[0].height_m
            compared += 1
    assert compared > 900


OBSERVERS = {"published": None, "noise-aware": KalmanObserver.before_tuning(1e-6, MS)}
LONG_MS = BEGIN_MS + 6500


def errors_n(ticks):
    """Error of the force where it is valid, from the beginning of the fault on."""
    valid = [tick for tick in ticks if tick.t_ns >= BEGIN_NS and tick.is_valid]
    return np.array([abs(tick.force_n - tick.truth_n) for tick in valid])


@pytest.fixture(scope="module")
def settled_n():
    return {
        name: errors_n(Trial(observer=observer).run(LONG_MS)).max()
        for name, observer in OBSERVERS.items()
    }


@pytest.mark.parametrize("held", [2, 5, 8, 13, 20, 60, 200])
@pytest.mark.parametrize("name", OBSERVERS)
def test_no_valid_force_is_far_from_the_truth(name, held, settled_n):
    trial = Trial(observer=OBSERVERS[name])
    ticks = trial.run(LONG_MS, after(BEGIN_NS, Gateway(held, 3000)))
    found = errors_n(ticks)
    assert found.max() <= 3.0 * settled_n[name]
    assert ticks[-1].mode is Mode.RUNNING
    assert len(found) > 1900


def test_what_comes_too_late_is_refused():
    trial = Trial()
    ticks = trial.run(END_MS, after(BEGIN_NS, Gateway(40, 500)))
    assert ticks[-1].counts.untimed > 20


def test_a_queue_before_the_first_tick_is_not_taken_as_new():
    queued = []

    def inject(t_ns, frames):
        queued.extend(frames)
        if t_ns < 200 * MS:
            return []
        kept = [replace(frame, t_ns=t_ns) for frame in queued]
        queued.clear()
        return kept

    ticks = Trial().run(END_MS, inject)
    first = next(tick for tick in ticks if tick.mode is not Mode.WAITING)
    assert first.t_ns >= 208 * MS
    assert ticks[-1].counts.untimed > 190
