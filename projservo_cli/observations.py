"""Observations of a robot by cameras, with all inputs of a calibration besides the pixels."""

import dataclasses
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from projservo_cli.calibration.detections import require_size_and_noise
from projservo_cli.geometry.flange import FLANGE_TYPES, FlangeChart, require_poses
from projservo_cli.image_size import ImageSize
from projservo_cli.records import TOOL, VIEWS, WORLD, InputError, Observation
from projservo_cli.settings.sections import is_view
from projservo_cli.store.display import Displayable, checked_array, numbers_in, pandas
from projservo_cli.store.observation_tables import (
    in_radians,
    mount_in,
    or_empty,
    read_table,
    table_text,
    to_csv,
)


class KnownNoise(NamedTuple):
    """Known noise of observations."""

    px: float | None = None  # standard deviation of a coordinate; None to estimate it
    joint: float | None = None  # rms of readings less true joints, rad; None to estimate it
    alone: bool = False  # whether pixel noise is the only error


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Observations(Displayable, Observation):
    """Images of markers at a sequence of poses, and their properties.

    Attributes
    ----------
    pose : (K,) numbers of the poses.
    marker : (m,) numbers of the markers.
    q : (K, n) joint readings, rad or m.
    images : (K, V, m, 2) pixels in each view, NaN where unseen.
    view : names of the V views.
    moving, t_q, t_view, sigma : as in [the run file]; None where unknown.
    joint_types : one letter a joint, R or P.
    image_size : width and height, px, of all images or of one each; None where unknown.
    noise_px : standard deviation of a coordinate, px; None to estimate it.
    joint_noise : rms of joint readings less true joints, rad (prismatic × 0.3 m/rad); None to estimate it.
    exact : whether pixel noise is their only error, so that χ² decides against ``noise_px``.
    noise : these three, as ``px``, ``joint`` and ``alone``.
    source : ``simulated`` or ``recorded``.
    seed : seed of the random starts of a calibration.
    mount : ``world`` for cameras that watch the tool, ``tool`` for cameras on it.
    order_stated : whether the order of the joints along the arm is known to be the order of q.
    """

    joint_types: str = ""
    image_size: ImageSize | None = None
    noise: KnownNoise = dataclasses.field(default_factory=KnownNoise)
    source: str = "recorded"
    seed: int = 0
    mount: str = WORLD
    order_stated: bool = False

    @property
    def noise_px(self) -> float | None:
        """Standard deviation of a coordinate, px; None to estimate it."""
        return self.noise.px

    @property
    def joint_noise(self) -> float | None:
        """Rms of joint readings less true joints, rad (prismatic × 0.3 m/rad); None to estimate it."""
        return self.noise.joint

    @property
    def exact(self) -> bool:
        """Whether pixel noise is their only error, so that χ² decides against ``noise_px``."""
        return self.noise.alone

    def __post_init__(self) -> None:
        """Refuse an image size or a noise that is none."""
        require_size_and_noise(self.image_size, self.noise_px)

    @classmethod
    def of(cls, observation: Observation, **properties: Any) -> "Observations":
        """Return the observations of a record, with further properties."""
        fields = {field.name: getattr(observation, field.name) for field in dataclasses.fields(Observation)}
        types = properties.pop("joint_types", None) or "R" * observation.q.shape[1]
        if observation.flange_chart is not None:  # coordinates of a pose have one order
            types, properties = FLANGE_TYPES, properties | {"order_stated": True}
        return cls(**fields, joint_types=types, **properties)

    @classmethod
    def from_arrays(
        cls,
        q: npt.ArrayLike,
        pixels: npt.ArrayLike,
        *,
        view: Sequence[str] | None = None,
        mount: str = WORLD,
        joint_types: str | Sequence[str] | None = None,
        joint_unit: str | None = None,
        marker: Sequence[int] | None = None,
        pose: Sequence[int] | None = None,
        sigma: npt.ArrayLike | None = None,
        image_size: ImageSize | None = None,
        noise_px: float | None = None,
    ) -> "Observations":
        """Return observations from arrays.

        Parameters
        ----------
        q : (K, n) joint readings, rad or m unless ``joint_unit`` says deg, or (K, 4, 4) poses of the flange
            in the base, m.
        pixels : (K, V, m, 2) raw pixels u, v of each marker in each of V images, NaN or masked where unseen.
        view : (V,) names of the views, such as ``("top",)``; by default left and right.
        mount : ``world`` for cameras that watch the tool, ``tool`` for cameras on it.
        joint_types : one letter a joint, R or P; by default all R.
        joint_unit : ``deg`` or ``rad`` of revolute joints; by default rad, and readings beyond two turns are
            refused as a mistaken unit.
        marker, pose : (m,) and (K,) numbers; by default from 0.
        sigma : (K, V, m) standard deviations of a coordinate, px.
        image_size : width and height, px, of all images or of one each; by default the extent of the pixels.
        noise_px : standard deviation of a coordinate, px, if it is common to all; by default estimated.

        Raises
        ------
        InputError
            When an array has another shape, readings are not finite or look like degrees, or a name of a
            view, a mount, an image size or a noise is none.
        """
        names = VIEWS if view is None else tuple(view)
        if isinstance(view, str) or not all(map(is_view, names)) or not 0 < len({*names}) == len(names):
            raise InputError(f"view: {view!r}: expected names of small letters, digits and spaces, each once")
        if mount not in (WORLD, TOOL):
            raise InputError(f"mount: {mount!r}: expected {WORLD} or {TOOL}")
        V = len(names)
        named = "" if view is not None else "; name the views of others: view=(...)"
        images = checked_array("pixels", pixels, (None, V, None, 2), f"(K, {V}, m, 2){named}")
        chart = None
        if np.ndim(q) == 3:
            if joint_types is not None or joint_unit is not None:
                raise InputError(
                    "q: poses of the flange have neither joint_types nor joint_unit: leave them out"
                )
            T = checked_array(
                "q", q, (len(images), 4, 4), f"({len(images)}, 4, 4), a pose of the flange each"
            )
            require_poses(T, [f"q[{k}]" for k in range(len(T))])
            joint_types, joint_unit, chart = FLANGE_TYPES, "rad", FlangeChart.of(T)
            q = chart.coordinates(T)
        readings = checked_array("q", q, (len(images), None), f"({len(images)}, n), a row for each pose")
        if not np.isfinite(readings).all():
            raise InputError("q: holds a number that is not finite; leave such poses out")
        n, m = readings.shape[1], images.shape[2]
        types = _types_of(joint_types, n) or "R" * n
        numbers = _numbers("marker", marker, m), _numbers("pose", pose, len(images))
        readings = in_radians("q", types, numbers[1], readings, joint_unit, "joint_unit={!r}")
        wrong = np.isinf(images).any(axis=-1) | (np.isnan(images).sum(axis=-1) == 1)
        if wrong.any():
            k, i, j = np.argwhere(wrong)[0]
            u, v = images[k, i, j]
            raise InputError(
                f"pixels: marker {j} at pose {k}, view {i} is at ({u:g}, {v:g}): give two finite "
                "numbers, or NaN for both"
            )
        stated = None
        if sigma is not None:
            stated = checked_array("sigma", sigma, images.shape[:3], f"{images.shape[:3]}")
            if not (stated[np.isfinite(images[..., 0])] > 0.0).all():
                raise InputError("sigma: must be positive wherever a marker is seen")
        order = np.argsort(numbers[0])
        images = np.where(np.isfinite(images).all(axis=-1, keepdims=True), images, np.nan)[:, :, order]
        stated = None if stated is None else np.ascontiguousarray(stated[:, :, order])
        record = Observation(
            numbers[1],
            numbers[0][order],
            readings,
            np.ascontiguousarray(images),
            sigma=stated,
            view=names,
            flange_chart=None if chart is None else chart.record,
        )
        noise = KnownNoise(noise_px)
        return cls.of(record, joint_types=types, image_size=image_size, noise=noise, mount=mount)

    @classmethod
    def from_frame(
        cls,
        table: Any,
        *,
        joint_types: str | Sequence[str] | None = None,
        joint_unit: str | None = None,
        image_size: ImageSize | None = None,
        noise_px: float | None = None,
    ) -> "Observations":
        """Return observations from an observation table.

        Parameters
        ----------
        table : a pandas table or a mapping of columns, as [observation tables] have them, or the path of one.
        joint_types : one letter a joint column, R or P; by default all R.
        joint_unit : ``deg`` or ``rad`` of the revolute columns; by default rad.
        image_size : width and height, px, of both images or of one each; by default the extent of the pixels.
        noise_px : standard deviation of a coordinate, px; by default as in the table, otherwise estimated.

        Raises
        ------
        InputError
            If a column is missing, a row is not valid, or an image size or a noise is none.
        """
        types = _types_of(joint_types)
        if isinstance(table, (str, Path)):
            observation, mount = read_table(table, types, joint_unit), mount_in(table)
        else:
            text = _text_of(table)
            observation = read_table("table", types, joint_unit, frame=text)
            mount = mount_in("table", text)
        noise = KnownNoise(noise_px)
        return cls.of(observation, joint_types=types, image_size=image_size, noise=noise, mount=mount)

    @classmethod
    def concat(cls, parts: Sequence["Observations"]) -> "Observations":
        """Return the poses of several observations one after the other, numbered from 0.

        Parameters
        ----------
        parts : observations by the same cameras, as in ``Observations.concat([trials, more])``. Markers that
            one lacks are unseen there; the first gives the seed.

        Raises
        ------
        InputError
            If there are none, or they differ in views, joints, or another property or column.
        """
        if not parts:
            raise InputError("concat: an empty list; give observations")
        marker = np.unique(np.concatenate([part.marker for part in parts]))
        parts = _in_one_chart(parts)
        columns: dict[str, list[Any]] = {}
        motions = 0  # which are numbered on
        for part in parts:
            require_observations("concat", part)
            own = {field.name: getattr(part, field.name) for field in dataclasses.fields(cls)}
            own |= {"marker": marker, "seed": parts[0].seed}
            for name in ("images", "sigma"):
                if (values := own[name]) is not None:
                    own[name] = np.full((*values.shape[:2], len(marker), *values.shape[3:]), np.nan)
                    own[name][:, :, np.searchsorted(marker, part.marker)] = values
            if part.moving is not None:
                own["moving"], motions = (
                    part.moving + motions * (part.moving > 0),
                    motions + part.moving.max(),
                )
            for name, values in own.items():
                columns.setdefault(name, []).append(values)
        joined: dict[str, Any] = {"pose": np.arange(sum(map(len, columns["pose"]))), "marker": marker}
        for name, values in columns.items():
            shapes = {np.shape(one)[1:] if isinstance(one, np.ndarray) else one for one in values}
            if len(shapes) > 1:
                raise InputError(f"concat: the observations differ in {name}: join those alike")
            if name not in (*joined, "flange_chart") and isinstance(values[0], np.ndarray):
                joined[name] = np.concatenate(values)
        return dataclasses.replace(parts[0], **joined)

    def select(self, **which: Any) -> "Observations":
        """Return the observations of some views, poses or markers.

        Parameters
        ----------
        **which : ``view``, ``pose`` and ``marker``, each one or a list, as in
            ``observations.select(view="left", pose=observations.pose[:20])``; by default all.

        Raises
        ------
        InputError
            If one is not among them.
        """
        if unknown := {*which} - {"view", "pose", "marker"}:
            raise InputError(f"select: {min(unknown)}: choose view, pose or marker")
        changed: dict[str, Any] = {f.name: getattr(self, f.name) for f in dataclasses.fields(Observation)}
        for name, asked in which.items():
            wanted = list(asked) if np.iterable(asked) and not isinstance(asked, str) else [asked]
            known = list(changed[name])
            if not wanted or {*wanted} - {*known} or len({*wanted}) < len(wanted):
                raise InputError(f"select: {name} {asked!r:.60}: choose among {known!r:.80}, each once")
            at = [known.index(one) for one in (sorted(wanted) if name == "marker" else wanted)]
            for field in dataclasses.fields(Observation):
                dims, values = field.metadata.get("dims") or (), changed[field.name]
                if name in dims and values is not None:
                    changed[field.name] = np.take(values, at, axis=dims.index(name))
            if name == "view":
                changed["view"] = tuple(wanted)
                sizes: Any = self.image_size
                if np.ndim(sizes or 0) == 2:
                    changed["image_size"] = tuple(sizes[v] for v in at)
        return dataclasses.replace(self, **changed)

    def to_frame(self) -> Any:
        """Return the observation table as a pandas table; an InputError without pandas."""
        return pandas().read_csv(io.StringIO(table_text(self, mount=self.mount)))

    def summary(self) -> dict[str, str]:
        """Return a summary in words, by name."""
        detected = np.isfinite(self.images[..., 0])
        moving = 0 if self.moving is None else int((self.moving > 0).sum())
        noise = "to be estimated" if self.noise_px is None else f"{self.noise_px:g} px"
        return {
            "source": self.source,
            "joints": self.joint_types,
            "poses": f"{len(self.pose) - moving}" + (f" and {moving} in motion" if moving else ""),
            "markers": str(len(self.marker)),
            "seen": f"{detected.mean():.0%} of {detected.size} marker-view pairs",
            "noise": "stated for each pixel" if self.noise_px is None and self.sigma is not None else noise,
        }


