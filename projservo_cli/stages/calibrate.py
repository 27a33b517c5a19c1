"""Stage calibrate: trial motions or a recorded table in, projective kinematics out."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from projservo_cli.calibration.checks.board_corner_numbering import BoardNumbering
from projservo_cli.calibration.checks.joint_order import undecided_pairs
from projservo_cli.calibration.checks.screening import screened
from projservo_cli.calibration.checks.validation import cross_validate
from projservo_cli.calibration.initial.initialization import Nominal
from projservo_cli.calibration.known_intrinsics import KnownCameras
from projservo_cli.calibration.pipeline import calibrate
from projservo_cli.calibration.refit import refit, since_moved
from projservo_cli.calibration.robust_fit import Solution
from projservo_cli.geometry.flange import FlangeChart
from projservo_cli.geometry.lens import K1
from projservo_cli.image_size import image_sizes
from projservo_cli.messages import lines, with_findings
from projservo_cli.messages.rows_by_code import Setup
from projservo_cli.observations import KnownNoise, Observations
from projservo_cli.planning.pose_selection import FARTHER, Suggestion, region_around, suggest
from projservo_cli.records import (
    ONLY,
    TOOL,
    WORLD,
    Calibration,
    CrossValidation,
    FloatArray,
    InputError,
    IntArray,
    Observation,
    WorkFailed,
    changed,
    coordinate_names,
)
from projservo_cli.simulation.random_streams import NORMAL, SUGGESTIONS, generator
from projservo_cli.stages import Progress, silent
from projservo_cli.stages.record import observed
from projservo_cli.stages.stage_inputs import (
    CalibrationInputs,
    Estimation,
    RefitInputs,
    SuggestionInputs,
    Table,
    Trials,
    of_simulation,
)
from projservo_cli.store.camera_files import read_intrinsics
from projservo_cli.store.files_and_locks import write_whole
from projservo_cli.store.flange_poses import pose_columns
from projservo_cli.store.nominal_robot import read_nominal
from projservo_cli.store.observation_tables import mount_in, read_detections, read_table, to_csv

_Calibrated = tuple[Observation, Calibration, CrossValidation | None]


def run(
    inputs: CalibrationInputs | RefitInputs,
    before: _Calibrated | None = None,
    table: Observations | None = None,
    *,
    progress: Progress = silent,
) -> _Calibrated:
    """Calibrate from a recorded table or from simulated trial motions, or fit a camera again.

    before : the result of the inputs before a refit, if at hand; table : observations of a table, likewise.
    Returns the screened observations, the calibration, and its held-out errors on request.
    """
    if isinstance(inputs, RefitInputs):
        return _refitted(inputs, before or run(inputs.before, progress=progress))
    source = inputs.source
    if isinstance(source, Table):
        seen = recorded(source) if table is None else table
    else:
        seen = simulated(source, progress=progress)
    if inputs.joint_noise is not None:
        seen = replace(seen, noise=seen.noise._replace(joint=inputs.joint_noise))
    return estimate(seen, inputs.estimation, progress=progress)


def _refitted(inputs: RefitInputs, before: _Calibrated) -> _Calibrated:
    """Fit a camera again."""
    old, calibration, _ = before
    kind, path = (calibration.joint_types, inputs.joint_unit), inputs.file.path
    readings = inputs.readings
    seen = (
        read_table(path, *kind, like=calibration)
        if readings is None
        else read_detections(path, readings.path, *kind, like=calibration)
    )
    found = refit(calibration, seen, inputs.view, inputs.image_size, inputs.max_predicted_px)
    return since_moved(old, seen, inputs.view), found, None


def recorded(table: Table) -> Observations:
    """Return the observations of a table."""
    unit, chart = (table.joint_types, table.joint_unit), table.flange_chart
    return Observations.of(
        read_table(table.file.path, *unit, chart=chart)
        if table.readings is None
        else read_detections(table.file.path, table.readings.path, *unit, chart=chart),
        joint_types=table.joint_types,
        image_size=table.image_size,
        noise=KnownNoise(table.noise_px),
        seed=table.seed,
        mount=table.mount or mount_in(table.file.path),
        order_stated=table.order_stated,
    )


def simulated(
    trials: Trials, q: FloatArray | None = None, seed: int | None = None, *, progress: Progress = silent
) -> Observations:
    """Simulate the trial motions, or poses (K, n), rad or m; the observations."""
    observation, noise_px = observed(trials, q, seed, progress=progress)
    observation = replace(observation, flange_chart=trials.joints.flange_chart)
    truth, ideal = of_simulation(trials.truth), trials.driven is None
    normal, straight = truth.noise == NORMAL, not truth.lens[:, K1:].any()
    sizes = tuple(map(tuple, truth.image_size.astype(int).tolist()))
    return Observations.of(
        observation,
        joint_types=trials.joints.types,
        image_size=sizes[0] if len({*sizes}) == 1 else sizes,
        # Where joints or images have faults, χ² of pixel noise alone decides no more than in a recording.
        noise=KnownNoise(noise_px if normal else None, 0.0 if ideal else None, ideal and normal and straight),
        source="simulated",
        seed=trials.motions.seed,
        mount=TOOL if truth.on_tool else WORLD,
    )


def estimate(
    seen: Observations, asked: Estimation, *, progress: Progress = silent
) -> tuple[Observation, Calibration, CrossValidation | None]:
    """Return the screened observations, the calibration, and its held-out errors on request."""
    cameras = known_cameras(seen, asked)
    screening = screened(seen.record, seen.joint_types)
    board = BoardNumbering.by_joints(screening.observation, seen.joint_types)
    held_out: list[CrossValidation] = []
    order: list[IntArray] = []

    def judge(solution: Solution, noise_px: float) -> None:
        """Test the order of the joints, and cross-validate, while the solution is at hand."""
        held_out.clear()
        order.clear()
        if seen.source == "recorded" and not seen.order_stated:  # a simulated arm knows its order
            order.append(undecided_pairs(solution, noise_px))
        if asked.cross_validate is not None:
            on_progress = partial(progress, "cross-validation")
            found = cross_validate(solution, noise_px, asked.cross_validate, seen.seed, on_progress)
            held_out.append(found)

    def fitted_to(observation: Observation) -> Calibration:
        """Calibrate from observations with the given inputs."""
        return calibrate(
            observation,
            seen.joint_types,
            sigma_px=seen.noise_px,
            source="simulated" if seen.exact else "recorded",
            image_size=seen.image_size,
            seed=seen.seed,
            lens=asked.lens,
            init=Nominal(**read_nominal(asked.init.path)) if asked.init is not None else None,
            joint_noise=seen.joint_noise,
            max_predicted_px=asked.max_predicted_px,
            mount=seen.mount,
            joint_model=asked.joint_model,
            boards=asked.boards,
            cameras=cameras,
            fitted=judge,
            progress=progress,
        )

    try:
        if board.turn.any() and not board.decided.all():  # a fit to the others decides on the rest
            board.turn_by(fitted_to(board.of_decided))
        calibration = fitted_to(board.observation)
        while board.turn_by(calibration):
            calibration = fitted_to(board.observation)
    except WorkFailed as error:
        found = [*screening.findings, *board.findings]
        names = coordinate_names(seen.flange_chart)
        setup = Setup(seen.mount, board.observation.view, len(seen.joint_types), names)
        words, findings = "; ".join((str(error), *lines(found, setup))), (*error.findings, *found)
        raise type(error)(words, findings=findings) from error
    calibration = changed(
        calibration,
        source=seen.source,
        placeholders=screening.placeholders,
        unseen_poses=screening.unseen,
        circular_joints=screening.circular,
        undecided_order=order[0] if order else None,
        turned_images=board.images,
    )
    found = [*calibration.open_order, *screening.findings, *board.findings]
    return board.observation, with_findings(calibration, found), next(iter(held_out), None)


def known_cameras(seen: Observations, asked: Estimation) -> KnownCameras | None:
    """Known cameras of all views; None without. Raises InputError for names or sizes that do not fit."""
    if not asked.intrinsics:
        return None
    if asked.lens:
        raise InputError("lenses are known and to be estimated (--intrinsics, --lens): leave one out")
    files = {name: file.path for name, file in asked.intrinsics}
    if {*files} == {ONLY} and len(seen.view) == 1:
        files = {seen.view[0]: files[ONLY]}
    if {*files} != {*seen.view}:
        raise InputError(
            f"intrinsics: of {', '.join(files)}, and the cameras are {', '.join(seen.view)}: name the file "
            "of each, NAME=FILE"
        )
    cameras = [read_intrinsics(files[name]) for name in seen.view]
    sizes = image_sizes(seen.image_size, seen.view)
    for name, camera, size in zip(seen.view, cameras, sizes, strict=True):
        if camera.size is not None and np.isfinite(size).all() and (size != camera.size).any():
            stated, given = (f"{width:.0f}x{height:.0f}" for width, height in (camera.size, size))
            raise InputError(
                f"{files[name]}: is of images of {stated} px, and those of {name} are {given} px"
            )
    K = np.array([camera.K for camera in cameras])
    of_centers = [camera.size or 2.0 * camera.K[:2, 2] for camera in cameras]
    u, v = asked.center_std_fraction * np.array(of_centers, dtype=np.float64).T
    x, y = asked.focal_std_fraction * K[:, (0, 1), (0, 1)].T
    return KnownCameras(K, np.array([one.lens for one in cameras]), np.stack([x, x, u, y, v], axis=1))


def suggest_motions(
    inputs: SuggestionInputs, observation: Observation, calibration: Calibration, count: int, path: Path
) -> tuple[Suggestion, ...]:
    """Write poses that reduce the variance of predictions most, within the joint limits if they are known.

    Predictions are judged over the range of the recorded readings, a little widened. Candidates lie in
    the same range, or for a simulated robot in one three times as wide. ``path`` becomes a list of motions, a
    row each: q1 … qN, from_pose, delta_q1 … delta_qN, revolute joints in the unit of the recorded table; or
    x, y, z, qx, qy, qz, qw of the flange.
    """
    observation = observation.at_rest
    limits = inputs.joints.joints("R" * observation.q.shape[1]).limits
    within = inputs.image_size, limits.lower, limits.upper
    targets = region_around(observation, *within)
    candidates = targets if inputs.recorded else region_around(observation, *within, FARTHER)
    rng = generator(inputs.seed, SUGGESTIONS)
    found = suggest(calibration, observation, candidates, targets, count, rng)
    chart = FlangeChart.from_optional(calibration.flange_chart)
    if chart is not None:
        columns = pose_columns(chart.poses(np.array([one.q for one in found])))
        write_whole(path, to_csv(columns | {"from_pose": np.array([one.from_pose for one in found])}))
        return found
    turn = np.degrees(1.0) if inputs.unit == "deg" else 1.0
    scale = np.array([turn if kind == "R" else 1.0 for kind in calibration.joint_types])
    joints = [f"q{i}" for i in range(1, len(scale) + 1)]
    q, delta = (scale * [getattr(one, name) for one in found] for name in ("q", "delta"))
    columns = dict(zip(joints, q.T, strict=True)) | {"from_pose": np.array([one.from_pose for one in found])}
    columns |= {f"delta_{name}": values for name, values in zip(joints, delta.T, strict=True)}
    write_whole(path, to_csv(columns))
    return found
