"""The laws of probability the judging uses, straight over ``scipy.special``.

``scipy.stats`` gives the same numbers and takes longer to load than most runs take to judge; nothing here loads it.
"""

from __future__ import annotations

import numpy as np

from uvgs_bench.geometry import FloatArray


def normal_quantile(probability: float) -> float:
    """Value below which a standard normal draw lies with a probability."""
    from scipy import special

    return float(special.ndtri(probability))


def chi2_quantile(probability: float, degrees: float) -> float:
    """Value below which a chi-squared draw lies with a probability.

    Args:
        probability: Between 0 and 1.
        degrees: Degrees of freedom, above 0.

    Returns:
        The quantile.
    """
    from scipy import special

    return 2.0 * float(special.gammaincinv(0.5 * degrees, probability))


def chi2_tails(values: FloatArray, degrees: float) -> FloatArray:
    """Chances that a chi-squared draw exceeds each value.

    Args:
        values: Values, not negative, shape (n,).
        degrees: Degrees of freedom, above 0.

    Returns:
        Chances, shape (n,).
    """
    from scipy import special

    return np.asarray(special.chdtrc(degrees, values), dtype=np.float64)


def t_quantile(probability: float, degrees: float) -> float:
    """Value below which a draw of Student's t lies with a probability.

    Args:
        probability: Between 0 and 1.
        degrees: Degrees of freedom, above 0; NaN where there are none.

    Returns:
        The quantile.
    """
    return float(t_quantiles(probability, np.array([degrees], dtype=np.float64))[0])


def t_quantiles(probability: float, degrees: FloatArray) -> FloatArray:
    """As ``t_quantile`` for each of several degrees of freedom, shape (n,); NaN for those not above 0."""
    from scipy import special

    found = special.stdtrit(np.where(degrees > 0.0, degrees, 1.0), probability)
    return np.where(degrees > 0.0, found, np.nan)


def t_tail(value: float, degrees: float) -> float:
    """Chance that a draw of Student's t exceeds a value.

    Args:
        value: The value.
        degrees: Degrees of freedom, above 0.

    Returns:
        The chance.
    """
    from scipy import special

    return float(special.stdtr(degrees, -value))


def f_quantile(probability: float, above: float, below: float) -> float:
    """Value below which a draw of F lies with a probability.

    Args:
        probability: Between 0 and 1.
        above: Degrees of freedom of the numerator, above 0.
        below: Of the denominator, above 0.

    Returns:
        The quantile.
    """
    from scipy import special

    return float(special.fdtri(above, below, probability))


def f_tail(value: float, above: float, below: float) -> float:
    """Chance that a draw of F exceeds a value; degrees of freedom as for ``f_quantile``."""
    from scipy import special

    return float(special.fdtrc(above, below, value))


def noncentral_f_tail(value: float, above: float, below: float, noncentrality: float) -> float:
    """Chance that a draw of F exceeds a value when the numerator has a mean.

    Args:
        value: The value.
        above: Degrees of freedom of the numerator, above 0.
        below: Of the denominator, above 0.
        noncentrality: Sum of squares of the numerator's means, in its standard deviations.

    Returns:
        The chance; meant for chances that are not tiny, since it is one less the chance of the contrary.
    """
    from scipy import special

    return 1.0 - float(special.ncfdtr(above, below, noncentrality, value))


def beta_quantile(probability: float, a: float, b: float) -> float:
    """Value below which a draw of the beta law lies with a probability; its exponents are above 0."""
    from scipy import special

    return float(special.betaincinv(a, b, probability))


def binomial_cdf(successes: int, trials: int, chance: float) -> float:
    """Chance of at most so many successes.

    Args:
        successes: Number of successes; any integer.
        trials: Number of trials.
        chance: Chance of a success, strictly between 0 and 1.

    Returns:
        The chance.
    """
    from scipy import special

    if successes < 0:
        return 0.0
    if successes >= trials:
        return 1.0
    return float(special.betaincc(successes + 1.0, trials - successes, chance))


def binomial_tail(successes: int, trials: int, chance: float) -> float:
    """Chance of more than so many successes; exact also where it is tiny. Arguments as for ``binomial_cdf``."""
    from scipy import special

    if successes < 0:
        return 1.0
    if successes >= trials:
        return 0.0
    return float(special.betainc(successes + 1.0, trials - successes, chance))


def binomial_quantile(probability: float, trials: int, chance: float) -> int:
    """Least number of successes that is not exceeded with a probability.

    Args:
        probability: Strictly between 0 and 1.
        trials: Number of trials.
        chance: Chance of a success, strictly between 0 and 1.

    Returns:
        Between 0 and ``trials``.
    """
    low, high = 0, trials
    while low < high:
        middle = (low + high) // 2
        if binomial_cdf(middle, trials, chance) >= probability:
            high = middle
        else:
            low = middle + 1
    return low
