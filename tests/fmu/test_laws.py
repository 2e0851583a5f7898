"""Every law of the catalogue, in C, against the plant's own."""

import ctypes
import math
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_model.effects import CATALOGUE, Effect
from dart_model.effects.calling import arguments, force_over_arrays, rates_over_arrays
from dart_model.effects.law import Floats
from rig.fmu.binaries import compile_for
from rig.fmu.law_in_c import NoLawError, in_c
from rig.fmu.source import read_common_source
from tests.fmu.driver import this_system

DOUBLES = ctypes.POINTER(ctypes.c_double)
LAWS = sorted(CATALOGUE)
MOST = 80
"""Switches, states and parameters of one law at most."""

REACH_PER_NEWTON = 1e-12


def _exported(name: str) -> str:
    """C of a law and its rate, each behind a function that a test can call."""
    law = CATALOGUE[name]
    force = in_c(law.force, name)
    text = force.text + _door(name, "double", "", f"return {_call(name, law.force, law)}")
    if law.rate is not None:
        rate = in_c(law.rate, f"{name}_rate")
        call = _call(f"{name}_rate", law.rate, law, *["out"] * rate.writes)
        text += rate.text
        text += _door(
            f"{name}_rate", "void", ", double *out", f"{'' if rate.writes else '*out = '}{call}"
        )
    return text


def _call(name: str, function, law: Effect, *out: str) -> str:
    """A call with arguments from the arrays that a door is given."""
    arrays = {"motion": "u", "states": "state", "parameters": "p", "strut": "strut"}
    given = ["&s"]
    for item in arguments(function, law):
        if item.origin != "rates":
            row = "" if item.size is None else "&"
            given.append(f"{row}{arrays[item.origin]}[{item.first}]")
    return f"{name}({', '.join([*given, *out])});"


def _door(name: str, kind: str, extra: str, call: str) -> str:
    return (
        f"{kind} call_{name}(int is_held, long *answer, double *indicator, const double *u, "
        f"const double *state, const double *p, const double *strut{extra});\n"
        f'__attribute__((visibility("default"))) {kind} call_{name}(int is_held, long *answer, '
        "double *indicator, const double *u, const double *state, const double *p, "
        f"const double *strut{extra}) {{\n"
        "    const Switches s = {is_held, answer, indicator};\n"
        f"    {call}\n}}\n"
    )


@pytest.fixture(scope="session")
def compiled():
    """All laws in one library."""
    text = '#include "switches.h"\n' + "\n".join(_exported(name) for name in LAWS)
    sources = {"switches.h": read_common_source("switches.h"), "laws.c": text}
    system = this_system()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "laws"
        path.write_bytes(compile_for([system], sources, "laws")[system])
        yield ctypes.CDLL(str(path))


def _numbers(values) -> "ctypes.Array[ctypes.c_double]":
    return (ctypes.c_double * MOST)(*values)


def _in_c(library, name: str, motion, state, p, strut, held=None):
    """Force and rates of a law in C; with switches that are held if answers are given."""
    law = CATALOGUE[name]
    answers = (ctypes.c_long * MOST)(*(held or []))
    indicators = (ctypes.c_double * MOST)()
    arrays = [_numbers(values) for values in (motion, state, p, strut)]
    function = getattr(library, f"call_{name}")
    function.restype = ctypes.c_double
    force = function(held is not None, answers, indicators, *arrays)
    rates = []
    if law.rate is not None:
        out = (ctypes.c_double * MOST)()
        getattr(library, f"call_{name}_rate")(
            held is not None, (ctypes.c_long * MOST)(), indicators, *arrays, out
        )
        rates = list(out[: law.state_size])
    return force, rates, list(answers), list(indicators)


def _in_python(name: str, motion, state, p, strut):
    law = CATALOGUE[name]
    force = force_over_arrays(law)(*motion, state, p, strut)
    rates = [0.0] * law.state_size
    rates_over_arrays(law)(*motion, state, p, strut, rates)
    return force, rates


def _value(parameter, share: float) -> float:
    """A parameter between its limits, or within what a damper may have."""
    low, high = max(parameter.low, -1e4), min(parameter.high, 1e4)
    if parameter.name == "delay_s":
        high = 0.02
    if low > 0.0:
        return low * (high / low) ** share
    return low + share * (high - low)


