"""Every kind of problem answers the whole protocol, and its answers fit together."""

import inspect
import math
from dataclasses import replace

import numpy as np
import pytest

from dart_model.effects import CATALOGUE
from rig.diagnosis.diagnose import first_fits, with_noise_of_least_force
from rig.diagnosis.estimates import FitEstimates
from rig.diagnosis.evaluate import evaluate_held_out
from rig.diagnosis.problem.build import (
    Problems,
    build_problems,
    build_without_delays,
    problem_kind,
)
from rig.diagnosis.problem.free_run import FreeRunProblem
from rig.diagnosis.problem.prescribed_motion import PrescribedProblem
from rig.diagnosis.problem.problem import Problem, nominal
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.fit import fit_covariance, validation_costs
from tests.diagnosis import little_bench, little_dyno

BENCHES = {FreeRunProblem: little_bench, PrescribedProblem: little_dyno}
"""A bench of one strut for each kind of problem; another kind needs its bench here."""


def kinds():
    """All kinds of problem, further ones included."""
    todo, found = list(Problem.__subclasses__()), []
    while todo:
        kind = todo.pop()
        todo += kind.__subclasses__()
        found += [] if inspect.isabstract(kind) else [kind]
    return sorted(found, key=lambda kind: kind.__name__)


@pytest.fixture(params=kinds(), ids=lambda kind: kind.__name__, scope="module")
def problems(request):
    bench = BENCHES[request.param]
    runs = [bench.run(bench.Nothing(), seed=seed, duration_s=4.0) for seed in (1, 2, 3)]
    assert problem_kind(runs) is request.param
    return build_problems(bench.model(), runs[:2], runs[2:], CRITERIA.blocks, 5)


@pytest.fixture(scope="module")
def fits(problems):
    return first_fits(problems.learnt)


def test_every_kind_has_a_bench_and_a_catalogue_of_laws():
    assert set(kinds()) == set(BENCHES)
    benches = [kind.bench for kind in kinds()]
    assert len(set(benches)) == len(benches)
    assert all(any(bench in law.benches for law in CATALOGUE.values()) for bench in benches)


def test_recordings_have_grids_blocks_and_residuals_of_one_length(problems, fits):
    problem, model = problems.learnt, fits[0].model
    assert all(note.endswith(".") for note in problem.assumptions)
    assert problem.recordings == len(problem.grids) == len(model.parts.starts) == 2
    for k, grid in enumerate(problem.grids):
        residual, blocks = problem.residual(k, model), problem.blocks(k)
        assert problem.fit_nodes(k).shape == grid.t_s.shape
        assert residual.shape == blocks.shape
        assert len(residual) == problem.fit_nodes(k).sum()
        assert blocks.min() == 0
        assert np.all(np.isfinite(residual))


def test_a_complete_models_residual_is_at_its_floor(problems, fits):
    given, linear = fits
    for fit in (given, linear):
        level = problems.learnt.floor_level(fit.model)
        assert level >= 1.0
        assert fit.mean_square == pytest.approx(level, rel=0.2)
    assert validation_costs(problems.learnt, given).sum() == pytest.approx(given.rows, rel=0.2)


def test_starts_scales_and_states_belong_to_a_candidates_laws(problems, fits):
    problem, parts = problems.learnt, fits[0].parts
    for name, states in (("cubic_stiffness", 0), ("maxwell", 1)):
        candidate = nominal(problem).with_effects((0, name))
        scales, fitted = problem.start_scales(candidate)
        start = problem.start(0, candidate)
        assert start.shape == scales.shape == fitted.shape
        assert len(start) == len(parts.starts[0]) + states
        model = fits[0].model._replace(parts=parts._replace(starts=(start, start)))
        assert len(problem.states(0, model)) == states


