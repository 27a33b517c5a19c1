"""The library: the same numbers as the command line, and the same sentences where something is wrong."""

import dataclasses
import importlib
import json
import os
import pkgutil
import shutil
import subprocess
import sys

import numpy as np
import pytest

import projservo_cli as ps
from projservo_cli import cli
from projservo_cli.calibration import prediction_variance
from projservo_cli.planning import joints_from_images
from projservo_cli.records import Calibration, Observation, Trace, changed, flat_fields
from projservo_cli.store.observation_tables import read_table, write_table
from tests.configured import calibrate
from tests.conftest import ROOT

FEW = {"calibration.frames_per_joint": 3, "calibration.random_poses": 6}


class Resolved:
    """A law of one's own: the stacked interaction matrix at the predicted images."""

    gain = 2.0

    def __init__(self, setup):
        self.setup = setup

    def __call__(self, s, q):
        J = self.setup.calibration.jacobian(q)[:, self.setup.face].reshape(-1, len(q))
        error = (s - self.setup.s_star).ravel()
        return -self.gain * np.linalg.lstsq(J, error, rcond=None)[0]


@pytest.fixture(scope="module")
def config():
    return ps.Config.load("ur5").replace({"control": {"laws": ["exact"]}})


@pytest.fixture(scope="module")
def made(config):
    """Observations, calibration and plan of a configuration."""
    observations = ps.simulate(config)
    calibration = ps.calibrate(observations)
    return observations, calibration, ps.plan(config, calibration)


@pytest.fixture
def begun(calibrated_run, tmp_path):
    """Folder of a run with its calibration, which may be gone on with."""
    return shutil.copytree(calibrated_run("ur5"), tmp_path / "run")


def alike(first, second, kind):
    """Whether records are equal to the bit but for the time they took."""
    for one in flat_fields(kind):
        a, b = getattr(first, one.name), getattr(second, one.name)
        if one.name != "seconds":
            np.testing.assert_array_equal(np.array(a), np.array(b), err_msg=one.name)


@pytest.mark.parametrize("name", ["hobby", "stanford"])
def test_a_calibration_from_python_is_that_of_the_chain(name):
    config = ps.Config.load(name).replace(FEW)
    seen, chained, _ = calibrate.run(config)
    observations = ps.simulate(config)
    alike(observations, seen, Observation)
    alike(ps.calibrate(observations, lens=config.calibration.lens), chained, Calibration)


