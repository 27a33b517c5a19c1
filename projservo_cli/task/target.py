"""The task as all markers of the body show it: teaching by showing."""

import numpy as np

from projservo_cli.geometry.displacement import as_array, as_mat
from projservo_cli.geometry.kinematics import forward, operators_at
from projservo_cli.geometry.lens import straight_views
from projservo_cli.geometry.mechanisms import workspace
from projservo_cli.geometry.span import span_of
from projservo_cli.records import FloatArray, Model, WorkFailed
from projservo_cli.task.body import Body, Fit, fit_body, new_normal
from projservo_cli.task.face import Task, task_from_images
from projservo_cli.task.partition import Memory, partition
from projservo_cli.task.trajectory import trajectory_displacement

# A fit ends where a step moves the images by less than this, px rms a coordinate.
SETTLED_PX = 1e-6
MOST_STEPS = 30


def task_from_body(
    model: Model,
    body: Body,
    q_start: FloatArray,
    s_start: FloatArray,
    s_star: FloatArray,
    center: int,
    m: int,
) -> Task:
    """What the laws know of a task, from images of the whole body.

    The goal is found from the start by the partition of the task, which the triangulated face
    determines, and fitted to all markers seen there.

    Parameters
    ----------
    model, body : calibrated.
    q_start : (n,) joints at the start, rad or m.
    s_start, s_star : (2, b, 2) pixels of the body at the start and at the goal, the m of the face first,
        which both cameras must see; of the others NaN where unseen.
    center : index of the centre marker, or ``MIDPOINT``.
    m : markers of the face.

    Raises
    ------
    WorkFailed
        If the face cannot be triangulated, a motion is not unique or the markers do not agree on a
        place of the body.
    """
    images = (np.ascontiguousarray(s_start[:, :m]), np.ascontiguousarray(s_star[:, :m]))
    task = task_from_images(model, *images, center)
    H_start = settled(model, body, s_start, as_array(forward(model, q_start)), "start")
    work = workspace(len(q_start), 4 * m, span_of(model, task.A_star))
    operators_at(model, q_start, work.H_hat)
    A = np.ascontiguousarray(body.M[:m] @ H_start.T)
    A_t, A_r, q_hat = np.zeros((m, 4)), np.zeros((m, 4)), np.zeros((4, len(work.basis)))
    parts = partition(work, task, A, A_t, A_r, q_hat, Memory(np.zeros((2, q_hat.shape[1]))))
    if not parts.found:
        raise WorkFailed(
            "the joint motion of the task is not unique at the start: the robot is near a singularity "
            "or moves the face in fewer than six ways"
        )
    H_hat = np.array([as_array(H) for H in (parts.H_t, parts.H_r, parts.H_p)])
    amplitudes = (parts.tau, parts.theta_r, parts.theta_p)
    H_guess = trajectory_displacement(H_hat, amplitudes, np.ones(3)) @ H_start
    H_star = settled(model, body, s_star, H_guess, "goal")
    shown = np.isfinite(s_star[..., 0]) & np.isfinite(s_star[..., 1])
    return task._replace(A_star=np.ascontiguousarray(body.M[:m] @ H_star.T), body=body._replace(shown=shown))


def settled(model: Model, body: Body, s: FloatArray, H: FloatArray, where: str) -> FloatArray:
    """Displacement (4, 4) of least reprojection error, from a predicted one.

    Parameters
    ----------
    s : (2, b, 2) pixels, NaN where unseen.
    H : (4, 4) prediction.
    where : the place, for the message.

    Raises
    ------
    WorkFailed
        If too few markers were seen, or the steps do not settle.
    """
    s = straight_views(model.lens, s)
    fit, normal = Fit(False, as_mat(H), 0.0, 0.0, 0), new_normal()
    for _ in range(MOST_STEPS):
        fit = fit_body(model.P, body, s, fit.H, False, SETTLED_PX, 1, normal)
        if not fit.found:
            raise WorkFailed(
                f"the images at the {where} show too few markers, {fit.views} in both views together, to "
                "tell where the body is: show three or more, not on one line"
            )
        if fit.before - fit.after <= SETTLED_PX * SETTLED_PX * (2 * fit.views):
            return as_array(fit.H)
    raise WorkFailed(
        f"the images at the {where} fit no place of the calibrated body: check the numbers of the markers, "
        "or measure point by point with control.observation: points"
    )
