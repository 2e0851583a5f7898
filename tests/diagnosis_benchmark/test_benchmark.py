"""The benchmark counts what it says it counts."""

import json
import math
from dataclasses import replace

import pytest
from rich.console import Console

from dart_model.effects import effect
from tests.diagnosis import little_bench
from tests.diagnosis_benchmark import __main__ as command
from tests.diagnosis_benchmark import execute as execution
from tests.diagnosis_benchmark.acting import overlap, overlaps
from tests.diagnosis_benchmark.bounds import BOUNDS, Bound, violations
from tests.diagnosis_benchmark.comparable import COMPARABLE, intervals
from tests.diagnosis_benchmark.execute import (
    crashed,
    execute,
    failed,
    load_result,
    result_path,
    within,
)
from tests.diagnosis_benchmark.judge import (
    Result,
    false_names,
    is_candidate,
    is_right,
    is_unbound,
    judge,
)
from tests.diagnosis_benchmark.live import live_force
from tests.diagnosis_benchmark.live_moving import live_force_of_moving
from tests.diagnosis_benchmark.moving import make_moving, nominal_bench, nominal_model
from tests.diagnosis_benchmark.plan import GROUPS, Slot, fill, part_of, slots
from tests.diagnosis_benchmark.summary import (
    COLUMNS,
    POOLS,
    figures,
    markdown,
    print_tables,
    rate,
    summarise,
    write_tables,
)
from tests.truth.cases import FAMILIES
from tests.truth.compiled import CODES
from tests.truth.plant import Bench, Case, Excitation, Planted, Roughness, RunPlan, Sensors, Stroke

BENCH = Bench(10.0, 1000.0, 20.0, 0.5)
LOAD = RunPlan(Excitation("multisine", 1.0, 0.0, 1.0, 4.0, 0.5, 1.0, 0), 0.0, 20.0, 0)
STROKE = RunPlan(Stroke(0.05, 0.5, 0.5, 4.0, 1.0, 1.0, 0), 0.0, 20.0, 0)
TIMES = {"duration_s": 1.0, "live_force_ratio": 1.0}
BOUNDED = {"value": 1.0, "low": 0.9, "high": 1.1}
OPEN = {"value": 1.0, "low": None, "high": 1.1}
NOTHING = {"value": 0.1, "low": -0.1, "high": 0.3}


def case_of(*effects, roughness=None, plan=LOAD, kind="single"):
    families = tuple(effect.family for effect in effects)
    rough = roughness or Roughness()
    sensors = Sensors(1000, 1e-5)
    return Case("case", kind, families, effects, BENCH, sensors, plan, plan, 0, rough)


def diagnosis(verdict, *families, rivals=(), linear=()):
    effects = [
        {"family": f, "name": f, "strut": "strut", "parameters": {"size_n": BOUNDED}}
        for f in families
    ]
    corrections = [{"parameter": p, "nominal": 1.0, "total": BOUNDED} for p in linear]
    return {
        "verdict": verdict,
        "effects": effects,
        "linear": corrections,
        "ambiguous_with": list(rivals),
    }


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
        (("stop", "preload"), diagnosis("explained", "stop", linear=["preload_n"]), True),
        (("stop", "preload"), diagnosis("explained", "stop", linear=["mass_kg"]), False),
        (("stiffness",), diagnosis("explained", "preload", "stiffness"), True),
        (("preload",), diagnosis("explained", "stiffness", "preload"), False),
        (("stiffness",), diagnosis("explained", "stop", linear=["stiffness_n_per_m"]), False),
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


@pytest.mark.parametrize(
    ("planted", "answer", "right"),
    [
        (("stop",), diagnosis("explained", "stiffness", "stop"), True),
        (("stop",), diagnosis("explained", "stiffness", "friction", "stop"), False),
        ((), diagnosis("nothing_missing"), True),
        ((), diagnosis("explained", "stiffness", "preload"), True),
        ((), diagnosis("explained", "friction"), False),
        ((), diagnosis("not_explained"), False),
        ((), diagnosis("failed"), False),
    ],
)
def test_rough_models_are_right_in_what_is_not_linear(planted, answer, right):
    assert is_right(planted, answer, is_rough=True) is right


