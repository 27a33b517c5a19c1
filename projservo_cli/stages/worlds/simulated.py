"""Simulated worlds: the truth, seen as points or by rendered cameras."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from projservo_cli.calibration.prediction import predict
from projservo_cli.findings import Finding
from projservo_cli.geometry.algebra import mat
from projservo_cli.geometry.null_space import COORDINATES
from projservo_cli.loop.run_metrics import Summary
from projservo_cli.messages import sentence
from projservo_cli.monitoring.arrival_accuracy import metres_a_unit
from projservo_cli.planning.joints_from_images import NEAR_PX, joints_showing
from projservo_cli.records import (
    CORNERS,
    FloatArray,
    Model,
    WorkFailed,
)
from projservo_cli.robots.contract import PluginRobot, Robot
from projservo_cli.robots.joint_limits import limit_passed
from projservo_cli.robots.latency_compensation import DrivenRobot, weights
from projservo_cli.robots.pacing import Steered
from projservo_cli.robots.session import Session
from projservo_cli.settings.task import TaskSettings
from projservo_cli.simulation.analytic_plant import NO_PINS, Ends, Plant, observe
from projservo_cli.simulation.ground_truth import SceneObject, Truth, plant_of, turned
from projservo_cli.simulation.random_streams import (
    GOAL_FRAMES,
    OBJECT_NOW,
    OBJECT_TAUGHT,
    PIN_NOISE,
    PIN_TARGET_NOISE,
    SERVO_NOISE,
    START_FRAMES,
    TARGET_NOISE,
    generator,
)
from projservo_cli.simulation.rendering import RenderedScene
from projservo_cli.simulation.robot_with_faults import (
    FaultyRobot,
    Points,
    SimulatedRobot,
    observed_in_frames,
    robot_of,
)
from projservo_cli.stages.stage_inputs import CarryingObject, Contract
from projservo_cli.stages.worlds.calibrated import CalibratedWorld, TruePoses
from projservo_cli.stages.worlds.external_robot import simulated_robot
from projservo_cli.stages.worlds.task_images import positioned, task_images
from projservo_cli.task.body_pose import make_body
from projservo_cli.task.face import center_of
from projservo_cli.task.incidences import incidences_of, nearest_goal, points_of
from projservo_cli.task.objects.object_bundle_adjustment import ObjectView
from projservo_cli.task.stand_off import displacement_back
from projservo_cli.task.target import TaskImages

_GUESSED = 1e-3  # weight of a marker in a fit that is predicted from others


@dataclass(frozen=True, eq=False)
class SimulatedWorld(CalibratedWorld):
    """A simulated robot, which cameras see as points, and its truth."""

    truth: Truth

    moves_unseen = True

    @property
    def observed(self) -> tuple[int, ...]:
        """Numbers of all markers that the robot observes, in its order."""
        return self.truth.number

    @property
    def noise_px(self) -> float:
        """Standard deviation of a coordinate of images in the loop, px."""
        return self.inputs.noise.servo_px

    def ends(self, task: TaskSettings) -> tuple[TaskImages, FloatArray | None]:
        """Return start and goal without noise, and the joints (n,) at the goal, if they are known."""
        at = None if self.inputs.q_current is None else tuple(self.inputs.q_current.tolist())
        pins = self.numbers[self.m :]
        return _simulated_ends(
            task, self.joints.types, self.truth, pins, self.inputs.markers.center, current=at
        )

    def true_ends(self, images: TaskImages, q_goal: FloatArray | None) -> Ends:
        """Return the true poses of the tool at start and goal, which may be carried along, then displaced."""
        truth = self.truth
        if q_goal is None:
            return Ends(truth.robot.base_tool, np.full((4, 4), np.nan), np.full(4, np.nan))
        found = truth.ends(q_goal)
        if len(carriers := images.goal.carriers) == 1:
            T = self._carried(carriers[0] if images.goal.incidences else len(self.inputs.carriers))
            found = found._replace(goal_pose=T @ found.goal_pose, goal=T @ found.goal)
        return self._displaced(images, found)

    def _carried(self, carrier: int) -> FloatArray:
        """Displacement (4, 4) of a carrier since the goal was taught; of the scene none."""
        placed = self.inputs.carriers[carrier - 1].placed if carrier else None
        return np.eye(4) if placed is None else placed.T

    def _displaced(self, images: TaskImages, ends: Ends) -> Ends:
        """Return the true ends of a task with its goal displaced, if requested."""
        asked, truth = self.inputs.displaced, self.truth
        if asked is None or not len(images.body.M):
            return ends
        body = make_body(truth.model, truth.of(self.numbers))
        H = ends.goal_pose @ np.linalg.inv(ends.base_tool)
        metre = metres_a_unit(truth.model, body.M[: self.m], self.inputs.lengths)
        shows = np.isfinite((images.s_start if asked.of_start else images.s_star)[..., 0])
        back = displacement_back(truth.model, body, H, positioned(asked, self.numbers), shows, metre)
        return Ends(ends.base_tool, back @ ends.goal_pose, back @ ends.goal)

    def true_motion(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As of all worlds."""
        placed = self.inputs.carriers[0].placed
        assert placed is not None
        back = np.linalg.inv(placed.T)
        return np.array([placed.at(one) @ back for one in t.tolist()]), (placed.X @ placed.T.T).mean(axis=0)

    def nearest_ends(self, images: TaskImages, ends: Ends, plant: Plant, H: FloatArray) -> Ends:
        """Return true ends, of goals of incidences with the one nearest to the displacement H (4, 4)."""
        if not images.goal.incidences or not np.isfinite(ends.goal_pose).all():
            return ends
        truth, on_tool = self.truth, plant.model.on_tool
        H_taught = ends.goal_pose @ np.linalg.inv(ends.base_tool)
        body = make_body(truth.model, truth.of(self.numbers))
        at, carriers = np.linalg.inv(H_taught) if on_tool else H_taught, images.goal.carriers
        scenes = list[FloatArray]()
        for one in images.goal.incidences:
            T, M = self._carried(one.carrier), body.M
            there = M @ (T @ at if len(carriers) > 1 else at).T
            if one.carrier and (placed := self.inputs.carriers[one.carrier - 1].placed) is not None:
                there = np.concatenate([there, placed.X @ T.T])
            scenes.append(points_of(there, one.scene))
        rows = incidences_of(truth.model, body, scenes, images.goal.incidences)
        H = nearest_goal(rows, body, H, _point_velocities)
        pose = (np.linalg.inv(H) if on_tool else H) @ ends.base_tool
        return Ends(ends.base_tool, pose, H @ np.array(center_of(plant.M, plant.center)))

    def averaged_images(self, images: TaskImages, q_taught: FloatArray | None, seed: int) -> TaskImages:
        """Start and taught goal with the noise of a seed; given images of the goal stay as they are."""
        sigma = self.inputs.noise.at_rest_px
        if sigma == 0.0:
            return images
        m, others, draw = self.m, self.truth.pins, self.truth.noise.draw
        which = [others.index(self.truth.number.index(number)) for number in self.numbers[m:]]
        s = np.array([images.s_start, images.s_star])
        drawn, V = 2 if self.goal_images is None else 1, len(self.view)  # given images stay as they are
        s[:drawn, :, :m] += sigma * draw(generator(seed, TARGET_NOISE), (drawn, V, m, 2))
        if which:
            noise = draw(generator(seed, PIN_TARGET_NOISE), (drawn, V, len(others), 2))
            s[:drawn, :, m:] += sigma * noise[:, :, which]
        return images._replace(s_start=s[0]).to(s[1])

    def _observed_now(
        self, carrier: CarryingObject, session: Session | None, q_start: FloatArray
    ) -> ObjectView:
        assert carrier.placed is not None
        return self._object(carrier.placed, OBJECT_NOW, carrier.placed.T)

    def _observed_before(self, carrier: CarryingObject, q_taught: FloatArray | None) -> ObjectView:
        assert carrier.placed is not None
        return self._object(carrier.placed, OBJECT_TAUGHT, np.eye(4))

    def _object(self, placed: SceneObject, stream: int, T: FloatArray) -> ObjectView:
        """Images of an object displaced by T (4, 4) since the goal was taught."""
        s = placed.images(self.truth, T)
        noise = self.inputs.noise.at_rest_px
        s += noise * self.truth.noise.draw(generator(self.inputs.seed, stream), s.shape)
        return ObjectView(s, np.full(s.shape[:2], noise) if noise > 0.0 else None)

    def metric_model(self, law: str) -> Model:
        """Return the true model."""
        return self.truth.model

    @property
    def knows_limits(self) -> bool:
        """Whether a path through joint space can be searched: always."""
        return True

    def plant(
        self, q_start: FloatArray, images: Callable[[], TaskImages], *, pins: bool, opaque: bool
    ) -> Plant:
        """Return the true robot, undisturbed, from joints (n,)."""
        found = plant_of(self.truth, q_start, opaque=opaque, min_views=self.min_views)
        return found._replace(pins=self.truth.of(self.numbers[self.m :]) if pins else NO_PINS)

    def noise(self, numbers: Sequence[int], seed: int, times: int) -> FloatArray:
        """Pixel noise (instants, V, markers, 2) of a seed, px, for markers of which the face comes first.

        It is the same for every law; fewer instants are the first of more.
        """
        noise = np.zeros((times, len(self.view), len(numbers), 2))
        sigma, draw = self.inputs.noise.servo_px, self.truth.noise.draw
        if sigma > 0.0:
            for these, stream in ((slice(self.m), SERVO_NOISE), (slice(self.m, None), PIN_NOISE)):
                if noise[:, :, these].size > 0:
                    drawn = draw(generator(seed, stream), noise[:, :, these].shape)
                    np.multiply(sigma, drawn, out=noise[:, :, these])
        return noise

    def require_ready(self) -> None:
        """Drive a simulated robot with any calibration."""

    def opened(
        self, session: Session, contract: Contract, q_start: FloatArray, plant: Plant, given: Robot | None
    ) -> Steered:
        """Open the simulated robot of a contract at joints (n,)."""
        return session.steered or session.opened(self._robot(contract, q_start, plant))

    def _robot(self, contract: Contract, q_start: FloatArray, plant: Plant) -> PluginRobot:
        """Make the simulated robot of a contract at joints (n,), which observes all markers."""
        truth, driven = self.truth, contract.driven
        face, others, workspace = list(truth.face), list(truth.pins), np.zeros_like(plant.M)
        assert isinstance(driven.robot, SimulatedRobot)

        def see(q: FloatArray, M: FloatArray) -> FloatArray:
            """Return the pixels of markers (m, 4) in all views at joints (n,)."""
            s, ordered = np.zeros((2, len(truth.P), len(M), 2))
            H = mat(truth.displacement(q))
            observe(plant._replace(M=M[face], pins=M[others]), H, workspace, ordered, np.zeros(len(ordered)))
            s[:, face + others] = ordered
            return s

        points = Points(truth, see, False, self.inputs.noise.servo_px)
        drawn = self.inputs.seed, SERVO_NOISE
        robot: FaultyRobot = robot_of(driven.robot, q_start, points, drawn, contract.events)
        return simulated_robot(driven, self.joints, robot)

    def begin(
        self, driven: DrivenRobot, contract: Contract, q_start: FloatArray, *, blind: bool
    ) -> Finding | None:
        """Return at once: a simulated robot is at the start."""
        return None

    def judged(self, summary: Summary) -> Summary:
        """Return the summary of a run, whose success is known."""
        return summary

    def poses(
        self, plant: Plant, ends: Ends, H: FloatArray, reached: FloatArray | None, goal_joints: FloatArray
    ) -> TruePoses:
        """Return where the tool was at displacements H (k, 4, 4)."""
        center = np.asarray(H @ np.array(center_of(plant.M, plant.center)))[:, :3]
        moved = np.linalg.inv(H) if plant.model.on_tool else H
        return TruePoses(moved @ ends.base_tool, ends.goal_pose, center, {})


