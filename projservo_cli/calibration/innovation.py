"""Whether what is seen still agrees with the calibration: a bumped camera, a moved marker.

At given joint readings the calibration predicts the pixels of every marker. What is seen differs from
them by the pixel noise and by the error of the calibration, r = J δ + ε with δ ~ N(0, Σ) and
ε ~ N(0, σ² I), to first order. δ is the same all along, so it is estimated from one observation to the
next by a Kalman filter, and each innovation has the χ² distribution of its own S = J C Jᵀ + σ² I. The
parts that are tested are the two views and each marker; one that is beyond its threshold several
times in a row is no chance and no slip of the detector.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
Navigation", Wiley 2001, section 5.4 (innovation as a test of the filter).
"""

from dataclasses import dataclass, field

import numpy as np

from projservo_cli.calibration.prediction import predict, prediction_derivative
from projservo_cli.calibration.quality import chi2_beyond
from projservo_cli.records import BoolArray, Calibration, FloatArray

VIEWS = ("left", "right")
# Chance that a run of undisturbed observations is called disturbed, at most.
FALSE_ALARM = 1e-3
# Observations in a row that must agree on it: one may be blurred, or a marker be taken for another.
WINDOW = 3
# No detector is better, px per coordinate.
LEAST_SIGMA = 0.01
# Smallest over largest variance that is no rounding.
RANK = 1e-12


@dataclass(eq=False)
class Innovation:
    """Test of a sequence of observations against a calibration.

    Attributes
    ----------
    calibration : what predicts the pixels, with its covariance.
    sigma_px : pixel noise per coordinate.
    observations : most observations of one sequence, which sets the threshold.
    """

    calibration: Calibration
    sigma_px: float
    observations: int
    _beyond: list[BoolArray] = field(default_factory=list)

    def __post_init__(self) -> None:
        spread, axes = np.linalg.eigh(self.calibration.covariance)
        known = spread > RANK * spread[-1]  # the gauge, and what a rigid robot cannot do, have no spread
        self._factor: FloatArray = np.sqrt(spread[known]) * axes[:, known]
        self._mean, self._C = np.zeros(known.sum()), np.eye(known.sum())
        m = len(self.calibration.marker)
        tail = FALSE_ALARM / (self.observations * (2 + m))
        self._threshold: FloatArray = np.asarray(chi2_beyond(tail, np.maximum(np.arange(4 * m + 1), 1)))

    def disturbed(self, q: FloatArray, images: FloatArray) -> str:
        """What is wrong, in words; empty while nothing is.

        Parameters
        ----------
        q : (n,) joint readings, rad or m.
        images : (2, m, 2) pixels of the markers of the calibration, NaN where unseen.
        """
        J = prediction_derivative(self.calibration.model(), self.calibration.M, q[None])[0] @ self._factor
        r = images - predict(self.calibration, q[None])[0] - J @ self._mean
        m = len(self.calibration.marker)
        views, numbers = np.arange(2)[:, None], np.arange(m)
        parts = [*(np.tile(views == view, m) for view in range(2))]
        parts += [np.tile(numbers == j, (2, 1)) for j in range(m)]
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
        S = B @ self._C @ B.T + max(self.sigma_px, LEAST_SIGMA) ** 2 * np.eye(len(B))
        return r[seen].ravel(), B, S

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
            side = VIEWS[int(views[1])]
            return f"{fit}, those of the {side} camera alone: it was moved; recalibrate"
        return (
            f"{fit}, in both cameras alike: the joint readings are wrong, or the tool or the rig was moved; "
            "check them and recalibrate"
        )
