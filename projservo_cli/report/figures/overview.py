"""The whole run at one look: both images, and how the errors end."""

from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.records import FloatArray
from projservo_cli.report import style
from projservo_cli.report.material import TITLES, VIEWS, Data, Material, center_image, percent, registered

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LAWS = ("direct_three", "stacked")
_IMAGE_WIDTH = 3.7  # inches, of the panels with images; those with errors stand beside them
_ERRORS_WIDTH = 2.1
_LEAST_ASPECT, _MOST_ASPECT = 0.45, 0.9  # height over width of an image: an error panel has its height
_LEAST_PERCENT = 1e-2  # of its start, of a control error: below it noise of the calibration rules
_HIDDEN: style.Look = {"color": style.ORANGE, "linewidth": 5.0, "alpha": 0.55, "solid_capstyle": "butt"}
_LOOKS: tuple[style.Look, ...] = (
    {"color": style.GREEN, "linewidth": 1.2},
    {"color": style.VERMILION, "linewidth": 1.1, "linestyle": (0, (4, 1.2))},
)
_CENTER: style.Look = {"color": style.GREEN, "linewidth": 3.2}
_ERRORS = (
    ("tau_affine", r"$\tau$"),
    ("theta_r", r"$\theta_r$"),
    ("theta_p", r"$\theta_p$"),
)


def _data(material: Material) -> Data:
    """Paths and image errors of the direct and the stacked law, control errors of the direct one."""
    order = material.plant.order
    direct = material.traces[_LAWS[0]]
    result: Data = {
        "s_star": direct.s_star[:, order],
        "center": center_image(material, direct),
        "period_s": np.array(direct.period),
        **{f"{name}_percent": np.abs(percent(getattr(direct, name))) for name, _ in _ERRORS},
    }
    for law in _LAWS:
        trace = material.traces[law]
        hidden = trace.self_occluded
        result |= {
            f"s_{law}": trace.s[:, :, order],
            f"hidden_{law}": hidden,
            f"image_error_{law}": trace.image_error,
            f"verdict_{law}": np.array(
                f"{TITLES[law]}: {trace.verdict} in {trace.steps} steps, "
                f"face hidden in {np.count_nonzero(hidden.any(axis=1))}"
            ),
        }
    return result


@registered(
    "fig00_overview",
    "One run at a look: the classical and the direct law in both images, and their errors",
    "beside the paper's",
    5.0,
    _data,
    laws=_LAWS,
    alt="Left: paths of the markers in both camera images, from the face at the start to the goal, "
    "for directTHREE and the stacked law, with the stretches in which the face is hidden. "
    "Right: control errors of directTHREE and image errors of both laws over time.",
)
def _draw(data: Data, figure: "Figure") -> None:
    """Left the images of both cameras, right the errors."""
    aspect = style.aspect(
        np.concatenate([_shown(data, view) for view in range(2)]), _LEAST_ASPECT, _MOST_ASPECT
    )
    figure.set_figheight(2.0 * _IMAGE_WIDTH * aspect + 1.75)
    axes = figure.subplots(2, 2, width_ratios=(_IMAGE_WIDTH, _ERRORS_WIDTH))
    for view, name in enumerate(VIEWS):
        _draw_image(axes[view, 0], data, view)
        style.image_axes(axes[view, 0], f"{name} camera")
    _draw_control_errors(axes[0, 1], data)
    _draw_image_errors(axes[1, 1], data)
    looks = {str(data[f"verdict_{law}"]): look for law, look in zip(_LAWS, _LOOKS, strict=True)}
    looks |= {
        f"centre under {TITLES[_LAWS[0]]}": _CENTER,
        "face at the start": style.START,
        "face at the goal": style.GOAL,
        "face hidden from the camera": _HIDDEN,
    }
    style.legend_below(figure, looks, 2)


def _shown(data: Data, view: int) -> FloatArray:
    """Pixels (k, 2) of all that is drawn of one view."""
    paths = [data[f"s_{law}"][:, view].reshape(-1, 2) for law in _LAWS]
    return np.concatenate([data["s_star"][view], data["center"][:, view], *paths])


def _draw_image(axes: "Axes", data: Data, view: int) -> None:
    for law, look in reversed(tuple(zip(_LAWS, _LOOKS, strict=True))):
        s, hidden = data[f"s_{law}"][:, view], data[f"hidden_{law}"][:, view, None]
        for k in range(s.shape[1]):
            axes.plot(*np.where(hidden, s[:, k], np.nan).T, **_HIDDEN)
            axes.plot(*s[:, k].T, **look)
    axes.plot(*data["center"][:, view].T, **_CENTER)
    style.face(axes, data[f"s_{_LAWS[0]}"][0, view], style.START, fill=True)
    style.face(axes, data["s_star"][view], style.GOAL)
    style.frame_pixels(axes, _shown(data, view))


def _draw_control_errors(axes: "Axes", data: Data) -> None:
    for index, (name, label) in enumerate(_ERRORS):
        values: FloatArray = data[f"{name}_percent"]
        if np.isfinite(values).all():
            t = data["period_s"] * np.arange(len(values))
            axes.plot(t, values, label=label, **style.curve(index))
    style.log_scale(axes)
    title = f"control errors, {TITLES[_LAWS[0]]}"
    axes.set(title=title, xlabel="time (s)", ylabel="error (% of its start)", ylim=(_LEAST_PERCENT, 200.0))
    axes.legend(loc="upper right")


def _draw_image_errors(axes: "Axes", data: Data) -> None:
    for law, look in zip(_LAWS, _LOOKS, strict=True):
        e, hidden = data[f"image_error_{law}"], data[f"hidden_{law}"].any(axis=1)
        t = data["period_s"] * np.arange(len(e))
        axes.plot(t, np.where(hidden, e, np.nan), **_HIDDEN)
        axes.plot(t, e, **look)
    style.log_scale(axes)
    axes.set(title="image errors, both laws", xlabel="time (s)", ylabel="rms (px)")
