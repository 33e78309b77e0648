"""What paired runs say about lines of a table: intervals, tests, verdicts, aggregates.

A score is a number per line, problem and seed, of which more is better: the log gain, in points.
A block is a problem and a seed; lines are compared within blocks, since the seed fixes data order
and initial weights for all of them.

Shapes: L lines, M problems, N seeds, B blocks, R runs, S sign patterns or resamples. NaN is a run
that is missing, -inf a run that failed: it is the worst that can be, and is never dropped.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]
LEVEL = 0.95
MARGIN = 1.0  # points of gain within which two lines are called equivalent
FLIPS = 2**16  # sign patterns: all of them up to 16 blocks, as many random ones above
RESAMPLES = 10_000


@dataclass(frozen=True)
class Estimate:
    """A mean and its interval; NaN where there are too few runs to know."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class Comparison:
    """A line against the control, over the blocks that both have."""

    difference: Estimate  # at LEVEL, points
    ahead: bool  # the mean difference, failed runs clipped, is above 0
    within: bool  # the 90 % interval lies inside the margin
    superior: float  # share of blocks in which the line is ahead, ties half
    p: float  # sign-flip test, two-sided
    p_holm: float  # over the declared family
    blocks: int
    failed: int  # blocks of these in which one of the two failed, or both

    @property
    def verdict(self) -> str:
        """better | worse | equivalent | open."""
        if self.p_holm <= 1 - LEVEL:
            return "better" if self.ahead else "worse"
        return "equivalent" if self.within else "open"


# --- means and intervals --------------------------------------------------------------------------


def stratified_t(x_MN: Array, level: float = LEVEL) -> Estimate:
    """Interval for the mean over problems of the mean over seeds; the problems are given.

    Degrees of freedom as of Welch and Satterthwaite: problems may differ in spread and in n. Of one
    problem it is Student's interval, and not a percentile bootstrap, which covers 75 % in place of
    95 % with three seeds, and 83 % with five.
    """
    strata = [row[~np.isnan(row)] for row in x_MN]
    strata = [row for row in strata if len(row)]
    if not strata:
        return Estimate(np.nan, np.nan, np.nan)
    with np.errstate(invalid="ignore"):  # runs of both sides failed
        mean = float(np.mean([row.mean() for row in strata]))
    if not np.isfinite(mean) or any(len(row) < 2 for row in strata):
        return Estimate(mean, np.nan, np.nan)
    parts = np.array([row.var(ddof=1) / len(row) for row in strata]) / len(strata) ** 2
    variance = parts.sum()
    if variance == 0:
        return Estimate(mean, mean, mean)
    freedom = variance**2 / sum(p**2 / (len(r) - 1) for p, r in zip(parts, strata, strict=True))
    half = float(stats.t.ppf((1 + level) / 2, freedom) * np.sqrt(variance))
    return Estimate(mean, mean - half, mean + half)


