"""Figs. 9, 10 and 12 of [RH00]: control errors and joints under direct control, over time."""

import numpy as np

from projservo_cli.laws import PAPER_LAWS
from projservo_cli.records import FloatArray, Trace
from projservo_cli.report import panels, style
from projservo_cli.report.figure_inputs import (
    Data,
    Driven,
    ReportData,
    curve_difference,
    joint_kinds,
    joint_units,
    moved,
    percent,
    registered,
    title,
)
from projservo_cli.task.face import cyclic_order

_DECADES = 1e-5  # share of its start, down to which an error is drawn on a log scale
_FAINT: style.LineStyle = {"linewidth": 0.8, "alpha": 0.55, "label": ""}
_KERNEL = r"$\tau$, unit-norm kernel (8), "
_TRANSLATION = {
    "distance": style.line(style.SKY, width=3.2, label="true distance"),
    "tau_affine": style.line(style.BLACK, label=r"$\tau$, scale fixed through $a_\infty$"),
    "tau": style.line(style.VERMILION, style.DASHED, label=_KERNEL + "projective"),
    "tau_metric": style.line(style.BLACK, style.DOTTED, label=_KERNEL + "Euclidean"),
}
_THIN = 0.6  # points, of differences with true operators
_HIDES = 3.0  # times the step of the slower half of the joints, beyond which a step hides theirs
_LIMIT = style.line(style.GREY, width=0.8)
_WAYS = (("free", False), ("limited", True))  # without and with the limit of the joint speed


def _data_two(report_data: ReportData) -> Data:
    """Errors of directTWO with calibrated operators, without and with the limit."""
    result: Data = {"step_limit_deg": np.array(report_data.extra.step_limit_deg)}
    for name, limited in _WAYS:
        trace = report_data.extra.own["direct_two", "calibrated", limited]
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
    _data_two,
    height=4.2,
    studies=True,
    alt="Translation and rotation error of directTWO over time, on a linear and on a logarithmic "
    "scale, without a limit and with one.",
)
def _draw_two(data: Data, figure: "style.Figure") -> None:
    """Above τ, below θ_s; left as in the paper, right on a logarithmic scale."""
    axes = figure.subplots(2, 2, sharex=True)
    lines = {
        "free": style.line(style.BLACK, label="no limit"),
        "limited": style.line(style.VERMILION, style.DASHED, label=f"{data['step_limit_deg']:g}° per step"),
    }
    for (above, below), scale in zip(axes.T, ("linear", "logarithmic"), strict=True):
        for name, line in lines.items():
            t = data[f"t_s_{name}"]
            above.plot(t, data[f"tau_affine_{name}"], **line)
            above.plot(t, data[f"tau_{name}"], **line | _FAINT)
            below.plot(t, data[f"theta_s_deg_{name}"], **line)
        above.set(title=f"directTWO, {scale} scale", ylabel=r"$\tau$ (% of its start)")
        below.set(xlabel="time (s)", ylabel=r"$\theta_s$ (deg)")
    for panel, start in zip(axes[:, 1], (100.0, float(data["theta_s_deg_free"][0])), strict=True):
        style.log_scale(panel)
        panel.set_ylim(max(start, 1e-3) * _DECADES, max(start, 1e-3) * 3.0)
    said = "unit-norm kernel (8), whose scale jumps near a singularity of the arm"
    thin = style.line(style.BLACK) | _FAINT | {"label": rf"thin: $\tau$ of the {said}"}
    style.legend_below(figure, 3, [thin])


def _data_three(report_data: ReportData) -> Data:
    """Errors of directTHREE with the projective and the metric model, and the true distance.

    τ is normalised to 100. In the unit-norm kernel of (8) its scale changes with the joints; scaled
    through a_inf it is the true distance of the centre.
    """
    own = report_data.extra.own
    calibrated, metric, twin = (own["direct_three", kind, False] for kind in ("calibrated", "true", "twin"))
    result: Data = {
        "t_s": _time(calibrated),
        "t_s_metric": _time(metric),
        "tau": percent(calibrated.tau),
        "tau_affine": percent(calibrated.tau_affine),
        "distance": percent(report_data.center_distance(calibrated)),
        "tau_metric": percent(metric.tau),
        "distance_metric": percent(report_data.center_distance(metric)),
    }
    for name in ("theta_r", "theta_p"):
        result[f"{name}_deg"] = np.degrees(getattr(calibrated, name))
        result[f"{name}_deg_metric"] = np.degrees(getattr(metric, name))
        for kind, trace in (("calibrated", calibrated), ("true", twin)):
            difference = curve_difference(getattr(trace, name), getattr(metric, name))
            result[f"{name}_difference_deg_{kind}"] = np.degrees(difference)
    return result


