"""The emission centre of an LED that travels along its axis as the LED is seen from the side.

Under a dome the centre of the light comes forward, or goes back, with the view angle: by ``shift * (1 - cos(angle))``
along the axis. Positions then mean those seen along the axis.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uvgs_bench.beacon.frames import fit_rigid
from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.beacon.network import Network, State, points_in_camera
from uvgs_bench.errors import ConfigError


def with_shifts(network: Network, state: State, nominal: Beacon) -> tuple[Network, State]:
    """Let every emission centre travel.

    Args:
        network: The network without shifts.
        state: Near its minimum: view angles are taken from it once, a tenth of a degree is near enough.
        nominal: The beacon, for the axes; an LED without one stays.

    Returns:
        The network and the state with shifts of zero.

    Raises:
        ConfigError: No LED has an axis.
    """
    if all(led.axis is None for led in nominal.leds):
        raise ConfigError("no LED of the nominal beacon has an axis for its emission centre to travel along", "leds")
    s = network.sightings
    turn, _ = fit_rigid(nominal.positions_m, state.leds_m)
    axes = np.array([np.zeros(3) if led.axis is None else turn @ led.axis for led in nominal.leds])
    axis = np.where((s.led >= 0)[:, None], axes[s.led], 0.0)
    p = points_in_camera(network, state)
    R = state.R[s.view] if network.gantry is None else np.broadcast_to(state.R[0], (len(p), 3, 3))
    cosine = -np.einsum("nij,nj,ni->n", R, axis, p) / np.linalg.norm(p, axis=1)
    shifted = replace(network, shift_axes=axis * (1.0 - cosine)[:, None])
    return shifted, replace(state, shifts_m=np.zeros(len(nominal.leds)))
