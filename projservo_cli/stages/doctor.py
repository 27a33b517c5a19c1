"""Doctor: look at robot and cameras before anything is recorded, and move each joint a little."""

import math
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from projservo_cli import messages
from projservo_cli.calibration.refit import ViewError, view_errors
from projservo_cli.detection.finders import DICTIONARY, finder_of
from projservo_cli.findings import LIMITS, NOTE, REFUSES, Finding, Subject, from_text, usable
from projservo_cli.hardware.camera_robot import CameraRobot, View
from projservo_cli.hardware.checks_at_rest import RobotAtRest, findings_at_rest
from projservo_cli.hardware.checks_in_motion import Strokes, findings_of, reach_of, strokes
from projservo_cli.hardware.video_cameras import VideoCamera
from projservo_cli.image_size import ImageSize, image_corners, image_sizes
from projservo_cli.messages.rows_by_code import Setup
from projservo_cli.monitoring.arrival_accuracy import resting_error_mm
from projservo_cli.monitoring.fault_at_rest import fault_at_rest
from projservo_cli.monitoring.frame_pairs import at_known_markers, mean_image
from projservo_cli.planning.pose_selection import RefitPoses, refit_poses
from projservo_cli.planning.prediction_covariance import Region
from projservo_cli.records import Calibration, FloatArray, InputError, Observation, WorkFailed
from projservo_cli.robots.contract import PluginRobot, at_rest_after
from projservo_cli.robots.pacing import Steered
from projservo_cli.robots.standstill import observation_of_frames
from projservo_cli.stages import Progress, silent
from projservo_cli.stages.stage_inputs import OwnRobot, PreflightInputs
from projservo_cli.stages.worlds.external_robot import plugin_robot

# Time of observation of a robot at rest, s, and minimum number of readings.
_LOOK_S, _MIN_LOOKS = 1.5, 8


class Checked(NamedTuple):
    """Findings on a robot and its cameras, and their data."""

    findings: tuple[Finding, ...]
    seen: RobotAtRest | None  # None where robot or cameras did not open
    moved: tuple[Strokes, ...]  # strokes of the joints that were moved
    refit: tuple[str, RefitPoses] | None = None  # camera that moved, and poses to fit it again from

    setup: Setup = Setup()  # the arm and its cameras

    @property
    def works(self) -> bool:
        """Whether no finding prevents a recording."""
        return usable(self.findings)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The findings as rows of a table and as data."""
        return [messages.table_row(one, self.setup) | one.plain() for one in self.findings]

    @property
    def refuted(self) -> str | None:
        """Reason why the calibration holds no more, empty if it does; None if it was not compared."""
        for one in self.findings:
            if one.code in ("agrees", "refuted"):
                return "" if one.code == "agrees" else messages.sentence(one, self.setup)
        return None


def check(
    inputs: PreflightInputs,
    calibration: Calibration | None = None,
    confirmed: Callable[[str], bool] | None = None,
    watch: Callable[[PluginRobot], None] | None = None,
    progress: Progress = silent,
) -> Checked:
    """Open robot and cameras, look, and close them.

    calibration : whose images are compared, if there is one, and whose data may give limits.
    confirmed : asks whether joints may be moved, by a distance in words; None moves none.
    watch : is called with the open robot, until the user has seen its images.
    """
    joints, dictionary = inputs.joints.joints("", calibration), inputs.dictionary or DICTIONARY
    assert isinstance(inputs.driven.robot, OwnRobot)
    bounds = inputs.driven.following.bounds(joints)
    further = inputs.driven.further
    robot = plugin_robot(inputs.driven.robot, bounds, joints.types, inputs.numbers, further=further)
    findings: list[Finding] = []
    at_rest, moved, mend = None, list[Strokes](), None
    try:
        with at_rest_after(robot):
            if watch is not None:
                watch(robot)
            at_rest = _seen(robot, inputs, progress)
            finder, moves = finder_of(inputs.markers.pattern, dictionary), confirmed is not None
            findings += findings_at_rest(at_rest, finder, dictionary, moves=moves)
            if calibration is not None:
                size, seen = robot.image_size, at_rest.of_views(calibration.view)
                lengths = inputs.markers.lengths(at_rest.face)
                found = calibration_finding(calibration, seen, size, lengths, inputs.noise_px)
                more, mend = mended_by_refit(found, calibration, seen, size)
                findings += (found, *more)
            if confirmed is not None and not usable(findings):
                findings.append(Finding("not_moved", LIMITS))
            elif confirmed is not None and confirmed(reach_of(joints.types)):
                findings += _move_joints(robot, moved, progress)
                findings += findings_of(moved, at_rest.marker, robot.view)
    except (InputError, WorkFailed) as error:
        if isinstance(error, InputError) and at_rest is None:
            raise
        findings += (error.findings if isinstance(error, WorkFailed) else ()) or (
            from_text(str(error), REFUSES),
        )
    setup = Setup(inputs.mount, robot.view, len(joints.types))
    return Checked(tuple(findings), at_rest, tuple(moved), mend, setup)


def _move_joints(robot: PluginRobot, moved: list[Strokes], progress: Progress) -> Iterator[Finding]:
    """Move each joint to and fro, and add its strokes; findings on those without room."""
    steered, joints = Steered(robot), len(robot.bounds.lead)
    for joint in range(joints):
        trial = strokes(steered, joint)
        progress("move", joint + 1, joints)
        if isinstance(trial, Finding):
            yield trial
        else:
            moved.append(trial)


def _seen(robot: PluginRobot, inputs: PreflightInputs, progress: Progress) -> RobotAtRest:
    """Observe a robot at rest for a while."""
    period, readings = robot.bounds.period, [robot.read()]
    wanted = max(_MIN_LOOKS, round(_LOOK_S / period))
    while len(readings) < wanted:
        time.sleep(period)
        readings.append(robot.read())
        progress("look", len(readings), wanted)
    frames, fresh = observation_of_frames(readings, np.array(inputs.numbers, dtype=np.int64))
    s, scatter = zip(*(_mean(frames.images[new, v]) for v, new in enumerate(fresh.T)), strict=True)
    own, cameras, views = robot.robot, list[VideoCamera](), list[View]()
    if isinstance(own, CameraRobot):
        cameras, views = own.cameras, [view for view in own.views if view is not None]
    return RobotAtRest(
        marker=inputs.numbers,
        face=inputs.markers.front or (),
        q=np.mean([observation.q for observation in readings], axis=0),
        s=np.stack(s),
        sigma=readings[-1].sigma_px,
        scatter=np.stack(scatter),
        frames=frames,
        fresh=fresh,
        limits=robot.bounds.limits,
        units=robot.bounds.units,
        views=views,
        cameras=cameras,
        health=robot.health(),
    )


def _mean(s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (m, 2) of frames (K, m, 2) of a view, NaN where most show no marker, and scatter (m,), px."""
    mean, scatter = mean_image(s), np.full(s.shape[1], np.nan)
    often = np.isfinite(mean[:, 0])
    if len(s) > 2:
        scatter[often] = np.sqrt(np.nanvar(s[:, often], axis=0).mean(axis=1))
    return mean, scatter


