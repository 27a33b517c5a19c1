"""What a plan says of its motion: whether it may be followed, what is nearest to failing, and where."""

import math

import numpy as np

from projservo_cli.planning.margins import (
    BEHIND,
    CONSTRAINTS,
    IMAGE,
    JOINTS,
    VISIBILITY,
    Demands,
    Motion,
    joint_margin,
)
from projservo_cli.records import VIEWS, FloatArray, in_unit


def verdict_of(motion: Motion) -> tuple[bool, str, str]:
    """Whether all constraints hold along a motion, which is nearest to failing, and that in words.

    Nearest is the smallest share of the margin at the worse of both ends; where a constraint fails, words
    are of the first instant at which it does.
    """
    shares = motion.shares()
    nearest = int(np.argmin(shares.min(axis=0)))
    margins = motion.along.margins[:, nearest]
    name, holds = CONSTRAINTS[nearest], bool(margins.min() > 0.0)
    words = _words(
        motion, nearest, int(np.argmin(shares[:, nearest]) if holds else np.argmax(margins <= 0.0))
    )
    if holds:
        return True, name, f"all constraints hold; nearest is {name}: {words}"
    return False, name, f"{name} fails first: {words}"


def _words(motion: Motion, constraint: int, instant: int) -> str:
    """What one constraint says at one instant, and where that is."""
    found, demands = motion.along, motion.reaching.demands
    at = "at mu_t {:.2f}, mu_r {:.2f}, mu_p {:.2f}".format(*motion.mu[instant])
    if constraint == VISIBILITY:
        view = int(np.argmin(found.visibility[instant]))
        margin = found.visibility[instant, view]
        return f"visibility from the {VIEWS[view]} camera is {margin:.3f} of the start's {at}"
    if constraint == IMAGE:
        view = int(np.argmin(found.distance[instant]))
        return f"{_border_words(found.distance[instant, view], VIEWS[view], demands)} {at}"
    if math.isnan(found.condition[instant]):
        return f"the joints cannot follow: the operators become dependent {at}"
    if constraint == JOINTS:
        q = found.q[instant]
        i = min(range(len(q)), key=lambda i: joint_margin(demands, q, i))
        unit = demands.units[i] if demands.units else "rad or m"
        here, low, high = (in_unit(values[i], unit, 4) for values in (q, demands.lower, demands.upper))
        return f"joint {i + 1} is at {here}, its limits are {low} to {high}, {at}"
    return (
        f"the reciprocal condition of the image Jacobian is {found.condition[instant]:.2g} "
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


def least_of(motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Smallest value (4,) of each constraint in its own unit, and the shares (4, 3) where it is."""
    found = motion.along
    values = [found.visibility.min(axis=1), found.distance.min(axis=1), found.limit, found.condition]
    where = [0 if np.isnan(column).all() else int(np.nanargmin(column)) for column in values]
    return np.array([column[i] for column, i in zip(values, where, strict=True)]), motion.mu[where]


def sight_words(profile: str, motion: Motion) -> tuple[bool, str]:
    """Whether both cameras see the face all along, and what says so."""
    margins = motion.along.visibility
    sigma = np.linspace(0.0, 1.0, len(margins))
    worst = np.unravel_index(np.argmin(margins), margins.shape)
    if margins.min() > 0.0:
        return True, (
            f"both cameras see the face all along; least margin {margins.min():.3f} of the start's, "
            f"{VIEWS[worst[1]]} camera at sigma {sigma[worst[0]]:.2f}"
        )
    lost = [
        f"{VIEWS[view]} from sigma {sigma[np.argmax(margins[:, view] <= 0)]:.2f}"
        for view in range(2)
        if margins[:, view].min() <= 0.0
    ]
    return False, (
        f"the profile {profile} turns the face away from a camera ({', '.join(lost)}): "
        "choose another trajectory.profile"
    )
