"""Figures after those of [RH00]: named arrays from a run, and a drawing of them.

Every figure is a pair of functions ``data(material) -> arrays`` and ``draw(data, figure)``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from projservo_cli.report.figures import (
    calibration,
    drift,
    errors,
    images,
    joints,
    modes,
    overview,
    partition,
    path,
    planned,
    scene,
    visibility,
)
from projservo_cli.report.material import CLASSICAL, DIRECT, Data

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
    modes : whether it compares runs that follow the plan with others.
    noisy : whether it shows runs with noise that has been drawn many times.
    goal : whether it needs a known goal pose.
    task : whether it needs a task; without, a calibration and what it was made from will do.
    alt : what can be seen, for those who do not see it; by default the title.
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
    modes: bool = False
    noisy: bool = False
    goal: bool = False
    task: bool = True
    alt: str = ""


FIGURES = (
    FigureSpec(
        "fig00_overview",
        "One run at a look: the classical and the direct law in both images, and their errors",
        "beside the paper's",
        5.0,
        overview.data,
        overview.draw,
        laws=overview.LAWS,
        alt=(
            "Left: paths of the markers in both camera images, from the face at the start to the goal, "
            "for directTHREE and the stacked law, with the stretches in which the face is hidden. "
            "Right: control errors of directTHREE and image errors of both laws over time."
        ),
    ),
    FigureSpec(
        "fig01_partition",
        "The task as a translation, a rotation onto the target plane and one within it",
        "Fig. 1, section 4.1",
        3.0,
        partition.data,
        partition.draw,
        alt=(
            "Three panels in the left image: the face moved along a straight line, turned onto the "
            "target plane, and turned within it."
        ),
    ),
    FigureSpec(
        "fig02_visibility",
        "Where the face changes visibility, and both senses of the rotation onto the plane",
        "Fig. 2, section 4.2",
        7.4,
        visibility.data,
        visibility.draw,
        alt=(
            "For each camera: the face turned onto the target plane in both senses, and its visibility "
            "margin over the angle and over the translation, with the values at which it is zero."
        ),
    ),
    FigureSpec(
        "fig03_scene",
        "Robot, stereo rig, and the face at the start and at the goal",
        "Fig. 3, section 6",
        4.4,
        scene.data,
        scene.draw,
        alt=(
            "The robot's arm at the start in three dimensions, both cameras, the face at the start and "
            "at the goal, and the straight line of its centre between them."
        ),
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
        alt=(
            "A row for each classical law, a panel for each camera: the paths of the markers from start "
            "to goal, with the stretches in which the face is hidden and in which the image error "
            "stands still."
        ),
    ),
    FigureSpec(
        "fig05_planned",
        "The planned motion from between the cameras",
        "Fig. 5, section 6",
        3.6,
        planned.data_linear,
        planned.draw,
        alt=(
            "The face at several moments of the planned motion, seen from between the cameras; beside "
            "it the shares of translation and rotations that are done and the visibility margin of both "
            "cameras."
        ),
    ),
    FigureSpec(
        "fig06_planned_steep",
        "The planned motion with a steep translation",
        "Fig. 6, section 6",
        3.6,
        planned.data_steep,
        planned.draw,
        alt=(
            "As the figure before, with a translation that is driven first: the face at several "
            "moments, the shares of the motions and the visibility margins."
        ),
    ),
    FigureSpec(
        "fig07_three_two",
        "directTHREE over directTWO in the images",
        "Fig. 7, section 6",
        3.4,
        images.data_direct,
        images.draw_direct,
        laws=DIRECT,
        alt="Paths of the markers in both camera images under directTHREE and directTWO.",
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
        alt=(
            "For directTHREE and directTWO: distance of the centre from its straight line along the way "
            "for several gains, and the largest distance over the gain, with true and calibrated "
            "operators, with and without a limit."
        ),
    ),
    FigureSpec(
        "fig09_errors_two",
        "Control errors of directTWO, without and with the limit",
        "Fig. 9, section 6",
        4.2,
        errors.data_two,
        errors.draw_two,
        studies=True,
        alt=(
            "Translation and rotation error of directTWO over time, on a linear and on a logarithmic "
            "scale, without a limit and with one."
        ),
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
        alt=(
            "Translation and rotation errors of directTHREE over time with the projective and the "
            "Euclidean model, and the differences between both."
        ),
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
        alt="For each camera: the errors of u and v of every marker and of the centre over time.",
    ),
    FigureSpec(
        "fig12_joints",
        "Joint trajectories without and with the limit",
        "Fig. 12, section 6",
        4.8,
        joints.data,
        joints.draw,
        studies=True,
        alt="The joints and their steps over time under directTHREE, without a limit and with one.",
    ),
    FigureSpec(
        "fig13_calibration",
        "What the calibration leaves of the images, and what the data determine",
        "beside the paper's",
        7.8,
        calibration.data,
        calibration.draw,
        task=False,
        alt=(
            "Residuals as arrows in both images; their histogram beside the noise model; rms residual "
            "of each pose over its predicted error; range of each joint; eigenvalues of the information "
            "matrix."
        ),
    ),
    FigureSpec(
        "fig14_path",
        "Where each camera sees the face, and the planned path among it",
        "beside the paper's, after section 4.3",
        6.0,
        path.data,
        path.draw,
    ),
    FigureSpec(
        "fig15_modes_path",
        "Path of the centre: planning anew in each step, and following the plan",
        "beside the paper's, after section 4",
        3.0,
        modes.data_path,
        modes.draw_path,
        modes=True,
        goal=True,
        alt="Distance of the centre from its straight line over the way along it, one curve a law and mode.",
    ),
    FigureSpec(
        "fig16_modes_images",
        "Image error: planning anew in each step, and following the plan",
        "beside the paper's, after section 4",
        3.2,
        modes.data_images,
        modes.draw_images,
        modes=True,
        alt=(
            "Image error over time on a linear and on a logarithmic scale, one curve a law and mode, with "
            "the time at which the plan arrives."
        ),
    ),
    FigureSpec(
        "fig17_modes_noise",
        "Noise in the loop: planning anew in each step, and following the plan",
        "beside the paper's, after section 4",
        3.2,
        modes.data_noise,
        modes.draw_noise,
        modes=True,
        noisy=True,
        alt=(
            "Standard deviation over the image noise of the centre and of the commands over time, one curve "
            "a law and mode."
        ),
    ),
)
