"""Teach: what both cameras see where somebody has moved the robot to, as a goal or as a start."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from projservo_cli.calibration import predict
from projservo_cli.config import Config, plain_yaml
from projservo_cli.config.models import TaskSettings
from projservo_cli.records import Calibration, FloatArray, InputError, IntArray, WorkFailed
from projservo_cli.robots.contract import ForeignRobot, Reading, at_rest_after
from projservo_cli.stages import plan as planning
from projservo_cli.stages.own_robot import foreign_robot, new_views, simulated_robot
from projservo_cli.stages.simulation import robot_at
from projservo_cli.stages.verdicts import VIEWS
from projservo_cli.stages.world import face_numbers, joints_of, limit_passed, truth_of

_LOOKS = 5  # for each frame that is wanted, where the same one comes again
_FAR = 4.0  # standard deviations that a marker may be off
_DIGITS = 4  # of pixels that are written


@dataclass(frozen=True, eq=False)
class Taught:
    """What the robot and its cameras tell of the pose it was moved to."""

    marker: IntArray  # (m,) numbers of the markers
    q: FloatArray  # (n,) mean of the joint readings, rad or m
    s: FloatArray  # (2, m, 2) mean of the pixels, NaN where most frames do not show a marker
    sigma: FloatArray  # (2, m) standard deviation of a coordinate of that mean, px; NaN where nobody knows
    frames: tuple[int, int]  # how many there were of each view
    moved: FloatArray | None  # (n,) by how much joints moved when they were held again; None if never

    @property
    def unseen(self) -> list[tuple[int, str]]:
        """Markers that a camera does not see, and which."""
        return [
            (int(self.marker[k]), VIEWS[view]) for view, k in np.argwhere(np.isnan(self.s[..., 0])).tolist()
        ]

    def as_goal(self) -> dict[str, Any]:
        """What stands under ``task.goal`` of a configuration."""
        images: dict[str, Any] = {"markers": self.marker.tolist()}
        for name, pixels in zip(("left", "right"), self.s, strict=True):
            images[name] = [None if math.isnan(u) else [u, v] for u, v in pixels.round(_DIGITS).tolist()]
        for name, sigma in zip(("sigma_left_px", "sigma_right_px"), self.sigma, strict=True):
            if np.isfinite(sigma).any():
                images[name] = [None if math.isnan(x) else x for x in sigma.round(_DIGITS).tolist()]
        return {"images": images | {"joints": {"joints": self.q.tolist(), "unit": "rad"}}}


class Checked(NamedTuple):
    """What a calibration says to what was taught."""

    reason: str  # whether joints reach it, in words
    reached: bool
    off: FloatArray  # (2, m) px by which markers are off what those joints, else those read, would show
    far: list[tuple[int, str, float]]  # markers beyond what noise explains, which view, how far, px


def teach(
    config: Config, frames: int, at: Sequence[float] | None = None, wait: Callable[[str], None] | None = None
) -> Taught:
    """Look where the robot stands, and average so many frames of each camera.

    at : joints (n,) that a simulated robot is put to, rad or m.
    wait : tells somebody to move the arm, and returns when that is done; None where nobody can be asked.
    Raises InputError if the configuration lacks a part of it; WorkFailed if the robot fails.
    """
    numbers = config.markers.known if config.markers is not None else None
    if numbers is None:
        raise InputError("teach needs to know which markers the robot observes: set markers.numbers")
    joints = joints_of(config)
    if config.plant.use is not None:
        if at is not None:
            raise InputError("--at is where a simulated robot is put to; move yours by hand")
        robot = foreign_robot(config, joints, len(numbers))
    else:
        if at is None:
            raise InputError("teach puts a simulated robot to --at q1,...,qN: give the joints")
        if wrong := limit_passed(np.array(at), joints.lower, joints.upper):
            raise InputError(f"--at: {wrong}: choose others")
        put = robot_at(config, truth_of(config), np.array(at))
        robot = simulated_robot(config, joints, put, len(numbers))
    period, moved = config.control.period_s, None

    def pause() -> None:
        """Let a period pass; a simulated robot holds where it was put to."""
        if at is None:
            time.sleep(period)
        else:
            robot.command(np.array(at), np.zeros(len(at)), robot.now() + period)

    with at_rest_after(robot):
        if wait is not None and robot.release():
            wait("the robot is released: move it, and take your hands away")
            before = robot.read().q
            robot.hold()
            moved = _looks(robot, pause, frames)[-1].q - before
        readings = _looks(robot, pause, frames)
    q = np.mean([reading.q for reading in readings], axis=0)
    means = [_mean([r.s[view] for r in _of_view(readings, view)[:frames]]) for view in range(2)]
    s, sigma = (np.stack(both) for both in zip(*means, strict=True))
    count = tuple(min(frames, len(_of_view(readings, view))) for view in range(2))
    return Taught(np.array(numbers, dtype=np.int64), q, s, sigma, (count[0], count[1]), moved)


def _looks(robot: ForeignRobot, pause: Callable[[], None], frames: int) -> list[Reading]:
    """What is read of a robot at rest, with pauses, until there are so many frames of each view."""
    readings = [robot.read()]
    while len(readings) < _LOOKS * frames and min(len(_of_view(readings, v)) for v in range(2)) < frames:
        pause()
        readings.append(robot.read())
    return readings


def _of_view(readings: list[Reading], view: int) -> list[Reading]:
    """Those with a frame of a view that is not that of the reading before."""
    before = [None, *readings[:-1]]
    return [now for now, last in zip(readings, before, strict=True) if new_views(now, last)[view]]


def _mean(frames: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Mean (m, 2) of frames of a view, px, and the standard deviation (m,) of a coordinate of it.

    Markers that most frames do not show are NaN; so are deviations of those seen but once.
    """
    all_of_them = np.array(frames)
    count = np.isfinite(all_of_them[..., 0]).sum(axis=0)
    mean = np.nansum(all_of_them, axis=0) / np.maximum(count, 1)[:, None]
    mean[2 * count <= len(frames)] = np.nan
    squares = 0.5 * np.nansum((all_of_them - mean) ** 2, axis=(0, 2))
    known = np.isfinite(mean[:, 0]) & (count > 1)
    sigma = np.sqrt(squares / np.maximum(count * (count - 1), 1))
    return mean, np.where(known, sigma, np.nan)


