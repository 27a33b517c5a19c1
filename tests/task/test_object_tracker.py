"""Objects that move: constant twists to the bit of the images, stated errors, events, and kinds of motion."""

import copy
import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.stats import chi2

from projservo_cli import messages
from projservo_cli.task.objects.object_bundle_adjustment import ObjectView
from projservo_cli.task.objects.object_tracker import ObjectTracker
from tests.calibration.simulated_robot import random_robot
from tests.metric.test_frame import calibrated
from tests.samples import displacement, frame, hat, pixels
from tests.task.test_displaced_object import NUMBERS, OBJECT, SCARA

PERIOD, NOISE_PX = 0.04, 0.5
MIDDLE = OBJECT[:, :3].mean(axis=0)
ACCELERATION, MOST = 50.0, 1000.0  # mm/s²
SURE = np.full((2, 8), 1e-4)


@pytest.fixture(scope="module")
def arm():
    return random_robot("RRRPRR", np.random.default_rng(20000626))


@pytest.fixture(scope="module")
def c(arm):
    """The arm calibrated exactly, in a projective frame."""
    return exact(arm, frame(1))


def exact(arm, G):
    """An exact calibration in a frame (4, 4)."""
    return dataclasses.replace(calibrated(arm, G), view=("left", "right"))


def metric_of(arm, c):
    return c.metric(np.linalg.norm(arm.markers[1] - arm.markers[0]), (0, 10))


def noisy(s, rng, std=NOISE_PX):
    return s + std * rng.standard_normal(s.shape)


def seen_at(arm, path, times):
    """Images (V, k, 2) of an object on a path, each view at its time."""
    each = [pixels(arm.cameras[v : v + 1], OBJECT @ path(t).T)[0] for v, t in enumerate(times)]
    return np.array(each)


def tracker_of(arm, c, path, sigma=SURE, noise=None, **limits):
    """A tracker whose looks are exact, or of a noise (2, V, k, 2)."""
    looks = [seen_at(arm, lambda t, T=T: T, (0.0, 0.0)) for T in (np.eye(4), path(0.0))]
    noise = np.zeros((2, 2, 8, 2)) if noise is None else noise
    given = [ObjectView(s + by, sigma) for s, by in zip(looks, noise, strict=True)]
    metric = metric_of(arm, c) if limits.pop("metric", True) else None
    most = {"acceleration": ACCELERATION, "max_acceleration": MOST, "name": "part"} | limits
    return ObjectTracker.of(c, NUMBERS, given, metric=metric, **most)


def turning(axis, at, rate, start):
    """A path about an axis, or along it with at of None, by rad/s or m/s."""
    axis = np.array(axis) / np.linalg.norm(axis)
    twist = hat([0.0] * 3, axis) if at is None else hat(axis, np.cross(at, axis))
    return lambda t: expm(rate * t * twist) @ start


START = displacement([0.2, -0.1, 0.1], [0.02, -0.03, 0.04])
BELT = turning([1.0, 0.3, -0.2], None, 0.05, START)
TABLE = turning([0.1, 1.0, 0.2], np.add(MIDDLE, [0.2, 0.0, 0.05]), math.radians(10.0), START)
STILL = turning([1.0, 0.0, 0.0], None, 0.0, START)


def SCREW(t):
    return expm(t * hat([0.1, 0.2, -0.1], [0.03, -0.02, 0.05])) @ START


def SWINGING(t):
    """All six coordinates by themselves."""
    by = np.sin(2.0 * t + np.arange(6.0)) * [0.1, 0.12, 0.08, 0.02, 0.025, 0.02]
    return expm(hat(by[:3], by[3:])) @ START


def followed(tracker, arm, path, frames, rng=None, std=NOISE_PX, ago=(0.0, 0.0), spoil=None, sigma=None):
    """Motions at the end of each period, and what is said of them."""
    said = []
    for i in range(frames):
        t = i * PERIOD - np.array(ago)
        s = seen_at(arm, path, t)
        s = s if rng is None else noisy(s, rng, std)
        tracker.observe(t, s if spoil is None else spoil(i, s), sigma)
        said.append((tracker.at(i * PERIOD), tracker.covered, tracker.pushed, tracker.unseen_s(i * PERIOD)))
    return said


def off_mm(arm, motion, path, seed=1):
    """Distance of the middle of the object from where it is, mm."""
    G = frame(seed)
    apart = (np.linalg.inv(G) @ motion.D @ G - path(motion.t)) @ np.append(MIDDLE, 1.0)
    return 1e3 * float(np.linalg.norm(apart[:3]))


