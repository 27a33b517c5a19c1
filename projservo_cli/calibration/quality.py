"""What the data can support: refusals before and after the fit, and the verdict in words."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from projservo_cli.calibration.readings import Readings
from projservo_cli.records import BoolArray, FloatArray, WorkFailed

# Fitted noise over the noise expected: above the first more than pixel noise is left, above the
# second the model does not describe the data.
WARN_RATIO, REFUSE_RATIO = 1.15, 3.0
# Shares of sightings both views agree on, and of poses, that may be left out of a fit.
MOST_UNEXPLAINED, MOST_SUSPECT = 0.02, 0.4
CHI2_TAIL = 1e-4
LEAST_SIGMA = 1e-4
# Second over first extent of a body that counts as a line.
COLLINEAR = 0.03
# Reach at which predictions are judged, rad and m, and their noise there in units of the pixel
# noise: above the first a joint is weak, above the second undetermined.
REACH_RAD, REACH_M = 0.5, 0.15
WEAK_NOISE, UNDETERMINED_NOISE = 3.0, 1000.0
# Least motion of the images over the range of a joint, in units of the pixel noise.
LEAST_MOTION = 5.0


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
    """

    sigma_px: float
    known: bool
    origin: str

    def ratio(self, agreement: Agreement) -> float:
        """Fitted over expected noise."""
        return agreement.sigma_px / self.sigma_px

    def noise_px(self, agreement: Agreement) -> float:
        """Noise a covariance is scaled by, px: the true one of a simulation, else never below the fitted."""
        return self.sigma_px if self.known else max(self.sigma_px, agreement.sigma_px)

    def agrees(self, agreement: Agreement) -> bool:
        """Whether a fit leaves nothing but the expected noise, so that no other need be sought."""
        if self.known:
            low, high = chi2_band(agreement.dof)
            return low <= self.ratio(agreement) ** 2 <= high
        return self.ratio(agreement) <= WARN_RATIO

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


def expected_noise(epipolar_px: float, sigma_px: float | None, source: str) -> Expected:
    """Noise to measure a fit by.

    Parameters
    ----------
    epipolar_px : noise from the epipolar residuals, px.
    sigma_px : noise that was configured or given, px, or None.
    source : ``simulated`` or ``recorded``.
    """
    if sigma_px is None:
        return Expected(max(epipolar_px, LEAST_SIGMA), False, "that the epipolar geometry shows")
    return Expected(sigma_px, source == "simulated", "that were given")


def amount(value: float, prismatic: bool) -> str:
    """A joint motion in words, mm or degrees."""
    return f"{1e3 * value:.3g} mm" if prismatic else f"{np.degrees(value):.3g}°"


def require_motion(readings: Readings) -> FloatArray:
    """Range of each joint over the poses, (n,) rad or m.

    Raises
    ------
    WorkFailed
        If a joint never moves, fewer than three markers were seen, or there is only one pose.
    """
    m = readings.marker.size
    if m < 3:
        what = ("no marker was", "only one marker was", "only two markers, which lie on a line, were")[m]
        raise WorkFailed(
            f"{what} seen: a rotation about a line through them shows in no image; "
            "use three or more markers that are not on one line"
        )
    if len(readings.q) < 2:
        raise WorkFailed("only one pose: trial motions of every joint are needed")
    present = np.unique(readings.pose_of)
    span: FloatArray = np.ptp(readings.q[present], axis=0)
    for i in np.flatnonzero(span <= 1e-6):
        raise WorkFailed(
            f"joint {i + 1} has no trial motion: it never moves in the data; record poses in which it does"
        )
    return span


def require_body(body: FloatArray) -> None:
    """Refuse a body whose markers lie on one line.

    Parameters
    ----------
    body : (m, 3) markers in a guessed metric frame, NaN where unknown.

    Raises
    ------
    WorkFailed
        If fewer than three markers are known or all lie on one line.
    """
    known = body[np.isfinite(body[:, 0])]
    if len(known) < 3:
        raise WorkFailed("no three markers are seen together by both cameras: more must be seen at once")
    extent = np.linalg.svd(known - known.mean(axis=0), compute_uv=False)
    if extent[1] < COLLINEAR * extent[0]:
        raise WorkFailed(
            "the markers lie on one line: turns about it show in no image; move one marker off the line"
        )


def chi2_band(dof: int) -> tuple[float, float]:
    """Quantiles of χ² per degree of freedom between which a true model stays, all but 2e-4 of the time."""
    return float(chi2.ppf(CHI2_TAIL, dof)) / dof, float(chi2.isf(CHI2_TAIL, dof)) / dof


