"""Figs. 1 and 2 of [RH00]: the parts of the task in the images, and where they change visibility."""

import numpy as np

from projservo_cli.geometry.algebra import exp_rotation
from projservo_cli.geometry.kinematics import project
from projservo_cli.records import FloatArray
from projservo_cli.report import style
from projservo_cli.report.report_data import VIEWS, Data, ReportData, registered
from projservo_cli.task.face import cyclic_order

_ARC_POINTS, _SENSE_POINTS = 61, 181
_START = style.START | {"label": "start $A$"}
_TARGETS = {
    "A_star": style.GOAL | {"label": "goal $A_*$"},
    "A_t": style.line(style.VERMILION, style.DOTTED, label="goal less translation $A_t$"),
    "A_r": style.line(style.GREEN, style.DASH_DOTTED, label="less rotation onto the plane $A_r$"),
}
_PATH = style.line(style.GREY, width=0.7, label="paths of the markers")
_AXIS = style.line(style.BLACK, (0, (8, 3, 1, 3)), 0.8, label=r"axis of $\hat H_r$")
_SENSES = (style.line(style.BLUE), style.line(style.VERMILION, style.DASHED))
_HIDDEN = style.line(style.GREY, width=4, label="hidden from this camera", alpha=0.5, solid_capstyle="butt")
_ZERO = style.dots(style.BLACK, "D", r"$\theta_0^\pm$, $\tau_0$", fillstyle="none")
_END = style.dots(style.BLACK, "s", "end of the motion")
_MARGIN = "margin $a\\cdot O$\n(start = 1)"


def _turned(H_hat: FloatArray, angles: FloatArray, points: FloatArray) -> FloatArray:
    """Points (k, m, 4) turned about one axis by each of the angles (k,), rad."""
    return np.stack([points @ exp_rotation(H_hat, theta).T for theta in angles])


def _data_partition(report_data: ReportData) -> Data:
    """Images in the left camera of the face, its targets and the paths of the three parts.

    A_t is the goal less the translation, A_r the goal less both translation and rotation onto the
    plane, [RH00] eqs. (12), (16); all come from the calibration and the images.
    """
    plan, model = report_data.plan, report_data.calibrated
    order = cyclic_order(plan.A)
    share = np.linspace(0.0, 1.0, _ARC_POINTS)
    points = {
        **{name: getattr(plan, name)[order] for name in ("A", "A_t", "A_r", "A_star")},
        "center": np.stack([plan.A_c, plan.A_c_star]),
        "onto_plane": _turned(plan.H_hat[1], share * plan.theta_r, plan.A_r[order]),
        "within_plane": _turned(plan.H_hat[2], share * plan.theta_p, plan.A[order]),
        "axis": _axis(plan.H_hat[1], plan.A_c, plan.A),
    }
    pixels = {name: project(model.P[:1], place, model.lens[:1])[0] for name, place in points.items()}
    return pixels | {"angles_deg": np.degrees([plan.theta_r, plan.theta_p])}


def _axis(H_hat: FloatArray, A_c: FloatArray, A: FloatArray) -> FloatArray:
    """Two points (2, 4) on the axis of a rotation through the centre, as far out as the face.

    (I + Ĥ²) X is the foot of X on the axis.
    """
    offset = A + A @ (H_hat @ H_hat).T - A_c
    longest = offset[np.argmax(np.linalg.norm(offset, axis=1))]
    reach = np.linalg.norm(A - A_c, axis=1).max()
    half = 1.4 * reach * longest / max(float(np.linalg.norm(longest)), np.finfo(float).tiny)
    return np.stack([A_c - half, A_c + half])


@registered(
    "fig01_partition",
    "The task as a translation, a rotation onto the target plane and one within it",
    "Fig. 1, section 4.1",
    _data_partition,
    height=3.0,
    alt="Three panels in the left image: the face moved along a straight line, turned onto the "
    "target plane, and turned within it.",
)
def _draw_partition(data: Data, figure: "style.Figure") -> None:
    """Three panels, one a part."""
    panels = figure.subplots(1, 3, width_ratios=[1.1, 1, 1])
    onto, within = (_signed(angle) for angle in data["angles_deg"])
    moved = np.stack([data["A_t"], data["A_star"]])
    parts = (
        ("translation of the centre", moved, ("A_t", "A_star")),
        (rf"onto plane, $\theta_r$ = {onto}°", data["onto_plane"], ("A_r", "A_t")),
        (rf"within plane, $\theta_p$ = {within}°", data["within_plane"], ("A_r",)),
    )
    panels[1].plot(*data["axis"].T, **_AXIS)
    for panel, (title, paths, ends) in zip(panels, parts, strict=True):
        axis = [data["axis"]] if panel is panels[1] else []
        style.paths(panel, paths, _PATH)
        style.face(panel, data["A"], _START, fill=True)
        for name in ends:
            style.face(panel, data[name], _TARGETS[name])
        style.image_axes(panel, title, np.concatenate([data["A"], paths.reshape(-1, 2), *axis]))
    arrow = {"arrowstyle": "->", "linewidth": 0.9}
    panels[0].annotate("", data["center"][1], data["center"][0], arrowprops=arrow)
    style.legend_below(figure, 3)


