"""The loop in Python equals the compiled loop to the bit, and takes laws of others."""

import numpy as np
import pytest

from projservo_cli.control.law import ERRORS, OK
from projservo_cli.laws import CODES, LAW_SPECS
from projservo_cli.loop.python_loop import BuiltInLaw, run_in_python
from projservo_cli.loop.verdicts import VERDICT_NAMES
from projservo_cli.simulation.analytic_plant import AnalyticPlant
from tests.control.following import tracked
from tests.loop.bits import FOLLOWING
from tests.samples import frame
from tests.scene import FACE_LAWS, GAINS, STEP, Run, limits, scene, with_pins


def in_python(sc, law, bounds, noise, G=None, task=None, gains=GAINS):
    plant = AnalyticPlant(sc.plant, sc.q_start, noise)
    task = sc.task(G) if task is None else task
    built_in = BuiltInLaw(
        CODES[law], sc.seen(G), task, gains._replace(limits=gains.limits._replace(speed=bounds.speed))
    )
    return run_in_python(built_in, plant, sc.s_star, GAINS.period, bounds)


def both(sc, law, bounds, noise, G=None, task=None, gains=GAINS):
    """Run of the compiled loop, to which that in Python is equal to the bit up to its last instant."""
    compiled = Run(sc, law, gains, bounds, noise, G, task=task)
    code, steps, log = in_python(sc, law, bounds, noise, G, task, gains)
    assert (VERDICT_NAMES[code], steps) == (compiled.verdict, compiled.steps)
    for name, rows in compiled.full._asdict().items():
        if name not in ("M", "scratch"):  # workspaces of the compiled loop
            up_to = slice(None) if name == "events" else slice(steps + 1)
            assert getattr(log, name)[up_to].tobytes() == rows[up_to].tobytes(), name
    return compiled


RUNS = [
    *((law, "RRRRRR", False) for law in FACE_LAWS),
    ("direct_two", "RRPRRR", False),
    *((law, "RRRRRR", True) for law in FOLLOWING),
]


@pytest.mark.parametrize(("law", "types", "follows"), RUNS)
def test_both_loops_are_equal_to_the_bit(law, types, follows, rng):
    """With noise, an active speed limit, a face that is lost, and a projective model where one is taken."""
    sc, G = scene(types=types), None if LAW_SPECS[law].metric else frame(2)
    bounds = limits(speed=np.full(6, 0.4), max_steps=60, max_lost_periods=5)
    noise = 0.3 * rng.normal(size=(61, 2, 4, 2))
    noise[7:10, 0, 1] = np.nan
    run = both(sc, law, bounds, noise, G, tracked(sc, G) if follows else None)
    assert (run.full.factor < 1).any()
    assert (run.full.q[7:10] == run.full.q[7]).all()


def test_both_loops_measure_with_the_body_alike(rng):
    """Pins outside the narrow image are unseen, another is lost by noise that is no number."""
    sc = with_pins(scene())
    sc = sc._replace(plant=sc.plant._replace(image_size=np.full((2, 2), [760.0, 560.0])))
    noise = 0.3 * rng.normal(size=(41, 2, 9, 2))
    noise[5:9, 0, 1] = np.nan
    run = both(sc, "exact", limits(max_steps=40), noise, frame(2), sc.body_task(frame(2)))
    assert run.steps == 40
    views = run.log.fit[:, 2]
    assert views.max() > views[5:9].max() >= 6


BOUNDS = [
    {"image_error_px": 1e3}, {"diverged_factor": 1e-9}, {"max_steps": 1},
    {"max_steps": 25, "speed": np.full(6, 1e-6)},
    {"stop_at_joint_limit": True}, {"stop_at_border": True},
]  # fmt: skip


@pytest.mark.parametrize("bounds", BOUNDS, ids=lambda given: ", ".join(given))
def test_both_loops_end_alike(bounds):
    """The other verdicts: converged, diverged, max steps, plateau, joint limit, left image."""
    sc, _ = narrowed()
    sc = sc._replace(plant=sc.plant._replace(image_size=np.full((2, 2), [1280.0, 700.0])))
    bounds = limits(**{"max_steps": 60, **bounds})
    both(sc, "direct_three", bounds, np.zeros((bounds.max_steps + 1, 2, 4, 2)))


class Towards:
    """A law of somebody else: straight to given joints."""

    def __init__(self, q_goal, status=OK):
        self.q_goal, self.status = q_goal, status
        self.errors = np.zeros(len(ERRORS))
        self.calls = 0

    def __call__(self, s, q):
        self.calls += 1
        return self.status, 5.0 * (self.q_goal - q)


