"""Boxes that stand in the way: how often tasks are solved around them, and what enters them in space.

Run as ``python -m tests.studies.planning_keep_out [profile] [arm=count ...]``, 200 tasks of three arms by
default. Each has a box that cuts the straight line between the joints of start and goal; its outlines in both
images are what the planner is told. Robots are calibrated and driven at 0.5 px; the box hides what is behind
it. Tasks that fail are looked into with the true model: where no way is found through the polygons either,
they are excluded.
"""

import sys
from collections import Counter
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.stereo import optical_centers
from projservo_cli.planning.keep_out import keep_out_of
from projservo_cli.planning.motion_margins import limits_alone
from projservo_cli.planning.rrt_connect import within_region
from projservo_cli.records import WorkFailed
from projservo_cli.settings.task import KeptOut
from projservo_cli.simulation.arm import METRIC_A_INF
from projservo_cli.simulation.ground_truth import Truth
from projservo_cli.simulation.random_tasks import random_tasks
from projservo_cli.stages.runs.run_trace import trace_of
from projservo_cli.stages.servo import drive
from projservo_cli.stages.worlds.simulated import SimulatedWorld
from tests.configured import calibrate, joints_of, plan, scenario_of, truth_of
from tests.known import configured, true_search, with_task
from tests.studies.common import has_no_way, rate

ARMS = {"paper": 67, "ur5": 67, "stanford": 66}
SEEDS = {"paper": (15, 5, 1), "ur5": (15, 5, 2), "stanford": (15, 5, 3)}
HALF_M = (0.02, 0.05)  # of the edges of a box


class Box(NamedTuple):
    """A box in space."""

    middle: np.ndarray  # (3,) m
    R: np.ndarray  # (3, 3) its axes
    half: np.ndarray  # (3,) m

    def local(self, X):
        """Points (..., 3) in the frame in which the box is the cube from −1 to 1."""
        return (X - self.middle) @ self.R / self.half

    def meets(self, X, Y):
        """Whether segments between points (..., 3) have a point in the box: the method of slabs."""
        X, Y = self.local(X), self.local(Y)
        d = np.where(Y == X, 1e-300, Y - X)
        low, high = (-1.0 - X) / d, (1.0 - X) / d
        enter, leave = np.minimum(low, high).max(axis=-1), np.maximum(low, high).min(axis=-1)
        return np.maximum(enter, 0.0) <= np.minimum(leave, 1.0)


class Drawn(NamedTuple):
    """A task with a box in its way."""

    ends: tuple[np.ndarray, np.ndarray]  # (n,) rad or m
    box: Box
    regions: tuple[KeptOut, ...]


def positions(truth: Truth, q):
    """Markers (s, m, 3) in space at joints (s, n), those of the face first."""
    order = [*truth.face, *truth.pins]
    return np.array([(truth.M[order] @ truth.displacement(x).T)[:, :3] for x in q])


def met(truth: Truth, box: Box, q):
    """Whether a marker, or a segment between markers of the face, is in the box at joints (s, n)."""
    X, m = positions(truth, q), len(truth.face)
    found = (np.abs(box.local(X)) <= 1.0).all(axis=-1).any(axis=1)
    for i in range(m):
        for j in range(i):
            found |= box.meets(X[:, i], X[:, j])
    return found


def hidden(truth: Truth, box: Box, q):
    """Whether the box stands between a camera and a marker (s, 2, m) at joints (s, n)."""
    X, O = positions(truth, q), optical_centers(truth.P, METRIC_A_INF)[:, :3]
    return np.stack([box.meets(np.broadcast_to(center, X.shape), X) for center in O], axis=1)


