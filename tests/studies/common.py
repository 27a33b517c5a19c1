"""What studies share: tasks by seed, the true model as a judge, command lines, rates, processes, tables."""

import argparse
import csv
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.stats import binomtest
from tqdm import tqdm

from projservo_cli.planning.motion_margins import limits_alone
from projservo_cli.planning.rrt_connect import SearchLimits, find_path
from projservo_cli.simulation.random_tasks import random_tasks
from tests.configured import calibrate, joints_of, truth_of
from tests.known import configured, true_search, with_task

# Configurations with images of 0.5 px noise, each with a seed of its own for its tasks.
ARMS = {"paper": 151, "ur5": 152, "stanford": 153, "seven": 154}
SEEDS = ARMS | {"hobby": 155}
# Paths that are looked for with the true model: joint vectors drawn by each search, and how many searches.
SAMPLES, SEARCHES = 100_000, 20


def task_configs(name, count, *overrides):
    """Configurations of random tasks of an arm, images and trials at 0.5 px, run k with the seed k."""
    config = configured(name, "noise.calibration_px=0.5", "noise.servo_px=0.5", *overrides)
    front = np.array(config.task.start.values(config.joint_types))
    tasks = random_tasks(truth_of(config), front, count, np.random.default_rng(SEEDS[name]))
    for k, ends in enumerate(zip(*tasks, strict=True)):
        yield with_task(config, ends, seed=k)


def jobs_of(arms, count, *more):
    """Jobs of random tasks of each arm: its name, seed, configuration and one calibration, and more."""
    for arm in arms:
        configs = list(task_configs(arm, count))
        calibration = calibrate.run(configs[0])[1]
        yield from ((arm, k, config, calibration, *more) for k, config in enumerate(configs))


def tasks_in(path, **only):
    """Start and goal joints, rad, by seed, from the rows of a file in which columns have these values."""
    with open(path, encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if only.items() <= row.items()]
    return {
        int(row["seed"]): tuple(
            np.array([float(row[f"{end}_q{i}"]) for i in range(1, 10) if row.get(f"{end}_q{i}")])
            for end in ("start", "goal")
        )
        for row in rows
    }


def row_of(ends):
    """Start and goal joints, rad, as ``tasks_in`` reads them."""
    named = zip(("start", "goal"), ends, strict=True)
    return {f"{end}_q{i}": repr(float(x)) for end, q in named for i, x in enumerate(q, 1)}


def search_of(config, *, margins=False):
    """Constraints, aim and joints at both ends of a task by the true model.

    margins : whether it keeps those of the configuration; else none, and a border of 0.
    """
    truth, joints, asked = truth_of(config), joints_of(config), config.trajectory
    ends = tuple(np.array(q.values(config.joint_types)) for q in (config.task.start, config.task.goal.joints))
    demands = limits_alone(joints.limits)._replace(image_size=truth.image_size)
    if margins:
        deg = np.radians(asked.joint_margin_deg)
        keep = np.array([asked.joint_margin_m if kind == "P" else deg for kind in joints.types])
        demands = demands._replace(border_px=asked.border_px, min_face_px=asked.min_face_px, keep=keep)
    return *true_search(truth, ends, demands), ends


def parser_of(study, about, numbers=(), **choices):
    """A parser of the command line of a study.

    numbers : name, default and help of each number that is asked for.
    choices : by name what may be chosen, all by default, or a pair of that and the default, a list.
    """
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    for name, default, counted in numbers:
        parser.add_argument(f"--{name}", type=int, default=default, help=counted)
    for name, choice in choices.items():
        pair = isinstance(choice, tuple) and isinstance(choice[-1], list)
        every, chosen = choice if pair else (choice, list(choice))
        parser.add_argument(f"--{name}", nargs="+", choices=every, default=chosen)
    parser.add_argument("-o", "--output", type=Path, default=Path(f"{study}.csv"), help="every row, as CSV")
    return parser


def asked_for(study, about, tasks, arms=tuple(ARMS), counted="of each arm"):
    """What the command line of a study of planning asks for: tasks, arms and where its table goes."""
    return parser_of(study, about, [("tasks", tasks, counted)], arms=(ARMS, list(arms))).parse_args()


def has_no_way(c, aim, ends):
    """Whether no search with the true model finds a way."""
    return not any(
        len(find_path(c, aim, ends[0], ends[1][None], SearchLimits(SAMPLES, seed)).corners)
        for seed in range(SEARCHES)
    )


def rate(good, count):
    """A share in percent with its interval of Wilson, 95 %."""
    if not count:
        return "-"
    interval = binomtest(int(good), int(count)).proportion_ci(0.95, "wilson")
    return f"{100 * good / count:.1f} ({100 * interval.low:.1f} to {100 * interval.high:.1f})"


def quantiles(values, shares=(0.5, 0.95, 1.0)):
    """Quantiles of what is a number, in words."""
    values = np.asarray(values, dtype=float)
    values = values[np.isfinite(values)]
    return " / ".join(f"{q:.4g}" for q in np.quantile(values, shares)) if len(values) else "-"


def in_two_processes(function, jobs, what, processes=2):
    """Results of jobs in their order, behind other work of the machine, with a progress bar."""
    with ProcessPoolExecutor(processes, get_context("spawn"), os.nice, (10,)) as pool:
        yield from tqdm(pool.map(function, jobs), what, len(jobs), disable=not sys.stderr.isatty())


def written(path, columns, batches):
    """All rows of batches, in a table that holds what has come so far; columns of the rows where None."""
    every = []
    for rows in batches:
        every += rows
        write_rows(path, every, columns)
    return every


def write_rows(path, rows, columns=None):
    """Rows of a table as CSV."""
    with open(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns or list(dict.fromkeys(name for row in rows for name in row)))
        writer.writeheader()
        writer.writerows(rows)
