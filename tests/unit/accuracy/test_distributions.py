"""The laws agree with ``scipy.stats``, which the package itself never loads."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

from uvgs_bench.accuracy import distributions as law

# Relative: both sides round differently in places, and iterate to a few units of the last digit.
CLOSE = 1e-12

CHANCES = (1e-6, 0.0025, 0.025, 0.05, 0.5, 0.8, 0.95, 0.975, 0.9999)
DEGREES = (0.7, 1.0, 2.0, 5.5, 12.0, 97.3, 1000.0, 25_000.0)


@pytest.mark.parametrize("p", CHANCES)
def test_quantiles_of_continuous_laws(p: float) -> None:
    assert law.normal_quantile(p) == pytest.approx(stats.norm.ppf(p), rel=CLOSE)
    for a in DEGREES:
        assert law.chi2_quantile(p, a) == pytest.approx(stats.chi2.ppf(p, a), rel=CLOSE)
        assert law.t_quantile(p, a) == pytest.approx(stats.t.ppf(p, a), rel=CLOSE, abs=1e-15)
        for b in DEGREES:
            assert law.f_quantile(p, a, b) == pytest.approx(stats.f.ppf(p, a, b), rel=CLOSE)
            assert law.beta_quantile(p, a, b) == pytest.approx(stats.beta.ppf(p, a, b), rel=CLOSE)


@pytest.mark.parametrize("x", [0.0, 0.01, 0.9, 3.0, 12.5, 80.0, 400.0])
def test_tails_of_continuous_laws(x: float) -> None:
    for a in DEGREES:
        assert law.chi2_tails(np.array([x]), a)[0] == pytest.approx(stats.chi2.sf(x, a), rel=CLOSE, abs=1e-300)
        assert law.t_tail(x, a) == pytest.approx(stats.t.sf(x, a), rel=CLOSE, abs=1e-300)
        for b in DEGREES:
            assert law.f_tail(x, a, b) == pytest.approx(stats.f.sf(x, a, b), rel=CLOSE, abs=1e-300)


@pytest.mark.parametrize("below", [3.0, 40.0, 6000.0])
@pytest.mark.parametrize("noncentrality", [0.5, 9.0, 30.0])
def test_the_noncentral_tail(below: float, noncentrality: float) -> None:
    for value in (0.5, 4.0, 11.0, 25.0):
        expected = stats.ncf.sf(value, 1, below, noncentrality)
        # Absolute: it is one less the chance of the contrary.
        assert law.noncentral_f_tail(value, 1, below, noncentrality) == pytest.approx(expected, abs=CLOSE)


@pytest.mark.parametrize("trials", [1, 2, 59, 93, 1000, 30_000])
@pytest.mark.parametrize("chance", [1e-3, 0.05, 0.5, 0.95])
def test_the_binomial_law(trials: int, chance: float) -> None:
    for p in CHANCES:
        assert law.binomial_quantile(p, trials, chance) == int(stats.binom.ppf(p, trials, chance))
    middle = int(trials * chance)
    for k in (-1, 0, middle - 1, middle, middle + 3, trials - 1, trials, trials + 1):
        expected = stats.binom.cdf(k, trials, chance), stats.binom.sf(k, trials, chance)
        assert law.binomial_cdf(k, trials, chance) == pytest.approx(expected[0], rel=CLOSE, abs=1e-300)
        assert law.binomial_tail(k, trials, chance) == pytest.approx(expected[1], rel=CLOSE, abs=1e-300)


def test_terms_without_degrees_of_freedom_have_no_quantile() -> None:
    found = law.t_quantiles(0.975, np.array([0.0, 5.0, np.nan, np.inf]))
    assert np.isnan(found[[0, 2]]).all()
    assert found[[1, 3]] == pytest.approx([stats.t.ppf(0.975, 5.0), stats.norm.ppf(0.975)], rel=CLOSE)


def test_judging_a_run_does_not_load_the_slow_library() -> None:
    script = (
        "import sys, numpy as np\n"
        "from pathlib import Path\n"
        "from tests.helpers.synthetic_run import LIMIT_VERDICTS, synthetic_run\n"
        "from uvgs_bench.store.judging import judge_run\n"
        "limits = tuple(verdict.limit for verdict in LIMIT_VERDICTS)\n"
        "judgement = judge_run(synthetic_run(stations=45, limits=limits), seed=1)\n"
        "assert judgement.summary is not None and judgement.sight_limits and judgement.quantities\n"
        "print('scipy.stats' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "False"