@registered(
    "fig10_errors_three",
    "Control errors of directTHREE, projective and Euclidean model",
    "Fig. 10, section 6",
    _data_three,
    height=5.1,
    studies=True,
    goal=True,
    alt="Translation and rotation errors of directTHREE over time with the projective and the "
    "Euclidean model, and the differences between both.",
)
def _draw_three(data: Data, figure: "style.Figure") -> None:
    """Above τ and its difference from the truth, below the angles and their differences."""
    (translation, off), (rotation, difference) = figure.subplots(2, 2, sharex=True)
    t, t_metric = data["t_s"], data["t_s_metric"]
    for name, line in _TRANSLATION.items():
        translation.plot(t_metric if name == "tau_metric" else t, data[name], **line)
        if name in ("tau_affine", "tau"):
            off.plot(t, style.positive(np.abs(data[name] - data["distance"])), **line)
    _rotations(rotation, difference, data)
    for panel, lowest in ((off, 1e-4), (difference, 1e-15)):
        style.log_scale(panel)
        panel.set_ylim(bottom=lowest)
    translation.set(title="directTHREE: translation error", ylabel=r"$\tau$ (% of its start)")
    off.set(title="its difference from the true distance", ylabel="difference (% of the start)")
    rotation.set(title="rotation errors", xlabel="time (s)", ylabel="angle (deg)")
    difference.set(title="projective less Euclidean model", xlabel="time (s)", ylabel="difference (deg)")
    thin = style.line(style.GREY, width=_THIN, label="thin difference: true operators")
    style.legend_below(figure, 2, [thin])


