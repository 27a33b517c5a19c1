"""Robots with one camera to three, of any names in any order: read, recorded, calibrated and taught."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from projservo_cli import Observations, calibrate, plan, record, servo
from projservo_cli.config import load_config
from projservo_cli.config.inputs import calibration_inputs, teach_inputs
from projservo_cli.records import VIEWS, InputError, JointLimits, WorkFailed
from projservo_cli.robots.contract import Bounds, PluginRobot, Reading, at_rest_after
from projservo_cli.robots.latency_compensation import DrivenRobot
from projservo_cli.robots.latency_estimation import DelayPrior, Delays
from projservo_cli.robots.standstill import Standstill, averaged
from projservo_cli.settings.cameras import Cameras
from projservo_cli.settings.task import GoalImages
from projservo_cli.stages.calibrate import recorded
from projservo_cli.stages.teach import teach
from projservo_cli.store.observation_tables import mount_in, read_table
from tests.calibration.simulated_robot import NAMES, around, random_robot
from tests.hardware.still import Quiet
from tests.robots.test_pacing import looks, predicted

POSES = {"frames_per_joint": 4, "random_poses": 12}
RIGS = [("top",), ("right",), VIEWS, ("right", "left"), ("left", "right", "top"), ("top", "left", "right")]
LIMITS = JointLimits(np.full(4, -4.0), np.full(4, 4.0), np.full(4, 30.0), np.full(4, math.inf))
BOUNDS = Bounds(LIMITS, np.ones(4), 0.04, 0.1, np.full(4, 0.01))
NOISE_PX = 0.2
USED = {"view": VIEWS}  # names of the cameras of a robot that is made by its name


class Rig(Quiet):
    """An arm that stands where it is sent, before cameras of some names; its time passes in commands.

    by_name : whether ``read`` gives a mapping. ``lost``: names that are missing in it.
    """

    def __init__(self, view=None, by_name=True, stamped=True):
        self.rng = np.random.default_rng(7)
        self.truth_of = random_robot("RRRR", np.random.default_rng(4), markers=8, views=3)
        self.view, self.by_name, self.stamped = view or USED["view"], by_name, stamped
        self.lost, self.time = (), 0.0
        self.q = self.truth_of.q_reference.copy()

    def images(self):
        """Exact pixels (m, 2) by name."""
        return dict(zip(NAMES, self.truth_of.images(self.q[None])[0], strict=False))

    def now(self):
        return self.time

    def command(self, target, speed, due):
        self.q, self.time = target.copy(), due

    def read(self):
        exact = self.images()
        seen = {name: exact[name] + NOISE_PX * self.rng.standard_normal((8, 2)) for name in self.view}
        if not self.by_name:
            return self.q, np.array([*seen.values()]), self.time, *(self.time for _ in self.view), None
        given = {name: (s, self.time) if self.stamped else s for name, s in seen.items()}
        return self.q, {name: one for name, one in given.items() if name not in self.lost}, self.time


class Losing(Rig):
    """Loses its left camera, if it has one, while a law drives it."""

    def command(self, target, speed, due):
        super().command(target, speed, due)
        self.lost = ("left",) if self.time > 3.0 else ()


def opened(robot, view=None):
    return PluginRobot(robot, "plant m:C", 8, BOUNDS, 5.0, 5.0, view=view)


def vector(q):
    return {"joints": q.tolist(), "unit": "rad"}


def configuration(folder, view, stamped=True, **more):
    USED["view"], robot = view, Rig()
    values = {
        "plant": {"use": f"{__name__}:Rig", "options": {"stamped": stamped}},
        "data": {"table": "rig.csv", "image_size_px": [1280, 1024]},
        "markers": {"numbers": [*range(8)], "face": [0, 1, 2]},
        "robot": {"limits": {"joints": [[-4, 4]] * 4, "unit": "rad"}},
        "calibration": {"reference": vector(robot.q), **POSES},
        "control": {"joint_speed_limit_deg_s": 2000},
    }
    values |= more
    (folder / "rig.yaml").write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
    return load_config(folder / "rig.yaml")


@pytest.mark.parametrize("view", RIGS)
@pytest.mark.parametrize("by_name", [True, False])
def test_readings_have_the_views_that_are_asked_for_whatever_the_order_of_the_robot(view, by_name):
    wanted = view[::-1][:2]
    robot = opened(Rig(view, by_name=by_name), wanted)
    robot.robot.frames = np.array([np.full((4, 6), NAMES.index(name), np.uint8) for name in view])
    with at_rest_after(robot):
        seen, exact = robot.read(), robot.robot.images()
    assert seen.view == robot.view == wanted
    for name, s, frame in zip(wanted, seen.s, robot.frames, strict=True):
        np.testing.assert_allclose(s, exact[name], atol=6.0 * NOISE_PX)
        assert (frame == NAMES.index(name)).all()
    np.testing.assert_array_equal(seen.t_view, np.zeros(len(wanted)))


def test_a_view_that_is_lost_is_unseen_and_no_other():
    robot = opened(Rig(("left", "top", "right")))
    with at_rest_after(robot):
        before = robot.read()
        robot.robot.lost = ("top",)
        seen = robot.read()
    assert np.isnan(seen.s).all(axis=(1, 2)).tolist() == [False, True, False]
    assert np.isnan(seen.t_view).tolist() == [False, True, False]
    assert before.new_views(None) == [True] * 3


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ({"front": np.zeros((8, 2))}, r"gave a view 'front', where its cameras are left, right: name all of"),
        ({"left": np.zeros((7, 2))}, r"gave left pixels of shape \(7, 2\), expected \(8, 2\)"),
        (
            {"left": (np.ones((8, 2)), 1.0, np.ones(8)), "right": np.ones((8, 2))},
            "gave deviations of some views",
        ),
    ],
)
def test_nonsense_by_name(answer, message):
    robot = Rig()
    robot.read = lambda: (robot.q, answer)
    with pytest.raises(WorkFailed, match=message), at_rest_after(foreign := opened(robot)):
        foreign.read()


def test_fewer_cameras_than_two_that_see_are_named():
    for view, dark, told in [
        (("top",), [9], ("top",)),
        (VIEWS, [9, 0], ("left",)),
        (VIEWS, [9, 9], VIEWS),
        (NAMES[:3], [9, 0, 0], ()),
        (NAMES[:3], [9, 0, 9], ("left", "top")),
        (NAMES[:3], [9, 9, 9], NAMES[:3]),
    ]:
        driven = SimpleNamespace(robot=SimpleNamespace(view=view), _dark=np.array(dark))
        found = DrivenRobot.unseen(driven, 2)
        assert (() if found is None else found.subject.views) == told
    assert DrivenRobot.unseen(driven, 1).subject.views == NAMES[:3]


def test_a_robot_without_a_camera_of_the_calibration_is_refused():
    with pytest.raises(InputError, match=r"has the cameras left, right, and none named top"):
        opened(Rig(), ("left", "top"))
    named = Rig()
    named.view = "top"
    with pytest.raises(InputError, match=r"view is 'top': expected names"):
        opened(named)


def test_each_view_is_averaged_waited_for_and_timed_as_if_it_were_alone():
    rng = np.random.default_rng(1)
    q, s = np.zeros(2), rng.uniform(0.0, 100.0, (40, 3, 5, 2))
    s[:, 1, 2] = np.nan
    readings = [Reading(q, one, 0.1 * k, np.full(3, np.nan), None, NAMES[:3]) for k, one in enumerate(s)]
    alone = [[one._replace(s=one.s[[v]], t_view=np.full(1, np.nan)) for one in readings] for v in range(3)]
    mean, squares, count = averaged(readings[0], iter(readings[1:]).__next__, 9)
    whole, still = Standstill(0.5), [Standstill(0.5) for _ in range(3)]
    for v in range(3):
        one = averaged(alone[v][0], iter(alone[v][1:]).__next__, 9)
        np.testing.assert_array_equal(mean.s[[v]], one[0].s)
        np.testing.assert_array_equal(squares[[v]], one[1])
        np.testing.assert_array_equal(count[[v]], one[2])
    for k, reading in enumerate(readings):
        each = [still[v].all(alone[v][k]) for v in range(3)]
        assert whole.all(reading) == all(each)
    late = 0.04, 0.12
    both = looks(Delays(VIEWS, predicted, DelayPrior.unknown(2), 0.2, 1.0, np.zeros(2)), late, noise=0.0)
    for v in range(2):
        known = DelayPrior.unknown(1), 0.2, 1.0, np.zeros(2)
        one = Delays(("top",), lambda q, v=v: predicted(q)[:, [v]], *known)
        found = looks(one, late[v : v + 1], noise=0.0, views=(v,))
        np.testing.assert_allclose(found, both[:, [v]], atol=1e-12)


@pytest.mark.parametrize("view", [("right", "left", "top")])
def test_a_rig_of_any_names_is_recorded_continued_calibrated_and_driven(tmp_path, monkeypatch, view):
    monkeypatch.chdir(tmp_path)
    config, path = configuration(tmp_path, view), tmp_path / "rig.csv"
    seen = record(config, path=path, progress=False)
    assert seen.view == read_table(path, "RRRR").view == view
    header = path.read_text(encoding="utf-8").splitlines()[0].split(",")
    assert [name for name in header if name.startswith("u_")] == [f"u_{name}" for name in view]
    found = calibrate(seen, progress=False)
    assert found.usable
    truth = Rig().truth_of
    ahead = around(truth, 20, np.random.default_rng(3))
    exact = truth.images(ahead)[:, [NAMES.index(name) for name in view]]
    error = math.sqrt(np.mean((found.predict(ahead) - exact) ** 2))
    assert error < NOISE_PX, error
    start, goal = (truth.q_reference + np.array(by) for by in ([0.2, -0.2, 0.1, 0.2], [-0.2, 0.1, -0.2, 0.0]))
    ends = {"start": vector(start), "goal": {"joints": vector(goal)}}
    asked, robot = configuration(tmp_path, view, task=ends), Losing(view)
    driven = servo(asked, found, plan(asked, found), "exact", robot=robot)
    assert (driven.verdict, robot.lost) == ("converged", ("left",))
    assert np.degrees(np.abs(robot.q - goal)).max() < (0.3 if len(view) == 1 else 0.1)
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join(lines[:100]) + "\n", encoding="utf-8")
    with pytest.raises(InputError, match=rf"was begun with the cameras {', '.join(view)}, not left, right"):
        record(configuration(tmp_path, VIEWS), path=path, progress=False)
    again = record(configuration(tmp_path, view), path=path, progress=False)
    assert (again.view, len(again.at_rest.pose)) == (view, len(seen.at_rest.pose))


def test_the_mount_stands_in_the_table_and_calibrate_takes_it_from_there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = {"data": {"table": "rig.csv", "mount": "tool"}}
    seen = record(configuration(tmp_path, ("top",), **data), path="rig.csv", progress=False)
    assert seen.mount == mount_in("rig.csv") == Observations.from_frame("rig.csv").mount == "tool"
    inputs = calibration_inputs(configuration(tmp_path, ("top",)))
    assert (inputs.source.mount, recorded(inputs.source).mount) == (None, "tool")
    assert mount_in("t", "pose,mount\n1,\n") == "world"
    (tmp_path / "t").write_text("pose,mount\n1,hand\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"t:2: mount is 'hand'; expected world or tool"):
        mount_in("t")


@pytest.mark.parametrize("view", [("top",), ("top", "left", "right")])
def test_a_goal_is_taught_by_the_names_of_its_views(tmp_path, view):
    config = configuration(tmp_path, view, stamped=False)
    taught = teach(teach_inputs(config), 20)
    images = GoalImages.model_validate(yaml.safe_load(yaml.safe_dump(taught.as_goal()["images"])))
    assert sorted(images.view) == sorted(view)
    exact, other = Rig().images(), [*reversed(view)]
    pixels, sigma = images.pixels((), other), images.deviations(range(8), (), other)
    for v, name in enumerate(other):
        np.testing.assert_allclose([at[v] for at in pixels.values()], exact[name], atol=2.0 * NOISE_PX)
    assert np.median(sigma) == pytest.approx(NOISE_PX / math.sqrt(20), rel=0.3)
    assert taught.shared == 8


def test_observations_of_any_views_are_made_from_arrays():
    robot = Rig()
    q = around(robot.truth_of, 3, robot.rng)
    images = robot.truth_of.images(q)
    made = Observations.from_arrays(q, images, view=("a", "b2", "c_3"), mount="tool")
    assert (made.view, made.mount, made.images.shape) == (("a", "b2", "c_3"), "tool", images.shape)
    one = Observations.from_arrays(q, images[:, :1], view=["top"])
    assert Observations.from_frame(one.to_frame()).view == ("top",)
    for names, message in [
        (None, r"expected \(K, 2, m, 2\); name the views of others"),
        (("a", "a", "b"), "each once"),
        (("a", "q", "b"), "small letters"),
        ("abc", "small letters"),
    ]:
        with pytest.raises(InputError, match=message):
            Observations.from_arrays(q, images, view=names)


def test_cameras_of_the_configuration_have_any_names():
    rig = Cameras.model_validate({"top": {"source": 2}, "right": {"source": 1}, "left": {"source": 0}})
    assert [*rig.sources] == ["left", "right", "top"]
    assert Cameras.model_validate(rig.model_dump()) == rig


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ("{}", r"cameras: name one camera or more, such as left and right"),
        ("{top: {source: 1}, max_age: 3}", r"cameras.max_age: unknown key; did you mean max_age_s"),
        ("{top: {sorce: 1}}", r"cameras.top.sorce: unknown key; did you mean source"),
        ("{top: {source: 1}, 'Top 2': {source: 2}}", r"cameras.Top 2: is no name of a camera"),
        (
            "{top: {source: 1}, low: {source: 1}}",
            r"cameras.low.source: is .*, also the device of the top camera",
        ),
    ],
)
def test_names_that_are_none_are_said(tmp_path, cameras, message):
    with pytest.raises(InputError, match=message):
        configuration(tmp_path, VIEWS, cameras=yaml.safe_load(cameras))
