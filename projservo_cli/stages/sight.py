"""How the face is watched: point by point, or with the whole body it belongs to."""

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from projservo_cli.records import Calibration, FloatArray, Model
from projservo_cli.stages.truth import Reach, Truth
from projservo_cli.task.body import Body, body_of
from projservo_cli.task.face import Task, task_from_images
from projservo_cli.task.target import task_from_body

if TYPE_CHECKING:
    from projservo_cli.config import Config


@dataclass(frozen=True, eq=False)
class Sight:
    """The body as it is watched: the markers of the face first, then the pins.

    Attributes
    ----------
    body : as calibrated.
    pins : (p, 4) true pins at the robot's reference, m.
    s_start, s_star : (2, m + p, 2) measured pixels at the start and at the goal, NaN where unseen.
    """

    body: Body
    pins: FloatArray
    s_start: FloatArray
    s_star: FloatArray


def by_points(config: "Config", calibration: Calibration) -> bool:
    """Whether the face is measured point by point: as configured, else where no body is calibrated well.

    A body of a calibration that is not usable is worse than no body.
    """
    if config.control.observation is None:
        return not calibration.usable
    return config.control.observation == "points"


def known_pins(calibration: Calibration, truth: Truth) -> list[int]:
    """Indices of the markers beside the face that the calibration knows."""
    known = calibration.marker.tolist()
    return [i for i in truth.pins if truth.number[i] in known]


def sight_of(config: "Config", calibration: Calibration, truth: Truth, reach: Reach) -> Sight | None:
    """The body of the markers that the calibration knows; None where the face is measured point by point.

    Raises
    ------
    WorkFailed
        If the displacements of the body cannot be told from the calibration.
    """
    found = watched_body(config, calibration, truth)
    if found is None:
        return None
    return Sight(
        found.body,
        found.pins,
        np.concatenate([reach.s_start, reach.pins_start[:, found.which]], axis=1),
        np.concatenate([reach.s_star, reach.pins_star[:, found.which]], axis=1),
    )


class Watched(NamedTuple):
    """The body of a calibration: its pins (p, 4) at the robot's reference, m, and which of the true ones."""

    body: Body
    pins: FloatArray
    which: list[int]


def watched_body(config: "Config", calibration: Calibration, truth: Truth) -> Watched | None:
    """The body by which the simulated face is measured, as of ``sight_of``; it is the same for every run."""
    if by_points(config, calibration):
        return None
    known, pins = calibration.marker.tolist(), known_pins(calibration, truth)
    body = _body(calibration, tuple(known.index(truth.number[index]) for index in (*truth.face, *pins)))
    return Watched(body, np.ascontiguousarray(truth.M[pins]), [truth.pins.index(i) for i in pins])


@lru_cache(maxsize=64)
def _body(calibration: Calibration, indices: tuple[int, ...]) -> Body:
    """Body of markers of a calibration, by their indices in it, the same for every run with it."""
    return body_of(calibration.model(), calibration.M[list(indices)])


def measured_task(
    model: Model,
    q_start: FloatArray,
    s_start: FloatArray,
    s_star: FloatArray,
    center: int,
    sight: Sight | None,
) -> Task:
    """The task as the images at start and goal show it, by the body or point by point.

    Parameters
    ----------
    q_start : (n,) joint readings at the start, rad or m.
    s_start, s_star : (2, m, 2) pixels of the face.
    center : index of the centre marker, or ``MIDPOINT``.

    Raises
    ------
    WorkFailed
        If the images do not show where the face or its body is.
    """
    if sight is None:
        return task_from_images(model, s_start, s_star, center)
    m = s_star.shape[1]
    return task_from_body(model, sight.body, q_start, sight.s_start, sight.s_star, center, m)
