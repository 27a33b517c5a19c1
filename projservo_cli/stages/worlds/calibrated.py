"""The world of a robot of which a calibration alone is known, which simulated ones share."""

import math
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from projservo_cli.calibration.prediction import predict
from projservo_cli.findings import Finding
from projservo_cli.geometry.algebra import mat
from projservo_cli.image_size import image_sizes
from projservo_cli.loop.run_metrics import Summary, angle_between
from projservo_cli.messages import failed, order_advice, sentence
from projservo_cli.messages.placeholders import all_of
from projservo_cli.messages.rows_by_code import Setup
from projservo_cli.records import (
    MM,
    TOOL,
    Calibration,
    FloatArray,
    InputError,
    Model,
    WorkFailed,
    coordinate_names,
)
from projservo_cli.robots.contract import Reading, Robot
from projservo_cli.robots.joint_limits import Joints
from projservo_cli.robots.latency_compensation import DrivenRobot
from projservo_cli.robots.pacing import Steered
from projservo_cli.robots.session import Session
from projservo_cli.robots.standstill import STILL, STILL_PX, seen_at_rest
from projservo_cli.settings.task import GoalImages, TaskSettings
from projservo_cli.simulation.analytic_plant import Ends, Plant
from projservo_cli.simulation.ground_truth import turned
from projservo_cli.stages.stage_inputs import CarryingObject, Contract, PlanInputs
from projservo_cli.stages.worlds.external_robot import opened_robot, path_to
from projservo_cli.stages.worlds.task_images import given_pixels, task_images
from projservo_cli.task.body_pose import NO_BODY, Body, make_body
from projservo_cli.task.objects.object_bundle_adjustment import ObjectView
from projservo_cli.task.target import TaskImages, is_stereo

_LOOKS = 3  # at an object that may move, at least
_UNKNOWN = Ends(np.full((4, 4), np.nan), np.full((4, 4), np.nan), np.full(4, np.nan))


class TruePoses(NamedTuple):
    """Poses of the tool in a run, by the truth or by its robot; NaN if unknown."""

    pose: FloatArray  # (k, 4, 4) of the tool, m
    goal_pose: FloatArray  # (4, 4) of the tool, m
    center: FloatArray  # (k, 3) of the face, m
    numbers: dict[str, float]  # numbers of a trace from these


def _in_motion(readings: list[Reading], which: list[int]) -> ObjectView:
    """Some markers of the reading that shows the largest number of them; they may move.

    Views are taken at other times, up to a reading apart, so a marker is as uncertain as it moves meanwhile.
    """
    best = max(readings, key=lambda one: np.isfinite(one.s[:, which, 0]).sum())
    s = np.array([one.s[:, which] for one in readings])
    steps = np.linalg.norm(np.diff(s, axis=0), axis=-1)
    moved = float(np.sqrt(np.mean(np.square(steps[np.isfinite(steps)])))) if np.isfinite(steps).any() else 0.0
    sigma = None if best.sigma_px is None else best.sigma_px[:, which]
    if moved > STILL_PX:
        sigma = np.hypot(moved, np.zeros(best.s[:, which, 0].shape) if sigma is None else sigma)
    return ObjectView(best.s[:, which], sigma)


