"""Statistics equal independent oracles, and cover what they claim to cover."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from mtl_bench.evaluate.delta import log_gain
from mtl_bench.report import evidence
from mtl_bench.report.evidence import (
    ahead,
    behind_front,
    bootstrap,
    compare,
    expected_best,
    holm,
    iqm,
    profile,
    rank_bands,
    ranks,
    sign_flip,
    stratified_t,
    student,
    suite_mean,
    superiority,
)

NAN, FAILED = math.nan, -math.inf


@pytest.fixture
def rng():
    """Of each test its own: what one draws does not depend on which others run."""
    return np.random.default_rng(20)


# --- the score ------------------------------------------------------------------------------------


def test_log_gain_treats_a_doubled_and_a_halved_error_alike():
    up, task = {"a": False, "b": True, "c": True}, {"a": "one", "b": "two", "c": "two"}
    base = {"a": 2.0, "b": 10.0, "c": 5.0}
    assert log_gain(base, base, up, task) == 0
    worse = log_gain(base | {"a": 4.0}, base, up, task)
    better = log_gain(base | {"a": 1.0}, base, up, task)
    assert better == -worse == pytest.approx(50 * math.log(2))  # one of two tasks
    assert log_gain(base | {"b": 11.0}, base, up, task) == pytest.approx(25 * math.log(1.1))
    assert log_gain(base | {"b": 0.0}, base, up, task) == FAILED
    with pytest.raises(ValueError, match=r"'a' is -1.0 beside 2.0, of which no ratio exists"):
        log_gain(base | {"a": -1.0}, base, up, task)


# --- intervals ------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [2, 3, 5, 10])
def test_the_interval_of_one_problem_is_scipys(count, rng):
    x = rng.normal(3, 2, count)
    theirs = stats.ttest_1samp(x, 0).confidence_interval(0.95)
    ours = stratified_t(np.append(x, NAN)[None])  # a missing run is none
    assert (ours.mean, ours.low, ours.high) == pytest.approx((x.mean(), *theirs))


def test_two_problems_of_unlike_spread_are_welchs_interval(rng):
    """The mean of two strata is half the difference of one and the other's negative."""
    a, b = rng.normal(1, 1, 5), rng.normal(2, 8, 9)
    table = np.full((2, 9), NAN)
    table[0, :5], table[1] = a, b
    theirs = stats.ttest_ind(a, -b, equal_var=False).confidence_interval(0.95)
    ours = stratified_t(table)
    assert (ours.low, ours.high) == pytest.approx((theirs.low / 2, theirs.high / 2))


def test_what_cannot_be_known_is_nan():
    one = stratified_t(np.array([[2.0]]))
    assert one.mean == 2
    assert math.isnan(one.low)
    assert math.isnan(stratified_t(np.array([[NAN]])).mean)
    failed = stratified_t(np.array([[1.0, FAILED]]))
    assert (failed.mean, math.isnan(failed.high)) == (FAILED, True)
    same = stratified_t(np.array([[2.0, 2.0]]))
    assert (same.low, same.high) == (2, 2)


def test_iqm_is_the_trimmed_mean(rng):
    x = rng.normal(size=(4, 5))
    assert iqm(x) == pytest.approx(stats.trim_mean(x, 0.25, axis=None))
    x[1, 3] = FAILED  # one of twenty is cut off with the lowest quarter
    assert iqm(x) == pytest.approx(stats.trim_mean(np.where(np.isinf(x), -1e9, x), 0.25, None))
    x[2] = FAILED
    assert iqm(x) == FAILED
    assert math.isnan(iqm(np.array([[NAN]])))


def test_bootstrap_draws_all_lines_together(rng):
    """Two lines whose difference is the same in every run: so it is in every resample."""
    first = rng.normal(0, 5, (3, 5))
    both = np.stack([first, first + 2])
    (chunk,) = evidence.resampled(both, 50, 0)
    for drawn in chunk:
        assert np.allclose(drawn[1] - drawn[0], 2)
        for problem in range(3):
            assert set(drawn[0, problem]) <= set(first[problem])
    one, other = bootstrap(both, resamples=500)
    assert (other.mean, other.low, other.high) == pytest.approx(
        (one.mean + 2, one.low + 2, one.high + 2)
    )