def calibration_finding(
    calibration: Calibration,
    at_rest: RobotAtRest,
    image_size: ImageSize | None,
    lengths: FloatArray,
    noise_px: float = 0.0,
) -> Finding:
    """Whether images at rest still agree with a calibration, and the change if they do not.

    lengths : (f, f) between the markers of the face, m, NaN if unknown; noise_px : of the images of a run.
    """
    if not calibration.usable:
        return Finding("unusable_calibration", LIMITS)
    size = image_sizes(image_size or at_rest.frame_sizes, calibration.view)
    marker = at_rest.frames.marker
    if not np.isfinite(at_rest.s[:, np.isin(marker, calibration.marker)]).any():
        return Finding("uncompared", LIMITS)
    if fault := fault_at_rest(calibration, at_rest.frames, size, sigma_px=noise_px, fresh=at_rest.fresh):
        views = _view_errors(calibration, at_rest)
        reasons = (one.finding for one in views if any(view.disagrees for view in views))
        return Finding("refuted", REFUSES, others=(fault, *reasons))
    images = at_known_markers(calibration, marker, at_rest.s)
    mm = resting_error_mm(calibration, at_rest.q, at_rest.face, lengths, images)
    return Finding("agrees", NOTE, amount=math.nan if mm is None else 1e-3 * mm, unit="m")


def _view_errors(calibration: Calibration, at_rest: RobotAtRest) -> list[ViewError]:
    """Errors of the images of each view that has any."""
    observation = Observation.of_one(at_rest.frames.marker, at_rest.q, at_rest.s, calibration.view)
    return [one for one in view_errors(calibration, observation) if np.isfinite(one.off_px)]


def mended_by_refit(
    finding: Finding, calibration: Calibration, at_rest: RobotAtRest, image_size: ImageSize | None
) -> tuple[tuple[Finding, ...], tuple[str, RefitPoses] | None]:
    """Yield poses to fit a camera again from, if it alone is wrong."""
    views = _view_errors(calibration, at_rest) if finding.severity == REFUSES else []
    moved = [one.view for one in views if one.disagrees]
    # A joint that slipped, a tag that moved and exchanged cameras show in other views too, if there are any.
    if len(moved) != 1 or len(views) < len(calibration.view):
        return (), None
    corners = image_corners(image_sizes(image_size or at_rest.frame_sizes, calibration.view))
    low = calibration.joint_min
    region, v = Region(low, low + calibration.excitation, corners), calibration.view.index(moved[0])
    try:
        poses = refit_poses(calibration, v, region, np.random.default_rng(0))
    except WorkFailed:
        return (), None
    of = Subject(views=(moved[0],), poses=tuple(range(1, len(poses.q) + 1)))
    mend = Finding("refit_poses", LIMITS, of, poses.error_px, limit=poses.before_px, unit="px")
    return (mend,), (moved[0], poses)
