"""What may be wrong with a bench: residuals held against the signatures of known causes, the likeliest first.

Every cause is one more column of the registration's least squares, weighed by how visits and places really scatter.
A cause is named when the residuals become so much smaller with it that chance would do it in three clean benches of a
hundred, all causes taken together (Bonferroni's first step of Holm's procedure). Among those the one that explains most
for its number of parameters comes first (Bayesian information criterion); the next must explain what the first left.
Causes that explain as much as the first, and nothing beside it, are named with it: these data cannot tell them apart.

Source: S. Holm, A simple sequentially rejective multiple test procedure (1979); G. Schwarz, Estimating the dimension of
a model (1978); R. Kass and A. Raftery, Bayes factors (1995).
"""

from __future__ import annotations

from dataclasses import replace
from math import comb

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.accuracy.bench_model import gantry_covariance, pose_residuals
from uvgs_bench.accuracy.cause_signatures import Signature, is_turned_away, signatures
from uvgs_bench.accuracy.centroid_noise import noise_at_predictions
from uvgs_bench.accuracy.distributions import chi2_tails, f_quantile, f_tail, noncentral_f_tail, t_quantile
from uvgs_bench.accuracy.least_squares import usual_distance
from uvgs_bench.accuracy.led_evidence import blamed_leds
from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.pose_sensitivity import pose_pixel_jacobian
from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.accuracy.suspects import Diagnosis, SightLimit, Suspect, of_refusals, of_turned_poses
from uvgs_bench.accuracy.tangent import hats
from uvgs_bench.accuracy.variance_components import Visits, fit_scatter, means, visits_of, whitened
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray

__all__ = ["LEAST_VISITS", "Diagnosis", "SightLimit", "Suspect", "diagnose", "examine"]

LEAST_VISITS = 12
"""With fewer visits nothing is diagnosed: too little is left once the registration is fitted."""
# The parts of the scatter are estimates too: alarms come a little more often than said, and must stay below 5 %.
_ALPHA = 0.03
_MOST_SUSPECTS = 4
# Chance with which a cause at its limit of sight is named.
_POWER = 0.95
# Difference of the information criterion beyond which one cause is clearly better: odds of 150 to 1.
_CLEARLY = 10.0
# What a drift and a slip can be mistaken for when places are visited in order.
_OF_TIME, _OF_AXES = ("drift", "slip"), ("axis_scale", "squareness")
_UNTRIED = (
    SightLimit("latency", "late stamps: no capture was taken in motion", "ms", float("inf")),
    SightLimit("backlash", "play: no axis came to places from both sides", "mm", float("inf")),
)
# Captures this many usual lengths from the middle of their visit are disturbed, with noise once in 10000 captures.
_FAR = 6.5
# Chance of a run to hold a place set aside for no reason, and how often places are looked through.
_STRAY = 1e-2
_CLEANINGS = 3
_RANK = 1e-6
_LEAST_EIGENVALUE = 1e-12


def diagnose(
    obs: Observations, registration: Registration | None, lens: Lens, leds_m: FloatArray, led_names: tuple[str, ...]
) -> tuple[Suspect, ...]:
    """Name what the residuals of a registration, and the refusals of the sensor, point to.

    Args:
        obs: Captures, misses included; those that registered may and should be among them.
        registration: Their registration; without one only the refusals speak.
        lens: The lens the sensor was told.
        leds_m: LED positions it was told, beacon frame, shape (L, 3), m.
        led_names: Names of the LEDs, length L.

    Returns:
        Suspects, the likeliest first; empty when nothing stands out. Captures far from their visit, and places nothing
        explains, are set aside for the search and counted in the evidence. Fewer than ``LEAST_VISITS`` visits with a
        pose say nothing by their residuals.
    """
    return examine(obs, registration, lens, leds_m, led_names).suspects


