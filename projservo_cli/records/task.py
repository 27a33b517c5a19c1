"""A reaching task as it is planned, and as each law drives it."""

from dataclasses import dataclass

import numpy as np

from projservo_cli.records.fields import BoolArray, FloatArray, array, scalar

LAWS = ("direct_three", "direct_two", "stacked", "blockwise", "euclidean_points", "exact")
METRIC_LAWS = ("euclidean_points",)  # laws that are given the metric model, as in the paper
POINT_LAWS = ("stacked", "blockwise", "euclidean_points")  # laws that need the points of the face themselves
BODY_LAWS = tuple(law for law in LAWS if law not in POINT_LAWS)  # laws that can measure with the body


def signed(theta_r: float, theta_p: float, q_hat: FloatArray) -> FloatArray:
    """Joint motions (2, n) of both rotations in the sense of their angles."""
    signs = np.where(np.array([theta_r, theta_p]) >= 0.0, 1.0, -1.0)
    return np.asarray(signs[:, None] * q_hat)


@dataclass(frozen=True, eq=False)
class Plan:
    """A reaching task as a translation and two rotations, and the motion planned for it.

    Everything comes from the calibration and the start and goal images. Amplitudes are per view
    where they concern visibility: None is stored as NaN where a motion never changes it.
    """

    profile: str = scalar(about="which part is driven when")
    feasible: bool = scalar(
        about="whether both cameras see the face all along; in the profile constrained, whether all "
        "constraints hold, but for what ``relaxed`` says"
    )
    reason: str = scalar(about="what makes the plan feasible or not, in words")
    relaxed: str = scalar(
        about="what was given up since no path keeps all constraints, and where; empty where nothing was"
    )
    tau: float = scalar(about="amplitude of the translation, unit-norm kernel of (8)")
    theta_r: float = scalar(units="rad", about="angle onto the target plane, in the sense chosen")
    theta_p: float = scalar(units="rad", about="angle within the plane")
    theta_s: float = scalar(units="rad", about="angle of both rotations together")
    constraint: str = scalar(
        about="what the motion comes nearest to failing, as a share of its ends' margins"
    )
    duration: float | None = scalar(
        units="s",
        about="time it takes, as asked for or at the joint-speed limit; none without a limit or where "
        "joints cannot follow",
    )
    tau_limit: float = scalar(about="least delta·tau_0 ahead of the face, infinite where there is none")
    sigma: FloatArray = array("sample", about="path parameter from 0 to 1")
    time: FloatArray = array("sample", units="s", about="when that is reached; NaN where there is no time")
    mu: FloatArray = array("sample", "part", about="shares of t, r, p that are done")
    H_d: FloatArray = array("sample", "row", "coordinate", about="planned displacement of the face")
    s: FloatArray = array("sample", "view", "marker", "xy", units="px", about="predicted images of the face")
    margin: FloatArray = array("sample", "view", about="visibility margin a·O, 1 at the start")
    border_distance: FloatArray = array(
        "sample", "view", units="px", about="least distance of a marker from the image border"
    )
    q: FloatArray = array(
        "sample", "joint", units="rad or m", about="joints that follow the motion, NaN where none can"
    )
    joint_margin: FloatArray = array("sample", about="least distance from a joint limit over half the range")
    condition: FloatArray = array("sample", about="reciprocal condition of the image Jacobian of the face")
    miss: FloatArray = array(
        "sample", units="px", about="how far the images stay behind the planned ones; 0 where joints follow"
    )
    given_up: BoolArray = array(
        "sample", about="whether conditioning is below its bound there or the joints stay behind"
    )
    least: FloatArray = array(
        "constraint",
        about="smallest visibility margin, border distance in px, joint margin, reciprocal condition",
    )
    least_mu: FloatArray = array("constraint", "part", about="shares of t, r, p where that is")
    s_start: FloatArray = array("view", "marker", "xy", units="px", about="images at the start")
    s_star: FloatArray = array("view", "marker", "xy", units="px", about="images at the goal")
    A: FloatArray = array("marker", "coordinate", about="face at the start")
    A_star: FloatArray = array("marker", "coordinate", about="face at the goal")
    A_t: FloatArray = array("marker", "coordinate", about="goal less the translation")
    A_r: FloatArray = array("marker", "coordinate", about="goal less translation and rotation onto the plane")
    a: FloatArray = array("coordinate", about="plane of the face at the start")
    a_star: FloatArray = array("coordinate", about="plane of the face at the goal")
    a_t: FloatArray = array("coordinate", about="plane of the goal less the translation")
    A_c: FloatArray = array("coordinate", about="centre of the face at the start")
    A_c_star: FloatArray = array("coordinate", about="centre of the face at the goal")
    q_start: FloatArray = array("joint", units="rad or m", about="joint readings at the start")
    q_hat: FloatArray = array("part", "joint", about="joint motions t, r, p at the start")
    H_hat: FloatArray = array("part", "row", "coordinate", about="operators t, r, p at the start")
    optical_center: FloatArray = array("view", "coordinate", about="optical centres")
    tau_0: FloatArray = array("view", about="translation at which visibility changes")
    theta_0: FloatArray = array("view", "solution", units="rad", about="angles at which visibility changes")
    sense: FloatArray = array("solution", units="rad", about="both senses of the rotation onto the plane")
    sense_margin: FloatArray = array(
        "solution", "view", about="least margin along each sense, 1 at the start"
    )

    def rotation_sense(self) -> FloatArray:
        """Joint motions (2, n) of the rotations r and p in the sense they are planned."""
        return signed(self.theta_r, self.theta_p, self.q_hat[1:3])


