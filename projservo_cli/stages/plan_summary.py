"""Summary of a plan: whether it may be followed, its smallest margin, and the result of its search."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from projservo_cli.image_size import BEHIND
from projservo_cli.planning.constraints import Constraints, demands_into, margins_along_into, new_trial
from projservo_cli.planning.margins import (
    CONDITIONING,
    CONSTRAINTS,
    IMAGE,
    JOINTS,
    OF_MOTION,
    VISIBILITY,
    Demands,
    Motion,
    best_views,
    constraint_at,
    joint_margin,
)
from projservo_cli.planning.rrt_connect import JointPath, Tree, may_start
from projservo_cli.planning.time_parameterization import TimedPath
from projservo_cli.records import FloatArray, IntArray, in_unit


def verdict_of(motion: Motion) -> tuple[bool, str, str]:
    """Whether all constraints hold along a motion, which is nearest to failing, and that in words.

    Nearest is the smallest share of the margin at the worse of both ends; where a constraint fails, words
    are of the first instant at which it does.
    """
    shares = motion.shares()
    nearest = int(np.argmin(shares.min(axis=0)))
    margins = motion.along.margins[:, nearest]
    name, holds = CONSTRAINTS[OF_MOTION[nearest]].name, bool(margins.min() > 0.0)
    words = _words(
        motion, OF_MOTION[nearest], int(np.argmin(shares[:, nearest]) if holds else np.argmax(margins <= 0.0))
    )
    if holds:
        return True, name, f"all constraints hold; nearest is {name}: {words}"
    return False, name, f"{name} fails first: {words}"


def _words(motion: Motion, constraint: int, instant: int) -> str:
    """One constraint at one time, with its margin."""
    along, demands = motion.along, motion.reaching.demands
    at = "at mu_t {:.2f}, mu_r {:.2f}, mu_p {:.2f}".format(*motion.mu[instant])
    if constraint in (VISIBILITY, IMAGE):
        best = best_views(demands, along.visibility[instant], along.distance[instant])
        worst = best[0 if constraint == VISIBILITY else 1].min()
        each = along.visibility if constraint == VISIBILITY else along.distance
        name = demands.view[int(np.flatnonzero(each[instant] == worst)[0])]
        if constraint == VISIBILITY:
            return f"{CONSTRAINTS[VISIBILITY].asked.format(name)} is {worst:.3f} of the start's {at}"
        return f"{_border_words(worst, name, demands)} {at}"
    if math.isnan(along.condition[instant]):
        return f"the joints cannot follow: the operators become dependent {at}"
    if constraint == JOINTS:
        q = along.q[instant]
        i = min(range(len(q)), key=lambda i: joint_margin(demands, q, i))
        unit = demands.units[i] if demands.units else "rad or m"
        limits = demands.limits
        reading, low, high = (in_unit(values[i], unit, 4) for values in (q, limits.lower, limits.upper))
        return f"joint {i + 1} is at {reading}, its limits are {low} to {high}, {at}"
    return (
        f"the {CONSTRAINTS[CONDITIONING].asked} is {along.condition[instant]:.2g} "
        f"({demands.conditioning:.2g} allowed) {at}"
    )


def _border_words(distance: float, view: str, demands: Demands) -> str:
    if distance <= BEHIND:
        return f"a marker of the face is behind the {view} camera"
    if distance < 0.0:
        return f"a marker of the face is {-distance:.1f} px outside the {view} image"
    return (
        f"a marker of the face is {distance:.1f} px from the border of the {view} image "
        f"({demands.border_px:g} px asked for)"
    )


def sight_words(profile: str, motion: Motion) -> tuple[bool, str]:
    """Tell whether enough cameras see the face all along, and give the reason."""
    margins, demands = motion.along.visibility, motion.reaching.demands
    view, V = demands.view, len(demands.view)
    least, all_of_them = demands.least_views or V, {1: "the camera sees", 2: "both cameras see"}
    see = all_of_them.get(V, f"all {V} cameras see") if least == V else f"{least} of {V} cameras see"
    margins = np.where(np.argsort(np.argsort(-margins, axis=1), axis=1) < least, margins, np.inf)
    sigma = np.linspace(0.0, 1.0, len(margins))
    worst = np.unravel_index(np.argmin(margins), margins.shape)
    if margins.min() > 0.0:
        return True, (
            f"{see} the face all along; minimum margin {margins.min():.3f} (1 at the start), "
            f"{view[worst[1]]} camera at path parameter {sigma[worst[0]]:.2f}"
        )
    lost = [
        f"{name} from path parameter {sigma[np.argmax(each <= 0)]:.2f}"
        for name, each in zip(view, margins.T, strict=True)
        if each.min() <= 0.0
    ]
    return False, (
        f"the profile {profile} turns the face away from a camera ({', '.join(lost)}): "
        "choose another trajectory.profile"
    )


# Joint vectors of each tree that are stored: those that it grew first.
_MOST_NODES = 2_000
# Number of margins in the message on a missing path: those that stopped most.
_TOLD = 2


def search_summary(
    path: JointPath, q: FloatArray, time: FloatArray, seed: int, view: Sequence[str]
) -> dict[str, Any]:
    """Fields of a plan that a search came to, with joints (s, n) at times (s,); NaN where it found none.

    view : names of the views.
    """
    summary: dict[str, Any] = {
        "n_goal_configurations": path.n_goals,
        "n_goals_tried": len(path.goals),
        "n_search_samples": path.draws,
        "seed": seed,
        "tree_nodes": 0,
    }
    if path.trees is not None:
        summary["tree_nodes"] = sum(int(tree.size[0]) for tree in path.trees)
        summary["tree_q"], summary["tree_parent"] = _stored(path.trees)
    if path.timing is None:
        return summary
    summary["margins"], summary["required_margins"] = _along(path.constraints, q)
    took = float(path.timing.time[-1])
    summary["blends"] = _corners_of(path.timing) * (float(time[-1]) / took if took > 0.0 else 1.0)
    summary["relaxed_constraints"] = tuple(_relaxed(path.constraints, {"start": q[0], "goal": q[-1]}, view))
    return summary


def _stored(trees: tuple[Tree, Tree]) -> tuple[FloatArray, IntArray]:
    """Return joints (k, n) and parents (k,) of the stored nodes of two trees, concatenated."""
    first, second = (min(int(tree.size[0]), _MOST_NODES) for tree in trees)
    parents = trees[1].parent[:second]
    return (
        np.concatenate([trees[0].q[:first], trees[1].q[:second]]),
        np.concatenate([trees[0].parent[:first], np.where(parents < 0, -1, parents + first)]),
    )


def _along(c: Constraints, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the margins and their required values, (s, c), at joints (s, n)."""
    margins = np.zeros((2, len(q), len(c.full)))
    margins_along_into(c, np.ascontiguousarray(q), new_trial(c), margins)
    return margins[0], margins[1]