def outlines(truth: Truth, box: Box):
    """The outlines of a box in both images, clipped to them; None where one shows none of it."""
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * box.half @ box.R.T
    m = np.c_[corners + box.middle, np.ones(8)] @ np.swapaxes(truth.P, 1, 2)
    if not (m[..., 2] > 0.1).all():
        return None
    drawn = []
    for s, size in zip(m[..., :2] / m[..., 2:], truth.image_size, strict=True):
        polygon = s[ConvexHull(s).vertices]
        for axis, bound, sign in ((0, -0.5, 1), (1, -0.5, 1), (0, None, -1), (1, None, -1)):
            edge = size[axis] - 0.5 if bound is None else bound
            polygon = clipped(polygon, axis, edge, sign)
        if len(polygon) < 3:
            return None
        drawn.append(polygon)
    return drawn


def clipped(polygon, axis, edge, sign):
    """The part of a convex polygon (k, 2) on one side of an edge of the image (Sutherland and Hodgman)."""
    kept = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        in_a, in_b = sign * (a[axis] - edge) >= 0.0, sign * (b[axis] - edge) >= 0.0
        if in_a:
            kept.append(a)
        if in_a != in_b:
            kept.append(a + (edge - a[axis]) / (b[axis] - a[axis]) * (b - a))
    return np.array(kept)


def drawn_tasks(config, truth: Truth, count, rng):
    """Tasks (count,) with boxes that cut the straight line of joints, clear of start and goal."""
    front, found = np.array(config.task.start.values(config.joint_types)), []
    while len(found) < count:
        for q_start, q_goal in zip(*random_tasks(truth, front, 60, rng), strict=True):
            task = with_box(config, truth, (q_start, q_goal), rng)
            if task is not None and len(found) < count:
                found.append(task)
    return found


def with_box(config, truth: Truth, ends, rng):
    """A task with a box on its way; None where none of ten draws leaves start and goal clear."""
    for _ in range(10):
        x, k = rng.uniform(0.3, 0.7), rng.uniform(0.0, 1.0, len(truth.face))
        q = (1.0 - x) * ends[0] + x * ends[1]
        middle = (k / k.sum()) @ positions(truth, q[None])[0, : len(truth.face)]
        box = Box(middle, Rotation.random(random_state=rng).as_matrix(), rng.uniform(*HALF_M, 3))
        drawn = outlines(truth, box)
        line = ends[0] + np.linspace(0.0, 1.0, 201)[:, None] * (ends[1] - ends[0])
        if drawn is None or not met(truth, box, line).any():
            continue
        both = np.array(ends)
        if met(truth, box, both).any() or hidden(truth, box, both).any():
            continue
        corners = [tuple((float(u), float(v)) for u, v in polygon) for polygon in drawn]
        regions = (KeptOut(left=corners[0], right=corners[1]),)
        starts = (search_around(config, truth, (q, ends[1]), regions)[0] for q in ends)
        if all(within_region(c, q) == 0 for c, q in zip(starts, ends, strict=True)):
            return Drawn(ends, box, regions)
    return None


def search_around(config, truth: Truth, ends, regions):
    """Constraints and aim from joints (n,) to others, around regions: border 0, limits without margin."""
    demands = limits_alone(joints_of(config).limits)._replace(image_size=truth.image_size)
    keep_out = keep_out_of([((region.left, region.right), region.occludes) for region in regions])
    return true_search(truth, ends, demands, pins=truth.pins, keep_out=keep_out)


@dataclass(frozen=True, eq=False)
class Hiding(SimulatedWorld):
    """A world in which markers are unseen at some instants (k, 2, markers)."""

    unseen: np.ndarray

    def noise(self, numbers, seed, times):
        """Noise as ever, NaN where the box hides a marker."""
        noise = super().noise(numbers, seed, times).copy()
        noise[: len(self.unseen)][self.unseen] = np.nan
        return noise


