"""Beside the figures of [RH00]: where the face is seen over the shares μ_t, μ_r, and the planned path."""

from typing import TYPE_CHECKING, Any

import numpy as np

from projservo_cli.geometry.algebra import exp_rotation
from projservo_cli.geometry.lens import through
from projservo_cli.records import FloatArray
from projservo_cli.report import style
from projservo_cli.report.material import VIEWS, Data, Material, registered

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NODES = 81
_TURNS = 41  # shares μ_p tried at each μ_t, μ_r
_TICKS = 11  # points at equal steps of σ on the path
_WIDE = 4.0  # margins beyond are drawn in powers of ten
LABEL = 0.05  # room that the number on a contour needs, in shares

_REGIONS: dict[str, style.Look] = {  # hatched, so that they differ in grey too
    "margin": {"facecolor": style.GREY, "hatch": ""},
    "border_px": {"facecolor": style.ORANGE, "hatch": "////"},
}
_MARGINS: dict[str, style.Look] = {
    "visibility": {"color": style.BLUE, "linestyle": "-"},
    "image": {"color": style.ORANGE, "linestyle": (0, (5, 1.5))},
    "joints": {"color": style.GREEN, "linestyle": (0, (4, 1, 1, 1))},
    "conditioning (start = 1)": {"color": style.PURPLE, "linestyle": (0, (1, 1))},
}


def _data(material: Material) -> Data:
    """Margins of both cameras over the unit square, the border distance at the best μ_p, and the path."""
    plan = material.plan
    mu = np.linspace(0.0, 1.0, _NODES)
    O = plan.optical_center
    moved = O[:, None] - mu[:, None] * plan.tau * (O @ plan.H_hat[0].T)[:, None]
    planes = np.array([exp_rotation(plan.H_hat[1], -share * plan.theta_r).T @ plan.a for share in mu])
    margin = np.einsum("vtc,rc->vtr", moved, planes) / (O @ plan.a)[:, None, None]
    half = 0.5 * float(material.plant.image_size.min())
    return {
        "share": mu,
        "margin": margin,
        "border_px": _border_distance(material, mu),
        "sigma": plan.sigma,
        "mu": plan.mu,
        "along": np.stack(
            [
                plan.margin.min(axis=1),
                plan.border_distance.min(axis=1) / half,
                plan.joint_margin,
                plan.condition / plan.condition[0],
            ],
            axis=1,
        ),
        "profile": np.array(plan.profile.replace("_", " ")),
    }


def _border_distance(material: Material, mu: FloatArray) -> FloatArray:
    """Least distance of a marker from the border of each image, px, where μ_p is best for both.

    mu : (k,) shares of t and of r.
    Returns (2, k, k) distances over μ_t and μ_r, negative outside.
    """
    plan, P, lens = material.plan, material.calibrated.P, material.calibrated.lens
    turns = np.linspace(0.0, 1.0, _TURNS)
    within = np.array([exp_rotation(plan.H_hat[2], share * plan.theta_p) for share in turns])
    onto = np.array([exp_rotation(plan.H_hat[1], share * plan.theta_r) for share in mu])
    M = np.einsum("rij,pmj->rpmi", onto, plan.A @ np.swapaxes(within, 1, 2))
    depth = np.sign(np.einsum("vc,mc->vm", P[:, 2], plan.A))
    result = np.empty((2, len(mu), len(mu)))
    for i, share in enumerate(mu):
        there = M + share * plan.tau * (M @ plan.H_hat[0].T)
        m = there @ P.swapaxes(1, 2)[:, None, None]
        uv = through(lens[:, None, None, None], m[..., :2] / m[..., 2:])
        least = np.minimum(uv + 0.5, material.plant.image_size - 0.5 - uv).min(axis=(-1, -2))
        front = (m[..., 2] * depth[:, None, None] > 0.0).all(axis=-1)
        least = np.where(front & np.isfinite(least), least, -np.inf)
        best = least.min(axis=0).argmax(axis=1)
        result[:, i] = least[:, np.arange(len(mu)), best]
    return result


