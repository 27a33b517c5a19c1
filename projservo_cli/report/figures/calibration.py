"""Diagnostics of a calibration: residuals of the images, and observability of the joints."""

from typing import Any

import numpy as np
from scipy.special import chdtri

from projservo_cli.calibration.detections import MAX_JUDGED, even_choice, per_rad
from projservo_cli.calibration.prediction import (
    error_factor,
    errors_of,
    from_reference,
    joint_derivative,
    parameters_from,
    pixel_changes,
    predict,
    prediction_variance,
)
from projservo_cli.records import BoolArray, Calibration, FloatArray, IntArray, Observation
from projservo_cli.report import panels, style
from projservo_cli.report.figure_inputs import Data, Fit, registered

_ARROW = 0.04  # length of an arrow of the rms residual, as a fraction of the extent of the observations
_BAND = (0.025, 0.975)  # shares of χ² between which the residuals of a pose are expected
_BINS = 40
_RESIDUAL = style.line(style.BLUE)
_POSE = style.dots(style.BLUE, "o", "residual of a pose", markersize=2.5)
_HATCHED: Any = {"edgecolor": style.BLACK, "hatch": "////", "linewidth": 0.6}
_WEAK = style.patch(style.ORANGE, "weak joint", **_HATCHED)
_MODEL = style.line(style.BLACK, width=1.2, label="noise model")
# Rejected observations by the reason: by themselves, their number, their pose, or their marker as a whole.
_LEFT_OUT = {
    "outlier": style.dots(style.VERMILION, "x", "rejected: outlier"),
    "id_switch": style.dots(style.ORANGE, "+", "rejected: under another number"),
    "pose": style.dots(style.BLACK, "1", "rejected: of a pose in doubt"),
    "marker": style.dots(style.GREEN, ".", "rejected: of a rejected marker"),
}
_KINDS = tuple(_LEFT_OUT)
_LARGE, _SMALL, _MANY = 4.0, 1.5, 300  # sizes of these points, pt, and how many are many


def _data(fit: Fit) -> Data:
    """Residuals, noise model, predicted error of each pose, excitation and information of a fit."""
    calibration, observation = fit.calibration, fit.observation
    predicted = predict(calibration, observation.q)
    pixels, rejected = observed_pixels(calibration, observation)
    measured: BoolArray = np.all(np.isfinite(pixels), axis=-1)
    excluded = (rejected > 0) | ~np.isfinite(predicted).all(axis=-1)
    used = measured & ~excluded
    residual, variance = pixels - predicted, prediction_variance(calibration, observation.q)
    weighed = calibration.sigma_q or observation.sigma is not None or calibration.sigma_view_px is not None
    if weighed:
        residual, variance = _as_tested(fit, residual, used)
    result: Data = {
        "sigma_px": np.array(calibration.sigma_px),
        "chi2_per_dof": np.array(calibration.chi2_per_dof),
        "excitation": calibration.excitation,
        "prismatic": calibration.prismatic,
        "weak": calibration.poorly_observable,
        "information": _information(calibration),
        "parameters": np.array(len(calibration.sqrt_cov_shared) + calibration.M[:MAX_JUDGED].size),
        "residual": residual[used].ravel(),
        "held_out": np.array(fit.held_out is not None),
        "weighed": np.array(bool(weighed)),
    }
    if fit.held_out is None:
        result |= _by_pose(used, residual, variance)
    else:  # from fits that have not seen the pose; predicted with the noise of the held-out reading
        predictable: BoolArray = np.all(np.isfinite(fit.held_out.residual), axis=-1)
        result |= _by_pose(predictable, fit.held_out.residual, fit.held_out.predicted**2)
    unknown = observation.images[:, :, ~np.isin(observation.marker, calibration.marker)]
    for v, view in enumerate(calibration.view):
        unidentified = unknown[:, v][np.isfinite(unknown[:, v]).all(axis=-1)]
        result[f"seen_{view}"] = pixels[:, v][used[:, v]]
        result[f"residual_{view}"] = residual[:, v][used[:, v]]
        reason = np.maximum(rejected, 1)  # a marker without a prediction counts as an outlier
        positions = [pixels[:, v][(measured & excluded & (reason == i))[:, v]] for i in range(1, len(_KINDS))]
        result |= {
            f"rejected_{kind}_{view}": of_kind
            for kind, of_kind in zip(_KINDS, (*positions, unidentified), strict=True)
        }
    extent = max(float(np.ptp(pixels[:, v][measured[:, v]], axis=0).max()) for v in range(pixels.shape[1]))
    residual = result["residual"]
    rms = float(np.sqrt(2.0 * np.mean(residual**2))) if residual.size else 0.0
    result["factor"] = np.array(style.magnification(rms, _ARROW * extent))
    return result


