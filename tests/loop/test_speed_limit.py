"""No law, in no mode and in neither loop, commands a joint speed beyond the limit."""

import numpy as np
import pytest

from projservo_cli.control.law import OK
from projservo_cli.laws import CODES
from projservo_cli.loop.python_loop import BuiltInLaw, run_in_python
from projservo_cli.simulation.analytic_plant import AnalyticPlant
from projservo_cli.stages.runs.plugin_law import PluginLaw
from tests.conftest import SHIPPED
from tests.known import configured
from tests.loop.speeds import RUNS, highest_shares
from tests.scene import GAINS, limits, scene, with_pins

# Rounding of a joint step.
ROUND_OFF = 1e-9
# Joint-speed limit of the scene in miniature, rad/s.
SPEED = np.full(6, 1.0)


@pytest.mark.volume
@pytest.mark.parametrize("period", [0.04, 0.1])
@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_law_keeps_the_limit_in_every_mode(path, period):
    shares = highest_shares(configured(path.stem, f"control.period_s={period}"))
    assert {name for name, _ in shares} == set(RUNS) or path.stem == "apart"
    beyond = {run: share for run, share in shares.items() if share > 1.0 + ROUND_OFF}
    assert not beyond


@pytest.mark.volume
def test_every_law_keeps_the_limit_along_a_joint_space_path():
    shares = highest_shares(configured("paper"), ["joint_space"], max_steps=200)
    assert len(shares) == len(RUNS)
    assert max(shares.values()) <= 1.0 + ROUND_OFF


class Recorder(AnalyticPlant):
    """A robot that takes long steps in parts, and keeps what it was sent."""

    takes_parts = True

    def __init__(self, *given):
        super().__init__(*given)
        self.sent = []

    def command(self, step, period):
        self.sent.append((step.copy(), period))
        super().command(step, period)


def sent(law, bounds, sc):
    """Steps (k, 6) that a law sends, rad, and their times (k,), s."""
    seen = len(sc.plant.M) + len(sc.plant.pins)
    plant = Recorder(sc.plant, sc.q_start, np.zeros((bounds.max_steps + 1, 2, seen, 2)))
    run_in_python(law, plant, sc.s_star, GAINS.period, bounds)
    steps, seconds = zip(*plant.sent, strict=True)
    return np.array(steps), np.array(seconds)


def test_every_part_of_a_step_keeps_the_limit_within_the_period():
    speed = 3.0 * SPEED
    bounds, sc = limits(speed=speed, max_steps=8), with_pins(scene())
    gains = GAINS._replace(gain_t=20.0, gain_s=20.0, substeps=True, limits=GAINS.limits._replace(speed=speed))
    steps, seconds = sent(BuiltInLaw(CODES["exact"], sc.model, sc.body_task(), gains), bounds, sc)
    assert len(steps) > bounds.max_steps
    assert (np.abs(steps).max(axis=1) <= 3.0 * seconds * (1.0 + ROUND_OFF)).all()
    assert seconds.sum() == pytest.approx(bounds.max_steps * GAINS.period, rel=1e-9)


@pytest.mark.parametrize("claimed", [-1.0, 0.5, 1.0])
def test_a_law_of_ones_own_keeps_the_limit_whatever_it_claims(claimed):
    """Also one that says that it applied the limit itself."""
    law = PluginLaw(lambda s, q: np.array([100.0, -3.0, 0.0, 1e-3, 2.0, 7.0]), "mine", 2)
    law.share = np.array([claimed])
    bounds = limits(speed=SPEED, max_steps=3, diverged_factor=1e9)
    steps, seconds = sent(law, bounds, scene())
    assert np.abs(steps / seconds[:, None]).max() == pytest.approx(1.0, rel=ROUND_OFF)
    assert law(np.zeros((2, 4, 2)), np.zeros(6))[0] == OK