@dataclass(frozen=True, eq=False)
class Trace:
    """One closed-loop run of one law, from the first instant to its verdict."""

    law: str = scalar(about="name of the control law")
    mode: str = scalar(about="replan: each step plans anew; track, image_track: the plan is followed")
    planned_s: float | None = scalar(units="s", about="when the followed plan arrives; none for replan")
    verdict: str = scalar(about="how the run ended")
    reason: str = scalar(about="why, in a sentence")
    steps: int = scalar(about="commands sent")
    period: float = scalar(units="s", about="control period")
    observation: str = scalar(about="how the face is measured: points or body")
    position_error_mm: float | None = scalar(units="mm", about="true centre to true goal at the end")
    rotation_error_deg: float | None = scalar(units="deg", about="true rotation to the goal at the end")
    translation_left: float | None = scalar(
        about="share of the translation left at the end, as the law measures it"
    )
    rotation_left_deg: float | None = scalar(
        units="deg", about="rotation left at the end, as the law measures it"
    )
    self_occluded_steps_left: int = scalar(about="instants at which the left camera is behind the face")
    self_occluded_steps_right: int = scalar(about="instants at which the right camera is behind the face")
    center_deviation_mm: float | None = scalar(
        units="mm", about="largest distance of the centre from the line, between samples too"
    )
    center_deviation_at_samples_mm: float | None = scalar(
        units="mm", about="largest distance of the centre from the line at the sampling instants"
    )
    path_length_mm: float | None = scalar(
        units="mm", about="length of the path of the centre, from sample to sample"
    )
    effort: float = scalar(units="rad²/s or m²/s", about="integral of the squared joint velocities")
    plateau_steps: int = scalar(about="longest stretch in which the image error falls < 1 % in 20 steps")
    speed_limited_steps: int = scalar(about="commands scaled to the joint-speed limit")
    visibility_limited_steps: int = scalar(about="commands whose translation was kept within delta·tau_0")
    first_outside_image: int = scalar(about="first instant with a marker outside an image, -1 for never")
    first_beyond_limit: int = scalar(about="first instant beyond a joint limit, -1 for never")
    limit_joint: int = scalar(
        about="the joint, from 0, that passed its limit first or stopped the run at it, -1 for none"
    )
    q: FloatArray = array("instant", "joint", units="rad or m", about="joints")
    s: FloatArray = array("instant", "view", "marker", "xy", units="px", about="measured images of the face")
    s_star: FloatArray = array("view", "marker", "xy", units="px", about="target images")
    image_error: FloatArray = array("instant", units="px", about="rms over markers and views")
    stop_error: FloatArray = array(
        "instant",
        units="px",
        about="the same by which runs end: with the body, of the face where the body was measured to be",
    )
    tau: FloatArray = array("instant", about="translation error, unit-norm kernel of (8)")
    tau_affine: FloatArray = array("instant", about="translation error, scale fixed through a_inf")
    theta_r: FloatArray = array("instant", units="rad", about="rotation error onto the plane")
    theta_p: FloatArray = array("instant", units="rad", about="rotation error within the plane")
    theta_s: FloatArray = array("instant", units="rad", about="rotation error of both together")
    prediction_px: FloatArray = array(
        "instant",
        units="px",
        about="observed less predicted from the joints, rms per coordinate; NaN for points",
    )
    fit_px: FloatArray = array(
        "instant", units="px", about="noise per coordinate that the fit of the body leaves; NaN for points"
    )
    views_used: FloatArray = array("instant", about="markers the body was fitted to, counted once a view")
    q_dot: FloatArray = array("step", "joint", units="rad/s or m/s", about="commands after the limit")
    speed_factor: FloatArray = array("step", about="factor of the joint-speed limit")
    self_occluded: BoolArray = array("instant", "view", about="true self-occlusion of the face")
    pose: FloatArray = array("instant", "row", "coordinate", units="m", about="true pose of the tool")
    goal_pose: FloatArray = array("row", "coordinate", units="m", about="true goal pose, NaN if unknown")
    center: FloatArray = array("instant", "axis", units="m", about="true centre of the face")
    unplanned: str = scalar(
        about="why a run that was to follow the plan went without it; empty where it followed", default=""
    )
    untested: str = scalar(
        about="why the images of a robot that is not simulated were not tested against the calibration",
        default="",
    )
    q_read: FloatArray | None = array(
        "instant",
        "joint",
        units="rad or m",
        about="joint readings, where they are not the joints",
        default=None,
    )
