"""Results of stages for those who call them: calibrations that predict, plans and traces."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self, cast, overload

import numpy as np
import numpy.typing as npt

from projservo_cli.calibration.checks.validation import residual_statistics
from projservo_cli.calibration.prediction import (
    error_factor,
    error_factor_with_model,
    joint_derivative,
    predict,
    prediction_variance,
)
from projservo_cli.calibration.refit import refit, since_moved
from projservo_cli.geometry.kinematics import project as pixels_of
from projservo_cli.metric.frame import Metric, Scale, links
from projservo_cli.metric.nominal_comparison import KinematicErrors, in_model_frames, kinematic_errors
from projservo_cli.observations import Observations, require_observations
from projservo_cli.planning.pose_selection import Suggestion, region_around, suggest
from projservo_cli.records import (
    MM,
    TOOL,
    BoolArray,
    Calibration,
    CrossValidation,
    FloatArray,
    InputError,
    JointLimits,
    Model,
    Observation,
    Plan,
    Report,
    Trace,
)
from projservo_cli.settings.task import Trajectory
from projservo_cli.simulation.urdf import UrdfChain, urdf_chain
from projservo_cli.store.display import (
    Displayable,
    Printed,
    checked_array,
    numbers_in,
    pandas,
    require_radians,
    xarray,
)
from projservo_cli.store.files_and_locks import bytes_of
from projservo_cli.task.objects.displaced_object import DisplacedObject
from projservo_cli.task.objects.object_bundle_adjustment import ObjectView

_AT_ONCE = 100  # poses whose derivatives are worked out together: more of them leave the cache
_MAX_BYTES = 10_000_000  # maximum size of a URDF
_AT_INFINITY = 1e-12  # share of the norms that rounding leaves of a_inf @ A there


def _axes_of(ax: Any) -> Any:
    """Return axes to draw into. Raises InputError for other values, such as the array of ``subplots``."""
    from matplotlib.axes import Axes

    if not isinstance(ax, Axes):
        raise InputError(f"plot: ax of type {type(ax).__name__}: give one axes of a figure")
    return ax


def _fields_of(record: Any, kind: type) -> dict[str, Any]:
    return {field.name: getattr(record, field.name) for field in dataclasses.fields(kind)}


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class HeldOutErrors(Displayable, CrossValidation):
    """A cross-validation that shows itself."""

    def summary(self) -> dict[str, str]:
        """Return a summary in words, by name."""
        found = {"folds": f"{self.folds} of {self.unit}", "count": f"{self.count} marker-view pairs"}
        if self.rms_px is not None:
            found["held out"] = (
                f"rms {self.rms_px:.3g} px (predicted {self.predicted_rms_px or math.nan:.3g}), "
                f"median {self.median_px:.3g}, p95 {self.p95_px:.3g}"
            )
        if self.posture_rms_px is not None and self.time_rms_px is not None:
            blocks = f"of posture rms {self.posture_rms_px:.3g} px, of time rms {self.time_rms_px:.3g} px"
            found["in blocks"] = blocks
        if self.failed:
            found["failed"] = "; ".join(self.failed)
        return found | {"reason": self.reason}


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class WrittenReport(Displayable, Report):
    """A report that shows itself."""

    @classmethod
    def of(cls, report: Report) -> Self:
        """Return a record with its functions."""
        return cls(**_fields_of(report, Report))

    def summary(self) -> dict[str, str]:
        """Return a summary in words, by name."""
        judged = [claim["holds"] for claim in self.claims]
        found = {"figures": f"{len(self.figures)} files", "omitted": f"{len(self.omitted)}"}
        if judged:
            found["claims"] = (
                f"{judged.count(True)} hold, {judged.count(False)} do not, {judged.count(None)} not judged"
            )
        failing = [claim["claim"] for claim in self.claims if claim["holds"] is False]
        return found | ({"do not hold": ", ".join(failing)} if failing else {})


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ImageModel(Displayable, Calibration):
    """A calibration that predicts images: all of its arrays, with functions on them.

    Views are left and right, markers in the order of ``marker``, pixels are raw u and v, joint
    readings rad or m. A point that is not in front of a camera has no pixels there: NaN.
    """

    cross_validation: HeldOutErrors | None = None  # held-out errors, if they were asked for
    observation: Observation | None = None  # observation of the calibration, if at hand

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        cross_validation: CrossValidation | None = None,
        observation: Observation | None = None,
    ) -> "ImageModel":
        """Return a record with its functions."""
        if isinstance(calibration, cls):
            return calibration
        held_out = None
        if cross_validation is not None:
            held_out = HeldOutErrors(**_fields_of(cross_validation, CrossValidation))
        return cls(**_fields_of(calibration, Calibration), cross_validation=held_out, observation=observation)

    def plot(self, ax: Any = None) -> Any:
        """Draw the residuals of the calibration and the observability of the joints, as the report does.

        Parameters
        ----------
        ax : axes into which the residuals alone are drawn, a colour a view; by default a figure is returned.

        Raises
        ------
        InputError
            When the observations that it was made from are not at hand.
        """
        observed = self._at_hand("plot")
        if ax is not None:
            *_, v, off, used = self._residuals(observed)
            for i, name in enumerate(self.view):
                _axes_of(ax).plot(*off[(v == i) & used].T, ".", markersize=2.0, label=f"{name} camera")
            ax.set(xlabel="u off the prediction (px)", ylabel="v off the prediction (px)")
            return ax
        from projservo_cli.report import figures  # so that those who draw nothing need not import all figures

        return figures.of_calibration(self, observed, self.cross_validation)

    @overload
    def predict(self, q: npt.ArrayLike, *, return_std: Literal[False] = False) -> FloatArray: ...
    @overload
    def predict(self, q: npt.ArrayLike, *, return_std: Literal[True]) -> tuple[FloatArray, FloatArray]: ...
    def predict(
        self, q: npt.ArrayLike, *, return_std: bool = False
    ) -> FloatArray | tuple[FloatArray, FloatArray]:
        """Pixels of all markers at joint readings, [RH00] eqs. (1), (6).

        Parameters
        ----------
        q : (n,) or (K, n) readings, rad or m.
        return_std : whether to return the standard deviations of the predictions as well, px, by the
            covariance of the calibration to first order; the noise of an image is not in them.

        Returns
        -------
        (2, m, 2) or (K, 2, m, 2) pixels, and on request as many standard deviations.

        Raises
        ------
        InputError
            If the readings have another number of joints, are not finite or look like degrees.
        """
        rows, single = self._rows(q)
        pixels = predict(self, rows)
        if not return_std:
            return pixels[0] if single else pixels
        sigma = np.sqrt(prediction_variance(self, rows))
        return (pixels[0], sigma[0]) if single else (pixels, sigma)

    def jacobian(self, q: npt.ArrayLike) -> FloatArray:
        """Derivative of the predicted pixels by the joint readings, [RH00] eqs. (7), (19).

        Parameters
        ----------
        q : (n,) or (K, n) readings, rad or m.

        Returns
        -------
        (2, m, 2, n) or (K, 2, m, 2, n) derivatives, px per rad or m.

        Raises
        ------
        InputError
            If the readings have another number of joints, are not finite or look like degrees.
        """
        rows, single = self._rows(q)
        parts = range(0, max(1, len(rows)), _AT_ONCE)
        J = np.concatenate([joint_derivative(self, rows[k : k + _AT_ONCE]) for k in parts])
        J[np.isnan(predict(self, rows)[..., 0])] = np.nan
        return J[0] if single else J

    def score(self, observation: Observation) -> dict[str, Any]:
        """Compare predictions with images that the calibration has not seen, as ``projservo validate`` does.

        Parameters
        ----------
        observation : images of the same robot, rig and markers; those in motion do not count.

        Returns
        -------
        ``count`` of marker-view pairs; ``rms_px``, ``median_px``, ``p95_px`` of their Euclidean distances,
        None without a pair; ``stated_px``, the median error that the covariance states there, ``noise_px`` of
        these images, and ``limit_px``, three times both together, above which the median contradicts the
        calibration; ``views``, with the ``view``, ``count``, ``median_px`` and ``limit_px`` of each, which
        show a camera that moved; ``skipped`` by why; ``findings``, one that refuses if a limit is passed.

        Raises
        ------
        InputError
            If it is no observation, or the readings have another number of joints or are not finite.
        """
        require_observations("score", observation, Observation)
        return residual_statistics(self, observation)

    def refitted(self, view: str, observations: Observations) -> "ImageModel":
        """Fit a camera that moved again, as ``projservo calibrate --refit`` does.

        Parameters
        ----------
        view : name of the camera.
        observations : images of its markers since it moved, at joint readings, and perhaps by other cameras.

        Returns
        -------
        The calibration with the new camera; one that is not ``usable`` says why in ``reason``.

        Raises
        ------
        InputError
            If there is no such camera, or the calibration has no covariance.
        WorkFailed
            If the camera has not moved, or the images do not determine it, or do not confirm the joint
            readings.
        """
        require_observations("refitted", observations)
        found, old = refit(self, observations, view, observations.image_size), self.observation
        old = None if old is None else since_moved(old, observations, view)
        return ImageModel.of(Calibration(**_fields_of(found, Calibration)), observation=old)

    def suggest(
        self, count: int = 5, *, limits: tuple[npt.ArrayLike, npt.ArrayLike] | None = None, seed: int = 0
    ) -> tuple[Suggestion, ...]:
        """Return the poses that would reduce the variance of predictions most, in their order.

        Parameters
        ----------
        count : how many.
        limits : lower and upper limits (n,) of the joints, rad or m; by default none.
        seed : of the poses that are drawn to choose from, a little beyond those that were recorded.

        Returns
        -------
        Suggestions with ``q`` (n,), ``from_pose``, ``delta`` (n,) from there, ``variance_before`` and
        ``variance_after``, px².

        Raises
        ------
        InputError
            When the observations are not at hand, or there is no covariance.
        WorkFailed
            When no pose shows the markers to all views.
        """
        observed, n = self._at_hand("suggest"), len(self.joint_types)
        lower, upper = (-np.inf, np.inf) if limits is None else limits
        low, high = (np.broadcast_to(np.asarray(bound, dtype=np.float64), n) for bound in (lower, upper))
        size = observed.image_size if isinstance(observed, Observations) else None
        region = region_around(observed.at_rest, size, low, high)
        return suggest(self, observed.at_rest, region, region, count, np.random.default_rng(seed))

    def residuals(self) -> Any:
        """Return the residuals of the calibration as a pandas table, a row for each marker seen in a view.

        Columns are ``pose``, ``marker``, ``view``, the pixels ``u`` and ``v``, their differences from the
        prediction, ``du`` and ``dv`` in px, and ``used``, whether the fit took them.

        Raises
        ------
        InputError
            When the observations are not at hand, or pandas is not installed.
        """
        pixels, pose, m, v, off, used = self._residuals(self._at_hand("residuals"))
        columns = {"pose": pose, "marker": self.marker[m], "view": np.array(self.view)[v]}
        (u, v), (du, dv) = pixels.T, off.T
        return pandas().DataFrame(columns | {"u": u, "v": v, "du": du, "dv": dv, "used": used})

    def _residuals(self, observed: Observation) -> tuple[npt.NDArray[Any], ...]:
        """Pixels (r, 2), pose, marker and view by index, residuals (r, 2), and whether the fit took them."""
        from projservo_cli.report.figures.calibration import observed_pixels

        observed = observed.at_rest
        pixels, rejected = observed_pixels(self, observed)
        off = pixels - predict(self, observed.q)
        k, v, m = np.nonzero(np.isfinite(off).all(axis=-1))
        return pixels[k, v, m], observed.pose[k], m, v, off[k, v, m], rejected[k, v, m] == 0

    def _at_hand(self, what: str) -> Observation:
        """Return the observations that the calibration was made from."""
        if self.observation is None:
            raise InputError(f"{what}: the observations that the calibration was made from are not at hand")
        return self.observation

    def covariance(self) -> FloatArray:
        """Return the covariance of P, H_hat_0, lenses (k1, k2 of both, if estimated) and M, each raveled.

        Frame and scales, which no image shows, are fixed: of all errors that change images alike it has the
        smallest. For many markers it is large: (24 + 16 n + 4 m)² numbers.
        """
        factor = error_factor(self)
        return np.asarray(factor @ factor.T)

    def metric(
        self,
        length_m: float | None = None,
        between: Scale = "joint",
        *,
        length_std_m: float = 0.0,
        face: Sequence[int] | None = None,
    ) -> "MetricModel":
        """Return cameras, axes and markers in metres, in the base frame of the arm, with covariances.

        Parameters
        ----------
        length_m : a known length, m; not needed with ``joint``.
        between : two ends of the length: the numbers of two markers; ``tags``, the sides of all; ``cameras``,
            the distance of their centres; or ``joint``, the readings of the first prismatic joint.
        length_std_m : standard deviation of the length, m.
        face : numbers of markers whose frame the tool has, by default all; with cameras on it, the tool is
            the flange, whose frame is by the joints.

        Raises
        ------
        InputError
            If the joints determine no metric, the images of one camera are mirrored, or the length is not
            known.
        """
        return MetricModel.of(
            self,
            error_factor_with_model(self),
            length_m=length_m,
            between=between,
            length_std_m=length_std_m,
            face=face,
        )

    def project(self, points: npt.ArrayLike) -> FloatArray:
        """Pixels of points of the calibration's projective frame, such as ``M``, [RH00] eq. (1).

        Parameters
        ----------
        points : (..., 4) homogeneous points, of any scale.

        Returns
        -------
        (2, ..., 2) pixels; of a point at infinity its vanishing point.

        Raises
        ------
        InputError
            If the points have not four coordinates.
        """
        A = numbers_in("points", points, "(..., 4)")
        if A.ndim == 0 or A.shape[-1] != 4:
            raise InputError(f"points of shape {A.shape}: expected four homogeneous coordinates each")
        depth = np.einsum("vj,...j->v...", self.P[:, 2], A)
        side = A @ self.a_inf
        norms = np.linalg.norm(A, axis=-1) * np.linalg.norm(self.a_inf)
        ahead = np.where(np.abs(side) > _AT_INFINITY * norms, depth * side > 0.0, depth != 0.0)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return np.where(ahead[..., None], pixels_of(self.P, A, self.model().lens), np.nan)

    def displaced(
        self, marker: Sequence[int], looks: Sequence[npt.ArrayLike], *, metric: Metric | None = None
    ) -> DisplacedObject:
        """Find where an object of the scene lies by looks at it, to carry goals that were taught on it along.

        Its displacement is rigid in the metric that the joints preserve, otherwise affine. Looks in between
        refine its shape.

        Parameters
        ----------
        marker : (k,) numbers of the markers of the object, as messages name them.
        looks : two or more, each (V, k, 2) px, NaN where unseen: the first when the goal was taught, the last
            now.
        metric : result of ``metric``, for mm.

        Returns
        -------
        The object, with ``D``, ``shift_px``, ``shift_mm`` and ``angle_deg``; ``carry`` takes a goal along.

        Raises
        ------
        InputError
            If an observation has another shape, cameras are on the tool or the calibration has no covariance.
        WorkFailed
            If images or joints do not show the displacement, with the freedom that is missing.
        """
        shape = (len(self.view), len(marker), 2)
        seen = [
            ObjectView(checked_array(f"looks[{i}]", s, shape, f"{shape} px")) for i, s in enumerate(looks)
        ]
        if len(seen) < 2:
            raise InputError(f"looks: {len(seen)}, of two or more: one when the goal was taught, and one now")
        return DisplacedObject.of(self, marker, seen, metric)

    def summary(self) -> dict[str, str]:
        """Return a summary in words, by name."""
        poorly = ", ".join(f"q{i + 1}" for i in np.flatnonzero(self.poorly_observable)) or "none"
        rejected = len(self.outlier)
        return {
            "usable": f"{'yes' if self.usable else 'no'}: {self.reason}",
            "source": f"{self.source}, method {self.method}",
            "joints": f"{self.joint_types}, poorly observable: {poorly}",
            "poses": f"{self.poses_used}",
            "markers": f"{self.markers_used}",
            "rejected": f"{rejected} observations",
            "residual": f"{self.rms_px:.4g} px rms per marker and view",
            "noise": f"{self.sigma_px:.4g} px per coordinate",
        }

    def _rows(self, q: npt.ArrayLike) -> tuple[FloatArray, bool]:
        n = len(self.joint_types)
        readings = numbers_in("joint readings", q, f"({n},) or (K, {n})")
        if readings.ndim not in (1, 2) or readings.shape[-1] != n or not np.isfinite(readings).all():
            raise InputError(
                f"joint readings of shape {readings.shape}: expected {n} finite numbers, or rows of them"
            )
        require_radians("joint readings", readings, self.joint_types)
        return np.atleast_2d(readings), readings.ndim == 1


class MetricModel(Printed, Metric):
    """A calibration in metres, in the base frame of the arm: its arrays, and functions with covariances.

    Arrays: ``K`` (V, 3, 3) intrinsic matrices, px; ``lens`` (V, 5) centre u, v and radius, px, then k1, k2;
    ``poses`` (V, 4, 4) of the cameras in the base, z forward and y down, m; ``axes`` (n, 6) screws of the
    joints at readings of zero, w rad and v m, per rad or m; ``markers`` (m, 3) in the tool frame, m. Of each
    ``covariance`` (name). With cameras on the tool, ``poses`` are in the flange, the hand–eye transformation,
    and ``markers`` in the base.

    The base frame has z along joint 1 and x along z × the direction of the first joint that is not parallel
    to it, at readings of zero; its origin is on the first revolute axis, at its common normal with the first
    revolute one that is not parallel. The tool frame has its origin at the mean of the face, x from its first
    marker to its second, and z across them and the next that is not on their line. The flange frame of
    cameras on the tool is the frame of the base, from the last joint back. ``in_frames_of`` takes the frames
    of a model instead. Covariances follow from the calibration, to first order, with covariances of frames
    and of the known length.
    """

    def in_frames_of(self, urdf: str | Path, tip: str | None = None) -> "MetricModel":
        """Return the same in the base of a model, with the tool in the frame of one of its links.

        The base is where the model fits the calibrated axes best, after the zeros of its inner joints. Those
        of the first and the last joint no image knows: they are as in the model.

        Parameters
        ----------
        urdf : file of the model.
        tip : link that carries the tool; by default the last one.

        Raises
        ------
        InputError
            If the file is no URDF, the link is not in it, or its joints are of other types.
        WorkFailed
            If the model does not describe the arm, as with a joint that turns the other way.
        """
        chain = _urdf_chain(urdf, tip)
        return cast(MetricModel, in_model_frames(self, chain.axes, chain.tip))

    def errors_of(self, urdf: str | Path, tip: str | None = None) -> KinematicErrors:
        """Return the errors of a model: zeros of joints, then axes, each with its standard deviation.

        Parameters
        ----------
        urdf, tip : as for ``in_frames_of``.

        Returns
        -------
        ``joints``, for each ``joint``, ``zero`` (rad or m to add to readings before the model takes them,
        None for the first and the last joint), ``offset_m`` and ``tilt_rad`` of its axis; and ``length``, the
        share by which the known length is too short for the links of the model.

        Raises
        ------
        InputError, WorkFailed
            As for ``in_frames_of``.
        """
        return kinematic_errors(self, _urdf_chain(urdf, tip).axes)

    def to_xarray(self) -> Any:
        """Return the arrays as a Dataset, with coordinates; an InputError without xarray."""
        square, joints = ("row", "coordinate"), [f"q{i + 1}" for i in range(len(self.joint_types))]
        return xarray().Dataset(
            {
                "K": (("view", "image_row", "image_column"), self.K, {"units": "px"}),
                "lens": (("view", "lens_term"), self.lens, {"units": "px, k1 and k2 1"}),
                "poses": (("view", *square), self.poses, {"units": "m"}),
                "axes": (("joint", "screw"), self.axes, {"units": "w rad, v m, per rad or m"}),
                "markers": (("marker", "axis"), self.markers, {"units": "m"}),
            },
            {"view": [*self.view], "joint": joints, "marker": self.marker, "axis": [*"xyz"]},
        )

    def summary(self) -> dict[str, str]:
        """Return a summary in words, by name."""
        places, of_poses = self.poses[:, :3, 3], self.covariance("poses")
        focal, of_K = self.K[:, (0, 1), (0, 1)], np.sqrt(self.covariance("K")[:, 0, 0])
        found = {"joints": self.joint_types, "markers": f"{len(self.marker)}"}
        for v, view in enumerate(self.view):
            std, turn = (np.sqrt(np.trace(part)) for part in (of_poses[v, 3:, 3:], of_poses[v, :3, :3]))
            at = f"({', '.join(f'{x:.4g}' for x in places[v])}) m ± {MM * std:.2g} mm"
            if self.mount == TOOL:
                at += f", {np.degrees(turn):.2g}° in the flange"
            found[f"{view} camera"] = f"at {at}, focal length {focal[v].mean():.5g} ± {of_K[v]:.2g} px"
        distances = links(self.axes, self.prismatic, self.axes)[1]
        found["links"] = ", ".join("–" if np.isnan(d) else f"{d:.4g}" for d in distances) + " m between axes"
        return found

    def _readings(self, q: npt.ArrayLike) -> FloatArray:
        readings = super()._readings(numbers_in("joint readings", q, f"(…, {len(self.joint_types)})"))
        require_radians("joint readings", readings, self.joint_types)
        return readings

    def _pixels(self, pixels: npt.ArrayLike) -> tuple[FloatArray, BoolArray, tuple[int, ...]]:
        return super()._pixels(numbers_in("pixels", pixels, f"(…, {len(self.view)}, m, 2)"))


def _urdf_chain(urdf: str | Path, tip: str | None) -> UrdfChain:
    return urdf_chain(str(urdf), tip, bytes_of(urdf, "a URDF", _MAX_BYTES))


class PlanScene(NamedTuple):
    """Scene of the figure of a plan."""

    model: Model  # as calibrated
    limits: JointLimits  # infinite if none is set
    image_size: FloatArray | None  # (V, 2) px, of each; None where unknown
    trajectory: Trajectory  # requested motion


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class MotionPlan(Displayable, Plan):
    """A plan that shows itself."""

    scene: PlanScene | None = None  # scene of its figure, if at hand
    asked: tuple[Any, Any] = (None, None)  # start and goal as requested; None for the configuration's

    @classmethod
    def of(cls, plan: Plan, scene: PlanScene | None = None, asked: tuple[Any, Any] = (None, None)) -> Self:
        """Return a record with its functions."""
        return plan if isinstance(plan, cls) else cls(**_fields_of(plan, Plan), scene=scene, asked=asked)

    def plot(self, ax: Any = None) -> Any:
        """Draw the motion in both images, its joints and its margins over time, as the report does.

        Parameters
        ----------
        ax : axes into which visibility alone is drawn, a curve a camera; by default a figure is returned.

        Raises
        ------
        InputError
            When the calibration that it was made with is not at hand.
        """
        if ax is not None:
            for name, margin in zip(self.view, self.margin.T, strict=True):
                _axes_of(ax).plot(self.time, margin, label=f"{name} camera")
            ax.set(xlabel="time (s)", ylabel="visibility (start = 1)")
            return ax
        if self.scene is None:
            raise InputError("plot: the calibration that the plan was made with is not at hand")
        from projservo_cli.report import figures

        return figures.of_plan(self, self.scene)

    def summary(self) -> dict[str, str]:
        """Return a summary in words, by name."""
        r, p, s = (math.degrees(angle) for angle in (self.theta_r, self.theta_p, self.theta_s))
        return {
            "feasible": f"{'yes' if self.feasible else 'no'}: {self.reason}",
            "profile": self.profile,
            "rotation": f"{r:.4g} deg onto the plane, {p:.4g} deg within it, {s:.4g} deg together",
            "duration": "none" if self.duration is None else f"{self.duration:.4g} s",
            "nearest to failing": self.constraint,
            "samples": str(len(self.path_parameter)),
        }


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class RunTrace(Displayable, Trace):
    """A trace that shows itself."""

    face: tuple[int, ...] = ()  # numbers of the markers of the face, if they are known

    @classmethod
    def of(cls, trace: Trace, face: tuple[int, ...] = ()) -> Self:
        """Return a record with its functions."""
        return trace if isinstance(trace, cls) else cls(**_fields_of(trace, Trace), face=face)

    def plot(self, ax: Any = None, *, label: str = "") -> Any:
        """Draw the image errors of the markers over time, as the report does.

        Parameters
        ----------
        ax : axes into which the image error of the run is drawn as one curve, next to others; by default a
            figure is returned.
        label : name of that curve; by default the name of the law.
        """
        if ax is not None:
            t = self.period * np.arange(len(self.image_error))
            _axes_of(ax).semilogy(t, self.image_error, label=label or self.law)
            ax.set(xlabel="time (s)", ylabel="image error (px rms)")
            return ax
        from projservo_cli.report import figures

        return figures.of_trace(self, self.face)

    def coordinates(self) -> dict[str, Any]:
        """Return coordinates of dimensions, by their names; ``time`` is in the record."""
        face = {"marker": list(self.face)} if self.face else {}
        return super().coordinates() | face

    def summary(self) -> dict[str, str]:
        """Return a summary in words, by name."""
        found = {
            "law": self.law,
            "mode": self.mode if self.planned_s is None else f"{self.mode}, a plan of {self.planned_s:.4g} s",
            "features": self.features,
            "verdict": f"{self.verdict}: {self.reason}",
            "steps": f"{self.steps}, {self.steps * self.period:.4g} s",
            "image error": f"{self.image_error[-1]:.4g} px rms as seen",
        }
        if self.incidences:
            found["incidences"] = f"{', '.join(self.incidences)}; {self.free_dof or 'no'} joint motion free"
        if self.unplanned:
            found["unplanned"] = f"regulated to the goal: {self.unplanned}"
        if self.untested:
            found["images"] = f"not tested against the calibration: {self.untested}"
        if self.features == "body":
            found["image error"] += f", {self.convergence_error[-1]:.4g} px by all markers"
        if self.position_error_mm is not None:
            found["position error"] = f"{self.position_error_mm:.4g} mm"
        elif self.estimated_position_error_mm is not None:
            found["position error"] = f"within {self.estimated_position_error_mm:.3g} mm"
        if self.rotation_error_deg is not None:
            found["rotation error"] = f"{self.rotation_error_deg:.4g} deg"
        return found
