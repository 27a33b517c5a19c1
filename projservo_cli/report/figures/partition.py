"""Fig. 1 of [RH00]: the task as a translation, a rotation onto a plane and one within it."""

from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.geometry.algebra import exp_rotation
from projservo_cli.geometry.kinematics import project
from projservo_cli.records import FloatArray
from projservo_cli.report import style
from projservo_cli.report.material import Data, Material, registered
from projservo_cli.task.face import cyclic_order

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ARC_POINTS = 61


def _data(material: Material) -> Data:
    """Images in the left camera of the face, its targets and the paths of the three parts.

    A_t is the goal less the translation, A_r the goal less both translation and rotation onto the
    plane, [RH00] eqs. (12), (16); all come from the calibration and the images.
    """
    plan = material.plan
    order = cyclic_order(plan.A)
    share = np.linspace(0.0, 1.0, _ARC_POINTS)
    H_r = [exp_rotation(plan.H_hat[1], x * plan.theta_r) for x in share]
    H_p = [exp_rotation(plan.H_hat[2], x * plan.theta_p) for x in share]
    axis = _axis(plan.H_hat[1], plan.A_c, plan.A)

    def seen(points: FloatArray) -> FloatArray:
        return np.asarray(project(material.calibrated.P[:1], points, material.calibrated.lens[:1])[0])

    return {
        "A": seen(plan.A[order]),
        "A_t": seen(plan.A_t[order]),
        "A_r": seen(plan.A_r[order]),
        "A_star": seen(plan.A_star[order]),
        "center": seen(np.stack([plan.A_c, plan.A_c_star])),
        "onto_plane": seen(np.stack([plan.A_r[order] @ H.T for H in H_r])),
        "within_plane": seen(np.stack([plan.A[order] @ H.T for H in H_p])),
        "axis": seen(axis),
        "angles_deg": np.degrees([plan.theta_r, plan.theta_p]),
    }


def _axis(H_hat: FloatArray, A_c: FloatArray, A: FloatArray) -> FloatArray:
    """Two points (2, 4) on the axis of a rotation through the centre, as far out as the face.

    (I + Ĥ²) X is the foot of X on the axis.
    """
    feet = A + A @ (H_hat @ H_hat).T
    offset = feet - A_c
    longest = offset[np.argmax(np.linalg.norm(offset, axis=1))]
    reach = np.linalg.norm(A - A_c, axis=1).max()
    size = np.linalg.norm(longest)
    if size == 0.0:
        return np.stack([A_c, A_c])
    return np.stack([A_c - 1.4 * reach / size * longest, A_c + 1.4 * reach / size * longest])


_SHIFTED: style.Look = {"color": style.VERMILION, "linestyle": (0, (1, 1))}
_TURNED: style.Look = {"color": style.GREEN, "linestyle": (0, (5, 1.5, 1, 1.5))}
_PATH: style.Look = {"color": style.GREY, "linewidth": 0.7}
_AXIS: style.Look = {"color": style.BLACK, "linewidth": 0.8, "linestyle": (0, (8, 3, 1, 3))}


@registered(
    "fig01_partition",
    "The task as a translation, a rotation onto the target plane and one within it",
    "Fig. 1, section 4.1",
    3.0,
    _data,
    alt="Three panels in the left image: the face moved along a straight line, turned onto the "
    "target plane, and turned within it.",
)
def _draw(data: Data, figure: "Figure") -> None:
    """Three panels, one a part."""
    axes = figure.subplots(1, 3, width_ratios=[1.1, 1, 1])
    _translation(axes[0], data)
    _onto_plane(axes[1], data)
    _within_plane(axes[2], data)
    looks = {
        "start $A$": style.START,
        "goal $A_*$": style.GOAL,
        "goal less translation $A_t$": _SHIFTED,
        "less rotation onto the plane $A_r$": _TURNED,
        "paths of the markers": _PATH,
        r"axis of $\hat H_r$": _AXIS,
    }
    style.legend_below(figure, looks, 3)


def _translation(axes: "Axes", data: Data) -> None:
    for k in range(len(data["A"])):
        axes.plot(*np.stack([data["A_t"][k], data["A_star"][k]]).T, **_PATH)
    arrow = {"arrowstyle": "->", "linewidth": 0.9}
    axes.annotate("", data["center"][1], data["center"][0], arrowprops=arrow)
    style.face(axes, data["A"], style.START, fill=True)
    style.face(axes, data["A_t"], _SHIFTED)
    style.face(axes, data["A_star"], style.GOAL)
    style.frame_pixels(axes, np.concatenate([data["A"], data["A_t"], data["A_star"]]))
    style.image_axes(axes, "translation of the centre")


def _onto_plane(axes: "Axes", data: Data) -> None:
    axes.plot(*data["axis"].T, **_AXIS)
    for k in range(len(data["A"])):
        axes.plot(*data["onto_plane"][:, k].T, **_PATH)
    style.face(axes, data["A"], style.START, fill=True)
    style.face(axes, data["A_r"], _TURNED)
    style.face(axes, data["A_t"], _SHIFTED)
    around = [data["onto_plane"].reshape(-1, 2), data["axis"], data["A"], data["A_t"]]
    style.frame_pixels(axes, np.concatenate(around))
    style.image_axes(axes, rf"onto plane, $\theta_r$ = {style.signed(data['angles_deg'][0])}°")


def _within_plane(axes: "Axes", data: Data) -> None:
    for k in range(len(data["A"])):
        axes.plot(*data["within_plane"][:, k].T, **_PATH)
    style.face(axes, data["A"], style.START, fill=True)
    style.face(axes, data["A_r"], _TURNED)
    style.frame_pixels(axes, np.concatenate([data["within_plane"].reshape(-1, 2), data["A_r"]]))
    style.image_axes(axes, rf"within plane, $\theta_p$ = {style.signed(data['angles_deg'][1])}°")
