"""The ideal plant: a robot that reaches every set-point, as the compiled loop sees it."""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.findings import Finding
from projservo_cli.geometry.algebra import Mat4, Vec4, apply, as_array, axpy, dot, mat, vec, vec_into
from projservo_cli.geometry.jit import merged, njit
from projservo_cli.geometry.kinematics import forward, from_border, row
from projservo_cli.geometry.lens import distort_pixel
from projservo_cli.records import FloatArray, IntArray, JointLimits, Model
from projservo_cli.task.face import center_of, face_plane

NO_PINS = np.zeros((0, 4))


class Ends(NamedTuple):
    """True poses of the tool."""

    base_tool: FloatArray  # (4, 4) pose of the tool at the reference, m
    goal_pose: FloatArray  # (4, 4) pose at the goal, m; NaN if it is not known
    goal: FloatArray  # (4,) centre of the face there, m


class Plant(NamedTuple):
    """True robot, rig and face in the metric frame."""

    model: Model  # metric model
    M: FloatArray  # (m, 4) points of the face at the reference, m
    order: IntArray  # (m,) markers around the face
    center: int  # index of the centre marker, or ``MIDPOINT``
    O: FloatArray  # (V, 4) optical centres
    visible: FloatArray  # (V,) sign of a·O on the visible side of the face
    image_size: FloatArray  # (V, 2) width and height of each image, px; infinite if it has no border
    limits: JointLimits  # limits of the joints
    opaque: bool  # whether the face hides its markers from a camera behind it
    min_views: int  # number of views that are to see the face
    # (p, 4) further markers of the body at the reference, m; a camera sees those within its image
    pins: FloatArray = NO_PINS


@njit
def observe(plant: Plant, H: Mat4, M: FloatArray, s: FloatArray, hidden: FloatArray) -> bool:
    """True pixels of the face after the displacement H.

    M : (m, 4) on return the points of the face.
    s : (V, m + p, 2) on return the pixels of face and pins, NaN where unseen.
    hidden : (V,) on return 1 if the face is self-occluded in a view.
    Returns false if fewer cameras than are to see it have the whole face before them.
    """
    m = M.shape[0]
    for k in range(m):
        vec_into(M[k], apply(H, vec(plant.M[k])))
    a = face_plane(M, plant.order, center_of(M, plant.center))
    behind = 0
    for view in range(plant.O.shape[0]):
        in_front = True
        visible = plant.visible[view] * dot(a, vec(plant.O[view])) > 0.0
        hidden[view] = 0.0 if visible else 1.0
        camera, lens = plant.model.P[view], plant.model.lens[view]
        for k in range(m):
            A = vec(M[k])
            if not _put_pixel(camera, lens, A, s[view, k]):
                in_front = False
            elif plant.opaque and not visible:
                s[view, k, :] = math.nan
        for k in range(plant.pins.shape[0]):
            pixel = s[view, m + k]
            A = apply(H, vec(plant.pins[k]))
            projected = _put_pixel(camera, lens, A, pixel)
            if projected and from_border(plant.image_size[view], pixel[0], pixel[1]) < 0.0:
                pixel[:] = math.nan
        behind += not in_front
    return bool(behind <= plant.O.shape[0] - plant.min_views)


@merged
def _put_pixel(camera: FloatArray, lens: FloatArray, A: Vec4, pixel: FloatArray) -> bool:
    """Write the pixel (2,) of a point; if it is not in front of the camera, NaN, and return False."""
    depth = row(camera, 2, A)
    if not depth > 0.0:
        pixel[:] = math.nan
        return False
    pixel[0], pixel[1] = distort_pixel(lens, row(camera, 0, A) / depth, row(camera, 1, A) / depth)
    return True


@merged
def shows_face(plant: Plant, H: Mat4, hidden: FloatArray, pixel: FloatArray) -> bool:
    """Whether enough images truly show every marker of the face, from its front, after the displacement H.

    hidden : (V,) 1 if the face is self-occluded; pixel : (2 or more,) workspace.
    """
    n_views = 0
    for view in range(plant.O.shape[0]):
        whole = not hidden[view] > 0.5
        for k in range(plant.M.shape[0]):
            A = apply(H, vec(plant.M[k]))
            if (
                not _put_pixel(plant.model.P[view], plant.model.lens[view], A, pixel)
                or from_border(plant.image_size[view], pixel[0], pixel[1]) < 0.0
            ):
                whole = False
        n_views += whole
    return bool(n_views >= plant.min_views)


@merged
def rig_distance(plant: Plant, M: FloatArray) -> float:
    """Distance of the centre of the face M (m, 4) from the middle of the optical centres, m."""
    middle, V = vec(plant.O[0]), plant.O.shape[0]
    for view in range(1, V):
        middle = axpy(1.0, middle, vec(plant.O[view]))
    distance = axpy(-1.0 / V, middle, center_of(M, plant.center))
    return math.sqrt(dot(distance, distance))


class AnalyticPlant:
    """Simulated robot and rig without a fault, with given pixel noise.

    plant : the truth.
    q_start : (n,) first joints, rad or m.
    noise : (k, V, markers, 2) added to the pixels of each observation in turn, px.
    ``q, H``: (n,) true joints, rad or m, and (4, 4) displacement of the face. ``in_front``: whether every
    marker was in front of enough cameras when last observed. ``markers``: number that is observed, markers of
    the face first. ``hidden``: (V,) 1 if the face was self-occluded when last observed.
    ``disturbance``: why the law that drove it failed; otherwise None. ``takes_parts``: it goes straight to
    the end of each step; the samples are the same. ``weight``: all pixels weigh alike. ``holds, pending``:
    nothing tests its images.
    """

    takes_parts = False
    holds = pending = False
    weight: FloatArray | None = None
    noise_ratio = 1.0

    def __init__(self, plant: Plant, q_start: FloatArray, noise: FloatArray) -> None:
        self.plant = plant
        self.noise = noise
        self.q = np.array(q_start, dtype=np.float64)
        self.H = as_array(forward(plant.model, self.q))
        self.observations = 0
        self.M = np.zeros_like(plant.M)
        self.hidden = np.zeros(len(plant.O))
        self.in_front = True
        self.markers = len(plant.M) + len(plant.pins)
        self.disturbance: Finding | None = None

    def joints(self) -> FloatArray:
        """Joint readings (n,), rad or m."""
        return self.q.copy()

    def observe(self) -> FloatArray:
        """Noisy pixels (V, markers, 2), NaN where unseen."""
        s = np.zeros((len(self.hidden), self.markers, 2))
        self.in_front = observe(self.plant, mat(self.H), self.M, s, self.hidden)
        s += self.noise[self.observations]
        self.observations += 1
        return s

    def distance(self) -> float:
        """Distance of the face from the middle of the optical centres when last observed, m."""
        return rig_distance(self.plant, self.M)

    def command(self, step: FloatArray, period: float) -> None:
        """Move by the joint step (n,), rad or m; the simulated robot always arrives."""
        del period
        self.q = self.q + step
        self.H = as_array(forward(self.plant.model, self.q))

    def give_up(self) -> None:
        """Nothing is held."""

    def stop(self) -> None:
        """Nothing moves between commands."""
