"""Where cameras stand in the base of a UR5 whose model is wrong: ``python -m tests.studies.metric_rendered``.

The model is off by 2° in the zeros of joints 3 and 5, and by 3 mm in the third link. projservo calibrates
from the images of rendered.yaml alone, and finds those zeros by ``kinematic_errors``. OpenCV's
robot-world–hand–eye calibration is given the same images, true intrinsics, the true tags and the wrong model.
Both cameras then triangulate the markers at the poses of the recording; errors are those in the true base
frame, rms. The distance of two markers sets the scale. ``ur5`` as an argument takes simulated points of
0.5 px instead.
"""

import sys

import numpy as np
from scipy.linalg import expm

import projservo_cli as projservo
from projservo_cli.geometry.displacements import screw_displacements, screws
from projservo_cli.geometry.kinematics import forward_kinematics
from projservo_cli.geometry.stereo import triangulate_points
from projservo_cli.metric.frame import base_frame, base_joints
from projservo_cli.metric.kinematic_errors import kinematic_errors
from tests.configured import truth_of
from tests.known import configured
from tests.studies import hand_eye

ZEROS = np.radians([0.0, 0.0, -2.0, 0.0, -2.0, 0.0])
LINK_M = 0.003
SEEDS = (1, 2, 3)


def at_zero(truth):
    """Screws (n, 6) of the true arm at readings of zero."""
    robot = truth.robot
    back = screw_displacements(screws(robot.H_hat_0), robot.prismatic, -robot.q_reference)
    T, found = np.eye(4), []
    for H, E in zip(robot.H_hat_0, back, strict=True):
        found.append(screws(T @ H @ np.linalg.inv(T)))
        T = T @ E
    return np.array(found)


def wrong(true):
    """Screws (n, 6) of the model at its readings of zero."""
    T, found = np.eye(4), []
    for i, screw in enumerate(true):
        H = np.zeros((4, 4))
        H[:3, :3], H[:3, 3] = np.cross(np.eye(3), screw[:3]), screw[3:]
        if i == 3:  # the link before joint 4 is too long, away from joint 3
            w, away = found[2][:3], np.cross(screw[:3], screw[3:]) - np.cross(true[2][:3], true[2][3:])
            away -= w * (w @ away)
            T[:3, 3] += T[:3, :3] @ (LINK_M * away / np.linalg.norm(away))
        found.append(screws(T @ H @ np.linalg.inv(T)))
        T = T @ expm(-H * ZEROS[i])
    return np.array(found)


def study(name, seed):
    """Errors of the zeros, degrees, and of positions by projservo and by OpenCV, mm rms."""
    config = configured(name)
    truth = truth_of(config)
    seen = projservo.simulate(config, seed=seed)
    c = projservo.calibrate(seen)
    observation, model = seen.record, wrong(at_zero(truth))
    order = [truth.number.index(number) for number in c.marker.tolist()]
    M = truth.M[order]
    a, b = 0, int(np.argmax(np.linalg.norm(M[:, :3] - M[0, :3], axis=1)))
    ends = (int(c.marker[a]), int(c.marker[b]))
    m = c.metric(float(np.linalg.norm(M[a, :3] - M[b, :3])), ends)
    found = [e.zero for e in kinematic_errors(m, model).joints]
    zeros = np.degrees([found[i] - ZEROS[i] for i in (2, 4)])
    columns = [observation.marker.tolist().index(number) for number in c.marker.tolist()]
    images = observation.images[:, :, columns]
    both = np.isfinite(images).all(axis=(1, 3))
    where = np.array([M @ forward_kinematics(truth.model, q).T for q in observation.q])[..., :3][both]
    s = np.moveaxis(images, 1, 0)[:, both]
    true_zero = at_zero(truth)
    base = base_frame(
        true_zero, ~np.ones(len(true_zero), bool), base_joints(true_zero, ~np.ones(len(true_zero), bool))
    )
    ours = m.triangulate(s) @ base[:3, :3].T + base[:3, 3]
    hands = np.array(
        [np.linalg.multi_dot(screw_displacements(model, np.zeros(6, bool), q)) for q in observation.q]
    )
    points = M[:, :3] - M[:, :3].mean(axis=0)
    views = [hand_eye.calibrated(P, points, hands, images[:, v]) for v, P in enumerate(truth.P)]
    P = np.array([view.K @ view.base[:3] for view in views])
    theirs = triangulate_points(P, np.array([0.0, 0.0, 0.0, 1.0]), s)[:, :3]
    rms = [1e3 * np.sqrt(((x - where) ** 2).sum(axis=1).mean()) for x in (ours, theirs)]
    centers = np.array([np.linalg.solve(P[:, :3], -P[:, 3]) for P in truth.P])
    ours_c = m.poses[:, :3, 3] @ base[:3, :3].T + base[:3, 3]
    theirs_c = np.array([np.linalg.inv(view.base)[:3, 3] for view in views])
    cameras = [1e3 * np.linalg.norm(x - centers, axis=1).mean() for x in (ours_c, theirs_c)]
    return zeros, rms, cameras


def main():
    for seed in SEEDS:
        zeros, rms, cameras = study((sys.argv[1:] or ["rendered"])[0], seed)
        print(
            f"seed {seed}: zeros of joints 3 and 5 off by {zeros[0]:+.3f}° and {zeros[1]:+.3f}°", flush=True
        )
        print(f"  markers in the base frame {rms[0]:.2f} mm, by OpenCV {rms[1]:.2f} mm, rms")
        print(f"  optical centres {cameras[0]:.2f} mm, by OpenCV {cameras[1]:.2f} mm, mean", flush=True)


if __name__ == "__main__":
    main()