@pytest.mark.parametrize(
    ("answer", "is_rough", "wrong"),
    [
        (diagnosis("explained", "friction"), False, []),
        (diagnosis("explained", "friction", "stop"), False, ["stop"]),
        (diagnosis("explained", "friction", "damping"), False, ["damping"]),
        (diagnosis("explained", "friction", "damping"), True, []),
        (diagnosis("explained", "damping", linear=["damping_n_s_per_m"]), False, []),
        (diagnosis("not_explained", "restoring_surface"), False, []),
        (diagnosis("ambiguous", "stop", rivals=["friction"]), False, []),
        (diagnosis("ambiguous", "stop", "backlash", rivals=["friction"]), False, ["backlash"]),
        (diagnosis("ambiguous", "friction", "stop", rivals=["backlash"]), False, ["stop"]),
    ],
)
def test_false_names_are_what_is_not_there(answer, is_rough, wrong):
    assert false_names(("friction",), answer, is_rough=is_rough) == wrong


def test_a_candidate_that_is_not_there_is_counted_apart():
    answer = diagnosis("partly_explained", "friction", "stop")
    answer["effects"][1]["evidence"] = {"held_out": "unsettled"}
    assert false_names(("friction",), answer, is_rough=False) == []
    counted = false_names(("friction",), answer, is_rough=False, counted=is_candidate)
    assert counted == ["stop"]
    answer["effects"][1]["evidence"] = {"held_out": "confirmed"}
    assert false_names(("friction",), answer, is_rough=False) == ["stop"]


def test_names_without_any_interval_are_not_counted_as_false():
    answer = diagnosis("explained", "stop")
    answer["effects"][0]["parameters"] = {"stiffness_n_per_m": OPEN}
    assert false_names(("friction",), answer, is_rough=False) == []


@pytest.mark.parametrize(
    ("family", "parameters", "unbound"),
    [
        ("friction", {"coulomb_force_n": BOUNDED}, False),
        ("friction", {"coulomb_force_n": OPEN}, True),
        ("friction", {"coulomb_force_n": NOTHING, "stribeck_velocity_m_per_s": BOUNDED}, True),
        ("stop", {"contact_height_m": NOTHING, "stiffness_n_per_m": BOUNDED}, False),
        ("backlash", {"gap_m": NOTHING, "centre_height_m": BOUNDED}, True),
        ("backlash", {"gap_m": BOUNDED, "centre_height_m": OPEN}, False),
        ("restoring_surface", {}, False),
    ],
)
def test_unbound_effects_may_be_nothing(family, parameters, unbound):
    assert is_unbound({"family": family, "name": family, "parameters": parameters}) is unbound


@pytest.mark.parametrize(
    ("hits", "of", "low", "high"),
    [(0, 10, 0.0, 0.2775), (5, 10, 0.2366, 0.7634), (97, 100, 0.9155, 0.9897), (4, 4, 0.5101, 1)],
)
def test_rates_have_wilson_intervals(hits, of, low, high):
    found = rate([True] * hits + [False] * (of - hits))
    assert (found.hits, found.of, found.share) == (hits, of, hits / of)
    assert (found.low, found.high) == pytest.approx((low, high), abs=1e-4)


def test_rate_of_nothing_is_none():
    assert rate([]) == (0, 0, None, None, None)
    assert str(rate([])) == "-"


def correction(parameter, nominal, value, half):
    total = {"value": value, "low": value - half, "high": value + half}
    return {"parameter": parameter, "nominal": nominal, "total": total, "about_height_m": 0.4}


def totals(case, *corrections):
    answer = {"effects": [], "linear": list(corrections)}
    return [(i.parameter, i.truth, i.holds) for i in intervals(case, answer)]


