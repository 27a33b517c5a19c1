"""Setting of plans and laws: robot, rig, markers, start and goal, noise.

A ``Scenario`` is made once from the inputs of a stage and a calibration; a plan is made in one. A
``RunScenario`` is one with all that the run of a law takes besides.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import chain
from typing import Self

import numpy as np

from projservo_cli.calibration.prediction import predict
from projservo_cli.control.law import Gains
from projservo_cli.findings import Finding
from projservo_cli.geometry.kinematics import project
from projservo_cli.image_size import image_sizes
from projservo_cli.laws import BODY_LAWS, LAW_SPECS
from projservo_cli.loop.verdicts import Limits
from projservo_cli.monitoring.accuracy import metres_a_unit
from projservo_cli.planning.margins import Demands
from projservo_cli.planning.shown_joints import NEAR_PX, joints_showing
from projservo_cli.records import (
    CORNERS,
    TOOL,
    VIEWS,
    WORLD,
    Calibration,
    FloatArray,
    InputError,
    IntArray,
    Model,
    Plan,
    WorkFailed,
)
from projservo_cli.robots.client import weights
from projservo_cli.robots.settings import Joints, limit_passed
from projservo_cli.settings.task import GoalImages, TaskSettings
from projservo_cli.simulation.analytic_plant import NO_PINS, Ends, Plant
from projservo_cli.simulation.faults import observed_in_frames
from projservo_cli.simulation.rendering import RenderedScene
from projservo_cli.simulation.streams import (
    GOAL_FRAMES,
    NORMAL,
    PIN_NOISE,
    PIN_TARGET_NOISE,
    SERVO_NOISE,
    START_FRAMES,
    TARGET_NOISE,
    generator,
)
from projservo_cli.simulation.workspace import Truth, plant_of, turned
from projservo_cli.stages.stage_inputs import CarryingObject, PlanInputs, ServoInputs
from projservo_cli.task.body import NO_BODY, Body, make_body
from projservo_cli.task.incidences import Flat, Incidence
from projservo_cli.task.stand_off import StandOff, displacement_back
from projservo_cli.task.target import TaskImages, is_stereo
from projservo_cli.words import sentence

_GUESSED = 1e-3  # weight of a marker in a fit that is predicted from others


@dataclass(frozen=True, eq=False)
class Scenario:
    """Task, model and images of a plan and its runs."""

    inputs: PlanInputs
    calibration: Calibration | None  # None: laws are given the true model
    joints: Joints  # as the laws take them
    numbers: tuple[int, ...]  # of the markers by which the face is measured, those of the face first
    observed: tuple[int, ...]  # numbers of all markers that the robot observes, in its order
    exact: TaskImages  # start and goal without noise; predicted for a robot that is not simulated
    true_ends: Ends  # true poses of the tool; NaN if unknown
    q_taught: FloatArray | None  # (n,) joints at which the goal was taught, rad or m; None if unknown
    goal_joints: FloatArray  # (k, n) joints at which the goal is shown, rad or m; k is 0 if unknown
    view: tuple[str, ...]  # names of the views
    noise_px: float  # of the images in the loop; at least the residual of a calibration of recorded ones
    # (V, b, 2) images of the goal that was chosen among those of the incidences, px; None for the taught one
    s_chosen: FloatArray | None
    s_carried: FloatArray | None  # (V, b, 2) images of the taught goal where its object is now, px

    @cached_property
    def ends(self) -> TaskImages:
        """Start and goal as the laws see them."""
        images = self.images_at(self.inputs.seed)
        if self.s_chosen is None:
            return images
        return images._replace(s_star=self.s_chosen, s_taught=images.s_star)

    @property
    def truth(self) -> Truth | None:
        """Robot, rig and markers as they are; None for a robot that is not simulated."""
        return self.inputs.truth

    @property
    def starts_here(self) -> bool:
        """Whether the start is where the arm stands."""
        return self.inputs.task is not None and self.inputs.task.start_joints is None

    @property
    def m(self) -> int:
        """Return the number of markers on the face."""
        return len(self.numbers) - self.exact.pins

    @property
    def least_views(self) -> int:
        """Number of views that are to see the whole face. Raises InputError if there are not so many."""
        asked, V = self.inputs.trajectory.least_views, len(self.view)
        if asked is not None and asked > V:
            raise InputError(f"trajectory.visible_views: {asked}, of {V} views: set {V} or all")
        return asked or V

    @property
    def untested(self) -> tuple[Finding, ...]:
        """Return why images are not tested against the calibration, if they are not."""
        if not self.inputs.tests_images:
            return (Finding("no_image_test"),)
        assert self.calibration is not None
        return () if self.calibration.has_covariance else (Finding("no_covariance"),)

    @property
    def joints_at_goal(self) -> FloatArray:
        """Joints (k, n) known to show the goal, rad or m; none of a displaced one."""
        displaced = self.inputs.displaced is not None and self.s_chosen is None
        return self.goal_joints[:0] if displaced else self.goal_joints

    def towards(self, plan: Plan) -> Self:
        """Return the scenario with the goal that a plan carried along, or chose among those of incidences."""
        found = self if plan.s_carried is None else self.carried(plan.s_carried)
        if plan.s_goal is None and plan.s_carried is None:
            return found
        end = plan.q[-1:] if np.isfinite(plan.q[-1:]).all() else self.goal_joints[:0]
        return replace(found, s_chosen=plan.s_goal, goal_joints=end)

    def carried(self, s: FloatArray) -> Self:
        """Return the scenario with a goal that was carried along, of which no joints are known.

        s : (V, b, 2) its images, px.
        """
        exact = self.exact
        if len(exact.q_near):
            shown = exact._replace(s_star=s)
            exact = exact._replace(q_near=_joints_near_goal(shown, None, self.calibration, self.numbers))
        return replace(self, s_carried=s, exact=exact, goal_joints=self.goal_joints[:0])

    def images_for(self, law: str) -> TaskImages:
        """Start and goal as a law measures them: with the body, or point by point."""
        return self.ends if self.measures_body(law) else self.ends.by_points()

    def measures_body(self, law: str) -> bool:
        """Whether a law measures the face with the body; classical laws from two views do not."""
        return law in BODY_LAWS or not is_stereo(self.view)

    def numbers_of(self, law: str) -> tuple[int, ...]:
        """Numbers of the markers that a law observes."""
        return self.numbers if self.measures_body(law) else self.numbers[: self.m]

    @cached_property
    def model(self) -> Model:
        """The calibrated model, or the true one without a calibration."""
        if self.calibration is not None:
            return self.calibration.model()
        assert self.truth is not None
        return self.truth.model

    @cached_property
    def demands(self) -> Demands:
        """Return the constraints of the planned motion."""
        if (size := self.inputs.image_size or self.inputs.seen_px) is None:
            raise InputError(
                "the size of the images, and so their border, is not known: set data.image_size_px, or "
                "size_px of the cameras"
            )
        joints, asked = self.joints, self.inputs.trajectory
        margins = asked.joint_margin_m, asked.joint_margin
        keep = np.array([margins[kind != "P"] for kind in joints.types])
        border, condition = asked.border_px, asked.min_reciprocal_condition
        face, units = asked.min_face_px, self.joints.units
        return Demands(
            limits=joints.limits,
            image_size=image_sizes(size, self.view),
            border_px=border,
            conditioning=condition,
            keep=keep,
            min_face_px=face,
            tags=self._tags(),
            units=units,
            view=self.view,
            least_views=self.least_views,
        )

    def _tags(self) -> IntArray:
        """Corners (t, 4) of tags among the markers; none for tools of which no tag is on the face."""
        order = self.numbers
        tags = [[order.index(k) for k in tag] for tag in self.inputs.tags if set(tag) <= set(order)]
        if not any(max(tag) < self.m for tag in tags):
            tags = []
        return np.array(tags, dtype=np.int64).reshape(-1, CORNERS)

    @property
    def goal_sigma_px(self) -> float:
        """Standard deviation of a coordinate of the face in the images of the goal, px."""
        images = self.goal_images
        stated = None if images is None else images.sigma_px(self.numbers[: self.m], self.inputs.face)
        return self.noise_px / math.sqrt(self.inputs.averaged_frames) if stated is None else stated

    @property
    def goal_error_px(self) -> float:
        """Standard deviation of a coordinate of the goal by its images and the calibration, px."""
        calibrated = None if self.calibration is None else self.calibration.predicted_rms_px
        return math.hypot(self.goal_sigma_px, math.sqrt(0.5) * (calibrated or 0.0))

    @property
    def goal_images(self) -> GoalImages | None:
        """Images of the goal that are given."""
        return None if self.inputs.task is None else self.inputs.task.goal.images

    @property
    def goal_pixels(self) -> tuple[FloatArray, FloatArray] | None:
        """Images (V, m, 2) that are given of the goal, px, and their deviations (V, m).

        They are of the markers of the calibration, NaN where unseen; deviations that are not given are those
        of the loop. None without such images, or a covariance to test them by.
        """
        if self.goal_images is None or self.calibration is None or not self.calibration.has_covariance:
            return None
        numbers, given = self.calibration.marker.tolist(), self.goal_images
        pixels, unseen = given.pixels(self.inputs.face, self.view), _unseen(len(self.view))
        images = np.array([pixels.get(number, unseen) for number in numbers]).swapaxes(0, 1)
        known = [number in pixels for number in numbers]
        sigma = np.full((len(self.view), len(numbers)), self.noise_px)
        told = [number for number in numbers if number in pixels]
        stated = np.array(given.deviations(told, self.inputs.face, self.view))
        sigma[:, known] = np.where(np.isnan(stated), self.noise_px, stated)
        return images, sigma

    def images_at(self, seed: int) -> TaskImages:
        """Start and goal as the images of a seed show them; a goal may be carried along, then displaced."""
        images, asked = self.shown_at(seed), self.inputs.displaced
        if self.s_carried is not None:
            images = images._replace(s_star=self.s_carried)
        if asked is None:
            return images
        if not len(images.body.M):
            raise WorkFailed(
                "a goal is displaced with the body, and the calibration is not usable: calibrate again, or "
                "set control.features: body to try"
            )
        model, back = self.model, _positioned(asked, self.numbers)
        s = images.s_start if asked.of_start else images.s_star
        H = images.displacement_at_start(model) if asked.of_start else images.displacement_taught(model)
        metre = metres_a_unit(model, images.body.M[: self.m], self.inputs.lengths)
        moved = displacement_back(model, images.body, H, back, np.isfinite(s[..., 0]), metre) @ H
        there, before = (project(model.P, images.body.M @ at.T, model.lens) for at in (moved, H))
        return images._replace(s_star=np.ascontiguousarray(there + s - before))

    def shown_at(self, seed: int) -> TaskImages:
        """Start and taught goal as the images of a seed show them, which are averages."""
        if self.inputs.scene is not None:
            return self._rendered(seed)
        sigma = self.inputs.noise_px / math.sqrt(self.inputs.averaged_frames)
        if sigma == 0.0 or self.truth is None:
            return self.exact
        m, others, draw = self.m, self.truth.pins, self.truth.noise.draw
        which = [others.index(self.truth.number.index(number)) for number in self.numbers[m:]]
        images = np.array([self.exact.s_start, self.exact.s_star])
        drawn, V = 2 if self.goal_images is None else 1, len(self.view)  # given images stay as they are
        images[:drawn, :, :m] += sigma * draw(generator(seed, TARGET_NOISE), (drawn, V, m, 2))
        if which:
            noise = draw(generator(seed, PIN_TARGET_NOISE), (drawn, V, len(others), 2))
            images[:drawn, :, m:] += sigma * noise[:, :, which]
        return self.exact._replace(s_start=images[0], s_star=images[1])

    def _rendered(self, seed: int) -> TaskImages:
        """Start and goal as rendered frames show them; images of the goal that are given stay as they are.

        The body is fitted to both by the deviations of their pixels, whichever is the larger. Markers of the
        face that frames do not show are predicted from those that they show.
        """
        numbers, seen_images, given = self.numbers, self.exact, self.goal_images
        start, sigma = self._frames(seen_images.q_start, (seed, START_FRAMES))
        if given is None:
            assert self.q_taught is not None
            scene = None if self.inputs.carrier is None else self.inputs.carrier.at_first
            goal, there = self._frames(self.q_taught, (seed, GOAL_FRAMES), scene)
        else:
            goal, there = seen_images.s_star, np.array(given.deviations(numbers, self.inputs.face, self.view))
        sigma = np.fmax(sigma, there)
        start = self._with_face("task.start", start, seen_images.q_start)
        seen_images = seen_images._replace(s_start=start, s_star=self._with_face("task.goal", goal, None))
        if not len(seen_images.body.M):
            return seen_images
        weight = weights(sigma, sigma[..., None])
        weight[np.isnan(sigma)] = _GUESSED
        return seen_images._replace(body=seen_images.body._replace(weight=weight))

    def _frames(
        self, q: FloatArray, drawn: tuple[int, int], scene: RenderedScene | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Pixels (V, b, 2) in rendered frames at joints (n,), rad or m, and their deviations (V, b).

        scene : another one than that of the inputs.
        """
        scene = scene or self.inputs.scene
        assert scene is not None
        which = [scene.numbers.index(number) for number in self.numbers]
        s, sigma = observed_in_frames(scene, self.inputs.averaged_frames, q, drawn)
        return np.ascontiguousarray(s[:, which]), sigma[:, which]

    def _with_face(self, key: str, s: FloatArray, q: FloatArray | None) -> FloatArray:
        """Pixels (V, b, 2) with a whole face, at joints (n,) or, for None, at those that they show.

        In as many views as are to see the face; the others may show less. Raises WorkFailed where too little
        of the tool is seen.
        """
        unseen = np.isnan(s[..., 0])
        unseen[:, self.m :] = False
        if (~unseen.any(axis=1)).sum() >= self.least_views:
            return s
        view, k = np.argwhere(unseen)[0]
        known, much = self.calibration, np.isfinite(s[..., 0]).sum(axis=1) > CORNERS - 1
        if known is not None and much.sum() >= self.least_views:
            unseen[~much] = False
            off = 0.0
            if q is None:
                q, off = joints_showing(known, self.numbers, s, self.exact.q_start)
            if off <= NEAR_PX:
                there = predict(known, q[None])[0][:, known.indices_of(self.numbers)]
                return np.ascontiguousarray(np.where(unseen[..., None], there, s))
        raise WorkFailed(
            f"{key}: the {self.view[view]} camera does not see marker {self.numbers[k]} of the face, and too "
            "little else of the tool: turn it towards the cameras, or bring it nearer"
        )


