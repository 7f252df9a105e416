"""Signatures of causes are what planted causes do to the poses of the sensor's own solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from uvgs_bench.accuracy import Observations, Registration, fit_registration
from uvgs_bench.accuracy.bench_model import pose_residuals
from uvgs_bench.accuracy.blind_bench import BlindBench, observe, planted, random_bench, standard_stations
from uvgs_bench.accuracy.cause_signatures import Signature, signatures
from uvgs_bench.accuracy.observations import Mount

NAMES = ("bottom", "left", "right", "apex")
ALL = tuple(range(len(NAMES)))


def quiet_bench(mount: Mount = "beacon_on_carriage") -> BlindBench:
    bench = random_bench(np.random.default_rng(3))
    if mount == "camera_on_carriage":
        # The same view with the parts exchanged.
        bench = replace(
            bench,
            mount=mount,
            left=replace(bench.left, source="carriage"),
            right=replace(bench.right, target="gantry"),
        )
    # Noise far below every planted effect; the stated one only sets weights, alike for all LEDs.
    return replace(bench, centroid_sigma_px=1e-9, place_sigma_px=0.0, gantry_repeatability_m=0.0)


def seen(bench: BlindBench) -> Observations:
    rng = np.random.default_rng(4)
    stations = standard_stations(rng, places=12, revisits=4, moving=6, shots=1, is_turning=True)
    return observe(bench, stations, np.random.default_rng(5))


def true_registration(bench: BlindBench) -> Registration:
    return replace(fit_registration(seen(bench)), left=bench.left, right=bench.right)


CASES = [
    ("axis_scale", 1e-5, 0, 0),
    ("axis_scale", 1e-5, 1, 1),
    ("axis_scale", 1e-5, 2, 2),
    ("squareness", 1e-5, 0, 0),
    ("squareness", 1e-5, 1, 1),
    ("squareness", 1e-5, 2, 2),
    ("backlash", 1e-6, 0, 3),
    ("latency", 1e-5, 0, 0),
    ("drift", 1e-8, 1, 0),
    ("focal_length", 1e-5, 0, 0),
    ("principal_point", 1e-3, 0, 0),
    ("principal_point", 1e-3, 1, 1),
    ("distortion", 1e-5, 0, 0),
    ("led_offset", 1e-6, 5, 1),
    ("led_offset", 1e-6, 9, 3),
    ("saturation", 1e-3, 0, 0),
]


@pytest.mark.parametrize("mount", ["beacon_on_carriage", "camera_on_carriage"])
@pytest.mark.parametrize(("cause", "size", "index", "number"), CASES)
def test_signature_is_what_the_planted_cause_does(
    mount: Mount, cause: str, size: float, index: int, number: int
) -> None:
    clean = quiet_bench(mount)
    registration = true_registration(clean)
    bench = planted(clean, cause, size, index)
    obs = seen(bench)
    assert obs.is_solved.all()
    moved = pose_residuals(obs, *registration.predict(obs))
    found = of_cause(signatures(obs, registration, clean.lens, clean.leds_m, NAMES, ALL), cause)[number]
    column = index % 3 if found.effect.shape[2] == 3 else 0
    expected = found.effect[:, :, column] * size
    # First order: what is left is of the order of the size squared, and the solver's last step.
    scale = np.abs(expected).max(axis=0)
    assert np.abs(moved - expected).max() < 2e-3 * scale.max() + 1e-9
    assert scale.max() > 1e-8


def of_cause(found: tuple[Signature, ...], cause: str) -> list[Signature]:
    return [signature for signature in found if signature.cause == cause]


def test_causes_the_captures_were_not_exposed_to_are_left_out() -> None:
    bench = quiet_bench()
    obs = seen(bench)
    still = replace(obs, velocity_gs_mps=np.zeros((obs.count, 3)), approach=np.ones((obs.count, 3), dtype=np.int8))
    causes = {s.cause for s in signatures(still, true_registration(bench), bench.lens, bench.leds_m, NAMES, ALL)}
    assert not causes & {"latency", "backlash", "saturation"}
    assert {"axis_scale", "focal_length", "led_offset", "slip", "drift"} <= causes