reals = {"allow_nan": False, "allow_infinity": False, "width": 64}
motions = st.tuples(
    st.floats(-5.0, 100.0, **reals),
    st.floats(-2.0, 2.0, **reals),
    st.floats(-5.0, 5.0, **reals),
    st.floats(-5e3, 5e3, **reals),
    st.floats(-40.0, 200.0, **reals),
)
shares = st.lists(st.floats(0.0, 1.0), min_size=MOST, max_size=MOST)
struts = st.tuples(st.floats(-1.0, 1.0), st.floats(0.0, 1e5), st.floats(0.0, 1e4), st.just(9.81))


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
@settings(deadline=None, max_examples=20)
@given(motion=motions, at=shares, states=shares, strut=struts)
def test_a_law_in_c_is_the_plants(compiled, name, motion, at, states, strut):
    law = CATALOGUE[name]
    p = [_value(item, share) for item, share in zip(law.parameters, at, strict=False)]
    state = [
        4.0 * (share - 0.5) * scale for share, scale in zip(states, law.state_scales, strict=False)
    ]
    try:
        force, rates = _in_python(name, motion, state, p, strut)
    except (ArithmeticError, ValueError):
        return  # the plant refuses these parameters
    in_c_force, in_c_rates, _, _ = _in_c(compiled, name, motion, state, p, strut)
    for ours, theirs in zip((in_c_force, *in_c_rates), (force, *rates), strict=True):
        assert ours == pytest.approx(theirs, rel=REACH_PER_NEWTON, abs=1e-300, nan_ok=True)


def test_the_same_over_many_motions_near_where_laws_switch(compiled):
    """Random motions, parameters and states, and places where comparisons are equal."""
    rng = np.random.default_rng(7)
    worst = 0.0
    for name in LAWS:
        law = CATALOGUE[name]
        for _ in range(400):
            p = [_value(item, rng.uniform()) for item in law.parameters]
            state = [rng.normal() * scale for scale in law.state_scales]
            at = rng.choice([0.0, *p, rng.uniform(-1, 1)]) if p else rng.uniform(-1, 1)
            v = rng.choice([0.0, -0.0, rng.normal(), *p[:3]])
            motion = (
                rng.uniform(0, 50),
                float(at),
                float(v),
                rng.normal() * 300,
                rng.uniform(0, 90),
            )
            strut = (0.5, 2e4, 1500.0, 9.81)
            try:
                force, rates = _in_python(name, motion, state, p, strut)
            except (ArithmeticError, ValueError):
                continue
            if isinstance(force, complex) or not all(map(math.isfinite, (force, *rates))):
                continue
            ours, our_rates, _, _ = _in_c(compiled, name, motion, state, p, strut)
            for a, b in zip((ours, *our_rates), (force, *rates), strict=True):
                worst = max(worst, abs(a - b) / max(abs(b), 1e-300) if a != b else 0.0)
    assert worst < REACH_PER_NEWTON


def test_a_held_switch_goes_on_smoothly_and_tells_where_it_turns(compiled):
    """Held inside a gap, the force stays zero beyond it, and its indicator changes sign."""
    p, strut = [1000.0, 0.02, 0.5], (0.5, 0.0, 0.0, 9.81)

    def at(height_m, held=None):
        return _in_c(compiled, "backlash", (0.0, height_m, 0.0, 0.0, 20.0), [], p, strut, held)

    force, _, answers, before = at(0.509)
    assert force == 0.0
    held, _, _, after = at(0.515, answers)
    assert held == 0.0
    assert at(0.515)[0] == pytest.approx(-5.0)
    assert any(a * b < 0.0 for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize(
    "law",
    [
        lambda a: a,
        pytest.param(lambda: None, id="no law"),
    ],
)
def test_what_is_no_function_is_refused(law):
    with pytest.raises((NoLawError, SyntaxError)):
        in_c(law, "it")


def _asks_the_clock(t_s: float) -> float:
    return time.time() + t_s


def _calls_another(t_s: float, height_m: float, elements: Floats) -> float:
    return sum([t_s, height_m, *elements])


def _is_given_a_word(t_s: float, word: str) -> float:
    return t_s if word else 0.0


@pytest.mark.parametrize("law", [_asks_the_clock, _calls_another, _is_given_a_word])
def test_what_no_law_may_use_is_refused(law):
    with pytest.raises(NoLawError):
        in_c(law, "it")