@dataclass(frozen=True, eq=False)
class RunScenario(Scenario):
    """A scenario with the further inputs of runs."""

    servo: ServoInputs  # further inputs of runs
    gains: Gains
    termination: Limits  # gains, termination: of the laws, and when a run ends

    def believed_by(self, law: str) -> Model:
        """The model that a law is given: the calibrated one, or for a metric law the true one."""
        if not (law in LAW_SPECS and LAW_SPECS[law].metric):
            return self.model
        if self.truth is not None:
            return self.truth.model
        P = None if self.inputs.arm is None else self.inputs.cameras_at(self.inputs.arm.q_reference)
        if self.inputs.arm is None or P is None:
            raise InputError(
                f"{law} is given the metric model of robot and rig: set robot and rig, or leave it out of "
                "control.laws"
            )
        return self.inputs.arm.model(P, on_tool=self.inputs.mount == TOOL)

    def plant_of(self, law: str) -> Plant:
        """The simulated robot as a law sees it."""
        assert self.truth is not None
        q_start, opaque = self.exact.q_start, self.servo.opaque
        plant = plant_of(self.truth, q_start, opaque=opaque, least_views=self.least_views)
        M = self.truth.of(self.numbers[self.m :]) if self.measures_body(law) else NO_PINS
        return plant._replace(pins=M)

    def noise_of(self, law: str, seed: int, times: int) -> FloatArray:
        """Pixel noise (instants, V, markers, 2) of a seed as a law observes it, px.

        It is the same for every law; fewer instants are the first of more.
        """
        numbers = self.numbers_of(law)
        noise = np.zeros((times, len(self.view), len(numbers), 2))
        sigma, shape = self.inputs.noise_px, NORMAL if self.truth is None else self.truth.noise
        if sigma > 0.0:
            for these, stream in ((slice(self.m), SERVO_NOISE), (slice(self.m, None), PIN_NOISE)):
                if noise[:, :, these].size > 0:
                    drawn = shape.draw(generator(seed, stream), noise[:, :, these].shape)
                    np.multiply(sigma, drawn, out=noise[:, :, these])
        return noise