@registered(
    "fig14_path",
    "Where each camera sees the face, and the planned path among it",
    "beside the paper's, after section 4.3",
    6.0,
    _data,
)
def _draw(data: Data, figure: "Figure") -> None:
    """Above the map of each camera with the path, below the shares and the margins along it."""
    axes = figure.subplots(2, 2, height_ratios=[1.5, 1.0])
    for view, name in enumerate(VIEWS):
        _map(axes[0, view], data, view)
        axes[0, view].set_title(f"{name} camera, {data['profile']} profile")
    for panel, name, lines in zip(axes[1], ("mu", "along"), (style.SHARES, _MARGINS), strict=True):
        for column, look in zip(data[name].T, lines.values(), strict=True):
            panel.plot(data["sigma"], column, **look)
        panel.set_xlabel(r"path parameter $\sigma$ (1)")
    axes[1, 0].set_ylabel(r"share $\mu$ (1)")
    axes[1, 1].axhline(0.0, color=style.BLACK, linewidth=0.6)
    if np.nanmax(data["along"]) > _WIDE:  # conditioning may grow a hundredfold
        axes[1, 1].set_yscale("symlog", linthresh=1.0)
        axes[1, 1].yaxis.set_major_formatter("{x:g}")
    axes[1, 1].set_ylim(bottom=min(-0.1, 1.1 * float(np.nanmin(data["along"]))))
    axes[1, 1].set_ylabel("margin (1)")
    region: style.Look = {"alpha": 0.6, "edgecolor": style.BLACK, "linewidth": 0.0}
    looks: dict[str, style.Look] = {
        "hidden from this camera": region | _REGIONS["margin"],
        r"outside this image at every $\mu_p$": region | _REGIONS["border_px"],
        r"path, at tenths of $\sigma$": {"color": style.VERMILION, "marker": "o"},
    }
    style.legend_below(figure, {**looks, **style.SHARES, **_MARGINS}, 4)


def _map(axes: "Axes", data: Data, view: int) -> None:
    share = data["share"]
    for name, look in _REGIONS.items():
        finite = np.maximum(data[name][view], -1e6)
        if finite.min() < 0.0:
            color, hatch = look["facecolor"], look["hatch"]
            axes.contourf(
                share, share, finite.T, levels=[-1e9, 0.0], colors=[color], hatches=[hatch], alpha=0.6
            )
        if finite.min() < 0.0 < finite.max():
            axes.contour(share, share, finite.T, levels=[0.0], colors=[style.BLACK], linewidths=0.6)
    seen = axes.contour(
        share, share, data["margin"][view].T, levels=[0.25, 0.5, 0.75, 1.0, 1.5, 2.0],
        colors=[style.BLACK], linewidths=0.4, linestyles="dotted",
    )  # fmt: skip
    lines = np.concatenate([data["mu"][:, :2], np.repeat(share[:, None], 2, axis=1)])
    axes.clabel(seen, fmt="%g", fontsize=6.5, manual=_clear(seen.allsegs, lines))
    t, r = data["mu"][:, 0], data["mu"][:, 1]
    axes.plot([0.0, 1.0], [0.0, 1.0], color=style.BLACK, linewidth=0.5)
    axes.plot(t, r, color=style.VERMILION, linewidth=1.6)
    tenths = np.linspace(0.0, 1.0, _TICKS)
    sigma = data["sigma"]
    axes.plot(np.interp(tenths, sigma, t), np.interp(tenths, sigma, r), "o", color=style.VERMILION)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes.set(xlabel=r"translation $\mu_t$ (1)", ylabel=r"turn onto the plane $\mu_r$ (1)")


def _clear(contours: Any, lines: FloatArray) -> list[FloatArray]:
    """A place (2,) on each piece of each contour, away from the points (k, 2), the border and one another."""
    places: list[FloatArray] = []
    for piece in (piece for pieces in contours for piece in pieces if len(piece) > 1):
        taken = np.concatenate([lines, np.reshape(places, (-1, 2))])
        room = np.linalg.norm(piece[:, None] - taken, axis=2).min(axis=1)
        room = np.minimum(room, np.minimum(piece, 1.0 - piece).min(axis=1))
        if room.max() > LABEL:
            places.append(piece[room.argmax()])
    return places
