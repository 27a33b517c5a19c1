"""Figure 23: how a goal that moves was followed: errors, speed, and paths in an image."""

import numpy as np

from projservo_cli.report import panels, style
from projservo_cli.report.figure_inputs import Data, Driven, ReportData, registered, title

_LEAST_PX = 1e-3  # lower end of errors that are drawn, px
_STATED = style.line(style.GREY, style.DOTTED, 1.0, label="stated deviation")
_TRUE = style.line(style.GREY, width=2.4, label="true speed")
_GOAL = style.line(style.BLACK, style.DASHED, 1.0, label="goal")


def _followed(report_data: Driven | ReportData) -> list[str]:
    """Names of the runs whose goal moved."""
    return [name for name, trace in report_data.traces.items() if trace.of_goal is not None]


def _moved(report_data: Driven | ReportData) -> bool:
    return bool(_followed(report_data))


def _data(report_data: Driven | ReportData) -> Data:
    """Errors, speeds and paths of the middle of the face over time, for each run."""
    data: Data = {"view": np.array(report_data.view)}
    for name in _followed(report_data):
        trace = report_data.traces[name]
        goal = trace.of_goal
        assert goal is not None
        data |= {
            f"t_s_{name}": goal.goal_time - goal.goal_time[0],
            f"error_px_{name}": goal.goal_error_px,
            f"stated_px_{name}": goal.goal_sigma_px,
            f"speed_{name}": goal.goal_speed,
            f"true_speed_mm_s_{name}": goal.goal_true_speed,
            f"goal_{name}": goal.goal_s.mean(axis=2),
            f"tool_{name}": trace.s.mean(axis=2),
        }
    return data


@registered(
    "fig23_following",
    "The goal that moved, and how it was followed",
    "not in the paper",
    _data,
    height=3.4,
    shows=(_moved, "no goal moved"),
    alt="Left the image error of each law to the goal where it was, over time, with its stated deviation. In "
    "the middle the estimated and the true speed of the object. Right the paths of the goal and of the face "
    "in the image of the first camera.",
)
def _draw(data: Data, figure: "style.Figure") -> None:
    """Errors, speeds and paths, a curve for each run."""
    names = [key.removeprefix("t_s_") for key in data if key.startswith("t_s_")]
    errors, speeds, image = figure.subplots(1, 3)
    lines = [style.curve(i, title(name)) for i, name in enumerate(names)]
    curves = [
        (data[f"t_s_{name}"], data[f"error_px_{name}"], line) for name, line in zip(names, lines, strict=True)
    ]
    first = names[0]
    curves.append((data[f"t_s_{first}"], data[f"stated_px_{first}"], _STATED))
    panels.errors(errors, curves, _LEAST_PX, xlabel="time (s)", ylabel="image error (px)")
    known = np.isfinite(data[f"true_speed_mm_s_{first}"]).any()
    if known:
        speeds.plot(data[f"t_s_{first}"], data[f"true_speed_mm_s_{first}"], **_TRUE)
    for name, line in zip(names, lines, strict=True):
        speeds.plot(data[f"t_s_{name}"], data[f"speed_{name}"], **line)
        image.plot(*data[f"tool_{name}"][:, 0].T, **line)
    speeds.set(xlabel="time (s)", ylabel="speed (mm/s)" if known else "speed (mm/s or px/s)")
    speeds.set_ylim(bottom=0.0)
    image.plot(*data[f"goal_{first}"][:, 0].T, **_GOAL)
    style.image_axes(image)
    image.set_title(f"{data['view'][0]} camera")
    style.legend_below(figure, 4)
