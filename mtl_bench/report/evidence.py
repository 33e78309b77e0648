"""What paired runs say about lines of a table: intervals, tests, verdicts, aggregates, ranks.

A score is a number per line, problem and seed, of which more is better: the log gain, in points.
A block is a problem and a seed; lines are compared within blocks, since the seed fixes data order
and initial weights for all of them.

Shapes: L lines, M problems, N seeds, B blocks, R runs, S sign patterns or resamples, K tasks, F
points of a front, T trials. NaN is a run that is missing, -inf a run that failed: it is the worst
that can be, and is never dropped.
"""

import functools
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
AT_A_TIME = 500  # resamples in memory


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
    ahead: bool  # the mean difference, as the test sees it, is above 0
    within: bool  # the 90 % interval lies inside the margin
    superior: float  # share of blocks in which the line is ahead, ties half
    p: float  # two-sided
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
    drawn = resampled(score_LMN, resamples, seed)
    drawn_SL = np.concatenate([aggregate(score_SLMN) for score_SLMN in drawn])
    tails = [50 * (1 - level), 50 * (1 + level)]
    ends = np.percentile(drawn_SL, tails, axis=0, method="inverted_cdf")
    found = zip(aggregate(score_LMN), *ends, strict=True)
    return [Estimate(float(mean), float(low), float(high)) for mean, low, high in found]


def resampled(score_LMN: Array, resamples: int, seed: int) -> Iterator[Array]:
    """Scores with the seeds of each problem drawn anew, jointly for all lines: [S, L, M, N]s."""
    _, problems, seeds = score_LMN.shape
    draws = np.random.default_rng(seed).integers(seeds, size=(resamples, 1, problems, seeds))
    for start in range(0, resamples, AT_A_TIME):
        yield np.take_along_axis(score_LMN[None], draws[start : start + AT_A_TIME], axis=3)


# --- tests and verdicts ---------------------------------------------------------------------------


def compare(
    score_LMN: Array,
    control_MN: Array,
    test: Callable[[Array], float] | None = None,
    margin: float = MARGIN,
) -> list[Comparison]:
    """Every line against one control; the lines are the family of Holm's correction.

    What is tested is what is printed, the mean over problems of the mean over seeds: where runs are
    missing, a block of a problem with fewer of them weighs more.

    Args:
        score_LMN: the control is none of them.
        test: two-sided p of what each block adds to the mean; None: `sign_flip`.
        margin: of equivalence, in points of the score.
    """
    found = []
    for line_MN in score_LMN:
        d_MN = difference(line_MN, control_MN)
        known_MN = ~np.isnan(d_MN)
        d_B, part_B = d_MN[known_MN], (d_MN * _weights(known_MN))[known_MN]
        # a tie of two failed runs is no sign that the lines are alike
        apart_MN = np.where(np.isneginf(line_MN) & known_MN, -np.inf, d_MN)
        narrow = stratified_t(apart_MN, 0.9)
        found.append(
            Comparison(
                difference=stratified_t(apart_MN),
                ahead=bool(clipped(part_B).sum() > 0),
                within=-margin < narrow.low and narrow.high < margin,
                superior=superiority(d_B),
                p=(test or sign_flip)(part_B),
                p_holm=np.nan,
                blocks=len(d_B),
                failed=int(np.isinf(apart_MN).sum()),
            )
        )
    corrected = holm([each.p for each in found])
    return [replace(each, p_holm=p) for each, p in zip(found, corrected, strict=True)]


def _weights(known_MN: NDArray[np.bool_]) -> Array:
    """Of a problem's blocks: 1 where it has as many as any, more where it has fewer."""
    count_M1 = known_MN.sum(1, keepdims=True)
    found: Array = count_M1.max() / np.maximum(count_M1, 1)
    return found


def ahead(value_LN: Array, control_N: Array) -> list[bool]:
    """Which lines lead a control in one problem: the paired difference's interval is above 0, and
    its p, by Holm over the lines, at most 1 - LEVEL."""
    differences = [difference(value_N, control_N) for value_N in value_LN]
    known = [d_N[~np.isnan(d_N)] for d_N in differences]
    corrected = holm([student(d_B) for d_B in known])
    return [
        bool(p <= 1 - LEVEL and d_B.mean() > 0) for p, d_B in zip(corrected, known, strict=True)
    ]


def difference(x: Array, y: Array) -> Array:
    """x - y in every block that has both; 0 where both failed."""
    with np.errstate(invalid="ignore"):
        return np.where(x == y, 0.0, x - y)


def clipped(d_B: Array) -> Array:
    """Finite differences: that of a failed run is twice the largest that was measured."""
    finite = np.abs(d_B[np.isfinite(d_B)])
    bound = 2 * finite.max() if finite.any() else 1.0
    return np.clip(d_B, -bound, bound)


def sign_flip(d_B: Array) -> float:
    """Two-sided p of a mean of 0 for paired differences: the share of sign patterns whose mean is
    as far from 0. It is exact up to 16 blocks, and takes FLIPS random patterns above."""
    blocks = len(d_B)
    if not blocks:
        return np.nan
    d_B = clipped(d_B)
    observed = abs(d_B.sum()) * (1 - 1e-12)  # its own pattern counts, whatever the rounding
    as_far = int((np.abs(_signs(blocks) @ d_B) >= observed).sum())
    return as_far / 2**blocks if 2**blocks <= FLIPS else (as_far + 1) / (FLIPS + 1)