def _rotations(rotation: "style.Axes", difference: "style.Axes", data: Data) -> None:
    """Draw θ_r and θ_p with both models, and how far these differ, thin with true operators."""
    t, t_metric = data["t_s"], data["t_s_metric"]
    t_common = max(t, t_metric, key=len)
    markers = {"fillstyle": "none", "markevery": max(1, len(t_metric) // 25)}
    for name, color, marker in (("theta_r", style.GREEN, "o"), ("theta_p", style.PURPLE, "s")):
        angle = rf"$\{name}$"
        rotation.plot(t, data[f"{name}_deg"], color=color, label=f"{angle}, projective model")
        euclidean = style.dots(color, marker, f"{angle}, Euclidean model", **markers)
        rotation.plot(t_metric, data[f"{name}_deg_metric"], **euclidean)
        for kind, width in (("calibrated", None), ("true", _THIN)):
            curve = data[f"{name}_difference_deg_{kind}"]
            positive_values = style.positive(curve)
            difference.plot(t_common[: len(curve)], positive_values, **style.line(color, width=width))


def _enlarge(axes: "style.Axes", t: FloatArray, steps: FloatArray, chosen: list[int]) -> None:
    """Draw steps (k, n) of the chosen joints enlarged too, where fast ones hide the slower half of them."""
    largest = np.sort(np.abs(steps[:, chosen]).max(axis=0, initial=0.0))
    half = 1.15 * float(largest[(len(largest) - 1) // 2])
    if not 0.0 < _HIDES * half < float(largest[-1]):
        return
    inset = axes.inset_axes((0.52, 0.56, 0.45, 0.38))
    panels.joints(inset, t, steps, chosen)
    inset.set(xlim=axes.get_xlim(), ylim=(-half, half))
    inset.tick_params(labelsize=6.5)
    inset.text(0.97, 0.93, "enlarged", ha="right", va="top", fontsize=6.5, transform=inset.transAxes)


def _data_joints(report_data: ReportData) -> Data:
    """Joints and their steps under directTHREE with calibrated operators, in deg and in mm."""
    prismatic = report_data.robot.prismatic
    scale = joint_units(prismatic)
    result: Data = {"prismatic": prismatic, "step_limit_deg": np.array(report_data.extra.step_limit_deg)}
    for name, limited in _WAYS:
        trace = report_data.extra.own["direct_three", "calibrated", limited]
        result |= {
            f"t_s_{name}": _time(trace),
            f"q_{name}": trace.q * scale,
            f"step_{name}": trace.q_dot * trace.period * scale,
        }
    return result


@registered(
    "fig12_joints",
    "Joint trajectories without and with the limit",
    "Fig. 12, section 6",
    _data_joints,
    studies=True,
    alt="The joints and their steps over time under directTHREE, without a limit and with one.",
)
def _draw_joints(data: Data, figure: "style.Figure") -> None:
    """Left without, right with the limit; joints above, their steps below, per kind of joint."""
    prismatic, limit = data["prismatic"], float(data["step_limit_deg"])
    kinds = joint_kinds(prismatic)
    figure.set_figheight(1.2 + 3.6 * len(kinds))
    axes = figure.subplots(2 * len(kinds), 2, sharex=True, squeeze=False)
    for panel in axes.flat:  # as many ticks as when labels are given room, however high it is then
        panel.locator_params(axis="y", nbins=6)
    for (joints, steps), (chosen, unit) in zip(axes.reshape(-1, 2, 2), kinds, strict=True):
        for panel, panel_below, (name, limited) in zip(joints, steps, _WAYS, strict=True):
            t = data[f"t_s_{name}"]
            panels.joints(panel, t, data[f"q_{name}"], chosen)
            panels.joints(panel_below, t[:-1], data[f"step_{name}"], chosen)
            if limited and unit == "deg":
                for bound in (-limit, limit):
                    panel_below.axhline(bound, **_LIMIT)
            if not limited:
                _enlarge(panel_below, t[:-1], data[f"step_{name}"], chosen)
        joints[0].set_ylabel(f"joint ({unit})")
        steps[0].set_ylabel(f"step ({unit} per period)")
        limits = [panel.get_ylim() for panel in joints]  # both sides are to be compared
        for panel in joints:
            panel.set_ylim(np.min(limits), np.max(limits))
    for column, heading in zip(axes.T, ("no limit", f"{limit:g}° per step"), strict=True):
        column[0].set_title(f"directTHREE, {heading}")
        column[-1].set_xlabel("time (s)")
    style.legend_below(figure, min(len(prismatic) + 1, 8), [_LIMIT | {"label": "limit"}])


def _data_runs(report_data: Driven) -> Data:
    """Images, judged error, joints and joint velocities of every run over time, by its name."""
    order, prismatic = cyclic_order(report_data.plan.A), report_data.calibration.prismatic
    scale, runs = joint_units(prismatic), moved(report_data)
    result: Data = {"run": np.array(runs), "view": np.array(report_data.view), "prismatic": prismatic}
    for name in runs:
        trace = report_data.traces[name]
        result |= {
            f"t_s_{name}": _time(trace),
            f"s_{name}": trace.s[:, :, order],
            f"s_star_{name}": trace.s_star[:, order],
            f"error_px_{name}": trace.convergence_error,
            f"q_{name}": trace.q * scale,
            f"q_dot_{name}": trace.q_dot * scale,
            f"verdict_{name}": np.array(f"{title(name)}\n{trace.verdict}, {trace.steps} steps"),
        }
    return result


def _of_other_laws(report_data: Driven | ReportData) -> bool:
    """Whether runs are of laws that are not in the paper; laws of a sequence have a separate figure."""
    others = {*moved(report_data)} - {*PAPER_LAWS}
    return bool(others) and not any("/" in name for name in others)


@registered(
    "fig21_runs",
    "Every run: images, error, joints and commands",
    "not in the paper",
    _data_runs,
    shows=(_of_other_laws, "all runs are of laws of the paper"),
    alt="A row for each run: the paths of the markers in the camera images, and the error that decides "
    "convergence, the joints and the commanded joint velocities over time.",
)
def _draw_runs(data: Data, figure: "style.Figure") -> None:
    """Two rows per run: above the images, below its curves over time."""
    runs, names, slides = [str(name) for name in data["run"]], data["view"], data["prismatic"]
    figure.set_figheight(4.4 * len(runs) + 0.5)
    rows = panels.rows(figure, [len(names), 3] * len(runs))
    units = "deg or mm" if slides.any() and not slides.all() else "mm" if slides.all() else "deg"
    for name, images, (error, joints, commands) in zip(runs, rows[::2], rows[1::2], strict=True):
        panels.images(images, [panels.DrawnRun(data[f"s_{name}"], panels.PATH)], data[f"s_star_{name}"])
        panels.cameras(images, names, str(data[f"verdict_{name}"]))
        t = data[f"t_s_{name}"]
        panels.errors(error, [(t, data[f"error_px_{name}"], style.line(style.BLACK))], ylabel="error (px)")
        panels.joints(joints, t, data[f"q_{name}"], range(len(slides)))
        panels.joints(commands, t[:-1], data[f"q_dot_{name}"], range(len(slides)))
        joints.set(ylabel=f"joint ({units})", xlabel="time (s)")
        commands.set(ylabel=f"velocity ({units} per s)", xlabel="time (s)")
    style.legend_below(figure, 8)
