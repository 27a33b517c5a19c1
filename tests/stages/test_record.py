"""Recording the simulated robot: the table, interruptions, limits, refusals."""

import csv
from pathlib import Path

import numpy as np
import pytest

from projservo_cli.cli.output import Console
from projservo_cli.config import load_config
from projservo_cli.records import WorkFailed
from projservo_cli.robots.contract import PluginRobot
from projservo_cli.store.observation_tables import read_joint_list, read_table
from tests.configured import bounds_of, joints_of, simulate, trial_motions, truth_of
from tests.configured import record as stage

CONFIGS = Path(__file__).parents[2] / "configs"
UR5, STANFORD = CONFIGS / "ur5.yaml", CONFIGS / "stanford.yaml"
FEW = ["--set", "calibration.frames_per_joint=2"]


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)


def same(table, observation):
    for name in ("pose", "marker", "q", "images"):
        np.testing.assert_array_equal(getattr(table, name), getattr(observation, name), err_msg=name)


@pytest.mark.parametrize("config", [UR5, STANFORD])
def test_the_table_is_what_calibrate_simulates_to_the_bit(projservo, config):
    answer = projservo("record", "-c", config, "--output", "new/t.csv", "--json")
    assert answer.code == 0, answer.err
    assert (answer.json["poses"], answer.json["recorded"], answer.json["pending"]) == (49, 49, 0)
    settings = load_config(config)
    same(read_table("new/t.csv"), simulate(settings, truth_of(settings)))


def lose_patience(console, what, done, total, note=""):
    if (what, done) == ("record", 5):
        raise KeyboardInterrupt


@pytest.mark.parametrize("gone", [0, 2])
def test_an_interrupted_recording_goes_on_where_it_was(projservo, monkeypatch, gone):
    assert projservo("record", "-c", UR5, *FEW, "-o", "whole.csv", "-q").code == 0
    with monkeypatch.context() as patch:
        patch.setattr(Console, "progress", lose_patience)
        answer = projservo("record", "-c", UR5, *FEW, "-o", "t.csv")
    assert answer.code == 130
    assert "t.csv: 5 of 13 poses; run again to continue" in answer.err
    assert read_table("t.csv").pose.tolist() == [0, 1, 2, 3, 4]
    lines = Path("t.csv").read_text().splitlines(keepends=True)
    del lines[1 : 1 + 10 * gone]  # poses that were lost are recorded again
    Path("t.csv").write_text("".join(lines))
    assert projservo("record", "-c", UR5, *FEW, "-o", "t.csv", "-n", "--json").json["pending"] == 8 + gone
    answer = projservo("record", "-c", UR5, *FEW, "-o", "t.csv", "--json")
    assert (answer.code, answer.json["found"], answer.json["recorded"]) == (0, 5 - gone, 8 + gone)
    assert Path("t.csv").read_bytes() == Path("whole.csv").read_bytes()
    again = projservo("record", "-c", UR5, *FEW, "-o", "t.csv", "--json").json
    assert (again["recorded"], again["commands"]) == (0, 0)


def test_a_table_of_another_configuration_is_refused_unless_forced(projservo):
    assert projservo("record", "-c", UR5, *FEW, "-o", "t.csv", "-q").code == 0
    before = Path("t.csv").read_bytes()
    others = {
        "seed=2": "was not recorded with this configuration",
        "noise.calibration_px=0.1": "was not recorded with this configuration",
        "calibration.amplitude_deg=20": "pose 1 is none of those to be recorded",
        "calibration.frames_per_joint=1": "pose 2 is none of those to be recorded",
    }
    for change, message in others.items():
        answer = projservo("record", "-c", UR5, *FEW, "--set", change, "-o", "t.csv", "-q")
        assert (answer.code, answer.err.count("\n")) == (2, 1)
        assert message in answer.err
        assert "--force" in answer.err
    assert Path("t.csv").read_bytes() == before
    lines = before.decode().splitlines(keepends=True)
    for text, message in (
        ("".join(lines).replace(",recording", ",note"), "was not recorded with this configuration"),
        ("".join(line for line in lines if line.split(",")[1] != "9"), "other markers"),
    ):
        Path("t.csv").write_text(text)
        answer = projservo("record", "-c", UR5, *FEW, "-o", "t.csv", "-q")
        assert (answer.code, message in answer.err) == (2, True)
    assert projservo("record", "-c", UR5, *FEW, "--set", "seed=2", "-o", "t.csv", "-q", "--force").code == 0
    assert Path("t.csv").read_bytes() != before
    again = projservo("record", "-c", UR5, *FEW, "--set", "seed=2", "-o", "t.csv", "--json")
    assert again.json["found"] == 13


