"""A robot as robots are, against closed forms and against its own truth over time."""

import math

import numpy as np
import pytest

from projservo_cli.config import Config
from projservo_cli.records import no_lenses, position_limits
from projservo_cli.simulation.arm import SerialArm
from projservo_cli.simulation.ground_truth import Truth
from projservo_cli.simulation.robot_with_faults import FaultyRobot, Points, World, full_reach
from tests.samples import displacement, pixels, revolute, rig

PERIOD = 0.04
M = np.array([[0.7, 0.05, 0.02, 1], [0.72, -0.05, 0.03, 1], [0.68, 0.0, -0.05, 1]])
CAMERAS = rig() @ np.linalg.inv(displacement([0, 0, 0], [0.7, 0, -1.5]))  # 1.5 m below the tool, looking up
WARPED = {
    "joint_moved": {"at_step": 6, "joint": 2, "by_deg": math.degrees(0.02)},
    "camera_moved": {"at_step": 4, "view": "left", "by_px": (2.0, -1.0)},
    "marker_moved": {"at_step": 9, "marker": 1, "by_m": (0.01, 0.0, 0.0)},
    "lost_markers": {"from_step": 2, "steps": 2, "markers": (2,)},
}


def arm():
    """Two links of 0.4 and 0.3 m that are raised by negative angles, stretched out along x at zero."""
    twists = np.array([revolute([x, 0, 0], [0, 1, 0]) for x in (0.0, 0.4)])
    limits = np.full(2, math.pi)
    tool = displacement([0, 0, 0], [0.7, 0, 0])
    return SerialArm(twists, np.zeros(2, dtype=np.bool_), np.zeros(2), tool, position_limits(-limits, limits))


def displaced(q):
    return arm().pose(np.asarray(q)) @ np.linalg.inv(arm().base_tool)


def images(q, M=M):
    return pixels(CAMERAS, M @ displaced(q).T)


def robot(sigma_px=0.0, seed=1, q_start=(0.0, 0.0), **disturbance):
    truth = Truth(arm(), CAMERAS, M, (0, 1, 2), (), 0, np.full((2, 2), math.inf), no_lenses(2))
    world = World(truth, np.array(q_start), Points(truth, truth.images, True, sigma_px), PERIOD, seed, 0)
    config = Config.from_dict({"data": {"table": "none"}, "disturbance": disturbance})
    return FaultyRobot(world, config.disturbance, config.disturbance)


def driven(plant, targets):
    """What a robot tells after each of some set-points, and its true joints over time."""
    rows = []
    for q in targets:
        plant.command(np.array(q, dtype=float), np.zeros(2), plant.now() + PERIOD)
        rows.append(plant.read())
    return [np.array(row[0]) for row in rows], [row[1] for row in rows]


WAY = [[0.02 * k, -0.01 * k] for k in range(1, 26)]


def test_sag_is_read_and_flexing_is_not_in_proportion_to_the_load():
    assert full_reach(arm()) == pytest.approx(0.7, rel=0.01)
    reach, sag = full_reach(arm()), math.radians(0.5)
    for q in ([0.0, 0.0], [-0.5, 0.2], [-math.pi / 2, 0.0]):
        x_tool = 0.4 * math.cos(q[0]) + 0.3 * math.cos(q[0] + q[1])
        load = np.array([x_tool, 0.3 * math.cos(q[0] + q[1])]) / reach  # drooping is positive here
        for faults, read, true in (
            ({"gravity_sag_deg": 0.5}, load, load),
            ({"link_deflection_deg": 0.5}, 0.0 * load, load),
        ):
            plant = robot(q_start=q, **faults)
            told, _ = driven(plant, [q] * 10)
            assert told[-1] - q == pytest.approx(sag * read, abs=2e-4 * sag + sag**2)
            assert plant.truth() - q == pytest.approx(sag * true, abs=2e-4 * sag + sag**2)


def along(t):
    """Where an ideal robot is on the way at times, s."""
    k = np.clip(np.asarray(t) / PERIOD, 0.0, 25.0)
    return np.stack([0.02 * k, -0.01 * k], axis=-1)


@pytest.mark.parametrize("exposure", [0.0, 0.02])
def test_images_are_late_and_averaged_over_their_exposure(exposure):
    plant = robot(
        camera_latency_s={"left": 0.1, "right": 0.033}, exposure_s=exposure, jitter_s=0.004, stamps=True
    )
    clocks = []
    for target in WAY:
        plant.command(np.array(target), np.zeros(2), plant.now() + PERIOD)
        _, s, t_q, *stamps = plant.read()
        assert t_q == plant.now()
        assert t_q - plant.taken == pytest.approx([0.1, 0.033], abs=0.02)
        clocks.append(stamps - plant.taken)
        instants = plant.taken[:, None] + exposure * np.linspace(-0.5, 0.5, 21)
        for view in range(2):
            shown = np.mean([images(q)[view] for q in along(instants[view])], axis=0)
            assert s[view] == pytest.approx(shown, abs=0.05 if exposure else 1e-9)
    assert np.ptp(clocks, axis=0) == pytest.approx([0.0, 0.0], abs=1e-9)
    assert np.abs(clocks).min() > 0.1


def test_cameras_that_run_freely_show_a_frame_until_the_next_has_come():
    plant = robot(0.5, camera_latency_s=0.02, frame_rate_hz=30, frame_offset_s=0.016, jitter_s=0.002)
    taken, shown, ages = [], [], []
    for k in range(400):
        plant.command(np.array(along(0.01 * k)), np.zeros(2), plant.now() + 0.01)
        _, s = plant.read()
        ages.append(plant.now() - plant.taken)
        taken.append(plant.taken.copy())
        shown.append(s)
    taken, new = np.array(taken), np.diff(taken, axis=0) != 0
    assert new.mean() == pytest.approx(0.3, abs=0.02)
    assert (np.diff(shown, axis=0) != 0).any(axis=(2, 3)).tolist() == new.tolist()
    assert np.min(ages) >= 0.02
    assert np.max(ages) < 0.02 + 1 / 30 + 0.01
    steps = np.concatenate([np.diff(np.unique(column)) for column in taken.T])
    assert np.std(steps) == pytest.approx(0.002 * math.sqrt(2), rel=0.25)
    behind = np.unique(taken[:, 1])[1:50, None] - np.unique(taken[:, 0])
    assert np.abs(behind - 0.016).min(axis=1).max() < 0.012


def test_events_befall_the_robot_in_their_period():
    plant = robot(**WARPED)
    seen = [plant.read(), *zip(*driven(plant, WAY[:12]), strict=True)]
    for k, (q, s) in enumerate(seen):
        moved = M.copy()
        moved[1, 0] += 0.01 * (k >= 9)
        struck = np.array([0.02 * k, -0.01 * k + 0.02 * (k == 6)])
        expected = images(struck, moved)
        expected[0] += np.array([2.0, -1.0]) * (k >= 4)
        expected[:, 2] = math.nan if 2 <= k < 4 else expected[:, 2]
        assert q == pytest.approx(struck, abs=1e-12)
        assert s == pytest.approx(expected, abs=1e-8, nan_ok=True)
