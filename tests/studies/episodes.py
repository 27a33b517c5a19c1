"""Cameras that moved between episodes of teleoperation: how often they are found, and how often falsely.

    python -m tests.studies.episodes [--draws 50] [-o episodes.csv]

Each draw has twenty episodes of the UR5 of the reference data: from about its home to a part and to a bin,
both elsewhere each time, with fifteen poses at rest an episode. One camera, two, or two that also see a tag
on the table, in turn. Corners err by 0.3 px, a fifth of them is hidden, joints err by 0.05° and by 0.1°
twice a turn.

In the first draws one camera is turned and shifted in random directions, so that its images move by 5 to 50
px rms: in half of them for good, from a random episode on, in the others in one episode of the twenty. Found
means: this camera, between these episodes, and nothing else. In as many draws again no camera moves.
"""

import dataclasses

import numpy as np
from scipy.linalg import expm

from projservo_cli.detection.stretches import stretches
from projservo_cli.records import Observation
from tests.calibration.simulated_robot import reference_ur5
from tests.studies.common import in_two_processes, parser_of, rate, written

SEED, EPISODES, POSES = 611, 20, 15
NOISE_PX, HIDDEN, JOINTS_RAD, TWICE_RAD = 0.3, 0.2, np.radians(0.05), np.radians(0.1)
SIZES_PX = (5.0, 50.0)
REACH_RAD = np.radians(25.0)  # of home to the middle of parts and to that of bins, in each joint
ELSEWHERE_RAD = np.radians(12.0)  # by which parts and bins are elsewhere, in each joint
KINDS = ("one camera", "two cameras", "two cameras, a tag on the table")
COLUMNS = ("draw", "moved", "kind", "expected", "found", "px", "said_px", "untested", "right")


def teleoperated(robot, rng):
    """Joints (K, n) at rest of all episodes, and the episode (K,) of each."""
    n, home = len(robot.joint_types), robot.q_reference
    part, bin_ = home + REACH_RAD * rng.uniform(-1, 1, (2, n))
    rows = []
    for _ in range(EPISODES):
        ends = [home + 0.02 * rng.standard_normal(n)]
        ends += [end + ELSEWHERE_RAD * rng.uniform(-1, 1, n) for end in (part, bin_)]
        way = np.sort(rng.uniform(0, 2, POSES))
        between = np.stack([np.interp(way, [0, 1, 2], column) for column in np.transpose(ends)], axis=-1)
        rows.append(between + np.radians(2.0) * rng.standard_normal(between.shape))
    return np.concatenate(rows), np.repeat(np.arange(EPISODES), POSES)


def turned(camera, turn, shift):
    """A camera (3, 4) turned about its centre, and shifted, m."""
    kernel = np.linalg.svd(camera)[2][3]
    R = camera[:, :3] @ expm(np.cross(np.eye(3), turn))
    return np.c_[R, -R @ (kernel[:3] / kernel[3] + shift)]


def observed(number, moves):
    """Observation of a draw, episodes of its poses, what moved, and by how much, px."""
    rng = np.random.default_rng([SEED, number, moves])
    kind = number % len(KINDS)
    robot = reference_ur5(1 if kind == 0 else 2)
    q, episode = teleoperated(robot, rng)
    true = q + JOINTS_RAD * rng.standard_normal(q.shape)
    true += TWICE_RAD * np.sin(2 * q + rng.uniform(0, 2 * np.pi, q.shape[1]))
    body = robot.markers[:, :3].mean(axis=0) + 0.05 * rng.standard_normal((4, 3))
    table = np.c_[body, np.ones(4)]

    def seen(one):
        """Images (K, V, m, 2) of all markers by the cameras of a robot."""
        images = one.images(true)
        if kind < 2:
            return images
        x = one.cameras @ table.T
        still = np.swapaxes(x[:, :2] / x[:, 2:], 1, 2)
        return np.concatenate([images, np.broadcast_to(still, (len(q), *still.shape))], axis=2)

    images, expected, size = seen(robot), (), 0.0
    if moves:
        v, size = int(rng.integers(len(robot.cameras))), float(np.exp(rng.uniform(*np.log(SIZES_PX))))
        turn, shift = (x / np.linalg.norm(x) for x in rng.standard_normal((2, 3)))
        at = int(rng.integers(1, EPISODES))
        last = at if number % 2 else EPISODES - 1  # of the episodes in which it is elsewhere
        scale = 1e-3
        for _ in range(20):  # images move nearly in proportion
            cameras = robot.cameras.copy()
            cameras[v] = turned(cameras[v], scale * turn, 0.5 * scale * shift)
            other = seen(dataclasses.replace(robot, cameras=cameras))
            scale *= size / np.sqrt(np.mean(np.square(other[:, v] - images[:, v]).sum(axis=-1)))
        there = (at <= episode) & (episode <= last)
        images = np.where(there[:, None, None, None], other, images)
        ends = [at] if last == EPISODES - 1 else [at, last + 1]
        expected = tuple((("left", "right")[v], k - 1, k) for k in ends)
    images = images + NOISE_PX * rng.standard_normal(images.shape)
    images[rng.random(images.shape[:3]) < HIDDEN] = np.nan
    pose = 100_000 * episode + np.tile(np.arange(POSES), EPISODES)
    view = ("left", "right")[: images.shape[1]]
    return Observation(pose, np.arange(images.shape[2]), q, images, view=view), episode, expected, size


def drawn(job):
    """Row of a draw."""
    number, moves = job
    observation, episode, expected, size = observed(number, moves)
    result = stretches(observation, episode)
    found = tuple((one.view, one.last, one.first) for one in result.moved)
    said = " ".join(f"{one.by_px:.2f}" for one in result.moved)
    row = (number, moves, KINDS[number % len(KINDS)], expected, found, f"{size:.2f}", said, result.untested)
    return [dict(zip(COLUMNS, (*row, int(found == expected and not result.untested)), strict=True))]


def main():
    """Judge all draws, and write the table."""
    asked = parser_of("episodes", __doc__, [("draws", 50, "with a camera that moved, and as many without")])
    asked = asked.parse_args()
    jobs = [(number, moves) for moves in (1, 0) for number in range(asked.draws)]
    rows = written(asked.output, COLUMNS, in_two_processes(drawn, jobs, "episodes"))
    for moves, words in ((1, "a camera moved, found"), (0, "none moved, none found")):
        for kind in (*KINDS, "all"):
            some = [row for row in rows if row["moved"] == moves and kind in (row["kind"], "all")]
            right = sum(row["right"] for row in some)
            print(f"{words}, {kind}: {right} of {len(some)}, {rate(right, len(some))} %")


if __name__ == "__main__":
    main()