def test_further_motions_follow_the_trials_and_continue_their_table(projservo):
    assert projservo("record", "-c", UR5, *FEW, "-o", "t.csv", "-q").code == 0
    trials = read_table("t.csv")
    degrees = np.degrees(trials.q[0]) + np.array([[10, 0, -10, 5, 0, 20], [-10, 5, 0, 0, 15, 0]])
    rows = [",".join(map(repr, row)) for row in degrees.tolist()]
    Path("more.csv").write_text("\n".join(["q1,q2,q3,q4,q5,q6", *rows]))
    more = ["--motions", "more.csv", "--joint-unit", "deg"]
    answer = projservo("record", "-c", UR5, *FEW, *more, "-o", "t.csv", "--json")
    assert (answer.json["found"], answer.json["recorded"]) == (13, 2)
    table = read_table("t.csv")
    assert table.pose.tolist() == list(range(15))
    np.testing.assert_array_equal(table.images[:13], trials.images)
    np.testing.assert_array_equal(table.q[13:], read_joint_list("more.csv", "RRRRRR", "deg").q)
    truth = truth_of(load_config(UR5))
    clean = np.stack([truth.images(q, truth.M) for q in table.q])
    assert 0.3 < np.std(table.images[13:] - clean[13:]) < 0.7  # 80 draws of sigma 0.5: ± 5 standard errors
    assert projservo("record", "-c", UR5, *FEW, "-o", "t.csv").code == 2  # poses that are not asked for
    Path("far.csv").write_text("pose,q1,q2,q3,q4,q5,q6\n8,0,0,0,0,0,7\n")
    refused = projservo("record", "-c", UR5, *FEW, "--motions", "far.csv", "-o", "u.csv")
    assert refused.code == 2
    assert "pose 8: joint 6 would be at 401.07°, beyond its limits" in refused.err
    assert not Path("u.csv").exists()


class Arm:
    """The arm of a configuration that lags, sags and plays; joints are read in ticks, images are late.

    Time passes in commands alone, in parts of a millisecond.
    """

    lag, sag, play, tick, late, noise, rate = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1e9

    def __init__(self, config, **faults):
        vars(self).update(faults)
        self.world = truth_of(config)
        self.q = np.array(trial_motions(config)[0]) + 0.3
        self.motor, self.target, self.time = self.q.copy(), self.q.copy(), 0.0
        self.past, self.sent, self.calls = [self.q], [], []
        self.random = np.random.default_rng(3)

    def open(self):
        self.calls.append("open")

    def shown(self, time):
        seen = time - self.late
        if self.rate < 1e9:  # the same frame until there is another
            seen = seen // (1.0 / self.rate) / self.rate
            self.random = np.random.default_rng(round(1e6 * max(0.0, seen)))
        return self.past[max(0, round(1e3 * seen))]

    def read(self):
        s = self.world.images(self.shown(self.time), self.world.M)
        s += self.noise * self.random.standard_normal(s.shape)
        q = self.q if not self.tick else self.tick * np.round(self.q / self.tick)
        return q, s, self.time

    def command(self, target, speed, due):
        self.sent.append(target - self.target)
        self.target = target
        while self.time < due - 5e-4:
            self.time += 1e-3
            self.motor = self.motor + (target - self.motor) * (1e-3 / self.lag if self.lag else 1.0)
            joint = self.motor - self.sag * np.cos(self.motor)
            self.q = np.clip(self.q, joint - self.play / 2, joint + self.play / 2)
            self.moved()
            self.past.append(self.q)

    def moved(self):
        pass

    def now(self):
        return self.time

    def stop(self):
        self.calls.append("stop")

    def close(self):
        self.calls.append("close")


def driven(config, robot):
    bounds = bounds_of(config, joints_of(config))
    return PluginRobot(robot, "plant Arm", len(config.markers.known), bounds, 30.0, 1.0)


TEN = ["calibration.frames_per_joint=2"]


def test_every_step_keeps_the_speed_limit_and_the_joint_limits():
    config = load_config(STANFORD, [*TEN, "control.prismatic_speed_limit_m_s=0.5"])
    recording = stage.new_recording(config, Path("t.csv"))
    robot = Arm(config)
    stage.record(config, recording, driven(config, robot))
    steps = np.array(robot.sent)
    limit = np.array([125 * np.pi / 180 * 0.04] * 6)
    limit[2] = 0.5 * 0.04
    assert (np.abs(steps) <= limit * (1 + 1e-9)).all()
    assert recording.commands == len(steps)
    truth, path = robot.world.robot, np.array(robot.past)
    assert ((path >= truth.limits.lower - 1e-9) & (path <= truth.limits.upper + 1e-9)).all()
    # each leg takes the least number of commands, one more for rounding, and half a second to stand still
    ways = np.vstack([robot.past[:1], recording.targets])
    legs = np.ceil(np.abs(np.diff(ways, axis=0)) / limit - 1e-9).max(axis=1)
    assert legs.sum() <= recording.commands <= legs.sum() + (2 + 13) * len(legs)
    assert robot.calls == ["open", "stop", "close"]
    np.testing.assert_array_equal(read_table("t.csv").at_rest.q, recording.targets)


