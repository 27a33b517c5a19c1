"""Fig. 12 of [RH00]: joint trajectories without and with the joint-speed limit."""

from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.records import PRISMATIC
from projservo_cli.report import style
from projservo_cli.report.material import Data, Material, registered

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _data(material: Material) -> Data:
    """Joints and their steps under directTHREE with calibrated operators, in deg and in mm."""
    studies = material.studies
    assert studies is not None
    prismatic = material.robot.joint_types == PRISMATIC
    scale = np.where(prismatic, 1e3, np.degrees(1.0))
    result: Data = {"prismatic": prismatic, "step_limit_deg": np.array(studies.step_limit_deg)}
    for name, limited in (("free", False), ("limited", True)):
        trace = studies.own["direct_three", "calibrated", limited]
        result |= {
            f"t_s_{name}": trace.period * np.arange(len(trace.q)),
            f"q_{name}": trace.q * scale,
            f"step_{name}": trace.q_dot * trace.period * scale,
        }
    return result


@registered(
    "fig12_joints",
    "Joint trajectories without and with the limit",
    "Fig. 12, section 6",
    4.8,
    _data,
    studies=True,
    alt="The joints and their steps over time under directTHREE, without a limit and with one.",
)
def _draw(data: Data, figure: "Figure") -> None:
    """Left without, right with the limit; joints above, their steps below, per kind of joint."""
    prismatic = data["prismatic"]
    both = ((np.flatnonzero(~prismatic), "deg"), (np.flatnonzero(prismatic), "mm"))
    kinds = [(chosen.tolist(), unit) for chosen, unit in both if len(chosen)]
    figure.set_figheight(figure.get_figheight() * (0.25 + 0.75 * len(kinds)))
    axes = figure.subplots(2 * len(kinds), 2, sharex=True, squeeze=False)
    limit = float(data["step_limit_deg"])
    for column, (name, title) in enumerate((("free", "no limit"), ("limited", f"{limit:g}° per step"))):
        t = data[f"t_s_{name}"]
        for pair, (chosen, unit) in enumerate(kinds):
            joints, steps = axes[2 * pair, column], axes[2 * pair + 1, column]
            for i in chosen:
                joints.plot(t, data[f"q_{name}"][:, i], **style.curve(i))
                steps.plot(t[:-1], data[f"step_{name}"][:, i], **style.curve(i))
            if name == "limited" and unit == "deg":
                for bound in (-limit, limit):
                    steps.axhline(bound, color=style.GREY, linewidth=0.8)
            if column == 0:
                joints.set_ylabel(f"joint ({unit})")
                steps.set_ylabel(f"step ({unit} per period)")
        axes[0, column].set_title(f"directTHREE, {title}")
        axes[-1, column].set_xlabel("time (s)")
    for row in axes[::2]:  # both sides are to be compared
        limits = [panel.get_ylim() for panel in row]
        for panel in row:
            panel.set_ylim(np.min(limits), np.max(limits))
    looks = {f"$q_{i + 1}$": style.curve(i) for i in range(len(prismatic))}
    looks["limit"] = {"color": style.GREY, "linewidth": 0.8}
    style.legend_below(figure, looks, min(len(looks), 7))
