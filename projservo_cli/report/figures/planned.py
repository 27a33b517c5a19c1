"""Figs. 5 and 6 of [RH00]: planned motions as seen from between the cameras, with their shares μ."""

from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.geometry.kinematics import project
from projservo_cli.geometry.stereo import triangulate_points
from projservo_cli.records import FloatArray
from projservo_cli.report import style
from projservo_cli.report.material import VIEWS, Data, Material, registered
from projservo_cli.robots.simulated import METRIC_A_INF, roll_axis
from projservo_cli.task.face import cyclic_order
from projservo_cli.task.trajectory import trajectory_displacement

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The steep profile has the translation done at this share of the path.
STEEP = 0.35
_FACES = 9


def _data_linear(material: Material) -> Data:
    """The plan of the run, by default with linear shares."""
    plan = material.plan
    return _rendered(material, plan.mu, plan.s, plan.margin, plan.profile)


def _data_steep(material: Material) -> Data:
    """The same task with linear shares of the rotations and a steep one of the translation."""
    plan = material.plan
    mu = np.stack([np.minimum(plan.sigma / STEEP, 1.0), plan.sigma, plan.sigma], axis=1)
    amplitudes = (plan.tau, plan.theta_r, plan.theta_p)
    H_d = trajectory_displacement(plan.H_hat, amplitudes, mu)
    s = np.array([project(material.calibrated.P, plan.A @ H.T, material.calibrated.lens) for H in H_d])
    carried = np.array([np.linalg.solve(H.T, plan.a) for H in H_d])
    margin = carried @ plan.optical_center.T / (plan.optical_center @ plan.a)
    return _rendered(material, mu, s, margin, "steep translation")


def _rendered(material: Material, mu: FloatArray, s: FloatArray, margin: FloatArray, profile: str) -> Data:
    """Pixels of the planned faces in a camera between the two.

    The planned stereo images come from the calibration alone; the true cameras only turn them into
    points that a third camera can see.
    """
    plan, P = material.plan, material.plant.model.P
    order = cyclic_order(plan.A)
    camera = middle_camera(P, material.plant.image_size)
    points = np.array([triangulate_points(P, METRIC_A_INF, row) for row in s])
    m = points[:, order] @ camera.T
    return {
        "sigma": plan.sigma,
        "mu": mu,
        "margin": margin,
        "faces": m[..., :2] / m[..., 2:],
        "profile": np.array(profile.replace("_", " ")),
    }


def middle_camera(P: FloatArray, image_size: FloatArray) -> FloatArray:
    """Camera (3, 4) midway between two metric cameras, looking along the roll axis of the rig, px.

    Its focal length is the mean of both, its principal point the middle of the image.

    P : (2, 3, 4) metric cameras; image_size : (2,) px.
    """
    center, z = roll_axis(P)
    across = np.zeros(3)
    focal = 0.0
    for camera in P:
        Q = camera[:, :3] / np.linalg.norm(camera[2, :3]) * np.sign(np.linalg.det(camera[:, :3]))
        right = Q[0] - (Q[0] @ Q[2]) * Q[2]
        across += right / np.linalg.norm(right)
        focal += float(np.linalg.norm(right)) / len(P)
    x = across - (across @ z) * z
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    u, v = (image_size - 1.0) / 2.0
    K = np.array([[focal, 0.0, u], [0.0, focal, v], [0.0, 0.0, 1.0]])
    result: FloatArray = K @ np.c_[R, -R @ center]
    return result


@registered(
    "fig05_planned",
    "The planned motion from between the cameras",
    "Fig. 5, section 6",
    3.6,
    _data_linear,
    alt="The face at several moments of the planned motion, seen from between the cameras; beside "
    "it the shares of translation and rotations that are done and the visibility margin of both "
    "cameras.",
)
@registered(
    "fig06_planned_steep",
    "The planned motion with a steep translation",
    "Fig. 6, section 6",
    3.6,
    _data_steep,
    alt="As the figure before, with a translation that is driven first: the face at several "
    "moments, the shares of the motions and the visibility margins.",
)
def _draw(data: Data, figure: "Figure") -> None:
    """Left the faces from dark to light along the path, right the shares and the margins."""
    from matplotlib import colormaps

    figure.set_figheight(max(4.2 * style.aspect(data["faces"]) + 1.0, 3.0))
    grid = figure.add_gridspec(2, 2, width_ratios=[1.7, 1])
    image, shares = figure.add_subplot(grid[:, 0]), figure.add_subplot(grid[0, 1])
    margins = figure.add_subplot(grid[1, 1], sharex=shares)
    faces, sigma = data["faces"], data["sigma"]
    for k in range(faces.shape[1]):
        image.plot(*faces[:, k].T, color=style.GREY, linewidth=0.6)
    shown = np.unique(np.linspace(0, len(sigma) - 1, _FACES).round().astype(int))
    for j in shown:
        color = colormaps["cividis"](0.82 * sigma[j])
        ends = j in (shown[0], shown[-1])
        style.face(image, faces[j], {"color": color, "linewidth": 1.8 if ends else 1.0})
    style.frame_pixels(image, faces)
    style.image_axes(image, f"from the rig's centre, {data['profile']}")
    for j, label in ((0, "start"), (-1, "goal")):
        corner = faces[j][np.argmin(faces[j][:, 1])]
        image.annotate(
            label,
            corner,
            xytext=(0, 5),
            textcoords="offset points",
            ha="center",
            va="bottom",
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.8},
        )
    for column, look in zip(data["mu"].T, style.SHARES.values(), strict=True):
        shares.plot(sigma, column, **look)
    shares.set_ylabel(r"share $\mu$ (1)")
    shares.tick_params(labelbottom=False)
    cameras = {f"{name} camera": style.curve(3 - view) for view, name in enumerate(VIEWS)}
    for column, look in zip(data["margin"].T, cameras.values(), strict=True):
        margins.plot(sigma, column, **look)
    margins.axhline(0.0, color=style.BLACK, linewidth=0.6)
    margins.set(xlabel=r"path parameter $\sigma$ (1)", ylabel="margin $a\\cdot O$\n(start = 1)")
    first: style.Look = {"color": style.BLACK, "marker": "o", "linestyle": "none"}
    style.legend_below(figure, {**style.SHARES, **cameras, "first marker of the face": first}, 6)
