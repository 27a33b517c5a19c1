"""What the data can support: refusals before and after the fit, and the verdict in words."""

from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration.chance import chi2_beyond, chi2_quantile
from projservo_cli.calibration.epipolar import Epipolar
from projservo_cli.calibration.excitation import REACH_M, REACH_RAD, WEAK_NOISE, describe_joint
from projservo_cli.records import BoolArray, FloatArray, IntArray, WorkFailed

# Fitted noise over the noise expected: above the first, or so many standard errors above one where that
# is less, more than pixel noise is left; above the last the model does not describe the data.
WARN_RATIO, WARN_ERRORS, REFUSE_RATIO = 1.15, 4.0, 3.0
# Shares of sightings both views agree on, and of poses, that may be left out of a fit.
MOST_UNEXPLAINED, MOST_SUSPECT = 0.02, 0.4
# Share of sightings beyond which outliers are what limits a fit.
MOST_OUTLIERS = 0.05
CHI2_TAIL = 1e-4
LEAST_SIGMA = 1e-4
# Least distance of the markers from their best line, in units of its own noise.
OFF_LINE = 5.0
ON_A_LINE = "the markers lie on one line: a turn about it shows in no image; add a marker off the line"


class Misfit(WorkFailed):
    """No model of the robot describes what was seen."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """What a fit leaves of the images.

    Attributes
    ----------
    residual : (2, N, 2) predicted minus seen, px.
    used : (2, N) readings that count; the rest of those seen are outliers.
    dof : degrees of freedom.
    """

    residual: FloatArray
    used: BoolArray
    dof: int

    @property
    def chi2(self) -> float:
        """Sum of squares of the readings used, px²."""
        return float((self.residual[self.used] ** 2).sum())

    @property
    def sigma_px(self) -> float:
        """Noise per coordinate that the residuals show, px."""
        return float(np.sqrt(self.chi2 / max(self.dof, 1)))

    @property
    def rms_px(self) -> float:
        """Root mean square of the Euclidean residual per marker and view, px."""
        return float(np.sqrt(self.chi2 / max(int(self.used.sum()), 1)))


@dataclass(frozen=True)
class Expected:
    """The noise a fit is measured by, px per coordinate.

    Attributes
    ----------
    sigma_px : noise that was given, else that of the epipolar geometry.
    known : whether it is the true noise of a simulation, so that χ² decides.
    origin : where it comes from, in words.
    error : its own standard error as a share of it, zero where it was given.
    """

    sigma_px: float
    known: bool
    origin: str
    error: float

    def ratio(self, agreement: Agreement) -> float:
        """Fitted over expected noise."""
        return agreement.sigma_px / self.sigma_px

    def noise_px(self, agreement: Agreement) -> float:
        """Noise a covariance is scaled by, px: the true one of a simulation, else never below the fitted."""
        return self.sigma_px if self.known else max(self.sigma_px, agreement.sigma_px)

    def warn_ratio(self, agreement: Agreement) -> float:
        """Ratio above which more than pixel noise is left: both noises come from finitely many residuals."""
        error = float(np.hypot(self.error, 1.0 / np.sqrt(2.0 * max(agreement.dof, 1))))
        return min(WARN_RATIO, 1.0 + WARN_ERRORS * error)

    def agrees(self, agreement: Agreement) -> bool:
        """Whether a fit leaves nothing but the expected noise, so that no other need be sought."""
        if self.known:
            low, high = chi2_band(agreement.dof)
            return low <= self.ratio(agreement) ** 2 <= high
        return self.ratio(agreement) <= self.warn_ratio(agreement)

    def refusal(self, agreement: Agreement) -> str | None:
        """Why a fit must not pass, or None where it may."""
        if self.known and not self.agrees(agreement):
            low, high = chi2_band(agreement.dof)
            return (
                f"the fit does not describe the data: χ² per degree of freedom is "
                f"{self.ratio(agreement) ** 2:.4g} at {self.sigma_px:g} px of noise, expected within "
                f"{low:.4g} and {high:.4g}"
            )
        if self.ratio(agreement) > REFUSE_RATIO:
            return (
                f"the fit does not describe the data: residuals of {agreement.sigma_px:.3g} px a coordinate "
                f"are {self.ratio(agreement):.3g} times the {self.sigma_px:.3g} px {self.origin}; check the "
                "joint readings, their units and types, and the marker numbers"
            )
        return None


def expected_noise(epipolar: Epipolar, sigma_px: float | None, source: str) -> Expected:
    """Noise to measure a fit by.

    Parameters
    ----------
    epipolar : epipolar geometry of the rig, whose residuals show the noise.
    sigma_px : noise that was configured or given, px, or None.
    source : ``simulated`` or ``recorded``.
    """
    if sigma_px is None:
        noise = max(epipolar.sigma_px, LEAST_SIGMA)
        return Expected(noise, False, "that the epipolar geometry shows", epipolar.relative_error)
    return Expected(sigma_px, source == "simulated", "that were given", 0.0)


def require_off_line(M: FloatArray, factor: FloatArray) -> None:
    """Refuse a body that its covariance cannot tell from a line, the span of two points.

    Parameters
    ----------
    M : (m, 4) fitted markers in an isotropic projective frame.
    factor : (4 m, r) factor of their covariance.

    Raises
    ------
    WorkFailed
        If the markers are not off their best line by several times the noise of their distances from it.
    """
    U, extent, Vt = np.linalg.svd(M, full_matrices=False)
    m = len(M)
    across = np.eye(m) - U[:, :2] @ U[:, :2].T
    noise = across @ (Vt[2:] @ factor.reshape(m, 4, -1)).reshape(m, -1)
    if extent[2] < OFF_LINE * float(np.linalg.norm(noise)):
        raise WorkFailed(ON_A_LINE)


def chi2_band(dof: int) -> tuple[float, float]:
    """Quantiles of χ² per degree of freedom between which a true model stays, all but 2e-4 of the time."""
    return float(chi2_quantile(CHI2_TAIL, dof)) / dof, float(chi2_beyond(CHI2_TAIL, dof)) / dof


def require_explained(unexplained: int, sightings: int, suspect_poses: int, poses: int) -> None:
    """Refuse a fit that leaves out too much of what both cameras agree on.

    Parameters
    ----------
    unexplained : sightings left out although both views agree on them.
    sightings : all sightings in both views.
    suspect_poses : poses left out for their joint readings.
    poses : all poses.

    Raises
    ------
    Misfit
        If the model of the robot, not single errors, is at odds with the data.
    """
    if unexplained > max(3.0, MOST_UNEXPLAINED * sightings):
        raise Misfit(
            f"the fit does not describe the data: in {unexplained} of {sightings} sightings both cameras "
            "agree with each other but not with the robot; check the joint readings and types (R or P)"
        )
    if suspect_poses > MOST_SUSPECT * poses:
        raise Misfit(
            f"the fit does not describe the data: {suspect_poses} of {poses} poses contradict their joint "
            "readings; check the joint readings, their units and types (R or P)"
        )


def shortfall(method: str, agreement: Agreement, expected: Expected) -> str | None:
    """Why a fit that was not refused cannot be used, or None where it can.

    The methods without refinement are kept for comparison: they return what they find, marked so.
    Theirs is no least-squares fit, so that residuals above the noise are their own doing.
    """
    if method == "refined" or expected.ratio(agreement) <= expected.warn_ratio(agreement):
        return None
    return (
        f"the {method} method explains the images only to {agreement.sigma_px:.3g} px a coordinate, "
        f"{expected.ratio(agreement):.3g} times the {expected.sigma_px:.3g} px {expected.origin}: use refined"
    )


def _limit(
    agreement: Agreement, weak: IntArray, span: FloatArray, prismatic: BoolArray, outliers: int
) -> str:
    """What limits a calibration that leaves no more than pixel noise, in a word."""
    if weak.size:
        short = span[weak] < np.where(prismatic[weak], REACH_M, REACH_RAD)
        return "amplitude" if short.any() else "geometry"
    return "outliers" if outliers > MOST_OUTLIERS * agreement.used.shape[1] else "noise"


def verdict(
    agreement: Agreement,
    expected: Expected,
    noise: FloatArray,
    span: FloatArray,
    needed: FloatArray,
    prismatic: BoolArray,
    left_out: tuple[int, int, int],
    suspicion: str,
) -> tuple[str, tuple[str, ...]]:
    """Why a calibration is usable, what limits it, and what to do next, in words.

    Parameters
    ----------
    agreement, expected : what the fit leaves, and what it should.
    noise, span, needed, prismatic : (n,) as in ``require_determined``.
    left_out : number of outliers, of suspect joint readings and of exchanged markers.
    suspicion : what may be to blame for more than pixel noise.
    """
    sigma, ratio = agreement.sigma_px, expected.ratio(agreement)
    weak = np.flatnonzero(noise > WEAK_NOISE)
    advice = [describe_joint(int(i), float(span[i]), bool(prismatic[i]), float(needed[i])) for i in weak]
    limit = _limit(agreement, weak, span, prismatic, left_out[0])
    if suspicion == "lens":
        limit = suspicion
    wanted = f"the {expected.sigma_px:.3g} px {expected.origin}"
    reason = f"residuals of {sigma:.3g} px a coordinate agree with {wanted}"
    if ratio > expected.warn_ratio(agreement):
        limit = suspicion
        left = f"residuals of {sigma:.3g} px a coordinate are {ratio:.3g} times {wanted}"
        reason = f"more than pixel noise is left: {left}"
        if "joint readings" in suspicion:
            advice.append("look for joint readings that lag behind the images")
    outliers, suspects, swaps = left_out
    if outliers:
        advice.append(f"{outliers} sightings were left out as outliers: check the detection of markers")
    if suspects:
        advice.append(
            f"{suspects} joint readings disagree with the images: check how poses and images are paired"
        )
    if swaps:
        advice.append(f"{swaps} times a marker was seen under another's number: check the numbering")
    return f"{reason}; limited by {limit}", tuple(advice)