def _corners_of(timed: TimedPath) -> FloatArray:
    """When each rounded stretch begins and ends (k, 2), s: where q'' is not zero."""
    curved = np.r_[False, (timed.ddq != 0.0).any(axis=1), False]
    return timed.time[np.flatnonzero(curved[1:] != curved[:-1])].reshape(-1, 2)


def _relaxed(c: Constraints, ends: Mapping[str, FloatArray], view: Sequence[str]) -> Iterator[str]:
    """Yield a sentence for each end (n,), by name, whose own margins relax a constraint."""
    asked = np.empty_like(c.full)
    for name, q in ends.items():
        demands_into(c, q, asked)
        if less := [_requirement(c, q, int(i), asked[i], view) for i in np.flatnonzero(asked < c.full)]:
            yield f"relaxed at the {name}: {', '.join(less)}"


def _requirement(c: Constraints, q: FloatArray, margin: int, asked: float, view: Sequence[str]) -> str:
    words, place = constraint_at(margin, len(view))
    if margin != JOINTS:
        return f"{words.asked.format(view[place])} {asked:.2g} px ({c.full[margin]:g} px required)"
    i = int(np.argmin(np.minimum(q - c.limits.lower, c.limits.upper - q) / c.keep))
    slides = c.model.prismatic[i]
    full, unit = (1e3 * c.keep[i], " mm") if slides else (math.degrees(c.keep[i]), "°")
    return f"{words.asked.format(i + 1)} {asked * full:.2g}{unit} away ({full:.3g}{unit} required)"


def reason_of(path: JointPath, view: Sequence[str]) -> str:
    """Describe the path through joint space, or why none was found; ``view`` are the names of the views."""
    if path.timing is None:
        return _no_path_reason(path, view)
    g = int(np.abs(path.goals - path.corners[-1]).max(axis=1).argmin())
    corners = len(path.corners) - 2
    how = "a straight path" if corners == 0 else f"a path with {corners} waypoint{'s' * (corners != 1)}"
    nearest = "the nearest" if g == 0 else f"number {g + 1}"
    some = "" if path.n_goals == len(path.goals) else f", of which the {len(path.goals)} nearest were tried"
    blocked = f"; {path.blocked} more are within a region" if path.blocked else ""
    goal = "the only joints" if path.n_goals == 1 else f"{nearest} of {path.n_goals} joint vectors"
    return f"{how} in joint space leads to {goal} that show the goal{some}{blocked}"


def _no_path_reason(path: JointPath, view: Sequence[str]) -> str:
    """Return the reason why no path was found."""
    if path.region:
        return f"the start is already within region {path.region}"
    if path.solutions == 0:
        return (
            "no joints were found that show the goal: the arm may not reach it, or its images are of "
            "other markers or in another order"
        )
    if len(path.goals) == 0:
        blocked = f" and {path.blocked} within a region that is kept out of" if path.blocked else ""
        cameras = "both cameras" if len(view) == 2 else "enough cameras"
        return (
            f"of {path.solutions} joint vectors that show the goal, whole turns apart, {path.hidden} lie "
            f"beyond the joint limits or do not show the face to {cameras}{blocked}"
        )
    if not may_start(path.start_clearance):
        worst = int(path.start_clearance.argmin())
        what = "a joint limit" if worst == JOINTS else _stopped(path, worst, view)
        return f"the start is already at or beyond {what}"
    failed = path.failures[: len(path.start_clearance)]
    main_reasons = [
        f"{_stopped(path, int(i), view)} ({failed[i] / failed.sum():.0%})"
        for i in np.argsort(-failed, kind="stable")[:_TOLD]
        if failed[i] > 0
    ]
    return (
        f"no path to any of {len(path.goals)} goal configurations was found, in {path.draws} "
        f"samples; what stopped most: {', '.join(main_reasons)}"
    )


def _stopped(path: JointPath, margin: int, view: Sequence[str]) -> str:
    words, place = constraint_at(margin, len(view))
    joint = int(path.failures[len(path.start_clearance) :].argmax()) + 1
    return words.stops.format(joint if margin == JOINTS or place >= len(view) else view[place])
