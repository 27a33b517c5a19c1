"""Rendered robots in a study: the arm, its tasks by seed, and the conditions under which it is driven.

    python -m tests.studies.rendered_conditions

draws the tasks anew and writes rendered_tasks.csv beside this file, which the study reads.
"""

from pathlib import Path

import numpy as np

from projservo_cli.records import FloatArray
from projservo_cli.simulation.random_tasks import STRATA, random_tasks
from projservo_cli.simulation.robot_with_faults import obstruction_of
from tests.configured import observed_in_frames, robot_by_itself, truth_of
from tests.conftest import SHARED
from tests.known import configured, with_task
from tests.studies.common import row_of, tasks_in, write_rows

TASKS = Path(__file__).with_name("rendered_tasks.csv")
SEEDS = range(1, 31)
ARM = SHARED / "robots" / "ur5e" / "ur5e.xml"
# Joints, rad, at which the tool stands upright before the cameras of rendered.yaml.
FRONT = (-1.6568, -1.5713, 1.6684, -0.0971, 1.4848, 1.5708)
LEAST_PX = 40.0  # width of the middle tag at start and goal
SHOWN_FRAMES = 8
FRAMES = 2  # of each pose of a recording

CONDITIONS = {
    "ideal": (),
    "40 ms late": ("disturbance.camera_latency_s=0.04",),
    "120 ms late, ticks, lag, sag": (  # servos of their own sag
        *(
            "disturbance.camera_latency_s=0.12",
            "disturbance.exposure_s=0.01",
            "disturbance.encoder_counts_per_turn=4096",
        ),
        "disturbance.servo_time_constant_s=0.05",
    ),
    "play, taught images": ("disturbance.backlash_deg=0.5",),
    "lens": ("plant.options.k1=-0.1", "calibration.lens=true"),
    "side light": ("plant.options.light=side",),
}
TAUGHT = "play, taught images"
LATEST = 300  # steps of classical laws


def base_of(condition, arm=ARM):
    """Configuration of an arm, by default the one with its meshes alone, under a condition."""
    front = f"{{joints: {list(FRONT)}, unit: rad}}"
    return configured(
        "rendered",
        f"robot={{mjcf: {arm}, tip: attachment_site}}",
        *(f"calibration.reference={front}", f"task={{start: {front}, goal: {{joints: {front}}}}}"),
        *(f"noise.averaged_frames={SHOWN_FRAMES}", "trajectory.profile=auto", "plant.joint_limits=stop"),
        *(
            "control.laws=[exact]",
            "control.mode=track",
            f"plant.averaged_frames={FRAMES}",
            "plant.settle_s=0.3",
        ),
        *CONDITIONS[condition],
    )


def tasks_of():
    """Start and goal joints, rad, by seed."""
    return tasks_in(TASKS)


def task_config(config, seed, *, taught=False):
    """A configuration with the task of a seed; its goal is taught by images, or joints."""
    ends, aim = tasks_of()[seed], None
    if taught:
        aim = type(config.task.goal).model_validate({"images": taught_images(config, ends[1], seed)})
    return with_task(config, ends, aim, seed=seed)


def taught_images(config, q: FloatArray, seed):
    """What ``teach`` writes of images at joints (n,)."""
    truth = truth_of(config)
    s, sigma = observed_in_frames(config, truth, q, (seed, 7))
    pixels = [[None if np.isnan(uv).any() else uv.tolist() for uv in view] for view in s]
    told = [[None if np.isnan(x) else float(x) for x in view] for view in sigma]
    sides = {"left": pixels[0], "right": pixels[1], "sigma_left_px": told[0], "sigma_right_px": told[1]}
    return {"markers": list(truth.number)} | sides


def drawn(config):
    """Tasks of all seeds before the cameras of a configuration, those of each sixth of half a turn in turn.

    Their ends show the middle tag well, and the arm touches nothing there, itself included.
    """
    truth, asked = truth_of(config), config.trajectory.visible_views
    least = len(truth.P) if asked == "all" else asked
    for seed in SEEDS:
        rng, found = np.random.default_rng(seed), None
        while found is None:
            starts, goals = random_tasks(truth, np.array(FRONT), STRATA, rng, least)
            ends = starts[(seed - 1) % STRATA], goals[(seed - 1) % STRATA]
            if not all(_is_large(truth, q, least) for q in ends):
                continue
            robots = [robot_by_itself(config, truth, q, 0.0, 0, 0) for q in ends]
            free = not any(one.code == "arm_touches" for robot in robots for one in obstruction_of(robot))
            found = ends if free and all(_shows(config, truth, q, least) for q in ends) else None
        yield {"seed": seed} | row_of(found)


def _is_large(truth, q, least):
    """Whether the middle tag is as wide as asked for in so many images at joints (n,)."""
    face = truth.images(q, truth.M_face)
    sides = np.linalg.norm(face - np.roll(face, 1, axis=1), axis=2)
    return np.sort(sides.max(axis=1))[-least] >= LEAST_PX


def _shows(config, truth, q, least):
    """Whether so many frames at joints (n,) show the middle tag."""
    s, _ = observed_in_frames(config.model_copy(update={"noise": type(config.noise)()}), truth, q, (0, 0))
    return bool(np.isfinite(s[:, list(truth.face)]).all(axis=(1, 2)).sum() >= least)


if __name__ == "__main__":
    write_rows(TASKS, list(drawn(base_of("ideal"))))