def test_totals_are_held_against_the_true_bench():
    rough = case_of(roughness=Roughness(0.04, -0.13, 0.3), kind="rough_complete")
    found = totals(
        rough,
        correction("mass_kg", 10.4, 10.01, 0.02),
        correction("stiffness_n_per_m", 870.0, 990.0, 5.0),
        correction("damping_n_s_per_m", 26.0, 20.1, 0.2),
    )
    assert [(name, round(truth, 9), holds) for name, truth, holds in found] == [
        ("total.mass_kg", 10.0, True),
        ("total.stiffness_n_per_m", 1000.0, False),
        ("total.damping_n_s_per_m", 20.0, True),
    ]
    heavy = case_of(Planted("inertia", "rigid_mass", {"mass_kg": 3.0}))
    assert totals(heavy, correction("mass_kg", 10.0, 13.1, 0.2)) == [("total.mass_kg", 13.0, True)]


def test_totals_are_not_compared_where_the_law_changes_them_too():
    spring = case_of(Planted("nonlinear_stiffness", "cube_spring", {"stiffness_n_per_m3": 1e4}))
    both = [correction("mass_kg", 10.0, 10.0, 0.1), correction("stiffness_n_per_m", 1e3, 1e3, 9.0)]
    assert [name for name, *_ in totals(spring, *both)] == ["total.mass_kg"]
    assert totals(case_of(roughness=Roughness(input_gain=0.01)), *both) == []
    assert [name for name, *_ in totals(case_of(plan=STROKE), *both)] == ["total.stiffness_n_per_m"]


def test_preload_is_compared_where_stiffness_stands():
    lift = case_of(Planted("preload", "constant", {"force_n": 5.0}))
    preload = correction("preload_n", 98.1, 103.0, 0.2)
    stiffness = correction("stiffness_n_per_m", 1000.0, 1010.0, 20.0)
    [(name, truth, holds)] = totals(lift, preload)
    assert (name, holds) == ("total.preload_n", True)
    assert truth == pytest.approx(103.1)
    assert [name for name, *_ in totals(lift, preload, stiffness)] == ["total.stiffness_n_per_m"]


def test_unbounded_intervals_are_left_out():
    slide = case_of(Planted("friction", "stick", {"coulomb_n": 1.0}))
    answer = {"name": "coulomb_friction", "parameters": {"coulomb_force_n": OPEN}}
    assert intervals(slide, {"effects": [answer], "linear": []}) == []
    answer["parameters"]["coulomb_force_n"] = BOUNDED
    assert len(intervals(slide, {"effects": [answer], "linear": []})) == 1
    # A sensor that reads the load wrong makes every force as wrong.
    scaled = case_of(*slide.effects, roughness=Roughness(input_gain=0.02))
    assert intervals(scaled, {"effects": [answer], "linear": []}) == []
    foreign = case_of(*slide.effects, kind="rough_foreign-friction")
    assert intervals(foreign, {"effects": [answer], "linear": []}) == []


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
    held = intervals(case_of(play), {"effects": found, "linear": []})
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
    counts = {"single": 30, "pair": 10, "triple": 2, "complete": 5, "outside": 3, "foreign": 0}
    found = slots(counts, 0)
    assert len({slot.name for slot in found}) == 50
    kinds = [slot.kind for slot in found if slot.group == "single"]
    assert all(kinds.count(family) == 2 for family in FAMILIES)
    assert sum(slot.kind == "friction_and_cubic" for slot in found) == 2
    # An interrupted run has something of everything.
    assert {slot.group for slot in found[:15]} >= {"single", "pair", "complete"}


def test_defaults_and_a_part_of_them():
    counts = {name: group.cases for name, group in GROUPS.items()}
    assert 450 <= sum(counts.values()) <= 600
    assert part_of(counts, 1) == counts
    part = part_of(counts, 10)
    assert 45 <= sum(part.values()) <= 60
    assert all(bool(part[name]) == bool(counts[name]) for name in counts)
    kinds = [slot.kind for slot in slots(part, 0) if slot.group == "single"]
    assert len(set(kinds)) == len(kinds)


