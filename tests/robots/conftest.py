"""The command line on a robot of others, with a calibration made once."""

import shutil
from pathlib import Path

import pytest

from tests.robots.robots import CALLS

UR5 = Path(__file__).parents[2] / "configs" / "ur5.yaml"


@pytest.fixture(scope="session")
def calibrated(calibrated_run):
    """A run with a calibration and nothing else."""
    return calibrated_run("ur5")


@pytest.fixture
def servo(projservo, calibrated, monkeypatch, tmp_path):
    """Servo with the calibration, the configuration given anew."""
    monkeypatch.chdir(tmp_path)
    CALLS.clear()
    shutil.copytree(calibrated, "run")

    def call(*arguments, law="direct_three"):
        laws = ["--law", law] if law else []
        return projservo("servo", "-c", UR5, "-o", "run", *laws, *arguments)

    return call
