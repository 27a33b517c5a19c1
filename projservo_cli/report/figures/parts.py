"""Figs. 1 and 2 of [RH00]: the parts of the task in the images, and where they change visibility."""

import numpy as np

from projservo_cli.geometry.displacements import exp_rotation
from projservo_cli.geometry.kinematics import project
from projservo_cli.records import FloatArray
from projservo_cli.report import style
from projservo_cli.report.report_data import VIEWS, Data, ReportData, registered
from projservo_cli.task.face import cyclic_order

_ARC_POINTS, _SENSE_POINTS = 61, 181
_SHIFTED: style.LineStyle = {"color": style.VERMILION, "linestyle": (0, (1, 1))}
_TURNED: style.LineStyle = {"color": style.GREEN, "linestyle": (0, (5, 1.5, 1, 1.5))}
_PATH: style.LineStyle = {"color": style.GREY, "linewidth": 0.7}
_AXIS: style.LineStyle = {"color": style.BLACK, "linewidth": 0.8, "linestyle": (0, (8, 3, 1, 3))}
_SENSES: tuple[style.LineStyle, ...] = (
    {"color": style.BLUE, "linestyle": "-"},
    {"color": style.VERMILION, "linestyle": (0, (5, 1.5))},
)
_HIDDEN: style.LineStyle = {"color": style.GREY, "linewidth": 4, "alpha": 0.5}
_ZERO: style.LineStyle = {"color": style.BLACK, "marker": "D", "linestyle": "none", "fillstyle": "none"}
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
    seen = {name: project(model.P[:1], there, model.lens[:1])[0] for name, there in points.items()}
    return seen | {"angles_deg": np.degrees([plan.theta_r, plan.theta_p])}


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
    targets = {"A_star": style.GOAL, "A_t": _SHIFTED, "A_r": _TURNED}
    onto, within = (_signed(angle) for angle in data["angles_deg"])
    moved = np.stack([data["A_t"], data["A_star"]])
    parts = (
        ("translation of the centre", moved, ("A_t", "A_star")),
        (rf"onto plane, $\theta_r$ = {onto}°", data["onto_plane"], ("A_r", "A_t")),
        (rf"within plane, $\theta_p$ = {within}°", data["within_plane"], ("A_r",)),
    )
    for panel, (title, ways, ends) in zip(panels, parts, strict=True):
        visible = [data["A"], ways.reshape(-1, 2)]
        if panel is panels[1]:
            panel.plot(*data["axis"].T, **_AXIS)
            visible.append(data["axis"])
        style.paths(panel, ways, _PATH)
        style.face(panel, data["A"], style.START, fill=True)
        for name in ends:
            style.face(panel, data[name], targets[name])
        style.image_axes(panel, title, np.concatenate(visible))
    arrow = {"arrowstyle": "->", "linewidth": 0.9}
    panels[0].annotate("", data["center"][1], data["center"][0], arrowprops=arrow)
    line_styles = {
        "start $A$": style.START,
        "goal $A_*$": style.GOAL,
        "goal less translation $A_t$": _SHIFTED,
        "less rotation onto the plane $A_r$": _TURNED,
        "paths of the markers": _PATH,
        r"axis of $\hat H_r$": _AXIS,
    }
    style.legend_below(figure, line_styles, 3)


