"""Fig. 8 of [RH00]: how far the centre drifts from its straight line, for several gains."""

from typing import TYPE_CHECKING, Any

import numpy as np

from projservo_cli.records import FloatArray, Report
from projservo_cli.report import style
from projservo_cli.report.material import DIRECT, TITLES, Data, Material, Studies
from projservo_cli.report.measures import along_line, center_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Share of the largest deviation of the best run below which nothing is drawn.
LEAST_SHARE = 0.05
PATH_POINTS = 400
# Runs with a longer joint step, rad or m, wind the arm up: their path is drawn at the instants only.
WHIRL = np.pi


def table(studies: Studies, *, at_samples: bool = False) -> FloatArray:
    """Largest deviation of the centre, mm, by law, operators (true, calibrated), limit (no, yes), gain.

    NaN where the goal pose is unknown.
    """
    result = np.full((len(DIRECT), 2, 2, len(studies.gains)), np.nan)
    for (law, operators, limited, gain), trace in studies.sweep.items():
        value = trace.center_deviation_at_samples_mm if at_samples else trace.center_deviation_mm
        where = DIRECT.index(law), int(operators == "calibrated"), int(limited), studies.gains.index(gain)
        result[where] = np.nan if value is None else value
    return result


def converged(studies: Studies) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Which runs of the table converged, in its shape."""
    result = np.zeros((len(DIRECT), 2, 2, len(studies.gains)), dtype=np.bool_)
    for (law, operators, limited, gain), trace in studies.sweep.items():
        where = DIRECT.index(law), int(operators == "calibrated"), int(limited), studies.gains.index(gain)
        result[where] = trace.verdict == "converged"
    return result


def data(material: Material) -> Data:
    """Paths of the centre with calibrated operators, and the largest deviations of all runs."""
    studies = material.studies
    assert studies is not None
    result: Data = {
        "gain": np.array(studies.gains),
        "drift_mm": table(studies),
        "step_limit_deg": np.array(studies.step_limit_deg),
    }
    for law in DIRECT:
        cases = [(gain, False) for gain in studies.gains] + [(max(studies.gains), True)]
        for i, (gain, limited) in enumerate(cases):
            trace = studies.sweep[law, "calibrated", limited, gain]
            whirls = np.abs(np.diff(trace.q, axis=0)).max(initial=0.0) > WHIRL
            points = trace.center if whirls else center_path(material, trace)
            way, off = along_line(points, trace.center[0], material.goal_center(trace))
            used = np.unique(np.linspace(0, len(points) - 1, PATH_POINTS).round().astype(int))
            result[f"whirls_{law}_{i}"] = np.array(whirls)
            result[f"path_mm_{law}_{i}"] = 1e3 * np.stack([way, off], axis=1)[used]
    return result


def draw(data: Data, figure: "Figure") -> None:
    """One row a law: left the paths, right the largest deviation over the gain."""
    axes = figure.subplots(2, 2, width_ratios=[1.5, 1])
    gains = data["gain"]
    for row, law in enumerate(DIRECT):
        paths = [data[f"path_mm_{law}_{i}"] for i in range(len(gains) + 1)]
        least = max(LEAST_SHARE * min(float(path[:, 1].max()) for path in paths), 1e-6)
        for i, path in enumerate(paths):
            way, off = path.T
            axes[row, 0].plot(way, np.maximum(off, least), **_path_look(i, len(gains)))
        axes[row, 0].set_title(f"{TITLES[law]}: path of the centre, calibrated operators")
        axes[row, 0].set_xlabel("way along the straight line (mm)")
        axes[row, 0].set_ylabel("distance from it (mm)")
        style.log_scale(axes[row, 0])
        axes[row, 0].set_ylim(bottom=least)
        for operators, color in enumerate((style.BLACK, style.VERMILION)):
            for limited, line in enumerate(("-", (0, (4, 1.5)))):
                marker = "os"[operators] if not limited else "^v"[operators]
                axes[row, 1].plot(
                    gains,
                    data["drift_mm"][row, operators, limited],
                    color=color,
                    linestyle=line,
                    marker=marker,
                    fillstyle="none" if operators else "full",
                    markersize=4.5 if operators else 3.0,
                )
        axes[row, 1].set_xscale("log")
        axes[row, 1].set_xticks(gains, [f"{gain:g}" for gain in gains])
        axes[row, 1].minorticks_off()
        style.log_scale(axes[row, 1])
        axes[row, 1].set_title(f"{TITLES[law]}: largest distance")
        axes[row, 1].set_xlabel("gain per step (1)")
        axes[row, 1].set_ylabel("largest distance (mm)")
    handles = _handles(gains, float(data["step_limit_deg"]))
    if any(data[f"whirls_{law}_{i}"] for law in DIRECT for i in range(len(gains) + 1)):
        handles.append(style.line_handle("chords: steps over 180°", color=style.BLACK, linewidth=0))
    style.legend_below(figure, handles, 4)


def _path_look(i: int, gains: int) -> dict[str, Any]:
    if i == gains:  # the limited run
        return {"color": style.SKY, "linewidth": 2.4}
    return style.curve(i)


def _handles(gains: FloatArray, limit: float) -> list[Any]:
    paths = [style.line_handle(f"gain {gain:g} per step", **style.curve(i)) for i, gain in enumerate(gains)]
    paths.append(
        style.line_handle(f"{gains.max():g} and {limit:g}° per step", **_path_look(len(gains), len(gains)))
    )
    maxima = [
        ("true, no limit", style.BLACK, "-", "o", "full"),
        (f"true, {limit:g}° per step", style.BLACK, (0, (4, 1.5)), "^", "full"),
        ("calibrated, no limit", style.VERMILION, "-", "s", "none"),
        (f"calibrated, {limit:g}° per step", style.VERMILION, (0, (4, 1.5)), "v", "none"),
    ]
    return paths + [
        style.line_handle(label, color=color, linestyle=line, marker=marker, fillstyle=fill)
        for label, color, line, marker, fill in maxima
    ]


def drift_rows(report: Report) -> list[dict[str, Any]]:
    """The drift table as rows: law, operators, limit in deg per step or None, gain, mm, converged."""
    rows = []
    for index in np.ndindex(report.drift_mm.shape):
        law, operators, limited, gain = index
        values = {
            "drift_mm": float(report.drift_mm[index]),
            "drift_at_samples_mm": float(report.drift_at_samples_mm[index]),
        }
        rows.append(
            {
                "law": DIRECT[law],
                "operators": ("true", "calibrated")[operators],
                "limit_deg_per_step": report.step_limit_deg if limited else None,
                "gain_per_step": float(report.gain_per_step[gain]),
                **{name: value if np.isfinite(value) else None for name, value in values.items()},
                "converged": bool(report.drift_converged[index]),
            }
        )
    return rows
