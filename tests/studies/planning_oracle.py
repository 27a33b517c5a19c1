"""Paths of the profile joint_space against other programs: how long they are by OMPL, how quick by toppra.

    python -m tests.studies.planning_oracle [--tasks 500] [--arms paper ur5 stanford seven] [-o ways.csv]

Where the way is no straight line, OMPL's RRT-Connect looks for one to the same goals in the same validity,
from as many samples, and shortens it by its own simplification; lengths are times at the speed limits. toppra
times the very path that was found, at the same limits of speed and acceleration, and a straight one is held
against the slowest joint by itself. What is not installed is left out. The model is the true one.
"""

import time
from importlib.util import find_spec
from itertools import count

import numpy as np
from tqdm import tqdm

from projservo_cli.planning.joint_constraints import demands_into
from projservo_cli.planning.rrt_connect import SearchLimits, find_path, margins_at, with_ends
from projservo_cli.planning.time_parameterization import minimum_time
from tests.studies.common import asked_for, quantiles, search_of, task_configs, write_rows

SEEDS = 5
# That OMPL searches, and then shortens, at most, s.
PATIENCE_S = 20.0, 2.0
# JointPath between two of OMPL's checks of an edge, s at the speed limits.
RESOLUTION_S = 0.01


def of_ompl(c, q_start, goals, samples, seed):
    """Length of the way that OMPL finds, s at the speed limits; NaN for none."""
    from ompl import base, geometric, util

    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(seed)
    n, demands = len(q_start), np.zeros_like(c.full)
    space, bounds = base.RealVectorStateSpace(n), base.RealVectorBounds(n)
    for i in range(n):
        bounds.setLow(i, float(c.limits.lower[i] / c.limits.speed[i]))
        bounds.setHigh(i, float(c.limits.upper[i] / c.limits.speed[i]))
    space.setBounds(bounds)

    def joints(state):
        return c.limits.speed * np.array([state[i] for i in range(n)])

    def is_valid(state):
        q = joints(state)
        demands_into(c, q, demands)
        return bool((margins_at(c, q)[0] >= demands).all())

    def state_of(q):
        state = space.allocState()
        for i in range(n):
            state[i] = float(q[i] / c.limits.speed[i])
        return state

    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(is_valid)
    information = setup.getSpaceInformation()
    information.setStateValidityCheckingResolution(RESOLUTION_S / space.getMaximumExtent())
    targets = base.GoalStates(information)
    for q in goals:
        targets.addState(state_of(q))
    setup.setStartState(state_of(q_start))
    setup.setGoal(targets)
    setup.setPlanner(geometric.RRTConnect(information))
    drawn, end = count(), time.monotonic() + PATIENCE_S[0]
    setup.solve(base.PlannerTerminationCondition(lambda: next(drawn) > samples or time.monotonic() > end))
    if not setup.haveExactSolutionPath():
        return np.nan
    setup.simplifySolution(PATIENCE_S[1])
    path = setup.getSolutionPath()
    states = [joints(path.getState(i)) for i in range(path.getStateCount())]
    return minimum_time(c.limits.speed, np.array(states))[-1]


def of_toppra(pace, speed, acceleration):
    """Duration that toppra gives the path of a pace, s, at limits (n,)."""
    import toppra

    toppra.setup_logging("ERROR")
    path = toppra.interpolator.SplineInterpolator(pace.s, pace.q)
    limits = [
        toppra.constraint.JointVelocityConstraint(np.c_[-1, 1] * speed[:, None]),
        toppra.constraint.JointAccelerationConstraint(np.c_[-1, 1] * acceleration[:, None]),
    ]
    found = toppra.algorithm.TOPPRA(limits, path, gridpoints=pace.s).compute_trajectory(0, 0)
    return np.nan if found is None else float(found.duration)


def slowest_joint(way, speed, acceleration):
    """Time that the slowest joint takes by itself from end to end, from rest to rest, s."""
    distance = np.abs(way.corners[-1] - way.corners[0])
    cruising = distance / speed + speed / acceleration
    return np.where(
        distance > speed**2 / acceleration, cruising, 2.0 * np.sqrt(distance / acceleration)
    ).max()


def compared(config):
    """A way of a task, in numbers, against what other programs make of it."""
    c, aim, (q_start, q_goal) = search_of(config, margins=True)
    acceleration = c.limits.acceleration
    seed = config.seed
    how = SearchLimits(config.trajectory.search.max_samples, seed, config.trajectory.max_goal_configurations)
    begin = time.process_time()
    way = find_path(c, aim, q_start, q_goal[None], how)
    row = {
        "seed": seed,
        "s": time.process_time() - begin,
        "found": len(way.corners) > 0,
        "goals": way.n_goals,
    }
    if way.timing is None:
        return row
    straight, length = len(way.corners) == 2, minimum_time(c.limits.speed, way.corners)[-1]
    row |= {"straight": straight, "length": length, "duration": float(way.timing.time[-1])}
    if find_spec("toppra"):
        row["toppra"] = of_toppra(way.timing, c.limits.speed, acceleration)
    if straight:
        return row | {"slowest_joint": slowest_joint(way, c.limits.speed, acceleration)}
    nearest = (np.abs(way.goals - q_start) / c.limits.speed).max(axis=1).min()
    row["straight_to_nearest"] = nearest
    if find_spec("ompl"):
        ends = with_ends(c, np.vstack([q_start[None], way.goals]))
        theirs = [of_ompl(ends, q_start, way.goals, how.samples, seed) for seed in range(1, SEEDS + 1)]
        row |= {
            "ompl": np.median(np.nan_to_num(theirs, nan=np.inf)),
            "ompl_failed": int(np.isnan(theirs).sum()),
        }
    return row


def main():
    """Compare the ways of random tasks and print the table."""
    given = asked_for("oracle_study", __doc__, 500)
    for name in ("ompl", "toppra"):
        if not find_spec(name):
            print(f"{name} is not installed: left out (pip install {name})")
    rows = []
    for name in given.arms:
        for config in tqdm(task_configs(name, given.tasks), name, given.tasks, disable=None):
            rows.append({"arm": name} | compared(config))
        write_rows(given.output, rows)
        tell(name, [row for row in rows if row["arm"] == name])
    tell("all", rows)


def tell(name, rows):
    """Print the ratios of some ways."""
    found = [row for row in rows if row["found"]]
    straight = [row for row in found if row["straight"]]
    print(f"{name}: {len(rows)} tasks, {len(rows) - len(found)} without a way, {len(straight)} straight")
    ratios = {
        "length over that of OMPL": ("length", "ompl"),
        "length over the shortest straight line to a goal": ("length", "straight_to_nearest"),
        "duration over that of toppra": ("duration", "toppra"),
        "duration of straight ways over the slowest joint": ("duration", "slowest_joint"),
    }
    for what, (ours, theirs) in ratios.items():
        values = [row[ours] / row[theirs] for row in found if row.get(theirs)]
        if values:
            told = quantiles(values, (0.5, 0.25, 0.75, 0.95))
            print(f"  {what}, {len(values)}: median / 25 / 75 / 95 %: {told}")
    if failed := sum(row.get("ompl_failed", 0) for row in found):
        print(f"  OMPL found no way in {failed} searches")


if __name__ == "__main__":
    main()