def test_residual_forces_lie_along_the_motion_and_are_small(problems, fits):
    problem = problems.learnt
    for k, grid in enumerate(problem.grids):
        forces = problem.residual_forces(k, fits[1].model)
        assert forces.name == grid.name
        assert forces.force_n.shape == forces.deviation_n.shape == (1, len(grid.t_s))
        assert forces.track.heights_m.shape == (1, len(grid.t_s))
        inner = slice(len(grid.t_s) // 10, -len(grid.t_s) // 10)
        assert np.std(forces.force_n[0, inner]) < 5.0 * np.median(forces.deviation_n[0, inner])
    rms_n = problem.residual_force_rms_n(fits[1].mean_square)
    assert np.isnan(rms_n) or rms_n > 0.0


def test_noise_of_a_model_is_no_larger_than_that_of_a_worse_one(problems, fits):
    again = problems.learnt.with_noise_of(fits[1].model)
    assert type(again) is type(problems.learnt)
    assert np.sum(again.residual(0, fits[1].model) ** 2) >= 0.99 * np.sum(
        problems.learnt.residual(0, fits[1].model) ** 2
    )


def test_finer_steps_change_a_residual_by_less_than_its_noise(problems, fits):
    finer = problems.learnt.finer()
    if finer is None:
        return
    change = finer.residual(0, fits[0].model) - problems.learnt.residual(0, fits[0].model)
    assert np.max(np.abs(change)) < 0.1


def test_pieces_are_parts_of_the_recordings(problems):
    problem = problems.learnt
    part = problem.cut([(1, slice(10, 210)), (0, slice(0, 300))])
    assert [len(grid.t_s) for grid in part.grids] == [200, 300]
    assert np.array_equal(part.grids[0].t_s, problem.grids[1].t_s[10:210])
    assert part.basis == problem.basis


def test_the_regression_about_a_model_responds_to_forces_linearly(problems, fits):
    problem = problems.learnt
    for segment in problem.segments(fits[0].model, 500, 2):
        rows = len(segment.target)
        assert segment.linear.shape == (rows, len(problem.linear))
        assert len(segment.initial) == len(segment.blocks) == rows
        force = np.sin(segment.track.t_s)[:, np.newaxis]
        twice = segment.respond(0, 2.0 * force)
        assert twice == pytest.approx(2.0 * segment.respond(0, force), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("by_blocks", [False, True])
def test_held_out_figures_make_an_outcome(problems, fits, by_blocks):
    given, linear = fits
    if by_blocks:
        problems = with_last_fifth_held_out(problems.learnt)
    for run in evaluate_held_out(problems, linear, given):
        assert run.target.after == pytest.approx(run.target.before)
        assert run.drift_m >= 0.0
        assert run.series[0].t_s.shape == run.series[0].measured.shape
        assert {item.unit for item in run.series} <= {"m", "N"}


def with_last_fifth_held_out(learnt):
    """A problem of which the last fifth takes no part in fits."""
    changed = []
    for run in learnt.runs:
        held_out = np.arange(len(run.grid.t_s)) > 0.8 * len(run.grid.t_s)
        grid = run.grid._replace(held_out=held_out, fitted=run.grid.fitted & ~held_out)
        changed.append(run._replace(grid=grid))
    problem = replace(learnt, runs=tuple(changed))
    return Problems(problem, problem, by_blocks=True)


def test_a_parameter_that_changes_nothing_has_no_interval():
    """Such as the velocity of a Stribeck curve at whose bound static and dynamic friction agree."""
    problem = build_without_delays(
        little_bench.model(), [little_bench.run(little_bench.Nothing())], 8, None
    )
    _, linear = first_fits(problem)
    known = FitEstimates(linear, fit_covariance(linear)).estimate(0)
    assert known.low < known.value < known.high
    solution = linear.solution
    jacobian, prior = solution.jacobian.copy(), solution.prior.copy()
    jacobian[:, 0], prior[0] = 0.0, 0.0
    blind = linear._replace(solution=solution._replace(jacobian=jacobian, prior=prior))
    unknown = FitEstimates(blind, fit_covariance(blind)).estimate(0)
    assert (unknown.value, unknown.low, unknown.high) == (known.value, None, None)


class Hum(little_bench.Nothing):
    def force(self, t, z, v, state):
        return 4.0 * math.cos(2.0 * math.pi * 5.3 * t)


@pytest.mark.parametrize("is_given_nearer", [True, False])
def test_tones_are_those_of_the_least_residual_force(is_given_nearer):
    """A fit may match the heights better by a mass that is far too large: its force does not."""
    problem = build_without_delays(little_bench.model(), [little_bench.run(Hum())], 32, None)
    given, linear = first_fits(problem)
    mass = np.array([20.0 * (parameter.kind == "mass") for parameter in problem.linear])
    heavy = linear._replace(model=linear.model.with_linear(mass))
    fits = (given, heavy) if is_given_nearer else (heavy, linear)
    (motion,) = with_noise_of_least_force(problem, fits).motions
    assert motion.tones[0][0] == pytest.approx(5.3, rel=0.01)
    assert motion.force_n < 4.0