def scenario_of(inputs: PlanInputs, calibration: Calibration | None = None) -> Scenario:
    """Make the scenario of a simulated robot, or of one that a calibration predicts.

    Without a calibration laws are given the true model of the simulated robot. Raises InputError if a part
    of it is missing, naming the key to set; WorkFailed if the goal cannot be reached or seen, or the body not
    be measured with.
    """
    truth, face, task = inputs.truth, inputs.face, inputs.task
    if task is None:
        raise InputError("this stage needs a task: set task.start and task.goal")
    joints = inputs.joints.joints("" if calibration is None else calibration.joint_types, calibration)
    if len(joints.types) == 1:
        raise WorkFailed(
            "one joint cannot reach a pose, which takes two or more: calibrate, validate and report it"
        )
    sigma_px = inputs.noise_px
    if truth is not None:
        observed = truth.number
    else:
        assert calibration is not None
        observed = observed_numbers(inputs, calibration)
    if calibration is not None and (truth is None or inputs.scene is not None):
        sigma_px = max(sigma_px, calibration.sigma_fitted_px)
    view = calibration.view if calibration is not None else truth.view if truth is not None else VIEWS
    _require_same_rig(inputs, calibration)
    body = NO_BODY
    pins: tuple[int, ...] = ()
    if not _by_points(inputs.features, calibration, view):
        known = observed if calibration is None else calibration.marker.tolist()
        pins = tuple(number for number in observed if number in known and number not in face)
        body = _body(calibration or truth, (*face, *pins))
    elif inputs.incidences:
        raise WorkFailed(
            "incidences are measured with the body, and the calibration is not usable: calibrate again, or "
            "set control.features: body to try"
        )
    if truth is not None:
        at = None if inputs.q_current is None else tuple(inputs.q_current.tolist())
        exact, ends, q_goal = _simulated_ends(task, joints.types, truth, pins, inputs.center, current=at)
    else:
        assert calibration is not None
        exact, ends, q_goal = _predicted_ends(inputs, task, calibration, joints, (*face, *pins))
    exact = exact._replace(body=body, view=view, incidences=_positions(inputs.incidences, (*face, *pins)))
    if not is_stereo(view):
        near = _joints_near_goal(exact, q_goal, calibration, (*face, *pins))
        exact = exact._replace(q_near=near)
    if inputs.carrier is not None:
        ends = _carried_ends(ends, inputs.carrier)
    if truth is not None and inputs.displaced is not None and len(body.M):
        ends = _displaced_ends(inputs, truth, exact, ends, (*face, *pins))
    found = Scenario(
        inputs=inputs,
        calibration=calibration,
        joints=joints,
        numbers=(*face, *pins),
        observed=observed,
        exact=exact,
        true_ends=ends,
        q_taught=q_goal,
        goal_joints=np.empty((0, len(joints.types))) if q_goal is None else q_goal[None],
        noise_px=sigma_px,
        view=view,
        s_chosen=None,
        s_carried=None,
    )
    return replace(found, exact=exact._replace(least_views=found.least_views))


