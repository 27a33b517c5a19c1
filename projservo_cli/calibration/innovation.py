"""Whether images in the loop agree with the calibration, and what is to blame where they do not."""

from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri

from projservo_cli.calibration.prediction import covariance_root, predict, prediction_derivative
from projservo_cli.calibration.readings import LEAST_SIGMA
from projservo_cli.records import BoolArray, Calibration, FloatArray

# Observations in a row that must agree on a disturbance: one may be blurred, or a marker taken for another.
WINDOW = 3
# Chance that a run of undisturbed observations is called disturbed, at most.
_FALSE_ALARM = 1e-3
# What the first order leaves out of a prediction's error, at most, as a share of the calibration's own noise:
# nearer than that no image need come to what is predicted, however good the detector.
_BEYOND_FIRST_ORDER = 0.02


@dataclass(eq=False)
class Innovation:
    """Whether a sequence of observations still agrees with a calibration: a bumped camera, a moved marker.

    At given joint readings the calibration predicts the pixels of every marker. What is seen differs by
    the pixel noise and by the error of the calibration, r = J δ + ε with δ ~ N(0, Σ) and ε ~ N(0, σ² I),
    to first order. δ is the same all along, so it is estimated from one observation to the next by a
    Kalman filter, and each innovation has the χ² distribution of its own S = J C Jᵀ + σ² I. The parts that
    are tested are the two views and each marker; one that is beyond its threshold several times in a row
    is no chance and no slip of the detector.

    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
    Navigation", Wiley 2001, section 5.4 (innovation as a test of the filter).
    """

    calibration: Calibration  # what predicts the pixels, with its covariance
    sigma_px: float  # pixel noise per coordinate
    observations: int  # most observations of one sequence, which sets the threshold
    _beyond: list[BoolArray] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._factor = covariance_root(self.calibration.covariance)
        r = self._factor.shape[1]
        self._mean, self._C = np.zeros(r), np.eye(r)
        self._sigma = max(self.sigma_px, _BEYOND_FIRST_ORDER * self.calibration.sigma_px, LEAST_SIGMA)
        m = len(self.calibration.marker)
        tail = _FALSE_ALARM / (self.observations * (2 + m))
        self._threshold: FloatArray = np.asarray(chdtri(np.maximum(np.arange(4 * m + 1), 1), tail))

    def disturbed(
        self, q: FloatArray, q_dot: FloatArray, delay_sigma: FloatArray, images: FloatArray, fresh: BoolArray
    ) -> str:
        """What is wrong, in words; empty while nothing is.

        q : (2, n) joint readings at the instants of both frames, rad or m.
        q_dot : (n,) joint velocities, rad/s or m/s.
        delay_sigma : (2,) uncertainty of these instants, of the delay and its jitter together, s.
        images : (2, m, 2) raw pixels of the markers of the calibration, NaN where unseen.
        fresh : (2,) whether the frame of a view is new; one that comes twice is no second measurement.
        """
        if not fresh.any():
            return ""
        views = np.arange(2)
        J = prediction_derivative(self.calibration, q)[views, views] @ self._factor
        seen = np.where(fresh[:, None, None], images, np.nan)
        r = seen - predict(self.calibration, q)[views, views] - J @ self._mean
        shape = r.shape[:2]
        parts = [np.broadcast_to(view[:, None], shape) for view in np.eye(2, dtype=np.bool_)]
        parts += [np.broadcast_to(marker, shape) for marker in np.eye(shape[1], dtype=np.bool_)]
        beyond = np.array([self._beyond_chance(r, J, part) for part in parts])
        self._beyond = [*self._beyond[1 - WINDOW :], beyond]
        lasting = np.all(self._beyond, axis=0)
        if len(self._beyond) == WINDOW and lasting.any():
            return self._culprit(r, J, lasting[2:])
        if not beyond.any():
            self._learn(r, J)
        return ""

    def _seen(
        self, r: FloatArray, J: FloatArray, part: BoolArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Innovation, derivative and covariance of the innovation of what was seen of a part (2, m)."""
        seen = part & np.isfinite(r[..., 0])
        B = J[seen].reshape(-1, J.shape[-1])
        return r[seen].ravel(), B, B @ self._C @ B.T + self._sigma**2 * np.eye(len(B))

    def _beyond_chance(self, r: FloatArray, J: FloatArray, part: BoolArray) -> bool:
        """Whether χ² of what was seen of a part (2, m) is beyond what chance allows."""
        values, _, S = self._seen(r, J, part)
        return bool(values @ np.linalg.solve(S, values) > self._threshold[values.size])

    def _learn(self, r: FloatArray, J: FloatArray) -> None:
        """Kalman update of the error of the calibration."""
        values, B, S = self._seen(r, J, np.ones(r.shape[:2], dtype=np.bool_))
        gain = np.linalg.solve(S, B @ self._C).T
        self._mean = self._mean + gain @ values
        self._C = self._C - gain @ B @ self._C
        self._C = 0.5 * (self._C + self._C.T)

    def _culprit(self, r: FloatArray, J: FloatArray, moved: BoolArray) -> str:
        """The least that explains it: some markers, one camera, or everything."""
        few = moved.sum() <= len(moved) // 2
        views = [
            self._beyond_chance(r, J, np.outer(np.arange(2) == view, ~moved | (not few))) for view in range(2)
        ]
        rms = float(np.sqrt(np.nanmean(r**2)))
        fit = f"images are {rms:.3g} px rms per coordinate off what the calibration predicts"
        if few and not any(views):
            numbers = ", ".join(map(str, self.calibration.marker[moved]))
            return f"{fit}: marker {numbers} was moved on the tool; put it back, or recalibrate"
        if views[0] != views[1]:
            side = ("left", "right")[int(views[1])]
            return f"{fit}, those of the {side} camera alone: it was moved; recalibrate"
        return (
            f"{fit}, in both cameras alike: the joint readings are wrong, or the tool or the rig was moved; "
            "check them and recalibrate"
        )