@dataclass(frozen=True, eq=False)
class CalibratedWorld:
    """Robot, cameras and markers of a plan and its runs, of which a calibration alone is known."""

    inputs: PlanInputs
    calibration: Calibration
    joints: Joints  # as the laws take them
    numbers: tuple[int, ...]  # markers that measure the face, the face first

    moves_unseen = False  # whether a motion that no camera sees does no harm

    @property
    def view(self) -> tuple[str, ...]:
        """Names of the views."""
        return self.calibration.view

    @property
    def m(self) -> int:
        """Number of markers on the face."""
        return len(self.inputs.markers.face)

    @property
    def min_views(self) -> int:
        """Number of views that are to see the whole face. Raises InputError if there are fewer."""
        asked, V = self.inputs.trajectory.min_views, len(self.view)
        if asked is not None and asked > V:
            raise InputError(f"trajectory.visible_views: {asked}, of {V} views: set {V} or all")
        return asked or V

    @property
    def setup(self) -> Setup:
        """Arm and cameras for words."""
        names = coordinate_names(self.calibration.flange_chart)
        return Setup(self.calibration.mount, self.view, len(self.joints.units), names)

    @cached_property
    def model(self) -> Model:
        """Model that plans and laws are given."""
        return self.calibration.model()

    @cached_property
    def body(self) -> Body:
        """Body of all markers by which the face is measured; none if it is measured point by point."""
        points = measures_points(self.inputs.features, self.calibration)
        return NO_BODY if points else _body(self.calibration, self.numbers)

    def require_body(self, what: str) -> None:
        """Raise WorkFailed for users of the body, if the face is measured point by point."""
        if not len(self.body.M):
            raise WorkFailed(
                f"{what} with the body, and the calibration is not usable: calibrate again, or set "
                "control.features: body to try"
            )

    @property
    def goal_images(self) -> GoalImages | None:
        """Images of the goal that are given."""
        return None if self.inputs.task is None else self.inputs.task.goal.images

    @property
    def observed(self) -> tuple[int, ...]:
        """Numbers of all markers that the robot observes, in its order."""
        return observed_numbers(self.inputs, self.calibration)

    @property
    def noise_px(self) -> float:
        """Standard deviation of a coordinate of images in the loop, px."""
        return max(self.inputs.noise.servo_px, self.calibration.fit.sigma_fitted_px)

    def ends(self, task: TaskSettings) -> tuple[TaskImages, FloatArray | None]:
        """Return start and goal without noise, and the joints (n,) at the goal, None for one by images alone.

        Raises InputError, WorkFailed where joints are beyond limits, or cameras do not see the face.
        """
        n = len(self.joints.types)
        taught = None if task.goal.images is None else task.goal.images.joints
        given = (
            (task.start_joints, "start"),
            (task.goal.joints, "goal.joints"),
            (taught, "goal.images.joints"),
        )
        for vector, key in given:
            if vector is not None and len(vector.joints) != n:
                raise InputError(f"task.{key}: {len(vector.joints)} values for {n} joints")
        numbers = self.numbers[: self.m], self.numbers[self.m :]
        how, at = (self.inputs.markers.center, self.view), self.inputs.q_current
        return task_images(task, self.joints.types, numbers, how, self._predicted, self._turned, q_current=at)

    def _predicted(self, q: FloatArray, key: str) -> FloatArray:
        """Pixels (V, b, 2) at joints (n,) of a key of the configuration."""
        if wrong := self.joints.limit_passed(q):
            raise InputError(f"{key}: {sentence(wrong)}: choose another")
        s = predict(self.calibration, q[None])[0][:, self.calibration.indices_of(self.numbers)]
        if np.isnan(s[:, : self.m]).any(axis=(1, 2)).sum() > len(s) - self.min_views:
            raise WorkFailed(f"{key}: by the calibration, the face is not in front of the cameras there")
        return np.ascontiguousarray(s)

    def _turned(self, q: FloatArray) -> FloatArray:
        """Joints (n,) of a goal that is a turn from joints (n,)."""
        P = self.inputs.described.cameras_at(q)
        if self.inputs.described.arm is None or P is None:
            raise InputError(
                "task.goal.roll_deg needs the model of the robot and its rig: give joints or images instead"
            )
        return turned(self.inputs.required_task.goal, self.inputs.described.arm, P, q)

    def true_ends(self, images: TaskImages, q_goal: FloatArray | None) -> Ends:
        """Return the true poses of the tool at the ends of a task; NaN if unknown."""
        return _UNKNOWN

    def true_motion(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """True displacements (k, 4, 4) of the object of the goal at times (k,), s, since the plan.

        With its middle (4,) then, m; NaN if unknown.
        """
        return np.full((len(t), 4, 4), np.nan), np.full(4, np.nan)

    def nearest_ends(self, images: TaskImages, ends: Ends, plant: Plant, H: FloatArray) -> Ends:
        """Return true ends, of goals of incidences with the one nearest to the displacement H (4, 4)."""
        return ends

    def averaged_images(self, images: TaskImages, q_taught: FloatArray | None, seed: int) -> TaskImages:
        """Start and taught goal as images of a seed show them, which are averages.

        q_taught : (n,) joints at which the goal was taught, if they are known.
        """
        return images

    def observe_object(
        self, carrier: CarryingObject, session: Session | None, ends: TaskImages, q_taught: FloatArray | None
    ) -> tuple[ObjectView, ObjectView]:
        """Images of an object when the goal was taught, and now.

        session : connection to the robot that observes in its present pose; None to open one.
        q_taught : (n,) joints at which the goal was taught, if they are known.
        """
        now = self._observed_now(carrier, session, ends.q_start)
        if carrier.taught is None:
            return self._observed_before(carrier, q_taught), now
        return ObjectView(*given_pixels(carrier.taught, carrier.numbers, (), self.view)), now

    def _observed_now(
        self, carrier: CarryingObject, session: Session | None, q_start: FloatArray
    ) -> ObjectView:
        """Images of an object by the robot in its present pose, or by a simulated one at the start (n,)."""
        assert carrier.driven is not None
        rest = carrier.rest
        with nullcontext(session) if session else Session() as own:
            known = self.joints, self.observed, self.view
            robot = opened_robot(own, carrier.driven, *known).robot

            def observe() -> Reading:
                time.sleep(robot.bounds.period)
                return robot.read().whole

            which = [len(self.observed) + carrier.driven.further.index(number) for number in carrier.numbers]
            if carrier.settings.follow:  # it need not rest, and a mean would be of several places
                return _in_motion([observe() for _ in range(max(_LOOKS, rest.averaged_frames))], which)
            _, mean, sigma, *_ = seen_at_rest(robot, observe, rest.averaged_frames, rest.settle_s, "plan")
        return ObjectView(mean.s[:, which], sigma[:, which])

    def _observed_before(self, carrier: CarryingObject, q_taught: FloatArray | None) -> ObjectView:
        """Images of an object when the goal was taught, of which none were kept; of simulated ones alone."""
        raise InputError(f"task.goal does not show where {carrier.name} was: teach it again, projservo teach")

    def metric_model(self, law: str) -> Model:
        """Return the metric model that a classical law is given; InputError if none is described."""
        arm = self.inputs.described.arm
        P = None if arm is None else self.inputs.described.cameras_at(arm.q_reference)
        if arm is None or P is None:
            raise InputError(
                f"{law} is given the metric model of robot and rig: set robot and rig, or leave it out of "
                "control.laws"
            )
        return arm.model(P, on_tool=self.inputs.described.mount == TOOL)

    @property
    def knows_limits(self) -> bool:
        """Whether a path through joint space can be searched within the limits of the joints."""
        limits = self.joints.limits
        return bool(np.isfinite([limits.lower, limits.upper]).all())

    def plant(
        self, q_start: FloatArray, images: Callable[[], TaskImages], *, pins: bool, opaque: bool
    ) -> Plant:
        """Return the robot, undisturbed, as a law sees it from joints (n,).

        images : start and goal as the law measures them, which decide the sides of a face that is trusted.
        pins : whether a simulated one shows the markers of the body that are not on the face.
        """
        images_of_goal = images()
        images_of_goal = images_of_goal.by_points() if len(images_of_goal.pair) else images_of_goal
        task = images_of_goal.asking(()).task(self.model)  # the face of the goal, for any incidences
        face = self.calibration.indices_of(self.numbers[: self.m])
        return Plant(
            model=self.model,
            M=np.ascontiguousarray(self.calibration.M[face]),
            order=task.order,
            center=task.center,
            O=task.O,
            visible=task.visible,
            image_size=image_sizes(self.inputs.image_size, self.view),
            limits=self.joints.limits,
            opaque=False,
            min_views=self.min_views,
        )

    def require_ready(self) -> None:
        """Refuse to drive a robot with a calibration that cannot predict its motion."""
        own, taken = self.inputs.joints.flange_chart, self.calibration.flange_chart
        if (own is None) != (taken is None) or (own is not None and not np.array_equal(own, taken)):
            raise InputError(
                "the calibration is by other readings than those of this robot (robot.flange and its home): "
                "calibrate with this configuration"
            )
        if not self.calibration.usable:
            raise WorkFailed("the calibration is not usable, and no robot is driven with it: calibrate again")
        if order := order_advice(self.calibration):
            raise InputError(
                f"{order}, or set data.joint_order=stated if it is known; no robot is driven before"
            )

    def opened(
        self, session: Session, contract: Contract, q_start: FloatArray, plant: Plant, given: Robot | None
    ) -> Steered:
        """Open the robot of a contract in a session, unless it is.

        q_start, plant : joints (n,) of a simulated one, and its plant; given : an object in its place.
        """
        return opened_robot(session, contract.driven, self.joints, self.observed, self.view, given)

    def begin(
        self, driven: DrivenRobot, contract: Contract, q_start: FloatArray, *, blind: bool
    ) -> Finding | None:
        """Bring an open robot to the start (n,); the cameras that showed nothing there, if any.

        blind : whether it may move although cameras show no marker of the calibration.
        Raises WorkFailed, before its first motion, if its images disagree with the calibration.
        """
        assert contract.settle_s is not None
        driven.robot.require_identity(contract.identity)
        if wrong := driven.fits():
            self._stop(driven, "the robot did not move, since at the start", wrong)
        unseen = self._require_images(driven, "the robot did not move, since where it stands", 1, blind=blind)
        stands = self.inputs.required_task.start_joints is None and _stands_at(driven, q_start)
        path = path_to(driven.steered, q_start, contract.settle_s, "servo")
        for _ in () if stands else path:
            if wrong := driven.agrees():
                self._stop(driven, "stopped on the path to the start, since", wrong)
        if wrong := driven.at_rest(wait=True):
            raise failed([wrong], self.setup, begin="stopped at the start, since ", refutes=True)
        at_start = self._require_images(driven, "stopped at the start of the task, since", 2, blind=blind)
        return at_start or unseen

    def _stop(self, driven: DrivenRobot, what: str, fault: Finding) -> None:
        """Raise the failure of a robot that a fault stopped before the run."""
        raise failed([fault], self.setup, begin=f"{what} ", refutes=not driven.object_moved)

    def _require_images(self, driven: DrivenRobot, what: str, seeing: int, *, blind: bool) -> Finding | None:
        """Refuse to move a robot unless enough cameras show markers, or ``blind`` was requested.

        Of fewer cameras, all must.
        """
        unseen = driven.unseen(seeing, wait=seeing > 1)
        if unseen and not blind:
            found = [unseen, *driven.robot.remarks()]
            mend = (
                f": uncover {all_of(driven.robot.view)} and look at the light, or move the arm by hand to "
                "where they see the tags; --blind (blind=True) drives it without images"
            )
            raise failed(found, self.setup, mend, begin=f"{what} ")
        return unseen

    def judged(self, summary: Summary) -> Summary:
        """Return the summary of a run with this world's knowledge of its success."""
        return summary._replace(success=math.nan)

    def poses(
        self, plant: Plant, ends: Ends, H: FloatArray, reached: FloatArray | None, goal_joints: FloatArray
    ) -> TruePoses:
        """Return where the tool was at displacements H (k, 4, 4).

        reached : poses (k, 4, 4) or joints (k, n) that a robot reports; goal_joints : (g, n) at the goal.
        """
        arm, goal, unknown = self.inputs.described.arm, np.full((4, 4), np.nan), np.full((len(H), 3), np.nan)
        if reached is None:
            return TruePoses(H * np.nan, goal, unknown, {})
        if arm is not None and len(goal_joints):
            goal = arm.pose(goal_joints[0])
        if reached.ndim != 3:
            reached = np.array([goal * np.nan if arm is None else arm.pose(q) for q in reached])
        numbers = {
            "position_error_mm": MM * float(np.linalg.norm(goal[:3, 3] - reached[-1, :3, 3])),
            "rotation_error_deg": math.degrees(angle_between(mat(reached[-1]), mat(goal))),
        }
        return TruePoses(reached, goal, unknown, numbers)


def observed_numbers(inputs: PlanInputs, calibration: Calibration) -> tuple[int, ...]:
    """Numbers of the markers that a robot which is not simulated observes, in its order."""
    numbers = tuple(calibration.marker.tolist()) if inputs.markers.known is None else inputs.markers.known
    for number in inputs.markers.face:
        if number not in numbers:
            raise InputError(f"markers.face: marker {number} is not among those observed, {[*numbers]}")
    return numbers


def _stands_at(driven: DrivenRobot, q: FloatArray) -> bool:
    """Whether a robot is at joints (n,), as near as it is held."""
    away = np.abs(driven.steered.observe().q - q)
    return bool((away <= np.maximum(driven.robot.bounds.sag, STILL)).all())


def measures_points(features: str | None, calibration: Calibration) -> bool:
    """Whether the face is measured point by point: as configured, otherwise if no body is calibrated well.

    Raises InputError if points are required and there are not two views.
    """
    view = calibration.view
    if not is_stereo(view):
        if features == "points":
            raise InputError(
                f"control.features: points are measured from two views, and there are {len(view)} "
                f"({', '.join(view)}): leave it out, for body"
            )
        return False
    if features is None:
        return not calibration.usable  # such a body is worse than none
    return features == "points"


@lru_cache(maxsize=64)
def _body(calibration: Calibration, numbers: tuple[int, ...]) -> Body:
    """Body of markers of a calibration, by their numbers, the same for every run with it."""
    return make_body(calibration.model(), calibration.M[calibration.indices_of(numbers)])