def test_bootstrap_enumerates():
    """One problem of three seeds: the 27 resamples are known."""
    x = np.array([[[1.0, 2.0, 6.0]]])
    means = [np.mean(draw) for draw in itertools.product(*x[0].repeat(3, axis=0))]
    (found,) = bootstrap(x, lambda x: x.mean((-2, -1)), resamples=20_000)
    ends = np.percentile(means, [2.5, 97.5], method="inverted_cdf")
    assert (found.low, found.high) == pytest.approx(tuple(ends))


# --- tests and verdicts ---------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 5, 10, 16])
def test_sign_flip_is_scipys_exact_test(count, rng):
    d = rng.normal(0.5, 1, count)
    d[: count // 3] = 0.25  # ties
    patterns = np.array(list(itertools.product([1, -1], repeat=count))) if count <= 10 else None
    if patterns is not None:
        brute = np.mean(np.abs(patterns @ d) >= abs(d.sum()) - 1e-9)
        assert sign_flip(d) == brute
    if count > 1:
        theirs = stats.permutation_test(
            (d,), np.mean, permutation_type="samples", n_resamples=2**16, batch=4096
        )
        assert sign_flip(d) == pytest.approx(theirs.pvalue)


def test_sign_flip_of_many_blocks_is_near_the_t_test(rng):
    d = rng.normal(0.4, 1, 40)
    assert sign_flip(d) == pytest.approx(stats.ttest_1samp(d, 0).pvalue, abs=0.01)
    assert sign_flip(d) == sign_flip(d)
    assert sign_flip(np.full(40, 1.0)) == 1 / (evidence.FLIPS + 1)


def test_a_failed_run_counts_as_the_worst_and_is_not_dropped():
    d = np.array([1.0, 2, 1.5, 1, 2, 1.2])
    assert sign_flip(d) == 2 / 2**6
    assert sign_flip(np.array([*d[:5], FAILED])) > 0.1
    assert superiority(np.array([*d[:5], FAILED])) == pytest.approx(5 / 6)
    assert sign_flip(np.full(6, FAILED)) == 2 / 2**6
    assert sign_flip(np.zeros(6)) == 1
    assert math.isnan(sign_flip(np.array([])))


def test_holm():
    p = [0.01, 0.04, 0.03, 0.005, NAN]
    found = holm(p)
    assert found[:4] == pytest.approx([0.03, 0.06, 0.06, 0.02])  # by hand
    assert math.isnan(found[4])


def test_verdicts(rng):
    noise = rng.normal(0, 0.2, (4, 5))
    control = rng.normal(0, 3, (4, 5))
    lines = np.stack([control + noise + shift for shift in (3, 0, -3)])
    apart = control + rng.normal(0, 4, (4, 5))
    apart -= (apart - control).mean() - 0.7
    found = compare(np.concatenate([lines, apart[None]]), control)
    assert [each.verdict for each in found] == ["better", "equivalent", "worse", "open"]
    assert {each.blocks for each in found} == {20}
    assert found[0].difference.mean == pytest.approx(3 + noise.mean())
    assert found[0].p_holm >= found[0].p


def test_what_is_tested_is_the_mean_that_is_printed():
    """Runs are missing: a block of the shorter problem weighs more, by brute force."""
    d = np.array([[1.0, 1.2, 0.8, 1.1, 0.9], [-1.5, -2.0, NAN, NAN, NAN]])
    (found,) = compare(d[None], np.zeros((2, 5)))
    assert np.nansum(d) > 0 > found.difference.mean
    assert not found.ahead
    known = ~np.isnan(d)
    part = (d / known.sum(1, keepdims=True))[known]
    patterns = np.array(list(itertools.product([1, -1], repeat=7)))
    as_far = np.abs(patterns @ part) >= abs(part.sum()) - 1e-12
    assert found.p == as_far.mean()


def test_lines_that_fail_together_are_not_equivalent(rng):
    control = rng.normal(0, 1, (1, 4))
    control[0, 2] = FAILED
    same, ahead = compare(np.stack([control, np.full((1, 4), 9.0)]), control)
    assert (same.difference.mean, same.blocks, same.failed) == (FAILED, 4, 1)
    assert (same.p, same.verdict) == (1, "open")
    assert (ahead.difference.mean, ahead.failed, ahead.superior) == (-FAILED, 1, 1)
    (both,) = compare(np.array([[[FAILED, 1.0, 2]]]), np.array([[0, FAILED, 1.0]]))
    assert (math.isnan(both.difference.mean), both.failed) == (True, 2)


def test_a_missing_run_leaves_out_its_block_and_a_failed_one_does_not(rng):
    control = rng.normal(0, 1, (2, 6))
    line = control + 1
    line[0, 0], line[1, 5] = NAN, FAILED
    (found,) = compare(line[None], control)
    assert (found.blocks, found.failed) == (11, 1)
    assert found.difference.mean == FAILED
    assert found.superior == pytest.approx(10 / 11)
    assert not found.within


def test_students_test_is_scipys_and_leaves_out_what_it_cannot_judge(rng):
    d = rng.normal(1, 1, 5)
    assert student(d) == stats.ttest_1samp(d, 0).pvalue
    assert [student(np.full(3, value)) for value in (0.0, 0.1)] == [1, 0]
    unknown = [np.array([]), np.array([1.0]), np.array([1.0, 2, FAILED])]
    assert all(math.isnan(student(d)) for d in unknown)


def test_who_leads_a_control_has_a_p_by_holm_and_an_interval_above_0(rng):
    control = rng.normal(0, 5, 6)
    t = np.array([20.0, -20.0, 2.9, 0.0])[:, None]
    noise = math.sqrt(6) * stats.zscore(rng.normal(size=(4, 6)), axis=1, ddof=1)
    lines = np.concatenate([control + t + noise, np.full((1, 6), NAN)])
    p = [stats.ttest_rel(line, control).pvalue for line in lines[:4]]
    assert p[2] < 0.05 < min(1, 2 * p[2])  # significant, and not among four
    assert ahead(lines, control) == [True, False, False, False, False]
    assert ahead(lines[2:3], control) == [True]


# --- the suite ------------------------------------------------------------------------------------


def test_profile_counts():
    x = np.array([[1.0, 2, NAN], [3, FAILED, 2]])
    assert profile(x, np.array([0, 1, 2, 3])).tolist() == [0.8, 0.6, 0.2, 0]


def test_expected_best_is_the_mean_over_all_draws():
    scores = np.array([3.0, 1, 2, 5, 2])  # with a tie
    for budget in (1, 2, 3, 4, 5):
        draws = itertools.product(scores, repeat=budget)
        expected = np.mean([max(draw) for draw in draws])
        assert expected_best(scores)[budget - 1] == pytest.approx(expected)


def test_distance_to_a_front(rng):
    front = np.array([[0.0, 4], [2, 2], [4, 0]])
    assert behind_front(np.array([1.0, 1]), front) == 1  # one more in both reaches (2, 2)
    assert behind_front(np.array([2.0, 2]), front) == 0
    assert behind_front(np.array([5.0, 5]), front) < 0
    assert behind_front(np.array([FAILED, FAILED]), front) == -FAILED
    for tasks in (2, 3):
        front, point = rng.normal(0, 1, (6, tasks)), rng.normal(0, 1, tasks)
        steps = np.arange(-4, 4, 0.001)
        free = [not (front > point + step).all(1).any() for step in steps]
        assert behind_front(point, front) == pytest.approx(steps[free.index(True)], abs=0.0011)


def test_ranks_are_scipys_means_over_ties():
    assert ranks(np.array([3.0, 1, 3, FAILED])).tolist() == [1.5, 3, 1.5, 4]
    several = ranks(np.array([[3.0, 2, NAN], [FAILED, FAILED, 1]]))
    assert np.nan_to_num(several).tolist() == [[1, 2, 0], [2.5, 2.5, 1]]


def test_the_mean_of_a_suite_weighs_problems_alike():
    score = np.array([[[1.0, 3, NAN], [8, 8, 8]], [[1, 1, 1], [NAN, NAN, NAN]]])
    assert suite_mean(score)[0] == 5
    assert math.isnan(suite_mean(score)[1])
    assert suite_mean(np.array([[[1.0, FAILED]]])) == FAILED


def test_rank_bands_are_the_ends_over_all_choices(rng):
    """Brute force: every definition with every problem left out, every resample of the seeds."""
    first, second = rng.normal(0, 1, (2, 4, 3, 2))
    first[1, 0, 1], first[2, 2, 0], second[1, 0, 1] = FAILED, NAN, FAILED
    choices, seeds = rank_bands([first, second], resamples=4000)

    def ranked(score):
        means = [np.mean([np.nanmean(row) for row in line]) for line in score]
        return [1 + sum(o > m for o in means) + (means.count(m) - 1) / 2 for m in means]

    kept = [[0, 1, 2], [1, 2], [0, 2], [0, 1]]
    every = np.array([ranked(s[:, problems]) for s in (first, second) for problems in kept])
    assert choices.tolist() == np.stack([every.min(0), every.max(0)], 1).tolist()
    draws = itertools.product(itertools.product(range(2), repeat=2), repeat=3)
    drawn = []
    for d in draws:
        several = np.stack([first[:, m, list(d[m])] for m in range(3)], 1)
        if np.isnan(several[2, 2]).all():
            several[2, 2] = np.nanmean(first[2, 2])  # a line without a drawn run: its mean
        drawn.append(ranked(several))
    ends = np.percentile(drawn, [2.5, 97.5], axis=0, method="inverted_cdf").T
    assert np.abs(seeds - ends).max() <= 0.5


def test_a_line_that_lacks_every_run_has_no_rank():
    choices, seeds = rank_bands([np.array([[[1.0, 2]], [[NAN, NAN]]])], resamples=20)
    assert choices[0].tolist() == seeds[0].tolist() == [1, 1]
    assert np.isnan([choices[1], seeds[1]]).all()


def test_a_line_that_lacks_a_problem_moves_no_other_s_rank(rng):
    scores = rng.normal(0, 1, (5, 3, 4))
    scores[1, 2] = NAN
    others = [0, 2, 3, 4]
    found = rank_bands([scores, scores**3], resamples=200)
    alone = rank_bands([scores[others], scores[others] ** 3], resamples=200)
    for ours, theirs in zip(found, alone, strict=True):
        assert np.isnan(ours[1]).all()
        assert ours[others].tolist() == theirs.tolist()


# --- coverage -------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, 5, 10])
def test_t_intervals_cover_95_percent(count):
    rng, hits, trials = np.random.default_rng(count), 0, 4000
    for _ in range(trials):
        spread = rng.uniform(0.5, 4, (4, 1))
        found = stratified_t(rng.normal(0, spread, (4, count)))
        hits += found.low <= 0 <= found.high
    assert 0.935 <= hits / trials <= 0.965 + 0.02 * (count == 3)  # Welch is wide where n is small


@pytest.mark.slow
def test_the_bootstrap_covers_what_its_docstring_says():
    rng, hits, trials = np.random.default_rng(0), 0, 1000
    for _ in range(trials):
        (found,) = bootstrap(rng.normal(0, 1, (1, 4, 5)), resamples=500)
        hits += found.low <= 0 <= found.high
    assert 0.88 <= hits / trials <= 0.945


@pytest.mark.slow
def test_under_the_null_hardly_any_family_has_a_verdict():
    rng, false, trials = np.random.default_rng(0), 0, 1000
    for _ in range(trials):
        control = rng.normal(0, 1, (2, 5))
        found = compare(control + rng.normal(0, 1, (20, 2, 5)), control)
        false += any(each.verdict in ("better", "worse") for each in found)
    assert false / trials <= 0.055
