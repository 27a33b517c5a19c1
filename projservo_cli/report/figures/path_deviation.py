"""Drift of the centre from its straight line: for several gains, Fig. 8 of [RH00], and by mode."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from projservo_cli.geometry.kinematics import forward_kinematics
from projservo_cli.laws import title_of
from projservo_cli.messages.verdict_causes import arrived
from projservo_cli.records import FloatArray, Report, Trace
from projservo_cli.report import style
from projservo_cli.report.figure_inputs import (
    DIRECT,
    Data,
    ReportData,
    Studies,
    along_line,
    registered,
    title,
)

_PATH_POINTS = 400
_WHIRL = np.pi  # joint step, rad or m, above which the arm winds up: its path is drawn at the instants only
_WIDE = 10.0  # modes that differ more have a logarithmic scale, down to a fraction of the smallest
_LEAST_SHOWN = 0.02
_RESOLUTION = np.radians(1.0)  # longest joint motion, rad or m, between two points of a drawn path
_OPERATORS = ("true", "calibrated")
# Largest deviations by operators and limit, both 0 or 1.
_MAXIMA = {
    (0, 0): style.line(style.BLACK, marker="o"),
    (0, 1): style.line(style.BLACK, style.DASHED, marker="^"),
    (1, 0): style.line(style.VERMILION, marker="s", fillstyle="none"),
    (1, 1): style.line(style.VERMILION, style.DASHED, marker="v", fillstyle="none"),
}


def study_numbers(studies: Studies | None) -> dict[str, Any]:
    """Return the numbers of the extra runs for a ``Report``, NaN if the goal pose is unknown.

    Laws, operators, limits and gains are in the order of its tables.
    """
    gains, periods = (studies.gains, studies.periods) if studies is not None else ((), ())
    shape = (len(DIRECT), len(_OPERATORS), 2, len(gains))
    drift, at_samples, converged = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, np.bool_)
    by_period = np.full((len(DIRECT), len(periods)), np.nan)
    for (law, operators, limited, gain), trace in (studies.sweep if studies is not None else {}).items():
        where = DIRECT.index(law), _OPERATORS.index(operators), int(limited), gains.index(gain)
        converged[where] = arrived(trace.verdict)
        drift[where] = trace.center_deviation_mm  # None becomes NaN
        at_samples[where] = trace.center_deviation_at_samples_mm
    for (law, period), trace in (studies.rate if studies is not None else {}).items():
        by_period[DIRECT.index(law), periods.index(period)] = trace.center_deviation_mm
    return {
        "gain_per_step": np.array(gains),
        "path_deviation_mm": drift,
        "path_deviation_at_samples_mm": at_samples,
        "path_deviation_converged": converged,
        "period": np.array(periods),
        "period_path_deviation_mm": by_period,
    }


def _data(report_data: ReportData) -> Data:
    """Paths of the centre with calibrated operators, and the largest deviations of all runs."""
    studies = report_data.extra
    result: Data = {
        "gain": np.array(studies.gains),
        "path_deviation_mm": study_numbers(studies)["path_deviation_mm"],
        "step_limit_deg": np.array(studies.step_limit_deg),
    }
    for law in DIRECT:
        cases = [(gain, False) for gain in studies.gains] + [(max(studies.gains), True)]
        for i, (gain, limited) in enumerate(cases):
            trace = studies.sweep[law, "calibrated", limited, gain]
            whirls = np.abs(np.diff(trace.q, axis=0)).max(initial=0.0) > _WHIRL
            points = trace.center if whirls else _center_path(report_data, trace)
            along, off = along_line(points, trace.center[0], report_data.goal_center(trace))
            used = np.unique(np.linspace(0, len(points) - 1, _PATH_POINTS).round().astype(int))
            result[f"whirls_{law}_{i}"] = np.array(whirls)
            result[f"path_mm_{law}_{i}"] = 1e3 * np.stack([along, off], axis=1)[used]
    return result


def _center_path(report_data: ReportData, trace: Trace) -> FloatArray:
    """True centre (k, 3) along a run, m, between the instants too, where the joints move linearly."""
    amount = np.abs(np.diff(trace.q, axis=0)).max(axis=1, initial=0.0)
    points = [trace.center[0]]
    for k, upper in enumerate(amount):
        parts = max(1, int(np.ceil(upper / _RESOLUTION)))
        for share in np.arange(1, parts) / parts:
            q = trace.q[k] + share * (trace.q[k + 1] - trace.q[k])
            points.append((forward_kinematics(report_data.plant.model, q) @ report_data.middle)[:3])
        points.append(trace.center[k + 1])
    return np.array(points)


@registered(
    "fig08_drift",
    "Drift of the centre from its straight line",
    "Fig. 8, section 6",
    _data,
    height=5.2,
    studies=True,
    goal=True,
    alt="For directTHREE and directTWO: distance of the centre from its straight line along the path "
    "for several gains, and the largest distance over the gain, with true and calibrated "
    "operators, with and without a limit.",
)
def _draw(data: Data, figure: "style.Figure") -> None:
    """One row per law: left the paths, right the largest deviation over the gain."""
    gains, limit = data["gain"], f"{float(data['step_limit_deg']):g}° per step"
    lines = [
        *(style.curve(i, f"gain {gain:g} per step") for i, gain in enumerate(gains)),
        style.line(
            style.SKY, width=2.8, label=f"{gains.max():g} and {limit}", zorder=1.5
        ),  # below the others
    ]
    axes = figure.subplots(2, 2, width_ratios=[1.5, 1])
    for (path_axes, gain_axes), deviation, law in zip(axes, data["path_deviation_mm"], DIRECT, strict=True):
        _paths(path_axes, [data[f"path_mm_{law}_{i}"] for i in range(len(lines))], lines, wide=True)
        path_axes.set_title(f"{title_of(law)}: path of the centre, calibrated operators")
        for (operators, limited), line in _MAXIMA.items():
            label = f"{_OPERATORS[operators]}, {limit if limited else 'no limit'}"
            size = 4.5 if operators else 3.0  # an empty marker shows around a full one
            gain_axes.plot(gains, deviation[operators, limited], **line, markersize=size, label=label)
        gain_axes.set(title=f"{title_of(law)}: largest distance", xscale="log")
        gain_axes.set(xlabel="gain per step (1)", ylabel="largest distance (mm)")
        gain_axes.set_xticks(gains, [f"{gain:g}" for gain in gains])
        gain_axes.minorticks_off()
        style.log_scale(gain_axes)
    whirls = any(data[f"whirls_{law}_{i}"] for law in DIRECT for i in range(len(lines)))
    note = style.line(style.BLACK, style.NO_LINE, label="chords: steps over 180°")
    style.legend_below(figure, 4, [note] * whirls)


def drift_rows(report: Report) -> list[dict[str, Any]]:
    """The drift table as rows: law, operators, limit in deg per step or None, gain, mm, converged."""
    rows = []
    for law, operators, limited, gain in np.ndindex(report.path_deviation_mm.shape):
        index = law, operators, limited, gain
        drift, at_samples = (
            float(values[index]) if np.isfinite(values[index]) else None
            for values in (report.path_deviation_mm, report.path_deviation_at_samples_mm)
        )
        rows.append(
            {
                "law": DIRECT[law],
                "operators": _OPERATORS[operators],
                "limit_deg_per_step": report.step_limit_deg if limited else None,
                "gain_per_step": float(report.gain_per_step[gain]),
                "path_deviation_mm": drift,
                "path_deviation_at_samples_mm": at_samples,
                "converged": bool(report.path_deviation_converged[index]),
            }
        )
    return rows


def _data_modes(report_data: ReportData) -> Data:
    """Way along the line of the centre and distance from it at every instant, mm."""
    names = report_data.compared()
    result: Data = {"names": np.array(names)}
    for name in names:
        trace = report_data.traces[name]
        along, off = along_line(trace.center, trace.center[0], report_data.goal_center(trace))
        result[f"path_mm_{name}"] = 1e3 * np.stack([along, off], axis=1)
    return result


@registered(
    "fig15_modes_path",
    "Path of the centre: regulation in each step, and following the plan",
    "not in the paper, after section 4",
    _data_modes,
    height=3.0,
    modes=True,
    goal=True,
    alt="Distance of the centre from its straight line over the distance along it, one curve a law and mode.",
)
def _draw_modes(data: Data, figure: "style.Figure") -> None:
    """Draw the distance of the centre from its line over the distance along it, one curve per run."""
    axes = figure.subplots()
    paths = [data[f"path_mm_{name}"] for name in data["names"]]
    farthest = [float(path[:, 1].max()) for path in paths]
    lines = [style.curve(i, title(name)) for i, name in enumerate(data["names"].tolist())]
    _paths(axes, paths, lines, wide=min(farthest) > 0.0 and max(farthest) > _WIDE * min(farthest))
    axes.set_title("path of the centre")
    style.legend_below(figure, 2)


def _paths(
    axes: "style.Axes", paths: Sequence[FloatArray], lines: Sequence[style.LineStyle], *, wide: bool
) -> None:
    """Draw distances from the straight line over the distance along it, of paths (k, 2), mm.

    wide : on a logarithmic scale, which has no place for 0.
    """
    for path, line in zip(paths, lines, strict=True):
        axes.plot(path[:, 0], style.positive(path[:, 1]) if wide else path[:, 1], **line)
    axes.set(xlabel="way along the straight line (mm)", ylabel="distance from it (mm)")
    if wide:
        style.log_scale(axes)
        axes.set_ylim(bottom=_LEAST_SHOWN * min(float(path[:, 1].max()) for path in paths))
