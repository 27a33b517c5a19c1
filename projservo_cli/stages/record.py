"""Record: drive a robot through trial motions and write what both cameras saw into a table."""

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from projservo_cli.config import Config, digest
from projservo_cli.records import FloatArray, InputError, IntArray, Observation
from projservo_cli.robots.yours import Robot, at_rest_after
from projservo_cli.stages import Progress, silent
from projservo_cli.stages.calibrate import images_at, trial_motions, trial_noise
from projservo_cli.stages.own_robot import ARRIVED, drive_to, foreign_robot
from projservo_cli.stages.world import Truth, joints_of, limit_passed, truth_of
from projservo_cli.tables import JointList, read_table, recording_of, write_table

# What a recorded pixel depends on, apart from the joints, which the table itself tells.
DEPENDS_ON = (
    *("seed", "robot", "rig", "markers.positions_m", "markers.numbers", "noise.calibration_px"),
    *("plant.use", "plant.options"),
)
SAVE_EVERY = 1.0  # s; what an interruption without warning may cost


class SimulatedRobot:
    """The robot of a configuration, from joints (n,) on, with noise (k, 2, m, 2) px for each look in turn."""

    def __init__(self, truth: Truth, q_start: FloatArray, noise: FloatArray) -> None:
        self._truth = truth
        self._q = np.array(q_start, dtype=np.float64)
        self._noise = iter(noise)

    def joints(self) -> FloatArray:
        """Joint readings (n,), rad or m."""
        return self._q.copy()

    def observe(self) -> FloatArray:
        """Noisy pixels (2, m, 2) of all markers, NaN outside an image."""
        return images_at(self._truth, self._q, next(self._noise))

    def command(self, step: FloatArray, period: float) -> None:
        """Move by the joint step (n,), rad or m; the simulated robot always arrives."""
        del period
        self._q = self._q + step

    def stop(self) -> None:
        """Nothing moves between commands."""


@dataclass
class _Recording:
    """A table in the making."""

    path: Path  # of the table
    key: str  # hash of what the pixels depend on, stored with every row
    targets: FloatArray  # (K, n) joints to drive to, rad or m; the row is the number of the pose
    marker: IntArray  # (m,) numbers of the markers
    # q, images: joints (n,) and pixels (2, m, 2) of the poses that are done
    q: dict[int, FloatArray] = field(default_factory=dict)
    images: dict[int, FloatArray] = field(default_factory=dict)
    found: int = 0  # how many of them an earlier call recorded
    commands: int = 0  # steps sent to the robot

    @property
    def pending(self) -> list[int]:
        """Poses that are still to be recorded."""
        return [pose for pose in range(len(self.targets)) if pose not in self.q]

    @property
    def unseen(self) -> int:
        """Marker–view pairs without a pixel in the poses that are done."""
        return sum(int(np.isnan(images[..., 0]).sum()) for images in self.images.values())

    def save(self) -> None:
        """Write all poses that are done, in their order; the file appears whole or not at all."""
        pose = sorted(self.q)
        q, images = (np.array([done[k] for k in pose]) for done in (self.q, self.images))
        observation = Observation(np.array(pose, dtype=np.int64), self.marker, q, images)
        write_table(observation, self.path, recording=self.key)


def new_recording(
    config: Config, path: Path, *, motions: JointList | None = None, force: bool = False
) -> _Recording:
    """What there is to record, and what of it the table holds already.

    motions : further poses after the trial motions, numbered on.
    force : begin anew, whatever stands at ``path``; else a table of another configuration is refused.
    """
    if config.plant.use is None:
        truth_of(config)  # refuses what lacks a part of the simulation
    targets = trial_motions(config)
    numbers = config.markers.known if config.markers is not None else None
    if numbers is None:
        raise InputError("record needs to know which markers the robot observes: set markers.numbers")
    if motions is not None:
        joints = joints_of(config)
        for pose, q in zip(motions.pose, motions.q, strict=True):
            if wrong := limit_passed(q, joints.lower, joints.upper):
                raise InputError(f"motions: pose {pose}: {wrong}: choose another")
        targets = np.vstack([targets, motions.q])
    key = digest(config, DEPENDS_ON)[:16]
    recording = _Recording(path, key, targets, np.array(numbers, dtype=np.int64))
    if path.exists() and not force:
        _resume(recording)
    return recording


def _resume(recording: _Recording) -> None:
    """Take over the poses of an interrupted recording."""
    path, remedy = recording.path, "choose another --output, or replace it with --force"
    if recording_of(path) != recording.key:
        raise InputError(f"{path}: was not recorded with this configuration; {remedy}")
    n = recording.targets.shape[1]
    table = read_table(path, "R" * n, "rad")
    if sorted(recording.marker) != table.marker.tolist():
        raise InputError(f"{path}: has other markers than the configuration; {remedy}")
    column = np.searchsorted(table.marker, recording.marker)
    for k, pose in enumerate(table.pose.tolist()):
        known = 0 <= pose < len(recording.targets)
        if not known or np.abs(table.q[k] - recording.targets[pose]).max() > ARRIVED:
            raise InputError(f"{path}: pose {pose} is none of those to be recorded; {remedy}")
        recording.q[pose], recording.images[pose] = table.q[k], table.images[k][:, column]
    recording.found = len(recording.q)


def record(
    config: Config, recording: _Recording, robot: Robot | None = None, *, progress: Progress = silent
) -> None:
    """Record the pending poses, and keep those that are done however it ends.

    robot : what is driven; None takes that of ``plant.use``, or simulates the robot of the configuration.
    """
    joints = joints_of(config)
    if robot is None and config.plant.use is not None:
        robot = foreign_robot(config, joints, len(recording.marker))
    if robot is None:
        noise = trial_noise(config, len(recording.targets), len(recording.marker))  # as calibrate adds it
        robot = SimulatedRobot(truth_of(config), recording.targets[0], noise[recording.pending])
    kept, due = len(recording.q), time.monotonic() + SAVE_EVERY
    try:
        with at_rest_after(robot):
            for pose in recording.pending:
                recording.commands += drive_to(robot, recording.targets[pose], config, joints, "record")
                recording.q[pose], recording.images[pose] = robot.joints(), robot.observe()
                progress("record", len(recording.q), len(recording.targets))
                if (start := time.monotonic()) >= due:
                    recording.save()
                    kept, now = len(recording.q), time.monotonic()
                    # A long table takes long to write: most of the time must stay for recording.
                    due = now + max(SAVE_EVERY, 10.0 * (now - start))
    finally:
        if len(recording.q) > kept:
            recording.save()