def test_a_law_of_others():
    sc = scene()
    law = Towards(sc.q_goal)
    plant = AnalyticPlant(sc.plant, sc.q_start, np.zeros((200, 2, 4, 2)))
    verdict, steps, log = run_in_python(law, plant, sc.s_star, 0.04, limits(max_steps=199))
    assert VERDICT_NAMES[verdict] == "converged"
    assert law.calls == steps + 1
    # Each step leaves 0.8 of the joint error.
    assert log.q[10] - sc.q_goal == pytest.approx(0.8**10 * (sc.q_start - sc.q_goal), abs=1e-12)


class Broken(Towards):
    def __call__(self, s, q):
        raise ZeroDivisionError("made to fail")


def test_the_plant_is_stopped_on_every_way_out(monkeypatch):
    stopped = []
    monkeypatch.setattr(AnalyticPlant, "stop", lambda self: stopped.append(True))
    sc = scene()
    for law in (Towards(sc.q_goal), Broken(sc.q_goal)):
        plant = AnalyticPlant(sc.plant, sc.q_start, np.zeros((4, 2, 4, 2)))
        try:
            run_in_python(law, plant, sc.s_star, 0.04, limits(max_steps=3))
        except ZeroDivisionError:
            stopped.append("after the failure")
    assert stopped == [True, True, "after the failure"]


def test_a_command_that_is_no_number_diverges():
    sc = scene()
    plant = AnalyticPlant(sc.plant, sc.q_start, np.zeros((4, 2, 4, 2)))
    verdict, steps, _ = run_in_python(
        Towards(np.full(6, np.nan)), plant, sc.s_star, 0.04, limits(max_steps=3)
    )
    assert (VERDICT_NAMES[verdict], steps) == ("diverged", 0)


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
    run = both(sc, law, limits(max_steps=200, **STOP), sigma * rng.normal(size=(201, 2, 4, 2)), gains=gains)
    assert run.verdict == "joint limit"
    assert (run.log.q <= sc.plant.limits.upper).all()


def unseen(gone, steps=60):
    """Noise that hides all markers at the instants ``gone``."""
    noise = np.zeros((steps + 1, 2, 4, 2))
    noise[list(gone)] = np.nan
    return noise


@pytest.mark.parametrize(
    ("gone", "waits", "verdict", "steps"),
    [
        (range(5, 9), 4, "max steps", 60),
        (range(5, 9), 3, "markers lost", 8),
        ([0, 1], 2, "max steps", 60),
        ([2, 3, 5, 6, 8, 9], 2, "max steps", 60),  # only those in a row count
        (range(58, 61), 9, "markers lost", 60),
    ],
)
def test_both_loops_wait_alike(gone, waits, verdict, steps):
    bounds = limits(max_steps=60, image_error_px=1e-12, max_lost_periods=waits, stall_periods=100)
    run = both(scene(), "direct_three", bounds, unseen(gone))
    assert (run.verdict, run.steps) == (verdict, steps)


def test_held_joints_stand_still_and_the_run_goes_on_as_it_would_have():
    sc = scene()
    bounds = limits(max_steps=60, image_error_px=1e-12, max_lost_periods=4, stall_periods=100)
    whole = Run(sc, "direct_three", bounds=bounds, noise=unseen([]))
    held = Run(sc, "direct_three", bounds=bounds, noise=unseen(range(5, 9)))
    assert (held.log.q_dot[5:9] == 0.0).all()
    for k in range(5, 9):
        np.testing.assert_array_equal(held.log.q[k + 1], held.log.q[5])
    np.testing.assert_array_equal(np.delete(held.log.q, range(5, 9), axis=0), whole.log.q[:-4])


class Bumped(AnalyticPlant):
    """Tells of a disturbance at an observation, and notes what it is sent."""

    at, sent = 0, ()

    def observe(self):
        s = super().observe()
        self.disturbance = "bumped" if self.observations - 1 == self.at else ""
        return s

    def command(self, step, period):
        self.sent += (step,)
        super().command(step, period)


def test_a_disturbance_ends_the_run_before_any_other_verdict():
    sc, ends = scene(), limits(max_steps=199, image_error_px=1e9)
    for at, verdict in ((7, "converged"), (0, "fault detected")):
        plant = Bumped(sc.plant, sc.q_start, np.zeros((200, 2, 4, 2)))
        plant.at = at
        code, steps, _ = run_in_python(Towards(sc.q_goal), plant, sc.s_star, 0.04, ends)
        assert (VERDICT_NAMES[code], steps, plant.sent) == (verdict, 0, ())
