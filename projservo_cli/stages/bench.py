"""Speed of control steps and whole runs, beside one SVD of NumPy in the same process.

Everything is timed in turn, round by round, in pieces of about a millisecond. Ratios are between the
least times, which a busy machine disturbs the least.
"""

import importlib.util
import itertools
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from projservo_cli.control import CODES
from projservo_cli.control.bound import bind, bound_command
from projservo_cli.control.law import ERRORS, Gains, State, new_state
from projservo_cli.geometry.kinematics import operators_at
from projservo_cli.geometry.mechanisms import workspace
from projservo_cli.loop.compiled import Log, new_log
from projservo_cli.loop.compiled import run as run_loop
from projservo_cli.loop.repeated import many_steps
from projservo_cli.loop.step import Limits
from projservo_cli.loop.trial import NUMBERS, Desk, Setting, new_desk, trials
from projservo_cli.records import LAWS, FloatArray, Model
from projservo_cli.robots.simulated import Plant
from projservo_cli.stages.scenario import gains_of, limits_of, plant_of, start_and_goal, true_ends
from projservo_cli.stages.world import truth_of
from projservo_cli.task.body import NO_BODY, body_of
from projservo_cli.task.face import Task, task_from_images
from projservo_cli.task.target import task_from_body

if TYPE_CHECKING:
    from projservo_cli.config import Config

STATES = 256
STEPS = 150
PIECE = 64
NOISE_PX = 0.5
ROUNDS = 200
RUNS = 64
BODY = "exact, body"


class Job(NamedTuple):
    """The arguments of one run; ``state`` and ``log`` are its own, the rest may be shared."""

    code: int
    model: Model
    task: Task
    gains: Gains
    limits: Limits
    plant: Plant
    noise: FloatArray
    q_start: FloatArray
    state: State
    log: Log


class Times(NamedTuple):
    """Least, median and both quartiles of what one call takes, in µs, and the least over one SVD's."""

    least: float
    median: float
    lower: float
    upper: float
    over_svd: float


class Case:
    """A noisy run of 256 states and everything a step of it needs, with the true model.

    Parameters
    ----------
    config : a simulated task.
    """

    def __init__(self, config: "Config") -> None:
        truth = truth_of(config)
        ends = start_and_goal(config, truth, range(len(truth.pins)))
        self.truth, self.q_start, self.model = truth, ends.q_start, truth.model
        self.gains, self.bounds = gains_of(config), limits_of(config)
        self.bounds = self.bounds._replace(
            image_px=1e-9, max_steps=STATES - 1, stop_at_border=False, stop_at_joint_limit=False
        )
        self.plant = plant_of(config, truth, ends.q_start)
        s_start, s_star = ends.first(len(truth.face))
        self.shown = np.array([s_start, s_star])
        self.ends = true_ends(truth, ends.goal_pose)
        self.task = task_from_images(self.model, s_start, s_star, truth.center)
        pins = np.ascontiguousarray(truth.M[list(truth.pins)])
        self.body_plant = self.plant._replace(pins=pins)
        self.body_task = task_from_body(
            self.model,
            body_of(self.model, truth.M[[*truth.face, *truth.pins]]),
            ends.q_start,
            ends.s_start,
            ends.s_star,
            truth.center,
            len(truth.face),
        )
        seen = len(truth.face) + len(truth.pins)
        self.noise = NOISE_PX * np.random.default_rng(0).standard_normal((STATES, 2, seen, 2))
        self.points = self.drive(self.task, self.plant)
        self.whole = self.drive(self.body_task, self.body_plant)
        self.state = new_state(len(self.q_start), len(truth.face))
        self.bound = bind(CODES["direct_three"], self.model, self.task, self.gains, self.state)

    def job(self, law: str, task: Task, plant: Plant, bounds: Limits) -> Job:
        """One run with a state and a log of its own."""
        n, m = len(self.q_start), len(self.truth.face)
        seen = m + len(plant.pins)
        log = new_log(n, seen, bounds.max_steps, len(ERRORS))
        noise = np.ascontiguousarray(self.noise[:, :, :seen])
        start = self.q_start.copy()
        return Job(
            CODES[law], self.model, task, self.gains, bounds, plant, noise, start, new_state(n, m), log
        )

    def drive(self, task: Task, plant: Plant) -> tuple[FloatArray, FloatArray]:
        """Pixels and joints of the states that are cycled through."""
        job = self.job("direct_three", task, plant, self.bounds)
        run_loop(*job)
        return job.log.s, job.log.q

    def steps(self, law: str, *, body: bool = False) -> float:
        """One step of a law in each state."""
        task, (S, Q) = (self.body_task, self.whole) if body else (self.task, self.points)
        return many_steps(CODES[law], self.model, task, self.gains, S, Q, self.state, self.bounds.speed)

    def one_step(self) -> int:
        """One step of direct_three, called from Python."""
        S, Q = self.points
        return bound_command(self.bound, S[0], Q[0])

    def whole_run(self) -> Job:
        """A run of 150 steps, traced."""
        return self.job("direct_three", self.task, self.plant, self.bounds._replace(max_steps=STEPS))

    def batches(self, count: int) -> list["Batch"]:
        """Runs of 150 steps as a sweep makes them, each with noise of its own, in so many equal shares."""
        plant, bounds = self.plant, self.bounds._replace(max_steps=STEPS)
        code, limits = CODES["direct_three"], (plant.lower, plant.upper)
        setting = Setting(
            code, self.model, self.model, NO_BODY, True, False, self.gains, bounds, plant, *limits,
            self.q_start, self.ends,
        )  # fmt: skip
        m = self.shown.shape[2]
        noise = NOISE_PX * np.random.default_rng(1).standard_normal((RUNS, STEPS + 1, 2, m, 2))
        return [
            Batch(
                setting,
                np.tile(self.shown, (len(share), 1, 1, 1, 1)),
                share,
                new_desk(setting, m),
                np.empty((len(share), len(NUMBERS))),
            )
            for share in np.split(noise, count)
        ]

    def matrices(self) -> FloatArray:
        """The 8×6 matrices of [RH00] eq. (9) at each state, for the SVD."""
        _, Q = self.points
        work = workspace(len(self.q_start), 8)
        found = np.empty((STATES, 8, len(self.q_start)))
        for k in range(STATES):
            operators_at(self.model, Q[k], work.H_hat)
            A = self.task.A_star
            found[k] = np.concatenate([(work.H_hat @ A[0]).T, (work.H_hat @ A[1]).T])
        return found