def _data_visibility(report_data: ReportData) -> Data:
    """Margins a·O of both cameras over τ and θ_r, their zeros, and the images along both senses.

    Margins are relative to the start, so 1 is the face as first seen and 0 a face seen edge-on.
    """
    plan, model = report_data.plan, report_data.calibrated
    O, face = plan.optical_center, plan.A[cyclic_order(plan.A)]
    start = O @ plan.a
    arcs = [np.linspace(0.0, sense, _SENSE_POINTS) for sense in plan.sense]
    seen = [project(model.P, _turned(plan.H_hat[1], arc, face), model.lens).swapaxes(0, 1) for arc in arcs]
    # As the plane is turned, so the optical centre may be turned back.
    margin = [_turned(plan.H_hat[1], -arc, O) @ plan.a / start for arc in arcs]
    tau_0 = plan.tau_0 / plan.tau if plan.tau > 0 else np.full(2, np.nan)
    used = tau_0[np.isfinite(tau_0)]
    reach = np.concatenate([[-0.2, 1.2], 1.1 * used[np.abs(used) < 5]])
    share = np.linspace(reach.min(), reach.max(), 101)
    rate = O @ (plan.H_hat[0].T @ plan.a) / start * plan.tau
    return {
        "tau_share": share,
        "tau_margin": 1.0 - share[:, None] * rate,
        "tau_0_share": tau_0,
        "theta_deg": np.degrees(arcs),
        "theta_margin": np.stack(margin),
        "theta_0_deg": np.degrees(plan.theta_0),
        "images": np.stack(seen),
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
    axes = figure.subplots(3, 2, height_ratios=[1.9, 1.0, 0.9])
    for view, name in enumerate(VIEWS):
        panel, images = axes[0, view], data["images"][:, :, view]
        for s, margin, line_style in zip(images, data["theta_margin"][..., view], _SENSES, strict=True):
            style.hidden_paths(panel, s, margin <= 0.0, _HIDDEN)
            style.paths(panel, s, line_style | {"linewidth": 0.9})
            style.face(panel, s[-1], line_style)
        style.face(panel, images[0, 0], style.START, fill=True)
        style.image_axes(panel, f"{name} camera", images)
        _angle(axes[1, view], data, view)
        _translation(axes[2, view], data, view)
    line_styles = {"face at the start": style.START}
    for angle, line_style in zip(data["theta_deg"][:, -1], _SENSES, strict=True):
        line_styles[rf"sense $\theta_r$ = {_signed(angle)}°"] = line_style
    line_styles |= {"hidden from this camera": _HIDDEN, r"$\theta_0^\pm$, $\tau_0$": _ZERO}
    line_styles["end of the motion"] = {"color": style.BLACK, "marker": "s", "linestyle": "none"}
    style.legend_below(figure, line_styles, 3)


def _angle(axes: "style.Axes", data: Data, view: int) -> None:
    angles, zeros = data["theta_deg"], data["theta_0_deg"][view]
    for theta, margin, line_style in zip(angles, data["theta_margin"][..., view], _SENSES, strict=True):
        _margin(axes, theta, margin, line_style)
        axes.plot(theta[-1:], margin[-1:], "s", color=line_style["color"])
    changes = " and ".join(f"{_signed(angle)}°" for angle in zeros)
    zeros = (zeros[:, None] + np.array([-360.0, 0.0, 360.0])).ravel()
    zeros = zeros[(zeros >= angles.min()) & (zeros <= angles.max())]
    axes.plot(zeros, np.zeros_like(zeros), **_ZERO)
    never = not np.isfinite(data["theta_0_deg"][view]).all()
    axes.set_title("visibility never changes" if never else rf"$\theta_0^\pm$ = {changes}")
    axes.set(xlabel=r"$\theta_r$ (deg)", ylabel=_MARGIN)


def _translation(axes: "style.Axes", data: Data, view: int) -> None:
    share, margin, zero = data["tau_share"], data["tau_margin"][:, view], data["tau_0_share"][view]
    _margin(axes, share, margin, {"color": style.BLACK})
    axes.plot([1.0], np.interp([1.0], share, margin), "s", color=style.BLACK)
    axes.plot([zero], [0.0], **_ZERO)
    known = rf"$\tau_0$ = {_signed(zero, 2)} $\tau$"
    axes.set_title(known if np.isfinite(zero) else "visibility never changes")
    axes.set(xlim=(share[0], share[-1]), xlabel=r"translation as share of $\tau$ (1)", ylabel=_MARGIN)


def _margin(axes: "style.Axes", x: FloatArray, margin: FloatArray, line_style: style.LineStyle) -> None:
    """A visibility margin over the share of a motion, and where the face is hidden by it."""
    axes.plot(x, np.where(margin > 0, np.nan, margin), **_HIDDEN)
    axes.plot(x, margin, **line_style)
    axes.axhline(0.0, color=style.BLACK, linewidth=0.6)


def _signed(value: float, decimals: int = 1) -> str:
    """Number with a typographic minus."""
    return f"{value:.{decimals}f}".replace("-", "\N{MINUS SIGN}")
