"""Statistics of the calibration over draws of noise, robots and errors."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from projservo_cli.calibration import calibrate, predict, residual_statistics
from projservo_cli.records import BoolArray, FloatArray, Observation, WorkFailed
from projservo_cli.tables import read_table
from tests.calibration.bound import derivative, spread
from tests.calibration.damage import listed, shifted
from tests.calibration.simulated_robot import Robot, around, random_robot, trials

SHARED = Path(__file__).parents[3] / "shared" / "data"
# What is drawn on the noise-free UR5 table: frames, noise in px, share of rows removed.
CASES = {
    "within 20 deg, 1.0 px": ("within", 1.0, 0.0),
    "4 frames a joint, 1.0 px": ("four", 1.0, 0.0),
    "40 % of rows removed, 0.5 px": ("all", 0.5, 0.4),
}
SIGMA = 0.5
NEAREST = 0.3  # m; a robot that brings a marker nearer to a camera is not drawn


@dataclass
class Draws:
    """Mean squared held-out errors of the draws and their Cramér–Rao bounds, px² a coordinate."""

    square: list[float] = field(default_factory=list)
    bound: list[float] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)

    @property
    def ratio(self) -> float:
        """Root mean square over the draws ÷ its bound."""
        return float(np.sqrt(np.mean(self.square) / np.mean(self.bound)))

    @property
    def error(self) -> float:
        """Bootstrap standard error of the ratio."""
        square, bound = np.array(self.square), np.array(self.bound)
        again = np.random.default_rng(0).integers(0, len(square), (2000, len(square)))
        return float(np.sqrt(square[again].mean(axis=1) / bound[again].mean(axis=1)).std())

    @property
    def worst(self) -> float:
        """Largest error of a draw ÷ its bound."""
        return float(np.sqrt(np.max(np.array(self.square) / self.bound)))


def frames(q: FloatArray, reference: FloatArray, which: str) -> BoolArray:
    """Poses (K,) of single-joint trials: all, those within 20°, or four a joint from end to end."""
    offset = q - reference
    if which == "within":
        return np.asarray(np.abs(offset).max(axis=1) <= np.radians(20.0) + 1e-9)
    if which == "all":
        return np.ones(len(q), dtype=np.bool_)
    keep = np.abs(offset).max(axis=1) < 1e-9
    for i in range(q.shape[1]):
        rows = np.flatnonzero(np.abs(offset[:, i]) > 1e-9)
        rows = rows[np.argsort(offset[rows, i])]
        keep[rows[np.linspace(0, len(rows) - 1, 4).round().astype(int)]] = True
    return keep


def noise_draws(case: str, robot: Robot, count: int, first: int = 0) -> Draws:
    """Fresh noise on the noise-free table of the true UR5, calibrated from scratch as a recorded one."""
    which, sigma, removed = CASES[case]
    table = read_table(SHARED / "ur5" / "trials_0.0px.csv", robot.joint_types)
    validation = read_table(SHARED / "ur5" / "validation.csv", robot.joint_types)
    kept = frames(table.q, robot.q_reference, which)
    pose, q, images = table.pose[kept], table.q[kept], table.images[kept]
    J, ahead = derivative(robot, q), derivative(robot, validation.q)
    shape = images.shape
    draws = Draws()
    for seed in range(first, first + count):
        rng = np.random.default_rng([seed, 4])
        noisy = images + sigma * rng.standard_normal(shape)
        gone = rng.random((shape[0], 1, shape[2], 1)) < removed
        noisy[np.broadcast_to(gone, shape)] = np.nan
        try:
            found = calibrate(
                Observation(pose, table.marker, q, noisy), robot.joint_types, source="recorded", seed=seed
            )
        except WorkFailed as error:
            draws.refused.append(f"{seed}: {error}")
            continue
        used = ~np.broadcast_to(gone, shape).ravel()
        draws.square.append(float(np.mean((predict(found, validation.q) - validation.images) ** 2)))
        draws.bound.append(sigma**2 * float((spread(J[used], ahead) ** 2).sum()) / len(ahead))
    return draws


@dataclass
class Robots:
    """Random robots: errors ÷ bounds of those calibrated, χ² as probabilities, and the others."""

    ratio: list[float] = field(default_factory=list)
    probability: list[float] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    rejected: int = 0

    @property
    def good(self) -> int:
        """Robots with χ² within its 1e-4 quantiles and an error up to 1.5 times its bound."""
        within = np.abs(np.array(self.probability) - 0.5) < 0.5 - 1e-4
        return int((within & (np.array(self.ratio) <= 1.5)).sum())


def random_robots(count: int, first: int = 1000) -> Robots:
    """Six joints, up to three prismatic, 10 markers, 0.5 px, 8 frames a joint within ±30° or ±0.15 m.

    Screws are drawn by the rule of ``random_robot``; a robot is rejected where a marker comes nearer
    than 0.3 m to a camera in its trials or the validation poses.
    """
    found = Robots()
    seed = first
    while len(found.ratio) + len(found.refused) < count:
        rng = np.random.default_rng(seed)
        seed += 1
        letters = np.array(list("RRRRRR"))
        letters[rng.choice(6, rng.integers(0, 4), replace=False)] = "P"
        robot = random_robot("".join(letters), rng)
        q, ahead = trials(robot), around(robot, 60, rng)
        if min(robot.depths(q).min(), robot.depths(ahead).min()) < NEAREST:
            found.rejected += 1
            continue
        try:
            calibration = calibrate(robot.observe(q, SIGMA, rng), robot.joint_types, sigma_px=SIGMA)
        except WorkFailed as error:
            found.refused.append(f"{seed - 1}: {error}")
            continue
        J = derivative(robot, ahead)
        square = float(np.mean((predict(calibration, ahead) - robot.images(ahead)) ** 2))
        limit = float((spread(derivative(robot, q), J) ** 2).sum()) / len(J)
        found.ratio.append(float(np.sqrt(square / limit) / SIGMA))
        dof = calibration.dof
        found.probability.append(float(chi2.cdf(calibration.chi2_per_dof * dof, dof)))
    return found


class Found(NamedTuple):
    """What became of a table with 5 % of its readings shifted by up to ±50 px.

    Attributes
    ----------
    median_px : held-out error.
    gross, listed : readings shifted by more than 5σ in some coordinate, and how many of them are listed.
    sound, accused : the other readings, and how many of them are listed.
    """

    median_px: float
    gross: int
    listed: int
    sound: int
    accused: int


def shifted_readings(seed: int) -> Found:
    """The UR5 table with 0.5 px of noise, one view and both views of a marker shifted equally often."""
    table = read_table(SHARED / "ur5" / "trials_0.5px.csv", "RRRRRR")
    observation, wrong = shifted(table, 0.05, SIGMA, seed, both=True)
    calibration = calibrate(observation, "RRRRRR", source="recorded")
    found = listed(calibration)[0]
    ahead = read_table(SHARED / "ur5" / "validation.csv", "RRRRRR")
    sound = int(np.isfinite(table.images[..., 0]).sum()) - len(wrong)
    return Found(
        residual_statistics(calibration, ahead)["median_px"],
        len(wrong),
        len(wrong & found),
        sound,
        len(found - wrong),
    )
