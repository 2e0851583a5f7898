"""The benchmark counts what it says it counts."""

import json

import pytest
from rich.console import Console

from dart_model.effects import effect
from tests.diagnosis_benchmark import execute as execution
from tests.diagnosis_benchmark.comparable import COMPARABLE, intervals
from tests.diagnosis_benchmark.execute import (
    crashed,
    execute,
    failed,
    load_result,
    result_path,
    within,
)
from tests.diagnosis_benchmark.judge import is_right
from tests.diagnosis_benchmark.plan import Counts, Slot, fill, slots
from tests.diagnosis_benchmark.summary import print_tables, summarise, write_tables
from tests.truth.cases import FAMILIES
from tests.truth.compiled import CODES
from tests.truth.plant import Bench, Planted

BENCH = Bench(10.0, 1000.0, 20.0, 0.5)


def diagnosis(verdict, *families, rivals=()):
    effects = [{"family": f, "name": f, "strut": "strut", "parameters": {}} for f in families]
    return {"verdict": verdict, "effects": effects, "ambiguous_with": list(rivals)}


@pytest.mark.parametrize(
    ("planted", "answer", "right"),
    [
        (("friction",), diagnosis("explained", "friction", "preload"), True),
        (("friction",), diagnosis("explained", "preload", "friction"), False),
        (("friction",), diagnosis("ambiguous", "stop", rivals=["friction"]), True),
        (("friction",), diagnosis("explained", "stop", rivals=["friction"]), False),
        (("friction",), diagnosis("ambiguous", "stop", rivals=["backlash"]), False),
        (("friction",), diagnosis("not_explained", "friction"), False),
        (("friction",), diagnosis("nothing_missing"), False),
        (("stop", "fade"), diagnosis("explained", "fade", "stop"), True),
        (("stop", "fade"), diagnosis("explained", "fade"), False),
        ((), diagnosis("nothing_missing"), True),
        ((), diagnosis("explained", "preload"), False),
        (("outside",), diagnosis("failed"), False),
        (("outside",), diagnosis("nothing_missing"), False),
        (("outside",), diagnosis("not_explained", "restoring_surface"), True),
        (("outside",), diagnosis("partly_explained", "stiffness"), True),
        (("outside",), diagnosis("explained", "stiffness"), False),
        (("outside",), diagnosis("ambiguous", "stiffness", rivals=["inertia"]), False),
    ],
)
def test_right_is_what_the_criteria_say(planted, answer, right):
    assert is_right(planted, answer) is right


def test_intervals_compare_equal_meanings_only():
    play = Planted("backlash", "free_play", {"half_gap_m": 0.004})
    found = [
        {
            "name": "free_play",
            "parameters": {
                "gap_m": {"value": 0.0081, "low": 0.0079, "high": 0.0083},
                "centre_height_m": {"value": 0.51, "low": 0.505, "high": 0.515},
            },
        },
        {"name": "preload", "parameters": {"force_n": {"value": 1.0, "low": 0.0, "high": 2.0}}},
    ]
    held = intervals((play,), BENCH, found)
    assert [(i.parameter, i.holds) for i in held] == [
        ("free_play.gap_m", True),
        ("free_play.centre_height_m", False),
    ]


def test_comparable_laws_exist():
    timed = {"constant", "load_scale", "late_load", "tone"}
    assert set(COMPARABLE) <= set(CODES) | timed


@pytest.mark.parametrize("law", COMPARABLE)
def test_parameters_to_compare_exist_in_the_catalogue(law):
    for same in COMPARABLE[law]:
        names = [parameter.name for parameter in effect(same.effect).parameters]
        assert same.parameter in names, same.effect


def test_slots_are_as_many_as_asked_and_cover_every_family():
    counts = Counts(single=30, pair=10, triple=2, complete=5, outside=3, foreign=0, faint=0)
    found = slots(counts, 0)
    assert len({slot.name for slot in found}) == 50
    kinds = [slot.kind for slot in found if slot.group == "single"]
    assert all(kinds.count(family) == 2 for family in FAMILIES)
    assert sum(slot.kind == "friction_and_cubic" for slot in found) == 2
    # An interrupted run has something of everything.
    assert {slot.group for slot in found[:15]} >= {"single", "pair", "complete"}


def test_filled_slots_hold_what_they_are_for():
    assert fill(Slot("single", "preload", 0, 0)).families == ("preload",)
    assert fill(Slot("complete", "complete", 0, 0)).families == ()


def test_results_are_kept_and_tabulated(tmp_path, monkeypatch):
    calls = []

    def oracle(folder):
        calls.append(folder)
        truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        noise = truth["sensors"]["height_noise_m"]
        rmse = {"before": 50 * noise, "after": 1.1 * noise}
        answer = diagnosis("explained", *truth["families"])
        return answer | {
            "held_out": {"height_rmse_m": rmse},
            "noise_floor": {"height_rmse_m": noise},
        }

    monkeypatch.setattr(execution, "diagnose", oracle)
    slot = Slot("single", "preload", 0, 0)
    first = execute(slot, tmp_path, 60.0)
    assert first.right
    assert 0.9 < first.floor_multiple <= 1.1
    assert execute(slot, tmp_path, 60.0) == first == load_result(result_path(tmp_path, slot))
    assert len(calls) == 1
    summary = summarise([first])
    assert summary["groups"]["single"]["right"] == 1.0
    assert summary["confusion"]["preload"] == {"preload": 1}
    write_tables([first], summary, tmp_path)
    assert len((tmp_path / "cases.csv").read_text(encoding="utf-8").splitlines()) == 2
    console = Console(width=180, record=True, file=(tmp_path / "table.txt").open("w"))
    print_tables(summary, console)
    console.file.close()
    assert "preload" in console.export_text()


def test_failure_is_reported_and_tried_again(tmp_path, monkeypatch):
    monkeypatch.setattr(execution, "diagnose", lambda _: failed("it broke"))
    slot = Slot("complete", "complete", 0, 0)
    result = execute(slot, tmp_path, 60.0)
    assert (result.verdict, result.right, result.message) == ("failed", False, "it broke")
    assert not result_path(tmp_path, slot).exists()


def test_crash_is_a_wrong_answer():
    result = crashed(Slot("outside", "outside", 0, 0), KeyError("x"))
    assert (result.verdict, result.right) == ("failed", False)
    assert "KeyError" in result.message


def never_end():
    while True:
        pass


def test_endless_diagnosis_is_broken_off():
    with pytest.raises(TimeoutError, match="no answer within 0 s"), within(0.01):
        never_end()
