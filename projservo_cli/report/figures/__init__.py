"""Figures after [RH00]: named arrays from a run, and a drawing of them.

A figure is a pair of functions ``data(material) -> arrays`` and ``draw(data, figure)``, which registers it
in a file of this folder with others of its topic. Some are also drawn from a single result.
"""

from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from projservo_cli.records import Calibration, CrossValidation, Observation, Plan, Trace, position_limits
from projservo_cli.report.figure_inputs import REGISTER, Fit, title
from projservo_cli.report.figures import scene
from projservo_cli.task.face import cyclic_order

if TYPE_CHECKING:
    from matplotlib.figure import Figure

for _topic in iter_modules([str(Path(__file__).parent)]):  # figures register themselves
    import_module(f"projservo_cli.report.figures.{_topic.name}")
FIGURES = tuple(REGISTER[name] for name in sorted(REGISTER))


def of_calibration(
    calibration: Calibration, observation: Observation, held_out: CrossValidation | None
) -> "Figure":
    """Draw figure 13: residuals, errors by pose, excitation and information."""
    spec = REGISTER["fig13_calibration"]
    return spec.drawn(spec.data(Fit(calibration, observation.at_rest, held_out=held_out)))


def of_scene(truth: Any, q: Any) -> "Figure":
    """Draw figure 3 at joints (n,) alone: arm, face and cameras."""
    polyline, of_face, of_rig = scene.drawn_arm(truth.robot, truth, q)
    face = (truth.M_face[cyclic_order(truth.M_face)] @ of_face.T)[:, :3]
    pyramids = scene.transformed(scene.plant_pyramids(truth, face), of_rig)
    data = {"robot": polyline, "face_start": face, "pyramids": pyramids, "view": np.array(truth.view)}
    return REGISTER["fig03_scene"].drawn(data)


def of_plan(plan: Plan, scene: Any) -> "Figure":
    """Draw figure 16: the motion in the images, its joints and its margins over time.

    scene : has ``model``, ``limits``, ``image_size`` and ``trajectory``.
    """
    extent = scene.image_size if scene.image_size is not None else np.nanmax(plan.s, axis=(0, 2))
    lowest, highest = plan.q.min(axis=0), plan.q.max(axis=0)
    robot = SimpleNamespace(
        prismatic=scene.model.prismatic,
        limits=position_limits(
            np.where(np.isfinite(scene.limits.lower), scene.limits.lower, lowest),
            np.where(np.isfinite(scene.limits.upper), scene.limits.upper, highest),
        ),
    )
    plant = SimpleNamespace(order=cyclic_order(plan.A), image_size=extent)
    displayed = {"plan": plan, "calibrated": scene.model, "trajectory": scene.trajectory}
    spec = REGISTER["fig16_way"]
    return spec.drawn(spec.data(SimpleNamespace(robot=robot, plant=plant, **displayed)))


def of_trace(trace: Trace, markers: tuple[int, ...]) -> "Figure":
    """Draw figure 11, without the centre of the face: errors of its markers in the images over time."""
    data = {
        "t_s": trace.period * np.arange(len(trace.s)),
        "view": np.array(trace.view),
        "e": trace.s - trace.s_star,
        "law": np.array(title(trace.law)),
        "marker": np.array(markers or range(trace.s.shape[2])),
    }
    return REGISTER["fig11_image_errors"].drawn(data)
