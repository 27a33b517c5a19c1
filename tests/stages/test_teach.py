"""Teaching: what a robot shows where it was moved to, checked, written, and taken as a goal or a start."""

import numpy as np
import pytest

from projservo_cli.config import plain_yaml
from projservo_cli.records import InputError, WorkFailed
from projservo_cli.robots.contract import Reading
from projservo_cli.robots.standstill import averaged
from tests.configured import calibrate, checked, plan, require_face, servo, teach, truth_of
from tests.known import configured

SHARP = ("noise.calibration_px=0.05", "noise.servo_px=0.05")
PLAY = (*SHARP, "disturbance.backlash_deg=0.5")
AT = np.radians([20.0, -5.0, 5.0, -10.0, 80.0])


def config(*overrides):
    return configured("hobby", *SHARP, *overrides)


@pytest.fixture(scope="module")
def calibration():
    return calibrate.run(config())[1]


@pytest.mark.parametrize("lasting", [0.0, 0.3])
def test_frames_are_averaged_by_what_they_tell_of_themselves(rng, lasting):
    """One sharp and two blurred frames a round, part of whose errors lasts and does not average away."""
    sigma, m = [0.1, 1.0, 1.0] * 5, 400
    stays = lasting * rng.standard_normal((2, m, 2))
    readings = [
        Reading(AT, stays + one * rng.standard_normal((2, m, 2)), float(k), np.full(2, float(k)), told)
        for k, one in enumerate(sigma)
        for told in [np.full((2, m), np.hypot(one, lasting))]
    ]
    rest = iter(readings[1:])
    mean, _, count = averaged(readings[0], lambda: next(rest), len(sigma))
    assert (count == len(sigma)).all()
    assert np.sqrt(np.mean(mean.s**2)) == pytest.approx(np.sqrt(np.mean(mean.sigma_px**2)), rel=0.25)
    if lasting == 0.0:
        assert mean.sigma_px == pytest.approx(np.sqrt(1.0 / np.sum(np.array(sigma) ** -2.0)), rel=0.1)


@pytest.mark.volume
def test_with_play_a_taught_goal_is_met_where_joints_would_miss_it(calibration, tmp_path):
    """By what the true pose shows: several times nearer than joints that play in their bearings."""
    given = config(*PLAY)
    path = tmp_path / "goal.yaml"
    path.write_text(plain_yaml(teach(given, 20, AT).as_goal()), encoding="utf-8")
    asked = config(f"task.goal={path}", f"task.start={path}")
    assert asked.task.start.values("RRRRR") == pytest.approx(AT)
    taught = config(*PLAY, f"task.goal={path}", "stop.innovation_threshold=0")
    assert len(taught.task.goal.images.markers) == 8
    trace = servo.run(taught, calibration, plan.run(taught, calibration), "exact_track")
    assert trace.verdict == "converged"
    truth, where = truth_of(given), np.array(taught.task.goal.images.left)
    by_images, by_joints = (truth.images(q, truth.M)[0] - where for q in (trace.q[-1], AT))
    assert np.abs(by_images).max() < 0.4
    assert np.abs(by_joints).max() > 1.5


@pytest.mark.volume
def test_what_does_not_fit_the_calibration_is_told(calibration):
    taught = teach(config(), 10, AT)
    good = checked(config(), calibration, taught)
    assert (good.reached, good.far) == (True, [])
    taught.s[0, 5] += [3.0, 0.0]
    moved = checked(config(), calibration, taught)
    assert moved.reached
    assert [(number, side) for number, side, _ in moved.far] == [(5, "left")]
    assert moved.far[0][2] == pytest.approx(3.0, abs=0.3)
    taught.s[0, :4] += [40.0, 25.0]
    nowhere = checked(config(), calibration, taught)
    assert not nowhere.reached
    assert nowhere.reason
    taught.s[1, 2] = np.nan
    with pytest.raises(WorkFailed, match="right camera does not see marker 2 of the face"):
        require_face(config(), taught)


def test_a_robot_that_can_let_go_is_held_again_before_it_is_looked_at(tmp_path, monkeypatch):
    (tmp_path / "by_hand.py").write_text(
        "import numpy as np\n"
        "class Arm:\n"
        "    falls_at = 0\n"
        "    def __init__(self, **more):\n"
        "        vars(self).update(more)\n"
        "        self.q, self.goal, self.held, self.looks = np.zeros(5), np.full(5, 0.5), True, 0\n"
        "    def open(self): pass\n"
        "    def read(self):\n"
        "        self.looks += 1\n"
        "        if self.looks == self.falls_at: self.q = self.q + [0, 0, 0.856, 0, 0]\n"
        "        return self.q, np.full((2, 8, 2), 100.0 + 10 * self.q[0])\n"
        "    def command(self, target, speed, due):\n"
        "        self.goal = target\n"
        "        if self.held: self.q = target\n"
        "    def stop(self): pass\n"
        "    def close(self): pass\n"
        "    def release(self): self.held, self.q = False, self.q + 0.3\n"
        # Its servos are only switched on again: it leaps to where it was sent last, and sags from there.
        "    def hold(self): self.held, self.q = True, self.goal - 0.01\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    given = config("plant=by_hand:Arm", "control.period_s=0.001", "control.gain=1")
    told = []
    taught = teach(given, 3, None, told.append)
    assert taught.q == pytest.approx(np.full(5, 0.3))  # sent there once more
    assert taught.moved == pytest.approx(np.zeros(5))
    assert taught.frames.tolist() == [1, 1]  # the same image comes again
    assert [words.split(":")[0] for words in told] == [
        "take hold of the arm", "move it to where it is to be", "take your hands away",
    ]  # fmt: skip
    assert teach(given, 1).q == pytest.approx(np.zeros(5))  # nobody there to hold it
    with pytest.raises(InputError, match="move yours by hand"):
        teach(given, 3, AT)
    with pytest.raises(InputError, match="give the joints"):
        teach(config(), 3)
    for words, look, since in (
        (told.append, 4, "since the arm was held again"),
        (None, 200, "while images were taken"),
    ):
        plant = f"plant={{use: 'by_hand:Arm', settle_s: 0.02, options: {{falls_at: {look}}}}}"
        with pytest.raises(WorkFailed, match=rf"joint 3 moved by 49° {since} \(1\.06° at most\)"):
            teach(config(plant, "control.period_s=0.001", "control.gain=1"), 100, None, words)
