"""Quantiles of the distributions that residuals follow.

The functions of ``scipy.special`` on which ``scipy.stats`` rests: importing all its distributions for
these three would take longer than most commands.
"""

from typing import Any

from scipy.special import betaincinv, gammainccinv, gammaincinv


def chi2_quantile(probability: Any, freedom: Any) -> Any:
    """Value below which chi-square of so many degrees of freedom stays with a probability."""
    return 2.0 * gammaincinv(0.5 * freedom, probability)


def chi2_beyond(tail: Any, freedom: Any) -> Any:
    """Value that chi-square of so many degrees of freedom exceeds with a probability."""
    return 2.0 * gammainccinv(0.5 * freedom, tail)


def f_beyond(tail: Any, numerator: Any, denominator: Any) -> Any:
    """Value that the F distribution of two degrees of freedom exceeds with a probability."""
    share = betaincinv(0.5 * denominator, 0.5 * numerator, tail)
    return denominator * (1.0 - share) / (numerator * share)