REAL = {
    "sag and play": {"sag": 0.00873, "play": 0.00873, "lag": 0.05},
    "late": {"late": 0.3, "lag": 0.05},
    "webcam": {"late": 0.12, "lag": 0.15, "rate": 30.0, "noise": 0.5, "tick": 2 * np.pi / 4096},
}


@pytest.mark.parametrize("faults", REAL.values(), ids=REAL)
def test_a_pose_is_recorded_where_joints_and_images_have_come_to_rest(faults):
    config = load_config(UR5, [*TEN, "plant.averaged_frames=5"])
    recording = stage.new_recording(config, Path("t.csv"))
    robot = Arm(config, **faults)
    stage.record(config, recording, driven(config, robot))
    whole = read_table("t.csv")
    table, way = whole.at_rest, whole.rows(whole.moving > 0)
    assert len(table.pose) == len(recording.targets) == 13
    assert 100 < len(way.pose) <= 200
    assert len(np.unique(way.moving)) > 3
    off = robot.sag + robot.play / 2 + robot.tick / 2
    assert np.abs(table.q - recording.targets).max() <= off + 1e-5
    rest = np.array([robot.past[round(1e3 * reading.t_q)] for reading in recording.done.values()])
    clean = np.stack([robot.world.images(q, robot.world.M) for q in rest])
    error = table.images - clean
    # What was seen on the way was so some time before the joints were read.
    then = [robot.shown(t) for t in way.t_q]
    late = way.images - np.stack([robot.world.images(q, robot.world.M) for q in then])
    assert np.nanmax(np.abs(late)) < 0.02 + 6.0 * robot.noise
    assert np.ptp(way.images[:, 0, 0, 0]) > 100.0
    if robot.noise:
        assert recording.spread_px == pytest.approx(0.5, abs=0.03)
        assert np.std(error) == pytest.approx(0.5 / np.sqrt(5), rel=0.1)
    else:
        assert np.abs(error).max() < 0.02


class Stuck(Arm):
    """An arm whose first joint does not go beyond a place."""

    def moved(self):
        self.q[0] = min(self.q[0], 3.7)


class Backwards(Arm):
    """An arm whose second joint turns the other way."""

    def command(self, target, speed, due):
        super().command(np.where(np.arange(6) == 1, 2.0 * self.past[0] - target, target), speed, due)


class Shaking(Arm):
    """An arm whose last joint does not come to rest."""

    def moved(self):
        self.q[5] = self.motor[5] + 0.01 * np.sin(5.0 * self.time)


@pytest.mark.parametrize(
    ("kind", "code", "numbers"),
    [
        (Stuck, "stands_short", (1, 0.485, 4.185, 3.7)),
        (Backwards, "moved_away", (2, 0.557, -1.678, -1.121)),
        (Shaking, "restless", ("joint 6", 20.0)),
    ],
)
def test_a_robot_that_does_not_arrive_is_reported_and_the_rest_kept(kind, code, numbers):
    config = load_config(UR5, TEN)
    recording = stage.new_recording(config, Path("t.csv"))
    robot = kind(config)
    with pytest.raises(WorkFailed) as caught:
        stage.record(config, recording, driven(config, robot))
    (one,) = caught.value.findings
    assert one.code == code
    if code == "restless":
        assert (one.subject.name, one.limit) == numbers
    else:
        found = (*one.subject.joints, one.amount, one.limit, one.others[0].amount)
        assert found == pytest.approx(numbers, abs=0.02)
    assert robot.calls == ["open", "stop", "close"]
    assert recording.pending
    if recording.done:
        assert read_table("t.csv").at_rest.pose.tolist() == list(range(len(recording.done)))


ROOF = (
    "markers={tags: roof, tag_size_m: 0.3}",  # of ten
    "task.goal={roll_deg: 10}",
)


class Masked(Arm):
    """An arm of which both cameras see what a function of the look, its joints and its pixels leaves."""

    def __init__(self, config, seen):
        super().__init__(config, lag=0.05)
        self.seen, self.looks = seen, 0

    def read(self):
        q, s, *more = super().read()
        self.looks += 1
        return q, self.seen(q, s.copy()), *more


def without(view, *markers):
    def seen(q, s):
        s[view, [*markers] or slice(None)] = np.nan
        return s

    return seen