def test_arguments_choose_groups_and_counts(monkeypatch):
    given = ["x", "--out", "there", "--groups", "rough_pair,dyno", "--rough-pair", "30"]
    monkeypatch.setattr("sys.argv", [*given, "--one-of", "10"])
    args = command._arguments()
    assert command._counts(args) == {"rough_pair": 3, "dyno": 4}
    monkeypatch.setattr("sys.argv", ["x", "--out", "there", "--groups", "wobble"])
    with pytest.raises(SystemExit):
        command._arguments()


@pytest.mark.slow
def test_filled_slots_hold_what_they_are_for():
    assert fill(Slot("dyno", "dyno_friction", 0, 0)).is_dyno
    assert fill(Slot("single", "preload", 0, 0)).families == ("preload",)
    assert fill(Slot("complete", "complete", 0, 0)).families == ()


@pytest.mark.slow
def test_results_are_kept_and_tabulated(tmp_path, monkeypatch):
    calls = []

    def oracle(folder):
        calls.append(folder)
        truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        noise = truth["sensors"]["height_noise_m"]
        rmse = {"before": 50 * noise, "after": 1.1 * noise}
        answer = diagnosis("explained", *truth["families"])
        found = {"held_out": {"height_rmse_m": rmse}, "noise_floor": {"height_rmse_m": noise}}
        return answer | found, None

    monkeypatch.setattr(execution, "diagnose", oracle)
    slot = Slot("single", "preload", 0, 0)
    first = execute(slot, tmp_path, 60.0)
    assert first.right
    assert 0.9 < first.floor_multiple <= 1.1
    assert execute(slot, tmp_path, 60.0) == first == load_result(result_path(tmp_path, slot))
    assert len(calls) == 1
    summary = summarise([first])
    assert summary["groups"]["single"]["right"].share == 1.0
    assert summary["pools"]["one effect"] == summary["groups"]["single"]
    assert summary["pools"]["all"]["explained_within"].hits == 1
    assert summary["confusion"]["preload"] == {"preload": 1}
    write_tables([first], summary, tmp_path)
    kept = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert kept["groups"]["single"]["right"]["hits"] == 1
    table = (tmp_path / "table.md").read_text(encoding="utf-8").splitlines()
    assert all(line.count("|") == len(COLUMNS) + 2 for line in table)
    assert table[2].startswith("| single | 1 | 100 % (20.7-100) | 0 % (0-79.3) |")
    assert len((tmp_path / "cases.csv").read_text(encoding="utf-8").splitlines()) == 2
    console = Console(width=180, record=True, file=(tmp_path / "table.txt").open("w"))
    print_tables(summary, console)
    console.file.close()
    assert "preload" in console.export_text()


def test_dyno_is_judged_by_its_load_cell():
    case = case_of(plan=STROKE)
    force = {"before": 9.0, "after": 0.55}
    answer = diagnosis("explained") | {
        "held_out": {"height_rmse_m": None, "strut_force_rmse_n": force},
        "noise_floor": {"height_rmse_m": None, "residual_force_rmse_n": 0.5},
    }
    result = Result(**judge(case, (), answer, "slot", "dyno_complete"), **TIMES)
    assert (result.unit, result.error_before) == ("N", 9.0)
    assert result.floor_multiple == pytest.approx(1.1)


def fake_results(count, wrong):
    answers = [diagnosis("nothing_missing")] * (count - wrong)
    answers += [diagnosis("explained", "stop")] * wrong
    return [
        Result(**judge(case_of(), (), answer, "slot", "complete"), **TIMES | {"duration_s": 2.0})
        for answer in answers
    ]


def test_bounds_hold_a_figure_against_its_whole_interval():
    assert violations(summarise(fake_results(4, 0))) == []
    lines = violations(summarise(fake_results(4, 2)))
    assert any(line.startswith("nothing planted: right 50 %") for line in lines)
    assert any(line.startswith("all but outside: false_names") for line in lines)
    slow = (Bound("all", "seconds_worst", 0.0, 1.0, "quick"),)
    assert violations(summarise(fake_results(1, 0)), slow) == [
        "all: seconds_worst 2.0, not 0 to 1: quick"
    ]