def _in_one_chart(parts: Sequence["Observations"]) -> list["Observations"]:
    """Poses of the flange in the coordinates of the first observations."""
    chart = FlangeChart.from_optional(getattr(parts[0], "flange_chart", None))
    moved = []
    for part in parts:
        own = FlangeChart.from_optional(getattr(part, "flange_chart", None))
        if chart is not None and own is not None:
            part = dataclasses.replace(
                part, q=chart.coordinates(own.poses(part.q)), flange_chart=chart.record
            )
        moved.append(part)
    return moved


def _types_of(joint_types: str | Sequence[str] | None, n: int | None = None) -> str | None:
    """Letters of the types of joints, of which there are n if that is known; None if none are given."""
    if joint_types is None:
        return None
    letters = [*joint_types] if np.iterable(joint_types) else [joint_types]
    types = "".join(map(str, letters)).upper()
    if set(types) - {"R", "P"} or len(types) != (len(types) if n is None else n):
        some = "letters" if n is None else f"{n} letters"
        raise InputError(f"joint_types: {joint_types!r}: expected {some} R or P, one per joint")
    return types


def _numbers(name: str, wanted: Sequence[int] | None, count: int) -> npt.NDArray[np.int64]:
    numbers = np.arange(count) if wanted is None else _unmasked(wanted)
    if numbers.dtype.kind == "f" and (numbers == np.rint(numbers)).all():
        numbers = numbers.astype(np.int64)
    if numbers.shape != (count,) or numbers.dtype.kind not in "iu" or len(set(numbers.tolist())) < count:
        raise InputError(f"{name}: expected {count} different whole numbers, not {wanted!r:.60}")
    return numbers.astype(np.int64)


def _text_of(table: Any) -> str:
    if hasattr(table, "to_csv"):
        return str(table.to_csv(index=False))
    if isinstance(table, Mapping):
        return to_csv({name: or_empty(_unmasked(values)) for name, values in table.items()})
    raise InputError(
        f"table: a {type(table).__name__}; expected a pandas table, a mapping of columns or a path"
    )


def _unmasked(values: Any) -> npt.NDArray[Any]:
    """A column, NaN if it is masked."""
    return numbers_in("table", values, "(rows,)") if np.ma.is_masked(values) else np.asarray(values)


def require_observations(what: str, observations: Any, kind: type[Observation] = Observations) -> None:
    """Raise InputError unless observations are of their kind."""
    if not isinstance(observations, kind):
        raise InputError(
            f"{what}: observations of type {type(observations).__name__}; make them with "
            "Observations.from_arrays or Observations.from_frame"
        )