def examine(
    obs: Observations, registration: Registration | None, lens: Lens, leds_m: FloatArray, led_names: tuple[str, ...]
) -> Diagnosis:
    """As ``diagnose``, with how large each cause would have to be to be named.

    Args:
        obs: As for ``diagnose``.
        registration: As for ``diagnose``.
        lens: As for ``diagnose``.
        leds_m: As for ``diagnose``.
        led_names: As for ``diagnose``.

    Returns:
        Suspects, and the limits of sight of this run.
    """
    blamed = blamed_leds(obs, lens, leds_m)
    found: tuple[Suspect, ...] = ()
    limits: tuple[SightLimit, ...] = ()
    if registration is not None:
        found, limits = _by_residuals(obs, registration, lens, leds_m, led_names, blamed)
    refused = of_refusals(obs, tuple(led_names[k] for k in blamed))
    if refused is not None and all(suspect.cause != refused.cause for suspect in found):
        # When most captures are refused, the poses of the others are what the same cause has left of them.
        found = (refused, *found) if 2 * int(obs.is_solved.sum()) < obs.count else (*found, refused)
    return Diagnosis(tuple(replace(suspect, rank=k + 1) for k, suspect in enumerate(found)), limits)


def _by_residuals(
    obs: Observations,
    registration: Registration,
    lens: Lens,
    leds_m: FloatArray,
    led_names: tuple[str, ...],
    blamed: tuple[int, ...],
) -> tuple[tuple[Suspect, ...], tuple[SightLimit, ...]]:
    """Suspects by what the poses say, and what they could have said."""
    data = obs.select(obs.is_solved)
    data = data.select(_can_be_seen(data, registration, lens, leds_m))
    if len(np.unique(data.station)) < LEAST_VISITS:
        return (), ()
    residual = pose_residuals(data, *registration.predict(data))
    noise, _ = noise_at_predictions(data, registration, lens, leds_m)
    distance = _lengths(residual, noise + gantry_covariance(registration.gantry_sigma_m))
    turned = is_turned_away(residual, distance, usual_distance(distance, np.ones(data.count)))
    wrong = (of_turned_poses(data, turned),) if turned.any() else ()
    kept = data.select(~turned & ~_is_stray(residual, noise, data.station))
    search: _Search | None = None
    for _ in range(_CLEANINGS):
        if len(np.unique(kept.station)) < LEAST_VISITS:
            return wrong, ()
        possible = signatures(kept, registration, lens, leds_m, led_names, blamed)
        search = _Search(kept, registration, lens, leds_m, possible)
        strays = search.stray_places()
        if len(strays) == 0:
            break
        kept = kept.select(~np.isin(kept.place, strays))
    aside = int((~turned).sum()) - kept.count
    return (wrong, ()) if search is None else (wrong + search.suspects(aside), search.limits())


