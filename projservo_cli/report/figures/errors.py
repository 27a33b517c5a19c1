"""Figs. 9 and 10 of [RH00]: the control errors of directTWO and directTHREE."""

from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.records import FloatArray, Trace
from projservo_cli.report import style
from projservo_cli.report.material import (
    Data,
    Material,
    center_distance,
    curve_difference,
    percent,
    registered,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# What is drawn of an error on a logarithmic scale: five decades below its start.
_DECADES = 1e-5
_FAINT: style.Look = {"linewidth": 0.8, "alpha": 0.55}
_DOTTED = (0, (1, 1.2))


def _data_two(material: Material) -> Data:
    """Errors of directTWO with calibrated operators, without and with the limit."""
    studies = material.studies
    assert studies is not None
    result: Data = {"step_limit_deg": np.array(studies.step_limit_deg)}
    for name, limited in (("free", False), ("limited", True)):
        trace = studies.own["direct_two", "calibrated", limited]
        result |= {
            f"t_s_{name}": _time(trace),
            f"tau_{name}": percent(trace.tau),
            f"tau_affine_{name}": percent(trace.tau_affine),
            f"theta_s_deg_{name}": np.degrees(trace.theta_s),
        }
    return result


def _time(trace: Trace) -> FloatArray:
    return np.asarray(trace.period * np.arange(len(trace.tau)))


@registered(
    "fig09_errors_two",
    "Control errors of directTWO, without and with the limit",
    "Fig. 9, section 6",
    4.2,
    _data_two,
    studies=True,
    alt="Translation and rotation error of directTWO over time, on a linear and on a logarithmic "
    "scale, without a limit and with one.",
)
def _draw_two(data: Data, figure: "Figure") -> None:
    """Above τ, below θ_s; left as in the paper, right on a logarithmic scale."""
    axes = figure.subplots(2, 2, sharex=True)
    looks: dict[str, style.Look] = {
        "free": {"color": style.BLACK, "linestyle": "-"},
        "limited": {"color": style.VERMILION, "linestyle": (0, (4, 1.5))},
    }
    for name, look in looks.items():
        t = data[f"t_s_{name}"]
        for column in range(2):
            axes[0, column].plot(t, data[f"tau_affine_{name}"], **look)
            axes[0, column].plot(t, data[f"tau_{name}"], **look, **_FAINT)
            axes[1, column].plot(t, data[f"theta_s_deg_{name}"], **look)
    for panel, start in zip(axes[:, 1], (100.0, float(data["theta_s_deg_free"][0])), strict=True):
        style.log_scale(panel)
        panel.set_ylim(max(start, 1e-3) * _DECADES, max(start, 1e-3) * 3.0)
    for column, title in enumerate(("linear scale", "logarithmic scale")):
        axes[0, column].set(title=f"directTWO, {title}", ylabel=r"$\tau$ (% of its start)")
        axes[1, column].set(xlabel="time (s)", ylabel=r"$\theta_s$ (deg)")
    legend: dict[str, style.Look] = {
        "no limit": looks["free"],
        f"{data['step_limit_deg']:g}° per step": looks["limited"],
        r"thin: $\tau$ of the unit-norm kernel (8)": {"color": style.BLACK, **_FAINT},
    }
    style.legend_below(figure, legend, 3)


def _data_three(material: Material) -> Data:
    """Errors of directTHREE with the projective and the metric model, and the true distance.

    τ is normalised to 100. In the unit-norm kernel of (8) its scale changes with the joints; scaled
    through a_inf it is the true distance of the centre.
    """
    studies = material.studies
    assert studies is not None
    calibrated = studies.own["direct_three", "calibrated", False]
    metric = studies.own["direct_three", "true", False]
    twin = studies.own["direct_three", "twin", False]
    result: Data = {
        "t_s": _time(calibrated),
        "t_s_metric": _time(metric),
        "tau": percent(calibrated.tau),
        "tau_affine": percent(calibrated.tau_affine),
        "distance": percent(center_distance(material, calibrated)),
        "tau_metric": percent(metric.tau),
        "distance_metric": percent(center_distance(material, metric)),
    }
    for name in ("theta_r", "theta_p"):
        curves = {trace: getattr(trace, name) for trace in (calibrated, metric, twin)}
        result[f"{name}_deg"] = np.degrees(curves[calibrated])
        result[f"{name}_deg_metric"] = np.degrees(curves[metric])
        for kind, trace in (("calibrated", calibrated), ("true", twin)):
            difference, _ = curve_difference(curves[trace], curves[metric])
            result[f"{name}_difference_deg_{kind}"] = np.degrees(difference)
    return result


@registered(
    "fig10_errors_three",
    "Control errors of directTHREE, projective beside Euclidean model",
    "Fig. 10, section 6",
    4.8,
    _data_three,
    studies=True,
    goal=True,
    alt="Translation and rotation errors of directTHREE over time with the projective and the "
    "Euclidean model, and the differences between both.",
)
def _draw_three(data: Data, figure: "Figure") -> None:
    """Above τ and what separates it from the truth, below the angles and their differences."""
    axes = figure.subplots(2, 2, sharex=True)
    t, t_metric = data["t_s"], data["t_s_metric"]
    t_common = max(t, t_metric, key=len)
    looks: dict[str, style.Look] = {
        "distance": {"color": style.SKY, "linewidth": 3.2},
        "tau_affine": {"color": style.BLACK},
        "tau": {"color": style.VERMILION, "linestyle": (0, (4, 1.5))},
        "tau_metric": {"color": style.BLACK, "linestyle": _DOTTED},
    }
    for name, look in looks.items():
        axes[0, 0].plot(t_metric if name == "tau_metric" else t, data[name], **look)
    for name in ("tau_affine", "tau"):
        axes[0, 1].plot(t, np.abs(data[name] - data["distance"]), **looks[name])
    angles = (("theta_r", style.BLACK, "o"), ("theta_p", style.VERMILION, "s"))
    for name, color, marker in angles:
        axes[1, 0].plot(t, data[f"{name}_deg"], color=color)
        every = max(1, len(t_metric) // 25)
        axes[1, 0].plot(
            t_metric, data[f"{name}_deg_metric"], marker, color=color, fillstyle="none", markevery=every
        )
        for kind, line in (("calibrated", "-"), ("true", _DOTTED)):
            difference = data[f"{name}_difference_deg_{kind}"]
            axes[1, 1].plot(t_common[: len(difference)], difference, color=color, linestyle=line)
    for panel, least in zip(axes[:, 1], (1e-4, 1e-15), strict=True):
        style.log_scale(panel)
        panel.set_ylim(bottom=least)
    axes[0, 0].set(title="directTHREE: translation error", ylabel=r"$\tau$ (% of its start)")
    axes[0, 1].set(title="its difference from the true distance", ylabel="difference (% of the start)")
    axes[1, 0].set(title="rotation errors", xlabel="time (s)", ylabel="angle (deg)")
    axes[1, 1].set(title="projective less Euclidean model", xlabel="time (s)", ylabel="difference (deg)")
    points: style.Look = {"color": style.BLACK, "marker": "o", "linestyle": "none", "fillstyle": "none"}
    legend = {
        "true distance": looks["distance"],
        r"$\tau$, scale fixed through $a_\infty$": looks["tau_affine"],
        r"$\tau$, unit-norm kernel (8), projective": looks["tau"],
        r"$\tau$, unit-norm kernel (8), Euclidean": looks["tau_metric"],
        r"$\theta_r$, projective model": {"color": style.BLACK},
        r"$\theta_p$, projective model": {"color": style.VERMILION},
        r"$\theta_r$, $\theta_p$, Euclidean": points,
        "dotted difference: true operators": {"color": style.BLACK, "linestyle": _DOTTED},
    }
    style.legend_below(figure, legend, 2)
