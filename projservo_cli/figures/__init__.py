"""Figures after those of [RH00]: named arrays from a run, and a drawing of them.

Every figure is a pair of functions ``data(material) -> arrays`` and ``draw(data, figure)``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from projservo_cli.figures import (
    calibration,
    drift,
    errors,
    images,
    joints,
    overview,
    partition,
    planned,
    scene,
    visibility,
)
from projservo_cli.figures.material import CLASSICAL, DIRECT, Data

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class FigureSpec:
    """One figure.

    Attributes
    ----------
    name : of its files.
    title : what it shows, in a phrase.
    paper : the figure of the paper it follows, and its section.
    height : inches.
    data, draw : what makes it, from a ``Material``; from a ``Fit`` where it needs no task.
    laws : whose traces it shows: all of them, or any of them where ``any_law`` is set.
    studies : whether it shows the extra runs.
    goal : whether it needs a known goal pose.
    task : whether it needs a task; without, a calibration and what it was made from will do.
    """

    name: str
    title: str
    paper: str
    height: float
    data: Callable[[Any], Data]
    draw: Callable[[Data, "Figure"], None]
    laws: tuple[str, ...] = ()
    any_law: bool = False
    studies: bool = False
    goal: bool = False
    task: bool = True


FIGURES = (
    FigureSpec(
        "fig00_overview",
        "One run at a look: the classical and the direct law in both images, and their errors",
        "beside the paper's",
        5.0,
        overview.data,
        overview.draw,
        laws=overview.LAWS,
    ),
    FigureSpec(
        "fig01_partition",
        "The task as a translation, a rotation onto the target plane and one within it",
        "Fig. 1, section 4.1",
        3.0,
        partition.data,
        partition.draw,
    ),
    FigureSpec(
        "fig02_visibility",
        "Where the face changes visibility, and both senses of the rotation onto the plane",
        "Fig. 2, section 4.2",
        7.4,
        visibility.data,
        visibility.draw,
    ),
    FigureSpec(
        "fig03_scene",
        "Robot, stereo rig, and the face at the start and at the goal",
        "Fig. 3, section 6",
        4.4,
        scene.data,
        scene.draw,
    ),
    FigureSpec(
        "fig04_classical",
        "Image trajectories of the classical laws",
        "Fig. 4, section 6",
        8.0,
        images.data_classical,
        images.draw_classical,
        laws=CLASSICAL,
        any_law=True,
    ),
    FigureSpec(
        "fig05_planned",
        "The planned motion from between the cameras",
        "Fig. 5, section 6",
        3.6,
        planned.data_linear,
        planned.draw,
    ),
    FigureSpec(
        "fig06_planned_steep",
        "The planned motion with a steep translation",
        "Fig. 6, section 6",
        3.6,
        planned.data_steep,
        planned.draw,
    ),
    FigureSpec(
        "fig07_three_two",
        "directTHREE over directTWO in the images",
        "Fig. 7, section 6",
        3.4,
        images.data_direct,
        images.draw_direct,
        laws=DIRECT,
    ),
    FigureSpec(
        "fig08_drift",
        "Drift of the centre from its straight line",
        "Fig. 8, section 6",
        5.2,
        drift.data,
        drift.draw,
        studies=True,
        goal=True,
    ),
    FigureSpec(
        "fig09_errors_two",
        "Control errors of directTWO, without and with the limit",
        "Fig. 9, section 6",
        4.2,
        errors.data_two,
        errors.draw_two,
        studies=True,
    ),
    FigureSpec(
        "fig10_errors_three",
        "Control errors of directTHREE, projective beside Euclidean model",
        "Fig. 10, section 6",
        4.8,
        errors.data_three,
        errors.draw_three,
        studies=True,
        goal=True,
    ),
    FigureSpec(
        "fig11_image_errors",
        "Image errors of the markers and of the centre",
        "Fig. 11, section 6",
        3.2,
        images.data_errors,
        images.draw_errors,
        laws=DIRECT[:1],
        goal=True,
    ),
    FigureSpec(
        "fig12_joints",
        "Joint trajectories without and with the limit",
        "Fig. 12, section 6",
        4.8,
        joints.data,
        joints.draw,
        studies=True,
    ),
    FigureSpec(
        "fig13_calibration",
        "What the calibration leaves of the images, and what the data determine",
        "beside the paper's",
        7.8,
        calibration.data,
        calibration.draw,
        task=False,
    ),
)
