"""What the data can support: refusals before and after the fit, and the verdict in words."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import betaincinv, gammainccinv, gammaincinv

from projservo_cli.calibration.epipolar import MAD, Epipolar
from projservo_cli.calibration.readings import Readings, joint_trials, reference_pose
from projservo_cli.records import BoolArray, FloatArray, IntArray, WorkFailed


def chi2_quantile(probability: Any, freedom: Any) -> Any:
    """Value below which chi-square of so many degrees of freedom stays with a probability."""
    return 2.0 * gammaincinv(0.5 * freedom, probability)


def chi2_beyond(tail: Any, freedom: Any) -> Any:
    """Value that chi-square of so many degrees of freedom exceeds with a probability."""
    return 2.0 * gammainccinv(0.5 * freedom, tail)


def f_beyond(tail: Any, numerator: Any, denominator: Any) -> Any:
    """Value that the F distribution of two degrees of freedom exceeds with a probability."""
    share = betaincinv(0.5 * denominator, 0.5 * numerator, tail)
    return denominator * (1.0 - share) / (numerator * share)


# Reach at which predictions are judged, rad and m, and their noise there in units of the pixel
# noise: above the first a joint is weak, above the second undetermined.
REACH_RAD, REACH_M = 0.5, 0.15
WEAK_NOISE, UNDETERMINED_NOISE = 3.0, 1000.0
# Farthest trial motion that is advised, in reaches.
MOST_REACHES = 4.0
# Least motion of the images over the range of a joint, in units of the pixel noise.
LEAST_MOTION = 5.0
# Share of the reach beyond which a joint that moves no image stands still; below, it moved too little.
STANDING = 0.1


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


def describe_joint(i: int, span: float, prismatic: bool, needed: float | None = None) -> str:
    """Advice for a joint that moved too little, or never apart from the others.

    Parameters
    ----------
    i : index of the joint.
    span : its range in the data, rad or m.
    prismatic : its type.
    needed : range of a trial motion that determines it, rad or m; NaN where none does, None where it
        is not known.
    """
    reach = REACH_M if prismatic else REACH_RAD
    moved = amount(span, prismatic)
    if needed is not None and not needed <= MOST_REACHES * reach:
        return f"joint {i + 1} moved {moved}; no motion of it alone would do: record trials of every joint"
    if span >= reach:
        far = "" if needed is None else f", by {amount(needed, prismatic)} or more"
        return f"joint {i + 1} moved {moved} but hardly apart from the other joints: move it alone{far}"
    if needed is None:
        needed = min(2.0 * reach, max(4.0 * span, 0.5 * reach))
    if needed <= span:
        return (
            f"joint {i + 1} moved {moved}, in too few poses: record further ones in which it moves alone, by "
            f"{amount(needed, prismatic)} or more"
        )
    return f"joint {i + 1} moved only {moved}: move it at least {amount(needed, prismatic)}"


def describe_still(i: int, span: float, prismatic: bool, motion_px: float, sigma_px: float) -> str:
    """Refusal of a joint whose range moves no image: it was too short, or the joint did not follow it."""
    seen = (
        f"the images by {motion_px:.3g} px, less than {LEAST_MOTION:g} times their noise of {sigma_px:.3g} px"
    )
    if span < STANDING * (REACH_M if prismatic else REACH_RAD):
        return (
            f"too little excitation: the range of joint {i + 1} moves {seen}; "
            f"{describe_joint(i, span, prismatic)}"
        )
    return (
        f"joint {i + 1} stands still: its readings range over {amount(span, prismatic)} but move {seen}; "
        "check that it moved and that its readings are its own, or move a marker off its axis"
    )


def require_moved(motion_px: FloatArray, sigma_px: float, span: FloatArray, prismatic: BoolArray) -> None:
    """Refuse a joint whose operator moves no image over the joint's range.

    Parameters
    ----------
    motion_px : (n,) how far the joint's range moves the images, px.
    sigma_px : pixel noise per coordinate.
    span, prismatic : (n,) as in ``require_determined``.

    Raises
    ------
    WorkFailed
        Naming the worst joint.
    """
    i = int(np.argmin(motion_px))
    if motion_px[i] < LEAST_MOTION * sigma_px:
        raise WorkFailed(describe_still(i, float(span[i]), bool(prismatic[i]), float(motion_px[i]), sigma_px))


def require_determined(noise: FloatArray, span: FloatArray, needed: FloatArray, prismatic: BoolArray) -> None:
    """Refuse a joint whose operator the data leave open.

    Parameters
    ----------
    noise : (n,) predicted noise of images at the reach of each joint, in units of the pixel noise.
    span : (n,) range of each joint in the data, rad or m.
    needed : (n,) range of a trial motion that would determine it, rad or m, NaN where none does.
    prismatic : (n,) types of the joints.

    Raises
    ------
    WorkFailed
        Naming the worst joint.
    """
    i = int(np.argmax(noise))
    if noise[i] > UNDETERMINED_NOISE:
        raise WorkFailed(
            f"joint {i + 1} is not determined: near the reference its images would be wrong by "
            f"{noise[i]:.3g} times the pixel noise; "
            + describe_joint(i, float(span[i]), bool(prismatic[i]), float(needed[i]))
        )


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


VIEWS = ("left", "right")
# Least spread of a view's pixels across their main direction, in units of the noise.
LEAST_SPREAD = 5.0
# Ratio of both spreads beyond which pixels lie on a line rather than in one place.
ELONGATED = 10.0
# Share of the sightings that may move more than the rest where the robot stands still: wrong ones.
MOST_WRONG = 0.1
# Quantile of noise beyond which the markers of an image are off their best line.
OFF_LINE_PX = 0.9


def require_images(readings: Readings, sigma_px: float | None) -> None:
    """Refuse images that show one place, one line, or no motion, whatever is to be made of them.

    Parameters
    ----------
    readings : what was seen.
    sigma_px : noise per coordinate as far as it is known, px.

    Raises
    ------
    WorkFailed
        Naming the view, or the joint whose trials show no motion.
    """
    sigma = LEAST_SIGMA if sigma_px is None else max(sigma_px, LEAST_SIGMA)
    _require_spread(readings, sigma)
    _require_motion(readings, sigma)
    _require_no_line(readings, sigma)


def spread(pixels: FloatArray) -> FloatArray:
    """Robust deviations (2,) of pixels (N, 2) along and across their main direction, px.

    The direction comes from the second moment of the unit vectors from the median, so that far
    outliers weigh no more than others. Source: S. Visuri, V. Koivunen, H. Oja, "Sign and rank
    covariance matrices", J. Statistical Planning and Inference 91(2), 2000.
    """
    offset = pixels - np.median(pixels, axis=0)
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    signs = offset / np.where(length > 0.0, length, 1.0)
    axes = np.linalg.eigh(signs.T @ signs)[1][:, ::-1]
    result: FloatArray = np.median(np.abs(offset @ axes), axis=0) / MAD
    return result


def _require_spread(readings: Readings, sigma: float) -> None:
    """Refuse a view that saw nothing, or whose pixels do not spread in two directions."""
    for v, view in enumerate(VIEWS):
        if not readings.seen[v].any():
            raise WorkFailed(f"the {view} camera saw no marker: both must see them")
        along, across = spread(readings.pixels[v][readings.seen[v]])
        if across >= LEAST_SPREAD * sigma:
            continue
        if along > ELONGATED * max(across, sigma):
            raise WorkFailed(
                f"the {view} images show all markers at all poses on one line, within {across:.3g} px: check "
                "the pixel columns, and move the robot and its markers in all directions"
            )
        raise WorkFailed(
            f"the {view} images show no more than noise: their markers spread over {along:.3g} px, "
            f"less than {LEAST_SPREAD:g} times the noise of {sigma:.3g} px; check the pixel columns, and "
            "that the left and right pixels of a row are of one marker at one pose"
        )


def image_path(readings: Readings, poses: BoolArray) -> FloatArray:
    """Length of the path that images take over some poses (K,), each marker and view its own, px².

    A point that moves evenly along a path of length L has the variance L² / 12 about its mean.

    Returns
    -------
    (2, m) twelve times the variance of both coordinates, NaN where seen at fewer than two poses.
    """
    m = readings.marker.size
    result = np.full((2, m), np.nan)
    for v in (0, 1):
        rows = readings.seen[v] & poses[readings.pose_of]
        count = np.bincount(readings.marker_of[rows], minlength=m)
        square = np.zeros(m)
        for coordinate in readings.pixels[v, rows].T:
            mean = np.bincount(readings.marker_of[rows], coordinate, m) / np.maximum(count, 1)
            deviation = coordinate - mean[readings.marker_of[rows]]
            square += np.bincount(readings.marker_of[rows], deviation**2, m)
        result[v, count > 1] = 12.0 * square[count > 1] / (count[count > 1] - 1)
    return result


def _require_motion(readings: Readings, sigma: float) -> None:
    """Refuse images that stand still while the readings move: all of them, or those of a joint's trials."""
    limit = LEAST_MOTION * sigma
    if _farthest(readings) < limit:
        raise WorkFailed(
            f"the images stand still within {limit:.3g} px although the joint readings move: check that the "
            "robot moved, and that images and readings belong together"
        )
    home = reference_pose(readings.q)
    if home is None:
        return
    for i, rows in enumerate(joint_trials(readings.q, home)):
        poses = np.zeros(len(readings.q), dtype=bool)
        poses[[home, *rows]] = True
        square = image_path(readings, poses)
        square = square[np.isfinite(square)]
        # Noise alone has the variance of both coordinates.
        path = np.sqrt(max(float(square.mean()) - 24.0 * sigma**2, 0.0)) if square.size else np.inf
        if path < limit:
            span = float(np.ptp(readings.q[poses, i]))
            raise WorkFailed(describe_still(i, span, bool(readings.prismatic[i]), path, sigma))


def _farthest(readings: Readings) -> float:
    """How far sightings are from the median place of their marker in their view, but for the farthest, px."""
    distances = []
    for v in (0, 1):
        for j in range(readings.marker.size):
            pixels = readings.pixels[v][readings.seen[v] & (readings.marker_of == j)]
            if len(pixels) > 1:
                distances.append(np.linalg.norm(pixels - np.median(pixels, axis=0), axis=1))
    return float(np.quantile(np.concatenate(distances), 1.0 - MOST_WRONG)) if distances else np.inf


def _require_no_line(readings: Readings, sigma: float) -> None:
    """Refuse a body whose markers lie on a line in most images, up to the noise: some are wrong."""
    off = []
    for v in (0, 1):
        for k in np.unique(readings.pose_of[readings.seen[v]]):
            pixels = readings.pixels[v][readings.seen[v] & (readings.pose_of == k)]
            if len(pixels) > 2:
                offset = np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False)[1]
                off.append(offset**2 > sigma**2 * chi2_quantile(OFF_LINE_PX, len(pixels) - 2))
    if off and np.mean(off) < 0.5:
        raise WorkFailed(ON_A_LINE)
