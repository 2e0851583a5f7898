"""The numbers that decide what is found, with their meaning and their source.

Priors, bounds of laws and limits of noise stand where they are used.

`python -m tests.criteria_study` shows how the hit rate moves when each is halved and doubled.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class SelectionCriteria:
    """What decides in a search.

    Attributes:
        blocks: Blocks of cross-validation over all recordings: the standard error of a sum over
            them is then known to an eighth (1 / sqrt(2 * blocks)), and each holds some periods.
        held_out_every: Without held-out runs, one block of so many is held out to be judged on; a
            fifth is usual (Hastie, Tibshirani, Friedman, The Elements of Statistical Learning,
            2009, 7.10).
        screened: Laws of each round whose parameters are refined before they are compared: their
            order at starts that nothing has adapted is rough, and a round costs as much as it has.
        beam: Sets of laws that each round goes on from, so that an early choice can be revisited.
        most_laws: Laws that a finding may consist of. A force needs three at most before a table
            describes it as well (measured dampers: the fourth gains less than the scatter between
            recordings).
        fitted_a_size: Sets of each size that are fitted in full, smaller ones of theirs apart;
            changes of a fitted set likewise.
        hopeless: Times the sum of squares of the best set of a size, along the motion, from which
            on a set of that size is not fitted in full, and no longer near the best where sets were
            fitted: smoothing the motion costs laws that switch a factor of two at most.
        standard_errors: Standard errors of the out-of-sample likelihood within which the smallest
            set is preferred: the one-standard-error rule (Breiman et al., Classification and
            Regression Trees, 1984, 3.4.3). More would lose what shows in few blocks: of an effect
            that acts in k of them alone the gain is sqrt(k) standard errors.
        least_likelihood_gain: Least gain of twice the out-of-sample log likelihood by a further
            law, a better formula or a linear correction. The best of some hundred useless starts
            gains 2 ln 100 = 9 by chance; an autocorrelated residual that much more often.
        least_share: Least share of the mean square above the noise floor that a further law takes
            away; 0.19 is a tenth of the RMS.
        least_above_noise: Mean square above the noise floor, as a share of the floor, below which
            no first law is looked for: integration and interpolation err by as much.
        least_above_noise_later: The same for a further law: what a formula that is nearly right
            leaves over is no effect. An RMS 1.1 times the floor: half of what `explained` allows.
        formula: Share of the RMS residual of the best linear model below which what a law leaves is
            put down to its formula, and a further law has to do far more than a better formula
            would (`imitation`), unless one stores and one dissipates: two formulas for one effect
            agree to a few percent, at worst to 0.09, as seen on the foreign formulas of
            `tests.truth`.
        imitation: Factor by which each further law then has to lower the RMS that is left, to be
            more than a part of a better formula; at the noise floor that of `hopeless` will do.
            Seen on benches that developed the method: pairs that one law imitated left up to 0.15,
            a second law beside a foreign formula 0.29 and more, two of them 0.16.
        significant: Times its standard deviation that a linear correction is away from nothing.
        bounded: The same for the size of an effect, beyond what the linear part could give.
        cancelling: Correlation of two forces in one strut below which they cancel each other.
        leftover: Share of a law's force along the motion that no change of the linear part could
            give; with less the law is a linear correction in disguise. A force is seldom known to
            less (class 0.5 of ISO 7500-1 is half a percent).
        passive: Share of the largest dissipated power that a corrected strut may feed in, for the
            rounding of a fit.
        explained: Multiple of the noise floor that a right model stays below on held-out data: the
            scatter of an RMS over some hundred independent samples.
        partly: Share of the RMS error of the best linear model on held-out data that laws have to
            take away to be called a partial explanation.
        white: Level of the whiteness test.
    """

    blocks: int = 32
    held_out_every: int = 5
    screened: int = 10
    beam: int = 3
    most_laws: int = 3
    fitted_a_size: int = 4
    hopeless: float = 4.0
    standard_errors: float = 1.0
    least_likelihood_gain: float = 30.0
    least_share: float = 0.19
    least_above_noise: float = 0.01
    least_above_noise_later: float = 0.2
    formula: float = 0.1
    imitation: float = 0.2
    significant: float = 4.0
    bounded: float = 4.0
    cancelling: float = -0.9
    leftover: float = 0.005
    passive: float = 0.02
    explained: float = 1.2
    partly: float = 0.25
    white: float = 0.001


STORING = {"nonlinear_stiffness", "backlash"}
"""Families whose force follows the height alone, and gives back what it takes."""
DISSIPATING = {"nonlinear_damping", "friction", "fade"}
"""Families with which a damper takes energy; bristles store a little. They hardly imitate those
that store it; stops that damp, hysteresis, delays, hidden masses and forces over time do."""

CRITERIA = SelectionCriteria()
"""The criteria of `rig diagnose`."""
