"""Record: trial motions, their observations, and the table."""

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from projservo_cli import messages
from projservo_cli.calibration.detections import per_rad
from projservo_cli.detection.finders import DICTIONARY, MIN_CELL, cells_of
from projservo_cli.findings import NOTE, REFUSES, Finding, Subject
from projservo_cli.hardware.checks_at_rest import MIN_SHARED
from projservo_cli.messages.rows_by_code import Setup
from projservo_cli.records import (
    CORNERS,
    VIEWS,
    WORLD,
    BoolArray,
    FloatArray,
    InputError,
    IntArray,
    JointList,
    Observation,
    coordinate_names,
)
from projservo_cli.report.image_pages import annotated, recording_page
from projservo_cli.robots.contract import PluginRobot, Reading, Robot, at_rest_after
from projservo_cli.robots.joint_limits import Joints
from projservo_cli.robots.pacing import Steered
from projservo_cli.robots.standstill import averaged
from projservo_cli.simulation.ground_truth import Truth
from projservo_cli.simulation.random_streams import CALIBRATION_NOISE, POSE_NOISE, TRIAL_POSES, generator
from projservo_cli.simulation.robot_with_faults import robot_by_itself
from projservo_cli.stages import Progress, silent
from projservo_cli.stages.stage_inputs import OwnRobot, RecordingInputs, Trials, of_simulation
from projservo_cli.stages.worlds.external_robot import path_to, plugin_robot, simulated_robot
from projservo_cli.store.files_and_locks import write_whole
from projservo_cli.store.observation_tables import identity_in, read_table, recording_of, write_table

_SAVE_EVERY = 1.0  # s; maximum loss by an interruption without warning
_SLACK = 1e-3  # rad or m; how far beyond its sag a reading may be from where the pose was to be
_MOST_MOVING = 200  # frames in motion in a table

# Draws of one pose, of which each reaches less far, and the shares of markers that must be within both
# images, and look towards both cameras.
_DRAWS, _SHRINKING, _LEAST_SEEN, _LEAST_FACING = 100, 0.98, 0.75, 0.5


