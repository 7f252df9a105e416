"""What a diagnosis names, and the suspects that need no residuals: refused fits and poses that are other poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.distributions import beta_quantile, binomial_tail
from uvgs_bench.accuracy.observations import Observations

# The sensor's test refuses one fit of a thousand by chance at most, and a few more where its noise is stated too small.
_CHANCE = 1e-3
_LEAST_SHARE = 0.1
_RARE = 1e-4
_REASONS = ("residual_too_large", "no_labeling")
# Residuals six times as long as usual do not come by chance.
_GROSS_CHANCE = 1e-6
_PERCENT = 100.0


@dataclass(frozen=True, slots=True)
class Suspect:
    """One cause that stands out.

    Args:
        cause: Stable word.
        title: What seems wrong, in words.
        p_value: Chance of such residuals on a clean bench, all causes tested taken together.
        effect_position_m: Root mean square of what it does to position errors after registration, m; NaN where poses
            cannot say.
        estimate: Its size in ``unit``; the length where it is a vector.
        low: Lower end of its 95 % interval in ``unit``.
        high: Upper end.
        unit: ``%``, ``mrad``, ``mm``, ``mm/h``, ``ms``, ``px``, ``% of captures``, or empty for a plain
            number.
        evidence: What one sees of it, one line.
        check: What would confirm it, one line.
        rank: 1 for the likeliest.
        alternatives: Titles of causes these data cannot tell from it.
        alternative_causes: Their words, in the same order.
    """

    cause: str
    title: str
    p_value: float
    effect_position_m: float
    estimate: float
    low: float
    high: float
    unit: str
    evidence: str
    check: str
    rank: int
    alternatives: tuple[str, ...] = ()
    alternative_causes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SightLimit:
    """How large a cause must be to be named in a run like this one.

    Args:
        cause: Stable word.
        title: What would be wrong, in words.
        unit: Unit of ``least``.
        least: Size that is named 19 times of 20; inf when this run cannot show it, whatever its size.
    """

    cause: str
    title: str
    unit: str
    least: float


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What a run points to, and what it could have shown.

    Args:
        suspects: The likeliest first; empty when nothing stands out.
        limits: One for each cause with a single size, in the order of the signatures; empty when nothing was searched.
    """

    suspects: tuple[Suspect, ...]
    limits: tuple[SightLimit, ...] = ()


def of_turned_poses(obs: Observations, turned: NDArray[np.bool_]) -> Suspect:
    """Poses that are another one altogether, as exchanged labels give.

    Args:
        obs: Captures with a pose.
        turned: Which of them are, shape (N,).

    Returns:
        The suspect, with the exact interval of their share.
    """
    visits = len(np.unique(obs.station[turned]))
    count = int(turned.sum())
    return _counted(
        "wrong_labels",
        "some poses are other poses altogether, as exchanged LEDs give",
        _GROSS_CHANCE,
        count,
        obs.count,
        f"{count} of {obs.count} poses at {visits} stations are turned and shifted far beyond their stated doubt",
        "look at the overlays of these captures; ask for a larger margin between labels",
        (),
    )


def of_refusals(obs: Observations, blamed: tuple[str, ...]) -> Suspect | None:
    """LEDs that fit no pose: a sensor that refuses more than chance may.

    Args:
        obs: Captures, misses included.
        blamed: Names of the LEDs that the pixels do not clear.

    Returns:
        The suspect, or None when few fits were refused.
    """
    count = sum(reason.rpartition("/")[2] in _REASONS for reason in obs.reason)
    tried = count + int(obs.is_solved.sum())
    chance = binomial_tail(count - 1, tried, _CHANCE) if count else 1.0
    if count < _LEAST_SHARE * tried or chance > _RARE:
        return None
    title = "the LEDs fit no pose: one of them is not where the beacon file says"
    evidence = f"{count} of {tried} fits were refused because lens and beacon cannot explain where the LEDs are seen"
    check = "measure the beacon again (uvgs beacon measure), and look at the overlays of refused captures"
    if len(blamed) == 1:
        title = f"the LEDs fit no pose: LED {blamed[0]} is not where the beacon file says"
        evidence += f"; moving LED {blamed[0]} alone explains most of it"
        check = f"measure the beacon again (uvgs beacon measure), LED {blamed[0]} first"
    return _counted(
        "led_offset",
        title,
        chance,
        count,
        tried,
        evidence,
        check,
        ("a light that is no LED of the beacon, or exchanged LEDs", "a lens that is not the camera's"),
    )


def _counted(
    cause: str,
    title: str,
    chance: float,
    count: int,
    total: int,
    evidence: str,
    check: str,
    alternatives: tuple[str, ...],
) -> Suspect:
    """A suspect whose size is a share of the captures.

    Source: C. J. Clopper and E. S. Pearson, The use of confidence or fiducial limits (1934).
    """
    low = beta_quantile(0.025, count, total - count + 1)
    high = beta_quantile(0.975, count + 1, total - count) if count < total else 1.0
    return Suspect(
        cause=cause,
        title=title,
        p_value=chance,
        effect_position_m=float("nan"),
        estimate=_PERCENT * count / total,
        low=_PERCENT * low,
        high=_PERCENT * high,
        unit="% of captures",
        evidence=evidence,
        check=check,
        rank=1,
        alternatives=alternatives,
    )
