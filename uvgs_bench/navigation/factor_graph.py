"""A fixed-lag factor graph over readings of an inertial unit and poses, by GTSAM (the extra ``fusion``).

One node (pose X, velocity V, biases B) per pose of the sensor, joined by preintegrated readings; without poses, nodes
are added all the same so that the window moves on. The sensor enters as a pose, or as the pixels of its LEDs through
our own lens; the beacon's place may be a variable of the graph. Other poses that come late are moved to the nearest
node with the velocity known there.

GTSAM's tangents have our order (rotation, translation) but act on the right: ours are mapped by the adjoint, which for
a covariance of (rotation in world axes, position) is a turn into body axes.

Source: C. Forster et al., On-manifold preintegration for real-time visual-inertial odometry, 2017.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from uvgs_bench.camera.lens import Lens
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.navigation.error_state_filter import FilterConfig, UpdateRecord, packed, unpacked, widen
from uvgs_bench.navigation.filter_kernels import correct, innovation_covariance, pose_residual, propagate
from uvgs_bench.navigation.gate import InnovationGate
from uvgs_bench.navigation.gtsam_bridge import GraphConfig, body_covariance, load_gtsam, middle_force
from uvgs_bench.navigation.led_factor import led_residual, pixel_covariance
from uvgs_bench.navigation.states import NavigationState, PoseMeasurement, SensedPose
from uvgs_bench.units import ns_from_s, s_from_ns

_POSE_ROWS = np.array([6, 7, 8, 0, 1, 2])
_PHI = np.zeros((15, 15))
# Doubt of the integration itself; GTSAM needs one.
_INTEGRATION_VARIANCE = 1e-12
# So long after a pause poses are believed without reserve, s.
_BACK_S = 0.5
# A pose this near to a node belongs to it.
_SAME_NS = 1_000_000


class FixedLagGraph:
    """A graph that looks back a fixed time.

    Args:
        start: Where it begins.
        config: Noise, gravity and gate.
        graph: Parameters of the graph.
        world_from_beacon: Where the beacon stands, as far as known.
        body_from_camera: How the camera sits on the body.
        lens: The camera's lens; needed for ``led`` factors.
        leds_m: LED positions in the beacon frame, shape (n, 3), m; needed for ``led`` factors.

    Raises:
        ConfigError: GTSAM is not installed, or ``led`` factors were asked for without lens and LEDs.
    """

    def __init__(
        self,
        start: NavigationState,
        config: FilterConfig,
        graph: GraphConfig,
        world_from_beacon: Pose,
        body_from_camera: Pose,
        lens: Lens | None = None,
        leds_m: FloatArray | None = None,
    ) -> None:
        if graph.factors == "led" and (lens is None or leds_m is None):
            raise ConfigError("LED factors need the camera's lens, which this source does not tell", "--factors")
        self.config, self.graph = config, graph
        self._g = load_gtsam()
        self._lens, self._leds_m = lens, leds_m
        self._body_from_camera = body_from_camera
        self._camera_from_body = body_from_camera.inverse()
        self._gate = InnovationGate(config.gate_chi2, config.reopen_after)
        self._noise, self._gravity = config.noise.vector(), read_only(config.gravity_mps2)
        self._params = self._preintegration()
        settings = self._g.ISAM2Params()
        settings.setRelinearizeThreshold(0.001)
        settings.relinearizeSkip = 1
        # Cholesky factors fail on what is left after long dead reckoning.
        settings.setFactorization("QR")
        settings.findUnusedFactorSlots = True
        self._smoother = self._g.IncrementalFixedLagSmoother(graph.lag_s, settings)
        self._readings: deque[tuple[int, FloatArray]] = deque()
        self._last_reading: FloatArray | None = None
        self._beacon = world_from_beacon
        self._node, self._nodes = 0, [start.t_ns]
        self._believed_ns = self._back_until_ns = start.t_ns
        # Of the last node, as the filter would have it, for the gate. Answers state the graph's own.
        self._x, self._P = packed(start), np.array(start.covariance)
        self._begin(start)

    @property
    def t_ns(self) -> int:
        """The instant of the newest reading or node, ns."""
        return self._readings[-1][0] if self._readings else self._nodes[-1]

    @property
    def world_from_beacon(self) -> Pose:
        """Where the beacon stands, as far as known by now."""
        return self._beacon

    @property
    def state(self) -> NavigationState:
        """The newest state: that of the last node, carried on by the readings since. Computes its covariance anew."""
        x, P = self._x.copy(), self._joint()
        self._carry(x, P, self._nodes[-1], self.t_ns)
        return unpacked(self.t_ns, x, P)

    def add_imu(self, t_ns: int, acceleration_mps2: FloatArray, rate_radps: FloatArray) -> None:
        """Take a reading; after a pause without poses a node is added.

        Args:
            t_ns: Its instant, ns, later than the last one.
            acceleration_mps2: Specific force in body axes, shape (3,), m/s^2.
            rate_radps: Rate in body axes, shape (3,), rad/s.
        """
        reading = np.concatenate((acceleration_mps2, rate_radps))
        last, self._last_reading = self._last_reading, reading
        if t_ns <= self._nodes[-1]:
            return
        self._readings.append((t_ns, reading if last is None else 0.5 * (last + reading)))
        if s_from_ns(t_ns - self._nodes[-1]) > self.graph.pause_s:
            middle_ns = self._readings[len(self._readings) // 2][0]
            pim = self._preintegrated(middle_ns)
            x, mean = self._predicted(pim)
            self._age(self._P, mean, middle_ns)
            self._add_node(middle_ns, pim, x)
            self._solve()

    def add_pose(self, measurement: PoseMeasurement, sensed: SensedPose | None = None) -> UpdateRecord:
        """Take a measured pose.

        Args:
            measurement: The pose of the body.
            sensed: The sensor's pose it was made of; with it the sensor's own factors are used.

        Returns:
            What became of it.
        """
        t_ns, source = measurement.t_ns, measurement.source
        delay_s = s_from_ns(self.t_ns - t_ns)
        if t_ns < self._nodes[0] or s_from_ns(self._nodes[-1] - t_ns) > self.graph.lag_s:
            return UpdateRecord(t_ns, source, "too_old", np.nan, delay_s, read_only(np.full(6, np.nan)))
        is_new = t_ns > self._nodes[-1] + _SAME_NS
        x, P = self._x.copy(), self._P.copy()
        index = self._node
        pim = None
        own_noise = measurement.covariance
        if sensed is not None and self.graph.learns_beacon:
            measurement = self._by_beacon(sensed, measurement)
        if is_new:
            pim = self._preintegrated(t_ns)
            x, mean = self._predicted(pim)
            self._age(P, mean, t_ns)
        else:
            index = int(np.argmin([abs(node - t_ns) for node in self._nodes])) + self._node - len(self._nodes) + 1
            if abs(self._nodes[index - self._node - 1] - t_ns) > _SAME_NS:
                sensed = None
            x, measurement = self._moved(index, measurement)
        R, place, noise = measurement.world_from_body.R, measurement.world_from_body.t_m, measurement.covariance
        residual = pose_residual(x, R, place)
        L, distance = innovation_covariance(P, noise, _POSE_ROWS, residual)
        status = self._gate.judge(source, t_ns, distance, residual, noise, P)
        record = UpdateRecord(t_ns, source, status, distance, delay_s, read_only(residual))
        if status == "refused":
            return record
        if pim is not None:
            self._add_node(t_ns, pim, x)
            index = self._node
        if status == "reopened":
            widen(P, residual)
            L, _ = innovation_covariance(P, noise, _POSE_ROWS, residual)
        correct(x.copy(), P, L, noise, _POSE_ROWS, residual)
        self._P = P
        # Far off for a good reason: robust factors would not let single steps of the solver come back.
        if status == "reopened" or s_from_ns(t_ns - self._believed_ns) > self.graph.pause_s:
            self._back_until_ns = t_ns + ns_from_s(_BACK_S)
        self._believed_ns = max(self._believed_ns, t_ns)
        self._add_factor(index, measurement, own_noise, sensed, t_ns <= self._back_until_ns)
        self._solve()
        return record

    # What follows speaks GTSAM.

    def _preintegration(self) -> Any:
        n = self.config.noise
        params = self._g.PreintegrationCombinedParams(self._gravity)
        params.setAccelerometerCovariance(n.acceleration_noise_mps2_rthz**2 * np.eye(3))
        params.setGyroscopeCovariance(n.rate_noise_radps_rthz**2 * np.eye(3))
        params.setBiasAccCovariance(n.acceleration_walk_mps3_rthz**2 * np.eye(3))
        params.setBiasOmegaCovariance(n.rate_walk_radps2_rthz**2 * np.eye(3))
        params.setIntegrationCovariance(_INTEGRATION_VARIANCE * np.eye(3))
        return params

    def _keys(self, index: int) -> tuple[int, int, int]:
        symbol = self._g.symbol
        return symbol("x", index), symbol("v", index), symbol("b", index)

    def _pose3(self, pose: Pose) -> Any:
        return self._g.Pose3(self._g.Rot3(pose.R), pose.t_m)

    def _begin(self, start: NavigationState) -> None:
        g = self._g
        x, v, b = self._keys(0)
        self._new, self._values = g.NonlinearFactorGraph(), g.Values()
        self._stamps: dict[int, float] = {}
        self._insert(0, packed(start), start.t_ns)
        P = start.covariance
        gaussian = g.noiseModel.Gaussian.Covariance
        pose_noise = gaussian(body_covariance(start.world_from_body, start.place_covariance))
        self._new.add(g.PriorFactorPose3(x, self._pose3(start.world_from_body), pose_noise))
        self._new.add(g.PriorFactorVector(v, start.velocity_mps, gaussian(P[3:6, 3:6])))
        bias = g.imuBias.ConstantBias(start.acceleration_bias_mps2, start.rate_bias_radps)
        self._new.add(g.PriorFactorConstantBias(b, bias, gaussian(P[9:, 9:])))
        if self.graph.learns_beacon:
            sigmas = np.repeat((self.graph.beacon_sigma_rad, self.graph.beacon_sigma_m), 3)
            key, here = g.symbol("w", 0), self._pose3(self._beacon)
            self._values.insert(key, here)
            self._new.add(g.PriorFactorPose3(key, here, g.noiseModel.Diagonal.Sigmas(sigmas)))
        self._solve()

    def _insert(self, index: int, state: FloatArray, t_ns: int) -> None:
        g = self._g
        x, v, b = self._keys(index)
        self._values.insert(x, g.Pose3(g.Rot3(state[6:15].reshape(3, 3)), state[:3]))
        self._values.insert(v, state[3:6])
        self._values.insert(b, g.imuBias.ConstantBias(state[15:18], state[18:21]))
        self._stamps |= dict.fromkeys((x, v, b), s_from_ns(t_ns))

    def _age(self, P: FloatArray, mean: FloatArray, t_ns: int) -> None:
        """Carry the gate's covariance from the last node to an instant, in one coarse step."""
        dt_s = s_from_ns(t_ns - self._nodes[-1])
        propagate(self._x.copy(), P, _PHI, mean, dt_s, self._noise, self._gravity, False)

    def _preintegrated(self, t_ns: int) -> Any:
        """The readings from the last node to an instant as one factor's worth."""
        g = self._g
        pim = g.PreintegratedCombinedMeasurements(self._params, g.imuBias.ConstantBias(self._x[15:18], self._x[18:21]))
        now_ns = self._nodes[-1]
        for end_ns, reading in self._steps(now_ns, t_ns):
            force, rate, dt_s = reading[:3], reading[3:], s_from_ns(end_ns - now_ns)
            pim.integrateMeasurement(middle_force(force, rate - self._x[18:21], dt_s), rate, dt_s)
            now_ns = end_ns
        return pim

    def _predicted(self, pim: Any) -> tuple[FloatArray, FloatArray]:
        """The state after preintegrated readings, and their mean."""
        g = self._g
        bias = g.imuBias.ConstantBias(self._x[15:18], self._x[18:21])
        here = g.NavState(g.Rot3(self._x[6:15].reshape(3, 3)), self._x[:3], self._x[3:6])
        nav = pim.predict(here, bias)
        R = np.ascontiguousarray(nav.attitude().matrix())
        x = np.concatenate((nav.position(), nav.velocity(), R.reshape(9), self._x[15:]))
        dt_s = pim.deltaTij()
        mean = np.concatenate((pim.deltaVij() / dt_s + self._x[15:18], g.Rot3.Logmap(pim.deltaRij()) / dt_s))
        mean[3:] += self._x[18:21]
        return x, mean

    def _add_node(self, t_ns: int, pim: Any, x: FloatArray) -> None:
        """A node at an instant, joined to the last one by the readings until then."""
        before = self._node
        self._x = x
        while self._readings and self._readings[0][0] <= t_ns:
            self._readings.popleft()
        self._node += 1
        self._nodes.append(t_ns)
        lag_ns = t_ns - ns_from_s(self.graph.lag_s)
        while self._nodes[0] < lag_ns:
            self._nodes.pop(0)
        self._insert(self._node, x, t_ns)
        (x0, v0, b0), (x1, v1, b1) = self._keys(before), self._keys(self._node)
        self._new.add(self._g.CombinedImuFactor(x0, v0, x1, v1, b0, b1, pim))

    def _steps(self, start_ns: int, end_ns: int) -> list[tuple[int, FloatArray]]:
        steps = [(t, reading) for t, reading in self._readings if start_ns < t < end_ns]
        later = [reading for t, reading in self._readings if t >= end_ns]
        last = later[0] if later else self._last_reading
        if last is None:
            last = np.concatenate((self._x[15:18] - self._gravity @ self._x[6:15].reshape(3, 3), self._x[18:21]))
        return [*steps, (end_ns, last)] if end_ns > start_ns else []

    def _carry(self, x: FloatArray, P: FloatArray, start_ns: int, end_ns: int) -> None:
        for until_ns, reading in self._steps(start_ns, end_ns):
            propagate(x, P, _PHI, reading, s_from_ns(until_ns - start_ns), self._noise, self._gravity, False)
            start_ns = until_ns

    def _by_beacon(self, sensed: SensedPose, m: PoseMeasurement) -> PoseMeasurement:
        """A measured pose by where the beacon is believed to stand now, with the doubt of that."""
        beacon_from_body = (self._body_from_camera @ sensed.camera_from_beacon).inverse()
        pose = self._beacon @ beacon_from_body
        Ad = beacon_from_body.inverse().adjoint()
        doubt = Ad @ self._smoother.marginalCovariance(self._g.symbol("w", 0)) @ Ad.T
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = pose.R
        return PoseMeasurement(m.t_ns, pose, m.covariance + turn @ doubt @ turn.T, m.source, m.delay_ns)

    def _moved(self, index: int, m: PoseMeasurement) -> tuple[FloatArray, PoseMeasurement]:
        """The state of an older node, and a measurement moved to its instant by its own velocity and rate."""
        state = self._state_of(index)
        node_ns = self._nodes[index - self._node - 1]
        dt_s = s_from_ns(node_ns - m.t_ns)
        rate = np.zeros(3) if self._last_reading is None else self._last_reading[3:] - state[18:21]
        pose = Pose(
            m.world_from_body.R @ so3_exp(dt_s * rate), m.world_from_body.t_m + dt_s * state[3:6], "world", "body"
        )
        return state, PoseMeasurement(node_ns, pose, m.covariance, m.source, m.delay_ns)

    def _state_of(self, index: int) -> FloatArray:
        x, v, b = self._keys(index)
        smoother = self._smoother
        pose, bias = smoother.calculateEstimatePose3(x), smoother.calculateEstimateConstantBias(b)
        R = np.ascontiguousarray(pose.rotation().matrix()).reshape(9)
        velocity = smoother.calculateEstimateVector(v)
        parts = (pose.translation(), velocity, R, bias.accelerometer(), bias.gyroscope())
        return np.concatenate(parts)

    def _add_factor(
        self, index: int, m: PoseMeasurement, own_noise: FloatArray, sensed: SensedPose | None, is_back: bool
    ) -> None:
        g = self._g
        x, _, _ = self._keys(index)
        if sensed is not None and self.graph.factors == "led" and sensed.led_px is not None:
            self._new.add(self._led_factor(x, sensed, is_back))
            return
        noise = g.noiseModel.Gaussian.Covariance(body_covariance(m.world_from_body, own_noise))
        if not is_back:
            noise = self._robust(noise)
        if sensed is not None and self.graph.learns_beacon:
            beacon_from_body = (self._body_from_camera @ sensed.camera_from_beacon).inverse()
            self._new.add(g.BetweenFactorPose3(g.symbol("w", 0), x, self._pose3(beacon_from_body), noise))
        else:
            self._new.add(g.PriorFactorPose3(x, self._pose3(m.world_from_body), noise))

    def _robust(self, noise: Any) -> Any:
        m = self._g.noiseModel
        return m.Robust.Create(m.mEstimator.Huber.Create(self.graph.huber_k), noise)

    def _led_factor(self, x: int, sensed: SensedPose, is_back: bool) -> Any:
        g, lens, leds_m = self._g, self._lens, self._leds_m
        assert lens is not None
        assert leds_m is not None
        assert sensed.led_px is not None
        seen = np.isfinite(sensed.led_px).all(axis=1)
        points_m, px = leds_m[seen], sensed.led_px[seen]
        covariance_px2 = pixel_covariance(lens, points_m, sensed)
        keys = [x, g.symbol("w", 0)] if self.graph.learns_beacon else [x]
        fixed, camera_from_body = self._beacon, self._camera_from_body

        def error(factor: Any, values: Any, jacobians: Any) -> FloatArray:
            body = _pose_of(values.atPose3(factor.keys()[0]), "body")
            beacon = _pose_of(values.atPose3(factor.keys()[1]), "beacon") if len(keys) > 1 else fixed
            e, by_body, by_beacon = led_residual(lens, camera_from_body, body, beacon, points_m, px)
            if jacobians is not None:
                jacobians[0] = by_body
                if len(keys) > 1:
                    jacobians[1] = by_beacon
            return e

        gaussian = g.noiseModel.Gaussian.Covariance(covariance_px2)
        noise = gaussian if is_back else self._robust(gaussian)
        return g.CustomFactor(noise, keys, error)

    def _solve(self) -> None:
        g = self._g
        if self.graph.learns_beacon:
            # A variable without a new stamp would leave the window.
            self._stamps[g.symbol("w", 0)] = s_from_ns(self._nodes[-1])
        self._smoother.update(self._new, self._values, self._stamps)
        self._new, self._values, self._stamps = g.NonlinearFactorGraph(), g.Values(), {}
        self._x = self._state_of(self._node)
        if self.graph.learns_beacon:
            self._beacon = _pose_of(self._smoother.calculateEstimatePose3(g.symbol("w", 0)), "beacon")

    def _joint(self) -> FloatArray:
        """Covariance of the last node with all correlations, shape (15, 15)."""
        g, keys = self._g, self._keys(self._node)
        marginals = g.Marginals(self._smoother.getFactors(), self._smoother.calculateEstimate())
        joint = marginals.jointMarginalCovariance(list(keys))
        blocks = [[joint.at(a, b) for b in keys] for a in keys]
        full = np.block(blocks)
        R = self._x[6:15].reshape(3, 3)
        # GTSAM: rotation and position in body axes, velocity in world axes, biases.
        turn = np.eye(15)
        turn[:3, :3], turn[3:6, 3:6] = R, R
        order = np.array([3, 4, 5, 6, 7, 8, 0, 1, 2, 9, 10, 11, 12, 13, 14])
        P: FloatArray = (turn @ full @ turn.T)[np.ix_(order, order)]
        return 0.5 * (P + P.T)


def _pose_of(pose3: Any, source: str) -> Pose:
    return Pose(np.ascontiguousarray(pose3.rotation().matrix()), pose3.translation(), "world", source)