class Batch(NamedTuple):
    """The arguments of many runs; ``desk`` and ``numbers`` are their own."""

    setting: Setting
    shown: FloatArray
    noise: FloatArray
    desk: Desk
    numbers: FloatArray


def seconds(function: Callable[[], object]) -> float:
    """Time of one call, s."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def measure(case: Case, rounds: int = ROUNDS) -> dict[str, Any]:
    """Time everything; see the schema of ``projservo bench --json``.

    Parameters
    ----------
    case : what is timed.
    rounds : how often each is timed.
    """
    matrices = itertools.cycle(case.matrices())
    whole = case.whole_run()
    timed: dict[str, tuple[Callable[[], object], int]] = {
        "numpy.linalg.svd": (lambda: [np.linalg.svd(next(matrices)) for _ in range(PIECE)], PIECE),
        **{law: (partial(case.steps, law), STATES) for law in LAWS},
        BODY: (lambda: case.steps("exact", body=True), STATES),
        "one call from Python": (lambda: [case.one_step() for _ in range(PIECE)], PIECE),
        "run of 150 steps": (lambda: run_loop(*whole), 1),
    }
    toolbox = toolbox_step(case)
    if toolbox is not None:
        timed["machinevision-toolbox-python"] = (toolbox, 1)
    with threadpool_limits(1):
        for function, _ in timed.values():
            function()
        table = np.array(
            [[seconds(function) / count for function, count in timed.values()] for _ in range(rounds)]
        )
        speedup, same = threads(case)
    times = {name: _times(1e6 * table[:, i], 1e6 * table[:, 0]) for i, name in enumerate(timed)}
    return {
        "step_over_svd": max(times["direct_three"].over_svd, times["direct_two"].over_svd),
        "exact_over_svd": times[BODY].over_svd,
        "run_150_ms": 1e-3 * times["run of 150 steps"].least,
        "python_call_us": times["one call from Python"].least,
        "two_threads_speedup": speedup,
        "threads_equal_to_serial": same,
        "times_us": {name: value._asdict() for name, value in times.items()},
    }


def _times(values: FloatArray, svd: FloatArray) -> Times:
    least, lower, median, upper = (float(x) for x in np.percentile(values, [0, 25, 50, 75]))
    return Times(least, median, lower, upper, least / float(svd.min()))


def threads(case: Case, count: int = 2) -> tuple[float, bool]:
    """How many times faster many runs are in two threads than in one, and whether their bits agree."""
    (serial,) = case.batches(1)
    shares = case.batches(count)
    with ThreadPoolExecutor(count) as pool:

        def together() -> None:
            for future in [pool.submit(trials, *share) for share in shares]:
                future.result()

        rounds = [(seconds(lambda: trials(*serial)), seconds(together)) for _ in range(15)]
    alone, beside = np.min(rounds, axis=0)
    same = serial.numbers.tobytes() == np.concatenate([share.numbers for share in shares]).tobytes()
    return float(alone / beside), same


def toolbox_step(case: Case) -> Callable[[], object] | None:
    """One step of image-based control of one camera by machinevision-toolbox-python, where installed."""
    if importlib.util.find_spec("machinevisiontoolbox") is None:
        return None
    from machinevisiontoolbox import CentralCamera

    camera = CentralCamera.Default()
    pixels = case.points[0][0, 0, :4].T
    error = np.ones(pixels.size)
    return lambda: np.linalg.pinv(camera.visjac_p(pixels, 1.0)) @ error