def test_bounds_name_figures_that_exist():
    known = figures(fake_results(1, 0))
    for bound in BOUNDS:
        assert bound.pool in POOLS or bound.pool in GROUPS
        assert bound.figure in known
        assert bound.least <= bound.most


def test_tables_of_nothing_are_tables():
    summary = summarise([])
    assert markdown(summary).count("\n") == 2
    assert violations(summary) == []


def test_failure_is_reported_and_tried_again(tmp_path, monkeypatch):
    monkeypatch.setattr(execution, "diagnose", lambda _: (failed("it broke"), None))
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


def test_what_shows_beyond_the_planted_contact_overlaps_all_of_it():
    recorded = (0.3, 0.4)
    assert overlap([(0.3, 0.32)], (0.32, 9.0), recorded) == pytest.approx(1.0)
    assert overlap([(0.3, 0.32), (0.38, 0.4)], (0.32, 0.38), recorded) == pytest.approx(1.0)
    assert overlap([(0.3, 0.34)], (0.32, 9.0), recorded) == pytest.approx(2.0 / 3.0)
    assert overlap([(0.36, 0.4)], (0.32, 9.0), recorded) == 0.0
    assert overlap([], (0.2, 0.5), recorded) == 0.0


def test_a_stop_and_a_knee_are_held_against_where_they_were_planted():
    where = {
        "height_m": [[0.38, 0.4]],
        "velocity_m_per_s": [[-0.5, -0.1], [0.1, 0.5]],
        "recorded_height_m": [0.3, 0.4],
        "recorded_velocity_m_per_s": [-0.5, 0.5],
    }
    stop = Planted("stop", "linear_bumper", {"low_m": -1.0, "high_m": 0.38})
    knee = Planted("nonlinear_damping", "blow_off", {"knee_m_per_s": 0.1})
    case = case_of(stop, knee)
    named = [{"family": it.family, "where": where} for it in case.effects]
    assert list(overlaps(case, {"effects": named})) == pytest.approx([1.0, 1.0])
    assert list(overlaps(case, {"effects": named[:1]})) == pytest.approx([1.0])
    zone = case_of(Planted("nonlinear_damping", "taper", {"damping_n_s_per_m2": 1.0}))
    zone = replace(zone, bench=replace(zone.bench, free_length_m=0.35))
    below = where | {"height_m": [[0.3, 0.35]]}
    named = [{"family": "nonlinear_damping", "where": below}]
    assert list(overlaps(zone, {"effects": named})) == pytest.approx([1.0])
    assert not list(overlaps(case, {"effects": []}))


def test_a_corrected_model_that_explains_all_leaves_noise_alone_live():
    results = [
        Result(**judge(case_of(), (), diagnosis(verdict), "slot", "complete"), duration_s=1.0,
               live_force_ratio=ratio)
        for verdict, ratio in (
            ("nothing_missing", 1.0), ("nothing_missing", 9.0), ("partly_explained", 9.0),
            ("partly_explained", math.inf), ("partly_explained", None),
        )
    ]  # fmt: skip
    shown = figures(results)["runs_live"]
    assert (shown.hits, shown.of) == (2, 4)


@pytest.mark.slow
def test_a_model_follows_its_bench_and_another_does_not():
    """Noise alone where the model is right; with half of its spring more than noise."""
    noise_m = 1e-5
    recording = little_bench.run(little_bench.Nothing(), noise_m=noise_m)
    right, wrong = (
        live_force(
            little_bench.model(stiffness=share * little_bench.STIFFNESS),
            recording,
            noise_m,
            residual_n=0.1,
        )
        for share in (1.0, 0.5)
    )
    assert right < 2.0  # The applied force is held for a tick.
    assert wrong > 5.0


@pytest.mark.slow
def test_a_right_model_of_a_moved_bench_leaves_noise_alone_and_a_rough_one_does_not():
    case = make_moving(7, "moving_shaker")
    complete = replace(case, bench=nominal_bench(case.kind), effects=())
    assert live_force_of_moving(complete, nominal_model(case.kind)) == pytest.approx(1.0, abs=0.2)
    assert live_force_of_moving(case, case.model) > 5.0
