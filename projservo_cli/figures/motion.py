"""Robot, rig, face and paths of a run in metres, over time: what the 3D view shows."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from projservo_cli.figures.scene import PYRAMID, pyramid, skeleton
from projservo_cli.geometry.kinematics import forward_kinematics, joint_operators
from projservo_cli.plants.plant import Plant
from projservo_cli.plants.robot import Robot, camera_center
from projservo_cli.records import BoolArray, FloatArray, IntArray, Plan, Trace
from projservo_cli.task.face import center_of

MOST_INSTANTS = 60


class Driven(NamedTuple):
    """One run of a law at the instants that are shown.

    Attributes
    ----------
    verdict : how it ended.
    seconds : (k,) time of the instants.
    robot : (k, j, 3) the robot as a polyline from its base to the tool, m.
    face : (k, m, 3) corners of the face in cyclic order, m.
    markers : (k, p, 3) all markers of the body, m.
    hidden : (k, 2) whether the face is hidden from each camera.
    path : (t, 3) centre of the face at every instant of the run, m.
    """

    verdict: str
    seconds: FloatArray
    robot: FloatArray
    face: FloatArray
    markers: FloatArray
    hidden: BoolArray
    path: FloatArray


@dataclass(frozen=True, eq=False)
class Motion:
    """What stands still in the view, and the runs.

    Attributes
    ----------
    cameras : (2, 5, 3) optical centre and image corners of both viewing pyramids, m.
    start, goal : (m, 3) corners of the face, m; the goal is None where only its images are known.
    planned : (s, 3) centre of the face along the joints of the plan, m; none where joints cannot follow it.
    runs : the runs by name.
    """

    cameras: FloatArray
    start: FloatArray
    goal: FloatArray | None
    planned: FloatArray
    runs: Mapping[str, Driven]


def motion(
    robot: Robot, plant: Plant, markers: FloatArray, plan: Plan, traces: Mapping[str, Trace]
) -> Motion:
    """Place everything in the frame of the robot's base.

    Parameters
    ----------
    robot, plant : the true robot, rig and face.
    markers : (p, 4) all markers at the robot's reference, m.
    plan : the plan.
    traces : the runs, each with a step at least; their joints move the robot.
    """
    face = plant.M[plant.order]
    start = (face @ forward_kinematics(plant.model, plan.q_start).T)[:, :3]
    distance = np.linalg.norm(start.mean(axis=0) - np.mean([camera_center(P) for P in plant.model.P], axis=0))
    goals = [trace.goal_pose for trace in traces.values() if np.isfinite(trace.goal_pose).all()]
    goal = goals[0] @ np.linalg.inv(robot.base_tool) if goals else None
    return Motion(
        np.stack([pyramid(P, plant.image_size, PYRAMID * float(distance)) for P in plant.model.P]),
        start,
        None if goal is None else (face @ goal.T)[:, :3],
        _centers(plant, plan.q[np.isfinite(plan.q).all(axis=1)]),
        {name: _driven(robot, plant, markers, trace) for name, trace in traces.items()},
    )


def instants(q: FloatArray) -> IntArray:
    """At most ``MOST_INSTANTS`` instants of the joints q (t, n), all of a shorter run.

    First and last are among them. They are spread evenly half over the time and half over the way of the
    joints, so that neither the beginning of a long run nor its end is passed over.
    """
    if len(q) <= MOST_INSTANTS:
        return np.arange(len(q))
    even = np.linspace(0.0, 1.0, len(q))
    way = np.append(0.0, np.cumsum(np.abs(np.diff(q, axis=0)).max(axis=1)))
    done = 0.5 * (even + (way / way[-1] if way[-1] > 0.0 else even))
    marks = np.linspace(0.0, 1.0, MOST_INSTANTS)
    return np.unique(np.minimum(np.searchsorted(done, marks), len(q) - 1))


def _driven(robot: Robot, plant: Plant, markers: FloatArray, trace: Trace) -> Driven:
    shown = instants(trace.q)
    H = [forward_kinematics(plant.model, q) for q in trace.q[shown]]
    polylines = [
        skeleton(joint_operators(plant.model, q), robot.joint_types, (displacement @ robot.base_tool)[:3, 3])
        for q, displacement in zip(trace.q[shown], H, strict=True)
    ]
    face = plant.M[plant.order]
    return Driven(
        f"{trace.verdict}, {trace.steps} steps",
        trace.period * shown.astype(np.float64),
        np.stack(polylines),
        np.stack([(face @ displacement.T)[:, :3] for displacement in H]),
        np.stack([(markers @ displacement.T)[:, :3] for displacement in H]),
        trace.self_occluded[shown],
        _centers(plant, trace.q),
    )


def _centers(plant: Plant, q: FloatArray) -> FloatArray:
    """Centre of the face (k, 3) at joints (k, n), m."""
    found = [center_of(plant.M @ forward_kinematics(plant.model, joints).T, plant.center)[:3] for joints in q]
    return np.reshape(np.array(found, dtype=np.float64), (-1, 3))
