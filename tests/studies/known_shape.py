"""Whether 95 % regions of calibrations by a board hold: ``python -m tests.studies.known_shape [--draws N]``.

Poses of the flange, 25 a draw, with a fixed camera, a camera on the flange, and a fixed pair; a board of 8×6
corners as free points and of known shape; 0.3 px. Eight poses without and with intrinsics that are known to
0.5 % of the focal length and 1 % of the image. Arms of parallel axes, 30 poses, by the board. Prints for
each the share of regions that hold the truth: of cameras (on the flange the hand–eye transformation),
intrinsics and corners of the target; the rms error of predicted images over the stated one; of the arms the
rms error of the board's diagonal; and the rms errors of the focal length, px, and of the camera, mm.
"""

import numpy as np

from projservo_cli.calibration.known_intrinsics import KnownCameras
from projservo_cli.calibration.pipeline import calibrate
from projservo_cli.calibration.prediction import predict, prediction_variance
from projservo_cli.geometry.displacements import rigid_inverse
from projservo_cli.geometry.flange import FLANGE_TYPES, FlangeChart
from projservo_cli.geometry.invariant_forms import UPPER
from projservo_cli.records import TOOL, WORLD, Observation, StatedBoard, WorkFailed
from projservo_cli.results import ImageModel
from tests.calibration import board_arms, flange
from tests.studies.common import in_two_processes, parser_of, write_rows
from tests.studies.metric_coverage import held, off

SEED, NOISE_PX, POSES, NEW = 720_000, 0.3, 25, 20
BOARD = StatedBoard(0, 8, 6, flange.PITCH)
DESIGNS = {"fixed": (WORLD, 1), "on the flange": (TOOL, 1), "pair": (WORLD, 2)}
HOW = "points", "shape", "few", "few, K known"
FEW = 8
# Deviations of the entries of K, px: 0.5 % of the focal length and the skew, 1 % of the image for the centre.
DEVIATION = np.array([4.525, 4.525, 12.8, 4.515, 9.6])
VIEWS = "one", "two"
NAMES = "camera", "intrinsics", "target"
COLUMNS = *NAMES, "squares", "length", "focal_px", "place_mm"


def by_flange(job):
    """Regions that hold, and errors of images, of one draw of a design."""
    name, how, number = job
    count = POSES if how < 2 else FEW
    mount, views = DESIGNS[name]
    rng = np.random.default_rng([SEED, number])
    T = flange.poses(rng, count)
    chart, seen = FlangeChart.of(T), flange.images(T, mount, rng, NOISE_PX, views=views)
    observation = Observation(
        *(np.arange(count), np.arange(48), chart.coordinates(T), seen),
        view=VIEWS[:views],
        flange_chart=chart.record,
    )
    K = np.tile(flange.K, (views, 1, 1))
    K[:, *UPPER] += DEVIATION * rng.standard_normal((views, 5))
    lens = np.tile([640.0, 480.0, 640.0, 0.0, 0.0], (views, 1))
    stated = {"cameras": KnownCameras(K, lens, np.tile(DEVIATION, (views, 1)))} if how == 3 else {}
    board = BOARD if how == 1 else None
    found = calibrated(observation, FLANGE_TYPES, board, mount=mount, joint_noise=None, **stated)
    if found is None:
        return None
    there = flange.poses(rng, NEW)
    q = FlangeChart.from_record(found.flange_chart).coordinates(there)
    error = predict(found, q) - flange.images(there, mount, rng, 0.0, views=views)
    cameras = (flange.CAMERAS if mount == WORLD else flange.HANDS)[:views]
    target = flange.BOARD_ON_FLANGE if mount == WORLD else flange.BOARD_ON_TABLE
    X = np.c_[flange.board(), np.ones(48)] @ target.T
    stated = prediction_variance(found, q).sum(axis=-1).mean()
    metric = ImageModel.of(found).metric()
    focal = np.sqrt(np.mean((metric.K - flange.K)[:, 0, 0] ** 2))
    place = 1e3 * np.sqrt(np.mean(np.sum((metric.poses - cameras)[:, :3, 3] ** 2, axis=1)))
    squares = (error**2).sum(axis=-1).mean() / stated
    return *regions(found, np.array(cameras), X[:, :3]), squares, np.nan, focal, place


def by_arm(job):
    """Regions that hold, and the relative error of the board's diagonal, of one draw of an arm."""
    name, number = job
    rng = np.random.default_rng([SEED, 1, number])
    types, observation = board_arms.recording(name, rng, sigma_px=NOISE_PX)
    found = calibrated(observation, types, board_arms.BOARD, image_size=board_arms.SIZE, joint_noise=0.0)
    if found is None:
        return None
    base = board_arms.BASES[name]
    X = np.c_[board_arms.corners(), np.ones(48)][:, :3]
    # The frame of the tool: x from the first corner to the second, z across, its origin amid the corners.
    cameras = rigid_inverse(base) @ board_arms.CAMERAS[0]
    answers = regions(found, cameras[None], X)
    markers = ImageModel.of(found).metric().markers
    length = np.linalg.norm(markers[0] - markers[-1]) / np.linalg.norm(X[0] - X[-1]) - 1.0
    return *answers, np.nan, length, np.nan, np.nan


def calibrated(observation, types, board, **known):
    """The calibration; None if it fails."""
    try:
        boards = () if board is None else (board,)
        return calibrate(observation, types, boards=boards, source="recorded", **known)
    except WorkFailed:
        return None


def regions(found, cameras, X):
    """Shares of the regions of cameras, intrinsics and two corners that hold the truth."""
    metric = ImageModel.of(found).metric()
    K = (metric.K - flange.K)[:, *UPPER]
    shares = (
        held(off(metric.poses, cameras), metric.covariance("poses")),
        held(K, metric.covariance("K")),
        held((metric.markers - X)[[0, 47]], metric.covariance("markers")[[0, 47]]),
    )
    return tuple(float(np.nanmean(one)) for one in shares)


def main():
    """Print a row for each design and each arm."""
    asked = parser_of("known_shape", __doc__, [("draws", 70, "of each design")]).parse_args()
    count, every = asked.draws, []
    names = "".join(f"{name:>12}" for name in NAMES)
    print(f"{'design':28}{'draws':>6}{'failed':>7}{names}  rms/stated  length  focal px  place mm")
    cells = {
        **{
            (name, how): (by_flange, [(name, how, k) for k in range(count)])
            for name in DESIGNS
            for how in range(len(HOW))
        },
        **{(name, 1): (by_arm, [(name, k) for k in range(count)]) for name in board_arms.ARMS},
    }
    for (name, how), (function, jobs) in cells.items():
        found = list(in_two_processes(function, jobs, f"{name}, {HOW[how]}"))
        rows = np.array([row for row in found if row is not None])
        shares = "".join(
            f"{100.0 * share:11.1f} %"[:12].rjust(12) for share in np.nanmean(rows[:, :3], axis=0)
        )
        ratio, length, focal, place = np.sqrt([rows[:, 3].mean(), *np.mean(rows[:, 4:] ** 2, axis=0)])
        title = f"{name}, {HOW[how]}"
        every += [{"design": title, **dict(zip(COLUMNS, row, strict=True))} for row in rows.tolist()]
        errors = f"  {ratio:10.3f}  {length:.2%}  {focal:8.3f}  {place:8.3f}"
        print(f"{title:28}{count:6}{count - len(rows):7}{shares}{errors}", flush=True)
    write_rows(asked.output, every)


if __name__ == "__main__":
    main()