def iqm(score_MN: Array) -> Array:
    """Interquartile mean: of the middle half of all runs; leading dimensions stay.

    Source: Agarwal et al., NeurIPS 2021. A failed run is among the lowest, and so is cut off.
    """
    sorted_R = np.sort(score_MN.reshape(*score_MN.shape[:-2], -1))  # NaN come last
    known = np.sum(~np.isnan(sorted_R), axis=-1, keepdims=True)
    place = np.arange(sorted_R.shape[-1])
    middle = (place >= known // 4) & (place < known - known // 4)
    with np.errstate(invalid="ignore"):
        found: Array = np.where(middle, sorted_R, 0).sum(-1) / middle.sum(-1)
    return found


def bootstrap(
    score_LMN: Array,
    aggregate: Callable[[Array], Array] = iqm,
    *,
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> list[Estimate]:
    """Percentile intervals of an aggregate over the suite, for each line.

    Seeds are drawn with replacement within each problem, the same ones for every line, so that
    differences between lines keep their pairing. With five seeds a problem a nominal 95 % covers
    about 91 %: `tests/report/test_evidence.py` measures it.
    """
    drawn_SL = np.stack([aggregate(scores) for scores in resampled(score_LMN, resamples, seed)])
    tails = [50 * (1 - level), 50 * (1 + level)]
    ends = np.percentile(drawn_SL, tails, axis=0, method="inverted_cdf")
    found = zip(aggregate(score_LMN), *ends, strict=True)
    return [Estimate(float(mean), float(low), float(high)) for mean, low, high in found]


def resampled(score_LMN: Array, resamples: int, seed: int) -> Iterator[Array]:
    """Scores with the seeds of each problem drawn anew, jointly for all lines."""
    _, problems, seeds = score_LMN.shape
    draws = np.random.default_rng(seed).integers(seeds, size=(resamples, 1, problems, seeds))
    return (np.take_along_axis(score_LMN, draw, axis=2) for draw in draws)


# --- tests and verdicts ---------------------------------------------------------------------------


def compare(
    score_LMN: Array, control_MN: Array, margin: float = MARGIN, seed: int = 0
) -> list[Comparison]:
    """Every line against one control; the lines are the family of Holm's correction.

    Args:
        score_LMN: the control is none of them.
        margin: of equivalence, in points of the score.
    """
    found = []
    for line_MN in score_LMN:
        d_MN = difference(line_MN, control_MN)
        d_B = d_MN[~np.isnan(d_MN)]
        # a tie of two failed runs is no sign that the lines are alike
        apart_MN = np.where(np.isneginf(line_MN) & ~np.isnan(d_MN), -np.inf, d_MN)
        narrow = stratified_t(apart_MN, 0.9)
        found.append(
            Comparison(
                difference=stratified_t(apart_MN),
                ahead=bool(clipped(d_B).sum() > 0),
                within=-margin < narrow.low and narrow.high < margin,
                superior=superiority(d_B),
                p=sign_flip(d_B, seed),
                p_holm=np.nan,
                blocks=len(d_B),
                failed=int(np.isinf(apart_MN).sum()),
            )
        )
    corrected = holm([each.p for each in found])
    return [replace(each, p_holm=p) for each, p in zip(found, corrected, strict=True)]


def difference(x: Array, y: Array) -> Array:
    """x - y in every block that has both; 0 where both failed."""
    with np.errstate(invalid="ignore"):
        return np.where(x == y, 0.0, x - y)


def clipped(d_B: Array) -> Array:
    """Finite differences: that of a failed run is twice the largest that was measured."""
    finite = np.abs(d_B[np.isfinite(d_B)])
    bound = 2 * finite.max() if finite.any() else 1.0
    return np.clip(d_B, -bound, bound)


def sign_flip(d_B: Array, seed: int = 0) -> float:
    """Two-sided p of a mean of 0 for paired differences: the share of sign patterns whose mean is
    as far from 0. It is exact up to 16 blocks, and takes FLIPS random patterns above."""
    blocks = len(d_B)
    if not blocks:
        return np.nan
    exact = 2**blocks <= FLIPS
    if exact:
        bits_SB = np.arange(2**blocks)[:, None] >> np.arange(blocks) & 1
    else:
        bits_SB = np.random.default_rng(seed).integers(2, size=(FLIPS, blocks))
    d_B = clipped(d_B)
    observed = abs(d_B.sum()) * (1 - 1e-12)  # its own pattern counts, whatever the rounding
    as_far = int((np.abs((1 - 2 * bits_SB) @ d_B) >= observed).sum())
    return as_far / 2**blocks if exact else (as_far + 1) / (FLIPS + 1)


def holm(p_L: Sequence[float]) -> list[float]:
    """Holm's step-down correction; a NaN belongs to no family and stays one."""
    corrected = np.full(len(p_L), np.nan)
    order = [i for i in np.argsort(p_L) if not np.isnan(p_L[i])]
    reached = 0.0
    for rank, index in enumerate(order):
        reached = max(reached, min(1.0, (len(order) - rank) * p_L[index]))
        corrected[index] = reached
    return [float(p) for p in corrected]


def superiority(d_B: Array) -> float:
    """Share of blocks in which a line is ahead, ties half: P(X > Y), paired."""
    return float(np.mean((np.sign(d_B) + 1) / 2)) if len(d_B) else np.nan