@pytest.mark.parametrize("path", [BELT, TABLE, SCREW], ids=["belt", "table", "screw"])
def test_a_delay_that_is_not_known_moves_the_object_along_its_velocity_and_is_stated(path, arm, c):
    """Images are 5 ms older than is said, and known to that."""
    late, trackers = 0.005, [tracker_of(arm, c, path) for _ in range(2)]
    for i in range(12):
        s = seen_at(arm, path, np.full(2, i * PERIOD - late))
        trackers[0].observe(np.full(2, i * PERIOD), s, SURE)
        trackers[1].observe(np.full(2, i * PERIOD), s, SURE, sigma_t=np.full(2, late))
    now, told = (tracker.at(11 * PERIOD) for tracker in trackers)
    np.testing.assert_array_equal(told.D, now.D)
    G = frame(1)
    assert pytest.approx(G @ path(now.t - late) @ np.linalg.inv(G), abs=1e-6) == now.D
    by_late = told.covariance - now.covariance
    np.testing.assert_allclose(by_late, late**2 * np.outer(now.rates, now.rates), atol=1e-15)


@pytest.mark.parametrize("ago", [(0.0, 0.0), (0.0, 0.002), (0.012, 0.0)], ids=str)
@pytest.mark.parametrize("path", [STILL, BELT, TABLE, SCREW], ids=["still", "belt", "table", "screw"])
def test_a_constant_twist_is_tracked_exactly(path, ago, arm, c):
    """To 1e-6 of the place, of speeds, and of where it will be, from exact images at their own times."""
    tracker, G = tracker_of(arm, c, path), frame(1)
    followed(tracker, arm, path, 12, ago=ago, sigma=SURE)
    for ahead in (0.0, 0.4):
        motion = tracker.at(11 * PERIOD + ahead)
        assert pytest.approx(G @ path(motion.t) @ np.linalg.inv(G), abs=1e-6) == motion.D
        by_rates = motion.D @ expm(1e-3 * np.tensordot(motion.rates, motion.E, 1))
        assert pytest.approx(tracker.at(motion.t + 1e-3).D, abs=1e-12) == by_rates
    v = 1e3 * np.linalg.norm((path(1e-5) - path(-1e-5)) @ np.append(MIDDLE, 1.0)) / 2e-5
    assert tracker.at(0.44).speed_mm_s == pytest.approx(v, abs=1e-3)
    a, b = (seen_at(arm, path, (t, t)) for t in (0.44 - 1e-4, 0.44 + 1e-4))
    px = np.sqrt(np.square(b - a).sum(axis=-1).mean()) / 2e-4
    assert tracker.at(0.44).speed_px_s == pytest.approx(px, rel=0.05, abs=1e-3)
    assert (tracker.covered, tracker.pushed) == (None, None)


def test_joints_without_a_metric_are_tracked_by_twelve_coordinates():
    c, G = exact(SCARA, frame(1)), frame(1)
    tracker = tracker_of(SCARA, c, TABLE, metric=False, acceleration=50.0, max_acceleration=5000.0)
    followed(tracker, SCARA, TABLE, 30, sigma=SURE)
    motion = tracker.at(1.3)
    assert pytest.approx(G @ TABLE(1.3) @ np.linalg.inv(G), abs=1e-6) == motion.D
    assert (motion.covariance.shape, math.isnan(motion.speed_mm_s)) == ((12, 12), True)
    assert tracker.kind.name == "turntable"
    back = np.linalg.inv(G) @ tracker.kind.operator @ G
    assert pytest.approx(expm(0.3 * hat([0, 0, 0], [0, 0, 0]) + 0.3 * back), abs=1e-5) == TABLE(
        0.3 / math.radians(10.0)
    ) @ np.linalg.inv(START)


@pytest.mark.parametrize("seed", range(5))
def test_twelve_coordinates_stay_at_the_images_under_noise(seed):
    """In 80 frames at 0.5 px, from looks of as much noise: its images are within 1 px of the true ones."""
    c, rng = exact(SCARA, frame(1)), np.random.default_rng(seed)
    noise = NOISE_PX * rng.standard_normal((2, 2, 8, 2))
    tracker = tracker_of(SCARA, c, BELT, sigma=None, noise=noise, metric=False, acceleration=20.0)
    motion, _, pushed, _ = followed(tracker, SCARA, BELT, 80, rng)[-1]
    s = pixels(SCARA.cameras @ np.linalg.inv(frame(1)), tracker.M @ motion.D.T)
    off = s - pixels(SCARA.cameras, OBJECT @ BELT(motion.t).T)
    assert np.sqrt(np.square(off).sum(axis=-1).mean()) < 1.0
    assert pushed is None