def checked(config: Config, calibration: Calibration, taught: Taught) -> Checked:
    """Whether joints reach what was taught, by a calibration, and which markers are off what they show.

    Raises WorkFailed if a camera does not see the whole face, InputError if the configuration has no face.
    """
    require_face(config, taught)
    joints = joints_of(config, calibration.joint_types, calibration)
    start = np.clip(taught.q, joints.lower, joints.upper).tolist()
    asked = {
        "task": TaskSettings.model_validate(
            {"start": {"joints": start, "unit": "rad"}, "goal": taught.as_goal()}
        ),
        "trajectory": config.trajectory.model_copy(update={"profile": "joint", "keep_out": ()}),
    }
    try:
        plan = planning.run(config.model_copy(update=asked), calibration)
        reached, reason = plan.feasible, plan.reason
        q = plan.q[-1] if reached else taught.q
    except WorkFailed as error:
        reached, reason, q = False, str(error), taught.q
    known, numbers = calibration.marker.tolist(), taught.marker.tolist()
    both = [k for k, number in enumerate(numbers) if number in known]
    off = np.full(taught.sigma.shape, np.nan)
    expected = predict(calibration, q[None])[0][:, [known.index(numbers[k]) for k in both]]
    off[:, both] = np.linalg.norm(taught.s[:, both] - expected, axis=2)
    noise = np.maximum(np.nan_to_num(taught.sigma), calibration.sigma_px)
    far = [
        (numbers[k], VIEWS[view], float(off[view, k]))
        for view, k in np.argwhere(off > _FAR * math.sqrt(2.0) * noise).tolist()
    ]
    return Checked(reason, reached, off, far)


def require_face(config: Config, taught: Taught) -> None:
    """Refuse what does not show the whole face to both cameras, with a WorkFailed."""
    face = face_numbers(config)
    if unseen := [(number, side) for number, side in taught.unseen if number in face]:
        number, side = unseen[0]
        raise WorkFailed(
            f"teach: the {side} camera does not see marker {number} of the face, markers.face {[*face]}: "
            "turn the face towards both cameras"
        )


def as_text(taught: Taught) -> str:
    """The file of what was taught: what stands under ``task.goal``."""
    head = "# What both cameras saw: projservo teach. Name this file under task.goal, or task.start.\n"
    return head + plain_yaml(taught.as_goal())
