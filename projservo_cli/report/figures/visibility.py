"""Fig. 2 of [RH00]: where the face changes visibility, seen from both cameras."""

from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.geometry.algebra import exp_rotation
from projservo_cli.geometry.kinematics import project
from projservo_cli.report import style
from projservo_cli.report.material import VIEWS, Data, Material, registered
from projservo_cli.task.face import cyclic_order

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ARC_POINTS = 181


def _data(material: Material) -> Data:
    """Margins a·O of both cameras over τ and θ_r, their zeros, and the images along both senses.

    Margins are relative to the start, so 1 is the face as first seen and 0 a face seen edge-on.
    """
    plan = material.plan
    order = cyclic_order(plan.A)
    O = plan.optical_center
    start = O @ plan.a
    arcs = np.stack([np.linspace(0.0, sense, _ARC_POINTS) for sense in plan.sense])
    images, theta_margin = np.empty((2, _ARC_POINTS, 2, len(plan.A), 2)), np.empty((2, _ARC_POINTS, 2))
    for i, arc in enumerate(arcs):
        for j, theta in enumerate(arc):
            H = exp_rotation(plan.H_hat[1], theta)
            images[i, j] = project(material.calibrated.P, plan.A[order] @ H.T, material.calibrated.lens)
            theta_margin[i, j] = O @ (exp_rotation(plan.H_hat[1], -theta).T @ plan.a) / start
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
        "theta_margin": theta_margin,
        "theta_0_deg": np.degrees(plan.theta_0),
        "images": images,
    }


_SENSES: tuple[style.Look, ...] = (
    {"color": style.BLUE, "linestyle": "-"},
    {"color": style.VERMILION, "linestyle": (0, (5, 1.5))},
)
_HIDDEN: style.Look = {"color": style.GREY, "linewidth": 4, "alpha": 0.5}
_ZERO: style.Look = {"color": style.BLACK, "marker": "D", "linestyle": "none", "fillstyle": "none"}
_MARGIN = "margin $a\\cdot O$\n(start = 1)"


@registered(
    "fig02_visibility",
    "Where the face changes visibility, and both senses of the rotation onto the plane",
    "Fig. 2, section 4.2",
    7.4,
    _data,
    alt="For each camera: the face turned onto the target plane in both senses, and its visibility "
    "margin over the angle and over the translation, with the values at which it is zero.",
)
def _draw(data: Data, figure: "Figure") -> None:
    """Per camera: the images along both senses of θ_r, and the margin over θ_r and over τ."""
    axes = figure.subplots(3, 2, height_ratios=[1.9, 1.0, 0.9])
    for view, name in enumerate(VIEWS):
        _images(axes[0, view], data, view)
        style.image_axes(axes[0, view], f"{name} camera")
        _angle(axes[1, view], data, view)
        _translation(axes[2, view], data, view)
    senses = data["theta_deg"][:, -1]
    looks = {"face at the start": style.START}
    for angle, look in zip(senses, _SENSES, strict=True):
        looks[rf"sense $\theta_r$ = {style.signed(angle)}°"] = look
    looks |= {"hidden from this camera": _HIDDEN, r"$\theta_0^\pm$, $\tau_0$": _ZERO}
    looks["end of the motion"] = {"color": style.BLACK, "marker": "s", "linestyle": "none"}
    style.legend_below(figure, looks, 3)


def _images(axes: "Axes", data: Data, view: int) -> None:
    images = data["images"][:, :, view]
    for i, look in enumerate(_SENSES):
        seen = data["theta_margin"][i, :, view] > 0
        for k in range(images.shape[2]):
            path = images[i, :, k]
            hidden = np.where(seen[:, None], np.nan, path)
            axes.plot(*hidden.T, solid_capstyle="butt", **_HIDDEN)
            axes.plot(*path.T, linewidth=0.9, **look)
        style.face(axes, images[i, -1], look)
    style.face(axes, images[0, 0], style.START, fill=True)
    style.frame_pixels(axes, images)


def _angle(axes: "Axes", data: Data, view: int) -> None:
    for i, look in enumerate(_SENSES):
        theta, margin = data["theta_deg"][i], data["theta_margin"][i, :, view]
        axes.plot(theta, np.where(margin > 0, np.nan, margin), **_HIDDEN)
        axes.plot(theta, margin, **look)
        axes.plot(theta[-1:], margin[-1:], "s", color=look["color"])
    low, high = data["theta_deg"].min(), data["theta_deg"].max()
    zeros = (data["theta_0_deg"][view][:, None] + np.array([-360.0, 0.0, 360.0])).ravel()
    zeros = zeros[(zeros >= low) & (zeros <= high)]
    axes.plot(zeros, np.zeros_like(zeros), **_ZERO)
    axes.axhline(0.0, color=style.BLACK, linewidth=0.6)
    changes = " and ".join(f"{style.signed(angle)}°" for angle in data["theta_0_deg"][view])
    known = np.isfinite(data["theta_0_deg"][view]).all()
    axes.set_title(rf"$\theta_0^\pm$ = {changes}" if known else r"visibility never changes")
    axes.set(xlabel=r"$\theta_r$ (deg)", ylabel=_MARGIN)


def _translation(axes: "Axes", data: Data, view: int) -> None:
    share, margin = data["tau_share"], data["tau_margin"][:, view]
    axes.plot(share, np.where(margin > 0, np.nan, margin), **_HIDDEN)
    axes.plot(share, margin, color=style.BLACK)
    axes.plot([1.0], np.interp([1.0], share, margin), "s", color=style.BLACK)
    axes.plot(data["tau_0_share"][view : view + 1], [0.0], **_ZERO)
    axes.axhline(0.0, color=style.BLACK, linewidth=0.6)
    tau_0 = data["tau_0_share"][view]
    known = np.isfinite(tau_0)
    axes.set_title(rf"$\tau_0$ = {style.signed(tau_0, 2)} $\tau$" if known else r"visibility never changes")
    axes.set(xlim=(share[0], share[-1]), xlabel=r"translation as share of $\tau$ (1)", ylabel=_MARGIN)