def errors_of(motion, path, G, rates):
    """Errors (2 g,) of displacement and rates against a path of rates (g,) of its own."""
    apart = np.linalg.solve(motion.D, G @ path(motion.t) @ np.linalg.inv(G)) - np.eye(4)
    by = motion.E.reshape(len(motion.E), -1).T
    return np.concatenate([np.linalg.lstsq(by, apart.ravel())[0], rates - motion.rates])


@pytest.mark.parametrize("exact_shape", [True, False])
def test_errors_are_as_stated(exact_shape, arm, c, rng):
    """Squares of errors over covariances, of all draws, are within the 0.1 % of their χ² on either side.

    Accelerations are as they are assumed to be, in eight steps a period.
    """
    G, draws, squares = frame(1), 60 if exact_shape else 20, []
    sure = tracker_of(arm, c, START_ONLY)
    std = sure._acceleration * math.sqrt(0.1 * PERIOD)
    for _ in range(draws):
        if exact_shape:
            tracker = copy.deepcopy(sure)
        else:
            noise = NOISE_PX * rng.standard_normal((2, 2, 8, 2))
            tracker = tracker_of(arm, c, START_ONLY, sigma=None, noise=noise)
        E = np.linalg.inv(G) @ tracker.at(0.0).E @ G
        T, rates = START.copy(), np.array([0.03, -0.02, 0.02, 0.1, 0.05, -0.1])
        for i in range(20):
            for _ in range(8 if i else 0):
                rates = rates + std / math.sqrt(8.0) * rng.standard_normal(6)
                T = T @ expm(PERIOD / 8.0 * np.tensordot(rates, E, 1))
            t = np.full(2, i * PERIOD)
            tracker.observe(t, noisy(pixels(arm.cameras, OBJECT @ T.T), rng))
        motion = tracker.at(t[0])
        error = errors_of(motion, lambda _, T=T: T, G, rates)
        covariance = motion.by_images + motion.by_calibration @ motion.by_calibration.T
        squares.append(error @ np.linalg.solve(covariance, error))
    low, high = chi2(12 * draws).ppf([1e-3, 1.0 - 1e-3])
    assert low < sum(squares) < high


def START_ONLY(t):
    return START


def test_noise_is_as_residuals_scatter_where_none_is_given(arm, c):
    """Errors are stated within 15 % of those with the true deviation, by 25 frames of 26 residuals."""
    stated = []
    for sigma in (None, np.full((2, 8), 0.1)):
        tracker = tracker_of(arm, c, BELT)
        followed(tracker, arm, BELT, 130, np.random.default_rng(5), std=0.1, sigma=sigma)
        stated.append(np.sqrt(np.diag(tracker.at(5.2).by_images)))
    assert stated[0] == pytest.approx(stated[1], rel=0.15)


def test_it_is_found_where_it_went_after_the_last_look(arm, c, rng):
    """By 150 mm and 40°, in the first frame."""
    tracker = tracker_of(arm, c, BELT)
    away = displacement([0.5, -0.4, 0.3], [0.1, 0.08, -0.08]) @ START
    tracker.observe(np.zeros(2), noisy(pixels(arm.cameras, OBJECT @ away.T), rng))
    assert tracker.covered is None
    assert off_mm(arm, tracker.at(0.0), lambda t: away) < 5.0


def covering(kind, rng, first=20, last=40):
    """Images in which a hand is over the first camera: corners hidden, drawn aside, all shifted or none."""

    def spoil(i, s):
        if first <= i < last:
            s = s.copy()
            if kind == "some":
                s[0, :5] = math.nan
            elif kind == "aside":
                s[0, :3] += 6.0 * rng.standard_normal((3, 2))
            elif kind == "shifted":
                s[0] += [8.0, 5.0]
            else:
                s[0] = math.nan
        return s

    return spoil


