"""A robot of the contract as the loop drives it: set-points at its pace, images as it will come to rest.

A servo lags behind its set-point while that moves, and sags below it under gravity. A law gets the
joints at which the arm would come to rest without further commands: lag has then no part in its loop,
and sag is integrated away.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from projservo_cli.calibration.detections import MIN_SIGMA
from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject
from projservo_cli.geometry.algebra import as_array
from projservo_cli.geometry.kinematics import forward
from projservo_cli.monitoring.fault_at_rest import fault_of_mean
from projservo_cli.monitoring.image_monitor import ImageMonitor
from projservo_cli.monitoring.innovation_tests import WINDOW
from projservo_cli.records import BoolArray, FloatArray, IntArray, WorkFailed
from projservo_cli.robots.contract import Reading
from projservo_cli.robots.frame_recorder import FrameRecorder
from projservo_cli.robots.latency_estimation import DelayPrior, Delays, Frames, squares_by_joints
from projservo_cli.robots.object_watch import ObjectWatch
from projservo_cli.robots.pacing import Steered
from projservo_cli.simulation.analytic_plant import Plant, observe
from projservo_cli.task.objects.object_tracker import ObjectTracker

# Markers that no detector sees at one pixel.
_AT_ONE_PIXEL = 3
# Weight in the fit of a law of a detection that is a single outlier.
_REJECTED = 1e-3
# Time, s, after which an image that repeats to the bit will not change: a simulated one without noise.
_STALE_S = 0.5
# Looks before the first motion, until enough agree or a fault is named.
_MOST_LOOKS = 120
# Frames over which an error of images must last while the arm is held: a hand passes in less.
_LASTS = 60


class Known(NamedTuple):
    """Knowledge of a robot and its images before it moves."""

    # pixels (k, V, m, 2) of the markers of the calibration at joints (k, n), rad or m
    predicted: Callable[[FloatArray], FloatArray]
    visible: IntArray  # (k,) markers of the loop, by their places in the observations, the face first
    order: IntArray  # (m,) index there of each marker of the calibration, −1 if it is not observed
    sigma_px: float  # noise of the pixels
    sigma_scale: float  # noise of a pixel over the deviation that it states
    sigma_q: FloatArray  # (n,) deviation of joint readings, rad or m; 0 if none shows
    delays: DelayPrior
    timeout_s: float  # longest that an image may stay the same while joints move, s
    max_force_n: float | None = None  # on the tool, N; None for any


class Tracked(NamedTuple):
    """An object that carries a goal while it moves."""

    name: str
    indices: Sequence[int]  # (k,) of its markers among the markers of objects
    tracker: ObjectTracker


class DrivenRobot:
    """A robot with its cameras, and the plant that models it.

    A law is given the joints at which the arm comes to rest if nothing more is sent, and images as they will
    be there: each pixel is carried by predict(q) − predict(q_then) from when it was taken. Lag and delay so
    vanish from its loop.

    steered : set-points of a robot of the contract, ``robot``.
    plant : face; image size and joint limits: of the calibration, or the true ones of a robot that knows its
        true joints.
    known : of robot and images.
    monitor : of the raw images against the calibration; None tests nothing.
    watches : over objects that carry the goal and rest; tracked : the one that carries it while it moves.
    ``q``: (n,) joint readings when last asked for, or the true joints, rad or m. ``H, hidden``: displacement
    of the face and self-occlusion there. ``in_front``: a camera sees nothing behind it. ``disturbance``: why
    the images no longer agree with the calibration, or the failure; otherwise None. ``weight``: (V, k) of the
    pixels shown in a fit, if the robot states their deviations. ``noise_ratio``: of the stated noise to
    the noise of the run; at least 1. Of each observation since ``begin``: ``delays`` of all views as
    followed, (V,) s, ``readings`` of the joints, (n,), and ``truths`` of a robot that knows them, joints (n,)
    or the pose (4, 4) of its tool; ``film`` of its frames; ``forces`` on its tool, N, if limited.
    """

    in_front = True
    takes_parts = True
    stops = True  # whether the run is the last of the robot

    def __init__(
        self,
        steered: Steered,
        plant: Plant,
        known: Known,
        monitor: ImageMonitor | None,
        watches: Sequence[ObjectWatch] = (),
        tracked: Tracked | None = None,
    ) -> None:
        self.robot, self.steered, self.plant, self.watches = (robot := steered.robot), steered, plant, watches
        self.known, self.monitor, self.tracked = known, monitor, tracked
        self.markers = len(known.visible)
        self._place = np.array([np.flatnonzero(known.order == i)[0] for i in known.visible])
        self._instants = Delays(
            robot.view, known.predicted, known.delays, known.sigma_px, known.timeout_s, known.sigma_q
        )
        V = len(robot.view)
        self._carried = np.zeros((V, self.markers, 2))
        self.q = np.zeros(len(plant.limits.lower))
        self.H = np.eye(4)
        self.hidden = np.zeros(V)
        self.disturbance: Finding | None = None
        self.weight: FloatArray | None = None
        self.retreats = 0  # periods by which it goes back if the object moves
        self.noise_ratio = 1.0
        self._stale = 0  # looks in a row without a new frame while the arm is held
        self._dark = np.zeros(V, dtype=np.int64)  # looks in a row that show no marker of the calibration
        self.begin()

    def begin(self) -> None:
        """Record the run from here on."""
        self.delays: list[FloatArray] = []
        self.readings: list[FloatArray] = []
        self.truths: list[FloatArray] = []
        self.forces: list[float] = []
        self.film = FrameRecorder()
        self.steered.overruns = 0

    def joints(self) -> FloatArray:
        """Joints (n,), rad or m, at which the arm comes to rest, after a new look at robot and images."""
        read, truth = self.steered.observe().q, self.robot.truth()
        self.q = read if truth is None or truth.ndim > 1 else truth
        H = forward(self.plant.model, self.q)
        self.H = as_array(H)
        M = np.zeros_like(self.plant.M)
        s = np.zeros((len(self.hidden), len(M) + len(self.plant.pins), 2))
        observe(self.plant, H, M, s, self.hidden)
        if self.robot.frames is not None:
            self.film.show(len(self.readings), self.steered.reading.s, self.robot.frames)
        self.readings.append(read)
        self.truths += [] if truth is None else [truth]
        if (limit := self.known.max_force_n) is not None:
            self.forces.append(self.robot.force())
            if self.forces[-1] > limit and not self.disturbance:
                self.disturbance = Finding("pressed", REFUSES, amount=self.forces[-1], limit=limit, unit="N")
        return self._measured_at

    @property
    def _measured_at(self) -> FloatArray:
        """Joints (n,) at which images are measured, rad or m: where the arm comes to rest.

        An arm that follows never rests, and the sag of its servos changes on the way: where it is.
        """
        return self.steered.set_point.at_rest if self.tracked is None else self.steered.reading.q

    def observe(self) -> FloatArray:
        """Pixels (V, k, 2) of the markers shown as they will be at rest, NaN where unseen; all are tested."""
        reading, history, order = self.steered.reading, self.steered.history, self.known.order
        for watch in self.watches:
            watch.observe(reading)
            if watch.moved and not self.disturbance:
                self.disturbance = watch.moved
                self._retreat()
        if self.monitor is not None:
            _require_apart(self.robot.name, reading)
        images = np.where((order < 0)[:, None], np.nan, reading.s[:, order])
        self._dark = np.where(np.isfinite(images[..., 0]).any(axis=1), 0, self._dark + 1)
        visible, stated = self.known.visible, None
        if reading.sigma_px is not None:
            stated = reading.sigma_px[:, order]
            self.weight = weights(reading.sigma_px[:, visible], reading.s[:, visible])
            self.noise_ratio = self._noise_of(reading.sigma_px[:, visible], reading.s[:, visible])
        frames = self._instants.update(reading.t_view, images, history)
        q_then = history.at(frames.t)
        self._track(frames)
        if self.monitor is not None:
            q_dot = np.stack([history.speed_at(float(t)) for t in frames.t])
            self.monitor.unanswered = self.steered.set_point.unanswered
            fault = self.monitor.observe(
                frames.t, q_then, q_dot, frames.sigma, images, frames.fresh, stated=stated
            )
            self.disturbance = fault or self.disturbance
            self._stale = 0 if frames.fresh.any() or not self.holds else self._stale + 1
            if self._stale * self.robot.bounds.period > _STALE_S:
                self.give_up()
            self._leave_out(self.monitor.rejected[:, self._place], stated is None)
        q = self._measured_at
        there, *then = self.known.predicted(np.stack([q, *q_then]))[:, :, self._place]
        for view in range(len(then)):
            carries = not np.array_equal(q, q_then[view])
            self._carried[view] = there[view] - then[view][view] if carries else 0.0
        self.delays.append(self._instants.mean)
        return np.ascontiguousarray(reading.s[:, visible]) + self._carried

    def _track(self, frames: Frames) -> None:
        """Show the object that moves in new frames to its tracker."""
        if self.tracked is None or not frames.fresh.any():
            return
        reading, (_, indices, tracker) = self.steered.reading, self.tracked
        s = np.where(frames.fresh[:, None, None], reading.s_objects[:, indices], np.nan)
        sigma = np.full(s.shape[:2], max(self.known.sigma_px, MIN_SIGMA))
        if reading.sigma_objects is not None:
            sigma = reading.sigma_objects[:, indices]
        tracker.observe(frames.t, s, sigma, sigma_t=frames.sigma_shared)
        if tracker.pushed is not None and not self.disturbance:
            self.disturbance = tracker.pushed
            self._retreat()

    def _noise_of(self, sigma: FloatArray, s: FloatArray) -> float:
        """Stated noise (V, k) of pixels (V, k, 2) of a fit, over the noise of the run; at least 1."""
        information = np.maximum(sigma[np.isfinite(s[..., 0])], MIN_SIGMA) ** -2.0
        if not information.size or not self.known.sigma_px > 0.0:
            return 1.0
        return max(1.0, self.known.sigma_scale / (self.known.sigma_px * math.sqrt(information.mean())))

    def _leave_out(self, rejected: BoolArray, alike: bool) -> None:
        """Leave single outliers (V, k) out of the fit of the law.

        alike : all others weigh the same.
        """
        if self.weight is not None and alike:
            self.weight = np.ones(rejected.shape)
        if rejected.any():
            weight = np.ones(rejected.shape) if self.weight is None else self.weight
            self.weight = np.where(rejected, _REJECTED * weight, weight)

    @property
    def holds(self) -> bool:
        """Whether images disagree with the calibration so that nothing should move."""
        return self.monitor is not None and self.monitor.holds

    @property
    def pending(self) -> bool:
        """Whether images disagreed and later ones have not cleared that yet."""
        return self.monitor is not None and self.monitor.pending

    def give_up(self) -> None:
        """Set the fault as far as it is known, if there is no time for more observations."""
        if self.monitor is not None:
            self.disturbance = self.disturbance or self.monitor.give_up()

    @property
    def object_moved(self) -> bool:
        """Whether it is an object of the goal that ended the run."""
        moved = [watch.moved for watch in self.watches]
        moved += [self.tracked.tracker.pushed] if self.tracked is not None else []
        return any(one is not None and self.disturbance == one for one in moved)

    def _retreat(self) -> None:
        """Go back along its path, by the last joint readings of the run."""
        for q in self.readings[-2 : -2 - self.retreats : -1]:
            self.steered.command(q - self.steered.target, self.robot.bounds.period)
            self.steered.observe()

    def fits(self) -> Finding | None:
        """Return the fault that images show where the robot is; None if enough of them agree.

        Nothing is moved meanwhile.
        """
        for look in range(1, _MOST_LOOKS):
            tested = 0 if self.monitor is None else self.monitor.observations
            self.joints()
            self.observe()
            if self.disturbance or self._agreed(look):
                return self.at_rest()
            if self.monitor is None or self.monitor.observations > tested:
                continue  # the next observation shows another image
            if not self.robot.waits(self.robot.bounds.period):  # time passes in commands alone
                if look >= WINDOW and self.monitor.agreeing and not self.pending:
                    return self.at_rest()
                if look >= WINDOW:
                    self.steered.hold()
        if self.pending:
            self.give_up()
        return self.disturbance

    def unseen(self, seeing: int, *, wait: bool = False) -> Finding | None:
        """Return the cameras that show no calibrated marker, or None if ``seeing`` others do.

        seeing : number of cameras, at most all of them.
        wait : whether to hold the arm meanwhile, to see whether the fault lasts.
        """
        if wait:
            self._persists(lambda: bool(max(self._dark) >= WINDOW), _LASTS)
        views = self.robot.view
        dark = [view for view, n_frames in zip(views, self._dark, strict=True) if n_frames >= WINDOW]
        if len(views) - len(dark) >= min(seeing, len(views)):
            return None
        return Finding("unseen_markers", LIMITS, Subject(views=tuple(dark)))

    def at_rest(self, *, wait: bool = False) -> Finding | None:
        """Return the fault that images of one posture show, as ``fault_at_rest`` returns it; otherwise None.

        wait : whether to hold the arm meanwhile, to see whether the fault lasts.
        """
        if (monitor := self.monitor) is not None:
            if wait:
                self._persists(lambda: bool(fault_of_mean(monitor)), _LASTS)
            self.disturbance = self.disturbance or fault_of_mean(monitor)
        return self.disturbance

    def _persists(self, wrong: Callable[[], bool], n_frames: int) -> bool:
        """Hold the arm while images are wrong; whether that lasted for all of a number of frames."""
        for _ in range(n_frames):
            if self.disturbance or not wrong():
                return False
            self.steered.hold()
            self.observe()
        return True

    def _agreed(self, observations: int) -> bool:
        """Whether enough of a number of observations agree."""
        agreeing = observations if self.monitor is None else self.monitor.agreeing
        return agreeing >= WINDOW and not self.pending

    def agrees(self) -> Finding | None:
        """Test the last images, holding the arm while they disagree; return the fault."""
        self.observe()
        if self._persists(lambda: self.holds, _MOST_LOOKS):
            self.give_up()
        return self.disturbance

    @property
    def carried_px(self) -> float:
        """Return the distance of the face from its place of rest, px rms per marker and view; NaN unseen."""
        face = self._carried[:, : len(self.plant.M)]
        known = face[np.isfinite(face)]
        return math.sqrt(2.0 * float(np.mean(known**2))) if known.size else math.nan

    def settled(self, within_px: float) -> bool:
        """Whether the arm is at rest, by images within a number of px rms or by its readings.

        Not before images of its pose agree with the calibration.
        """
        if self.monitor is not None and (self.pending or self.monitor.agreeing < WINDOW):
            return False
        q, face = self.steered.set_point.at_rest, self._place[: len(self.plant.M)]
        if self.known.sigma_q.any():
            squares = squares_by_joints(self.known.predicted, q, self.known.sigma_q)[:, face]
            within_px = max(within_px, math.sqrt(float(np.nansum(squares)) / (2 * len(face))))
        return self.carried_px <= within_px

    def distance(self) -> float:
        """No distance is known without a metric: nothing ever recedes."""
        return 0.0

    def command(self, step: FloatArray, period: float) -> None:
        """Move by the joint step (n,), rad or m, within one period, s."""
        self.steered.command(step, period)

    def stop(self) -> None:
        """Come to rest; in a session the robot holds its last set-point, until the session ends."""
        if self.stops:
            self.robot.stop()


def _require_apart(name: str, reading: Reading) -> None:
    """Raise WorkFailed for images with several markers at one pixel, as zeros for unseen ones."""
    for view, pixels in zip(reading.view, reading.s, strict=True):
        at, count = np.unique(pixels[np.isfinite(pixels[:, 0])], axis=0, return_counts=True)
        if (count >= _AT_ONE_PIXEL).any():
            u, v = at[np.argmax(count)]
            raise WorkFailed(
                f"{name}: read() gave {count.max()} markers of the {view} view at the same pixel, "
                f"({u:g}, {v:g}): NaN stands for unseen"
            )


def weights(sigma: FloatArray, s: FloatArray) -> FloatArray:
    """Weights (V, k) of pixels (V, k, 2) of deviations (V, k) in a fit: the rms of those seen over each."""
    detected = np.isfinite(s[..., 0])
    weight = np.ones(detected.shape)
    if detected.any():
        sigma = np.maximum(sigma, MIN_SIGMA)
        weight[detected] = np.sqrt(np.mean(sigma[detected] ** 2)) / sigma[detected]
    return weight