def shrunk(q, s):
    """Images in which the widest tag is 10 px wide."""
    middle, tags = s.mean(axis=1, keepdims=True), s[:, :8].reshape(2, 2, 4, 2)
    side = np.linalg.norm(tags - np.roll(tags, 1, axis=2), axis=-1).max()
    return middle + 10.0 / max(side, 300.0) * (s - middle)


@pytest.mark.parametrize(
    ("seen", "message"),
    [
        (
            without(slice(None)),
            r"neither camera sees one of the 20 markers where the robot stands: .*dictionary",
        ),
        (
            without(1),
            r"the right camera sees none of the 20 markers where the robot stands, the left one 20:",
        ),
        (
            without(0, *range(2, 20)),
            r"both cameras see only 2 of 20 markers where the robot stands \(3 at",
        ),
        (shrunk, r"tags are 10\.\d px wide in the left image .*, 1\.\d+ px a cell \(1\.8 px at least\)"),
    ],
)
def test_what_cannot_be_used_is_named_before_anything_moves(seen, message):
    config = load_config(UR5, [*TEN, *ROOF])
    recording = stage.new_recording(config, Path("t.csv"))
    robot = Masked(config, seen)
    with pytest.raises(WorkFailed, match=f"record: {message}.*; nothing was moved"):
        stage.record(config, recording, driven(config, robot))
    assert robot.sent == []
    assert robot.calls == ["open", "stop", "close"]
    assert not Path("t.csv").exists()


def test_after_each_joint_what_it_showed_must_be_of_use_and_is_kept():
    config = load_config(UR5, [*TEN, *ROOF])
    recording = stage.new_recording(config, Path("t.csv"))
    reference = recording.targets[0]

    def seen(q, s):
        """Joint 2 alone turns the tool away."""
        if abs(q[1] - reference[1]) > 0.1 and abs(q[0] - reference[0]) < 0.01:
            s[0, 2:] = np.nan
        return s

    few = r"only 2 of 20 markers in the 3 poses of joint 2, half of them or more \(3 at least\)"
    with pytest.raises(WorkFailed, match=f"{few}.*calibration.amplitude_deg; then start again with --force"):
        stage.record(config, recording, driven(config, Masked(config, seen)))
    assert read_table("t.csv").at_rest.pose.tolist() == [0, 1, 2, 3, 4]
    # It does not go on until the table is begun anew.
    again, sound = stage.new_recording(config, Path("t.csv")), Masked(config, lambda q, s: s)
    assert again.found == 5
    with pytest.raises(WorkFailed, match="start again"):
        stage.record(config, again, driven(config, sound))
    assert sound.sent == []
    stage.record(config, stage.new_recording(config, Path("t.csv"), force=True), driven(config, sound))
    assert len(np.unique(read_table("t.csv").at_rest.pose)) == 13


SHORT = ("-c", STANFORD, "--set", "calibration.frames_per_joint=4")


def test_suggest_record_calibrate_again(projservo):
    """Suggested poses are recorded and make the next calibration better: the loop a user goes through."""
    first = projservo("--suggest", "calibrate", *SHORT, "-o", "run", "--json")
    assert first.code == 0, first.err
    rows = first.json["suggestions"]
    assert len(rows) == 5
    assert Path(first.json["suggestions_file"]) == Path("run/suggestions.csv").resolve()
    motions = read_joint_list("run/suggestions.csv", "RRPRRR")
    np.testing.assert_array_equal(motions.q, [row["q"] for row in rows])
    with open("run/suggestions.csv", newline="") as file:
        listed = list(csv.DictReader(file))
    assert [int(row["from_pose"]) for row in listed] == [row["from_pose"] for row in rows]
    assert float(listed[2]["delta_q3"]) == rows[2]["delta"][2]
    # Within the limits of the robot, or record would refuse.
    answer = projservo("record", *SHORT, "--motions", "run/suggestions.csv", "-o", "t.csv", "--json")
    assert answer.code == 0, answer.err
    assert answer.json["poses"] == 25 + 5
    np.testing.assert_array_equal(read_table("t.csv", "RRPRRR").q[25:], motions.q)
    again = projservo("calibrate", "--data", "t.csv", "--joints", "RRPRRR", "--noise-px", "0.5", "-o", "two")
    assert again.code == 0, again.err
    # Held out: trial motions of another seed.
    assert projservo("record", *SHORT, "--set", "seed=9", "-o", "v.csv", "-q").code == 0
    errors = [
        projservo("validate", run, "--data", "v.csv", "--json").json["rms_px"] for run in ("run", "two")
    ]
    assert errors[1] < 1.05 * errors[0]