def _carried_ends(ends: Ends, carrier: CarryingObject) -> Ends:
    """Return the true poses of the tool with the goal carried along by its object, if that is simulated."""
    if carrier.placed is None:
        return ends
    T = carrier.placed.T
    return ends._replace(goal_pose=T @ ends.goal_pose, goal=T @ ends.goal)


def _positions(asked: Sequence[Incidence], numbers: Sequence[int]) -> tuple[Incidence, ...]:
    """Incidences by positions in the body instead of numbers of markers; raises as ``_in_body``."""
    names = [f"task.goal.incidences: {one.name}" for one in asked]
    return tuple(
        one._replace(tool=_in_body(one.tool, numbers, name), scene=_in_body(one.scene, numbers, name))
        for one, name in zip(asked, names, strict=True)
    )


def _positioned(asked: StandOff, numbers: Sequence[int]) -> StandOff:
    """Displacement by positions in the body instead of numbers of markers; raises as ``_in_body``."""
    return asked._replace(along=_in_body(asked.along, numbers, f"displaced: {asked.name}"))


def _in_body(points: Flat, numbers: Sequence[int], name: str) -> Flat:
    """Points that span a feature, by positions in the body instead of numbers of markers.

    name : of what they are for, as a message begins. Raises InputError for a marker that the body lacks.
    """
    for number in chain.from_iterable(points):
        if number not in numbers:
            raise InputError(
                f"{name} needs marker {number}, and the body has {', '.join(map(str, numbers))}: name these, "
                "or calibrate with it"
            )
    return tuple(tuple(map(numbers.index, point)) for point in points)


