"""The first screen of a diagnosis: headline, meaning and certainty agree with the verdict."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.diagnosis.outcome import ModelErrors, RejectedEffect
from rig.pages.report.finding import find, remainder
from tests.pages.test_report import FALLS, FRICTION, MASS, SOFTER, STOP, found, report

LEFT = ModelErrors(2.3e-3, 2.3e-3, 4e-5, math.nan)


@pytest.mark.parametrize(
    ("diagnosis", "headline"),
    [
        (found(), "Dry friction (Coulomb) missing"),
        (found("partly_explained", height=LEFT), "Dry friction (Coulomb) and more missing"),
        (found("nothing_missing", ()), "Nothing is missing"),
        (
            found("explained", (), linear=(SOFTER,)),
            "Spring 13 % softer than in the model; no further effect",
        ),
        (
            found("explained", (), linear=(SOFTER, MASS)),
            "Spring 13 % softer than in the model and Mass 4.5 % smaller than in the model; no "
            "further effect",
        ),
        (
            found("ambiguous", ambiguous_with=("damping",)),
            "Dry friction (Coulomb), or a different damping",
        ),
        (found("not_explained", (), LEFT), "0.370 N RMS of force that no law describes"),
    ],
)
def test_the_headline_is_the_finding(diagnosis, headline):
    assert find(report(diagnosis)).headline.replace("\u00a0", " ") == headline


def test_a_force_is_stated_in_newtons_where_it_acts():
    (meaning,) = find(report()).meaning
    assert meaning.replace("\u00a0", " ").startswith("Dry friction (Coulomb): 12.1 N at −0.41 m/s")


def test_the_error_is_in_one_unit_before_and_after():
    text = find(report()).error.replace("\u00a0", " ")
    assert text == "Height error 2.31 → 0.0104 mm on data not used for fitting."


@given(
    st.sampled_from(
        ["nothing_missing", "explained", "partly_explained", "ambiguous", "not_explained"]
    ),
    st.floats(0.5, 100.0),
)
def test_what_remains_is_judged_as_the_verdict_judges_it(verdict, ratio):
    effects = (FRICTION,) if verdict not in ("nothing_missing", "not_explained") else ()
    if verdict in ("explained", "nothing_missing"):
        ratio = min(ratio, 1.2)
    diagnosis = found(verdict, effects, ModelErrors(2e-3, 2e-3, 1e-5 * ratio, math.nan))
    statement = remainder(diagnosis)
    is_noise = verdict in ("explained", "nothing_missing") or (
        verdict == "ambiguous" and ratio <= 1.2
    )
    assert (statement.tone == "good") == is_noise
    assert ("Only noise is left" in statement.text) == is_noise
    assert is_noise or "missing" in statement.text or "as good as any" in statement.text


def test_a_load_cell_that_does_not_agree_is_said():
    held_out = replace(found().held_out, strut_force_rmse_n=ModelErrors(3.0, 3.0, 9.0, math.nan))
    *_, cell = find(report(replace(found(), held_out=held_out))).certainty
    assert cell.tone == "bad"
    assert "does not agree" in cell.text
    *_, cell = find(report()).certainty
    assert "No load cell" in cell.text


def test_a_rival_of_linear_corrections_is_no_rival_of_the_law():
    law = replace(FRICTION, where=STOP)
    diagnosis = found("ambiguous", (law,), linear=(SOFTER,), ambiguous_with=("input_gain",))
    headline = find(report(diagnosis)).headline
    assert headline == (
        "Dry friction (Coulomb) missing; Spring 13\u00a0% softer than in the model, or a wrong "
        "gain of the applied force"
    )


def test_a_height_error_that_falls_is_no_model_as_good_as_any():
    held_out = replace(
        found().held_out,
        height_rmse_m=ModelErrors(0.13, 0.13, 3.5e-3, math.nan),
        residual_force_rmse_n=ModelErrors(0.43, 0.43, 0.42, math.nan),
    )
    text = remainder(replace(found("partly_explained"), held_out=held_out)).text
    assert "2.7\u00a0% of the height error is left" in text
    assert "as good as any" not in text


def test_a_rival_that_leaves_less_than_what_is_named_is_said_with_the_reason_against_it():
    def certainty(left):
        rival = RejectedEffect("hysteresis", "dahl", "strut", "it cancels another law", left)
        _, rivals, _ = find(report(replace(found(), rejected=(rival,), left=0.1))).certainty
        return rivals

    behind, ahead = certainty(0.4), certainty(0.05)
    assert behind.tone == "good"
    assert "what is named here leaves 10.0" in behind.text
    assert ahead.tone == "part"
    assert ahead.text.endswith("It was not chosen: it cancels another law.")


def test_a_second_pass_that_gains_nothing_names_the_model_to_keep():
    held_out = replace(
        found().held_out,
        height_rmse_m=ModelErrors(2.8e-5, 2.8e-5, 2.7e-5, math.nan),
        residual_force_rmse_n=ModelErrors(0.43, 0.43, 0.42, math.nan),
    )
    diagnosis = replace(found("not_explained", (), FALLS), held_out=held_out)
    assert "the given model is as good as any" in remainder(diagnosis).text
    assert math.isfinite(held_out.residual_force_rmse_n.after)
