"""Quick cases, each with its right answer: what a number that decides is held against."""

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.search.criteria import SelectionCriteria
from rig.recordings.recording import RecordingError
from tests.diagnosis import little_bench as bench
from tests.diagnosis import little_dyno as dyno
from tests.diagnosis import test_planted_effects as on_bench
from tests.diagnosis import test_prescribed as on_dyno


class Sum(dyno.Nothing):
    """Several forces without internal state at once."""

    def __init__(self, *effects):
        self.effects = effects

    def force(self, t, z, v, state, warm):
        return sum(effect.force(t, z, v, state, warm) for effect in self.effects)


class Exponential(dyno.Nothing):
    def force(self, t, z, v, state, warm):
        return 40.0 * (math.exp(-(z - dyno.FREE) / 0.02) - 1.0)


class Driven(dyno.Nothing):
    """Feeds energy in at low velocity, as no strut does."""

    def force(self, t, z, v, state, warm):
        return 1500.0 * v / (1.0 + (v / 0.1) ** 2)


class Regressive(dyno.Nothing):
    """Damping of 900 N·s/m that turns into -300 at 0.1 m/s: the damper drives from 0.4 m/s on."""

    def force(self, t, z, v, state, warm):
        return math.copysign(1200.0 * max(abs(v) - 0.1, 0.0), v)


class Cogging(dyno.Nothing):
    """A force that no law of the catalogue gives."""

    def __init__(self, amplitude_n):
        self.amplitude_n = amplitude_n

    def force(self, t, z, v, state, warm):
        return self.amplitude_n * math.sin(2.0 * math.pi * z / 0.004)


class Answer(NamedTuple):
    """What a diagnosis says.

    Attributes:
        verdict: Its verdict.
        families: Families that it names as missing; none if its verdict is that nothing explains.
            A preload beside a stiffness is left out: a stiffness is corrected about mid-stroke,
            which brings one along.
        white: Whether it calls the nominal model's residual white.
    """

    verdict: str
    families: frozenset[str]
    white: bool


class Case(NamedTuple):
    """Recordings and their right answer.

    Attributes:
        right: The right answer.
        make: Gives model, runs and held-out runs.
    """

    right: Answer
    make: Callable[[], tuple]


def _on_dyno(effect, judged=None):
    runs = [dyno.run(effect, duration_s=8.0, rate_hz=250)]
    test = dyno.run(judged or effect, 2, 6.0, rate_hz=250, motion=dyno.later)
    return dyno.model(), runs, [test]


def _on_dyno_kept_back(effect):
    return dyno.model(), [dyno.run(effect, duration_s=8.0, rate_hz=250)], []


def _on_bench(effect):
    test = bench.run(effect, seed=2, duration_s=6.0, start=0.37)
    return bench.model(), [bench.run(effect)], [test]


def _case(verdict, families, make, *effects, white=False):
    return Case(Answer(verdict, frozenset(families), white), lambda: make(*effects))


_HARDENING, _STOP, _ORIFICE = on_dyno.Hardening(), on_dyno.Stop(), on_dyno.Orifice()

CASES = {
    "nothing": _case("nothing_missing", (), _on_dyno, dyno.Nothing(), white=True),
    "nothing_on_bench": _case("nothing_missing", (), _on_bench, bench.Nothing(), white=True),
    "stiffness": _case("explained", ["stiffness"], _on_dyno, on_dyno.Stiffness()),
    "hardening": _case("explained", ["nonlinear_stiffness"], _on_dyno, _HARDENING),
    "kept_back": _case("explained", ["nonlinear_stiffness"], _on_dyno_kept_back, _HARDENING),
    "exponential": _case("explained", ["nonlinear_stiffness"], _on_dyno, Exponential()),
    "stop": _case("explained", ["stop"], _on_dyno, _STOP),
    "orifice": _case("explained", ["nonlinear_damping"], _on_dyno, _ORIFICE),
    "orifice_on_bench": _case("explained", ["nonlinear_damping"], _on_bench, on_bench.Orifice()),
    # Formulas that the catalogue has not.
    "foreign_friction": _case("explained", ["friction"], _on_bench, on_bench.Friction()),
    "foreign_loop": _case("explained", ["hysteresis"], _on_dyno, on_dyno.Yielding()),
    "two_kinds": _case(
        "explained", ["nonlinear_stiffness", "nonlinear_damping"], _on_dyno,
        Sum(_HARDENING, _ORIFICE),
    ),
    "one_kind": _case(
        "explained", ["nonlinear_stiffness", "stop"], _on_dyno, Sum(_HARDENING, _STOP)
    ),
    "friction_too": _case(
        "explained", ["nonlinear_stiffness", "friction"], _on_dyno, on_dyno.FrictionAndHardening()
    ),
    "three_kinds": _case(
        "explained", ["nonlinear_stiffness", "stop", "nonlinear_damping"], _on_dyno,
        Sum(_HARDENING, _STOP, _ORIFICE),
    ),
    # Held-out runs with a force that the others have not.
    "some_left": _case(
        "partly_explained", ["nonlinear_stiffness"], _on_dyno,
        _HARDENING, Sum(_HARDENING, Cogging(12.0)),
    ),
    "most_left": _case(
        "not_explained", (), _on_dyno, _HARDENING, Sum(_HARDENING, Cogging(40.0))
    ),
    "driven": _case("not_explained", (), _on_dyno, Driven()),
    # Dissipates at the recorded velocities alone.
    "driven_if_faster": _case(
        "partly_explained", ["nonlinear_damping"], _on_dyno, Regressive()
    ),
    "outside": _case("not_explained", (), _on_dyno, Cogging(40.0)),
}  # fmt: skip


@cache
def _made(name):
    return CASES[name].make()


def answer(name: str, criteria: SelectionCriteria) -> Answer:
    """The answer to a case; "refused" where the recordings do not suffice with these criteria."""
    try:
        found = diagnose(*_made(name), criteria=criteria).diagnosis
    except RecordingError:
        return Answer("refused", frozenset(), white=False)
    families = {effect.family for effect in found.effects}
    if found.verdict == "not_explained":
        families = set()
    if "stiffness" in families:
        families -= {"preload"}
    return Answer(found.verdict, frozenset(families), found.residual_white.before)