def _as_tested(fit: Fit, residual: FloatArray, used: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Residuals (K, 2, m, 2), px, that are to scatter as the noise model, and the variance of predictions.

    Those of a pose, weighed if their deviations are stated, have the covariance S = σ² (I + G Gᵀ), with G
    the derivative by the joints times their noise over σ. With G = U s Vᵀ, σ S^-½ takes the share
    1 − (1 + s²)^-½ from the part along U. It mixes the separate errors of markers: of the squares
    of their mutual contributions, only their sum A over all is needed.
    """
    calibration, q = fit.calibration, fit.observation.q
    weight = np.ones(used.shape)
    if calibration.sigma_view_px is not None:
        weight *= (calibration.sigma_px / calibration.sigma_view_px)[None, :, None]
    if (stated := fit.observation.sigma) is not None:
        stated = stated[:, :, _columns(calibration, fit.observation)]
        weight[used] *= np.sqrt(np.mean(stated[used] ** 2)) / stated[used]
    noise = (calibration.sigma_q or 0.0) * per_rad(calibration.prismatic) / calibration.sigma_px
    G = weight[..., None, None] * joint_derivative(calibration, q) * noise
    tested, variance = residual * weight[..., None], np.empty_like(residual)
    for k, of_pose in enumerate(used):
        parts = pixel_changes(
            parameters_from(calibration), errors_of(calibration), from_reference(calibration, q[k : k + 1])
        )
        common, own = (part[0] * weight[k, ..., None, None] for part in parts)
        variance[k] = (common**2).sum(axis=-1) + (own**2).sum(axis=-1)
        if not of_pose.any():  # a pose that is left out is not tested
            continue
        U, s, _ = np.linalg.svd(G[k][of_pose].reshape(-1, len(q[k])), full_matrices=False)
        rows = np.concatenate([tested[k][..., None], common], axis=-1)[of_pose].reshape(len(U), -1)
        across = U * (1.0 - 1.0 / np.sqrt(1.0 + s**2))
        rows -= across @ (U.T @ rows)
        tested[k][of_pose] = rows[:, 0].reshape(-1, 2)
        # Uᵀ own of each marker, of both views: (m, n, 3).
        along = np.zeros((used.shape[2], len(s), 3))
        marker = np.repeat(np.nonzero(of_pose)[1], 2)
        own = own[of_pose].reshape(-1, 3)
        np.add.at(along, marker, U[:, :, None] * own[:, None])
        A = np.tensordot(along, along, axes=([0, 2], [0, 2]))
        mixed = ((across @ A) * across).sum(axis=1)
        kept = (own**2).sum(axis=1) - 2.0 * np.einsum("ai,aij,aj->a", across, along[marker], own)
        variance[k][of_pose] = ((rows[:, 1:] ** 2).sum(axis=1) + kept + mixed).reshape(-1, 2)
    return tested, variance


def observed_pixels(calibration: Calibration, observation: Observation) -> tuple[FloatArray, IntArray]:
    """Pixels (K, 2, m, 2) of the calibrated markers, and why the fit left them out (K, 2, m), 0 for not.

    Those are outliers (1), markers that were read under another number (2), and poses in doubt (3).
    """
    pixels, every = observation.images[:, :, _columns(calibration, observation)], len(calibration.view)
    reason = np.zeros(pixels.shape[:3], dtype=np.int64)
    row = {number: k for k, number in enumerate(observation.pose.tolist())}
    column = {number: j for j, number in enumerate(calibration.marker.tolist())}
    # The marker that it is was not seen there, or is left out as well: an exchange is listed once.
    renamed = [(pose, number, every) for pose, *pair in calibration.id_switches.tolist() for number in pair]
    for why, positions in ((2, renamed), (1, calibration.outlier.tolist())):
        for pose, number, view in positions:
            if pose in row and number in column:
                reason[row[pose], slice(None) if view == every else view, column[number]] = why
    doubted = calibration.suspect[:, 0]
    if calibration.rejected_poses is not None:
        doubted = np.append(doubted, calibration.rejected_poses)
    reason[np.isin(observation.pose, doubted)] = _KINDS.index("pose") + 1
    return pixels, reason


def _columns(calibration: Calibration, observation: Observation) -> list[int]:
    """Index of each calibrated marker among the markers of an observation."""
    place = {number: j for j, number in enumerate(observation.marker.tolist())}
    return [place[number] for number in calibration.marker.tolist()]


def _by_pose(used: BoolArray, residual: FloatArray, variance: FloatArray) -> Data:
    """Predicted and actual error (L,) of each pose with observations, rms per coordinate, and their number.

    used : (K, 2, m) observations; residual : (K, 2, m, 2), px; variance : of the predictions, px².
    """
    poses = used.any(axis=(1, 2))
    count = 2 * used.sum(axis=(1, 2))[poses]
    errors: Data = {}
    for name, squares in (("pose_predicted_px", variance), ("pose_residual_px", residual**2)):
        total = np.where(used[..., None], squares, 0.0).sum(axis=(1, 2, 3))[poses]
        errors[name] = np.sqrt(total / count)
    return errors | {"pose_coordinates": count}


def _information(calibration: Calibration) -> FloatArray:
    """Eigenvalues of the information matrix, falling: the covariance's that are not zero, inverted.

    Zero are the gauge directions, and those across the constraint that all operators are conjugate
    to rigid motions by one matrix. Of P, H_hat_0 and M, some of them for many.
    """
    few = calibration.with_markers(even_choice(len(calibration.M), MAX_JUDGED))
    spread = np.linalg.svd(error_factor(few), compute_uv=False)[::-1] ** 2
    floor = len(spread) * np.finfo(np.float64).eps * spread[-1]
    return np.asarray(1.0 / spread[spread > floor])


def _expected_residual(predicted: FloatArray, sigma: float) -> FloatArray:
    """Rms residual (L,) that a fit leaves if its own prediction errs by ``predicted``, px per coordinate.

    A least-squares residual is noise less the error of the fitted prediction, which it follows:
    variance σ² − p²; D. A. Belsley, E. Kuh, R. E. Welsch, "Regression Diagnostics", 1980, section 2.1.
    """
    return np.asarray(np.sqrt(np.maximum(sigma**2 - predicted**2, 0.0)))


@registered(
    "fig13_calibration",
    "Residuals of the calibration, and observability of the joints",
    "not in the paper",
    _data,
    height=7.8,
    task=False,
    alt="Residuals as arrows in the images; their histogram with the noise model; rms residual "
    "of each pose over its predicted error; range of each joint; eigenvalues of the information "
    "matrix.",
)
def _draw(data: Data, figure: "style.Figure") -> None:
    """Residuals over the images; their histogram and error of each pose; excitation and information."""
    views = [name.removeprefix("seen_") for name in data if name.startswith("seen_")]
    cameras, (residuals, poses), (joints, directions) = panels.rows(
        figure, (len(views), 2, 2), (1.15, 1.0, 0.9)
    )
    for axes, view in zip(cameras, views, strict=True):
        _arrows(axes, data, view)
    _histogram(residuals, data)
    _poses(poses, data)
    _excitation(joints, data)
    _spectrum(directions, data)
    notes = [
        _RESIDUAL | {"label": f"residual, {data['factor']:,g} times"},
        style.line(style.PALE, width=6, label="95 % of poses in the model"),
        *[_WEAK] * bool(data["weak"].any()),
    ]
    style.legend_below(figure, 3, notes)


def _arrows(axes: "style.Axes", data: Data, view: str) -> None:
    """Draw residuals as arrows in one image, magnified, and the observations that were rejected."""
    used, rejected = data[f"seen_{view}"], {kind: data[f"rejected_{kind}_{view}"] for kind in _KINDS}
    count = sum(map(len, rejected.values()))
    arrows = float(data["factor"]) * data[f"residual_{view}"]
    pixels: Any = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "color": _RESIDUAL["color"]}
    heads: Any = {"width": 0.0022, "headwidth": 4.0, "headlength": 5.0, "headaxislength": 4.0}
    axes.quiver(*used.T, *arrows.T, **pixels, **heads)
    size = _LARGE if count < _MANY else _SMALL
    for kind, positions in rejected.items():
        if len(positions):
            axes.plot(*positions.T, **_LEFT_OUT[kind], markersize=size, markeredgewidth=0.9)
    axes.set_title(f"{view}: {len(used):,} observations\n{count:,} rejected")
    style.image_axes(axes, np.concatenate([used, used + arrows, *rejected.values()]))


def _histogram(axes: "style.Axes", data: Data) -> None:
    """Draw the density of the residuals and the normal density of the noise model."""
    residual, sigma = data["residual"], float(data["sigma_px"])
    widest = max(4.0 * sigma, float(np.abs(residual).max(initial=0.0)))
    bins = np.linspace(-widest, widest, _BINS + 1).tolist()
    axes.hist(residual, bins, density=bool(residual.size), color=style.SKY, linewidth=0)
    x = np.linspace(-widest, widest, 401)
    axes.plot(x, np.exp(-0.5 * (x / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi)), **_MODEL)
    title = f"noise model {sigma:.3g} px, χ²/dof {float(data['chi2_per_dof']):.3g}"
    label = "residual, as tested (px)" if data["weighed"] else "residual (px)"
    axes.set(title=title, xlabel=label, ylabel="density (1/px)")


def _poses(axes: "style.Axes", data: Data) -> None:
    """Draw the residual of each pose over its predicted error, with the distribution of the noise model."""
    predicted, residual = data["pose_predicted_px"], data["pose_residual_px"]
    sigma = float(data["sigma_px"])
    held_out = bool(data["held_out"])
    axes.set(
        title="each pose, held out" if held_out else "each pose, in the fit (not held out)",
        xlabel="predicted error with noise (px)" if held_out else "predicted error (px)",
        ylabel="rms residual (px)",
    )
    upper = 1.06 * float(predicted.max(initial=0.0))
    x = np.linspace(0.94 * float(predicted.min(initial=upper)) if held_out else 0.0, upper, 101)
    expected = x if held_out else _expected_residual(x, sigma)
    coordinates = float(np.median(data["pose_coordinates"])) if predicted.size else 1.0
    low, high = np.sqrt(chdtri(coordinates, 1.0 - np.array(_BAND)) / coordinates)
    axes.fill_between(x, low * expected, high * expected, color=style.PALE, linewidth=0)
    axes.plot(x, expected, **_MODEL)
    axes.plot(predicted, residual, **_POSE)
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(0.0, 1.1 * max(float(residual.max(initial=0.0)), high * float(expected.max(initial=sigma))))


def _excitation(axes: "style.Axes", data: Data) -> None:
    """Range of each joint, deg, or m if all are prismatic; next to revolute ones these state their range."""
    prismatic, weak = data["prismatic"], data["weak"]
    mixed, amount = bool(prismatic.any() and not prismatic.all()), data["excitation"].copy()
    amount[~prismatic] = np.degrees(amount[~prismatic])
    height = amount.copy()
    if mixed and amount[prismatic].max() > 0.0:  # bars of both kinds are as high at most
        height[prismatic] *= amount[~prismatic].max() / amount[prismatic].max()
    for i, slides in enumerate(prismatic):
        line = _WEAK if weak[i] else {"color": style.SKY if slides else style.BLUE}
        axes.bar(i, height[i], width=0.6, **line)
        if mixed and slides:
            axes.text(i, 0.5 * height[i], f"{amount[i]:.3g} m", rotation=90, ha="center", va="center")
    axes.set_ylabel(f"range ({'m' if prismatic.all() else 'deg'})")
    axes.set_xticks(range(len(prismatic)), [f"$q_{{{i + 1}}}$" for i in range(len(prismatic))])
    axes.set_xlim(-0.6, len(prismatic) - 0.4)
    axes.grid(visible=False, axis="x")
    axes.set_title(f"excitation, {int(weak.sum())} of {len(weak)} joints weak")


def _spectrum(axes: "style.Axes", data: Data) -> None:
    """Information along each direction that the images determine, falling; the last is the worst."""
    values = data["information"]
    title = f"information, {len(values)} directions of {int(data['parameters'])} numbers"
    axes.set(title=title, xlabel="direction (best to worst)", ylabel="eigenvalue (1)")
    line = style.line(style.BLUE, width=0.8, marker="o", markersize=2.5)
    axes.plot(np.arange(1, len(values) + 1), values, **line)
    style.log_scale(axes)
