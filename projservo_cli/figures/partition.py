"""Fig. 1 of [RH00]: the task as a translation, a rotation onto a plane and one within it."""

from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.figures import style
from projservo_cli.figures.material import Data, Material
from projservo_cli.geometry.displacement import exp_rotation
from projservo_cli.geometry.kinematics import project
from projservo_cli.records import FloatArray
from projservo_cli.task.face import cyclic_order

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ARC_POINTS = 61


def data(material: Material) -> Data:
    """Images in the left camera of the face, its targets and the paths of the three parts.

    A_t is the goal less the translation, A_r the goal less both translation and rotation onto the
    plane, [RH00] eqs. (12), (16); all come from the calibration and the images.
    """
    plan = material.plan
    order = cyclic_order(plan.A)
    share = np.linspace(0.0, 1.0, ARC_POINTS)
    H_r = [exp_rotation(plan.H_hat[1], x * plan.theta_r) for x in share]
    H_p = [exp_rotation(plan.H_hat[2], x * plan.theta_p) for x in share]
    axis = _axis(plan.H_hat[1], plan.A_c, plan.A)

    def seen(points: FloatArray) -> FloatArray:
        return project(material.calibrated.P[:1], points)[0]

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


def draw(data: Data, figure: "Figure") -> None:
    """Three panels, one a part."""
    axes = figure.subplots(1, 3, width_ratios=[1.25, 1, 1])
    start = {"color": style.BLACK, "linewidth": 1.4}
    goal = {"color": style.BLUE, "linestyle": (0, (5, 1.5))}
    shifted = {"color": style.VERMILION, "linestyle": (0, (1, 1))}
    turned = {"color": style.GREEN, "linestyle": (0, (5, 1.5, 1, 1.5))}
    path = {"color": style.GREY, "linewidth": 0.7}
    theta_r, theta_p = data["angles_deg"]

    for k in range(len(data["A"])):
        ends = np.stack([data["A_t"][k], data["A_star"][k]])
        axes[0].plot(ends[:, 0], ends[:, 1], **path)
    axes[0].annotate(
        "", data["center"][1], data["center"][0], arrowprops={"arrowstyle": "->", "linewidth": 0.9}
    )
    style.face(axes[0], data["A"], fill=style.PALE, **start)
    style.face(axes[0], data["A_t"], **shifted)
    style.face(axes[0], data["A_star"], **goal)
    style.frame_pixels(axes[0], np.concatenate([data["A"], data["A_t"], data["A_star"]]))

    axes[1].plot(*data["axis"].T, color=style.BLACK, linewidth=0.8, linestyle=(0, (8, 3, 1, 3)))
    for k in range(len(data["A"])):
        axes[1].plot(*data["onto_plane"][:, k].T, **path)
    style.face(axes[1], data["A"], fill=style.PALE, **start)
    style.face(axes[1], data["A_r"], **turned)
    style.face(axes[1], data["A_t"], **shifted)
    around = [data["onto_plane"].reshape(-1, 2), data["axis"], data["A"], data["A_t"]]
    style.frame_pixels(axes[1], np.concatenate(around))

    for k in range(len(data["A"])):
        axes[2].plot(*data["within_plane"][:, k].T, **path)
    style.face(axes[2], data["A"], fill=style.PALE, **start)
    style.face(axes[2], data["A_r"], **turned)
    style.frame_pixels(axes[2], np.concatenate([data["within_plane"].reshape(-1, 2), data["A_r"]]))

    style.image_axes(axes[0], "translation of the centre")
    style.image_axes(axes[1], rf"onto the plane, $\theta_r$ = {theta_r:.1f}°")
    style.image_axes(axes[2], rf"within the plane, $\theta_p$ = {theta_p:.1f}°")
    handles = [
        style.line_handle("start $A$", **start),
        style.line_handle("goal $A_*$", **goal),
        style.line_handle("goal less translation $A_t$", **shifted),
        style.line_handle("less rotation onto the plane $A_r$", **turned),
        style.line_handle("paths of the markers", **path),
        style.line_handle(
            r"axis of $\hat H_r$", color=style.BLACK, linewidth=0.8, linestyle=(0, (8, 3, 1, 3))
        ),
    ]
    style.legend_below(figure, handles, 3)
