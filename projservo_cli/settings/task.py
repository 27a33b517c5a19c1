"""The task, the motion to its goal, and regions of the images that the motion keeps out of."""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import Annotated, Any, Literal, Self

from pydantic import (
    ConfigDict,
    Field,
    PlainSerializer,
    Strict,
    StrictBool,
    StrictInt,
    WithJsonSchema,
    WrapValidator,
)

from projservo_cli.records import InputError
from projservo_cli.settings.features import Feature, Name, Pair
from projservo_cli.settings.sections import (
    ByView,
    Count,
    JointVector,
    Note,
    NotNegative,
    Number,
    OneOf,
    Positive,
    Section,
    Vector2,
    Vector3,
    Whole,
)


class _Perturbation(Section):
    """A small displacement of the goal pose, in the tool frame."""

    translation_m: Vector3 = Field((0.0, 0.0, 0.0), description="translation along the axes of the tool")
    rotation_rad: Vector3 = Field((0.0, 0.0, 0.0), description="rotation vector in the axes of the tool")


_Pixels = tuple[Vector2 | None, ...]
_Deviations = tuple[NotNegative | None, ...]


_OF_SIGMA = re.compile(r"sigma_(.+)_px")  # key of the standard deviations of a view


def sigma_key(view: str) -> str:
    """Return the key of the standard deviations of a view."""
    return f"sigma_{view}_px"


def _pixels_or_deviations(value: Any, pixels: Callable[[Any], _Pixels]) -> _Pixels | _Deviations:
    """Entries under the name of a view, or numbers under the key of its deviations."""
    if not isinstance(value, (list, tuple)) or all(x is None or isinstance(x, (list, tuple)) for x in value):
        return pixels(value)
    for x in value:
        if isinstance(x, bool) or not (x is None or (isinstance(x, int | float) and 0.0 <= x < math.inf)):
            raise ValueError("must be a list of [u, v], or of deviations of at least 0")
    return tuple(None if x is None else float(x) for x in value)


_OfView = Annotated[
    _Pixels,
    WrapValidator(_pixels_or_deviations),
    PlainSerializer(lambda entries: entries, return_type=Any),
    WithJsonSchema({"type": "array"}),
]