class _Search:
    """Signatures and residuals of one run, whitened, with what a registration absorbs taken off."""

    def __init__(
        self,
        obs: Observations,
        registration: Registration,
        lens: Lens,
        leds_m: FloatArray,
        possible: tuple[Signature, ...],
    ) -> None:
        self.obs = obs
        residual = pose_residuals(obs, *registration.predict(obs))
        noise, _ = noise_at_predictions(obs, registration, lens, leds_m)
        visits, of_visit = visits_of(residual, noise, obs.station, obs.place)
        self.absorbed = registration.prediction_jacobian(obs)
        averaged = [means(self.absorbed, of_visit)] + [means(s.effect, of_visit) for s in possible]
        explained, self.freedom = _explained(visits, averaged)
        scatter = fit_scatter(visits, explained, registration.gantry_sigma_m)
        table = np.concatenate([visits.residual[:, :, None], *averaged], axis=2)
        white, _ = whitened(visits, scatter, table)
        ends = np.cumsum([1, *(part.shape[2] for part in averaged)])
        self.visits, self.has_all = visits, explained.shape[2] > averaged[0].shape[2]
        self.unexplained = _off(_basis(white[:, 1:]), white[:, :1])[:, 0]
        self.registering = white[:, ends[0] : ends[1]]
        self.basis = _basis(self.registering)
        self.left = _off(self.basis, white[:, :1])[:, 0]
        self.observed = white[:, 0]
        self.count = len(white)
        self.asked = possible
        self.possible: list[Signature] = []
        self.columns: list[FloatArray] = []
        for signature, first, last in zip(possible, ends[1:-1], ends[2:], strict=True):
            columns = white[:, first:last]
            if len(columns.T) == _rank(_off(self.basis, columns), columns):
                self.possible.append(signature)
                self.columns.append(columns)

    def stray_places(self) -> NDArray[np.int64]:
        """Places that nothing explains: a disturbed capture must not look like a cause."""
        found: list[int] = []
        if not self.has_all:
            return np.array(found, dtype=np.int64)
        places = self.obs.place[np.unique(self.obs.station, return_index=True)[1]]
        first = 0
        for block in self.visits.blocks:
            rows = self.unexplained[first : first + 6 * block.size].reshape(len(block), -1)
            first += 6 * block.size
            is_stray = chi2_tails((rows**2).sum(axis=1), rows.shape[1]) < _STRAY / len(self.visits.residual)
            found += places[block[is_stray, 0]].tolist()
        return np.array(found, dtype=np.int64)

    def suspects(self, aside: int) -> tuple[Suspect, ...]:
        """The search: the best cause, then the best for what it leaves, until nothing stands out."""
        basis, left = self.basis, self.left
        chosen: list[int] = []
        found: list[tuple[float, float, list[Signature]]] = []
        open_ones = list(range(len(self.possible)))
        while open_ones and len(chosen) < _MOST_SUSPECTS:
            gains = {k: self._gain(basis, left, k) for k in open_ones}
            chances = {k: min(1.0, len(open_ones) * self._chance(gains[k], k)) for k in open_ones}
            standing = [k for k in open_ones if chances[k] <= _ALPHA]
            if not standing:
                break
            # What has more places to be found at finds one by chance more easily.
            worth = {k: gains[k] - self._weight(k) - 2.0 * float(np.log(self.possible[k].rivals)) for k in standing}
            best = max(standing, key=lambda k: worth[k])
            best, mistaken = self._beside_axis_terms(basis, left, best, standing, worth[best])
            with_best = _basis(np.concatenate([basis, self.columns[best]], axis=1))
            cause = self.possible[best].cause
            rest = _off(with_best, left[:, None])[:, 0]
            like = [
                k
                for k in sorted(standing, key=lambda k: -worth[k])
                if self.possible[k].cause != cause
                and (
                    k in mistaken
                    or (
                        gains[k] - self._weight(k) > gains[best] - self._weight(best) - _CLEARLY
                        and len(open_ones) * self._chance(self._gain(with_best, rest, k), k) > _ALPHA
                    )
                )
            ]
            chosen.append(best)
            # Of each other cause the likeliest.
            others = {self.possible[k].cause: self.possible[k] for k in reversed(like)}
            found.append((chances[best], gains[best], list(reversed(others.values()))))
            basis, left = with_best, rest
            # Another instant, LED or axis of the same cause may still be named, but not one the first has used up.
            open_ones = [k for k in open_ones if k != best and not (cause == "slip" == self.possible[k].cause)]
        return self._described(chosen, found, aside)

    def _beside_axis_terms(
        self, basis: FloatArray, left: FloatArray, best: int, standing: list[int], worth: float
    ) -> tuple[int, list[int]]:
        """The best cause once several axis terms together may be it, and what it cannot be told from.

        Where places are visited in order along an axis, time is travel: a drift in three directions then takes the
        place of that axis' scale and squareness, none of which alone explains as much.
        """
        terms = [k for k, s in enumerate(self.possible) if s.cause in _OF_AXES]
        if self.possible[best].cause not in _OF_TIME or not terms:
            return best, []
        taken: list[int] = []
        total, together = 0.0, -np.inf
        while terms and len(taken) < self.columns[best].shape[1]:
            gains = {k: self._gain(basis, left, k) for k in terms}
            k = max(terms, key=lambda k: gains[k])
            choices = comb(len(taken) + len(terms), len(taken) + 1)
            taken, total = [*taken, k], total + gains[k]
            terms.remove(k)
            basis = _basis(np.concatenate([basis, self.columns[k]], axis=1))
            left = _off(basis, left[:, None])[:, 0]
            weight = sum(self._weight(k) for k in taken) + 2.0 * float(np.log(choices))
            together = max(together, total - weight)
        first = taken[0]
        if first not in standing or together <= worth - _CLEARLY:
            return best, []
        return (first, [best]) if together > worth else (best, [first])

    def limits(self) -> tuple[SightLimit, ...]:
        """How large each cause of a single size must be to stand out on an otherwise clean bench."""
        if not self.possible:
            return ()
        gain = _gain_for_power(_ALPHA / len(self.possible), self.freedom)
        found = []
        for signature in self.asked:
            if signature.effect.shape[2] > 1:
                continue
            least = float("inf")
            if signature in self.possible:
                free = _off(self.basis, self.columns[self.possible.index(signature)])
                least = float(np.sqrt(gain) / np.linalg.norm(free)) * signature.per_unit
            found.append(SightLimit(signature.cause, signature.title, signature.unit, least))
        tried = {limit.cause for limit in found}
        return (*found, *(limit for limit in _UNTRIED if limit.cause not in tried))

    def _gain(self, basis: FloatArray, left: FloatArray, k: int) -> float:
        """How much of the squared residual a cause explains beside a basis."""
        free = _off(basis, self.columns[k])
        if _rank(free, self.columns[k]) < free.shape[1]:
            return 0.0
        return float(((np.linalg.qr(free)[0].T @ left) ** 2).sum())

    def _chance(self, gain: float, k: int) -> float:
        p = self.columns[k].shape[1]
        return f_tail(gain / p, p, self.freedom)

    def _weight(self, k: int) -> float:
        """What the parameters of a cause must explain to be worth having."""
        count: int = self.columns[k].shape[1]
        return count * float(np.log(self.count))

    def _described(
        self, chosen: list[int], found: list[tuple[float, float, list[Signature]]], aside: int
    ) -> tuple[Suspect, ...]:
        if not chosen:
            return ()
        design = np.concatenate([self.registering, *(self.columns[k] for k in chosen)], axis=1)
        length = np.linalg.norm(design, axis=0)
        length[length == 0.0] = 1.0
        inverse = np.linalg.pinv(design / length, rcond=1e-10) / length[:, None]
        size, doubt = inverse @ self.observed, inverse @ inverse.T
        reach = t_quantile(0.975, self.freedom)
        suspects = []
        first = self.registering.shape[1]
        total = float(self.left @ self.left)
        without = f" ({aside} disturbed captures set aside)" if aside else ""
        for place, (k, (chance, gain, like)) in enumerate(zip(chosen, found, strict=True)):
            signature = self.possible[k]
            rows = slice(first, first + signature.effect.shape[2])
            first = rows.stop
            theta, C = size[rows], doubt[rows, rows]
            estimate, half = _size_and_half(theta, C, reach)
            low = estimate - half if len(theta) == 1 else max(estimate - half, 0.0)
            suspects.append(
                Suspect(
                    cause=signature.cause,
                    title=signature.title,
                    p_value=chance,
                    effect_position_m=self._effect_m(k, theta),
                    estimate=estimate * signature.per_unit,
                    low=low * signature.per_unit,
                    high=(estimate + half) * signature.per_unit,
                    unit=signature.unit,
                    evidence=f"{signature.sign}; it explains {gain / total:.0%} of the squared residuals{without}",
                    check="; ".join([signature.check, *(f"or {other.check}" for other in like)]),
                    rank=place + 1,
                    alternatives=tuple(other.title for other in like),
                    alternative_causes=tuple(other.cause for other in like),
                )
            )
        return tuple(suspects)

    def _effect_m(self, k: int, theta: FloatArray) -> float:
        """Root mean square of the position errors a cause leaves once a registration has absorbed what it can."""
        whole = self.columns[k] @ theta
        taken = np.linalg.lstsq(self.registering, whole, rcond=1e-10)[0]
        tangent = self.possible[k].effect @ theta - self.absorbed @ taken
        shift = tangent[:, 3:] - np.einsum("nij,nj->ni", hats(self.obs.t_cb_m), tangent[:, :3])
        return float(np.sqrt((shift**2).sum(axis=1).mean()))