def _displaced_ends(
    inputs: PlanInputs, truth: Truth, exact: TaskImages, ends: Ends, numbers: tuple[int, ...]
) -> Ends:
    """True poses of the tool at start and displaced goal."""
    assert inputs.displaced is not None
    model, goal = truth.model, ends.goal_pose
    if not np.isfinite(goal).all():
        return ends
    body, H = make_body(model, truth.of(numbers)), goal @ np.linalg.inv(ends.base_tool)
    metre = metres_a_unit(model, body.M[: len(inputs.face)], inputs.lengths)
    shows = np.isfinite((exact.s_start if inputs.displaced.of_start else exact.s_star)[..., 0])
    back = displacement_back(model, body, H, _positioned(inputs.displaced, numbers), shows, metre)
    return Ends(ends.base_tool, back @ goal, back @ ends.goal)


def _require_same_rig(inputs: PlanInputs, calibration: Calibration | None) -> None:
    """Refuse a calibration of other views or another mount than the simulated rig has."""
    truth = inputs.truth
    if truth is None or calibration is None:
        return
    mount = TOOL if truth.on_tool else WORLD
    if (calibration.view, calibration.mount) != (truth.view, mount):
        raise InputError(
            f"the calibration is of {', '.join(calibration.view)} (mount {calibration.mount}), and the rig "
            f"has {', '.join(truth.view)} (mount {mount}): calibrate this rig"
        )


