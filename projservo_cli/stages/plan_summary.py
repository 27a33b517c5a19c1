"""What a way through joint space tells: how it leads or why there is none, margins, trees."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from projservo_cli.planning.constraints import (
    BORDER,
    CLEAR,
    FRONT,
    LIMITS,
    MARGINS,
    WIDTH,
    Constraints,
    new_trial,
    put_along,
    put_demands,
)
from projservo_cli.planning.rrt_connect import Tree, Way, may_start
from projservo_cli.planning.time_parameterization import Pace
from projservo_cli.records import PRISMATIC, VIEWS, FloatArray, IntArray

# Joint vectors of each tree that are stored: those that it grew first.
_MOST_NODES = 2_000
# Margins that are told where no way was found: those that stopped most.
_TOLD = 2


def told_of(way: Way, q: FloatArray, time: FloatArray, seed: int) -> dict[str, Any]:
    """Fields of a plan that a search came to, with joints (s, n) at times (s,); NaN where it found none."""
    told: dict[str, Any] = {
        "goals": way.shown,
        "goals_tried": len(way.goals),
        "samples": way.draws,
        "seed": seed,
        "tree_nodes": 0,
    }
    if way.trees is not None:
        told["tree_nodes"] = sum(int(tree.size[0]) for tree in way.trees)
        told["tree_q"], told["tree_parent"] = _stored(way.trees)
    if way.pace is None:
        return told
    told["validity"], told["validity_asked"] = _along(way.held, q)
    took = float(way.pace.time[-1])
    told["corner"] = _corners_of(way.pace) * (float(time[-1]) / took if took > 0.0 else 1.0)
    told["lowered"] = tuple(_lowered(way.held, {"start": q[0], "goal": q[-1]}))
    return told


def _stored(trees: tuple[Tree, Tree]) -> tuple[FloatArray, IntArray]:
    """Joints (k, n) and parents (k,) of what is stored of two trees, one after the other."""
    first, second = (min(int(tree.size[0]), _MOST_NODES) for tree in trees)
    parents = trees[1].parent[:second]
    return (
        np.concatenate([trees[0].q[:first], trees[1].q[:second]]),
        np.concatenate([trees[0].parent[:first], np.where(parents < 0, -1, parents + first)]),
    )


def _along(c: Constraints, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Margins and what is asked of them, (s, 10), at joints (s, n)."""
    found = np.zeros((2, len(q), MARGINS))
    put_along(c, np.ascontiguousarray(q), new_trial(q.shape[1], len(c.M)), found)
    return found[0], found[1]


def _corners_of(pace: Pace) -> FloatArray:
    """When each rounded stretch begins and ends (k, 2), s: where q'' is not zero."""
    bent = np.r_[False, (pace.ddq != 0.0).any(axis=1), False]
    return pace.time[np.flatnonzero(bent[1:] != bent[:-1])].reshape(-1, 2)


def _lowered(c: Constraints, ends: Mapping[str, FloatArray]) -> Iterator[str]:
    """What is asked less of at joints (n,) by name, which have less themselves; a sentence each."""
    asked = np.empty(MARGINS)
    for name, q in ends.items():
        put_demands(c, q, asked)
        if less := [_instead(c, q, int(i), asked[i]) for i in np.flatnonzero(asked < c.full)]:
            yield f"asked less at the {name}: {', '.join(less)}"


def _instead(c: Constraints, q: FloatArray, margin: int, asked: float) -> str:
    if margin != LIMITS:
        name = "distance from regions"
        if margin < CLEAR:
            view = VIEWS[(margin - WIDTH) % 2]
            name = f"{'border' if margin >= BORDER else 'width of the face'} in the {view} image"
        return f"{name} {asked:.2g} px instead of {c.full[margin]:g} px"
    i = int(np.argmin(np.minimum(q - c.lower, c.upper - q) / c.keep))
    slides = c.model.joint_types[i] == PRISMATIC
    full, unit = (1e3 * c.keep[i], " mm") if slides else (math.degrees(c.keep[i]), "°")
    return f"limit of joint {i + 1} {asked * full:.2g}{unit} instead of {full:.3g}{unit}"


def reason_of(way: Way) -> str:
    """How a way through joint space leads to the goal, or why none was found, in words."""
    if way.pace is None:
        return _why_none(way)
    g = int(np.abs(way.goals - way.corners[-1]).max(axis=1).argmin())
    corners = len(way.corners) - 2
    how = "a straight way" if corners == 0 else f"a way round {corners} corner{'s' * (corners != 1)}"
    nearest = "the nearest" if g == 0 else f"number {g + 1}"
    some = "" if way.shown == len(way.goals) else f", of which the {len(way.goals)} nearest were tried"
    barred = f"; {way.barred} more are within a region" if way.barred else ""
    goal = "the only joints" if way.shown == 1 else f"{nearest} of {way.shown} joint vectors"
    return f"{how} in joint space leads to {goal} that show the goal{some}{barred}"


def _why_none(way: Way) -> str:
    """Why no way was found, in words."""
    if way.region:
        return f"the start is already within region {way.region}"
    if way.solutions == 0:
        return (
            "no joints were found that show the goal: the arm may not reach it, or its images are of "
            "other markers or in another order"
        )
    if len(way.goals) == 0:
        barred = f" and {way.barred} within a region that is kept out of" if way.barred else ""
        return (
            f"of {way.solutions} joint vectors that show the goal, whole turns apart, {way.hidden} lie "
            f"beyond the joint limits or do not show the face to both cameras{barred}"
        )
    if not may_start(way.had):
        worst = int(way.had.argmin())
        what = "a joint limit" if worst == LIMITS else _stopped(way, worst)
        return f"the start is already at or beyond {what}"
    failed = way.failures[:MARGINS]
    most = [
        f"{_stopped(way, int(i))} ({failed[i] / failed.sum():.0%})"
        for i in np.argsort(-failed, kind="stable")[:_TOLD]
        if failed[i] > 0
    ]
    return (
        f"no way was found to any of {len(way.goals)} joint vectors that show the goal, in {way.draws} "
        f"samples; what stopped most: {', '.join(most)}"
    )


def _stopped(way: Way, margin: int) -> str:
    if margin == LIMITS:
        return f"the limits of joint {int(way.failures[MARGINS:].argmax()) + 1}"
    if margin == CLEAR:
        return "a region that is kept out of"
    kind, view = (margin - FRONT) // 2, VIEWS[(margin - FRONT) % 2]
    return (
        f"a marker behind the {view} camera",
        f"the face edge-on to the {view} camera",
        f"the width of the face in the {view} image",
        f"the border of the {view} image",
    )[kind]
