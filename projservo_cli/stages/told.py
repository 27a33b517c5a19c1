"""What a way through joint space tells beside its joints: margins, corners, trees, and what was lowered."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from projservo_cli.guidance.search import Tree
from projservo_cli.guidance.timing import Pace
from projservo_cli.guidance.validity import (
    BORDER,
    CLEAR,
    LIMITS,
    MARGINS,
    WIDTH,
    Constraints,
    put_along,
    put_demands,
)
from projservo_cli.guidance.way import Way
from projservo_cli.records import PRISMATIC, FloatArray, IntArray

# Joint vectors of each tree that are stored: those that it grew first.
MOST_NODES = 2_000


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
    told["corner"] = corners_of(way.pace) * (float(time[-1]) / took if took > 0.0 else 1.0)
    told["lowered"] = tuple(_lowered(way.held, {"start": q[0], "goal": q[-1]}))
    return told


def _stored(trees: tuple[Tree, Tree]) -> tuple[FloatArray, IntArray]:
    """Joints (k, n) and parents (k,) of what is stored of two trees, one after the other."""
    first, second = (min(int(tree.size[0]), MOST_NODES) for tree in trees)
    parents = trees[1].parent[:second]
    return (
        np.concatenate([trees[0].q[:first], trees[1].q[:second]]),
        np.concatenate([trees[0].parent[:first], np.where(parents < 0, -1, parents + first)]),
    )


def _along(c: Constraints, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Margins and what is asked of them, (s, 10), at joints (s, n)."""
    margins, asked = np.zeros((len(q), MARGINS)), np.zeros((len(q), MARGINS))
    put_along(c, np.ascontiguousarray(q), np.zeros((2, len(c.M), 2)), margins, asked)
    return margins, asked


def corners_of(pace: Pace) -> FloatArray:
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
            view = ("left", "right")[(margin - WIDTH) % 2]
            name = f"{'border' if margin >= BORDER else 'width of the face'} in the {view} image"
        return f"{name} {asked:.2g} px instead of {c.full[margin]:g} px"
    i = int(np.argmin(np.minimum(q - c.lower, c.upper - q) / c.keep))
    slides = c.model.joint_types[i] == PRISMATIC
    full, unit = (1e3 * c.keep[i], " mm") if slides else (math.degrees(c.keep[i]), "°")
    return f"limit of joint {i + 1} {asked * full:.2g}{unit} instead of {full:.3g}{unit}"