@functools.lru_cache(maxsize=4)  # lines of a table have the same number of blocks
def _signs(blocks: int) -> Array:
    """Sign patterns, [S, B]."""
    if 2**blocks <= FLIPS:
        bits_SB = np.arange(2**blocks)[:, None] >> np.arange(blocks) & 1
    else:
        bits_SB = np.random.default_rng(0).integers(2, size=(FLIPS, blocks))
    return np.where(bits_SB == 1, -1.0, 1.0)


def student(d_B: Array) -> float:
    """Two-sided p of a mean of 0 for the paired differences of one problem, by Student's test: it
    fits `stratified_t`. NaN for fewer than two, and where one of a pair failed."""
    if len(d_B) < 2 or not np.isfinite(d_B).all():
        return np.nan
    if np.ptp(d_B) <= 1e-9 * np.abs(d_B).max():  # what is the same for all seeds, such as a size
        return 0.0 if d_B.any() else 1.0
    return float(stats.ttest_1samp(d_B, 0).pvalue)


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


# --- the suite as a whole -------------------------------------------------------------------------


def profile(score_MN: Array, tau_T: Array) -> Array:
    """Share of runs whose score is above each threshold. Source: Agarwal et al., NeurIPS 2021."""
    known = score_MN[~np.isnan(score_MN)]
    return np.array([(known > tau).mean() if len(known) else np.nan for tau in tau_T])


def expected_best(score_T: Array) -> Array:
    """Expected score of the best of n trials, for n from 1 to all that there are.

    Source: Dodge et al., EMNLP 2019: one set of finished trials gives every smaller budget, drawn
    from them with replacement.

    Args:
        score_T: finite.
    """
    trials = len(score_T)
    share = np.arange(trials + 1) / trials
    budget_T = np.arange(1, trials + 1)[:, None]
    weight_TT = share[1:] ** budget_T - share[:-1] ** budget_T
    found: Array = weight_TT @ np.sort(score_T)
    return found


def behind_front(point_K: Array, front_FK: Array) -> float:
    """How far a point must improve in every task not to be dominated by a front; 0 or less: it is
    on the front or beyond it (the additive epsilon indicator)."""
    return float(np.max(np.min(front_FK - point_K, axis=1)))


def ranks(score_XL: Array) -> Array:
    """Ranks along the last dimension, 1 the best; equal ones share the mean of their ranks, and a
    NaN has none."""
    return np.asarray(stats.rankdata(-score_XL, axis=-1, nan_policy="omit"), float)


def seed_mean(score_XMN: Array) -> Array:
    """Mean over seeds; NaN for a problem without runs."""
    known = ~np.isnan(score_XMN)
    with np.errstate(invalid="ignore"):
        found: Array = np.where(known, score_XMN, 0).sum(-1) / known.sum(-1)
    return found


def suite_mean(score_XMN: Array) -> Array:
    """Mean over problems of the mean over seeds; NaN for a line that lacks a problem."""
    found: Array = seed_mean(score_XMN).mean(-1)
    return found


def rank_bands(
    definitions: Sequence[Array], resamples: int = 1000, seed: int = 0
) -> tuple[Array, Array]:
    """Best and worst rank of each line, [L, 2]: over choices that a report makes, and over seeds.

    The choices are how a score is defined and which problem is left out. Of the ranks under
    resampled seeds, drawn jointly for all lines, the band is the middle LEVEL. A rank depends on
    the lines that are ranked: they are the same throughout, those that have every problem. One
    that has no run of a problem among the drawn seeds counts there with its mean over all.

    Args:
        definitions: scores of the same runs, [L, M, N] each; the first is resampled.
    """
    problems = definitions[0].shape[1]
    lacks_L = np.isnan(suite_mean(definitions[0]))
    definitions = [np.where(lacks_L[:, None, None], np.nan, s) for s in definitions]
    chosen = [suite_mean(score_LMN) for score_LMN in definitions]
    if problems > 1:
        left_out = (np.delete(s, m, axis=1) for s in definitions for m in range(problems))
        chosen += [suite_mean(score_LMN) for score_LMN in left_out]
    own_LM = seed_mean(definitions[0])
    drawn = map(seed_mean, resampled(definitions[0], resamples, seed))
    drawn_SL = np.concatenate([np.where(np.isnan(m), own_LM, m).mean(-1) for m in drawn])
    tails = [50 * (1 - LEVEL), 50 * (1 + LEVEL)]
    return (
        _ends(ranks(np.stack(chosen)), [0, 100]),
        _ends(ranks(drawn_SL), tails),
    )


def _ends(rank_VL: Array, tails: Sequence[float]) -> Array:
    """Percentiles of each line's ranks; NaN for a line that never has one."""
    found = [
        np.percentile(known, tails, method="inverted_cdf") if len(known) else [np.nan, np.nan]
        for known in (rank_V[~np.isnan(rank_V)] for rank_V in rank_VL.T)
    ]
    return np.array(found)
