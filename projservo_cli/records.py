"""The named arrays that pass from stage to stage, and the model every kernel reads.

Records hold plain arrays with documented shapes and units. ``_array`` attaches the names of the
dimensions and the unit to a field, so that the run file can label its arrays; this module
knows how it is stored.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from functools import cache
from typing import Any, NamedTuple, TypeVar, get_args, get_origin

import numpy as np
import numpy.typing as npt

from projservo_cli.deviations import DEVIATIONS
from projservo_cli.findings import LIMITS, Finding, Subject
from projservo_cli.passwords import masked

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
ByteArray = npt.NDArray[np.uint8]

VIEWS = ("left", "right")
# Name of a view, as in the columns u_NAME, v_NAME, in small letters of any language, and of one word or more;
# q alone belongs to joint readings: t_q is their time.
VIEW_NAME = r"(?!q$)[^\W_](?: ?\w)*"
WORLD, TOOL = "world", "tool"  # where the cameras are mounted: the markers are on the other
MM = 1e3  # mm in a metre
TWO_TURNS = 4.0 * np.pi  # rad; no revolute joint of an arm with stops turns that far from its zero
FARTHEST_M = 20.0  # no prismatic joint that two cameras watch goes farther
# Features of an incidence, by the number of points that span one, and how two of them are to lie.
KINDS = ("point", "line", "plane")
MEET, PARALLEL, PERPENDICULAR, ANGLE = "meet", "parallel", "perpendicular", "angle"
CORNERS = 4  # corners of a tag: corner k of tag t is marker 4 t + k
# Reasons of rejected markers: a marker is fixed in the images, on another body, slips, or hardly any
# of its readings fits.
WHY_LOST = ("still", "other body", "drifting", "hardly seen")

# Dimensions that have the same size in every record.
SIZES = {
    "xy": 2,
    "image_row": 3,
    "row": 4,
    "span": 3,
    "coordinate": 4,
    "axis": 3,
    "own": 3,
    "pair_end": 2,
    "part": 3,
    "solution": 2,
    "lens_term": 5,
    "outlier_column": 3,
    "suspect_column": 2,
    "moved_column": 2,
    "id_switch_column": 3,
    "rejected_marker_column": 2,
    "law": 2,
    "operators": 2,
    "limit": 2,
    "end": 2,
    "model_error_column": 4,
    "refit_column": 3,
    "joint_curve_column": 7,
    "with_or_without": 2,
    "joint_curve_part": 5,
}


# Remedy for a robot without joint limits.
LIMITS_MISSING = "set robot.limits, such as {from_data: 0.1}, or limits in robot.dh or robot.screws"


def _array(dims: str, units: str = "1", about: str = "", **default: Any) -> Any:
    """Declare an array field: the names of its dimensions, its unit and meaning."""
    return field(metadata={"dims": tuple(dims.split()), "units": units, "about": about}, **default)


def _scalar(units: str = "1", about: str = "", **default: Any) -> Any:
    """Declare a scalar or text field with its unit and meaning."""
    return field(metadata={"units": units, "about": about}, **default)


def _optional_array(dims: str, units: str = "1", about: str = "") -> Any:
    """Declare an array field that is None if there is none."""
    return _array(dims, units, about, default=None)


def _optional_scalar(units: str = "1", about: str = "") -> Any:
    """Declare a scalar or text field that is None if there is none."""
    return _scalar(units, about, default=None)


def _by_view(about: str, **default: Any) -> Any:
    """Declare a tuple of numbers, one per view; files and JSON name each by field and view."""
    return field(metadata={"units": "1", "about": about, "by_view": True}, **default)


_Found = TypeVar("_Found")


def _kept(function: Callable[[Any], _Found]) -> Callable[[Any], _Found]:
    """Cache the result of a function of a class, which mypy takes for unhashable."""
    return cache(function)


class RecordPart:
    """Base of a part of a record, whose fields are among the fields of the record in files and JSON."""


def part_of(entry: "Field[Any]") -> type[RecordPart] | None:
    """Kind of the part that a field holds; None of a field of another type."""
    kinds = (entry.type, *get_args(entry.type))
    return next((kind for kind in kinds if isinstance(kind, type) and issubclass(kind, RecordPart)), None)


def is_optional(entry: "Field[Any]") -> bool:
    """Tell whether a field is None if there is none."""
    return type(None) in get_args(entry.type)


def is_list(entry: "Field[Any]") -> bool:
    """Tell whether a field holds a list of parts, the first of which is among the fields of the record."""
    return part_of(entry) is not None and get_origin(entry.type) is tuple


def has_default(entry: "Field[Any]") -> bool:
    """Tell whether a field has a default."""
    return entry.default is not MISSING


@_kept
def flat_fields(kind: Any) -> tuple["Field[Any]", ...]:
    """Fields of a kind of record as files have them: with the fields of each part in its place."""
    found: list[Field[Any]] = []
    for entry in fields(kind):
        part = part_of(entry)
        found += [entry] if part is None else flat_fields(part)
    return tuple(found)


@_kept
def optional_names(kind: Any) -> frozenset[str]:
    """Names of the fields of those parts of a kind of record that may be absent."""
    parts = [part_of(entry) for entry in fields(kind) if is_optional(entry) or is_list(entry)]
    return frozenset(entry.name for part in parts if part for entry in flat_fields(part))


@_kept
def _parts_of(kind: Any) -> dict[str, str]:
    """Names that parts of a kind of record have, each with the name of the field that holds the part."""
    found: dict[str, str] = {}
    for entry in fields(kind):
        if (part := part_of(entry)) is not None:
            names = {*dir(part), *(inner.name for inner in flat_fields(part))}
            found |= {name: entry.name for name in names if not name.startswith("_")}
    return found


class Composite:
    """Base of a record of parts: their attributes are attributes of the record, too."""

    def __getattr__(self, name: str) -> Any:
        """Attribute of a part, of a list of the first; its default if it is absent."""
        place = _parts_of(type(self)).get(name)
        if place is None:
            raise AttributeError(f"{type(self).__name__} has no {name}")
        part = getattr(self, place)
        if isinstance(part, tuple):
            part = part[0] if part else None
        if part is not None:
            return getattr(part, name)
        defaults = (entry.default for entry in flat_fields(type(self)) if entry.name == name)
        default = next(defaults, None)
        return None if default is MISSING else default

    def __dir__(self) -> Iterable[str]:
        return sorted({*super().__dir__(), *_parts_of(type(self))})


_Record = TypeVar("_Record")


def composed(kind: Any, values: Mapping[str, Any]) -> Any:
    """Make a record of values of its flat fields; an optional part is absent without a required one.

    values : of a list of parts those after the first, by its own name.
    """
    own: dict[str, Any] = {}
    for entry in fields(kind):
        part = part_of(entry)
        if part is None and entry.name in values:
            own[entry.name] = values[entry.name]
        elif part is not None:
            needed = (one.name for one in flat_fields(part) if not (is_optional(one) or has_default(one)))
            many, known = is_list(entry), any(values.get(name) is not None for name in needed)
            there = known or not (many or is_optional(entry))
            own[entry.name] = composed(part, values) if there else None
            if many:
                own[entry.name] = (own[entry.name], *values.get(entry.name, ())) if there else ()
    return kind(**own)


def changed(record: _Record, **values: Any) -> _Record:
    """Return a record with other values of some fields, its own or of its parts.

    Of a list of parts the first is meant.
    """
    own: dict[str, Any] = {}
    of_parts: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        place = _parts_of(type(record)).get(name)
        (own if place is None else of_parts.setdefault(place, {}))[name] = value
    for place, inner in of_parts.items():
        part_or_parts = getattr(record, place)
        first, *others = part_or_parts if isinstance(part_or_parts, tuple) else (part_or_parts,)
        part = replace(first, **inner)
        own[place] = (part, *others) if isinstance(part_or_parts, tuple) else part
    return replace(record, **own)  # type: ignore[type-var]  # records are dataclasses


def scalars_of(record: Any) -> dict[str, Any]:
    """All fields of a record but its arrays, by their names in files and JSON."""
    found: dict[str, Any] = {}
    for entry in flat_fields(type(record)):
        value = getattr(record, entry.name)
        if "by_view" in entry.metadata:
            names = (f"{entry.name}_{view}" for view in record.view)
            found |= zip(names, value, strict=True)
        elif "dims" not in entry.metadata:
            found[entry.name] = value
    return found


class InputError(ValueError):
    """Usage, configuration or data that cannot be read or make no sense (exit code 2).

    The message is one line a user can act on: place, error and remedy.
    """

    def __init__(self, *args: object) -> None:
        super().__init__(*masked(args))


class WorkFailed(RuntimeError):  # noqa: N818 - a verdict, not a programming error
    """The data were read, but the work they ask for cannot be done (exit code 1).

    stage : the work that failed, with which the text begins.
    refutes : whether images or readings of a robot contradict its calibration, and so the recording of it.
    findings : the evidence as data.
    """

    def __init__(
        self, text: object = "", *, stage: str = "", refutes: bool = False, findings: Iterable[Finding] = ()
    ) -> None:
        (self.reason,) = masked((str(text),))
        super().__init__(f"{stage}: {self.reason}" if stage else self.reason)
        self.refutes, self.findings = refutes, tuple(findings)


def board_numberings(rows: int, columns: int) -> IntArray:
    """Indices (g, N) of the corners of a board by each numbering of it turned, the first as it is."""
    index = np.arange(rows * columns).reshape(rows, columns)
    return np.stack([np.rot90(index, k).ravel() for k in range(0, 4, 1 if rows == columns else 2)])


ONLY = "camera"
"""Name of the camera of a file of intrinsics that is given without one, where there is but one."""

LEAST_CORNERS = 2
"""Minimum number of corners in a row or a column of a board."""


class StatedBoard(NamedTuple):
    """A board whose corners are markers, row by row, and whose shape is known."""

    first: int  # number of the marker at its first corner
    columns: int  # of corners
    rows: int
    pitch_m: float | None = None  # distance of neighbouring corners, m, or of rows if staggered, if known
    staggered: bool = False  # whether corners of a row are two pitches apart, and odd rows one pitch on

    @classmethod
    def of(cls, values: Sequence[float]) -> "StatedBoard":
        """Return the board of three to five numbers. Raises InputError if they are none."""
        known = 3 <= len(values) <= 5
        more = (math.nan, 0.0)[len(values) - 3 :]
        first, columns, rows, pitch, staggered = (*values, *more) if known else (-1, 0, 0, 0, 0)
        whole = [round(number) for number in (first, columns, rows) if math.isfinite(number)]
        if whole != [first, columns, rows] or first < 0 or min(whole[1:]) < LEAST_CORNERS or pitch <= 0.0:
            raise InputError(
                f"boards: {values!r:.60}: give the number of the first marker, columns and rows of corners "
                f"({LEAST_CORNERS} or more), and perhaps the distance of neighbouring corners, m"
            )
        return cls(whole[0], whole[1], whole[2], None if math.isnan(pitch) else float(pitch), bool(staggered))

    @property
    def longest(self) -> tuple[int, int]:
        """Numbers of the markers at its first and its last corner, farthest apart."""
        return self.first, self.first + self.columns * self.rows - 1

    def positions_of(self, markers: IntArray) -> FloatArray:
        """Places (m, 2) of markers by their numbers, in pitches along rows and columns; NaN for others."""
        at = np.asarray(markers) - self.first
        u, v = at % self.columns, at // self.columns
        positions = np.stack([2 * u + v % 2 if self.staggered else u, v], axis=1).astype(np.float64)
        positions[(at < 0) | (at >= self.columns * self.rows)] = np.nan
        return positions


def no_lenses(views: int) -> FloatArray:
    """Lenses (V, 5) that do not distort."""
    return np.tile([0.0, 0.0, 1.0, 0.0, 0.0], (views, 1))


class JointLimits(NamedTuple):
    """Limits of joints, (n,) each; infinite for none."""

    lower: FloatArray  # rad or m
    upper: FloatArray  # rad or m
    speed: FloatArray  # rad/s or m/s
    acceleration: FloatArray  # rad/s² or m/s²


def prismatic_of(letters: Iterable[str]) -> BoolArray:
    """Tell which joints (n,) are prismatic, by one letter each, R or P, as users and files write them."""
    return np.array([letter == "P" for letter in letters], dtype=np.bool_)


def letters_of(prismatic: Iterable[bool]) -> str:
    """Return one letter a joint, R or P, of joints (n,) that are prismatic or not."""
    return "".join("P" if slides else "R" for slides in prismatic)


def coordinate_names(flange_chart: FloatArray | None) -> tuple[str, ...]:
    """Names of the coordinates of poses of a flange, by their chart (2, 4, 4); none for joints."""
    if flange_chart is None:
        return ()
    turns = (f"the turn about {'xyz'[int(np.argmax(np.abs(axis)))]}" for axis in flange_chart[0, :3, :3].T)
    return "x", "y", "z", *turns


def position_limits(lower: FloatArray, upper: FloatArray) -> JointLimits:
    """Limits (n,) of the positions of joints, rad or m, alone."""
    endless = np.full(len(lower), math.inf)
    return JointLimits(lower=lower, upper=upper, speed=endless, acceleration=endless)


class JointCurve(NamedTuple):
    """True joints less readings as a sum of terms c φ(x), all zero at the reference.

    φ is a function of a reading x from the reference, such as x² or sin x, or the torque of weights behind
    the joint that it moves, less that at the reference. That needs an arm as it was before the fit: its own
    errors times a deflection are of second order.
    """

    terms: FloatArray  # (T, 4) index of φ in ``BASIS``, joint moved and joint read from 0, and c, rad or m
    # (n + 1, 5, 4) of each joint its twist over a weight on its axis, at last gravity in the first row over
    # the weight at the tool; their largest torque is 1; (0, 5, 4) without torques
    arm: FloatArray


FROM_ONE = np.array([0.0, 1.0, 1.0, 0.0])  # added to terms, numbers joints from 1
NO_CURVE = JointCurve(np.zeros((0, 4)), np.zeros((0, 5, 4)))


class Model(NamedTuple):
    """Robot and rig as the kernels see them, in one frame, projective or metric.

    The calibrated model lives in a projective frame; the true one in the metric frame of the robot
    base, if the operators are 4×4 twists and ``a_inf`` is (0, 0, 0, 1).
    """

    P: FloatArray  # (V, 3, 4) cameras to pixels
    # (n, 4, 4) joint operators at the reference, one unit of motion per rad or m; of cameras on the tool they
    # move the scene before them, in the order of the arm
    H_hat_0: FloatArray
    prismatic: BoolArray  # (n,) whether a joint is prismatic; otherwise it is revolute
    q_reference: FloatArray  # (n,) joint reading at the reference, rad or m
    a_inf: FloatArray  # (4,) plane at infinity, the common left null vector of the operators
    # (V, 5) radial distortion of the views: image centre u, v and radius, px, then k1, k2
    lens: FloatArray
    # whether the cameras are on the tool: the joints then move the scene, the last one first
    on_tool: bool = False
    curve: JointCurve = NO_CURVE  # true joints by readings


class Spread(NamedTuple):
    """Prediction errors: models one standard deviation off the calibrated one, each in another direction.

    The directions are those in which the covariance of the calibration moves images most.
    """

    P: FloatArray  # (k, 2, 3, 4)
    H_hat: FloatArray  # (k, n, 4, 4)
    M: FloatArray  # P, H_hat, M: (k, b, 4) cameras, operators, markers; first as calibrated
    rest: float  # standard deviation that is left to all other directions, px
    max_sigma: float  # largest standard deviation of a coordinate that was met with, px


class Errors(NamedTuple):
    """Errors of parameters by independent ones of unit variance: r for all, three for each marker alone.

    Their covariance is Λ Λᵀ + diag(own ownᵀ), with Λ of ``shared`` over ``marker``: linear in the markers.
    """

    shared: FloatArray  # (s, r) of the parameters before the markers
    marker: FloatArray  # (m, d, r) of the d parameters of each marker, by the same errors
    own: FloatArray  # (m, d, 3) and by its separate ones

    def of(self, markers: IntArray | list[int]) -> "Errors":
        """Those of some markers, by their indices."""
        return Errors(self.shared, self.marker[markers], self.own[markers])

    def scaled(self, factor: float) -> "Errors":
        """Errors times a factor."""
        return Errors(factor * self.shared, factor * self.marker, factor * self.own)

    def dense(self) -> FloatArray:
        """All in one factor (s + d m, r + 3 m) of the covariance: for few markers."""
        m = len(self.marker)
        markers = apart(self.marker, self.own, np.arange(m)[:, None], m)
        shared = np.pad(self.shared, ((0, 0), (0, 3 * m)))
        return np.concatenate([shared, markers.reshape(-1, shared.shape[1])])


def apart(common: FloatArray, own: FloatArray, marker: IntArray, m: int) -> FloatArray:
    """Changes (…, r) by errors that all feel and (…, 3) by errors of a marker (…) of m, as (…, r + 3 m)."""
    *shape, r = common.shape
    result = np.zeros((*shape, r + 3 * m))
    result[..., :r] = common
    columns = np.broadcast_to(r + 3 * marker[..., None] + np.arange(3), own.shape)
    np.put_along_axis(result, columns, own, axis=-1)
    return result


NO_SPREAD = Spread(
    P=np.zeros((0, 2, 3, 4)), H_hat=np.zeros((0, 0, 4, 4)), M=np.zeros((0, 0, 4)), rest=0.0, max_sigma=0.0
)


@dataclass(frozen=True, eq=False)
class Observation:
    """Stereo images of the markers at a sequence of robot poses."""

    pose: IntArray = _array("pose", about="number of the pose")
    marker: IntArray = _array("marker", about="number of the marker")
    q: FloatArray = _array("pose joint", "rad or m", "joint readings")
    images: FloatArray = _array("pose view marker xy", "px", "pixels, NaN if unseen")
    moving: IntArray | None = _optional_array(
        "pose", about="number of the motion during which the pose was recorded, 0 at rest"
    )
    t_q: FloatArray | None = _optional_array("pose", "s", "time of the joint readings, NaN if unknown")
    t_view: FloatArray | None = _optional_array(
        "pose view", "s", "timestamps of both images, NaN if there are none"
    )
    sigma: FloatArray | None = _optional_array(
        "pose view marker", "px", "standard deviation of the pixels, per coordinate, NaN if unseen"
    )
    view: tuple[str, ...] = _scalar(about="names of the views", default=VIEWS)
    flange_chart: FloatArray | None = _optional_array(
        "flange_part row coordinate",
        about="of poses of the flange, whose coordinates q are: axes of turns, and the pose at zero, m",
    )

    @classmethod
    def of_one(
        cls,
        marker: IntArray,
        q: FloatArray,
        images: FloatArray,
        view: tuple[str, ...],
        sigma: FloatArray | None = None,
    ) -> "Observation":
        """Images (V, m, 2) of joints (n,), with the deviations (V, m) of their pixels, if stated."""
        none, stated = np.zeros(1, dtype=np.int64), None if sigma is None else sigma[None]
        return cls(pose=none, marker=marker, q=q[None], images=images[None], sigma=stated, view=view)

    def rows(self, keep: BoolArray) -> "Observation":
        """Some of the poses (K,)."""
        kept: dict[str, Any] = {}
        for name in ("pose", "q", "images", "moving", "t_q", "t_view", "sigma"):
            values = getattr(self, name)
            kept[name] = None if values is None else values[keep]
        return replace(self, **kept)

    @property
    def at_rest(self) -> "Observation":
        """The poses that were recorded at rest: all that a calibration rests on but for its delay."""
        return self if self.moving is None else self.rows(self.moving == 0)


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibratedRig(RecordPart):
    """Cameras in the projective frame."""

    mount: str = _scalar(about="world: fixed cameras watch the tool; tool: the reverse", default=WORLD)
    P: FloatArray = _array("view image_row coordinate", "px", "cameras, projective frame")
    lens: FloatArray | None = _optional_array(
        "view lens_term", about="radial distortion, if estimated: image centre u, v and radius in px, k1, k2"
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibratedArm(RecordPart):
    """Joints in the projective frame."""

    joint_types: str = _scalar(about="one letter a joint, R or P")
    H_hat_0: FloatArray = _array("joint row coordinate", about="joint operators at the reference")
    q_reference: FloatArray = _array("joint", "rad or m", "joint reading at the reference")
    a_inf: FloatArray = _array("coordinate", about="common plane at infinity")
    joint_curve: FloatArray | None = _optional_array(
        "joint_curve_row joint_curve_column",
        about="terms of true joints less readings, if fitted: index into BASIS, joint moved and joint read "
        "from 1, coefficient and its standard deviation in rad or m, typical error at left-out poses in px "
        "without and with it; their errors are the last rows of sqrt_cov_shared",
    )
    joint_curve_arm: FloatArray | None = _optional_array(
        "joint_curve_motion joint_curve_part coordinate",
        about="arm by which torques are known: of each joint its twist over a weight on its axis, at last "
        "gravity in the first row over the weight at the tool",
    )
    flange_chart: FloatArray | None = _optional_array(
        "flange_part row coordinate",
        about="of poses of the flange, whose coordinates are joints: axes of turns, and the pose at zero, m",
    )

    @property
    def prismatic(self) -> BoolArray:
        """Whether each joint (n,) is prismatic."""
        return prismatic_of(self.joint_types)

    @property
    def curve(self) -> JointCurve | None:
        """True joints by readings, in the order of the arm; None if they are equal."""
        if self.joint_curve is None:
            return None
        terms = self.joint_curve[:, :4] - FROM_ONE
        return JointCurve(terms, NO_CURVE.arm if self.joint_curve_arm is None else self.joint_curve_arm)


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibratedBody(RecordPart):
    """Markers in the projective frame, scaled to ``a_inf @ M = 1``: their mean is their midpoint."""

    marker: IntArray = _array("marker", about="number of the marker")
    M: FloatArray = _array("marker coordinate", about="markers at the reference, a_inf @ M = 1")
    boards: FloatArray | None = _optional_array(
        "board number",
        about="boards whose shape the fit uses: number of the first marker, columns, rows, pitch in m, "
        "NaN if unknown, and 1 if odd rows are one pitch on",
    )

    def indices_of(self, numbers: Iterable[int]) -> list[int]:
        """Return indices of markers in ``marker`` and ``M`` by their numbers; ValueError if unknown."""
        known = self.marker.tolist()
        return [known.index(number) for number in numbers]


@dataclass(frozen=True, eq=False, kw_only=True)
class ParameterErrors(RecordPart):
    """Covariance of rig, arm and body, as ``Errors`` says; not finite of a truth, which has none."""

    sqrt_cov_shared: FloatArray = _array(
        "parameter error",
        about="square root of the covariance of P.ravel(), H_hat_0.ravel() and, if estimated, k1, k2 and "
        "image centre u, v of both lenses, up to the gauge",
    )
    sqrt_cov_marker: FloatArray = _array(
        "marker coordinate error", about="square root of the covariance of M by the same errors"
    )
    sqrt_cov_own: FloatArray = _array(
        "marker coordinate own",
        about="square root of the covariance of each marker by three separate errors",
    )

    @property
    def errors(self) -> Errors:
        """Errors of P, H_hat_0, lenses and M, in this order."""
        return Errors(self.sqrt_cov_shared, self.sqrt_cov_marker, self.sqrt_cov_own)

    @property
    def has_covariance(self) -> bool:
        """Whether it states its errors; a truth, which is exact, does not."""
        return bool(np.isfinite(self.sqrt_cov_shared).all())


@dataclass(frozen=True, eq=False, kw_only=True)
class JointEvidence(RecordPart):
    """Determination of each joint, and the range of its readings."""

    excitation: FloatArray = _array("joint", "rad or m", "range of joint motion in the data")
    joint_min: FloatArray = _array("joint", "rad or m", "minimum joint reading in the data")
    poorly_observable: BoolArray = _array("joint", about="joints whose operator the data hardly determine")
    operator_defect: FloatArray = _array("joint", about="norm of Ĥ³ + Ĥ (revolute) or Ĥ² (prismatic) over Ĥ")
    trace_defect: FloatArray = _array("joint", about="absolute trace of Ĥ")
    plane_defect: FloatArray = _array("joint", about="norm of a_inf @ Ĥ, a_inf of unit norm")
    prediction_noise: FloatArray = _array(
        "joint", about="noise of predicted images 0.5 rad or 0.15 m from the reference, over the pixel noise"
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class FitQuality(RecordPart):
    """Evidence of a calibration: its residuals and their noise."""

    rms_px: float = _scalar("px", "reprojection residual, rms per marker and view (Euclidean)")
    sigma_px: float = _scalar("px", "noise per image coordinate: configured, given or estimated")
    sigma_view_px: FloatArray | None = _optional_array(
        "view", "px", "noise per coordinate of each view, if it is not common to all"
    )
    sigma_fitted_px: float = _scalar("px", "noise per coordinate from the residuals of the fit")
    chi2_per_dof: float = _scalar(about="squared residuals over sigma_px squared, per degree of freedom")
    dof: int = _scalar(about="degrees of freedom of the fit")
    sigma_scale: float | None = _optional_scalar(
        about="true standard deviation of pixels over the stated one, if the images determine it"
    )
    sigma_scale_interval: FloatArray | None = _optional_array("limit", about="95 % interval of sigma_scale")
    model_px: float = _scalar("px", "model error per coordinate, 0 if it is within the noise", default=0.0)
    corner_squares: FloatArray | None = _optional_array(
        "corner_pose view marker",
        about="squared residuals over their variance, mean of both coordinates, NaN if unseen",
    )
    corner_q: FloatArray | None = _optional_array(
        "corner_pose joint", "rad or m", "joint readings of corner_squares"
    )
    sigma_q: float | None = _optional_scalar(
        "rad", "standard deviation of joint readings, prismatic × 0.3 m/rad; 0 if none is significant"
    )
    sigma_q_interval: FloatArray | None = _optional_array(
        "limit", "rad", "95 % interval of sigma_q, if estimated"
    )
    sigma_flange_m: float | None = _optional_scalar(
        "m", "standard deviation of positions of the flange; sigma_q is that of its rotations"
    )
    encoder_counts: bool = _scalar(about="whether sigma_q is that of encoder counts", default=False)
    poses_used: int = _scalar(about="number of poses in the fit")
    markers_used: int = _scalar(about="number of markers in the fit")


@dataclass(frozen=True, eq=False, kw_only=True)
class Rejections(RecordPart):
    """Data that a calibration left out or read otherwise than they were written, or that decide nothing."""

    outlier: IntArray = _array(
        "outlier_row outlier_column",
        about="rejected observations: pose, marker, index of the view (their number for all)",
    )
    suspect: IntArray = _array(
        "suspect_row suspect_column", about="joint readings that no image agrees with: pose, joint from 1"
    )
    id_switches: IntArray = _array(
        "id_switch_row id_switch_column",
        about="observations under a wrong marker number: pose, number read, true number",
    )
    rejected_markers: IntArray | None = _optional_array(
        "rejected_marker_row rejected_marker_column",
        about="rejected markers: number, and reason as an index into WHY_LOST",
    )
    rejected_poses: IntArray | None = _optional_array(
        "rejected_pose", about="rejected poses without one suspect joint reading"
    )
    moved_images: IntArray | None = _optional_array(
        "moved_row moved_column",
        about="images of a camera that moved, or had not settled: pose, index of the view",
    )
    turned_images: IntArray | None = _optional_array(
        "turned_row turned_column",
        about="images of a board, numbered from another end and turned right: pose, index of the view",
    )
    placeholders: int = _scalar(about="number of detections in place of unseen markers", default=0)
    unseen_poses: IntArray | None = _optional_array("unseen_pose", about="poses that no camera saw")
    circular_joints: IntArray | None = _optional_array(
        "circular_joint", about="joints, from 1, whose readings passed a full turn"
    )
    undecided_order: IntArray | None = _optional_array(
        "undecided_pair pair_end", about="pairs of joints, from 1, whose order no pose shows"
    )

    @property
    def open_order(self) -> tuple[Finding, ...]:
        """A finding on the joints whose order no pose shows, if there are any."""
        if self.undecided_order is None or not self.undecided_order.size:
            return ()
        joints = tuple(np.unique(self.undecided_order).tolist())
        return (Finding("undecided_order", LIMITS, Subject(joints=joints)),)


@dataclass(frozen=True, eq=False, kw_only=True)
class StatedErrors(RecordPart):
    """Errors of predicted images, with the deviations from the model that limit them."""

    predicted_rms_px: float | None = _optional_scalar(
        "px", "expected error of images within the joint ranges, rms per marker and view"
    )
    predicted_p99_px: float | None = _optional_scalar(
        "px", "99th percentile of that rms over draws of the noise"
    )
    predicted_recorded_px: float | None = _optional_scalar(
        "px", "expected error of images at the recorded poses, rms per marker and view"
    )
    predicted_worst_px: float | None = _optional_scalar(
        "px", "expected error within the joint ranges if the deviation is there that these data do not show"
    )
    model_error: tuple[str, ...] = _scalar(
        about="deviations from the model that limit predictions: kind, joints and view of each", default=()
    )
    model_error_numbers: FloatArray | None = _optional_array(
        "model_error_row model_error_column",
        about="of each its estimate, standard deviation, effect on predictions in px, and first pose",
    )
    model_error_bias: FloatArray | None = _optional_array(
        "parameter_and_coordinate model_error_row",
        about="error of P, H_hat_0, lenses and M by each of them, to first order",
    )
    unshown_error: tuple[str, ...] = _scalar(
        about="the deviation that these data do not show and that would spoil predictions most", default=()
    )
    unshown_numbers: FloatArray | None = _optional_array(
        "model_error_column", about="its usual or smallest detectable size, 0, and its effect in px"
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class TimeOffset(RecordPart):
    """Time of joint readings minus the time of images, if poses in motion determine it."""

    time_offset_s: FloatArray = _array("view", "s", "time of a joint reading less the time of its image")
    time_offset_interval_s: FloatArray = _array("view limit", "s", "95 % interval of the time offset")
    time_offset_jitter_s: FloatArray = _array(
        "view", "s", "standard deviation of the time offset of single images"
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Refits(RecordPart):
    """Cameras that were fitted again."""

    refit: tuple[str, ...] = _scalar(
        about="names of cameras that were fitted again, in this order", default=()
    )
    refit_numbers: FloatArray = _array(
        "refit refit_column",
        about="of each the number of poses, and the error of its images within the joint ranges now and "
        "before it moved, rms px",
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationVerdict(RecordPart):
    """Whether a calibration is usable, and its limits."""

    usable: bool = _scalar(about="whether the calibration is usable for control")
    reason: str = _scalar(about="reason why it is usable or not")
    advice: tuple[str, ...] = _scalar(about="remedies, one sentence each")
    limit: str = _scalar(about="factor that limits the predictions", default="")
    notes: tuple[str, ...] = _scalar(about="remedies that only reduce noise", default=())
    findings: tuple[Finding, ...] = _scalar(
        about="findings: code, severity, subject, amount, deviation, limit, unit, effect",
        default=(),
    )

    @property
    def model_errors(self) -> tuple[Finding, ...]:
        """Deviations from the model that limit predictions, in the order of ``model_error_bias``."""
        return tuple(one for one in self.findings if one.code in DEVIATIONS)

    @property
    def unshown(self) -> Finding | None:
        """The deviation that these data do not show and that would spoil predictions most."""
        return next((one.others[0] for one in self.findings if one.code == "unshown"), None)


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration(Composite):
    """Projective kinematics of a robot seen by a stereo rig of unknown calibration.

    Points are scaled to ``a_inf @ M = 1``, so that the mean of points is their midpoint.
    """

    view: tuple[str, ...] = _scalar(about="names of the views", default=VIEWS)
    method: str = _scalar(about="bundle_adjustment, maximum likelihood")
    source: str = _scalar(about="simulated or recorded")
    seconds: float = _scalar("s", "computing time")
    rig: CalibratedRig
    arm: CalibratedArm
    body: CalibratedBody
    parameter_errors: ParameterErrors
    verdict: CalibrationVerdict
    fit: FitQuality
    joints: JointEvidence
    rejections: Rejections
    stated: StatedErrors
    time_offset: TimeOffset | None = None
    refits: Refits | None = None

    def model(self) -> Model:
        """The kernels' view of the calibration."""
        rig, arm, on_tool = self.rig, self.arm, self.rig.mount == TOOL
        return Model(
            P=rig.P,
            H_hat_0=-arm.H_hat_0 if on_tool else arm.H_hat_0,
            prismatic=arm.prismatic,
            q_reference=arm.q_reference,
            a_inf=arm.a_inf,
            lens=no_lenses(len(rig.P)) if rig.lens is None else rig.lens,
            on_tool=on_tool,
            curve=arm.curve or NO_CURVE,
        )

    @property
    def lens_terms(self) -> int:
        """Number of estimated terms of each lens: 0, k1 and k2, or those and the image centre u, v."""
        if self.rig.lens is None:
            return 0
        of_curve = 0 if self.arm.joint_curve is None else len(self.arm.joint_curve)
        return (
            len(self.parameter_errors.sqrt_cov_shared) - self.rig.P.size - self.arm.H_hat_0.size - of_curve
        ) // len(self.rig.P)

    def without_covariance(self) -> "Calibration":
        """The same, which takes little memory, for callers who need no errors of it."""
        none = {
            name: getattr(self, name)[..., :0]
            for name in ("sqrt_cov_shared", "sqrt_cov_marker", "sqrt_cov_own")
        }
        return changed(self, **none)

    def with_markers(self, indices: IntArray | list[int]) -> "Calibration":
        """The same with some of the markers, by their indices."""
        few, bias = self.errors.of(indices), self.model_error_bias
        if bias is not None:
            first = len(bias) - self.M.size
            of_markers = bias[first:].reshape(len(self.M), 4, -1)[indices]
            bias = np.concatenate([bias[:first], of_markers.reshape(-1, bias.shape[1])])
        return changed(
            self,
            model_error_bias=bias,
            marker=self.marker[indices],
            M=self.M[indices],
            sqrt_cov_marker=few.marker,
            sqrt_cov_own=few.own,
            corner_squares=None if self.corner_squares is None else self.corner_squares[..., indices],
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldOutBlocks(RecordPart):
    """Held-out errors of folds of like postures, and of consecutive poses; none if not asked for."""

    posture_rms_px: float | None = _optional_scalar("px", "rms residual in folds of like postures")
    posture_predicted_px: float | None = _optional_scalar("px", "expected rms of it")
    time_rms_px: float | None = _optional_scalar("px", "rms residual in folds of consecutive poses")
    time_predicted_px: float | None = _optional_scalar("px", "expected rms of it")


@dataclass(frozen=True, eq=False, kw_only=True)
class CrossValidation(Composite):
    """Repeatability of a calibration: images at poses that the fit which predicts them has not seen.

    The statistics are of Euclidean distances, one for each marker and view, as in ``validate``.
    Readings that the calibration leaves out as outliers do not count.
    """

    folds: int = _scalar(about="number of folds of the poses, each predicted from the others")
    seed: int = _scalar(about="seed of the division")
    unit: str = _scalar(about="poses, or configurations: poses that differ in one joint stay together")
    failed: tuple[str, ...] = _scalar(about="folds without a prediction, each with the reason")
    reason: str = _scalar(about="comparison of the held-out error with the predicted one")
    findings: tuple[Finding, ...] = _scalar(
        about="the same: code, severity, subject, amount, deviation, limit, unit, effect", default=()
    )
    count: int = _scalar(about="number of predicted marker-view pairs")
    rms_px: float | None = _scalar("px", "held-out residual, root mean square")
    median_px: float | None = _scalar("px", "held-out residual, median")
    p95_px: float | None = _scalar("px", "held-out residual, 95th percentile")
    predicted_rms_px: float | None = _scalar(
        "px", "expected root mean square from noise and covariance of each fit"
    )
    pose: IntArray = _array("pose", about="number of the pose")
    fold: IntArray = _array("pose", about="fold of the pose, from 0")
    marker: IntArray = _array("marker", about="number of the marker")
    residual: FloatArray = _array("pose view marker xy", "px", "seen minus predicted, NaN if there is none")
    predicted: FloatArray = _array(
        "pose view marker xy", "px", "standard deviation of the residual from noise and covariance"
    )
    others_px: FloatArray | None = _optional_array(
        "view with_or_without",
        "px",
        "rms residual of the other views, by fits with this view and without it; none of two views",
    )
    blocks: HeldOutBlocks


def in_unit(value: float, unit: str, digits: int = 6) -> str:
    """Write a joint reading, rad or m, in the unit deg, rad or m."""
    return f"{math.degrees(value) if unit == 'deg' else value:.{digits}g} {unit}"


def in_sense(theta_r: float, theta_p: float, q_hat: FloatArray) -> FloatArray:
    """Joint motions (2, n) of both rotations in the sense of their angles."""
    signs = np.where(np.array([theta_r, theta_p]) >= 0.0, 1.0, -1.0)
    return np.asarray(signs[:, None] * q_hat)


@dataclass(frozen=True, eq=False, kw_only=True)
class PlannedMotion(RecordPart):
    """Samples of a planned motion, and their margins."""

    path_parameter: FloatArray = _array("sample", about="path parameter from 0 to 1")
    time: FloatArray = _array("sample", "s", "time of each sample; NaN if the plan has no duration")
    duration: float | None = _scalar(
        "s",
        "duration, as configured or at the joint-speed limit; none without a limit, or if no joints follow",
    )
    mu: FloatArray = _array(
        "sample part", about="fractions of t, r, p that are done, NaN in the profile joint_space"
    )
    H_d: FloatArray = _array("sample row coordinate", about="planned displacement of the face")
    s: FloatArray = _array("sample view marker xy", "px", "predicted images of the face")
    q: FloatArray = _array("sample joint", "rad or m", "joints that follow the motion, NaN if none do")
    margin: FloatArray = _array("sample view", about="visibility margin a·O, 1 at the start")
    border_distance: FloatArray = _array(
        "sample view", "px", "minimum distance of a marker from the image border"
    )
    joint_margin: FloatArray = _array(
        "sample", about="minimum distance from a joint limit over half the range"
    )
    reciprocal_condition: FloatArray = _array(
        "sample", about="reciprocal condition number of the image Jacobian of the face"
    )
    min_margin: FloatArray = _array(
        "constraint",
        about="minimum of visibility margin, border distance in px, joint margin, reciprocal condition "
        "number",
    )
    min_margin_mu: FloatArray = _array("constraint part", about="fractions of t, r, p at that minimum")


@dataclass(frozen=True, eq=False, kw_only=True)
class TaskPartition(RecordPart):
    """A reaching task as a translation and two rotations, from images of start and goal, [RH00] section 4."""

    s_start: FloatArray = _array("view marker xy", "px", "images at the start")
    s_star: FloatArray = _array("view marker xy", "px", "images at the goal")
    A: FloatArray = _array("marker coordinate", about="face at the start")
    A_star: FloatArray = _array("marker coordinate", about="face at the goal")
    A_t: FloatArray = _array("marker coordinate", about="goal less the translation")
    A_r: FloatArray = _array("marker coordinate", about="goal less translation and rotation onto the plane")
    a: FloatArray = _array("coordinate", about="plane of the face at the start")
    a_star: FloatArray = _array("coordinate", about="plane of the face at the goal")
    a_t: FloatArray = _array("coordinate", about="plane of the goal less the translation")
    A_c: FloatArray = _array("coordinate", about="centre of the face at the start")
    A_c_star: FloatArray = _array("coordinate", about="centre of the face at the goal")
    q_start: FloatArray = _array("joint", "rad or m", "joint readings at the start")
    q_hat: FloatArray = _array("part joint", about="joint motions t, r, p at the start")
    H_hat: FloatArray = _array("part row coordinate", about="operators t, r, p at the start")
    tau: float = _scalar(about="amplitude of the translation, unit-norm kernel of (8)")
    theta_r: float = _scalar("rad", "angle onto the target plane, in the sense chosen")
    theta_p: float = _scalar("rad", "angle within the plane")
    theta_s: float = _scalar("rad", "angle of both rotations together")

    def rotation_sense(self) -> FloatArray:
        """Joint motions (2, n) of the rotations r and p in the sense they are planned."""
        return in_sense(self.theta_r, self.theta_p, self.q_hat[1:3])


@dataclass(frozen=True, eq=False, kw_only=True)
class FaceVisibility(RecordPart):
    """Visibility of the face in each view by translation and rotation, and both senses of the latter."""

    optical_center: FloatArray = _array("view coordinate", about="optical centres")
    tau_0: FloatArray = _array("view", about="translation at which visibility changes")
    theta_0: FloatArray = _array("view solution", "rad", "angles at which visibility changes")
    sense: FloatArray = _array("solution", "rad", "both senses of the rotation onto the plane")
    sense_margin: FloatArray = _array(
        "solution view", about="minimum margin along each sense, 1 at the start"
    )
    tau_limit: float = _scalar(
        about="minimum visibility_fraction·tau_0 ahead of the face, infinite if there is none"
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class JointSpaceSearch(RecordPart):
    """A search through joint space: its numbers, trees and required margins; none in other profiles."""

    n_goal_configurations: int = _scalar(
        about="number of goal configurations within the limits; none but in the profile joint_space"
    )
    n_search_samples: int = _scalar(
        about="number of samples of the search; none but in the profile joint_space"
    )
    n_goals_tried: int = _scalar(
        about="number of goal configurations tried, nearest in time; none but in the profile joint_space"
    )
    seed: int = _scalar(about="seed of the search; none but in the profile joint_space")
    tree_nodes: int = _scalar(
        about="number of nodes of both search trees, of which the first are stored; none but in the "
        "profile joint_space"
    )
    margins: FloatArray | None = _optional_array(
        "sample margin_kind",
        about="in the profile joint_space: distance from the joint limits over the required one; for "
        "each view minimum depth (start = 1), visibility a·O (start = 1), width of the face in "
        "px, distance from the image border less three standard deviations in px; distance from "
        "keep-out regions in px",
    )
    required_margins: FloatArray | None = _optional_array(
        "sample margin_kind", about="required values of these margins, smaller near start and goals"
    )
    blends: FloatArray | None = _optional_array(
        "blend end", "s", "in the profile joint_space: begin and end of each blend of a waypoint"
    )
    tree_q: FloatArray | None = _optional_array(
        "node joint", "rad or m", "nodes of the search trees: that from the start, then that from the goals"
    )
    tree_parent: IntArray | None = _optional_array(
        "node", about="index of the parent of each node, -1 at a root"
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class CarriedByObject(RecordPart):
    """Object that the goal was taught on, where it is now, and the goal carried along.

    A goal may have several: files have the first among the fields of the plan, others in separate groups.
    """

    object_name: str = _scalar(about="name of the object that carries the goal")
    object_shift_mm: float | None = _optional_scalar(
        "mm", "motion of its middle since the goal was taught; none if no length is known"
    )
    object_angle_deg: float | None = _optional_scalar(
        "deg", "its rotation since; none if the joints do not determine the metric"
    )
    object_shift_px: float = _scalar("px", "motion of its images since, rms per marker and view")
    goal_deviation_mm: float | None = _optional_scalar(
        "mm", "deviation of the carried goal, rms; none if no length is known"
    )
    goal_deviation_deg: float | None = _optional_scalar(
        "deg", "deviation of its rotation; none if the joints do not determine the metric"
    )
    goal_deviation_px: float = _scalar("px", "deviation of its images, rms per marker and view")
    object_marker: IntArray = _array("object_marker", about="numbers of the markers of the object")
    object_left_out: str | None = _optional_scalar(
        about="numbers of its markers that disagreed in one observation of the object, and were left out"
    )
    s_object: FloatArray = _array(
        "view object_marker xy", "px", "images of these when it was planned, NaN if unseen"
    )
    s_object_taught: FloatArray = _array(
        "view object_marker xy", "px", "images of these when the goal was taught, NaN if unseen"
    )
    sigma_object: FloatArray | None = _optional_array(
        "view object_marker", "px", "standard deviation of a coordinate when it was planned, NaN if unknown"
    )
    sigma_object_taught: FloatArray | None = _optional_array(
        "view object_marker", "px", "standard deviation of a coordinate when taught, NaN if unknown"
    )
    s_carried: FloatArray = _array(
        "view observed xy", "px", "images of all markers of the body at the carried goal"
    )
    M_object: FloatArray | None = _optional_array(
        "object_marker coordinate",
        about="its markers in the frame of the body, where this was when the goal was taught; NaN if unseen",
    )

    @property
    def object_words(self) -> str:
        """Displacement of the object and deviation of its goal, in words."""
        shift = [
            f"{number:.3g} {unit}"
            for number, unit in (
                (self.object_shift_mm, "mm"),
                (self.object_angle_deg, "deg"),
                (self.object_shift_px, "px"),
            )
            if number is not None
        ]
        known = [
            f"{number:.2g} {unit}"
            for number, unit in (
                (self.goal_deviation_mm, "mm"),
                (self.goal_deviation_deg, "deg"),
                (self.goal_deviation_px, "px"),
            )
            if number is not None
        ]
        return (
            f"{self.object_name} has moved by {' and '.join(shift[:-1]) or shift[-1]} since the goal was "
            f"taught; the goal is known to {', '.join(known[:-1]) or known[-1]}"
            + (f"; inconsistent and left out: marker {self.object_left_out}" if self.object_left_out else "")
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class GoalOfIncidences(RecordPart):
    """Goal that was chosen of those that incidences leave open; none for the whole pose."""

    incidences: tuple[str, ...] = _scalar(
        about="incidences that are to hold at the goal; none for the whole pose", default=()
    )
    free_dof: int = _scalar(
        about="number of joint motions at the goal that keep all incidences; none for the whole pose"
    )
    s_goal: FloatArray = _array(
        "view observed xy",
        "px",
        "images of all markers of the body at the goal that was chosen, of those that incidences leave open",
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Plan(Composite):
    """A reaching task as a translation and two rotations, and the motion planned for it.

    Everything comes from the calibration and the start and goal images. Amplitudes are per view
    if they concern visibility: None is stored as NaN if a motion never changes it.
    """

    view: tuple[str, ...] = _scalar(about="names of the views", default=VIEWS)
    profile: str = _scalar(about="profile of the motion")
    feasible: bool = _scalar(
        about="whether the cameras see the face all along; in the profile constrained, whether all "
        "constraints hold; in the profile joint_space, whether a path was found"
    )
    reason: str = _scalar(about="reason why the plan is feasible or not")
    findings: tuple[Finding, ...] = _scalar(
        about="findings: code, severity, subject, amount, deviation, limit, unit, effect",
        default=(),
    )
    constraint: str = _scalar(
        about="constraint with the smallest margin, as a fraction of its margin at the ends"
    )
    rejected_profiles: tuple[str, ...] = _scalar(
        about="profiles that auto rejected, each with the reason", default=()
    )
    relaxed_constraints: tuple[str, ...] = _scalar(
        about="constraints relaxed at the start and the goal, which have smaller margins themselves",
        default=(),
    )
    motion: PlannedMotion
    partition: TaskPartition
    visibility: FaceVisibility
    open_goal: GoalOfIncidences | None = None
    search: JointSpaceSearch | None = None
    carried: tuple[CarriedByObject, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class RunErrors(RecordPart):
    """Distance of the end of a run from its goal."""

    position_error_mm: float | None = _scalar(
        "mm",
        "true centre to true goal at the end, the nearest one of a goal of incidences; of the tool if the "
        "robot reports its true pose",
    )
    rotation_error_deg: float | None = _scalar("deg", "true rotation to the goal at the end")
    remaining_translation: float | None = _scalar(
        about="fraction of the translation that remains at the end, as the law measures it"
    )
    remaining_rotation_deg: float | None = _scalar(
        "deg", "rotation that remains at the end, as the law measures it"
    )
    image_error_px: float | None = _optional_scalar(
        "px", "image_error at the end; none if a marker of the face was unseen"
    )
    estimated_position_error_mm: float | None = _optional_scalar(
        "mm",
        "estimated distance of the face from the goal, rms: by the images, with undetected_position_error_mm "
        "and the uncertainty of goal images; none if no length on the face is known, or images disagree with "
        "the calibration",
    )
    undetected_position_error_mm: float | None = _optional_scalar(
        "mm",
        "part of it: by errors that no test detects, at two deviations, such as tags that moved less than "
        "backlash hides; none if images are not tested",
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class RunMetrics(RecordPart):
    """Numbers by which runs of laws are compared."""

    success: bool | None = _optional_scalar(
        about="whether it converged and at every time, in truth, no joint was past a limit, no camera "
        "behind the face and every marker of the face in both images; none if the truth is "
        "unknown"
    )
    self_occluded_steps: tuple[int, ...] = _by_view("times at which this camera is behind the face")
    center_deviation_mm: float | None = _scalar(
        "mm", "maximum distance of the centre from the line, between samples too"
    )
    center_deviation_at_samples_mm: float | None = _scalar(
        "mm", "maximum distance of the centre from the line at the samples"
    )
    path_length_mm: float | None = _scalar("mm", "length of the path of the centre, from sample to sample")
    effort: float = _scalar("rad²/s or m²/s", "integral of the squared joint velocities")
    longest_stall_steps: int = _scalar(
        about="longest run of steps in which convergence_error falls < 1 % in each stop.stall_periods"
    )
    speed_limited_steps: int = _scalar(about="commands scaled to the joint-speed limit")
    visibility_limited_steps: int = _scalar(
        about="commands whose translation was limited to visibility_fraction·tau_0"
    )
    first_outside_image: int = _scalar(about="first time index with a marker outside an image, -1 for never")
    first_beyond_limit: int = _scalar(about="first time index beyond a joint limit, -1 for never")
    limit_joint: int = _scalar(
        about="the joint, from 0, that passed its limit first or stopped the run, -1 for none"
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class RunHistory(RecordPart):
    """Arrays of a run over time: joints, images, errors and commands."""

    q: FloatArray = _array("time joint", "rad or m", "joints")
    s: FloatArray = _array("time view marker xy", "px", "measured images of the face")
    s_star: FloatArray = _array("view marker xy", "px", "target images")
    image_error: FloatArray = _array("time", "px", "image error of the face, rms over markers and views")
    convergence_error: FloatArray = _array(
        "time",
        "px",
        "error that decides convergence: the image error of the face, located by the body if "
        "features is body; of a goal of incidences the minimum motion of the body's images that meets them",
    )
    tau: FloatArray = _array("time", about="translation error, unit-norm kernel of (8)")
    tau_affine: FloatArray = _array("time", about="translation error, scale fixed through a_inf")
    theta_r: FloatArray = _array("time", "rad", "rotation error onto the plane")
    theta_p: FloatArray = _array("time", "rad", "rotation error within the plane")
    theta_s: FloatArray = _array("time", "rad", "rotation error of both together")
    prediction_px: FloatArray = _array(
        "time", "px", "observed less predicted from the joints, rms per coordinate; NaN for points"
    )
    fit_px: FloatArray = _array(
        "time", "px", "noise per coordinate that the fit of the body leaves; NaN for points"
    )
    views_used: FloatArray = _array("time", about="markers in the fit of the body, counted once per view")
    q_dot: FloatArray = _array("step joint", "rad/s or m/s", "commands after the limit")
    speed_factor: FloatArray = _array("step", about="factor of the joint-speed limit")
    force: FloatArray | None = _optional_array(
        "time", "N", "force on the tool; none without stop.max_force_n"
    )
    latency: FloatArray | None = _optional_array(
        "time view", "s", "time of the joint reading less the time of the image, as estimated in the run"
    )
    q_read: FloatArray | None = _optional_array(
        "time joint", "rad or m", "joint readings, if they differ from the joints"
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class TrueMotion(RecordPart):
    """True poses of a run over time; NaN if unknown."""

    self_occluded: BoolArray = _array("time view", about="true self-occlusion of the face")
    pose: FloatArray = _array("time row coordinate", "m", "true pose of the tool")
    goal_pose: FloatArray = _array("row coordinate", "m", "true goal pose, NaN if unknown")
    center: FloatArray = _array("time axis", "m", "true centre of the face")


@dataclass(frozen=True, eq=False, kw_only=True)
class IncidenceHistory(RecordPart):
    """Incidences that were to hold at the goal of a run, and their errors."""

    incidences: tuple[str, ...] = _scalar(
        about="incidences that were to hold at the goal; none for the whole pose", default=()
    )
    free_dof: int | None = _optional_scalar(
        about="number of joint motions at the goal that keep all incidences; none for the whole pose"
    )
    incidence_px: FloatArray = _array(
        "time incidence",
        "px",
        "error of each incidence over its deviation at one pixel of noise; none for the whole pose",
    )
    feature_s: FloatArray = _array(
        "time incidence span view xy",
        "px",
        "images of the points that span each feature of the tool, as the body was measured; NaN beyond the "
        "one, two or three of a point, line or plane",
    )
    feature_s_star: FloatArray = _array(
        "incidence span view xy", "px", "images of the features of the scene, as taught"
    )
    incidence_mm: FloatArray = _array(
        "incidence",
        "mm",
        "distance of features that are to meet, at the end, as stated: that which images show and its "
        "deviation, root of the sum of squares; NaN without a known length, or of others",
    )
    incidence_deg: FloatArray = _array(
        "incidence",
        "deg",
        "angle error of an incidence at the end, as stated likewise; NaN of points, or if the joints "
        "leave angles open",
    )
    free_motion: FloatArray | None = _optional_array(
        "freedom joint", "rad or m", "joint motions of unit norm that the incidences leave free at the end"
    )
    free_s: FloatArray | None = _optional_array(
        "freedom view marker xy", "px", "velocities of the images of the face by these, per rad or m"
    )
    incidence_deviation_mm: FloatArray | None = _optional_array(
        "incidence", "mm", "deviation of the distance by images, calibration and object"
    )
    incidence_deviation_deg: FloatArray | None = _optional_array(
        "incidence", "deg", "deviation of the angle by images, calibration and object"
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class FollowedErrors(RecordPart):
    """Errors of a goal that an object carried while a law ran, from its arrival on."""

    followed_rms_px: float | None = _optional_scalar(
        "px", "image error to the goal where it was, rms over time"
    )
    followed_rms_mm: float | None = _optional_scalar(
        "mm", "distance of the body, rms; none without a known length"
    )
    followed_max_mm: float | None = _optional_scalar("mm", "largest distance of the body; likewise")
    followed_rms_deg: float | None = _optional_scalar(
        "deg", "angle, rms; none if the joints leave angles open"
    )
    followed_seconds: float = _scalar("s", "time since the first arrival; 0 without one")
    followed_speed_mm_s: float | None = _optional_scalar("mm/s", "mean speed of the object; likewise")
    followed_deviation_mm: float | None = _optional_scalar(
        "mm", "stated deviation of the goal at the end; likewise, and none for a retreat"
    )
    followed_deviation_deg: float | None = _optional_scalar(
        "deg", "likewise; none if the joints leave angles open"
    )
    followed_motion: str | None = _optional_scalar(
        about="motion of the object in the last frames: still, belt, turntable or free"
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class GoalHistory(Composite, RecordPart):
    """A goal that an object carried while a law ran, over time."""

    followed: FollowedErrors
    goal_time: FloatArray = _array("time", "s", "clock of the robot")
    goal_error_px: FloatArray = _array(
        "time", "px", "image error to the goal where it was; NaN if unmeasured"
    )
    goal_error_mm: FloatArray = _array("time", "mm", "distance of the body; NaN without a known length")
    goal_error_deg: FloatArray = _array("time", "deg", "angle; NaN if the joints leave angles open")
    goal_sigma_px: FloatArray = _array("time", "px", "stated deviation of the image error")
    goal_s: FloatArray = _array("time view marker xy", "px", "images of the face at the goal then")
    goal_displacement: FloatArray = _array(
        "time row coordinate",
        about="displacement of the goal since the plan, in the frame of the calibration",
    )
    goal_speed: FloatArray = _array(
        "time", "mm/s or px/s", "speed of the object, px/s without a known length"
    )
    goal_unseen_s: FloatArray = _array("time", "s", "time since its object was seen")
    goal_center: FloatArray = _array("time axis", "m", "true centre of the face at the goal; NaN if unknown")
    goal_true_speed: FloatArray = _array("time", "mm/s", "true speed of the object; NaN if unknown")


@dataclass(frozen=True, eq=False, kw_only=True)
class PlanFollowing(RecordPart):
    """Adherence of a run to its plan."""

    mode: str = _scalar(
        about="regulate: each step moves to the goal by the present images; track, image_track: by the plan"
    )
    planned_s: float | None = _scalar("s", "arrival of the followed plan; none for regulate")
    replan_attempts: int = _scalar(about="number of replanning attempts", default=0)
    unplanned: str = _scalar(
        about="reason why a run in a following mode ran without the plan; empty if it followed", default=""
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class ImagesUsed(RecordPart):
    """Use that a run made of images."""

    features: str = _scalar(about="image features: points or body")
    untested: str = _scalar(about="reason why the images were not tested against the calibration", default="")


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordedFrames(RecordPart):
    """Camera images that were kept of a run; absent if the robot provides none."""

    frame_index: IntArray = _array(
        "frame", about="time indices of the stored frames; absent if the robot provides none"
    )
    frame_s: FloatArray = _array("frame view observed xy", "px", "all markers that were found in the frames")
    frame_size: IntArray = _array("frame view", about="bytes of each frame in frame_jpeg")
    frame_jpeg: ByteArray = _array("frame_byte", about="frames as JPEG, concatenated")


@dataclass(frozen=True, eq=False, kw_only=True)
class Trace(Composite):
    """One closed-loop run of one law, from the first instant to its verdict."""

    view: tuple[str, ...] = _scalar(about="names of the views", default=VIEWS)
    law: str = _scalar(about="name of the control law")
    verdict: str = _scalar(about="verdict of the run")
    reason: str = _scalar(about="reason of the verdict, one sentence")
    findings: tuple[Finding, ...] = _scalar(
        about="reasons: code, severity, subject, amount, deviation, limit, unit, effect", default=()
    )
    steps: int = _scalar(about="commands sent")
    period: float = _scalar("s", "control period")
    overruns: int | None = _optional_scalar(
        about="number of missed periods; none for the ideal simulated robot"
    )
    images_used: ImagesUsed
    following: PlanFollowing
    errors: RunErrors
    metrics: RunMetrics
    history: RunHistory
    truth: TrueMotion
    of_incidences: IncidenceHistory | None = None
    of_goal: GoalHistory | None = None
    frames: RecordedFrames | None = None

    def __getattr__(self, name: str) -> Any:
        """Attribute of a part by name, or the number of one view, such as ``self_occluded_steps_left``."""
        if name.startswith("self_occluded_steps_"):  # names of views are not known before a run
            numbers = scalars_of(self)
            if name in numbers:
                return numbers[name]
        return super().__getattr__(name)


@dataclass(frozen=True, eq=False)
class Action:
    """A step of a sequence that no law drives, once it was done."""

    kind: str = _scalar(about="act or wait")
    text: str = _scalar(about="action and value, or the time to wait")
    seconds: float = _scalar("s", "time for which the arm was held")


@dataclass(frozen=True, eq=False)
class Report:
    """Files of a report, the claims of the paper against the runs, and the numbers of the extra runs.

    Laws are direct_three and direct_two, operators true and calibrated, limits none and the limit
    per step. Deviations are NaN if the goal pose is unknown.
    """

    figures: tuple[str, ...] = _scalar(about="files written, relative to the folder of the run")
    omitted: tuple[dict[str, str], ...] = _scalar(about="omitted figures and studies, each with the reason")
    claims: tuple[dict[str, Any], ...] = _scalar(about="claim, source, measured, criterion, holds")
    metric: tuple[dict[str, Any], ...] = _scalar(
        about="quantity, value, deviation, unit of cameras, axes and tool; empty without a known length",
        default=(),
        kw_only=True,
    )
    step_limit_deg: float = _scalar("deg", "joint motion per step of the limited runs")
    gain_per_step: FloatArray = _array("gain_per_step", about="fraction of the error corrected in one step")
    path_deviation_mm: FloatArray = _array(
        "law operators limit gain_per_step", "mm", "maximum deviation of the centre"
    )
    path_deviation_at_samples_mm: FloatArray = _array(
        "law operators limit gain_per_step", "mm", "maximum deviation of the centre at the samples"
    )
    path_deviation_converged: BoolArray = _array(
        "law operators limit gain_per_step", about="whether the run converged"
    )
    period: FloatArray = _array("period", "s", "control period at the configured gains")
    period_path_deviation_mm: FloatArray = _array(
        "law period", "mm", "maximum deviation of the centre, true operators, no limit"
    )
    share: FloatArray = _array("share", about="fraction of the task in both sides of (22)")
    composition_mm: FloatArray = _array("share", "mm", "distance of the centre between both sides of (22)")


@dataclass(frozen=True, eq=False)
class JointList:
    """Joint readings of numbered poses."""

    pose: IntArray  # (K,) numbers; 0, 1 … if the file has none
    q: FloatArray  # (K, n) readings, rad or m
    numbered: bool  # whether the file has pose numbers
    images: dict[str, tuple[str, ...]] | None = None  # of each view, the names of its images at each pose
    flange_chart: FloatArray | None = None  # (2, 4, 4) of poses of the flange, whose coordinates are ``q``
