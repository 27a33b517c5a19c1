"""A closed loop in miniature: the sample arm, its rig and a face between two sets of joints."""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.control import make_law
from projservo_cli.control.law import ERRORS, Gains, new_state
from projservo_cli.geometry.lens import distort
from projservo_cli.geometry.stereo import optical_centers
from projservo_cli.laws import CODES, INCIDENCES
from projservo_cli.loop.compiled_loop import Course, run_compiled
from projservo_cli.loop.verdicts import VERDICT_NAMES, Limits, new_log
from projservo_cli.records import FloatArray, Model, position_limits
from projservo_cli.simulation.analytic_plant import Plant
from projservo_cli.task.body_pose import make_body
from projservo_cli.task.face import MIDPOINT, Task, center_of, cyclic_order, face_plane
from projservo_cli.task.target import TargetGoal, TaskImages
from tests.samples import METRIC_A_INF, arm, face, in_frame, pixels, poe

# Laws that measure a face point by point; that of incidences takes a body.
FACE_LAWS = tuple(law for law in CODES if law != INCIDENCES)

GAINS = Gains(2.5, 2.5, 2.5, 2.5, 1.0, 2.5, 0.04, 0.9)
# Joint steps from start to goal: the face moves by 0.5 m and turns by 68° in view of both cameras.
STEP = np.array([0.19, 0.35, 0.38, -0.35, -0.08, 0.3])


class Scene(NamedTuple):
    """True robot, rig and face, and the images of start and goal."""

    plant: Plant
    q_start: FloatArray
    q_goal: FloatArray
    s_start: FloatArray
    s_star: FloatArray

    @property
    def model(self) -> Model:
        return self.plant.model

    def task(self, G=None) -> Task:
        """Task in the frame of the model ``self.seen(G)``."""
        return TaskImages(self.q_start, self.s_start, TargetGoal.at(self.s_star), self.plant.center).task(
            self.seen(G)
        )

    def seen(self, G=None) -> Model:
        """Model in another frame."""
        return self.model if G is None else in_frame(self.model, G)

    def body_task(self, G=None) -> Task:
        """The same task measured with face and pins; images of the pins are the true ones."""
        model = self.seen(G)
        M = np.concatenate([self.plant.M, self.plant.pins])
        body = make_body(model, M if G is None else M @ G.T)
        lens = self.model.lens[:, None]
        s = [
            distort(lens, pixels(self.model.P, M @ poe(self.model, q).T)) for q in (self.q_start, self.q_goal)
        ]
        return TaskImages(
            self.q_start, s[0], TargetGoal.at(s[1]), self.plant.center, len(self.plant.pins), body
        ).task(model)

    def images(self, q) -> FloatArray:
        """True pixels of the face at the joints q."""
        return pixels(self.model.P, self.plant.M @ poe(self.model, q).T)


def plant_of(model, M, center=MIDPOINT, opaque=False) -> Plant:
    """Plant of a face at its reference, which both cameras see there."""
    order = cyclic_order(M)
    O = optical_centers(model.P, METRIC_A_INF)
    a = np.array(face_plane(np.ascontiguousarray(M), order, center_of(M, center)))
    n = len(model.q_reference)
    return Plant(
        model, M, order, center, O, np.sign(O @ a), np.full((2, 2), [1280.0, 1024.0]),
        position_limits(np.full(n, -9.0), np.full(n, 9.0)), opaque, 2,
    )  # fmt: skip


def scene(step=STEP, types="RRRRRR", m=4, center=MIDPOINT, opaque=False) -> Scene:
    """Scene that starts at the reference of the arm and ends a joint step away."""
    model = arm(types)
    plant = plant_of(model, np.ascontiguousarray(face(m)), center, opaque)
    q_start, q_goal = model.q_reference.copy(), model.q_reference + step
    s = [pixels(model.P, plant.M @ poe(model, q).T) for q in (q_start, q_goal)]
    return Scene(plant, q_start, q_goal, s[0], s[1])


def with_pins(scene) -> Scene:
    """Scene whose face is part of a body: five pins behind and around it."""
    offsets = [[0.1, 0.02, 0.06], [-0.09, 0.05, 0.08], [-0.02, -0.11, 0.05], [0.05, 0.09, 0.1], [0, 0, 0.12]]
    middle = scene.plant.M.mean(axis=0)
    pins = np.ascontiguousarray(middle + np.c_[np.array(offsets), np.zeros(5)])
    return scene._replace(plant=scene.plant._replace(pins=pins))


def limits(n=6, **given) -> Limits:
    """Limits that end a run only at its goal, or as given."""
    values = {
        "speed": np.full(n, math.inf),
        "image_error_px": 1e-3,
        "diverged_factor": 10.0,
        "stall_periods": 20,
        "max_steps": 400,
        "stop_at_joint_limit": False,
        "stop_at_border": False,
    }
    return Limits(**{**values, **given})


class Run:
    """One compiled closed loop, and what it logged up to its last instant."""

    def __init__(self, scene, law, gains=GAINS, bounds=None, noise=None, G=None, memory=None, task=None):
        bounds = limits(len(scene.q_start)) if bounds is None else bounds
        n, m = len(scene.q_start), len(scene.plant.M)
        seen = m + len(scene.plant.pins)
        noise = np.zeros((bounds.max_steps + 1, 2, seen, 2)) if noise is None else noise
        self.state, self.full = new_state(n, m, seen), new_log(n, seen, bounds.max_steps, len(ERRORS))
        if memory is not None:
            self.state.driven[:] = memory
        task = scene.task(G) if task is None else task
        gains = gains._replace(limits=gains.limits._replace(speed=bounds.speed))
        course = Course(scene.plant, bounds, scene.q_start.copy())
        built_in = make_law(CODES[law], scene.seen(G), task, gains)
        self.code, self.steps = run_compiled(built_in, course, noise, self.state, self.full)
        self.verdict = VERDICT_NAMES[self.code] if self.code >= 0 else None
        self.log = type(self.full)(*(rows[: self.steps + 1] for rows in self.full[:-4]), *self.full[-4:])
        self.center = (self.log.H @ np.array(center_of(scene.plant.M, scene.plant.center)))[:, :3]
