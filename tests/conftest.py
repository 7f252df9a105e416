"""Settings every test shares."""

from __future__ import annotations

from hypothesis import HealthCheck, settings

# Seeds are fixed, and compiled kernels make the first example slow: neither luck nor the clock decides a test.
settings.register_profile(
    "house", deadline=None, derandomize=True, max_examples=60, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("house")