class GoalImages(ByView):
    """Pixels of the face, and of further markers, at the goal, with their standard deviations.

    Cameras of other names have pixels under these, and deviations under ``sigma_NAME_px``.
    """

    __pydantic_extra__: dict[str, _OfView]
    markers: Annotated[tuple[Whole, ...], Field(min_length=1)] | None = Field(
        None, description="numbers of the markers; null: markers.face"
    )
    left: _Pixels | None = Field(
        None, description="u and v of each marker in the left image, px; null: unseen; others by their names"
    )
    right: _Pixels | None = Field(
        None, description="u and v of each marker in the right image, px; null: unseen"
    )
    sigma_left_px: _Deviations | None = Field(
        None, description="standard deviation of each marker in the left image; null: noise.servo_px"
    )
    sigma_right_px: _Deviations | None = Field(
        None, description="standard deviation of each marker in the right image; null: noise.servo_px"
    )
    joints: JointVector | None = Field(
        None, description="joint readings at the goal, from which task.start takes them if it names the file"
    )

    def contradictions(self) -> Iterator[Note]:
        """Yield images of no camera, and keys that are neither names of cameras nor of deviations."""
        yield from super().contradictions()
        if not self.view:
            yield (), "give left, right or other cameras by their names: the pixels of the markers there"
        if self.markers is not None and len({*self.markers}) < len(self.markers):
            yield ("markers",), "a number occurs here twice"
        for key, value in (self.model_extra or {}).items():
            named, numbers = _OF_SIGMA.fullmatch(key), any(isinstance(entry, float) for entry in value)
            if named is None and numbers:
                yield (key,), "unknown key; pixels are [u, v] per marker, deviations go under sigma_NAME_px"
            elif named is not None and any(isinstance(entry, tuple) for entry in value):
                yield (key,), "must be a list of standard deviations, one number per marker"
            elif named is not None and named[1] not in self.view:
                yield (key,), f"there are no pixels of {named[1]}"

    @property
    def view(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(key for key in self.by_view if not _OF_SIGMA.fullmatch(key))

    def side(self, key: str) -> tuple[Any, ...] | None:
        """Return the entries under the name of a camera, or under the key of its deviations; None without."""
        side: tuple[Any, ...] | None = getattr(self, key, None)
        return side

    def pixels(self, face: Sequence[int], view: Sequence[str]) -> dict[int, tuple[Vector2, ...]]:
        """Pixel of each marker in some views, NaN where unseen; ``face`` are numbers of its markers."""
        own, unseen = list(self.markers or face), (math.nan, math.nan)
        sides = [self.side(name) or (None,) * len(own) for name in view]
        each = zip(own, *sides, strict=True)
        return {number: tuple(at or unseen for at in pixels) for number, *pixels in each}

    def deviations(
        self, numbers: Sequence[int], face: Sequence[int], view: Sequence[str]
    ) -> list[list[float]]:
        """Standard deviation of markers in the images of some views, px; NaN if unknown."""
        own = list(self.markers or face)
        sides = [self.side(sigma_key(name)) or (None,) * len(own) for name in view]
        known = [dict(zip(own, side, strict=True)) for side in sides]
        return [[math.nan if (x := side.get(number)) is None else x for number in numbers] for side in known]

    def sigma_px(self, numbers: Sequence[int], face: Sequence[int]) -> float | None:
        """Standard deviation of a coordinate of markers of some numbers, rms; None if unknown."""
        known = [sigma**2 for side in self.deviations(numbers, face, self.view) for sigma in side]
        return None if any(map(math.isnan, known)) else math.sqrt(sum(known) / len(known))


class _ObjectImages(Section):
    """Pixels of the markers of objects, by the names of these."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, GoalImages]

    def of(self, name: str) -> GoalImages | None:
        """Pixels of an object; None without."""
        return (self.model_extra or {}).get(name)


class DisplacedAlong(OneOf):
    """A displacement back along a line, or from a plane along its normal, to the side that cameras see."""

    one_of = ("by_m", "by_px")
    along: Name = Field(description="name of a line or plane, if it is at the pose that is displaced")
    by_m: Number | None = Field(None, description="length; below 0 the other way; needs a known length")
    by_px: Number | None = Field(
        None,
        description="mean motion of the markers in the image in which they move most; below 0 the other way",
    )

    def of_kind(self) -> Iterator[Note]:
        """No amount to speak of."""
        if getattr(self, self.kind) == 0.0:
            yield (self.kind,), "must not be 0"

    def misplaced(self, features: Mapping[str, Feature]) -> str:
        """Return the reason why it is along none of these features; empty if it is along one."""
        if self.along not in features:
            return f"there is no feature {self.along}; features: {', '.join(features) or 'none'}"
        if features[self.along].on != "tool" and not isinstance(features[self.along].source, str):
            return (
                f"{self.along} is of markers of {features[self.along].on}: name a line or plane of the tool"
            )
        if not features[self.along].given("line", "plane"):
            return f"{self.along} is a point, which has no direction: name a line or a plane"
        return ""


class Goal(OneOf):
    """The goal: joint readings, a rotation about the roll axis of the rig, or images of the face."""

    one_of = ("joints", "roll_deg", "images")
    joints: JointVector | None = Field(None, description="joint readings at the goal")
    roll_deg: Number | None = Field(
        None, ge=-360, le=360, description="rotation from the start about the roll axis of the rig"
    )
    perturbation: _Perturbation | None = Field(
        None, description="small displacement of a goal that roll_deg gives, in the tool frame"
    )
    images: GoalImages | None = Field(None, description="pixels of the face at the goal")
    incidences: Annotated[tuple[Pair, ...], Field(max_length=20)] = Field(
        (),
        description="pairs of a feature of the tool and one of the scene, [pin, hole] or "
        "[pin, hole, parallel], perpendicular or an angle in deg, that are to meet; the rest of the pose is "
        "free. Empty: the whole pose",
    )
    on: Name | None = Field(
        None,
        description="object that the goal was taught on and is carried by; null: the object of the "
        "features of the scene, if any",
    )
    objects: _ObjectImages = Field(
        _ObjectImages(),
        description="pixels of objects when the goal was taught, by projservo teach",
    )
    displaced: DisplacedAlong | None = Field(
        None, description="displacement of this goal, such as a stand-off; alone, of the start"
    )

    @property
    def of_start(self) -> bool:
        """Whether it is the start, displaced."""
        return self.displaced is not None and not self.given(*self.one_of)

    def contradictions(self) -> Iterator[Note]:
        """No goal, or several; a perturbation of another one than by a rotation."""
        if not self.of_start:
            yield from super().contradictions()
        if self.perturbation is not None and self.roll_deg is None:
            yield ("perturbation",), "belongs to a goal given by roll_deg"


class _Approach(DisplacedAlong):
    """A displacement of a named goal."""

    to: Name = Field(description="name of the goal that is displaced")


class TaskStep(OneOf):
    """One step of a sequence: a motion, an action of the robot, or a time to wait."""

    one_of = ("to", "approach", "retreat", "act", "wait_s")
    to: Name | None = Field(None, description="name of the goal to go to")
    approach: _Approach | None = Field(None, description="go to a goal displaced along a feature")
    retreat: DisplacedAlong | None = Field(
        None, description="go back along a feature from where the arm stands"
    )
    act: Annotated[dict[Name, Number], Field(min_length=1)] | None = Field(
        None, description="actions of the robot class by their names, such as {gripper: 0.3}"
    )
    wait_s: Annotated[float, Strict(), Field(gt=0, le=3600)] | None = Field(
        None, description="time to hold the arm"
    )
    duration_s: Positive | None = Field(
        None, description="of a motion, such as one into contact; null: trajectory.duration_s"
    )

    def of_kind(self) -> Iterator[Note]:
        """A duration other than of a motion."""
        if self.duration_s is not None and not self.moves:
            yield ("duration_s",), "is of a motion: to, approach or retreat; the robot class times an action"

    @property
    def moves(self) -> bool:
        """Whether the arm moves by a law."""
        return self.kind in ("to", "approach", "retreat")

    @property
    def goal(self) -> str | None:
        """Name of the goal that it goes to, or that it approaches."""
        return self.to if self.approach is None else self.approach.to

    @property
    def label(self) -> str:
        """Name of the step, which others may have too."""
        if self.act is not None:
            return "_".join(self.act)
        return self.to or "_".join(filter(None, (self.kind.removesuffix("_s"), self.goal)))


CURRENT = "current"


def _start(value: Any, read: Callable[[Any], Any]) -> Any:
    """The word for the current joints, or joints."""
    del read  # which would name both kinds in every message
    return value if value == CURRENT else JointVector.model_validate(value)


class TaskSettings(Section):
    """A reaching task from ``start`` to ``goal``, or a sequence of them.

    ``start_offset`` moves the start alone: a goal that is a turn starts from the start without it.
    """

    start: Annotated[JointVector | Literal["current"], WrapValidator(_start)] = Field(
        description="joint readings at the start; current: where the arm stands, a simulated one at "
        "calibration.reference"
    )
    start_offset: JointVector | None = Field(
        None, description="offset of the start; the goal follows from the start without it"
    )
    goal: Goal
    goals: dict[Name, Goal] = Field({}, description="goals of the steps, by their names")
    steps: Annotated[tuple[TaskStep, ...], Field(max_length=100)] = Field(
        (), description="steps of a sequence, which one law drives; without goal it is the last of them"
    )

    def __hash__(self) -> int:  # mappings have none
        return hash((self.start, self.start_offset, self.goal))

    @property
    def start_joints(self) -> JointVector | None:
        """Joint readings at the start; None for where the arm stands."""
        return None if isinstance(self.start, str) else self.start

    @property
    def each_goal(self) -> dict[tuple[str, ...], Goal]:
        """Return the goal and the goals of the steps, by their places in the section."""
        return {("goal",): self.goal} | {("goals", name): goal for name, goal in self.goals.items()}

    @property
    def named_steps(self) -> dict[str, TaskStep]:
        """Return the steps by their names, with their numbers where several have one."""
        labels = [step.label for step in self.steps]
        names = [
            label if labels.count(label) == 1 else f"{k:02d}-{label}" for k, label in enumerate(labels, 1)
        ]
        return dict(zip(names, self.steps, strict=True))

    def at_step(self, name: str) -> Self:
        """Return the task of a step, which starts where the arm stands unless it is the first motion."""
        step = self.named_steps[name]
        first = next(one for one, step in self.named_steps.items() if step.moves) == name
        goal = self.goals[step.goal] if step.goal is not None else self._retreat(name)
        if step.approach is not None:
            amount = step.approach.model_dump(exclude={"to"})
            goal = goal.model_copy(update={"displaced": DisplacedAlong(**amount)})
        start = {} if first else {"start": CURRENT, "start_offset": None}
        return self.model_copy(update={**start, "goal": goal, "goals": {}, "steps": ()})

    def _retreat(self, name: str) -> Goal:
        """Return the start of a retreat, displaced: freedoms of the goal before stay free."""
        k = list(self.named_steps).index(name)
        before = [one.goal for one in self.steps[:k] if one.goal is not None]
        incidences = self.goals[before[-1]].incidences if before else ()
        return Goal(displaced=self.steps[k].retreat, incidences=incidences)

    def contradictions(self) -> Iterator[Note]:
        """An offset from nowhere, steps to unknown goals, and without a motion."""
        if self.start == CURRENT and self.start_offset is not None:
            yield ("start_offset",), "applies to joints: leave it out with start: current"
        for k, step in enumerate(self.steps):
            name = None if any(step.contradictions()) else step.goal
            if name is not None and name not in self.goals:
                known = ", ".join(self.goals) or "none"
                yield (
                    ("steps", k, step.kind),
                    f"there is no goal {name} under task.goals, nor a file {name}.yaml; goals: {known}",
                )
            elif step.approach is not None and name is not None and self.goals[name].displaced is not None:
                yield ("steps", k, "approach"), f"goal {name} is displaced itself: approach the other one"
        if self.steps and not any(step.given("to", "approach", "retreat") for step in self.steps):
            yield ("steps",), "no step moves the arm: give to, approach or retreat"


_Polygon = Annotated[tuple[Vector2, ...], Field(min_length=3, max_length=200)]


class KeptOut(ByView):
    """Region that an obstacle covers in the images, by their names: simple polygons, convex or not, px."""

    __pydantic_extra__: dict[str, _Polygon | None]

    left: _Polygon | None = Field(None, description="corners u and v in the left image, px; null: none")
    right: _Polygon | None = Field(None, description="corners u and v in the right image, px; null: none")
    occludes: StrictBool = Field(
        True,
        description="whether the obstacle may occlude markers other than the face, which stays outside",
    )

    def contradictions(self) -> Iterator[Note]:
        """No polygon, or one that is none."""
        yield from super().contradictions()
        if not self.by_view:
            yield (), "give left, right or both: the corners of the region that the obstacle covers there"
        for name, corners in self.by_view.items():
            if what := _not_simple(corners):
                yield (name,), what

    def polygons(self, view: Sequence[str]) -> list[_Polygon | None]:
        """Its polygon in each of the views, None for none. Raises InputError for another name."""
        if unknown := [name for name in self.by_view if name not in view]:
            raise InputError(f"trajectory.keep_out: {unknown[0]} is no view; the views are {', '.join(view)}")
        return [self.by_view.get(name) for name in view]


def _not_simple(corners: Sequence[Vector2]) -> str:
    """Return the reason why corners are no simple polygon; empty if they are one."""
    edges = list(zip(corners, (*corners[1:], corners[0]), strict=True))
    for (i, first), (j, second) in combinations(enumerate(edges), 2):
        if 1 < j - i < len(edges) - 1 and _meet(*first, *second):
            return (
                f"the edges from corners {i + 1} and {j + 1} meet: draw an outline that does not cross itself"
            )
    if sum(a[0] * b[1] - b[0] * a[1] for a, b in edges) == 0.0:
        return "the polygon has no area: its corners lie on one line"
    return ""


def _turn(a: Vector2, b: Vector2, c: Vector2) -> float:
    """Twice the area of a triangle, with its sense."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _meet(a: Vector2, b: Vector2, c: Vector2, d: Vector2) -> bool:
    """Whether the segments a–b and c–d have a point in common."""
    boxes_apart = any(max(a[i], b[i]) < min(c[i], d[i]) or max(c[i], d[i]) < min(a[i], b[i]) for i in (0, 1))
    if boxes_apart:
        return False
    return _turn(a, b, c) * _turn(a, b, d) <= 0.0 and _turn(c, d, a) * _turn(c, d, b) <= 0.0


class _Search(Section):
    """Limits and seed of the search of the profile ``joint_space``."""

    max_samples: Count = Field(20_000, description="maximum number of samples of the two search trees")
    seed: Whole = Field(0, description="seed of the search; the same seed gives the same path")


class Trajectory(Section):
    """Profile of the planned motion over the path parameter in [0, 1], and its constraints.

    ``joint_space`` plans a path through joint space to any goal configuration. ``auto`` takes ``linear`` if
    it meets every constraint, then ``constrained``, then ``joint_space``.
    """

    profile: Literal[
        "linear",
        "exponential",
        "rotation_first",
        "translation_first",
        "planar_first",
        "constrained",
        "joint_space",
        "auto",
    ] = Field("linear", description="order of the parts of the motion, or a path through joint space")
    visibility_fraction: Number = Field(
        0.9,
        gt=0,
        le=1,
        description="maximum translation or rotation ahead of the other, as a fraction of that at which "
        "visibility changes",
    )
    n_samples: StrictInt = Field(101, ge=2, le=100_001, description="number of stored points of the path")
    duration_s: Positive | None = Field(
        None, description="duration of the motion; null: the minimum within the joint-speed limit"
    )
    acceleration_time_s: NotNegative = Field(
        0.4, description="time of acceleration at the start, and of deceleration at the end"
    )
    border_px: NotNegative = Field(
        5.0,
        description="minimum distance of a marker from the image border, profiles constrained and "
        "joint_space",
    )
    min_reciprocal_condition: Number = Field(
        0.001,
        ge=0,
        lt=1,
        description="minimum reciprocal condition number of the image Jacobian of the face, profile "
        "constrained",
    )
    max_goal_configurations: Count = Field(
        64, description="maximum number of goal configurations, nearest in time, profile joint_space"
    )
    joint_margin_deg: NotNegative = Field(
        1.0, description="minimum distance from a joint limit, revolute joints, profile joint_space"
    )
    joint_margin_m: NotNegative = Field(
        0.002, description="minimum distance from a joint limit, prismatic joints, profile joint_space"
    )
    min_face_px: NotNegative = Field(
        8.0,
        description="minimum width of the face in an image, profile joint_space",
    )
    search: _Search = Field(_Search(), description="limits and seed of the search, profile joint_space")
    visible_views: Literal["all"] | Count = Field(
        "all",
        description="number of views that are to see the whole face at every instant; all of them",
    )
    keep_out: Annotated[tuple[KeptOut, ...], Field(max_length=100)] = Field(
        (),
        description="outlines of obstacles, each {left: [[u, v], ...], right: [[u, v], ...], "
        "occludes: true}, that no marker and no line between markers of the face enters",
    )

    @property
    def joint_margin(self) -> float:
        """Minimum distance from a limit, revolute joints, rad."""
        return math.radians(self.joint_margin_deg)

    @property
    def rehearses(self) -> bool:
        """Whether half turns are rehearsed; a search of the fractions compares both senses."""
        return self.profile not in ("constrained", "auto")

    @property
    def min_views(self) -> int | None:
        """Number of cameras that must see the whole face; None for all."""
        return None if self.visible_views == "all" else self.visible_views

    @property
    def needs_covariance(self) -> bool:
        """Whether a plan takes the covariance of the calibration: searches through joint space, regions."""
        return self.profile in ("joint_space", "auto") or bool(self.keep_out)
