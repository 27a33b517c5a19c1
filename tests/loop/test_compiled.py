"""Whole closed loops: every verdict reached by a case made for it, and what the log says of it."""

import math

import numpy as np
import pytest
from numba import typeof

from projservo_cli.control import make_law
from projservo_cli.control.law import ERRORS, Law, State, new_state, reset
from projservo_cli.laws import CODES
from projservo_cli.loop.compiled_loop import Course, run_compiled
from projservo_cli.loop.jit_warmup import calls
from projservo_cli.loop.run_metrics import SUBSAMPLES, Ended, path_deviation, summarize
from projservo_cli.loop.verdicts import CONVERGED, MAX_STEPS, Log, new_log
from projservo_cli.simulation.analytic_plant import Ends, Plant
from tests.known import configured, known_scenario
from tests.samples import poe
from tests.scene import FACE_LAWS, GAINS, STEP, Run, limits, scene


def test_log_describes_the_run_it_belongs_to():
    """Joints integrate the commands, poses are those of the joints, pixels those of the poses."""
    sc = scene()
    run = Run(sc, "direct_three")
    log = run.log
    assert run.verdict == "converged"
    assert log.q[0] == pytest.approx(sc.q_start, abs=0)
    assert np.diff(log.q, axis=0) == pytest.approx(GAINS.period * log.q_dot[:-1], abs=1e-15)
    for k in (0, 3, run.steps):
        assert log.H[k] == pytest.approx(poe(sc.model, log.q[k]), abs=1e-12)
        assert log.s[k] == pytest.approx(sc.images(log.q[k]), abs=1e-9)
        rms = math.sqrt(np.sum((log.s[k] - sc.s_star) ** 2) / 8)
        assert log.error[k] == pytest.approx(rms, rel=1e-12)
    assert log.error[-1] <= 1e-3 < log.error[-2]
    assert not log.q_dot[-1].any()
    assert (log.events == -1).all()
    # Beyond its last instant the log is untouched.
    assert not run.full.s[run.steps + 1 :].any()


@pytest.mark.parametrize("law", ["stacked", "exact"])
def test_arrays_that_another_run_left_are_as_good_as_new(law, rng):
    """Whatever log and state hold, a run is the same to the bit, and so is what it tells of itself."""
    sc, bounds = scene(), limits(max_steps=30)
    noise = 0.3 * rng.normal(size=(31, 2, 4, 2))
    noise[4:6] = math.nan  # rows of lost markers have no errors
    fresh = Run(sc, law, bounds=bounds._replace(max_lost_periods=5), noise=noise)
    used = Run(sc, law, bounds=bounds, noise=7.0 * rng.normal(size=noise.shape))
    reset(used.state)
    built_in = make_law(
        CODES[law], sc.model, sc.task(None), GAINS._replace(limits=GAINS.limits._replace(speed=bounds.speed))
    )
    course = Course(sc.plant, bounds._replace(max_lost_periods=5), sc.q_start.copy())
    verdict, steps = run_compiled(built_in, course, noise, used.state, used.full)
    assert (verdict, steps) == (fresh.code, fresh.steps)
    for name, rows in fresh.log._asdict().items():
        if name not in ("M", "scratch", "path"):
            again = getattr(used.full, name)
            assert again[: len(rows)].tobytes() == rows.tobytes(), name
    assert used.state.limited[0] == fresh.state.limited[0]


@pytest.mark.parametrize("law", FACE_LAWS)
def test_at_the_goal_and_next_to_it_a_run_converges(law):
    """Without a command, and after steps of 1e-9 rad: errors of 1e-6 px, directions next to nothing."""
    run = Run(scene(np.zeros(6)), law)
    assert (run.verdict, run.steps) == ("converged", 0)
    assert run.log.error.max() < 1e-12  # px, round-off of the joints
    run = Run(scene(1e-7 * STEP), law, bounds=limits(image_error_px=1e-8))
    assert run.verdict == "converged"
    assert run.steps < 120