def _explained(visits: Visits, averaged: list[FloatArray]) -> tuple[FloatArray, int]:
    """What may have shifted the visits while their scatter is sought, and the degrees of freedom left.

    All causes where there are visits enough for them; else only the registration, and the scatter comes out larger.
    """
    everything = np.concatenate(averaged, axis=2)
    rows = 6 * len(visits.residual)
    for columns in (everything, averaged[0]):
        left = rows - columns.shape[2]
        if left >= 3 * columns.shape[2]:
            break
    return columns, max(left, 1)


def _gain_for_power(chance: float, freedom: int) -> float:
    """Squared residual a cause with one size must explain, so that the F test at a chance finds it 19 times of 20."""
    from scipy.optimize import brentq

    bound = f_quantile(1.0 - chance, 1, freedom)
    return float(brentq(lambda gain: noncentral_f_tail(bound, 1, freedom, gain) - _POWER, bound, 25.0 * bound))


def _lengths(residual: FloatArray, covariance: FloatArray) -> FloatArray:
    """Lengths of residuals in units of their doubt, shape (N,)."""
    white = np.linalg.solve(np.linalg.cholesky(covariance), residual[:, :, None])[:, :, 0]
    return np.asarray(np.linalg.norm(white, axis=1))


def _is_stray(residual: FloatArray, noise: FloatArray, station: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Captures far from the middle of their visit, shape (N,)."""
    _, of_visit = np.unique(station, return_inverse=True)
    middle = np.array([np.median(residual[of_visit == v], axis=0) for v in range(int(of_visit.max()) + 1)])
    distance = _lengths(residual - middle[of_visit], noise)
    several = np.bincount(of_visit)[of_visit] > 2
    if not several.any():
        return several
    usual = usual_distance(distance[several], np.ones(int(several.sum())))
    return several & (distance > _FAR * usual)


def _can_be_seen(obs: Observations, registration: Registration, lens: Lens, leds_m: FloatArray) -> NDArray[np.bool_]:
    """Captures whose prediction the lens can show with all LEDs, and whose pose that would tell, shape (N,)."""
    J, _ = pose_pixel_jacobian(lens, leds_m, *registration.predict(obs))
    is_finite = np.isfinite(J.sum(axis=(1, 2, 3)))
    information = np.einsum("nkui,nkuj->nij", J[is_finite], J[is_finite])
    scale = np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), 1e-300))
    least: FloatArray = np.linalg.eigvalsh(information / scale[:, :, None] / scale[:, None, :])[:, 0]
    seen = np.zeros(len(J), dtype=np.bool_)
    seen[is_finite] = least > _LEAST_EIGENVALUE
    return seen


def _basis(columns: FloatArray) -> FloatArray:
    """Orthonormal columns that span the given ones, shape (n, r)."""
    length = np.linalg.norm(columns, axis=0)
    U, size, _ = np.linalg.svd(columns[:, length > 0.0] / length[length > 0.0], full_matrices=False)
    basis: FloatArray = U[:, size > _RANK * size[0]]
    return basis


def _off(basis: FloatArray, columns: FloatArray) -> FloatArray:
    """Columns less what lies in the basis."""
    once = columns - basis @ (basis.T @ columns)
    # Twice is enough: what is nearly all absorbed loses its digits in one go.
    return once - basis @ (basis.T @ once)


def _rank(free: FloatArray, columns: FloatArray) -> int:
    """How many directions of columns are left in their free part."""
    length = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return int((np.linalg.svd(free / length, compute_uv=False) > _RANK).sum())


def _size_and_half(theta: FloatArray, C: FloatArray, reach: float) -> tuple[float, float]:
    """A scalar with half its interval, or the length of a vector with half the interval along it."""
    if len(theta) == 1:
        return float(theta[0]), reach * float(np.sqrt(C[0, 0]))
    length = float(np.linalg.norm(theta))
    along = theta / max(length, 1e-300)
    return length, reach * float(np.sqrt(along @ C @ along))
