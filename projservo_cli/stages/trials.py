"""Many simulated runs of one configuration that differ in their seeds alone, without their traces."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from projservo_cli.control import CODES
from projservo_cli.geometry.mechanisms import COORDINATES
from projservo_cli.loop.step import RUNNING
from projservo_cli.loop.trial import NUMBERS, VERDICT, Desk, Setting, new_desk, trials
from projservo_cli.records import BODY_LAWS, METRIC_LAWS, Calibration, FloatArray, law_and_mode
from projservo_cli.stages.motion import joints_of
from projservo_cli.stages.plan import rehearses
from projservo_cli.stages.scenario import (
    Reach,
    disturbance_of,
    lose_markers,
    noise_of,
    plant_of,
    shown_at,
    shown_px,
    start_and_goal,
    truth_of,
    watched_body,
)
from projservo_cli.stages.servo import gains_of, limits_of, sense_is_enough
from projservo_cli.stages.traces import ends_of
from projservo_cli.task.body import NO_BODY

if TYPE_CHECKING:
    from projservo_cli.config import Config

# Noise is drawn for so many instants, and for so many times as many where a run is not over then.
INSTANTS, FURTHER = 192, 4
# Runs that compiled code makes in one call: their noise is a few hundred kilobytes.
TOGETHER = 16


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
    ends: Reach
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
    if watched is None:
        ends = replace(ends, pins_start=ends.pins_start[:, :0], pins_star=ends.pins_star[:, :0])
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
    desk = new_desk(prepared.setting, prepared.ends.s_start.shape[1] + len(prepared.pins))
    found = np.empty((len(seeds), len(NUMBERS)))
    for first in range(0, len(seeds), TOGETHER):
        last = first + TOGETHER
        _make(prepared, seeds[first:last], INSTANTS, desk, found[first:last])
    return found


def _make(prepared: Prepared, seeds: Sequence[int], instants: int, desk: Desk, numbers: FloatArray) -> None:
    """Write the numbers (k, ``NUMBERS``) of runs whose noise is drawn for so many instants at first."""
    config, m = prepared.config, prepared.ends.s_start.shape[1]
    drawn = min(instants, prepared.setting.limits.max_steps + 1)
    shown = np.array([images_of(prepared, seed) for seed in seeds])
    noise = np.empty((len(seeds), drawn, 2, len(prepared.numbers), 2))
    for seed, of_run in zip(seeds, noise, strict=True):
        of_run[:] = noise_of(seed, config.noise.servo_px, drawn, m, len(prepared.numbers) - m)
        lose_markers(config, of_run, prepared.numbers)
    trials(prepared.setting, shown, noise, desk, numbers)
    for i in np.flatnonzero(numbers[:, VERDICT] == RUNNING).tolist():
        _make(prepared, seeds[i : i + 1], FURTHER * instants, desk, numbers[i : i + 1])


def images_of(prepared: Prepared, seed: int) -> FloatArray:
    """Images (2, 2, b, 2) at the start and at the goal as a seed shows them, the face first, px."""
    reach = shown_at(prepared.ends, seed, shown_px(prepared.config))
    m, pins = reach.s_start.shape[1], prepared.pins
    shown = np.empty((2, 2, m + len(pins), 2))
    shown[0, :, :m], shown[1, :, :m] = reach.s_start, reach.s_star
    shown[0, :, m:], shown[1, :, m:] = reach.pins_start[:, pins], reach.pins_star[:, pins]
    return shown