@dataclass
class _Recording:
    """A table in the making."""

    path: Path  # path of the table
    key: str  # the plant, and a hash of the inputs of the pixels; stored with every row
    targets: FloatArray  # (K, n) joints to drive to, rad or m; the row is the number of the pose
    marker: IntArray  # (m,) numbers of the markers
    done: dict[int, Reading] = field(default_factory=dict)  # the poses that are done
    # Frames in motion towards poses that are done, by the number of the motion, which is the pose's, from 1.
    motion_readings: dict[int, list[Reading]] = field(default_factory=dict)
    found: int = 0  # how many of them an earlier call recorded
    identity: str = ""  # identity of the robot that recorded them
    view: tuple[str, ...] = VIEWS  # names of its views
    mount: str = WORLD  # mount of its cameras
    flange_chart: FloatArray | None = None  # (2, 4, 4) of readings that are poses of the flange
    why: str = "none yet"  # why there is something to record; empty if there is nothing
    commands: int = 0  # steps sent to the robot
    # Sum of the squares of deviations of pixels of one pose from their mean, px², and its degrees of freedom.
    scatter: FloatArray = field(default_factory=lambda: np.zeros(2))

    @property
    def pending(self) -> list[int]:
        """Poses that are still to be recorded."""
        return [pose for pose in range(len(self.targets)) if pose not in self.done]

    @property
    def unseen(self) -> int:
        """Marker–view pairs without a pixel in the poses that are done."""
        return sum(int(np.isnan(reading.s[..., 0]).sum()) for reading in self.done.values())

    def note(self, units: Sequence[str] = ()) -> str:
        """Return the words on the last pose, and the joint that was farthest off its target; empty for none.

        units : of the joints; empty for rad.
        """
        if not self.done:
            return ""
        seen = np.isfinite(self.done[max(self.done)].s[..., 0]).sum(axis=1).tolist()
        off = np.array([np.abs(one.q - self.targets[pose]) for pose, one in self.done.items()]).max(axis=0)
        i = int(off.argmax())
        counts = tuple(Finding("seen", amount=count) for count in seen)
        unit = "m" if units and units[i] == "m" else "rad"
        return messages.sentence_and_remedy(
            Finding("farthest_off", NOTE, Subject(joints=(i + 1,)), off[i], unit=unit, others=counts)
        )

    @property
    def spread_px(self) -> float | None:
        """Standard deviation of the pixels of a pose, per coordinate; None for single images."""
        squares, freedom = self.scatter
        return float(np.sqrt(squares / freedom)) if freedom > 0.0 else None

    @property
    def summary(self) -> dict[str, Any]:
        """Summary as JSON values."""
        return {
            "table": self.path.resolve(),
            "poses": len(self.targets),
            "recorded": len(self.done) - self.found,
            "found": self.found,
            "pending": len(self.pending),
            "markers": len(self.marker),
            "unseen": self.unseen,
            "commands": self.commands,
            "spread_px": self.spread_px,
        }

    def save(self) -> None:
        """Write all that is done; the file appears whole or not at all."""
        how = {"recording": self.key, "identity": self.identity, "mount": self.mount}
        write_table(self.observation(), self.path, **how)

    def observation(self) -> Observation:
        """All poses that are done, in their order.

        Frames in motion follow, with negative numbers of poses, of the longest motions.
        """
        rest = sorted(self.done.items())
        motions = sorted(self.motion_readings, key=lambda k: len(self.motion_readings[k]), reverse=True)
        in_motion = [(k, reading) for k in motions for reading in self.motion_readings[k]][:_MOST_MOVING]
        rows = [reading for _, reading in (*rest, *in_motion)]
        pose = [*(k for k, _ in rest), *range(-1, -1 - len(in_motion), -1)]
        moving = [*(0 for _ in rest), *(k for k, _ in in_motion)]
        timed = np.isfinite([reading.t_q for reading in rows]).any()
        sigma = [reading.sigma_px for reading in rows if reading.sigma_px is not None]
        return Observation(
            pose=np.array(pose, dtype=np.int64),
            marker=self.marker,
            q=np.array([reading.q for reading in rows]),
            images=np.array([reading.s for reading in rows]),
            view=self.view,
            moving=np.array(moving, dtype=np.int64) if in_motion else None,
            t_q=np.array([reading.t_q for reading in rows]) if timed else None,
            t_view=np.array([reading.t_view for reading in rows]) if timed else None,
            sigma=np.array(sigma) if len(sigma) == len(rows) else None,
            flange_chart=self.flange_chart,
        )


def trial_motions(trials: Trials) -> FloatArray:
    """Joint readings (k, n) of the reference and of all trials, rad or m.

    Every joint alone; then, where joints may be read or images taken with faults, all joints at once, and
    the trials are spread by fractions of an encoder's tick.
    """
    motions, joints = trials.motions, trials.joints.joints()
    reference = motions.reference.values(joints.types)
    amplitude = np.array([motions.amplitude[kind == "P"] for kind in joints.types])
    rows = [reference]
    for i, farthest in enumerate(amplitude):
        for offset in np.linspace(-farthest, farthest, motions.frames_per_joint):
            q = reference.copy()
            q[i] += offset
            if wrong := joints.limit_passed(q):
                raise InputError(
                    f"calibration: in a trial {messages.sentence(wrong)}: choose another "
                    "calibration.reference or a smaller amplitude"
                )
            rows.append(q)
    rng = generator(motions.seed, TRIAL_POSES)
    drawn = (
        _random_pose(joints, trials.truth, amplitude, reference, rng) for _ in range(motions.random_poses)
    )
    q = np.array([*rows, *drawn])
    if not motions.spread:
        return q
    tick = per_rad(np.array([*joints.types]) == "P") * motions.spread
    return np.clip(q + tick * rng.uniform(-1.0, 1.0, q.shape), joints.limits.lower, joints.limits.upper)


