"""Figs. 1, 2, 5 and 6 of [RH00]: the parts of the task and the planned motions, with their visibility."""

from contextlib import suppress
from typing import Any

import numpy as np

from projservo_cli.geometry.displacements import exp_rotation
from projservo_cli.geometry.kinematics import project
from projservo_cli.geometry.lens import distort_visible
from projservo_cli.geometry.stereo import triangulate_points
from projservo_cli.image_size import border_distance
from projservo_cli.records import FloatArray, WorkFailed
from projservo_cli.report import panels, style
from projservo_cli.report.figure_inputs import Data, ReportData, registered
from projservo_cli.simulation.arm import METRIC_A_INF, roll_axis
from projservo_cli.task.face import cyclic_order
from projservo_cli.task.trajectory import trajectory_displacement

_ARC_POINTS, _SENSE_POINTS = 61, 181
_START = style.START | {"label": "start $A$"}
_TARGETS = {
    "A_star": style.GOAL | {"label": "goal $A_*$"},
    "A_t": style.line(style.VERMILION, style.DOTTED, label="goal less translation $A_t$"),
    "A_r": style.line(style.GREEN, style.DASH_DOTTED, label="less rotation onto the plane $A_r$"),
}
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
    """Images in the first camera of the face, its targets and the paths of the three parts.

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
    alt="Three panels in the first image: the face moved along a straight line, turned onto the "
    "target plane, and turned within it.",
)
def _draw_partition(data: Data, figure: "style.Figure") -> None:
    """Three panels, one per part."""
    row = figure.subplots(1, 3, width_ratios=[1.1, 1, 1])
    onto, within = (_signed(angle) for angle in data["angles_deg"])
    moved = np.stack([data["A_t"], data["A_star"]])
    parts = (
        ("translation of the centre", moved, ("A_t", "A_star")),
        (rf"onto plane, $\theta_r$ = {onto}°", data["onto_plane"], ("A_r", "A_t")),
        (rf"within plane, $\theta_p$ = {within}°", data["within_plane"], ("A_r",)),
    )
    row[1].plot(*data["axis"].T, **_AXIS)
    for panel, (title, paths, ends) in zip(row, parts, strict=True):
        style.paths(panel, paths, panels.PATH)
        style.face(panel, data["A"], _START, fill=True)
        for name in ends:
            style.face(panel, data[name], _TARGETS[name])
        panel.set_title(title)
        style.image_axes(panel)
    arrow = {"arrowstyle": "->", "linewidth": 0.9}
    row[0].annotate("", data["center"][1], data["center"][0], arrowprops=arrow)
    style.legend_below(figure, 3)


def _data_visibility(report_data: ReportData) -> Data:
    """Margins a·O of the cameras over τ and θ_r, their zeros, and the images along both senses.

    Margins are relative to the start, so 1 is the face as first seen and 0 a face seen edge-on.
    """
    plan, model = report_data.plan, report_data.calibrated
    O, face = plan.optical_center, plan.A[cyclic_order(plan.A)]
    start = O @ plan.a
    arcs = [np.linspace(0.0, sense, _SENSE_POINTS) for sense in plan.sense]
    images = [project(model.P, _turned(plan.H_hat[1], arc, face), model.lens).swapaxes(0, 1) for arc in arcs]
    # As the plane is turned, so the optical centre may be turned back.
    margin = [_turned(plan.H_hat[1], -arc, O) @ plan.a / start for arc in arcs]
    tau_0 = plan.tau_0 / plan.tau if plan.tau > 0 else np.full(len(plan.tau_0), np.nan)
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
        "view": np.array(report_data.view),
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
    names = data["view"]
    rows = panels.rows(figure, [len(names)] * 3, [1.9, 1.0, 0.9])
    senses = [
        line | {"label": rf"sense $\theta_r$ = {_signed(angle)}°"}
        for line, angle in zip(_SENSES, data["theta_deg"][:, -1], strict=True)
    ]
    for view, (image, turned, moved) in enumerate(zip(*rows, strict=True)):
        images, margins = data["images"][:, :, view], data["theta_margin"][..., view]
        style.face(image, images[0, 0], style.START | {"label": "face at the start"}, fill=True)
        for s, margin, line in zip(images, margins, senses, strict=True):
            style.paths(image, s, _HIDDEN, mask=margin <= 0.0)
            style.paths(image, s, line | {"linewidth": 0.9})
            style.face(image, s[-1], line)
        _angle(turned, data["theta_deg"], margins, senses, data["theta_0_deg"][view])
        _translation(moved, data["tau_share"], data["tau_margin"][:, view], data["tau_0_share"][view])
    panels.cameras(rows[0], names)
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
    zeros_text = rf"$\theta_0^\pm$ = {', '.join(f'{_signed(angle)}°' for angle in zeros)}"
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
    axes.set(xlim=(share[0], share[-1]), xlabel=r"share of $\tau$ (1)")


def _margin(
    axes: "style.Axes", x: FloatArray, margin: FloatArray, line: style.LineStyle, end: float | None = None
) -> None:
    """A visibility margin over a motion, where the face is hidden by it, and the end, or the last."""
    axes.plot(x, np.where(margin > 0, np.nan, margin), **_HIDDEN)
    axes.plot(x, margin, **line)
    last = (x[-1], margin[-1]) if end is None else (end, np.interp(end, x, margin))
    axes.plot(*np.array([last]).T, **_END | {"color": line["color"]})
    style.zero_line(axes)
    axes.set_ylabel(_MARGIN)


def _signed(value: float, decimals: int = 1) -> str:
    """Number with a typographic minus."""
    return f"{value:.{decimals}f}".replace("-", "\N{MINUS SIGN}")


_STEEP = 0.35  # share of the path at which the steep profile has done the translation
_FACES = 9
_MIDDLE = "rig's centre"
_NODES = 81
_TURNS = 41  # shares μ_p tried at each μ_t, μ_r
_TICKS = 11  # points at equal steps of σ on the path
_WIDE = 4.0  # margins beyond are drawn in powers of ten
# levels of contours of a margin
_LEVELS = [0.25, 0.5, 0.75, *(c * 2.0**k for k in range(12) for c in (1.0, 1.5))]
_LABEL = 0.05  # room that the number on a contour needs, in shares
_SIGMA, _SHARE = r"path parameter $\sigma$ (1)", r"share $\mu$ (1)"
_SHARES = (  # equal shares lie on one another: the wider shows beneath
    style.line(style.SKY, width=3.0, label=r"$\mu_t$"),
    style.line(style.BLACK, (0, (4, 2)), 1.8, label=r"$\mu_r$"),
    style.line(style.VERMILION, style.DOTTED, 1.0, label=r"$\mu_p$"),
)
_PATH = style.line(style.VERMILION, width=1.6)
_HATCHED = {"alpha": 0.6, "edgecolor": style.BLACK, "linewidth": 0.0}
_REGIONS = {  # hatched, so that they differ in grey too
    "margin": style.patch(style.GREY, "hidden from this camera", hatch="", **_HATCHED),
    "border_px": style.patch(style.ORANGE, r"outside this image at every $\mu_p$", hatch="////", **_HATCHED),
}
_MARGINS = (
    style.line(style.BLUE, label="visibility, worst camera"),
    style.line(style.ORANGE, style.DASHED, label="image border, worst camera"),
    style.line(style.GREEN, (0, (4, 1, 1, 1)), label="nearest joint limit"),
    style.line(style.PURPLE, style.DOTTED, label="conditioning (start = 1)"),
)


def _data_linear(report_data: ReportData) -> Data:
    """The plan of the run, by default with linear shares."""
    plan = report_data.plan
    return _rendered(report_data, plan.mu, plan.s, plan.margin, plan.profile)


def _data_steep(report_data: ReportData) -> Data:
    """The same task with linear shares of the rotations and a steep one of the translation."""
    plan, model = report_data.plan, report_data.calibrated
    mu = np.stack(
        [np.minimum(plan.path_parameter / _STEEP, 1.0), plan.path_parameter, plan.path_parameter], axis=1
    )
    amplitudes = (plan.tau, plan.theta_r, plan.theta_p)
    H_d = np.array([trajectory_displacement(plan.H_hat, amplitudes, row) for row in mu])
    s = project(model.P, plan.A @ H_d.swapaxes(1, 2), model.lens).swapaxes(0, 1)
    margin = np.linalg.solve(H_d.swapaxes(1, 2), plan.a[:, None])[..., 0] @ plan.optical_center.T
    return _rendered(report_data, mu, s, margin / (plan.optical_center @ plan.a), "steep translation")


def _rendered(
    report_data: ReportData, mu: FloatArray, s: FloatArray, margin: FloatArray, profile: str
) -> Data:
    """Pixels of the planned faces in a camera between the two.

    The planned stereo images come from the calibration alone; the true cameras only turn them into
    points that a third camera can see.
    """
    plan, P = report_data.plan, report_data.plant.model.P
    s = s[:, :, cyclic_order(plan.A)]
    # One camera determines no points; from amid cameras all around not all of them are in front.
    faces, where = s[:, 0], f"{report_data.view[0]} camera"
    with suppress(WorkFailed):
        if len(P) > 1:
            camera = _middle_camera(P, report_data.plant.image_size.mean(axis=0))
            points = np.array([triangulate_points(P, METRIC_A_INF, row) for row in s])
            if (points @ camera[2] > 0.0).all():
                faces, where = project(camera[None], points)[0], _MIDDLE
    return {
        "sigma": plan.path_parameter,
        "mu": mu,
        "margin": margin,
        "faces": faces,
        "profile": np.array(profile.replace("_", " ")),
        **({} if where == _MIDDLE else {"from": np.array(where)}),
        "view": np.array(report_data.view),
    }


def _middle_camera(P: FloatArray, image_size: FloatArray) -> FloatArray:
    """Camera (3, 4) amid metric cameras (V, 3, 4), looking along the roll axis of the rig, px.

    Its focal length is their mean, its principal point the middle of the image.
    """
    center, z = roll_axis(P)
    Q = (
        P[:, :, :3]
        * (np.sign(np.linalg.det(P[:, :, :3])) / np.linalg.norm(P[:, 2, :3], axis=1))[:, None, None]
    )
    right = Q[:, 0] - (Q[:, :1] @ Q[:, 2, :, None])[:, 0] * Q[:, 2]
    focal = np.linalg.norm(right, axis=1, keepdims=True)
    across = (right / focal).sum(axis=0)
    x = across - (across @ z) * z
    x /= np.linalg.norm(x)
    u, v = (image_size - 1.0) / 2.0
    K = np.array([[focal.mean(), 0.0, u], [0.0, focal.mean(), v], [0.0, 0.0, 1.0]])
    R = np.stack([x, np.cross(z, x), z])
    return np.asarray(K @ np.c_[R, -R @ center])


@registered(
    "fig05_planned",
    "The planned motion from between the cameras",
    "Fig. 5, section 6",
    _data_linear,
    alt="The face at several moments of the planned motion, seen from between the cameras; next to "
    "it the shares of translation and rotations that are done and the visibility margin of the "
    "cameras.",
)
@registered(
    "fig06_planned_steep",
    "The planned motion with a steep translation",
    "Fig. 6, section 6",
    _data_steep,
    alt="As the figure before, with a translation that is driven first: the face at several "
    "moments, the shares of the motions and the visibility margins.",
)
def _draw_planned(data: Data, figure: "style.Figure") -> None:
    """Left the faces from dark to light along the path, right the shares and the margins."""
    rows = 0.2 * (len(data["view"]) > 2)  # height of the legend
    figure.set_figheight(max(4.2 * style.aspect(data["faces"]) + 1.0, 3.0) + rows)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.7, 1])
    _faces(figure.add_subplot(grid[:, 0]), data)
    sigma, shares = data["sigma"], None
    if np.isfinite(data["mu"]).all():
        shares = figure.add_subplot(grid[0, 1])
        panels.curves(shares, sigma, data["mu"], _SHARES)
        shares.set_ylabel(_SHARE)
        shares.tick_params(labelbottom=False)
    # A path through joint space has no shares.
    margins = figure.add_subplot(grid[1, 1] if shares else grid[:, 1], sharex=shares)
    panels.curves(margins, sigma, data["margin"], style.view_lines(data["view"]))
    style.zero_line(margins)
    margins.set(xlabel=_SIGMA, ylabel=_MARGIN)
    style.legend_below(figure, 6, [style.dots(style.BLACK, "o", "first marker of the face")])


def _faces(axes: "style.Axes", data: Data) -> None:
    """Draw some of the planned faces, from dark to light along the path, and the paths of the markers."""
    from matplotlib import colormaps

    faces, sigma = data["faces"], data["sigma"]
    style.paths(axes, faces, style.line(style.GREY, width=0.6))
    visible = np.unique(np.linspace(0, len(sigma) - 1, _FACES).round().astype(int))
    for j in visible:
        width = 1.8 if j in (visible[0], visible[-1]) else 1.0
        style.face(axes, faces[j], style.line(colormaps["cividis"](0.82 * sigma[j]), width=width))
    axes.set_title(f"from the {data.get('from', _MIDDLE)}, {data['profile']}")
    style.image_axes(axes)
    place: Any = {"xytext": (0, 5), "textcoords": "offset points", "ha": "center", "va": "bottom"}
    paper = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.8}
    for corners, label in ((faces[0], "start"), (faces[-1], "goal")):
        axes.annotate(label, corners[np.argmin(corners[:, 1])], bbox=paper, **place)


def _data_path(report_data: ReportData) -> Data:
    """Margins of the cameras over the unit square, the border distance at the best μ_p, and the path."""
    plan = report_data.plan
    mu = np.linspace(0.0, 1.0, _NODES)
    O = plan.optical_center
    moved = O[:, None] - mu[:, None] * plan.tau * (O @ plan.H_hat[0].T)[:, None]
    planes = np.array([exp_rotation(plan.H_hat[1], -share * plan.theta_r).T @ plan.a for share in mu])
    half = 0.5 * float(report_data.plant.image_size.min())
    along = (plan.margin.min(axis=1), plan.border_distance.min(axis=1) / half, plan.joint_margin)
    return {
        "share": mu,
        "margin": np.einsum("vtc,rc->vtr", moved, planes) / (O @ plan.a)[:, None, None],
        "border_px": _border_distance(report_data, mu),
        "sigma": plan.path_parameter,
        "mu": plan.mu,
        "along": np.stack([*along, plan.reciprocal_condition / plan.reciprocal_condition[0]], axis=1),
        "profile": np.array(plan.profile.replace("_", " ")),
        "view": np.array(report_data.view),
    }


def _border_distance(report_data: ReportData, mu: FloatArray) -> FloatArray:
    """Least distance of a marker from the border of each image, px, where μ_p is best for both.

    It is (V, k, k) over the shares mu (k,) of t and of r, negative outside.
    """
    plan, P, lens = report_data.plan, report_data.calibrated.P, report_data.calibrated.lens
    turns = np.linspace(0.0, 1.0, _TURNS)
    within = np.array([exp_rotation(plan.H_hat[2], share * plan.theta_p) for share in turns])
    onto = np.array([exp_rotation(plan.H_hat[1], share * plan.theta_r) for share in mu])
    # Markers first, so that the rest uses whole arrays: it took a tenth of a second of every report.
    M = np.einsum("rij,pmj->mrpi", onto, plan.A @ np.swapaxes(within, 1, 2)).copy()
    moved = M @ plan.H_hat[0].T
    depth = np.sign(np.einsum("vc,mc->vm", P[:, 2], plan.A))[:, :, None, None]
    size = report_data.plant.image_size[:, None, None, None]
    result = np.empty((len(P), len(mu), len(mu)))
    for i, share in enumerate(mu):
        points = (M + share * plan.tau * moved).reshape(-1, 4)
        m = (points @ P.swapaxes(1, 2)).reshape(len(P), *M.shape[:3], 3)
        pixels = distort_visible(lens[:, None, None, None], m[..., :2] / m[..., 2:])
        lowest = border_distance(pixels, size).min(axis=1)
        front = (m[..., 2] * depth > 0.0).all(axis=1)
        lowest = np.where(front & np.isfinite(lowest), lowest, -np.inf)
        best = lowest.min(axis=0).argmax(axis=1)
        result[:, i] = lowest[:, np.arange(len(mu)), best]
    return result


@registered(
    "fig14_path",
    "Where each camera sees the face, and the planned path among it",
    "not in the paper, after section 4.3",
    _data_path,
    height=6.0,
    shares=True,
)
def _draw_path(data: Data, figure: "style.Figure") -> None:
    """Above the map of each camera with the path, below the shares and the margins along it."""
    names = data["view"]
    maps, (shares, margins) = panels.rows(figure, [len(names), 2], [1.5, 1.0])
    for view, panel in enumerate(maps):
        _map(panel, data, view)
    panels.titles(maps, names, f"{data['profile']} profile")
    panels.curves(shares, data["sigma"], data["mu"], _SHARES)
    panels.curves(margins, data["sigma"], data["along"], _MARGINS)
    shares.set(xlabel=_SIGMA, ylabel=_SHARE)
    margins.set(xlabel=_SIGMA, ylabel="margin (1)")
    style.zero_line(margins)
    if np.nanmax(data["along"]) > _WIDE:  # conditioning may grow a hundredfold
        style.near_zero_scale(margins, 1.0)
    margins.set_ylim(bottom=min(-0.1, 1.1 * float(np.nanmin(data["along"]))))
    path = _PATH | {"marker": "o", "label": r"path, at tenths of $\sigma$"}
    violated = [line for name, line in _REGIONS.items() if data[name].min() < 0.0]
    style.legend_below(figure, 4, [*violated, path])


def _map(axes: "style.Axes", data: Data, view: int) -> None:
    """Draw the regions in which a camera does not see the face over the shares μ_t and μ_r, and the path."""
    share = data["share"]
    for name, line in _REGIONS.items():
        finite = np.maximum(data[name][view], -1e6)
        region: Any = {"colors": [line["facecolor"]], "hatches": [line["hatch"]], "alpha": line["alpha"]}
        if finite.min() < 0.0:
            axes.contourf(share, share, finite.T, levels=[-1e9, 0.0], **region)
        if finite.min() < 0.0 < finite.max():
            axes.contour(share, share, finite.T, levels=[0.0], colors=[style.BLACK], linewidths=0.6)
    faint: Any = {"colors": [style.BLACK], "linewidths": 0.4, "linestyles": "dotted"}
    contours = axes.contour(share, share, data["margin"][view].T, levels=_LEVELS, **faint)
    lines = np.concatenate([data["mu"][:, :2], np.repeat(share[:, None], 2, axis=1)])
    axes.clabel(contours, fmt="%g", fontsize=6.5, manual=_clear(contours.allsegs, lines))
    axes.plot([0.0, 1.0], [0.0, 1.0], color=style.BLACK, linewidth=0.5)
    t, r = data["mu"][:, :2].T
    axes.plot(t, r, **_PATH)
    tenths, sigma = np.linspace(0.0, 1.0, _TICKS), data["sigma"]
    axes.plot(np.interp(tenths, sigma, t), np.interp(tenths, sigma, r), **style.dots(style.VERMILION, "o"))
    labels = {"xlabel": r"translation $\mu_t$ (1)", "ylabel": r"turn onto the plane $\mu_r$ (1)"}
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), **labels)


def _clear(contours: Any, lines: FloatArray) -> list[FloatArray]:
    """A place (2,) on each piece of each contour, away from the points (k, 2), the border and one another."""
    positions: list[FloatArray] = []
    for piece in (piece for pieces in contours for piece in pieces if len(piece) > 1):
        taken = np.concatenate([lines, np.reshape(positions, (-1, 2))])
        room = np.linalg.norm(piece[:, None] - taken, axis=2).min(axis=1)
        room = np.minimum(room, np.minimum(piece, 1.0 - piece).min(axis=1))
        if room.max() > _LABEL:
            positions.append(piece[room.argmax()])
    return positions
