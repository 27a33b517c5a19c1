"""Summary of a plan: whether it may be followed, its smallest margin, and the result of its search."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from projservo_cli.findings import NOTE, REFUSES, Finding, Subject
from projservo_cli.image_size import BEHIND
from projservo_cli.planning.joint_constraints import Constraints, demands_into, margins_along_into, new_trial
from projservo_cli.planning.motion_margins import (
    CONSTRAINTS,
    IMAGE,
    JOINTS,
    OF_MOTION,
    VISIBILITY,
    Motion,
    best_views,
    constraint_at,
    joint_margin,
)
from projservo_cli.planning.rrt_connect import JointPath, Tree, may_start
from projservo_cli.planning.time_parameterization import TimedPath
from projservo_cli.records import FloatArray, IntArray, JointSpaceSearch


def verdict_of(motion: Motion) -> tuple[str, Finding]:
    """Return the constraint of a motion that is nearest to failing, and the finding on it, which may refuse.

    Nearest is the smallest share of the margin at the worse of both ends; if a constraint fails, the
    finding is on the first instant at which it does.
    """
    shares = motion.shares()
    nearest = int(np.argmin(shares.min(axis=0)))
    margins = motion.along.margins[:, nearest]
    kind, holds = OF_MOTION[nearest], bool(margins.min() > 0.0)
    instant = int(np.argmin(shares[:, nearest]) if holds else np.argmax(margins <= 0.0))
    found = _at_instant(motion, kind, instant)
    parts = zip(("mu_t", "mu_r", "mu_p"), motion.mu[instant].tolist(), strict=True)
    at = tuple(Finding("share", subject=Subject(name=name), amount=share) for name, share in parts)
    severity = NOTE if holds else REFUSES
    return CONSTRAINTS[kind].name, replace(found, severity=severity, others=(*found.others, *at))


def _at_instant(motion: Motion, constraint: int, instant: int) -> Finding:
    """Return one constraint at one time, with its margin."""
    along, demands = motion.along, motion.reaching.demands
    if constraint in (VISIBILITY, IMAGE):
        best = best_views(demands, along.visibility[instant], along.distance[instant])
        worst = float(best[0 if constraint == VISIBILITY else 1].min())
        each = along.visibility if constraint == VISIBILITY else along.distance
        subject = Subject(views=(demands.view[int(np.flatnonzero(each[instant] == worst)[0])],))
        if constraint == VISIBILITY:
            return Finding("motion_visibility", subject=subject, amount=worst)
        if worst <= BEHIND:
            return Finding("motion_behind", subject=subject)
        if worst < 0.0:
            return Finding("outside_image", subject=subject, amount=-worst, unit="px")
        return Finding("motion_border", subject=subject, amount=worst, limit=demands.border_px, unit="px")
    if math.isnan(along.condition[instant]):
        return Finding("dependent_operators")
    if constraint == JOINTS:
        q, limits = along.q[instant], demands.limits
        i = min(range(len(q)), key=lambda i: joint_margin(demands, q, i))
        unit = "m" if motion.reaching.model.prismatic[i] else "rad"
        ends = Finding("range", amount=float(limits.lower[i]), limit=float(limits.upper[i]), unit=unit)
        return Finding(
            "motion_joints", subject=Subject(joints=(i + 1,)), amount=float(q[i]), unit=unit, others=(ends,)
        )
    return Finding("motion_conditioning", amount=float(along.condition[instant]), limit=demands.conditioning)


def sight_of(profile: str, motion: Motion) -> Finding:
    """Tell whether enough cameras see the face all along: the finding refuses if they do not."""
    margins, demands = motion.along.visibility, motion.reaching.demands
    view, min_seen = demands.view, demands.min_views or len(demands.view)
    margins = np.where(np.argsort(np.argsort(-margins, axis=1), axis=1) < min_seen, margins, np.inf)
    sigma = np.linspace(0.0, 1.0, len(margins))
    if margins.min() > 0.0:
        instant, worst = np.unravel_index(np.argmin(margins), margins.shape)
        at = Finding("share", amount=float(sigma[instant]))
        subject = Subject(views=(view[worst],))
        return Finding("face_seen", NOTE, subject, float(margins.min()), limit=min_seen, others=(at,))
    lost = tuple(
        Finding("share", subject=Subject(views=(name,)), amount=float(sigma[np.argmax(each <= 0)]))
        for name, each in zip(view, margins.T, strict=True)
        if each.min() <= 0.0
    )
    return Finding("face_turned", REFUSES, Subject(name=profile), others=lost)


# Joint vectors of each tree that are stored: those that it grew first.
_MOST_NODES = 2_000
# Number of margins in the message on a missing path: those that stopped most.
_TOLD = 2


def search_summary(path: JointPath, q: FloatArray, time: FloatArray, seed: int) -> JointSpaceSearch:
    """Result of a search, with joints (s, n) at times (s,); NaN if it found none."""
    trees = path.trees or ()
    tree_q, tree_parent = _stored(path.trees) if path.trees is not None else (None, None)
    margins, required, blends = None, None, None
    if path.timing is not None:
        margins, required = _along(path.constraints, q)
        took = float(path.timing.time[-1])
        blends = _corners_of(path.timing) * (float(time[-1]) / took if took > 0.0 else 1.0)
    return JointSpaceSearch(
        n_goal_configurations=path.n_goals,
        n_goals_tried=len(path.goals),
        n_search_samples=path.draws,
        seed=seed,
        tree_nodes=sum(int(tree.size[0]) for tree in trees),
        tree_q=tree_q,
        tree_parent=tree_parent,
        margins=margins,
        required_margins=required,
        blends=blends,
    )


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


def relaxed(path: JointPath, q: FloatArray, view: Sequence[str]) -> Iterator[Finding]:
    """Yield a finding on each end of joints (s, n) whose own margins relax a constraint."""
    c, asked = path.constraints, np.empty_like(path.constraints.full)
    for name, end in (("start", q[0]), ("goal", q[-1])):
        demands_into(c, end, asked)
        less = tuple(_required(c, end, int(i), asked[i], view) for i in np.flatnonzero(asked < c.full))
        if less:
            yield Finding("relaxed", NOTE, Subject(name=name), others=less)


def _required(c: Constraints, q: FloatArray, margin: int, asked: float, view: Sequence[str]) -> Finding:
    """Return the requirement of a margin after relaxation."""
    if margin != JOINTS:
        return replace(_of_margin(margin, view), amount=float(asked), limit=float(c.full[margin]), unit="px")
    i = int(np.argmin(np.minimum(q - c.limits.lower, c.limits.upper - q) / c.keep))
    min_seen, unit = float(c.keep[i]), "m" if c.model.prismatic[i] else "rad"
    return replace(_of_margin(margin, view, i + 1), amount=float(asked) * min_seen, limit=min_seen, unit=unit)


def findings_on(path: JointPath, view: Sequence[str]) -> Finding:
    """Return the result of a search through joint space, or its failure; ``view`` names the views."""
    if path.timing is None:
        return replace(_why_no_path(path, view), severity=REFUSES)
    g = int(np.abs(path.goals - path.corners[-1]).max(axis=1).argmin())
    waypoints = Finding("waypoints", amount=len(path.corners) - 2, unit="1")
    return Finding("joint_path", amount=g + 1.0, limit=path.n_goals, unit="1", others=(waypoints,))


def _why_no_path(path: JointPath, view: Sequence[str]) -> Finding:
    """Return the reason why no path was found."""
    if path.region:
        return Finding("within_region", subject=Subject(name="start"), amount=path.region)
    if path.solutions == 0:
        return Finding("no_goal_joints")
    if len(path.goals) == 0:
        blocked = Finding("within_region", amount=path.blocked, unit="1")
        return Finding("goals_hidden", amount=path.solutions, limit=path.hidden, others=(blocked,))
    if not may_start(path.start_clearance):
        worst = int(path.start_clearance.argmin())
        what = Finding("margin_limits") if worst == JOINTS else _stopped(path, worst, view)
        return Finding("start_beyond", others=(what,))
    failed = path.failures[: len(path.start_clearance)]
    frequent = [int(i) for i in np.argsort(-failed, kind="stable")[:_TOLD] if failed[i] > 0]
    stopped = tuple(_stopped(path, i, view) for i in frequent)
    return Finding("no_path", amount=len(path.goals), limit=path.draws, others=stopped)


def _stopped(path: JointPath, margin: int, view: Sequence[str]) -> Finding:
    """Return the margin that stopped a search, of the joints the one whose limit did so most."""
    return _of_margin(margin, view, int(path.failures[len(path.start_clearance) :].argmax()) + 1)


def _of_margin(margin: int, view: Sequence[str], joint: int = 0) -> Finding:
    """Return the finding on a column of margins, of one of the views or of a joint."""
    kind, place = constraint_at(margin, len(view))
    subject = Subject(joints=(joint,)) if margin == JOINTS else Subject(views=(*view, "")[place:][:1])
    return Finding(f"margin_{kind.name}", subject=subject)