@pytest.mark.parametrize("kind", ["some", "aside", "shifted", "all"])
def test_a_hand_over_one_camera_is_left_out(kind, arm, c, rng):
    tracker = tracker_of(arm, c, BELT)
    said = followed(tracker, arm, BELT, 60, rng, spoil=covering(kind, rng))
    covered = [i for i, (_, covered, *_) in enumerate(said) if covered is not None]
    expected = list(range(20, 40)) if kind in ("aside", "shifted") else []
    assert [i for i in covered if i in expected] == expected
    assert len(covered) <= len(expected) + 3  # the view is taken again as soon as it is alike
    assert all(said[i][1].subject.views == ("left",) for i in expected)
    assert all(pushed is None and unseen == 0.0 for _, _, pushed, unseen in said)
    assert max(off_mm(arm, motion, BELT) for motion, *_ in said[5:]) < 10.0
    assert off_mm(arm, said[-1][0], BELT) < 2.0  # of a stated deviation of 0.8


def pushing(axis):
    """A path that a push across that of a belt by 30 mm within 80 ms interrupts."""

    def path(t):
        by = np.eye(4)
        by[:3, 3] = 0.03 * np.clip((t - 1.0) / 0.08, 0.0, 1.0) * axis
        return by @ BELT(t)

    return path


@pytest.mark.parametrize("axis", np.eye(3), ids=["across", "up", "deep"])
def test_a_push_is_found(axis, arm, c, rng):
    """In any direction: the speed changes by 9 times what 1 m/s² does in 40 ms."""
    pushed = pushing(axis)
    tracker = tracker_of(arm, c, BELT)
    said = followed(tracker, arm, pushed, 50, rng)
    first = next(i for i, (*_, found, _) in enumerate(said) if found is not None)
    assert 25 < first <= 28
    one = said[-1][2]
    assert (one.code, one.subject.name, one.unit) == ("pushed_object", "part", "m")
    assert one.amount > one.limit >= 0.5 * 1e-3 * MOST * (2 * PERIOD) ** 2 - 1e-12
    assert "part" in messages.sentence(one)
    assert off_mm(arm, said[-1][0], pushed) < 1.5


def test_a_push_is_found_by_cameras_that_take_turns(arm, c, rng):
    """Each takes an image every 40 ms, the other one between; without a push none is found."""

    def taking_turns(i, s):
        s[i % 2] = math.nan
        return s

    for path in (BELT, pushing(np.array([1.0, 0.0, 0.0]))):
        tracker = tracker_of(arm, c, path)
        for i in range(80):
            t = np.full(2, 0.5 * PERIOD * i)
            tracker.observe(t, taking_turns(i, noisy(seen_at(arm, path, t), rng)))
        assert (tracker.pushed is not None) == (path is not BELT)
        assert tracker.covered is None
        assert off_mm(arm, tracker.at(t[0]), path) < 3.0


def course(speed, at, lasting, to):
    """Distance over time of a belt whose speed changes once, evenly, m."""

    def distance(t):
        during = np.clip(t - at, 0.0, lasting)
        after = max(t - at - lasting, 0.0)
        return speed * min(t, at) + speed * during + (to - speed) * during**2 / (2 * lasting) + to * after

    return distance


EVENTS = {
    "stop": (course(0.1, 1.6, 0.1, 0.0), ()),
    "reversal": (course(0.05, 1.6, 0.1, -0.05), ()),
    "hidden": (course(0.1, 9.0, 0.1, 0.0), range(40, 53)),
    "hidden stop": (course(0.05, 1.7, 0.1, 0.0), range(40, 53)),
}


@pytest.mark.parametrize(("distance", "unseen"), EVENTS.values(), ids=EVENTS)
def test_it_is_back_after_sudden_changes(distance, unseen, arm, c, rng):
    """Within twice its rms from 1.2 s after on, at the point where laws lead it, 0.4 s ahead; no push."""

    def path(t):
        by = np.eye(4)
        by[:3, 3] = distance(t) * np.array([0.9, 0.3, 0.3])
        return by @ START

    def spoil(i, s):
        return np.full_like(s, math.nan) if i in unseen else s

    tracker, led = tracker_of(arm, c, path), []
    said = []
    for i in range(110):
        t = np.full(2, i * PERIOD)
        tracker.observe(t, spoil(i, noisy(seen_at(arm, path, t), rng)))
        said.append((tracker.unseen_s(t[0]), tracker.pushed))
        led.append(off_mm(arm, tracker.at(t[0] + 0.4), path))
    assert [seconds for seconds, _ in said if seconds > 0.0] == pytest.approx(
        [PERIOD * (k + 1) for k in range(len(unseen))]
    )
    assert said[-1][1] is None
    before, after = np.array(led[15:29]), np.array(led[42 + 30 :] if not unseen else led[53 + 30 :])
    assert np.sqrt(np.mean(after**2)) < 2.0 * np.sqrt(np.mean(before**2))


