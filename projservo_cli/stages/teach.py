"""Teach: images of a robot that the user has moved, as a goal or as a start."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from projservo_cli import messages
from projservo_cli.calibration.checks.validation import of_views
from projservo_cli.calibration.prediction import predict
from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject
from projservo_cli.hardware.checks_at_rest import MIN_SHARED
from projservo_cli.image_size import image_sizes
from projservo_cli.messages.rows_by_code import Setup
from projservo_cli.monitoring.fault_at_rest import fault_at_rest
from projservo_cli.records import (
    BoolArray,
    Calibration,
    FloatArray,
    InputError,
    IntArray,
    Observation,
    WorkFailed,
)
from projservo_cli.robots.contract import Bounds, PluginRobot, Reading, at_rest_after
from projservo_cli.robots.joint_limits import Joints
from projservo_cli.robots.standstill import observation_of_frames, seen_at_rest
from projservo_cli.settings.sections import JointVector
from projservo_cli.settings.task import Goal, GoalImages, TaskSettings, sigma_key
from projservo_cli.simulation.random_streams import TAUGHT_NOISE, generator
from projservo_cli.simulation.robot_with_faults import FaultyRobot, SimulatedRobot, robot_by_itself
from projservo_cli.stages import plan as planning
from projservo_cli.stages.record import shared_markers
from projservo_cli.stages.stage_inputs import OwnRobot, PlanInputs, TeachInputs
from projservo_cli.stages.worlds.external_robot import plugin_robot, simulated_robot, takes_limits
from projservo_cli.store.display import require_radians
from projservo_cli.task.objects.displaced_object import RIGID

_FAR = 4.0  # standard deviations by which a marker may err
_DIGITS = 4  # digits of written pixels
_SLACK = 1e-3  # rad or m; by how much more than it sags a reading may change
# From how far, rad or m, a simulated robot comes to where it is put, and how long it then rests, s.
_BESIDE, _AT_REST_S = 0.02, 3


@dataclass(frozen=True, eq=False)
class _Taught:
    """Readings of robot and cameras at the taught pose."""

    marker: IntArray  # (m,) numbers of the markers
    q: FloatArray  # (n,) mean of the joint readings, rad or m
    view: tuple[str, ...]  # names of the views
    s: FloatArray  # (V, m, 2) mean of the pixels, NaN where most frames do not show a marker
    sigma: FloatArray  # (V, m) standard deviation of a coordinate of that mean, px; NaN if unknown
    frames: IntArray  # (V,) how many there were of each view
    moved: FloatArray | None  # (n,) by how much joints moved when they were held again; None if never
    bounds: Bounds  # bounds of the robot, with the units of its joints
    seen: tuple[Observation, BoolArray]  # frames that they are the mean of, and which are new (K, V)

    objects: dict[str, "_Taught"] = field(default_factory=dict)  # objects that it saw, by their names

    @property
    def shared(self) -> int:
        """Number of markers that two cameras or more see; of one camera, that it sees."""
        return int(shared_markers(self.s).sum())

    @property
    def unseen(self) -> list[tuple[int, str]]:
        """Markers that a camera does not see, and which."""
        return [
            (int(self.marker[k]), self.view[v]) for v, k in np.argwhere(np.isnan(self.s[..., 0])).tolist()
        ]

    @property
    def images(self) -> GoalImages:
        """Return the images as the goal of a task."""
        pixels = {
            name: tuple(None if math.isnan(u) else (u, v) for u, v in side.round(_DIGITS).tolist())
            for name, side in zip(self.view, self.s, strict=True)
        }
        sigma = {
            sigma_key(name): tuple(None if math.isnan(x) else x for x in side.round(_DIGITS).tolist())
            for name, side in zip(self.view, self.sigma, strict=True)
            if np.isfinite(side).any()
        }
        numbers = tuple(self.marker.tolist())
        joints = JointVector(joints=self.q.tolist(), unit="rad") if len(self.q) else None
        return GoalImages.model_validate({"markers": numbers, **pixels, **sigma, "joints": joints})

    def as_goal(self) -> dict[str, Any]:
        """Return the section ``task.goal`` of a configuration."""
        of_objects = {name: one.images.model_dump(mode="json", exclude_none=True) for name, one in self._seen}
        images = {"images": self.images.model_dump(mode="json", exclude_none=True)}
        return images | ({"objects": of_objects} if of_objects else {})

    @property
    def _seen(self) -> list[tuple[str, "_Taught"]]:
        """Names and images of the objects of which anything is seen."""
        return [(name, one) for name, one in self.objects.items() if np.isfinite(one.s).any()]


class _Checked(NamedTuple):
    """Comparison of a taught pose with a calibration."""

    off_px: FloatArray  # (V, m) error of markers against the joints that reach it, otherwise the joints read
    far: list[tuple[int, str, float]]  # markers that noise does not explain, view, distance, px
    reached: bool
    reason: str  # whether joints reach it, in words
    findings: tuple[Finding, ...]  # likewise


def teach(
    inputs: TeachInputs,
    frames: int,
    at: JointVector | None = None,
    wait: Callable[[str], None] | None = None,
) -> _Taught:
    """Observe the robot in its present pose, and average frames of each camera.

    at : joints that a simulated robot is put to.
    wait : asks the user to act, and returns afterwards; None without a user, so that
        the arm is not released.
    Raises InputError if ``at`` is missing, does not fit or is beyond a limit, or an arm without limits would
    have to hold; WorkFailed if the robot fails.
    """
    (robot, q), moved = _robot_to_teach(inputs, at, by_hand=wait is not None), None
    period = robot.bounds.period

    def observe() -> Reading:
        """A look after a period, in which a simulated robot holds where it was put to."""
        if q is None:
            time.sleep(period)
        else:
            robot.command(q, np.zeros_like(q), robot.now() + period)
        return robot.read().whole

    with at_rest_after(robot):
        if wait is not None and robot.lets_go:
            wait("take hold of the arm: it will be released")
            robot.by_hand("release")
            wait("move it to where it is to be: it will be held there")
            moved = robot.read().q
            robot.by_hand("hold")
        if wait is not None:
            wait("take your hands away")
        rest, mean, sigma, count, looks = seen_at_rest(robot, observe, frames, inputs.settle_s, "teach")
        stood = rest.q if moved is None else moved
        code = "moved_in_images" if moved is None else "moved_since_held"
        _require_still(robot.bounds, stood, robot.read().q, code)
    tool = _Taught(
        marker=np.array(inputs.numbers, dtype=np.int64),
        q=mean.q,
        view=robot.view,
        s=mean.s[:, : len(inputs.numbers)],
        sigma=sigma[:, : len(inputs.numbers)],
        frames=count.max(axis=1),
        moved=None if moved is None else mean.q - moved,
        bounds=robot.bounds,
        seen=observation_of_frames(looks, np.array(inputs.numbers, dtype=np.int64)),
    )
    begin, objects = len(inputs.numbers), dict[str, _Taught]()
    for name, one in inputs.objects.named.items():
        numbers = one.numbers
        own, begin = slice(begin, begin + len(numbers)), begin + len(numbers)
        marker, nowhere = np.array(numbers, dtype=np.int64), np.zeros(0)
        objects[name] = replace(tool, marker=marker, q=nowhere, s=mean.s[:, own], sigma=sigma[:, own])
    return replace(tool, objects=objects)


def _robot_to_teach(
    inputs: TeachInputs, at: JointVector | None, *, by_hand: bool
) -> tuple[PluginRobot, FloatArray | None]:
    """Return the robot, and the joints (n,), rad or m, that a simulated one was put to.

    by_hand : whether a user moves it, so that it must hold again after its release.
    """
    joints, driven = inputs.joints.joints(), inputs.driven
    if not isinstance(driven.robot, OwnRobot):
        if at is None:
            raise InputError("teach puts a simulated robot to --at q1,...,qN: give the joints")
        q = _within_limits(at, joints)
        return simulated_robot(driven, joints, _put_to(inputs, driven.robot, q)), q
    if at is not None:
        raise InputError("--at is where a simulated robot is put to; move yours by hand")
    bounds = driven.following.bounds(joints)
    robot = plugin_robot(driven.robot, bounds, joints.types, inputs.numbers, further=driven.further)
    if by_hand and robot.lets_go and takes_limits(driven.robot):
        _require_limits(joints)
    return robot, None


def _require_limits(joints: Joints) -> None:
    """Refuse with an InputError to release an arm that would not hold again without limits."""
    for i in np.flatnonzero(~np.isfinite([joints.limits.lower, joints.limits.upper]).all(axis=0)).tolist():
        raise InputError(
            f"teach: joint {i + 1} has no limits, without which the arm would not hold again: nothing was "
            "released; run projservo limits -c FILE first, or set robot.limits.joints"
        )


def _within_limits(at: JointVector, joints: Joints) -> FloatArray:
    """The joints (n,) of ``--at``, rad or m. Raises InputError if the robot cannot be put there."""
    if len(at.joints) != len(joints.types):
        raise InputError(f"--at: {len(at.joints)} numbers for {len(joints.types)} joints: give one for each")
    q = at.values(joints.types)
    for i in np.flatnonzero(~np.isfinite(q)).tolist():
        raise InputError(f"--at: joint {i + 1} is {q[i]}: give a finite number")
    if wrong := joints.limit_passed(q):
        if at.unit == "rad":
            require_radians("--at", q, joints.types, "set --at-unit deg")
        raise InputError(f"--at: {messages.sentence(wrong)}: choose others")
    return q


def _require_still(bounds: Bounds, before: FloatArray, after: FloatArray, code: str) -> None:
    """Raise WorkFailed, a finding of a code, if a joint has moved by more than it may sag."""
    off, most = np.abs(after - before), bounds.sag + _SLACK
    i = int(np.argmax(off / most))
    if off[i] > most[i]:
        found = Finding(code, REFUSES, Subject(joints=(i + 1,)), off[i], limit=most[i], unit=bounds.unit(i))
        raise messages.failed([found], end="; nothing was written", stage="teach")


def _put_to(inputs: TeachInputs, simulated: SimulatedRobot, q: FloatArray) -> FaultyRobot:
    """Move the simulated robot to rest at joints (n,), rad or m, from one side, so that backlash shows."""
    arm, drawn = simulated.truth.robot, (inputs.seed, TAUGHT_NOISE)
    aside = generator(*drawn).choice((-_BESIDE, _BESIDE), len(q))
    aside = np.clip(q + aside, arm.limits.lower, arm.limits.upper)
    robot = robot_by_itself(simulated, aside, inputs.noise_px, drawn)
    for second in range(1, 1 + _AT_REST_S):
        robot.command(q, np.zeros_like(q), float(second))
    return robot


def checked(inputs: PlanInputs, calibration: Calibration, taught: _Taught) -> _Checked:
    """Tell whether joints reach the taught pose, by a calibration, and which markers disagree.

    inputs : of a plan from anywhere; taught : with the whole face.
    """
    if missing := [name for name in calibration.view if name not in taught.view]:
        raise InputError(
            f"teach: the calibration has a camera {missing[0]}, the robot {', '.join(taught.view)}: name the "
            "cameras as in the recording"
        )
    views = [taught.view.index(name) for name in calibration.view]
    s, sigma = taught.s[views], taught.sigma[views]
    joints = inputs.joints.joints(calibration.joint_types, calibration)
    within = np.clip(taught.q, joints.limits.lower, joints.limits.upper)
    start = JointVector(joints=within.tolist(), unit="rad")
    limits = np.concatenate([joints.limits.lower, joints.limits.upper, joints.limits.speed])
    markers = calibration.marker.tolist()
    # No path is searched for joints of unknown limits: the arm is at the goal already.
    profile = "joint_space" if np.isfinite(limits).all() else "linear"
    border = inputs.trajectory.border_px + 1.0  # beyond the pixels of the goal, if the size is not known
    seen_px = np.ceil(np.nanmax(s, axis=1) + border).astype(int).tolist()
    asked = replace(
        inputs,
        seen_px=tuple((width, height) for width, height in seen_px),
        task=TaskSettings(start=start, goal=Goal(images=taught.images)),
        incidences=tuple(one._replace(carrier=0) for one in inputs.incidences if one.visible_by(markers)),
        carriers=(),
        displaced=None,
        trajectory=inputs.trajectory.model_copy(update={"profile": profile, "keep_out": ()}),
    )
    frames, fresh = taught.seen
    frames, fresh = of_views(frames, calibration.view), fresh[:, views]
    size, noise_px = image_sizes(inputs.image_size, calibration.view), inputs.noise.servo_px
    try:
        if fault := fault_at_rest(calibration, frames, size, sigma_px=noise_px, fresh=fresh):
            setup = messages.setup_of(calibration)
            raise messages.failed([fault], setup, "; teach it again", stage=planning.CHANGED)
        plan = planning.run(asked, calibration)
        reached, reason, found = plan.feasible, plan.reason, plan.findings
        q = plan.q[-1] if reached else taught.q
    except WorkFailed as error:
        reached, reason, found, q = False, str(error), error.findings, taught.q
    numbers = taught.marker.tolist()
    known_to_both = np.flatnonzero(np.isin(numbers, calibration.marker))
    off = np.full(sigma.shape, np.nan)
    expected = predict(calibration, q[None])[0][:, calibration.indices_of(taught.marker[known_to_both])]
    off[:, known_to_both] = np.linalg.norm(s[:, known_to_both] - expected, axis=2)
    noise = np.maximum(np.nan_to_num(sigma), calibration.sigma_px)
    far = [
        (numbers[k], calibration.view[view], float(off[view, k]))
        for view, k in np.argwhere(off > _FAR * math.sqrt(2.0) * noise).tolist()
    ]
    return _Checked(off, far, reached, reason, found)


def require_start(taught: _Taught) -> None:
    """Refuse a start from which nothing can be recorded, since cameras see too little; a WorkFailed."""
    if taught.shared < MIN_SHARED:
        counts = zip(taught.view, np.isfinite(taught.s[..., 0]).sum(axis=1), strict=True)
        seen = [Finding("seen", subject=Subject(views=(name,)), amount=count) for name, count in counts]
        parts = Finding("share", amount=MIN_SHARED, unit="1"), *(seen if len(seen) > 1 else ())
        few = Finding(
            "few_shared", REFUSES, amount=taught.shared, limit=len(taught.marker), unit="1", others=parts
        )
        raise messages.failed([few], Setup(view=taught.view), stage="teach")


def require_objects(taught: _Taught, *, one_goal: bool) -> Finding | None:
    """Return the object that shows too little to carry a goal along, or that all are out of sight, or None.

    one_goal : whether there is no other goal, so that this one is on an object; a WorkFailed says it then.
    """
    seen = {name: _seen_of(one) for name, one in taught.objects.items()}
    for name, numbers in seen.items():
        if 0 < len(numbers) < RIGID or not any(seen.values()):
            subject = Subject(markers=tuple(numbers), name=name)
            hidden = Finding("hidden_object", LIMITS, subject, len(numbers), limit=RIGID, unit="1")
            if one_goal:
                refusing = replace(hidden, severity=REFUSES)
                raise messages.failed([refusing], Setup(view=taught.view), stage="teach")
            return hidden
    return None


def _seen_of(one: _Taught) -> list[int]:
    """Numbers of the markers of an object that a camera sees."""
    found: list[int] = one.marker[np.isfinite(one.s[..., 0]).any(axis=0)].tolist()
    return found


def require_face(face: Sequence[int], taught: _Taught, min_seen: int | None = None) -> None:
    """Raise WorkFailed unless enough cameras see the whole face.

    min_seen : number of cameras; None for all.
    """
    enough = np.isfinite(taught.s[..., 0]).sum(axis=0) >= (min_seen or len(taught.view))
    shared = {*taught.marker[enough].tolist()}
    if unseen := [(number, side) for number, side in taught.unseen if number in {*face} - shared]:
        number, side = unseen[0]
        hidden = Finding("hidden_face", REFUSES, Subject(views=(side,), markers=(number,)))
        raise messages.failed([hidden], Setup(view=taught.view), stage="teach")