def _random_pose(
    joints: Joints,
    truth: Truth | None,
    amplitude: FloatArray,
    reference: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """Joints (n,) within the amplitudes and the limits, which show the markers of a simulated robot."""
    for draw in range(_DRAWS):
        q = reference + amplitude * _SHRINKING**draw * rng.uniform(-1.0, 1.0, len(reference))
        if joints.limit_passed(q):
            continue
        if truth is None:
            return q
        seen = np.isfinite(truth.within(truth.images(q, truth.M))[..., 0])
        min_seen = min(len(truth.P), 2)  # views that are to show a marker
        inside = seen.sum(axis=0) >= min_seen
        facing = truth.faces(q).sum(axis=0) >= min_seen
        if inside.mean() >= _LEAST_SEEN and facing.mean() >= _LEAST_FACING:
            return q
    return reference


def noisy_observation(truth: Truth, q: FloatArray, noise_px: float, drawn: tuple[int, int]) -> Observation:
    """Noisy images of all markers at poses (k, n); unseen outside an image.

    drawn : seed and stream of the noise.
    """
    exact = np.stack([truth.images(row, truth.M) for row in q])
    images = truth.within(exact + noise_px * truth.noise.draw(generator(*drawn), exact.shape))
    return Observation(np.arange(len(q)), np.array(truth.number), q, images, view=truth.view)


class _OutdatedError(InputError):
    """A table of another configuration."""


def new_recording(
    inputs: RecordingInputs,
    path: Path | None,
    *,
    motions: JointList | None = None,
    force: bool = False,
    redo: bool = False,
) -> _Recording:
    """Return the poses to record, with those that the table holds already.

    path : the table; None for one that is kept in memory.
    motions : further poses after the trial motions, numbered on.
    force : start again, replacing ``path``; otherwise a table of another configuration is refused.
    redo : start again also if ``path`` is a recording of the same plant with another configuration.
    """
    targets, joints, key = trial_motions(inputs.trials), inputs.trials.joints.joints(), inputs.key
    if motions is not None:
        for pose, q in zip(motions.pose, motions.q, strict=True):
            if wrong := joints.limit_passed(q):
                raise InputError(f"motions: pose {pose}: {messages.sentence(wrong)}: choose another")
        targets = np.vstack([targets, motions.q])
    numbers = np.array(inputs.numbers, dtype=np.int64)
    chart = inputs.trials.joints.flange_chart
    recording = _Recording(path or Path(), key, targets, numbers, mount=inputs.mount, flange_chart=chart)
    if path is None:
        return recording
    if path.exists() and force:
        return replace(recording, why="asked for by --force")
    if path.exists():
        try:
            return _resumed(recording, joints.length_of(inputs.max_steady_state_error_deg) + _SLACK)
        except _OutdatedError:
            if not redo or (recording_of(path) or "").rpartition(" ")[0] != key.rpartition(" ")[0]:
                raise
            return replace(recording, why="outdated")
    return recording


def _resumed(empty: _Recording, maximum: FloatArray) -> _Recording:
    """The poses of an interrupted recording taken over, within (n,) of their intended joints."""
    recording = replace(empty, done={}, motion_readings={})
    path, remedy = recording.path, "choose another table, or replace it with --force (force=True)"
    recording.identity = identity_in(path)
    if recording_of(path) != recording.key:
        raise _OutdatedError(f"{path}: was not recorded with this configuration; {remedy}")
    n = recording.targets.shape[1]
    chart = recording.flange_chart
    known = ("R" * n, "rad") if chart is None else ()
    table = read_table(path, *known, chart=chart)
    if sorted(recording.marker) != table.marker.tolist():
        raise _OutdatedError(f"{path}: has other markers than the configuration; {remedy}")
    column = np.searchsorted(table.marker, recording.marker)
    nobody = np.full(len(table.pose), np.nan)
    moving = np.zeros(len(nobody), dtype=np.int64) if table.moving is None else table.moving
    t_q = nobody if table.t_q is None else table.t_q
    unstamped = np.full(table.images.shape[:2], np.nan)
    t_view = unstamped if table.t_view is None else table.t_view
    recording.view = table.view
    for k, pose in enumerate(table.pose.tolist()):
        sigma = None if table.sigma is None else table.sigma[k][:, column]
        reading = Reading(table.q[k], table.images[k][:, column], t_q[k], t_view[k], sigma, table.view)
        if moving[k] > 0:
            recording.motion_readings.setdefault(int(moving[k]), []).append(reading)
            continue
        known = 0 <= pose < len(recording.targets)
        if not known or (np.abs(table.q[k] - recording.targets[pose]) > maximum).any():
            raise _OutdatedError(f"{path}: pose {pose} is none of those to be recorded; {remedy}")
        recording.done[pose] = reading
    recording.found = len(recording.done)
    recording.why = "interrupted" if recording.pending else ""
    return recording


def record_poses(
    inputs: RecordingInputs,
    recording: _Recording,
    robot: PluginRobot | None = None,
    *,
    given: Robot | None = None,
    kept: bool = True,
    progress: Progress = silent,
) -> None:
    """Record the pending poses, and keep those that are done however it ends.

    kept : whether the table is written.
    robot : the robot to drive; None takes that of ``plant.use``, or simulates the configured robot,
        which follows its set-points exactly unless it has faults.
    given : an object of the contract instead of one of the class.
    """
    if not recording.pending:
        return
    trials, sight = inputs.trials, _Sight(inputs, recording)
    drawn = trials.motions.seed, CALIBRATION_NOISE
    robot = robot or _robot_of(trials, recording, drawn, given)
    poses = (
        _simulated(trials, recording, drawn) if robot is None else _recorded(robot, trials, recording, sight)
    )
    stored, due = len(recording.done), time.monotonic() + _SAVE_EVERY
    try:
        with nullcontext() if robot is None else at_rest_after(robot):
            if robot is not None:
                _require_same_views(recording, robot)
                robot.require_identity(recording.identity)
                recording.identity = robot.identity()
            for _ in poses:
                progress("record", len(recording.done), len(recording.targets))
                if kept and (start := time.monotonic()) >= due:
                    recording.save()
                    _show(recording, robot)
                    stored, now = len(recording.done), time.monotonic()
                    # A long table takes long to write: most of the time must stay for recording.
                    due = now + max(_SAVE_EVERY, 10.0 * (now - start))
    finally:
        if kept and len(recording.done) > stored:
            recording.save()
            _show(recording, robot)


def _require_same_views(recording: _Recording, robot: PluginRobot) -> None:
    """Take over the names of a robot's views; an InputError if a table has been begun with others."""
    if recording.found and recording.view != robot.view:
        raise InputError(
            f"{recording.path}: was begun with the cameras {', '.join(recording.view)}, not "
            f"{', '.join(robot.view)}: name them likewise, in this order, or start again with --force "
            "(force=True)"
        )
    recording.view = robot.view


def _show(recording: _Recording, robot: PluginRobot | None) -> None:
    """Write a page next to the table if a robot has frames: how far it is, and the last pose with tags."""
    if robot is None or robot.frames is None:
        return
    last, nothing, marker = recording.done[max(recording.done)], np.empty((0, 2)), recording.marker.tolist()
    each = zip(robot.frames, last.s, strict=True)
    pictures = [annotated(grey, marker, s, nothing) for grey, s in each]
    done = f"{len(recording.done)} of {len(recording.targets)} poses; {recording.note(robot.bounds.units)}"
    images = dict(zip(recording.view, pictures, strict=True))
    text = recording_page(recording.path.name, done, images, whole=not recording.pending)
    write_whole(recording.path.with_suffix(".html"), text)


def _robot_of(
    trials: Trials, recording: _Recording, drawn: tuple[int, int], given: Robot | None = None
) -> PluginRobot | None:
    """The robot that is to be driven; None for one that need not be.

    drawn : seed and stream of the random numbers of a simulated one.
    given : an object of the contract instead of one of a class.
    """
    driven, joints = trials.driven, trials.joints.joints()
    if driven is None:
        return None
    if isinstance(driven.robot, OwnRobot):
        known = driven.robot, driven.following.bounds(joints), joints.types, recording.marker.tolist()
        return plugin_robot(*known, given, further=driven.further)
    first = recording.targets[recording.pending[0]]
    return simulated_robot(driven, joints, robot_by_itself(driven.robot, first, trials.noise_px, drawn))


def observed(
    trials: Trials, q: FloatArray | None = None, seed: int | None = None, *, progress: Progress = silent
) -> tuple[Observation, float | None]:
    """Return the observations of the simulated robot, and the noise of its pixels, px, if known.

    q : (K, n) poses, rad or m, with a separate stream of noise; None for the trial motions.
    seed : of that noise; None for the seed of the trials.
    """
    truth, sigma_px = of_simulation(trials.truth), trials.noise_px
    targets = trial_motions(trials) if q is None else q
    drawn = trials.motions.seed if seed is None else seed, CALIBRATION_NOISE if q is None else POSE_NOISE
    recording = _Recording(Path(), "", targets, np.array(truth.number))
    robot = _robot_of(trials, recording, drawn)
    if robot is None or trials.driven is None:
        return noisy_observation(truth, targets, sigma_px, drawn), sigma_px or None
    recording.view = robot.view
    with at_rest_after(robot):
        for _ in _recorded(robot, trials, recording):
            progress("trial motions", len(recording.done), len(recording.targets))
    simulated = trials.driven.robot
    if not isinstance(simulated, OwnRobot) and simulated.scene is not None:
        return recording.observation(), None
    return recording.observation(), sigma_px / math.sqrt(trials.rest.averaged_frames) or None


def _simulated(trials: Trials, recording: _Recording, drawn: tuple[int, int]) -> Iterator[int]:
    """One pending pose after the other as calibrate simulates it; the number of each."""
    seen = noisy_observation(of_simulation(trials.truth), recording.targets, trials.noise_px, drawn)
    for pose in recording.pending:
        recording.done[pose] = Reading(
            seen.q[pose], seen.images[pose], np.nan, np.full(len(seen.view), np.nan), None
        )
        yield pose


def shared_markers(s: FloatArray) -> BoolArray:
    """Tell which markers (…, m) of pixels (…, V, m, 2) two views or more see; of one view, which it sees."""
    seen: BoolArray = np.isfinite(s[..., 0]).sum(axis=-2) >= min(2, s.shape[-3])
    return seen


@dataclass(frozen=True, eq=False)
class _Sight:
    """Checks that a recording suffices for a calibration, before the first motion and after each joint.

    A recording of nothing takes as long as any other.
    """

    inputs: RecordingInputs
    recording: _Recording

    def before(self, robot: PluginRobot, reading: Reading) -> None:
        """Refuse to move if the first readings, for a while, show too few markers."""
        period, waited = robot.bounds.period, 0.0
        while wrong := self._wrong(reading.s[None], Subject()):
            if waited >= self.inputs.trials.rest.settle_s:  # a camera may need some time for its first image
                raise messages.failed([wrong], self.setup, "; nothing was moved", stage="record")
            time.sleep(period)
            waited, reading = waited + period, robot.read()

    def after(self, pose: int) -> None:
        """Refuse to go on if the reference and the trial motions of a joint that ends show too little."""
        count = self.inputs.trials.motions.frames_per_joint
        i, last = divmod(pose, count) if count else (0, 1)
        group = [0, *range((i - 1) * count + 1, pose + 1)]
        if (
            last
            or not 1 <= i <= self.recording.targets.shape[1]
            or not {*group} <= self.recording.done.keys()
        ):
            return
        s = np.array([self.recording.done[k].s for k in group])
        if wrong := self._wrong(s, Subject(joints=(i,), poses=tuple(group))) or self._faceless():
            end = (
                ", or choose another calibration.reference or a smaller calibration.amplitude_deg; then "
                "start again with --force (force=True)"
            )
            raise messages.failed([wrong], self.setup, end, stage="record")

    @property
    def setup(self) -> Setup:
        """The cameras."""
        names = coordinate_names(self.recording.flange_chart)
        return Setup(self.recording.mount, self.recording.view, self.recording.targets.shape[1], names)

    def _faceless(self) -> Finding | None:
        """Tell which marker of the face no pose shows to two cameras yet; None if there is none.

        One camera shows it by itself.
        """
        face, done = self.inputs.face, self.recording.done
        shared = np.any([shared_markers(one.s) for one in done.values()], axis=0)
        lost = [k for k in self.recording.marker[~shared].tolist() if k in face]
        if not lost:
            return None
        return Finding("faceless", REFUSES, Subject(markers=tuple(lost)), len(done), unit="1")

    def _wrong(self, s: FloatArray, where: Subject) -> Finding | None:
        """Tell why looks (k, V, m, 2) are of no use; None if they are."""
        seen, given, views = np.isfinite(s[..., 0]), self.inputs.dictionary, self.recording.view
        blind, total = ~seen.any(axis=(0, 2)), seen.shape[2]
        if blind.all():
            return Finding("no_markers", REFUSES, replace(where, name=given or ""), 0, limit=total, unit="1")
        cells = cells_of(given or DICTIONARY)
        for view, side in zip(views, self._widths(s), strict=True):
            if side < MIN_CELL * cells:
                width, subject = (Finding("width", amount=side, unit="px"),), replace(where, views=(view,))
                return Finding(
                    "narrow_tags", REFUSES, subject, side / cells, limit=MIN_CELL, unit="px", others=width
                )
        if blind.any():
            most, count = int(seen.sum(axis=(0, 2)).argmax()), int(seen.sum(axis=2).max())
            subject = replace(where, views=(views[int(blind.argmax())], views[most]))
            return Finding("unseeing_camera", REFUSES, subject, count, limit=total, unit="1")
        often = -(-len(s) // 2)
        shared = int((shared_markers(s).sum(axis=0) >= often).sum())
        min_seen = (Finding("share", amount=MIN_SHARED, unit="1"),)
        few = Finding("few_shared", REFUSES, where, shared, limit=total, unit="1", others=min_seen)
        return few if shared < MIN_SHARED else None

    def _widths(self, s: FloatArray) -> list[float]:
        """Widest side of a tag in each view, px; infinite where markers are not known to be tags.

        They are if the configuration states it, or if all markers are fours that look like tags: convex
        and of one sense, wherever they are seen.
        """
        number = self.recording.marker
        order = np.argsort(number)
        corners = number[order].reshape(-1, CORNERS) if len(number) % CORNERS == 0 else np.ones((1, CORNERS))
        if (corners != corners[:, :1] + range(CORNERS)).any() or (corners[:, 0] % CORNERS).any():
            return [math.inf] * s.shape[1]
        tags = s[:, :, order.reshape(-1, CORNERS)]  # (k, V, tags, 4, 2)
        side = np.roll(tags, -1, axis=3) - tags
        after = np.roll(side, -1, axis=3)
        turn = side[..., 0] * after[..., 1] - side[..., 1] * after[..., 0]
        turn = turn[np.isfinite(turn).all(axis=-1)]
        if not self.inputs.tagged and (len(corners) < 2 or not ((turn > 0.0).all() or (turn < 0.0).all())):
            return [math.inf] * s.shape[1]
        length = np.linalg.norm(side, axis=-1)
        return [np.nanmax(one) if np.isfinite(one).any() else math.inf for one in np.moveaxis(length, 1, 0)]


def _recorded(
    robot: PluginRobot, trials: Trials, recording: _Recording, sight: _Sight | None = None
) -> Iterator[int]:
    """Drive to one pending pose after the other and look; the number of each that was recorded.

    sight : checks of the observations, if any.
    """
    steered, settle_s = Steered(robot), trials.rest.settle_s
    fit = None if sight is None else partial(sight.before, robot)
    if sight is not None:
        for pose in recording.done:  # poses of an earlier call
            sight.after(pose)

    def observe() -> Reading:
        """A look after a period."""
        recording.commands += 1
        return steered.hold()

    for pose in recording.pending:
        seen = list(path_to(steered, recording.targets[pose], settle_s, "record", fit))
        fit = None
        recording.commands += len(seen)
        recording.done[pose], squares, count = averaged(steered.reading, observe, trials.rest.averaged_frames)
        recording.scatter += squares.sum(), 2.0 * np.maximum(count - 1, 0).sum()
        recording.motion_readings[pose + 1] = _moving(seen, settle_s)
        if sight is not None:
            sight.after(pose)
        yield pose


def _moving(seen: list[Reading], settle_s: float) -> list[Reading]:
    """Return the readings in motion before all were at rest, each frame once."""
    found = []
    for before, reading in pairwise(seen):
        new = np.array(reading.new_views(before))
        if new.any() and reading.t_q < seen[-1].t_q - settle_s:
            found.append(reading._replace(s=np.where(new[:, None, None], reading.s, np.nan)))
    return found
