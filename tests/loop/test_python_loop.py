"""The loop in Python equals the compiled loop to the bit, and takes laws of others."""

import numpy as np
import pytest

from projservo_cli.control.law import ERRORS, OK
from projservo_cli.laws import CODES, LAWS
from projservo_cli.loop.python import BuiltInLaw, run_in_python
from projservo_cli.loop.verdicts import VERDICTS
from projservo_cli.simulation.analytic_plant import AnalyticPlant
from tests.control.following import Followed, tracked
from tests.loop.bits import FOLLOWING
from tests.samples import frame
from tests.scene import GAINS, STEP, Run, limits, scene, with_pins

SPEED = np.full(6, 0.5)


def in_python(sc, law, bounds, noise, G=None, task=None, gains=GAINS):
    plant = AnalyticPlant(sc.plant, sc.q_start, noise)
    task = sc.task(G) if task is None else task
    built_in = BuiltInLaw(
        CODES[law], sc.seen(G), task, gains._replace(limits=gains.limits._replace(speed=bounds.speed))
    )
    return run_in_python(built_in, plant, sc.s_star, GAINS.period, bounds)


def same(left, right):
    """Equal to the bit, unknown values included."""
    return left.tobytes() == right.tobytes()


@pytest.mark.parametrize(
    ("law", "types"), [*((law, "RRRRRR") for law in LAWS), ("direct_two", "RRPRRR"), ("stacked", "RRPRRR")]
)
def test_both_loops_are_equal_to_the_bit(law, types, rng):
    """With noise, a speed limit that is active, and a projective model for the laws that take one."""
    G = None if law == "euclidean_points" else frame(2)
    bounds = limits(speed=SPEED, max_steps=40)
    noise = 0.3 * rng.normal(size=(41, 2, 4, 2))
    sc = scene(types=types)
    compiled = Run(sc, law, bounds=bounds, noise=noise, G=G)
    verdict, steps, log = in_python(sc, law, bounds, noise, G)
    assert (VERDICTS[verdict], steps) == (compiled.verdict, compiled.steps)
    assert (compiled.full.factor < 1).any()
    same_logs(log, compiled.full, steps)


@pytest.mark.parametrize("law", FOLLOWING)
def test_both_loops_follow_a_plan_alike(law, rng):
    """With noise, a joint-speed limit that is active, and periods in which the face is lost."""
    sc, G = scene(), frame(2)
    bounds = limits(speed=np.full(6, 0.4), max_steps=60, max_lost_periods=5)
    noise = 0.3 * rng.normal(size=(61, 2, 4, 2))
    noise[7:10, 0, 1] = np.nan
    compiled = Followed(sc, law, G, bounds=bounds, noise=noise)
    verdict, steps, log = in_python(sc, law, bounds, noise, G, tracked(sc, G, compiled.plan))
    assert (VERDICTS[verdict], steps) == (compiled.verdict, compiled.steps)
    assert (compiled.full.factor < 1).any()
    assert (compiled.full.q[7:10] == compiled.full.q[7]).all()
    same_logs(log, compiled.full, steps)


def test_both_loops_measure_with_the_body_alike(rng):
    """Pins outside the narrow image are unseen, another is lost by noise that is no number."""
    sc = with_pins(scene())
    sc = sc._replace(plant=sc.plant._replace(image_size=np.full((2, 2), [760.0, 560.0])))
    noise = 0.3 * rng.normal(size=(41, 2, 9, 2))
    noise[5:9, 0, 1] = np.nan
    bounds = limits(max_steps=40)
    task = sc.body_task(frame(2))
    compiled = Run(sc, "exact", bounds=bounds, noise=noise, G=frame(2), task=task)
    verdict, steps, log = in_python(sc, "exact", bounds, noise, frame(2), task)
    assert (VERDICTS[verdict], steps) == (compiled.verdict, compiled.steps)
    assert compiled.steps == 40
    views = compiled.log.fit[:, 2]
    assert views.max() > views[5:9].max() >= 6
    same_logs(log, compiled.full, steps)


def same_logs(left, right, steps):
    """Equal to the bit up to the last instant."""
    for name, rows in right._asdict().items():
        if name in ("M", "scratch"):  # workspaces of the compiled loop
            continue
        up_to = slice(None) if name == "events" else slice(steps + 1)
        assert same(getattr(left, name)[up_to], rows[up_to]), name


BOUNDS = [
    {"image_error_px": 1e3}, {"diverged_factor": 1e-9}, {"max_steps": 1},
    {"max_steps": 25, "speed": np.full(6, 1e-6)},
    {"stop_at_joint_limit": True}, {"stop_at_border": True},
]  # fmt: skip


@pytest.mark.parametrize("bounds", BOUNDS, ids=lambda given: ", ".join(given))
def test_both_loops_end_alike(bounds):
    """The other verdicts: converged, diverged, max steps, plateau, joint limit, left image."""
    sc = scene()
    upper = sc.plant.limits.upper.copy()
    upper[2] = sc.q_start[2] + 0.5 * STEP[2]
    sc = sc._replace(
        plant=sc.plant._replace(
            limits=sc.plant.limits._replace(upper=upper), image_size=np.full((2, 2), [1280.0, 700.0])
        )
    )
    bounds = limits(**{"max_steps": 60, **bounds})
    noise = np.zeros((bounds.max_steps + 1, 2, 4, 2))
    compiled = Run(sc, "direct_three", bounds=bounds, noise=noise)
    verdict, steps, log = in_python(sc, "direct_three", bounds, noise)
    assert (VERDICTS[verdict], steps) == (compiled.verdict, compiled.steps)
    assert same(log.events, compiled.log.events)


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
    assert VERDICTS[verdict] == "converged"
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
    assert (VERDICTS[verdict], steps) == ("diverged", 0)
