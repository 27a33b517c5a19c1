"""A position limit in the way: steps end at it, along the path, and the run says so."""

import numpy as np
import pytest

from projservo_cli.loop.verdicts import VERDICTS
from tests.loop.test_python_loop import in_python, same_logs
from tests.scene import GAINS, STEP, Run, limits, scene

STOP = {"stop_at_joint_limit": True}


def narrowed(share=0.5, joint=2):
    """Scene with a joint limited at a share of its way, and gains that know the limits."""
    sc = scene()
    upper = sc.plant.limits.upper.copy()
    upper[joint] = sc.q_start[joint] + share * STEP[joint]
    sc = sc._replace(plant=sc.plant._replace(limits=sc.plant.limits._replace(upper=upper)))
    return sc, GAINS._replace(limits=GAINS.limits._replace(lower=sc.plant.limits.lower, upper=upper))


def off_line(center):
    """Distances of centres (k, 3) from the line of a free run of the law."""
    free = Run(scene(), "exact").center
    way = (free[-1] - free[0]) / np.linalg.norm(free[-1] - free[0])
    off = center - free[0]
    return np.linalg.norm(off - np.outer(off @ way, way), axis=1)


@pytest.mark.parametrize("share", [0.02, 0.5])
def test_exact_goes_along_its_path_to_the_limit(share):
    sc, gains = narrowed(share)
    stopped = Run(sc, "exact", gains, limits(**STOP))
    assert stopped.verdict == "joint limit"
    assert stopped.log.events[1:3].tolist() == [-1, 2]
    assert 0 <= sc.plant.limits.upper[2] - stopped.log.q[-1, 2] < 1e-9
    assert off_line(stopped.center).max() < 1e-10
    # What is left is what the law measures there: the task was not finished, the face moved on the way.
    first, last = stopped.log.errors[0], stopped.log.errors[-1]
    assert 0 < last[1] < first[1]
    assert 0 < last[4] < first[4]
    # A law that leaves the limit to the loop bends off the line instead.
    bent = Run(sc, "direct_two", gains, limits(**STOP))
    assert bent.verdict == "joint limit"
    assert share < 0.1 or off_line(bent.center).max() > 1e-6


@pytest.mark.parametrize(("law", "sigma"), [("exact", 0.3), ("direct_two", 0.0)])
def test_both_loops_end_at_the_limit_alike(law, sigma, rng):
    sc, gains = narrowed()
    bounds = limits(max_steps=200, **STOP)
    noise = sigma * rng.normal(size=(201, 2, 4, 2))
    compiled = Run(sc, law, gains, bounds, noise)
    code, steps, log = in_python(sc, law, bounds, noise, gains=gains)
    assert (VERDICTS[code], steps) == (compiled.verdict, compiled.steps)
    assert compiled.verdict == "joint limit"
    assert (log.q[: steps + 1] <= sc.plant.limits.upper).all()
    same_logs(log, compiled.full, steps)