def _data_visibility(report_data: ReportData) -> Data:
    """Margins a·O of both cameras over τ and θ_r, their zeros, and the images along both senses.

    Margins are relative to the start, so 1 is the face as first seen and 0 a face seen edge-on.
    """
    plan, model = report_data.plan, report_data.calibrated
    O, face = plan.optical_center, plan.A[cyclic_order(plan.A)]
    start = O @ plan.a
    arcs = [np.linspace(0.0, sense, _SENSE_POINTS) for sense in plan.sense]
    images = [project(model.P, _turned(plan.H_hat[1], arc, face), model.lens).swapaxes(0, 1) for arc in arcs]
    # As the plane is turned, so the optical centre may be turned back.
    margin = [_turned(plan.H_hat[1], -arc, O) @ plan.a / start for arc in arcs]
    tau_0 = plan.tau_0 / plan.tau if plan.tau > 0 else np.full(2, np.nan)
    finite = tau_0[np.isfinite(tau_0)]
    reach = np.concatenate([[-0.2, 1.2], 1.1 * finite[np.abs(finite) < 5]])
    share = np.linspace(reach.min(), reach.max(), 101)
    rate = O @ (plan.H_hat[0].T @ plan.a) / start * plan.tau
    return {
        "tau_share": share,
        "tau_margin": 1.0 - share[:, None] * rate,
        "tau_0_share": tau_0,
        "theta_deg": np.degrees(arcs),
        "theta_margin": np.stack(margin),
        "theta_0_deg": np.degrees(plan.theta_0),
        "images": np.stack(images),
    }


@registered(
    "fig02_visibility",
    "Where the face changes visibility, and both senses of the rotation onto the plane",
    "Fig. 2, section 4.2",
    _data_visibility,
    height=7.4,
    alt="For each camera: the face turned onto the target plane in both senses, and its visibility "
    "margin over the angle and over the translation, with the values at which it is zero.",
)
def _draw_visibility(data: Data, figure: "style.Figure") -> None:
    """Per camera: the images along both senses of θ_r, and the margin over θ_r and over τ."""
    panels = figure.subplots(3, 2, height_ratios=[1.9, 1.0, 0.9])
    senses = [
        line | {"label": rf"sense $\theta_r$ = {_signed(angle)}°"}
        for line, angle in zip(_SENSES, data["theta_deg"][:, -1], strict=True)
    ]
    for view, (name, (image, turned, moved)) in enumerate(zip(VIEWS, panels.T, strict=True)):
        images, margins = data["images"][:, :, view], data["theta_margin"][..., view]
        style.face(image, images[0, 0], style.START | {"label": "face at the start"}, fill=True)
        for s, margin, line in zip(images, margins, senses, strict=True):
            style.paths(image, s, _HIDDEN, where=margin <= 0.0)
            style.paths(image, s, line | {"linewidth": 0.9})
            style.face(image, s[-1], line)
        style.image_axes(image, f"{name} camera", images)
        _angle(turned, data["theta_deg"], margins, senses, data["theta_0_deg"][view])
        _translation(moved, data["tau_share"], data["tau_margin"][:, view], data["tau_0_share"][view])
    style.legend_below(figure, 3, [_END])


def _angle(
    axes: "style.Axes",
    angles: FloatArray,
    margins: FloatArray,
    senses: list[style.LineStyle],
    zeros: FloatArray,
) -> None:
    """Margins (2, k) over angles (2, k), deg, in both senses, and the angles (2,) of no margin."""
    for theta, margin, line in zip(angles, margins, senses, strict=True):
        _margin(axes, theta, margin, line)
    zeros_text = rf"$\theta_0^\pm$ = {' and '.join(f'{_signed(angle)}°' for angle in zeros)}"
    axes.set_title(zeros_text if np.isfinite(zeros).all() else "visibility never changes")
    periods = (zeros[:, None] + np.array([-360.0, 0.0, 360.0])).ravel()
    periods = periods[(periods >= angles.min()) & (periods <= angles.max())]
    axes.plot(periods, np.zeros_like(periods), **_ZERO)
    axes.set_xlabel(r"$\theta_r$ (deg)")


def _translation(axes: "style.Axes", share: FloatArray, margin: FloatArray, zero: float) -> None:
    """Margin (k,) over the share (k,) of the translation, and the share of no margin."""
    _margin(axes, share, margin, style.line(style.BLACK), end=1.0)
    axes.plot([zero], [0.0], **_ZERO)
    zero_text = rf"$\tau_0$ = {_signed(zero, 2)} $\tau$"
    axes.set_title(zero_text if np.isfinite(zero) else "visibility never changes")
    axes.set(xlim=(share[0], share[-1]), xlabel=r"translation as share of $\tau$ (1)")


def _margin(
    axes: "style.Axes", x: FloatArray, margin: FloatArray, line: style.LineStyle, end: float | None = None
) -> None:
    """A visibility margin over a motion, where the face is hidden by it, and the end, else the last."""
    axes.plot(x, np.where(margin > 0, np.nan, margin), **_HIDDEN)
    axes.plot(x, margin, **line)
    last = (x[-1], margin[-1]) if end is None else (end, np.interp(end, x, margin))
    axes.plot(*np.array([last]).T, **_END | {"color": line["color"]})
    style.zero_line(axes)
    axes.set_ylabel(_MARGIN)


def _signed(value: float, decimals: int = 1) -> str:
    """Number with a typographic minus."""
    return f"{value:.{decimals}f}".replace("-", "\N{MINUS SIGN}")