def test_occlusion_begins_where_the_plane_passes_the_optical_center():
    """A law that turns the face away: hidden exactly while the true plane has the camera behind it."""
    sc = scene()
    run = Run(sc, "stacked")
    assert run.log.hidden.any()
    assert not run.log.hidden.all()
    for H, hidden in zip(run.log.H, run.log.hidden, strict=True):
        M = (sc.plant.M @ H.T)[:, :3]
        normal = np.cross(M[1] - M[0], M[2] - M[0])
        towards = [normal @ (O[:3] - M[0]) for O in sc.plant.O]
        start = np.cross(*(sc.plant.M[i, :3] - sc.plant.M[0, :3] for i in (1, 2)))
        sign = [np.sign(start @ (O[:3] - sc.plant.M[0, :3])) for O in sc.plant.O]
        assert [t * s <= 0 for t, s in zip(towards, sign, strict=True)] == (hidden > 0).tolist()
    opaque = Run(scene(opaque=True), "stacked")
    assert opaque.verdict == "markers lost"
    assert opaque.steps == int(np.argmax(run.log.hidden.any(axis=1)))


def test_deviation_from_the_line():
    """Against the joints interpolated in plain NumPy, at the samples and between."""
    sc = scene()
    run = Run(sc, "direct_three", bounds=limits(max_steps=5))
    A_c = sc.plant.M.mean(axis=0)
    start, goal = (poe(sc.model, q) @ A_c for q in (sc.q_start, sc.q_goal))
    between = path_deviation(sc.plant, run.log, run.steps, GAINS.period, start, goal)
    ends = Ends(np.eye(4), np.eye(4), goal)
    told = summarize(sc.plant, run.log, Ended(run.code, run.steps, 0.0), GAINS.period, ends)
    length, at_samples = 1e-3 * told.path_length_mm, 1e-3 * told.center_deviation_at_samples_mm
    way = (goal - start)[:3] / np.linalg.norm((goal - start)[:3])

    def distance(q):
        off = (poe(sc.model, q) @ A_c - start)[:3]
        return np.linalg.norm(off - (off @ way) * way)

    steps = [
        run.log.q[k] + t / SUBSAMPLES * (run.log.q[k + 1] - run.log.q[k])
        for k in range(5)
        for t in range(SUBSAMPLES + 1)
    ]
    assert between == pytest.approx(max(distance(q) for q in steps), abs=1e-12)
    assert at_samples == pytest.approx(max(distance(q) for q in run.log.q), abs=1e-12)
    assert between >= at_samples > 1e-4
    assert length == pytest.approx(np.linalg.norm(np.diff(run.center, axis=0), axis=1).sum(), rel=1e-12)


def test_success_is_told_of_the_truth(rng):
    """At every instant: what is measured may lie outside, true images and joints may not."""
    sc = scene()
    run = Run(sc, "direct_three")
    ends = Ends(np.eye(4), np.eye(4), np.full(4, np.nan))

    def success(verdict=CONVERGED, log=run.log, **plant):
        ended = Ended(verdict, run.steps, 0.0)
        return summarize(sc.plant._replace(**plant), log, ended, GAINS.period, ends).success

    assert run.code == CONVERGED
    assert success() == 1.0
    assert success(MAX_STEPS) == 0.0
    seen = np.array([sc.images(q) for q in run.log.q])
    noisy = run.log._replace(s=run.log.s + 3.0 * rng.normal(size=run.log.s.shape))
    for axis in range(2):
        size, border = sc.plant.image_size.copy(), seen[..., axis].max() + 0.5
        for beside, wanted in ((1e-6, 1.0), (-1e-6, 0.0)):
            size[:, axis] = border + beside
            assert success(image_size=size, log=noisy) == wanted
    q = run.log.q[:, 3]
    for limit, least, sign in (("lower", q.min(), 1.0), ("upper", -q.max(), -1.0)):
        for beside, wanted in ((0.0, 1.0), (1e-6, 0.0)):
            bound = getattr(sc.plant.limits, limit).copy()
            bound[3] = sign * (least + beside)
            assert success(limits=sc.plant.limits._replace(**{limit: bound})) == wanted
    hidden = run.log.hidden.copy()
    hidden[run.steps // 2, 1] = 1.0
    assert success(log=run.log._replace(hidden=hidden)) == 0.0


def test_records_are_of_the_types_of_a_run():
    scenario = known_scenario(configured("paper"))
    real = {
        Law: make_law(0, scenario.world.model, scenario.ends.task(scenario.world.model), scenario.gains),
        Course: Course(scenario.plant_of("exact"), scenario.termination, scenario.exact.q_start),
        Plant: scenario.plant_of("exact"),
        State: new_state(6, scenario.world.m),
        Log: new_log(6, scenario.world.m, 3, len(ERRORS)),
        Ends: scenario.true_ends,
    }
    met = set()
    for _, arguments in calls():
        for argument in arguments:
            if type(argument) in real:
                assert typeof(argument) == typeof(real[type(argument)])
                met.add(type(argument))
    assert met == set(real)