def _joints_near_goal(
    images: TaskImages, q_goal: FloatArray | None, calibration: Calibration | None, numbers: Sequence[int]
) -> FloatArray:
    """Joints (n,) at the goal, or those that show it by the calibration, rad or m."""
    if q_goal is not None:
        return q_goal
    if calibration is None:
        raise InputError("task.goal.images needs a calibration, or left and right; give task.goal.joints")
    q, off = joints_showing(calibration, numbers, images.s_star, images.q_start)
    if off > NEAR_PX:
        raise WorkFailed(
            f"task.goal.images: no joints were found that show them; the nearest are off by {off:.3g} px "
            f"({NEAR_PX:g}): give task.goal.images.joints"
        )
    return q


def run_scenario(inputs: ServoInputs, calibration: Calibration | None = None) -> RunScenario:
    """Make the scenario of runs; raises as ``scenario_of``. Noise widens the tolerance of the image error."""
    found, stop = scenario_of(inputs.plan, calibration), inputs.stop
    limits, noise_px = found.joints.limits, stop.noise_factor * found.noise_px
    termination = Limits(
        speed=limits.speed,
        image_error_px=stop.image_error_px + noise_px,
        diverged_factor=stop.diverged_factor,
        stall_periods=stop.stall_periods,
        max_steps=stop.max_steps,
        stop_at_joint_limit=inputs.at_joint_limit,
        stop_at_border=inputs.at_border,
        max_lost_periods=stop.max_lost_periods,
        noise_px=noise_px,
    )
    if not inputs.at_joint_limit:  # a run may pass them, so that they end no path
        endless = np.full(len(found.joints.types), math.inf)
        limits = limits._replace(lower=-endless, upper=endless)
    gains = inputs.gains._replace(limits=limits)
    # What was just made holds its fields alone: nothing is derived from them yet.
    return RunScenario(**vars(found), servo=inputs, gains=gains, termination=termination)


