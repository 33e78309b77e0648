"""Statistics equal independent oracles, and cover what they claim to cover."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from mtl_bench.evaluate.delta import log_gain
from mtl_bench.report import evidence
from mtl_bench.report.evidence import (
    bootstrap,
    compare,
    holm,
    iqm,
    sign_flip,
    stratified_t,
    superiority,
)

RNG = np.random.default_rng(20)
NAN, FAILED = math.nan, -math.inf


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
def test_the_interval_of_one_problem_is_scipys(count):
    x = RNG.normal(3, 2, count)
    theirs = stats.ttest_1samp(x, 0).confidence_interval(0.95)
    ours = stratified_t(np.append(x, NAN)[None])  # a missing run is none
    assert (ours.mean, ours.low, ours.high) == pytest.approx((x.mean(), *theirs))


def test_two_problems_of_unlike_spread_are_welchs_interval():
    """The mean of two strata is half the difference of one and the other's negative."""
    a, b = RNG.normal(1, 1, 5), RNG.normal(2, 8, 9)
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


def test_iqm_is_the_trimmed_mean():
    x = RNG.normal(size=(4, 5))
    assert iqm(x) == pytest.approx(stats.trim_mean(x, 0.25, axis=None))
    x[1, 3] = FAILED  # one of twenty is cut off with the lowest quarter
    assert iqm(x) == pytest.approx(stats.trim_mean(np.where(np.isinf(x), -1e9, x), 0.25, None))
    x[2] = FAILED
    assert iqm(x) == FAILED
    assert math.isnan(iqm(np.array([[NAN]])))


def test_bootstrap_draws_all_lines_together():
    """Two lines whose difference is the same in every run: so it is in every resample."""
    first = RNG.normal(0, 5, (3, 5))
    both = np.stack([first, first + 2])
    for drawn in evidence.resampled(both, 50, 0):
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
def test_sign_flip_is_scipys_exact_test(count):
    d = RNG.normal(0.5, 1, count)
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


def test_sign_flip_of_many_blocks_is_near_the_t_test():
    d = RNG.normal(0.4, 1, 40)
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


def test_verdicts():
    noise = RNG.normal(0, 0.2, (4, 5))
    control = RNG.normal(0, 3, (4, 5))
    lines = np.stack([control + noise + shift for shift in (3, 0, -3)])
    apart = control + RNG.normal(0, 4, (4, 5))
    apart -= (apart - control).mean() - 0.7
    found = compare(np.concatenate([lines, apart[None]]), control)
    assert [each.verdict for each in found] == ["better", "equivalent", "worse", "open"]
    assert {each.blocks for each in found} == {20}
    assert found[0].difference.mean == pytest.approx(3 + noise.mean())
    assert found[0].p_holm >= found[0].p


def test_lines_that_fail_together_are_not_equivalent():
    control = RNG.normal(0, 1, (1, 4))
    control[0, 2] = FAILED
    same, ahead = compare(np.stack([control, np.full((1, 4), 9.0)]), control)
    assert (same.difference.mean, same.blocks, same.failed) == (FAILED, 4, 1)
    assert (same.p, same.verdict) == (1, "open")
    assert (ahead.difference.mean, ahead.failed, ahead.superior) == (-FAILED, 1, 1)
    (both,) = compare(np.array([[[FAILED, 1.0, 2]]]), np.array([[0, FAILED, 1.0]]))
    assert (math.isnan(both.difference.mean), both.failed) == (True, 2)


def test_a_missing_run_leaves_out_its_block_and_a_failed_one_does_not():
    control = RNG.normal(0, 1, (2, 6))
    line = control + 1
    line[0, 0], line[1, 5] = NAN, FAILED
    (found,) = compare(line[None], control)
    assert (found.blocks, found.failed) == (11, 1)
    assert found.difference.mean == FAILED
    assert found.superior == pytest.approx(10 / 11)
    assert not found.within


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