def driven_behind(scenario, planned, truth: Truth, box: Box):
    """The run, with markers lost where the box hides them: driven again until that agrees."""
    markers = scenario.numbers_of("exact")
    order = [truth.number.index(number) for number in markers]
    columns = [[*truth.face, *truth.pins].index(i) for i in order]
    unseen = np.zeros((1, 2, len(markers)), dtype=bool)
    for _ in range(4):
        parts = {field.name: getattr(scenario.world, field.name) for field in fields(SimulatedWorld)}
        hiding = replace(scenario, world=Hiding(**parts, unseen=unseen))
        trace = trace_of(drive(hiding, planned, "exact_track"))
        behind = hidden(truth, box, trace.q)[:, :, columns]
        if behind.shape == unseen.shape and (behind == unseen).all():
            break
        unseen = behind
    return trace, behind


def judged(config, calibration, truth: Truth, task: Drawn, tally):
    """What is wrong with how a task ends, in words; what else befell it is counted."""
    motion = config.trajectory.model_copy(update={"keep_out": task.regions})
    config = with_task(config, task.ends, trajectory=motion)
    try:
        planned = plan.run(config, calibration)
    except WorkFailed as error:
        return f"not planned: {error}"
    tally[planned.profile] += planned.feasible
    if not planned.feasible:
        return f"no plan: {planned.reason}"
    if met(truth, task.box, between(planned.q)).any():
        tally["planned through"] += 1
    trace, behind = driven_behind(scenario_of(config, calibration), planned, truth, task.box)
    tally["face hidden"] += bool(behind[:, :, : len(truth.face)].any())
    tally["pins hidden"] += bool(behind[:, :, len(truth.face) :].any())
    if met(truth, task.box, between(trace.q)).any():
        tally["entered"] += 1
        return "entered the box"
    if trace.verdict != "converged":
        return f"{trace.verdict}: {trace.reason}"
    if trace.self_occluded.any() or trace.first_outside_image >= 0 or trace.first_beyond_limit >= 0:
        return "converged past a limit, out of sight or of an image"
    return ""


def between(q):
    """Joints at ten places between each two of (s, n)."""
    x = np.linspace(0.0, 1.0, 10, endpoint=False)[:, None, None]
    return np.concatenate([((1.0 - x) * q[:-1] + x * q[1:]).reshape(-1, q.shape[1]), q[-1:]])


def study(name, count, profile):
    """Run the tasks of an arm and print how they end; successes, ways that exist, entered boxes."""
    config = configured(
        *(name, f"trajectory.profile={profile}", "control.mode=track", "plant.joint_limits=stop"),
        *("control.laws=[exact]", "control.must_converge=[exact]", "noise.servo_px=0.5"),
    )
    truth, (_, calibration, _) = truth_of(config), calibrate.run(config)
    tally: Counter[str] = Counter()
    good = ways = 0
    tasks = drawn_tasks(config, truth, count, np.random.default_rng(SEEDS[name]))
    for k, task in enumerate(tasks):
        wrong = judged(config.model_copy(update={"seed": k}), calibration, truth, task, tally)
        good += not wrong
        search = search_around(config, truth, task.ends, task.regions)
        lost = bool(wrong) and has_no_way(*search, task.ends)
        ways += not lost
        if wrong:
            print(f"{name} {k}: {wrong}; {'no way' if lost else 'a way exists'}", flush=True)
    print(
        f"{name}: {good} of {ways} with a way, {count} tasks, {rate(good, ways)} %; of all "
        f"{rate(good, count)} %; {dict(tally)}",
        flush=True,
    )
    return good, ways, count, tally["entered"]


def main(arguments):
    """Study the arms that are named, or all."""
    profile = next((word for word in arguments if "=" not in word), "joint_space")
    named = dict(word.split("=") for word in arguments if "=" in word)
    arms = {name: int(count) for name, count in named.items()} or ARMS
    good, ways, count, entered = np.sum([study(name, n, profile) for name, n in arms.items()], axis=0)
    print(f"{profile}: {good} of {ways} with a way ({rate(good, ways)} %), {count} tasks; entered {entered}")


if __name__ == "__main__":
    main(sys.argv[1:])