def _by_points(features: str | None, calibration: Calibration | None, view: Sequence[str]) -> bool:
    """Whether the face is measured point by point: as asked for, else where no body is calibrated well.

    Raises InputError where points are asked for and there are not two views.
    """
    if not is_stereo(view):
        if features == "points":
            raise InputError(
                f"control.features: points are measured from two views, and there are {len(view)} "
                f"({', '.join(view)}): leave it out, for body"
            )
        return False
    if features is None:
        return calibration is None or not calibration.usable  # such a body is worse than none
    return features == "points"


@lru_cache(maxsize=64)
def _body(known: Calibration | Truth, numbers: tuple[int, ...]) -> Body:
    """Body of markers of a calibration, by their numbers, the same for every run with it."""
    if isinstance(known, Truth):
        return make_body(known.model, known.of(numbers))
    return make_body(known.model(), known.M[known.indices_of(numbers)])


def observed_numbers(inputs: PlanInputs, calibration: Calibration) -> tuple[int, ...]:
    """Numbers of the markers that a robot which is not simulated observes, in its order."""
    numbers = tuple(calibration.marker.tolist()) if inputs.known is None else inputs.known
    for number in inputs.face:
        if number not in numbers:
            raise InputError(f"markers.face: marker {number} is not among those observed, {[*numbers]}")
    return numbers


@lru_cache(maxsize=2048)
def _simulated_ends(
    task: TaskSettings,
    types: str,
    truth: Truth,
    pins: tuple[int, ...],
    center: int,
    *,
    current: tuple[float, ...] | None,
) -> tuple[TaskImages, Ends, FloatArray | None]:
    """Return the images of the ends of a task, for any seed and noise, and the joints (n,) at the goal.

    current : joints where the arm stands, if that is known.
    """
    at = None if current is None else np.array(current)
    M_pins, robot = truth.of(pins), truth.robot

    def images(q: FloatArray, key: str) -> FloatArray:
        """Both apart, so that the face has the same bits with any pins."""
        if wrong := limit_passed(q, robot.limits, types):
            raise WorkFailed(f"{key}: {sentence(wrong)}: choose others or wider limits")
        return np.concatenate([truth.images(q, truth.M_face), truth.images(q, M_pins)], axis=1)

    def turn(q: FloatArray) -> FloatArray:
        return turned(task.goal, robot, truth.cameras_at(q), q)

    numbers = tuple(truth.number[i] for i in truth.face), pins
    seen_images, q_goal = _task_images(task, types, numbers, (center, truth.view), images, turn, q_current=at)
    return seen_images, _unknown(robot.base_tool) if q_goal is None else truth.ends(q_goal), q_goal


