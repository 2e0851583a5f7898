"""The thresholds of a search and its verdict, with their meaning and their source.

Priors, bounds of laws and limits of noise stand where they are used.

`python -m tests.criteria_study` shows how the hit rate moves when each is halved and doubled.
"""

from dataclasses import dataclass

from rig.diagnosis.outcome import IMPROBABLE


@dataclass(frozen=True)
class SelectionCriteria:
    """Thresholds of a search and its verdict.

    Attributes:
        blocks: Blocks of cross-validation over all recordings: the standard error of a sum over
            them is then known to an eighth (1 / sqrt(2 * blocks)), and each holds some periods.
        held_out_every: Without held-out runs, one block in so many is held out to evaluate on; a
            fifth is usual (Hastie, Tibshirani, Friedman, The Elements of Statistical Learning,
            2009, 7.10).
        screened: Laws of each round whose parameters are refined before they are compared: their
            order at unrefined starts is rough, and the cost of a round is proportional to this.
        beam: Combinations of laws that each round extends, so that an early choice can be revised.
        most_laws: Most laws of a model. A force needs three at most before a table
            describes it as well (measured dampers: the fourth gains less than the scatter between
            recordings).
        fitted_a_size: Combinations of each size that are fitted in simulation, apart from subsets
            of theirs; of the changes of a fitted model so many additions, with two exchanges of
            each law, and those of the same families that promise as much as the best (additions,
            if that is what a law has to gain) or begin as near to the model (exchanges).
        hopeless: Times the sum of squares of the best combination of a size, along the motion, from
            which on a combination of that size is not fitted in simulation, and a fitted model not
            near the best: smoothing the motion costs laws that switch a factor of two at most.
        standard_errors: Standard errors of the out-of-sample likelihood within which the smallest
            model is preferred: the one-standard-error rule (Breiman et al., Classification and
            Regression Trees, 1984, 3.4.3). With more, effects of few blocks would be lost: an
            effect that acts in k blocks alone gains sqrt(k) standard errors.
        level: Probability that any law is named where none is missing (Bonferroni, over all laws
            that are searched), and that a rival which is right, and as plain, is distinguished from
            the chosen model by chance: of Student's distribution of the logarithm of the residuals'
            ratio, by the blocks. A hundredth is usual where a name has consequences.
        least_likelihood_gain: Least gain of twice the out-of-sample log likelihood by a further
            law, a better formula or a linear correction. The best of some hundred useless starts
            gains 2 ln 100 = 9 by chance; an autocorrelated residual that much more often.
        least_share: Least share by which a further law reduces the mean square above the sensors'
            noise; 0.19 is a tenth of the RMS.
        least_above_noise: Mean square above the noise floor, as a share of the floor, below which
            no first law is searched: integration and interpolation err by as much.
        scatter: Standard deviations of the mean square of as many samples of white noise, that of
            Gauss, which is added to these shares: the best linear model of a bench that lacks
            nothing is above the floor in every second recording.
        least_above_noise_later: The same for a further law: the residual of a formula that is
            nearly right is no effect. An RMS 1.1 times the floor: half of what `explained` allows.
        formula: Share of the RMS residual of the best linear model below which the residual of a
            law is attributed to its formula, and a further law has to gain far more than a better
            formula would (`imitation`), unless one stores and one dissipates: two formulas for one
            effect agree to a few percent, at worst to 0.09, by the foreign formulas of
            `tests.truth`.
        imitation: Factor by which each further law then has to reduce the RMS residual, to be more
            than a part of a better formula; at the noise floor that of `hopeless` suffices. By the
            benches of the method's development: pairs reduced the residual of one law that imitated
            them to 0.15 or less, a second law that of a foreign formula only to 0.29 or more, two
            further ones to 0.16.
        significant: Least distance of a linear correction from zero, in standard deviations.
        bounded: The same for the size of an effect, the linear part projected out.
        cancelling: Correlation of two forces in one strut below which they cancel each other.
        improbable: Standard deviations of the model file's values from which on laws are not
            believed that need such a mass, stiffness or damping, where no correction alone does (to
            two deviations) and a gain of the applied force does not (all in one proportion, to a
            tenth of a deviation): one in some ten thousand is as far off (Gauss), so that the laws
            are the likelier error.
        leftover: Least share of a law's force along the motion that no change of the linear part
            replaces; with less the law is a linear correction, unless it is at the noise floor and
            the best linear model is not. A force is seldom known to less (class 0.5 of ISO 7500-1
            is half a percent).
        passive: Share of the largest dissipated power that a corrected strut may feed in, a
            tolerance for the rounding of a fit.
        dissipating_to: Multiple of the largest recorded velocity up to which a corrected strut has
            to dissipate: where its force drives, a model that an observer disturbs does not come
            back. Ten times the speeds of a test are beyond any bench.
        slow: Velocity, as a share of its RMS, below which a damper hardly acts, but friction does.
        dry: Share of its force at usual velocities that friction has there, at least; what
            corrects the formula of a damper grows with velocity, to a fifth of it.
        explained: Multiple of the noise floor that a right model does not exceed on held-out data:
            the scatter of an RMS over some hundred independent samples.
        settled: Multiple of the noise floor up to which a set may owe what it leaves to a formula:
            on held-out data further names are believed, and in the search other formulas are tried.
            Beyond it a further law may stand in for what the formula of another lacks: of partial
            explanations by several laws in the method's development, right ones left 3.4 times the
            floor at most, and those with a false further name 6 times and more, but for one.
        leading: Share of the best linear model's residual force on held-out data that a model
            beyond that may leave for its first name to be believed: in the same cases a false one
            left a third of the error and more, right ones a tenth or less; the measured stage EMPS
            leaves a quarter of the force beside its friction.
        partly: Share by which laws have to reduce the RMS error of the best linear model on
            held-out data to be a partial explanation.
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
    level: float = 0.01
    least_likelihood_gain: float = 30.0
    least_share: float = 0.19
    least_above_noise: float = 0.01
    scatter: float = 2.0
    least_above_noise_later: float = 0.2
    formula: float = 0.1
    imitation: float = 0.2
    significant: float = 4.0
    bounded: float = 4.0
    cancelling: float = -0.9
    improbable: float = IMPROBABLE
    leftover: float = 0.005
    passive: float = 0.02
    dissipating_to: float = 10.0
    slow: float = 0.2
    dry: float = 0.5
    explained: float = 1.2
    settled: float = 5.0
    leading: float = 0.3
    partly: float = 0.25
    white: float = 0.001


STORING = {"nonlinear_stiffness", "backlash"}
"""Families whose force is a function of height alone, and that return the energy they take."""
DISSIPATING = {"nonlinear_damping", "friction", "fade"}
"""Families with which a damper dissipates energy; bristles store a little. They hardly imitate
those that store it; stops that damp, hysteresis, delays, hidden masses and forces over time do."""
REMEMBERING = {"friction", "hysteresis"}
"""Families whose force depends on where the motion turned; their formulas imitate each other."""

CRITERIA = SelectionCriteria()
"""The criteria of `rig diagnose`."""