@pytest.mark.parametrize(
    ("path", "kind"),
    [(STILL, "still"), (BELT, "belt"), (TABLE, "turntable"), (SWINGING, "free")],
    ids=["still", "belt", "turntable", "free"],
)
def test_kinds_of_motion_are_told(path, kind, arm, c):
    """In 3 draws of 3, with the direction or the axis to 3°."""
    for seed in range(3):
        tracker = tracker_of(arm, c, path)
        assert tracker.kind.name == "still"
        followed(tracker, arm, path, 60, np.random.default_rng(seed))
        found = tracker.kind
        assert found.name == kind
        if kind in ("belt", "turntable"):
            X = np.linalg.inv(frame(1)) @ found.operator @ frame(1)
            true = path(1.0) @ np.linalg.inv(path(0.0))
            given = true[:3, 3] if kind == "belt" else np.array([0.1, 1.0, 0.2])
            own = X[:3, 3] if kind == "belt" else np.array([X[2, 1], X[0, 2], X[1, 0]])
            cosine = own @ given / np.linalg.norm(own) / np.linalg.norm(given)
            assert cosine > math.cos(math.radians(3.0))


def test_images_of_no_view_and_frames_again_change_nothing(arm, c):
    tracker = tracker_of(arm, c, BELT)
    followed(tracker, arm, BELT, 10, sigma=SURE)
    before = tracker.at(0.5).D
    tracker.observe(np.full(2, 0.36), seen_at(arm, BELT, (0.9, 0.9)), SURE)
    tracker.observe(np.full(2, math.nan), seen_at(arm, BELT, (0.9, 0.9)), SURE)
    tracker.observe(np.full(2, 0.4), np.full((2, 8, 2), math.nan), SURE)
    assert np.array_equal(tracker.at(0.5).D, before)
    assert tracker.unseen_s(0.5) == pytest.approx(0.14)


@settings(max_examples=10, deadline=None)
@given(
    turn=st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    by=st.tuples(*[st.floats(-0.1, 0.1)] * 3),
    ago=st.tuples(st.floats(0.0, 0.02), st.floats(0.0, 0.02)),
)
def test_any_constant_twist_is_tracked_whatever_the_frame(turn, by, ago):
    """Predictions map with a change of the projective frame, and are exact."""
    arm = random_robot("RRRPRR", np.random.default_rng(20000626))
    for G in (np.eye(4), frame(2)):
        tracker = tracker_of(arm, exact(arm, G), START_ONLY)

        def path(t):
            return expm(t * hat(turn, by)) @ START

        followed(tracker, arm, path, 6, ago=ago, sigma=SURE)
        predicted = np.linalg.inv(G) @ tracker.at(0.4).D @ G
        assert predicted == pytest.approx(path(0.4), abs=1e-4)


@pytest.mark.parametrize("twelve", [False, True])
def test_wild_images_leave_it_with_numbers(twelve, arm, c):
    """Jumps, noise of 100 px, hidden corners and times that are missing, in 12 runs."""
    robot = SCARA if twelve else arm
    start = tracker_of(robot, exact(SCARA, frame(1)) if twelve else c, START_ONLY, metric=not twelve)
    for seed in range(12):
        rng, tracker, T = np.random.default_rng(seed), copy.deepcopy(start), START
        for i in range(20):
            turn, by = rng.choice([0.0, 0.01, 0.3]), rng.choice([0.0, 0.002, 0.05])
            T = T @ displacement(turn * rng.standard_normal(3), by * rng.standard_normal(3))
            s = noisy(pixels(robot.cameras, OBJECT @ T.T), rng, rng.choice([0.0, 0.5, 5.0, 100.0]))
            s[rng.uniform(size=(2, 8)) < rng.choice([0.0, 0.3, 0.9])] = math.nan
            t = i * PERIOD - rng.uniform(0.0, 0.05, 2)
            t[0] = math.nan if rng.uniform() < 0.1 else t[0]
            tracker.observe(t, s, None if rng.uniform() < 0.5 else np.full((2, 8), 0.3))
            motion = tracker.at(i * PERIOD + 0.4)
            assert np.isfinite(motion.D).all()
            assert np.isfinite(motion.covariance).all()
        assert tracker.kind.name in ("still", "belt", "turntable", "free")