def test_a_score_is_that_of_validate(config, made, begun, tmp_path, capsys):
    observations, calibration, _ = made
    held_out = ps.simulate(config, observations.q[:9] + 0.05)
    write_table(held_out, tmp_path / "held.csv")
    assert cli.run(["validate", str(begun), "--data", str(tmp_path / "held.csv"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert calibration.score(held_out) == {key: value for key, value in told.items() if key != "run"}
    table = ps.Observations.from_frame(str(tmp_path / "held.csv"))
    assert calibration.score(table) == ps.load(begun).calibration.score(held_out)


def test_deviations_are_those_of_the_covariance(made):
    observations, calibration, _ = made
    pixels, sigma = calibration.predict(observations.q[:3], return_std=True)
    np.testing.assert_array_equal(pixels, calibration.predict(observations.q[:3]))
    np.testing.assert_allclose(sigma**2, prediction_variance(calibration, observations.q[:3]), rtol=1e-12)
    C = calibration.covariance()
    size = calibration.P.size + calibration.H_hat_0.size + calibration.M.size
    assert C.shape == (size, size)
    # To first order, sigma² = J C Jᵀ: differences of predictions by each parameter, central, at a step of
    # 1e-6 of its deviation, of which rounding takes 1e-13 / 1e-6 of a deviation.
    kinds = {"P": calibration.P, "H_hat_0": calibration.H_hat_0, "M": calibration.M}
    q, step = observations.q[7], 1e-4 * np.sqrt(np.diag(C).max())
    columns = []
    for name, values in kinds.items():
        for k in range(values.size):
            ends = []
            for sign in (1.0, -1.0):
                moved = values.copy()
                moved.flat[k] += sign * step
                ends.append(changed(calibration, **{name: moved}).predict(q).ravel())
            columns.append((ends[0] - ends[1]) / (2.0 * step))
    J = np.array(columns).T
    sigma = calibration.predict(q, return_std=True)[1].ravel()
    np.testing.assert_allclose(np.sqrt(((J @ C) * J).sum(axis=1)), sigma, rtol=1e-3)


def test_a_plan_takes_joints_pixels_and_what_was_taught(config, made, tmp_path):
    _, calibration, plan = made
    same = ps.plan(config, calibration, q_start=plan.q_start)
    np.testing.assert_array_equal(same.s, plan.s)
    by_images = ps.plan(config, calibration, goal=plan.s_star)
    # By the four points of the face alone, from images of 0.5 px, not by the body of ten.
    np.testing.assert_allclose(by_images.theta_s, plan.theta_s, atol=5e-3)
    taught = {"images": {side: plan.s_star[i].tolist() for i, side in enumerate(("left", "right"))}}
    (tmp_path / "goal.yaml").write_text(json.dumps(taught), encoding="utf-8")
    for goal in (taught, str(tmp_path / "goal.yaml")):
        np.testing.assert_array_equal(ps.plan(config, calibration, goal=goal).s, by_images.s)
    joints = calibration.q_reference + 0.05
    assert ps.plan(config, calibration, goal=joints).feasible


def test_a_run_has_the_start_and_goal_of_its_plan(config, made):
    _, calibration, plan = made
    start, goal = plan.q_start + 0.05, plan.q_start + 0.1
    asked = ps.plan(config, calibration, q_start=start, goal=goal)
    trace = ps.servo(config, calibration, asked)
    np.testing.assert_array_equal(trace.q[0], start)
    assert np.abs(trace.q[-1] - goal).max() < 0.02
    unasked = dataclasses.replace(asked, asked=(None, None))  # as of another configuration
    with pytest.raises(ps.InputError, match=r"another task than the configuration: it starts 0\.05 rad"):
        ps.servo(config, calibration, unasked)
    other = dataclasses.replace(ps.plan(config, calibration, goal=goal), asked=(None, None))
    with pytest.raises(ps.InputError, match=r"its goal images are .* px from task\.goal"):
        ps.servo(config, calibration, other)


def test_goal_images_without_joints_must_fit_the_calibration(config, made, monkeypatch):
    monkeypatch.setattr(
        joints_from_images, "_TRIALS", 5
    )  # else seconds until images that fit nowhere are given up
    _, calibration, plan = made
    images = calibration.predict(plan.q_start + 0.1)[:, calibration.indices_of(config.face_numbers)]
    assert ps.plan(config, calibration, goal=images).feasible
    for off, what in (
        (np.array([[[0.0, 20.0]], [[0.0, 0.0]]]), "leaves .* px rms a marker"),
        (15.0 * (np.arange(16).reshape(2, 4, 2) == 4), "marker 2 is .* px off in the left one"),
    ):
        with pytest.raises(ps.WorkFailed, match=what):
            ps.plan(config, calibration, goal=images + off)


def test_a_trace_is_that_of_the_chain_and_of_a_class_like_that_of_its_name(config, made):
    _, calibration, plan = made
    run = ps.Experiment(config).make("servo")
    alike(ps.servo(config, calibration, plan), run.traces["exact"], Trace)
    tracks = [{"law": "exact_track"}, {"law": "exact_track", "mode": "track"}, {"mode": "track"}]
    first, *others = (ps.servo(config, calibration, plan, **given) for given in tracks)
    assert (first.law, first.mode) == ("exact", "track")
    for other in others:
        alike(first, other, Trace)
    own = ps.servo(config, calibration, plan, law=Resolved)
    named = ps.servo(config, calibration, plan, law=f"{__name__}:Resolved")
    alike(own, named, Trace)
    assert own.law == f"{__name__}:Resolved"
    assert own.verdict == "converged"
    lazy = ps.servo(config, calibration, plan, law=lambda setup: lambda s, q: 0.0 * q)
    assert lazy.verdict == "no progress"


def test_a_robot_at_hand_is_recorded_and_driven(made):
    from tests.robots.robots import Sound

    config = ps.Config.load("ur5").replace({"plant.settle_s": 0.3, "noise.servo_px": 0.5, **FEW})
    path = ROOT / "configs" / "ur5.yaml"
    observations = ps.record(config, robot=Sound(path))
    assert observations.source == "recorded"
    assert len(observations.at_rest.pose) == 1 + 6 * 3 + 6
    calibration = ps.calibrate(observations, noise_px=0.5)
    assert calibration.usable
    trace = ps.servo(config, calibration, ps.plan(config, calibration), robot=Sound(path))
    assert trace.verdict == "converged"
    with pytest.raises(ps.InputError, match=r"lacks open\(\), read\(\)"):
        ps.record(config, robot=object())


def test_a_sweep_in_memory_compares_classes_and_laws(config):
    class Slow(Resolved):
        gain = 0.5

    study = ps.sweep(config, laws=[Slow, Resolved, "exact"], tasks=2, seed=3)
    assert study.path is None
    assert [cell["law"] for cell in study.success()] == ["Slow", "Resolved", "exact"]
    low, high = study.success()[2]["success_interval"]
    assert 0.0 <= low <= study.success()[2]["success_rate"] <= high <= 1.0
    (pair,) = study.paired(Slow, "exact")
    assert pair["laws"] == ["Slow", "exact"]
    assert pair["both"] + sum(pair["only"]) + pair["neither"] == pair["pairs"] == 2
    with pytest.raises(ps.InputError, match="no law direct_two in this sweep; laws: Slow, Resolved, exact"):
        study.paired("direct_two", "exact")
    with pytest.raises(ps.InputError, match=r"other processes cannot import .*Slow: put it into a module"):
        ps.sweep(config, laws=[Slow], tasks=2, workers=2)
    assert len(study.table["run"]) == 3 * 2
    assert set(study.to_frame().columns) == set(study.table)


def test_a_sweep_in_a_folder_is_continued_but_never_that_of_a_class_without_source(config, tmp_path):
    first = ps.sweep(config, laws=["exact"], runs=3, path=tmp_path / "sweep")
    done = (tmp_path / "sweep" / "sweep.h5").stat().st_mtime_ns
    for path in (tmp_path / "sweep", tmp_path / "sweep" / "sweep.h5"):
        np.testing.assert_array_equal(first.table["steps"], ps.load(path).table["steps"])
    ps.sweep(config, laws=["exact"], runs=3, path=tmp_path / "sweep")
    assert (tmp_path / "sweep" / "sweep.h5").stat().st_mtime_ns == done
    with pytest.raises(
        ps.InputError, match=r"; choose another folder, or start again with --force \(force=True\)"
    ):
        ps.sweep(config, laws=["exact"], runs=4, path=tmp_path / "sweep")


class Lost(Resolved):
    """A law of no numbers."""

    def __call__(self, s, q):
        return q * np.nan


class Broken(Resolved):
    """A law with an error in its source, which shows at its third call."""

    calls = 0

    def __call__(self, s, q):
        self.calls += 1
        return super().__call__(s, q) if self.calls < 3 else {}["gain"]


def test_a_sweep_says_why_laws_failed(config, tmp_path, capsys):
    grid = {"noise.servo_px": [0.1 * k for k in range(4)]}
    study = ps.sweep(config, laws=[Lost, Broken, "exact"], runs=2, grid=grid, path=tmp_path)
    reasons = {
        "Lost": "gave array([nan, nan, nan, nan, nan, nan]): expected 6 finite joint velocities, or None",
        "Broken": "failed: KeyError: 'gain' (test_api.py:",
    }
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 2
    stored = ps.load(tmp_path)
    for (law, reason), line in zip(reasons.items(), told, strict=True):
        first = study.table["run"][study.table["law"] == law][0]
        told = f"law {law}: 8 runs failed or did not start, first run {first}: "
        assert line.startswith(told)
        assert reason in line
        assert f"failures of {law} " in repr(study)
        assert study.failures[law][:2] == (8, first)
        assert study.failures[law] == stored.failures[f"{__name__}:{law}"]
    assert len(study.summary()) <= 11
    verdicts = {law: set(study.table["verdict"][study.table["law"] == law]) for law in (*reasons, "exact")}
    assert verdicts["Lost"] == {"not started"}
    assert verdicts["Broken"] == {"failed"}
    assert not verdicts["exact"] & {"not started", "failed"}


SCRIPT = """
import numpy as np
import projservo_cli as ps

class Law:
    def __init__(self, setup):
        self.setup = setup

    def __call__(self, s, q):
        return 0.0 * q

if __name__ == "__main__":
    study = ps.sweep(ps.Config.load("ur5"), laws=[Law], runs=1, workers=2)
    print(study.table["verdict"].tolist())
"""


def test_a_script_is_told_of_the_guard_it_lacks_and_its_classes_work_with_one(tmp_path, config, monkeypatch):
    study = tmp_path / "study.py"
    study.write_text(SCRIPT.replace('__name__ == "__main__"', "True"), encoding="utf-8")
    monkeypatch.setattr(sys.modules["__main__"], "__file__", str(study), raising=False)
    with pytest.raises(ps.InputError, match='put its calls under if __name__ == "__main__":'):
        ps.sweep(config, laws=["exact"], runs=2, workers=2)
    study.write_text(SCRIPT, encoding="utf-8")
    command, environment = [sys.executable, "study.py"], {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout == "['no progress']\n", done.stderr


def test_an_experiment_is_made_once_resumed_and_opened_again(config, begun):
    run = ps.Experiment(config, begun).make("plan")
    keys = {name: result.key for name, result in run.results.items()}
    again = ps.Experiment(config, begun).make("servo")
    assert {name: again.results[name].key for name in keys} == keys
    np.testing.assert_array_equal(again.calibration.P, run.calibration.P)
    assert ps.load(begun).traces["exact"].verdict == "converged"


def test_a_law_of_a_notebook_is_never_up_to_date(config, begun, monkeypatch):
    monkeypatch.setattr(sys.modules["__main__"], "Resolved", Resolved, raising=False)
    run = ps.Experiment(config, begun).make("servo", laws=["__main__:Resolved"])
    monkeypatch.setattr(Resolved, "gain", 1.0)
    steps = run.traces["__main__:Resolved"].steps
    assert run.make("servo", laws=["__main__:Resolved"]).traces["__main__:Resolved"].steps > 1.5 * steps


def test_a_stored_run_starts_no_code_that_it_names(config, begun):
    named = config.replace({"control.laws": [f"{__name__}:Resolved"]})
    ps.Experiment(named, begun).make("plan")
    with pytest.raises(ps.InputError, match="is named by the stored run alone, which starts no code"):
        ps.load(begun).make("servo")


def arrays(**given):
    """Observations of four poses and three markers, but for what is given."""
    return ps.Observations.from_arrays(**{"q": np.zeros((4, 6)), "pixels": np.ones((4, 2, 3, 2)), **given})


MIXED = {"q": np.full((4, 6), 0.5) + 150.0 * (np.arange(6) == 2), "joint_types": "RRPRRR"}
# What is asked of a configuration c, a calibration k or a plan p, and the words that refuse it.
REFUSED = [
    (lambda c, k, p: ps.Config.load("ur6"), r"no file, and no shipped configuration; did you mean ur5\?"),
    (lambda c, k, p: ps.Config.load(5), "a configuration of type int: give the path of a file, or a name"),
    (lambda c, k, p: c.replace({"control.gain_t": -1.0}), "control.gain_t=-1.0: control.gain_t: must be"),
    (lambda c, k, p: ps.load(5), "load: a path of type int: give the folder of a run or of a sweep"),
    (lambda c, k, p: ps.load("configs/ur5.yaml"), "a configuration, which Config.load reads"),
    (lambda c, k, p: ps.simulate(c, np.zeros((2, 5))), r"q of shape \(2, 5\): expected \(K, 6\), rad or m"),
    (lambda c, k, p: ps.simulate(c, np.full((1, 6), np.nan)), "q: holds a number that is not finite"),
    (lambda c, k, p: ps.simulate(c, np.full((1, 6), 7.0)), "q: pose 0: joint 1 would be at 401.07°, beyond"),
    (lambda c, k, p: ps.simulate(c, np.full((1, 6), 90.0)), "joint 1 at 90 is more than two turns in rad"),
    (lambda c, k, p: ps.simulate(c, "here"), r"q: no array of numbers; expected shape \(K, 6\), rad or m"),
    (lambda c, k, p: ps.simulate("ur5"), "simulate: config of type str: read one with Config.load"),
    (lambda c, k, p: ps.calibrate(np.zeros(3)), "observations of type ndarray; make them with"),
    (
        lambda c, k, p: ps.simulate(c, noise_px=-1),
        "^simulate: noise_px: noise.calibration_px: must be",
    ),
    (
        lambda c, k, p: ps.calibrate(ps.simulate(c), method="best", noise_px=0, lens="no"),
        "^calibrate: method: 'best' is not one of .*\ncalibrate: lens: .*, not 'no'\n"
        "calibrate: noise_px: must be greater than 0, not 0$",
    ),
    (lambda c, k, p: ps.Experiment(c).plan, r"holds no result of plan; make it first: make\('plan'\)"),
    (lambda c, k, p: ps.Experiment(c).make("report"), "give Experiment a path"),
    (lambda c, k, p: ps.Experiment(c).make("prepare"), "no such stage; stages: calibrate, plan, servo, rep"),
    (lambda c, k, p: ps.sweep(c, laws=["exact"], workers=0), "workers=0: give a whole number of one or more"),
    (lambda c, k, p: ps.sweep(c, laws=["exact"], runs=0), "^sweep: runs: must be at least 1, not 0$"),
    (lambda c, k, p: ps.sweep(c, laws=[]), "sweep: name one law or more"),
    (lambda c, k, p: ps.sweep(c, laws="exact"), r"sweep: laws 'exact': give a list of them, such as laws=\["),
    (lambda c, k, p: ps.sweep(c, laws=[Resolved, Resolved]), "grid.law: a value occurs there twice"),
    (lambda c, k, p: ps.plan(c, k, q_start=np.degrees(p.q_start)), "q_start: .* two turns in rad"),
    (lambda c, k, p: ps.plan(c, k, q_start=[1, 2]), r"q_start of shape \(2,\): expected \(6,\)"),
    (lambda c, k, p: ps.plan(c, k, goal=np.zeros((2, 3, 2))), r"\(6,\) joint readings, or \(2, 4, 2\)"),
    (lambda c, k, p: ps.plan(ps.Config.load("stanford"), k), "the configuration of RRPRRR: take one"),
    (lambda c, k, p: ps.servo(c, k, p.q), "servo: plan of type ndarray: make one with plan"),
    (
        lambda c, k, p: ps.servo(c, k, p, law="exakt"),
        r"law exakt: no such law; did you mean exact\? laws: direct_three",
    ),
    (lambda c, k, p: ps.servo(c, k, p, law=3), "law 3: expected a name, or a class or function"),
    (lambda c, k, p: ps.sweep(c, laws=[3]), "law 3: expected a name, or a class or function that makes"),
    (lambda c, k, p: ps.servo(c, k, p, mode="follow"), "^servo: mode: .* 'follow' is not one of them; valid"),
    (
        lambda c, k, p: ps.servo(c, k, p, law="stacked", mode="track"),
        "^control.mode track: stacked has no such mode, only regulate and image_track; laws that have",
    ),
    (
        lambda c, k, p: ps.servo(c, k, p, law="exact_track", mode="regulate"),
        "^servo: law exact_track is exact in mode track, not 'regulate': leave mode out$",
    ),
    (lambda c, k, p: k.predict(np.full(6, 90.0)), "joint readings: joint 1 at 90 is more than two turns"),
    (lambda c, k, p: k.project("here"), r"points: no array of numbers; expected shape \(..., 4\)"),
    (lambda c, k, p: k.score({"q1": [0.0]}), "score: observations of type dict; make them with"),
    (lambda c, k, p: p.plot(np.zeros(2)), "plot: ax of type ndarray: give one axes of a figure"),
    (lambda c, k, p: arrays(q=np.zeros((3, 6))), r"q of shape \(3, 6\): expected \(4, n\)"),
    (lambda c, k, p: arrays(pixels=np.zeros((4, 3, 2))), r"\(4, 3, 2\): expected \(K, 2, m, 2\)"),
    (lambda c, k, p: arrays(pixels=np.ones((4, 2, 3, 2)) + 1j), "pixels: complex numbers; expected real"),
    (lambda c, k, p: arrays(q=np.ma.masked_equal(np.zeros((4, 6)), 0.0)), "q: holds a number that is not"),
    (lambda c, k, p: arrays(pixels=np.full((4, 2, 3, 2), np.inf)), r"at pose 0, view 0 is at \(inf, inf\): "),
    (lambda c, k, p: arrays(q=np.full((4, 6), 90.0)), "they look like degrees; give joint_unit='deg'"),
    (lambda c, k, p: arrays(**MIXED), r"q3 of pose 0 is 150\.5, of a prismatic .*they look like millimetres"),
    (lambda c, k, p: arrays(joint_unit="degrees"), "q: joint_unit 'degrees': give deg or rad"),
    (lambda c, k, p: arrays(joint_types="RRR"), "joint_types: 'RRR': expected 6 letters R or P"),
    (lambda c, k, p: arrays(image_size="1280x1024"), "image size '1280x1024': give a positive width and"),
    (lambda c, k, p: arrays(noise_px=float("nan")), "pixel noise nan: give a positive number"),
    (lambda c, k, p: arrays(noise_px="a"), "pixel noise 'a': give a positive number"),
    (lambda c, k, p: arrays(marker=[1, 1, 2]), "marker: expected 3 different whole numbers"),
    (lambda c, k, p: arrays(sigma=np.zeros((4, 2, 3))), "sigma: must be positive wherever a marker is seen"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_what_makes_no_sense_is_said_in_a_sentence(config, made, call, message):
    with pytest.raises(ps.InputError, match=message):
        call(config, *made[1:])


def test_arrays_tables_and_frames_hold_the_same(made, tmp_path):
    observations = made[0]
    order = np.random.default_rng(0).permutation(len(observations.marker))
    shuffled = ps.Observations.from_arrays(
        observations.q, observations.images[:, :, order], marker=observations.marker[order]
    )
    write_table(observations, tmp_path / "table.csv")
    table = read_table(tmp_path / "table.csv")
    tables = tmp_path / "table.csv", observations.to_frame(), dict(observations.to_frame())
    for one in (shuffled, *map(ps.Observations.from_frame, tables)):
        alike(one, table, Observation)
    for types in ("rrrrrr", np.array([*"rRrRrR"])):
        given = ps.Observations.from_arrays(observations.q, observations.images, joint_types=types)
        frame = ps.Observations.from_frame(observations.to_frame(), joint_types=types)
        assert given.joint_types == frame.joint_types == "RRRRRR"
    q, pixels = np.degrees(observations.q), observations.images
    degrees = ps.Observations.from_arrays(q, pixels, joint_unit="deg")
    np.testing.assert_allclose(degrees.q, observations.q, atol=1e-12)
    columns = dict(observations.to_frame())
    joined = ps.Observations.from_frame(columns | {"marker": columns["marker"].astype(float)})
    alike(joined, table, Observation)
    bare = columns["marker"].where(columns["marker"].index != 3)  # as a join leaves it
    with pytest.raises(ps.InputError, match="table: row 3: marker is ''; expected"):
        ps.Observations.from_frame(columns | {"marker": bare})
    with pytest.raises(ps.InputError, match="joint_unit='deg', or joint_unit='rad' if they are"):
        ps.Observations.from_frame(columns | {"q1": columns["q1"] + 90.0})


def test_what_is_masked_is_unseen(made):
    def masked(values):
        """Zeros below the mask, as a detector may leave them."""
        return np.ma.masked_array(np.nan_to_num(values), np.isnan(values))

    observations, calibration, _ = made
    seen = observations.images.copy()
    seen[::5, 0, 3] = seen[1::7, :, 2] = np.nan
    known = ps.Observations.from_arrays(observations.q, seen)
    alike(ps.Observations.from_arrays(observations.q, masked(seen)), known, Observation)
    columns = {name: masked(values) for name, values in known.to_frame().items()}
    alike(ps.Observations.from_frame(columns), known, Observation)
    metric = calibration.metric(0.3, "cameras")
    np.testing.assert_array_equal(metric.triangulate(masked(seen)), metric.triangulate(seen))


def test_labelled_arrays_are_the_group_of_the_run_file(config, made, begun):
    xarray = pytest.importorskip("xarray")
    run = ps.Experiment(config, begun).make("servo")
    stored = xarray.load_dataset(begun / "run.h5", engine="h5netcdf", group="servo/exact")
    labelled = run.traces["exact"].to_xarray()
    coordinates = {"joint", "marker", "view", "xy"}
    xarray.testing.assert_equal(labelled.drop_vars(coordinates), stored)
    assert labelled.attrs.items() <= stored.attrs.items()
    assert labelled["time"].values[:2].tolist() == [0.0, config.control.period_s]
    np.testing.assert_array_equal(labelled["s"].sel(view="right", xy="v"), labelled["s"][:, 1, :, 1])
    assert run.calibration.to_xarray()["M"].sel(marker=3).shape == (4,)
    assert made[0].to_xarray()["q"].sel(joint="q2").shape == (49,)
    metric = run.calibration.metric(0.3, "cameras")
    assert metric.to_xarray()["markers"].sel(marker=3, axis="z") == metric.markers[3, 2]


def test_results_draw_the_figures_of_the_report(config, made):
    from matplotlib.figure import Figure

    _, calibration, plan = made
    trace = ps.servo(config, calibration, plan)
    for one, panels in ((calibration, 6), (plan, 4), (trace, 2)):
        figure = one.plot()
        assert len(figure.axes) >= panels
        axes = Figure().subplots()
        assert one.plot(axes) is one.plot(axes) is axes
        assert len(axes.lines) == 2 * len(axes.get_legend_handles_labels()[1]) / 2 >= 2
    labels = [text.get_text() for text in trace.plot().legends[0].get_texts()]
    assert labels == [*(f"marker {number}" for number in config.face_numbers), "u", "v"]
    with pytest.raises(ps.InputError, match=r"the observations .* are not at hand"):
        dataclasses.replace(calibration, observation=None).plot()


def test_no_public_name_is_hidden_by_a_module():
    names = [name for name in ps.__all__ if name != "__version__"]
    before = {name: getattr(ps, name) for name in names}
    for module in pkgutil.iter_modules(ps.__path__):
        importlib.import_module(f"projservo_cli.{module.name}")
    assert {name: getattr(ps, name) for name in names} == before
    assert set(dir(ps)) >= set(names)


def test_parts_of_observations_join_to_the_whole():
    rng = np.random.default_rng(3)
    images = rng.uniform(0.0, 900.0, (9, 3, 5, 2))
    images[2, 1, 3] = np.nan
    known = {"view": ("a", "b", "c"), "image_size": ((900, 901), (902, 903), (904, 905))}
    whole = ps.Observations.from_arrays(rng.uniform(-1, 1, (9, 4)), images, sigma=np.ones((9, 3, 5)), **known)
    first, last = whole.select(pose=range(4)), whole.select(pose=range(4, 9))
    joined = ps.Observations.concat([first, last])
    for name in ("pose", "marker", "q", "images", "sigma"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name))
    few = ps.Observations.concat([first.select(marker=[4, 1]), last])
    np.testing.assert_array_equal(few.images[:4, :, [1, 4]], images[:4, :, [1, 4]])
    assert np.isnan(few.images[:4, :, [0, 2, 3]]).all()
    one = whole.select(view=["c", "a"], marker=2)
    assert (one.view, one.image_size) == (("c", "a"), ((904, 905), (900, 901)))
    np.testing.assert_array_equal(one.images, images[:, [2, 0]][:, :, [2]])
    for call, said in (
        (lambda: whole.select(view="left"), "select: view 'left': choose among ['a', 'b', 'c']"),
        (lambda: ps.Observations.concat([whole, one]), "concat: the observations differ in images"),
        (lambda: ps.Observations.concat([]), "concat: an empty list"),
        (lambda: ps.Observations.concat([whole, dataclasses.replace(whole, mount="tool")]), "in mount"),
    ):
        with pytest.raises(ps.InputError) as refused:
            call()
        assert said in str(refused.value)


def test_a_scene_and_a_sweep_are_drawn_before_and_without_a_report():
    config = ps.Config.load("ur5").replace(FEW)
    q = np.array(config.task.start.values(config.joint_types))
    pose = config.pose(q)
    metric = ps.simulate(config, q=q[None], noise_px=0.0)
    assert metric.images.shape[0] == 1
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert len(config.plot(q).axes) == 1
    for call in (config.pose, config.plot):
        with pytest.raises(ps.InputError, match="rad"):
            call(q[:3])
    study = ps.sweep(config, laws=["exact"], runs=2, grid={"noise.servo_px": [0.0, 0.5]})
    assert study.plot().axes[0].get_xlabel() == "noise.servo_px"
    with pytest.raises(ps.InputError, match="plot: figure basin: this sweep allows success_over"):
        study.plot("basin")


def resolved(setup):
    return Resolved(setup)


def test_an_experiment_takes_the_class_of_a_law_as_servo_does(tmp_path):
    config = ps.Config.load("ur5").replace(FEW)
    for place, law in ((None, resolved), (tmp_path / "run", Resolved)):
        made = ps.Experiment(config, place).make("servo", laws=[law])
        (name,) = made.traces
        assert name.endswith(f":{law.__name__}")
    with pytest.raises(ps.InputError, match="give the name of a law"):
        ps.Experiment(config).make("servo", laws=[3])