@dataclass(frozen=True, eq=False)
class RenderedWorld(SimulatedWorld):
    """A simulated robot before rendered cameras, which see tags."""

    scene: RenderedScene

    @property
    def noise_px(self) -> float:
        """Standard deviation of a coordinate of images in the loop, px."""
        return max(self.inputs.noise.servo_px, self.calibration.fit.sigma_fitted_px)

    def averaged_images(self, images: TaskImages, q_taught: FloatArray | None, seed: int) -> TaskImages:
        """Start and goal as rendered frames show them; images of the goal that are given stay as they are.

        The body is fitted to both by the deviations of their pixels, whichever is the larger. Markers of the
        face that frames do not show are predicted from those that they show.
        """
        given, carriers = self.goal_images, self.inputs.carriers
        start, sigma = self._frames(self.scene, images.q_start, (seed, START_FRAMES))
        if given is None:
            assert q_taught is not None
            at_first = carriers[0].at_first if carriers else None
            goal, there = self._frames(at_first or self.scene, q_taught, (seed, GOAL_FRAMES))
        else:
            deviations = given.deviations(self.numbers, self.inputs.markers.face, self.view)
            goal, there = images.s_star, np.array(deviations)
        sigma = np.fmax(sigma, there)
        start = self._with_face("task.start", start, images.q_start, images.q_start)
        goal = self._with_face("task.goal", goal, None, images.q_start)
        found = images._replace(s_start=start).to(goal)
        if not len(found.body.M):
            return found
        weight = weights(sigma, sigma[..., None])
        weight[np.isnan(sigma)] = _GUESSED
        return found._replace(body=found.body._replace(weight=weight))

    def _frames(
        self, scene: RenderedScene, q: FloatArray, drawn: tuple[int, int]
    ) -> tuple[FloatArray, FloatArray]:
        """Pixels (V, b, 2) in rendered frames at joints (n,), rad or m, and their deviations (V, b)."""
        which = [scene.numbers.index(number) for number in self.numbers]
        s, sigma = observed_in_frames(scene, self.inputs.noise.averaged_frames, q, drawn)
        return np.ascontiguousarray(s[:, which]), sigma[:, which]

    def _with_face(self, key: str, s: FloatArray, q: FloatArray | None, q_start: FloatArray) -> FloatArray:
        """Pixels (V, b, 2) with a whole face, at joints (n,) or, for None, at those that they show.

        In as many views as are to see the face; the others may show less. Raises WorkFailed where too little
        of the tool is seen.
        """
        unseen = np.isnan(s[..., 0])
        unseen[:, self.m :] = False
        if (~unseen.any(axis=1)).sum() >= self.min_views:
            return s
        view, k = np.argwhere(unseen)[0]
        known, much = self.calibration, np.isfinite(s[..., 0]).sum(axis=1) > CORNERS - 1
        if much.sum() >= self.min_views:
            unseen[~much] = False
            off = 0.0
            if q is None:
                q, off = joints_showing(known, self.numbers, s, q_start)
            if off <= NEAR_PX:
                there = predict(known, q[None])[0][:, known.indices_of(self.numbers)]
                return np.ascontiguousarray(np.where(unseen[..., None], there, s))
        raise WorkFailed(
            f"{key}: the {self.view[view]} camera does not see marker {self.numbers[k]} of the face, and too "
            "little else of the tool: turn it towards the cameras, or bring it nearer"
        )

    def _observed_now(
        self, carrier: CarryingObject, session: Session | None, q_start: FloatArray
    ) -> ObjectView:
        return self._object_frames(carrier, self.scene, q_start, OBJECT_NOW)

    def _observed_before(self, carrier: CarryingObject, q_taught: FloatArray | None) -> ObjectView:
        assert carrier.at_first is not None
        assert q_taught is not None
        return self._object_frames(carrier, carrier.at_first, q_taught, OBJECT_TAUGHT)

    def _object_frames(
        self, carrier: CarryingObject, scene: RenderedScene, q: FloatArray, stream: int
    ) -> ObjectView:
        """Images of an object in a scene, with the arm at joints (n,)."""
        which = [scene.numbers.index(number) for number in carrier.numbers]
        s, sigma = observed_in_frames(scene, self.inputs.noise.averaged_frames, q, (self.inputs.seed, stream))
        return ObjectView(s[:, which], sigma[:, which])


def _point_velocities(M: FloatArray, motions: FloatArray) -> FloatArray:
    """Return the velocities (3 m, 6) of metric points (m, 4) by motions (6, 4, 4), to measure these by."""
    return np.asarray(np.einsum("kab,mb->mak", motions, M)[:, :3].reshape(-1, COORDINATES))


@lru_cache(maxsize=2048)
def _simulated_ends(
    task: TaskSettings,
    types: str,
    truth: Truth,
    pins: tuple[int, ...],
    center: int,
    *,
    current: tuple[float, ...] | None,
) -> tuple[TaskImages, FloatArray | None]:
    """Return the images of the ends of a task, for any seed and noise, and the joints (n,) at the goal.

    current : present joints of the arm, if known.
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
    return task_images(task, types, numbers, (center, truth.view), images, turn, q_current=at)
