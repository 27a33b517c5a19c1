"""Setting of plans and laws: a task in a world, with the images of its start and goal.

A ``Scenario`` is made once from the inputs of a stage and a calibration; a plan is made in one. A
``RunScenario`` is one with all that the run of a law takes besides.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Self

import numpy as np

from projservo_cli.control.law import Gains
from projservo_cli.findings import Finding
from projservo_cli.geometry.kinematics import project
from projservo_cli.image_size import image_sizes
from projservo_cli.laws import BODY_LAWS, LAW_SPECS
from projservo_cli.loop.verdicts import Limits
from projservo_cli.monitoring.arrival_accuracy import metres_a_unit
from projservo_cli.planning.joints_from_images import NEAR_PX, joints_showing
from projservo_cli.planning.motion_margins import Demands
from projservo_cli.records import (
    CORNERS,
    TOOL,
    WORLD,
    Calibration,
    CarriedByObject,
    FloatArray,
    InputError,
    IntArray,
    Model,
    Plan,
    WorkFailed,
)
from projservo_cli.simulation.analytic_plant import Ends, Plant
from projservo_cli.simulation.ground_truth import Truth
from projservo_cli.stages.stage_inputs import CarryingObject, PlanInputs, ServoInputs
from projservo_cli.stages.worlds.calibrated import CalibratedWorld, measures_points, observed_numbers
from projservo_cli.stages.worlds.simulated import RenderedWorld, SimulatedWorld
from projservo_cli.stages.worlds.task_images import given_pixels, in_body, positioned
from projservo_cli.task.incidences import Incidence
from projservo_cli.task.stand_off import displacement_back
from projservo_cli.task.target import Place, TaskImages, is_stereo


@dataclass(frozen=True, eq=False)
class Scenario:
    """Task, model and images of a plan and its runs."""

    world: CalibratedWorld  # robot, cameras and markers, simulated or as they are calibrated
    exact: TaskImages  # start and goal without noise; predicted for a robot that is not simulated
    true_ends: Ends  # true poses of the tool; NaN if unknown
    q_taught: FloatArray | None  # (n,) joints at which the goal was taught, rad or m; None if unknown
    goal_joints: FloatArray  # (k, n) joints at which the goal is shown, rad or m; k is 0 if unknown
    # (V, b, 2) images of the goal that was chosen among the goals of the incidences, px; None for the taught
    # one
    s_chosen: FloatArray | None = None
    objects: tuple[Place, ...] = ()  # the taught goal where its objects have it now

    @cached_property
    def ends(self) -> TaskImages:
        """Start and goal as the laws see them."""
        images = self.images_at(self.world.inputs.seed)
        if self.s_chosen is None:
            return images
        return images._replace(goal=images.goal._replace(s=self.s_chosen))

    @property
    def untested(self) -> tuple[Finding, ...]:
        """Return why images are not tested against the calibration, if they are not."""
        if not self.world.inputs.tests_images:
            return (Finding("no_image_test"),)
        return () if self.world.calibration.has_covariance else (Finding("no_covariance"),)

    @property
    def joints_at_goal(self) -> FloatArray:
        """Joints (k, n) known to show the goal, rad or m; none of a displaced one."""
        displaced = self.world.inputs.displaced is not None and self.s_chosen is None
        return self.goal_joints[:0] if displaced else self.goal_joints

    def towards(self, plan: Plan) -> Self:
        """Return the scenario with the goal that a plan carried along, or chose among goals of incidences."""
        found = self.carried(plan.carried)
        if plan.open_goal is None and not plan.carried:
            return found
        end = plan.q[-1:] if np.isfinite(plan.q[-1:]).all() else self.goal_joints[:0]
        chosen = None if plan.open_goal is None else plan.open_goal.s_goal
        return replace(found, s_chosen=chosen, goal_joints=end)

    def carried(self, objects: Sequence[CarriedByObject]) -> Self:
        """Return the scenario with a goal that objects carried along, of which no joints are known."""
        if not objects:
            return self
        exact, none = self.exact, np.zeros((0, 4))
        moved_objects = tuple(
            Place(one.s_carried, none if one.M_object is None else one.M_object) for one in objects
        )
        if len(exact.q_near):
            at_objects = exact._replace(goal=exact.goal.carried_to(moved_objects))
            exact = exact._replace(q_near=_joints_near_goal(self.world, at_objects, None))
        return replace(self, objects=moved_objects, exact=exact, goal_joints=self.goal_joints[:0])

    def images_for(self, law: str) -> TaskImages:
        """Start and goal as a law measures them: with the body, or point by point."""
        return self.ends if self.measures_body(law) else self.ends.by_points()

    def measures_body(self, law: str) -> bool:
        """Whether a law measures the face with the body; classical laws from two views do not."""
        return law in BODY_LAWS or not is_stereo(self.world.view)

    def numbers_of(self, law: str) -> tuple[int, ...]:
        """Numbers of the markers that a law observes."""
        return self.world.numbers if self.measures_body(law) else self.world.numbers[: self.world.m]

    @cached_property
    def demands(self) -> Demands:
        """Return the constraints of the planned motion."""
        if (size := self.world.inputs.image_size or self.world.inputs.seen_px) is None:
            raise InputError(
                "the size of the images, and so their border, is not known: set data.image_size_px, or "
                "size_px of the cameras"
            )
        joints, asked = self.world.joints, self.world.inputs.trajectory
        margins = asked.joint_margin_m, asked.joint_margin
        keep = np.array([margins[kind != "P"] for kind in joints.types])
        border, condition = asked.border_px, asked.min_reciprocal_condition
        face, units = asked.min_face_px, self.world.joints.units
        return Demands(
            limits=joints.limits,
            image_size=image_sizes(size, self.world.view),
            border_px=border,
            conditioning=condition,
            keep=keep,
            min_face_px=face,
            tags=self._tags(),
            units=units,
            view=self.world.view,
            min_views=self.world.min_views,
        )

    def _tags(self) -> IntArray:
        """Corners (t, 4) of tags among the markers; none for tools of which no tag is on the face."""
        order = self.world.numbers
        tags = [
            [order.index(k) for k in tag] for tag in self.world.inputs.markers.tags if set(tag) <= set(order)
        ]
        if not any(max(tag) < self.world.m for tag in tags):
            tags = []
        return np.array(tags, dtype=np.int64).reshape(-1, CORNERS)

    @property
    def goal_sigma_px(self) -> float:
        """Standard deviation of a coordinate of the face in the images of the goal, px."""
        images = self.world.goal_images
        stated = (
            None
            if images is None
            else images.sigma_px(self.world.numbers[: self.world.m], self.world.inputs.markers.face)
        )
        if stated is not None:
            return stated
        return self.world.noise_px / math.sqrt(self.world.inputs.noise.averaged_frames)

    @property
    def goal_error_px(self) -> float:
        """Standard deviation of a coordinate of the goal by its images and the calibration, px."""
        calibrated = self.world.calibration.predicted_rms_px or 0.0
        return math.hypot(self.goal_sigma_px, math.sqrt(0.5) * calibrated)

    @property
    def goal_pixels(self) -> tuple[FloatArray, FloatArray] | None:
        """Images (V, m, 2) that are given of the goal, px, and their deviations (V, m).

        They are of the markers of the calibration, NaN where unseen; deviations that are not given are those
        of the loop. None without such images, or a covariance to test them by.
        """
        world, given = self.world, self.world.goal_images
        if given is None or not world.calibration.has_covariance:
            return None
        s, sigma = given_pixels(
            given, world.calibration.marker.tolist(), world.inputs.markers.face, world.view
        )
        return s, np.where(np.isnan(sigma), world.noise_px, sigma)

    def images_at(self, seed: int) -> TaskImages:
        """Start and goal as the images of a seed show them; a goal may be carried along, then displaced."""
        images, asked = (
            self.world.averaged_images(self.exact, self.q_taught, seed),
            self.world.inputs.displaced,
        )
        if self.objects:
            images = images._replace(goal=images.goal.carried_to(self.objects))
        if asked is None:
            return images
        self.world.require_body("a goal is displaced")
        model, back = self.world.model, positioned(asked, self.world.numbers)
        s = images.s_start if asked.of_start else images.s_star
        H = images.displacement_at_start(model) if asked.of_start else images.displacement_at_goal(model)
        metre = metres_a_unit(model, images.body.M[: self.world.m], self.world.inputs.lengths)
        moved = displacement_back(model, images.body, H, back, np.isfinite(s[..., 0]), metre) @ H
        there, before = (project(model.P, images.body.M @ at.T, model.lens) for at in (moved, H))
        return images.to(np.ascontiguousarray(there + s - before))


@dataclass(frozen=True, eq=False, kw_only=True)
class RunScenario(Scenario):
    """A scenario with the further inputs of runs."""

    servo: ServoInputs  # further inputs of runs
    gains: Gains
    termination: Limits  # gains, termination: of the laws, and when a run ends

    @property
    def simulated(self) -> SimulatedWorld:
        """The world of runs that are simulated."""
        assert isinstance(self.world, SimulatedWorld)
        return self.world

    def believed_by(self, law: str) -> Model:
        """The model that a law is given: the calibrated one, or for a metric law the true one."""
        metric = law in LAW_SPECS and LAW_SPECS[law].metric
        return self.world.metric_model(law) if metric else self.world.model

    def plant_of(self, law: str) -> Plant:
        """The robot as a law sees it."""
        images, pins = partial(self.images_for, law), self.measures_body(law)
        return self.world.plant(self.exact.q_start, images, pins=pins, opaque=self.servo.conditions.opaque)


def world_of(inputs: PlanInputs, calibration: Calibration) -> CalibratedWorld:
    """Return the world of inputs, as a calibration has it.

    Raises InputError if the calibration is of other views or markers, and for points without two views;
    WorkFailed for an arm of one joint.
    """
    truth, face = inputs.described.truth, inputs.markers.face
    joints = inputs.joints.joints(calibration.joint_types, calibration)
    if len(joints.types) == 1:
        raise WorkFailed(
            "one joint cannot reach a pose, which takes two or more: calibrate, validate and report it"
        )
    if truth is not None:
        _require_same_rig(truth, calibration)
    observed = observed_numbers(inputs, calibration) if truth is None else truth.number
    pins: tuple[int, ...] = ()
    if not measures_points(inputs.features, calibration):
        known = calibration.marker.tolist()
        pins = tuple(number for number in observed if number in known and number not in face)
    parts, scene = (inputs, calibration, joints, (*face, *pins)), inputs.described.scene
    if truth is None:
        return CalibratedWorld(*parts)
    return SimulatedWorld(*parts, truth) if scene is None else RenderedWorld(*parts, truth, scene)


def _require_same_rig(truth: Truth, calibration: Calibration) -> None:
    """Refuse a calibration of other views or another mount than the simulated rig has."""
    mount = TOOL if truth.on_tool else WORLD
    if (calibration.view, calibration.mount) != (truth.view, mount):
        raise InputError(
            f"the calibration is of {', '.join(calibration.view)} (mount {calibration.mount}), and the rig "
            f"has {', '.join(truth.view)} (mount {mount}): calibrate this rig"
        )


def scenario_of(inputs: PlanInputs, calibration: Calibration) -> Scenario:
    """Make the scenario of a task in the world of inputs.

    Raises InputError if a part of it is missing, naming the key to set; WorkFailed if the goal cannot be
    reached or seen, or the body not be measured with.
    """
    task = inputs.required_task
    world = world_of(inputs, calibration)
    if inputs.incidences:
        world.require_body("incidences are measured")
    exact, q_goal = world.ends(task)
    exact = exact._replace(body=world.body, view=world.view)
    exact = exact.asking(_positions(inputs.incidences, world.numbers, inputs.carriers))
    if not is_stereo(world.view):
        exact = exact._replace(q_near=_joints_near_goal(world, exact, q_goal))
    exact = exact._replace(min_views=world.min_views)
    joints = np.empty((0, len(world.joints.types))) if q_goal is None else q_goal[None]
    return Scenario(world, exact, world.true_ends(exact, q_goal), q_goal, joints)


def _positions(
    asked: Sequence[Incidence], numbers: Sequence[int], carriers: Sequence[CarryingObject]
) -> tuple[Incidence, ...]:
    """Incidences by positions in the body instead of numbers of markers; raises as ``in_body``.

    Markers of the object of a feature come after the markers of the body.
    """
    found = list[Incidence]()
    for one in asked:
        name = f"task.goal.incidences: {one.name}"
        own = carriers[one.carrier - 1].numbers if one.carrier else ()
        scene = in_body(one.scene, (*numbers, *own), name)
        found.append(one._replace(tool=in_body(one.tool, numbers, name), scene=scene))
    return tuple(found)


def run_scenario(inputs: ServoInputs, calibration: Calibration) -> RunScenario:
    """Make the scenario of runs; raises as ``scenario_of``. Noise widens the tolerance of the image error."""
    found, stop, conditions = scenario_of(inputs.plan, calibration), inputs.stop, inputs.conditions
    limits, noise_px = found.world.joints.limits, stop.noise_factor * found.world.noise_px
    termination = Limits(
        speed=limits.speed,
        image_error_px=stop.image_error_px + noise_px,
        diverged_factor=stop.diverged_factor,
        stall_periods=stop.stall_periods,
        max_steps=stop.max_steps,
        stop_at_joint_limit=conditions.joint_limits == "stop",
        stop_at_border=conditions.image_border == "stop",
        max_lost_periods=stop.max_lost_periods,
        noise_px=noise_px,
    )
    if not termination.stop_at_joint_limit:  # a run may pass them, so that they end no path
        endless = np.full(len(found.world.joints.types), math.inf)
        limits = limits._replace(lower=-endless, upper=endless)
    laws = inputs.laws
    gains = Gains(
        gain_t=laws.gain_t,
        gain_r=laws.gain_r,
        gain_p=laws.gain_p,
        gain_s=laws.gain_s,
        ratio_rp=laws.ratio_rp,
        gain=laws.gain,
        period=laws.period_s,
        visibility_fraction=inputs.plan.trajectory.visibility_fraction,
        limits=limits,
        substeps=laws.substeps == "auto",
        scale=conditions.speed_scale,
    )
    # A new record holds its fields alone: derived values are missing.
    return RunScenario(**vars(found), servo=inputs, gains=gains, termination=termination)


def _joints_near_goal(world: CalibratedWorld, images: TaskImages, q_goal: FloatArray | None) -> FloatArray:
    """Joints (n,) at the goal, or those that show it by the calibration, rad or m."""
    if q_goal is not None:
        return q_goal
    q, off = joints_showing(world.calibration, world.numbers, images.s_star, images.q_start)
    if off > NEAR_PX:
        raise WorkFailed(
            f"task.goal.images: no joints were found that show them; the nearest are off by {off:.3g} px "
            f"({NEAR_PX:g}): give task.goal.images.joints"
        )
    return q
