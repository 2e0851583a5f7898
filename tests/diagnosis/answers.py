"""What these tests ask of an answer: names, intervals, the linear part of a corrected model."""

from dataclasses import dataclass

import pytest

LINEAR_FAMILIES = frozenset({"preload", "stiffness", "damping", "inertia", "input_gain"})


def missing(found):
    """Names of what is missing, the linear families left out, strongest first."""
    return [effect.name for effect in found.effects if effect.family not in LINEAR_FAMILIES]


def named(found, family):
    """The only effect of a family."""
    (effect,) = [effect for effect in found.effects if effect.family == family]
    return effect


def correction(found, parameter):
    """The only linear correction of a parameter."""
    (item,) = [item for item in found.linear if item.parameter == parameter]
    return item


def holds(estimate, truth, slack=2e-3):
    """Whether an interval, widened by a share of the truth, holds the truth."""
    assert estimate.low is not None
    assert estimate.high is not None
    margin = slack * abs(truth)
    return estimate.low - margin <= truth <= estimate.high + margin


def overlap(one, other, slack=2e-3):
    """Whether two intervals, widened by a share of the value, have values in common."""
    for estimate in (one, other):
        assert estimate.low is not None
        assert estimate.high is not None
    margin = slack * max(abs(one.value), abs(other.value))
    return one.low - margin <= other.high and other.low - margin <= one.high


def is_at_the_floor(found, factor=1.3):
    """Whether the held-out error of the corrected model is at the floor."""
    force = found.held_out.strut_force_rmse_n
    if found.held_out.height_rmse_m.after == found.held_out.height_rmse_m.after:
        return found.held_out.height_rmse_m.after < factor * found.noise_floor.height_rmse_m
    assert force is not None
    return force.after < factor * found.noise_floor.residual_force_rmse_n


def same_answer(one, other, rel=0.01):
    """Assert that two diagnoses name the same, with the same parameters and verdict.

    Linear corrections within the accuracy are no difference.
    """
    same_names(one, other)
    for before, after in zip(one.effects, other.effects, strict=True):
        for name, estimate in before.parameters.items():
            assert after.parameters[name].value == pytest.approx(estimate.value, rel=rel), name


def same_names(one, other):
    """Assert that two diagnoses name the same, with the same verdict and the same rivals."""
    assert other.verdict == one.verdict
    assert [e.name for e in other.effects] == [e.name for e in one.effects]
    assert other.ambiguous_with == one.ambiguous_with


@dataclass(frozen=True)
class LinearPart:
    """Linear part of a corrected model with one body and one strut.

    Attributes:
        mass_kg: All that moves.
        stiffness_n_per_m: All springs.
        compression_n_s_per_m: All dampers, while heights fall.
        rebound_n_s_per_m: All dampers, while heights rise.
        force_n: Force of the linear part at the given height, at rest.
    """

    mass_kg: float
    stiffness_n_per_m: float
    compression_n_s_per_m: float
    rebound_n_s_per_m: float
    force_n: float


def linear_part(spec, height_m):
    """Linear part of a corrected model, wherever it stands: in body, strut or effects."""
    (strut,) = spec.struts
    (body,) = spec.skeleton.bodies
    mass, preload = body.mass_kg, 0.0
    stiffness = strut.stiffness_n_per_m
    compression = rebound = strut.damping_n_s_per_m
    for effect in strut.effects:
        values = effect.parameters
        if effect.name == "linear_stiffness":
            stiffness += values["stiffness_n_per_m"]
        elif effect.name == "linear_damping":
            compression += values["damping_n_s_per_m"]
            rebound += values["damping_n_s_per_m"]
        elif effect.name == "asymmetric_damping":
            compression += values["compression_n_s_per_m"]
            rebound += values["rebound_n_s_per_m"]
        elif effect.name == "added_mass":
            mass += values["mass_kg"]
        elif effect.name == "preload":
            preload += values["force_n"]
    force = stiffness * (strut.free_length_m - height_m) + preload
    return LinearPart(mass, stiffness, compression, rebound, force)
