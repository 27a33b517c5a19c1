"""An empty cache is filled by one process, whose memory goes with it; a filled one is left alone."""

import pytest

from projservo_cli.sweep import compiling
from projservo_cli.sweep.compiling import First, compile_once, first_runs
from projservo_cli.sweep.engine import Here, LocalEngine
from tests.sweep.cases import design


class Counted(LocalEngine):
    """An engine of two that works here, and how often it was asked and ended."""

    def __init__(self, workers=2):
        super().__init__(workers)
        self.asked = self.ended = 0

    def pool(self, *, anew=False):
        """The pool of one."""
        self.asked += 1
        return Here()

    def close(self):
        """Count."""
        self.ended += 1


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache."""
    monkeypatch.setattr(compiling, "CACHE_FOLDER", tmp_path)
    return tmp_path


def filled(cache, name):
    """Put machine code of the loop where the compiler does."""
    (cache / "loop_0123").mkdir(exist_ok=True)
    (cache / "loop_0123" / f"{name}-108.py311.nbi").touch()


def test_only_an_empty_cache_that_several_processes_share_is_filled_first(cache, monkeypatch):
    made, told = [], []
    monkeypatch.setattr(compiling, "first_runs", made.append)
    compile_once(design(), {}, Counted(1), told.append)
    assert made == told == []
    engine = Counted()
    compile_once(design(), {}, engine, told.append)
    assert len(made) == len(told) == engine.asked == engine.ended == 1
    filled(cache, "compiled.run")  # by a run of its own
    compile_once(design(grid={"law": ["exact"]}, set={"control.mode": "track"}), {}, engine, told.append)
    assert len(made) == len(told) == 1
    compile_once(design(), {}, engine, told.append)
    assert len(made) == len(told) == 2
    filled(cache, "trial.without_rehearsal")
    compile_once(design(), {}, engine, told.append)
    monkeypatch.setattr(compiling, "CACHE_FOLDER", None)
    compile_once(design(), {}, engine, told.append)
    assert len(made) == len(told) == 2


@pytest.mark.volume
def test_every_law_is_run_once_and_with_one_calibration(monkeypatch):
    made = []
    run_part = compiling.run_part
    monkeypatch.setattr(compiling, "run_part", lambda part: made.append(run_part(part)))
    noise = {"keys": ["noise.calibration_px", "noise.servo_px"], "values": [0.3, 0.5]}
    found = design(base=["ur5", "paper"], runs=3, grid={"noise": noise, "law": ["stacked", "direct_two"]})
    assert first_runs(First(found, {})) == 2
    assert sorted(found.values(int(one.columns["cell"][0]))["law"] for one in made) == [
        "direct_two",
        "stacked",
    ]
    assert all(one.columns["steps"][0] > 0 for one in made)