def describe_joint(i: int, span: float, prismatic: bool) -> str:
    """Advice for a joint that moved too little, or never apart from the others."""
    reach = REACH_M if prismatic else REACH_RAD
    moved = amount(span, prismatic)
    if span >= reach:
        return f"joint {i + 1} moved {moved} but hardly apart from the other joints: move it alone"
    more = amount(min(2.0 * reach, max(4.0 * span, 0.5 * reach)), prismatic)
    return f"joint {i + 1} moved only {moved}: move it at least {more}"


def require_determined(
    noise: FloatArray, motion_px: FloatArray, sigma_px: float, span: FloatArray, prismatic: BoolArray
) -> None:
    """Refuse a joint whose operator the data leave open.

    Parameters
    ----------
    noise : (n,) predicted noise of images at the reach of each joint, in units of the pixel noise.
    motion_px : (n,) how far the joint's range moves the images, px.
    sigma_px : pixel noise per coordinate.
    span : (n,) range of each joint in the data, rad or m.
    prismatic : (n,) types of the joints.

    Raises
    ------
    WorkFailed
        Naming the worst joint.
    """
    i = int(np.argmin(motion_px))
    if motion_px[i] < LEAST_MOTION * sigma_px:
        raise WorkFailed(
            f"too little excitation: the range of joint {i + 1} moves the images by {motion_px[i]:.3g} px, "
            f"less than {LEAST_MOTION:g} times their noise of {sigma_px:.3g} px; "
            f"{describe_joint(i, float(span[i]), bool(prismatic[i]))}"
        )
    i = int(np.argmax(noise))
    if noise[i] > UNDETERMINED_NOISE:
        raise WorkFailed(
            f"joint {i + 1} is not determined: near the reference its images would be wrong by "
            f"{noise[i]:.3g} times the pixel noise; {describe_joint(i, float(span[i]), bool(prismatic[i]))}"
        )


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
    WorkFailed
        If the model of the robot, not single errors, is at odds with the data.
    """
    if unexplained > max(3.0, MOST_UNEXPLAINED * sightings):
        raise WorkFailed(
            f"the fit does not describe the data: in {unexplained} of {sightings} sightings both cameras "
            "agree with each other but not with the robot; check the joint readings and types (R or P)"
        )
    if suspect_poses > MOST_SUSPECT * poses:
        raise WorkFailed(
            f"the fit does not describe the data: {suspect_poses} of {poses} poses contradict their joint "
            "readings; check the joint readings, their units and types (R or P)"
        )


def shortfall(method: str, agreement: Agreement, expected: Expected) -> str | None:
    """Why a fit that was not refused cannot be used, or None where it can.

    The methods without refinement are kept for comparison: they return what they find, marked so.
    Theirs is no least-squares fit, so that residuals above the noise are their own doing.
    """
    if method == "refined" or expected.ratio(agreement) <= WARN_RATIO:
        return None
    return (
        f"the {method} method explains the images only to {agreement.sigma_px:.3g} px a coordinate, "
        f"{expected.ratio(agreement):.3g} times the {expected.sigma_px:.3g} px {expected.origin}: use refined"
    )


def verdict(
    agreement: Agreement,
    expected: Expected,
    noise: FloatArray,
    span: FloatArray,
    prismatic: BoolArray,
    left_out: tuple[int, int, int],
) -> tuple[str, tuple[str, ...]]:
    """Why a calibration is usable, what limits it, and what to do next, in words.

    Parameters
    ----------
    agreement, expected : what the fit leaves, and what it should.
    noise, span, prismatic : (n,) as in ``require_determined``.
    left_out : number of outliers, of suspect joint readings and of exchanged markers.
    """
    sigma, ratio = agreement.sigma_px, expected.ratio(agreement)
    advice = [
        describe_joint(int(i), float(span[i]), bool(prismatic[i])) for i in np.flatnonzero(noise > WEAK_NOISE)
    ]
    limit = "amplitude" if advice else "noise"
    wanted = f"the {expected.sigma_px:.3g} px {expected.origin}"
    reason = f"residuals of {sigma:.3g} px a coordinate agree with {wanted}"
    if ratio > WARN_RATIO:
        limit = "lens or joint readings"
        reason = (
            f"more than pixel noise is left: residuals of {sigma:.3g} px a coordinate are {ratio:.3g} times "
            + wanted
        )
        advice.append("look for lens distortion and for joint readings that lag behind the images")
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