def _task_images(
    task: TaskSettings,
    types: str,
    numbers: tuple[Sequence[int], Sequence[int]],
    how: tuple[int, tuple[str, ...]],
    images: Callable[[FloatArray, str], FloatArray],
    turn: Callable[[FloatArray], FloatArray],
    *,
    q_current: FloatArray | None,
) -> tuple[TaskImages, FloatArray | None]:
    """Start and goal of a task, and the joints (n,) at the goal, None for a goal by images alone.

    numbers : of the markers of the face and of the pins.
    how : position of the centre marker within the face, or ``MIDPOINT``; names of the views.
    images : pixels (V, b, 2) at the joints (n,) of a key of the configuration.
    turn : joints (n,) of a goal that is a turn from the joints (n,) of the start.
    q_current : (n,) joints where the arm stands, if that is known.
    """
    pins, given, (center, view) = len(numbers[1]), task.goal.joints, how
    q_start = q_from = _joints_at_start(task, q_current, types)
    if task.start_offset is not None:
        q_start = q_from + task.start_offset.values(types)
    s_start = images(q_start, "task.start" if task.start_offset is None else "task.start_offset")
    if task.goal.images is not None:
        pixels = task.goal.images.pixels(numbers[0], view)
        unseen = _unseen(len(s_start))
        s_star = np.array([pixels.get(number, unseen) for number in (*numbers[0], *numbers[1])])
        s_star = np.ascontiguousarray(np.swapaxes(s_star, 0, 1))
        return TaskImages(q_start, s_start, s_star, center, pins), None
    if task.goal.of_start:
        return TaskImages(q_start, s_start, s_start, center, pins), q_start
    q_goal = turn(q_from) if given is None else given.values(types)
    return TaskImages(q_start, s_start, images(q_goal, "task.goal"), center, pins), q_goal


def _joints_at_start(task: TaskSettings, q_current: FloatArray | None, types: str) -> FloatArray:
    """Joints (n,) at the start, rad or m. Raises InputError where nobody has asked where the arm stands."""
    if task.start_joints is not None:
        return task.start_joints.values(types)
    if q_current is None:
        raise InputError("task.start: current is where the arm stands: give joints, or run projservo servo")
    return q_current


def _unseen(views: int) -> tuple[tuple[float, float], ...]:
    """Pixels of a marker that no camera sees."""
    return ((math.nan, math.nan),) * views


def _unknown(base_tool: FloatArray) -> Ends:
    """Return the ends of a task whose goal is known by its images alone."""
    return Ends(base_tool, np.full((4, 4), np.nan), np.full(4, np.nan))


def _predicted_ends(
    inputs: PlanInputs, task: TaskSettings, calibration: Calibration, joints: Joints, numbers: Sequence[int]
) -> tuple[TaskImages, Ends, FloatArray | None]:
    """Start and goal of a robot that is not simulated, as the calibration predicts them, as above."""
    m, columns = len(inputs.face), calibration.indices_of(numbers)
    least = inputs.trajectory.least_views or len(calibration.view)
    taught = None if task.goal.images is None else task.goal.images.joints
    given = (task.start_joints, "start"), (task.goal.joints, "goal.joints"), (taught, "goal.images.joints")
    for vector, key in given:
        if vector is not None and len(vector.joints) != len(joints.types):
            raise InputError(f"task.{key}: {len(vector.joints)} values for {len(joints.types)} joints")

    def images(q: FloatArray, key: str) -> FloatArray:
        if wrong := joints.limit_passed(q):
            raise InputError(f"{key}: {sentence(wrong)}: choose another")
        s = predict(calibration, q[None])[0][:, columns]
        if np.isnan(s[:, :m]).any(axis=(1, 2)).sum() > len(s) - least:
            raise WorkFailed(f"{key}: by the calibration, the face is not in front of the cameras there")
        return np.ascontiguousarray(s)

    def turn(q: FloatArray) -> FloatArray:
        P = inputs.cameras_at(q)
        if inputs.arm is None or P is None:
            raise InputError(
                "task.goal.roll_deg needs the model of the robot and its rig: give joints or images instead"
            )
        return turned(task.goal, inputs.arm, P, q)

    seen_images, q_goal = _task_images(
        *(task, joints.types, (numbers[:m], numbers[m:]), (inputs.center, calibration.view)),
        *(images, turn),
        q_current=inputs.q_current,
    )
    return seen_images, _unknown(np.full((4, 4), np.nan)), q_goal
