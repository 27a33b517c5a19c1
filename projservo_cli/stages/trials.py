"""Many simulated runs of one configuration that differ in their seeds alone, without their traces."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from projservo_cli.control import CODES
from projservo_cli.geometry.mechanisms import COORDINATES
from projservo_cli.loop.step import RUNNING
from projservo_cli.loop.trial import NUMBERS, VERDICT, Desk, Setting, new_desk, trial
from projservo_cli.modes import law_and_mode
from projservo_cli.records import BODY_LAWS, METRIC_LAWS, Calibration, FloatArray, IntArray
from projservo_cli.stages.beginning import rehearses
from projservo_cli.stages.disturbed import disturbance_of, lose_markers
from projservo_cli.stages.motion import joints_of
from projservo_cli.stages.servo import gains_of, limits_of, noise_of, sense_is_enough
from projservo_cli.stages.sight import watched_body
from projservo_cli.stages.traces import ends_of
from projservo_cli.stages.truth import Ends, plant_of, shown_at, shown_px, truth_of
from projservo_cli.stages.truth import ends_of as start_and_goal
from projservo_cli.task.body import NO_BODY

if TYPE_CHECKING:
    from projservo_cli.config import Config

BATCH = 32  # runs of a call, whose noise is in memory
# Noise is drawn for so many instants, and for so many times as many where a run is not over then.
INSTANTS, FURTHER = 192, 4


class Prepared(NamedTuple):
    """What runs of a configuration share.

    Attributes
    ----------
    config : without the seed.
    setting : for the kernel.
    ends : start and goal without noise.
    pins : positions of the pins that are shown among the true ones.
    numbers : of the markers that the law observes.
    """

    config: "Config"
    setting: Setting
    ends: Ends
    pins: list[int]
    numbers: list[int]


def is_compiled(config: "Config", name: str) -> bool:
    """Whether runs of a name are made here; others need their whole plan or are driven in Python."""
    six = config.robot is not None and len(config.robot.joint_types) == COORDINATES
    return six and sense_is_enough(config, name) and rehearses(config.trajectory.profile)


def prepare(config: "Config", calibration: Calibration, name: str) -> Prepared:
    """Work out all that does not depend on the seed.

    Raises
    ------
    InputError
        If the configuration lacks a part of the simulation.
    WorkFailed
        If the task cannot be begun, whatever the seed.
    """
    law, _ = law_and_mode(name)
    truth = truth_of(config)
    ends = start_and_goal(config, truth)
    watched = watched_body(config, calibration, truth)
    plant = plant_of(config, truth, ends.q_start)
    plant = plant._replace(disturbance=disturbance_of(config, len(ends.q_start)))
    numbers = [truth.number[i] for i in truth.face]
    if watched is not None and law in BODY_LAWS:
        plant = plant._replace(pins=watched.pins)
        numbers += [truth.number[truth.pins[i]] for i in watched.which]
    model, joints = calibration.model(), joints_of(config, calibration.joint_types)
    setting = Setting(
        CODES[law],
        model,
        truth.model if law in METRIC_LAWS else model,
        NO_BODY if watched is None else watched.body,
        law in BODY_LAWS,
        rehearses(config.trajectory.profile),
        gains_of(config),
        limits_of(config),
        plant,
        joints.lower,
        joints.upper,
        ends.q_start,
        ends_of(plant, truth, ends.goal_pose),
    )
    return Prepared(config, setting, ends, [] if watched is None else watched.which, numbers)


def numbers_of(prepared: Prepared, seeds: Sequence[int]) -> FloatArray:
    """Numbers (k, ``NUMBERS``) of the runs of seeds (k), each a function of its own seed alone.

    Raises
    ------
    WorkFailed
        If the task cannot be begun, whatever the seed.
    """
    found = np.empty((len(seeds), len(NUMBERS)))
    desk = new_desk(prepared.setting, prepared.ends.s_start.shape[1] + len(prepared.pins))
    for these in _batches(np.arange(len(seeds))):
        instants, most = INSTANTS, prepared.setting.limits.max_steps + 1
        while len(these) > 0:
            found[these] = _batch(prepared, [seeds[i] for i in these], min(instants, most), desk)
            these = these[found[these, VERDICT] == RUNNING]
            instants *= FURTHER
    return found


def _batches(runs: IntArray) -> Iterator[IntArray]:
    for first in range(0, len(runs), BATCH):
        yield runs[first : first + BATCH]


def _batch(prepared: Prepared, seeds: Sequence[int], instants: int, desk: Desk) -> FloatArray:
    """Numbers of runs with noise for so many instants."""
    config, ends, pins = prepared.config, prepared.ends, prepared.pins
    m, observed = ends.s_start.shape[1], len(prepared.numbers)
    shown = np.empty((len(seeds), 2, 2, m + len(pins), 2))
    noise = np.empty((len(seeds), instants, 2, observed, 2))
    for i, seed in enumerate(seeds):
        reach = shown_at(ends, seed, shown_px(config))
        shown[i, 0, :, :m], shown[i, 1, :, :m] = reach.s_start, reach.s_star
        shown[i, 0, :, m:], shown[i, 1, :, m:] = reach.pins_start[:, pins], reach.pins_star[:, pins]
        noise[i] = noise_of(seed, config.noise.servo_px, instants, m, observed - m)
        lose_markers(config, noise[i], prepared.numbers)
    numbers = np.empty((len(seeds), len(NUMBERS)))
    for i in range(len(seeds)):
        trial(prepared.setting, shown[i], noise[i], desk, numbers[i])
    return numbers
