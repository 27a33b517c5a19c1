"""Boards of known shape: their corners move as one similarity instead of point by point.

A fit of free markers comes first. It places the boards, and judges whether they are as stated.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.special import fdtrc

from projservo_cli.calibration.bundle_adjustment import BOARD, minimize
from projservo_cli.calibration.detections import Detections
from projservo_cli.calibration.prediction import Parameters
from projservo_cli.calibration.robust_fit import Expected, Solution, fit_inliers, fit_joint_noise
from projservo_cli.findings import LIMITS, Finding, Subject
from projservo_cli.geometry.displacements import aligned
from projservo_cli.geometry.invariant_forms import (
    board_steps,
    changes_by_rotations,
    differences_of_lengths,
    distortions_of_boards,
    form_of,
)
from projservo_cli.records import FloatArray, StatedBoard

# Minimum number of corners of a board that a fit of free markers places, else its shape is not used.
_LEAST_CORNERS = 6
# Probability that noise alone contradicts the shape of a board as much.
_BY_CHANCE = 1e-6
# Difference of the pitch of a board from the stated one for a finding, in standard deviations.
_OTHER_PITCH = 4.0
# Change of a form of unit norm by the joints up to which these leave it open.
_INVARIANT = 1e-6
# Ratio of the two smallest sizes of equations for a form, above which they determine it.
_DETERMINED = 1e-3


def with_known_shapes(
    free: Solution, boards: Sequence[StatedBoard], expected: Expected
) -> tuple[Solution, tuple[StatedBoard, ...], list[Finding]]:
    """Fit with the shapes of boards that the images do not contradict; these boards, and findings on others.

    free : fit of all markers as points.
    """
    counts = {board: _placed(board, free) for board in boards}
    placed = [board for board, count in counts.items() if count >= _LEAST_CORNERS]
    findings = [_unplaced(board, count) for board, count in counts.items() if board not in placed]
    solution = _agreeing(free, placed, expected)
    if solution is None and len(placed) > 1:  # which of them it is
        alone = {board: _agreeing(free, [board], expected) is not None for board in placed}
        findings += [_contradicted(board, free) for board, agrees in alone.items() if not agrees]
        placed = [board for board, agrees in alone.items() if agrees]
        solution = _agreeing(free, placed, expected)
    if solution is None:
        return free, (), findings + [_contradicted(board, free) for board in placed]
    return solution, tuple(placed), [*findings, *_other_pitches(solution, placed)]


def _placed(board: StatedBoard, free: Solution) -> int:
    """Number of corners of a board that a fit places, zero if they are on one line."""
    corners = board.positions_of(free.problem.detections.marker)
    found = corners[np.isfinite(corners).all(axis=1)]
    return len(found) if len(found) and np.linalg.matrix_rank(found - found[0]) == 2 else 0


def _unplaced(board: StatedBoard, count: int) -> Finding:
    """Tell that too few corners of a board are known."""
    subject = Subject(name=f"{board.columns}x{board.rows}", markers=(board.first,))
    return Finding("unplaced_board", LIMITS, subject, count, limit=_LEAST_CORNERS, unit="1")


def _agreeing(free: Solution, boards: Sequence[StatedBoard], expected: Expected) -> Solution | None:
    """Fit with the shapes of boards; None without any, or if the images contradict them."""
    solution = _fitted(free, boards, expected) if boards else None
    return None if solution is None or chance(solution, free) < _BY_CHANCE else solution


def _fitted(free: Solution, boards: Sequence[StatedBoard], expected: Expected) -> Solution | None:
    """Fit with the shapes of boards; None if it fails."""
    detections = _on_boards(free.problem.detections, boards)
    problem = free.problem.alike(detections).with_noise(free.problem.tau)
    params = _with_shapes(_upgraded(free, boards), detections, boards)
    start = minimize(problem, params, free.used, robust=True, max_steps=50).params
    found = fit_inliers(problem, start, free.sigma_px, min_px=expected.min_px)
    noise = free.joint_noise
    if found is None or noise is None:
        return found
    if free.problem.tau is None:  # none shows, or exact readings were stated
        return dataclasses.replace(found, joint_noise=noise)
    return fit_joint_noise(found, expected, noise.sigma_q if noise.interval is None else None)


def _on_boards(detections: Detections, boards: Sequence[StatedBoard]) -> Detections:
    """Detections with the board of each marker."""
    which = np.full(detections.marker.size, -1)
    for b, board in enumerate(boards):
        which[np.isfinite(board.positions_of(detections.marker)[:, 0])] = b
    return dataclasses.replace(detections, board=which)


def _with_shapes(params: Parameters, detections: Detections, boards: Sequence[StatedBoard]) -> Parameters:
    """Place the corners of boards by the similarities nearest to where they are."""
    M = params.M.copy()
    for b, board in enumerate(boards):
        on = np.flatnonzero(detections.board == b)
        body = np.pad(board.positions_of(detections.marker[on]), ((0, 0), (0, 1)))
        body -= body.mean(axis=0)
        points, weight = M[None, on, :3], np.ones((1, len(on)))
        R, t = aligned(body, points, weight)
        turned = body @ R[0].T
        size = float((turned * (points[0] - t)).sum() / (body**2).sum())
        M[on, :3] = size * turned + t
    return dataclasses.replace(params, M=M)


def _upgraded(free: Solution, boards: Sequence[StatedBoard]) -> Parameters:
    """Parameters in the frame in which boards are nearest to their shape, where joints leave frames open.

    Rotations about parallel axes, and translations, are rigid motions in many frames.
    """
    params, detections = free.params, free.problem.detections
    exact = changes_by_rotations(params.H_hat[~params.prismatic, :3, :3].swapaxes(-1, -2))
    _, sizes, forms = np.linalg.svd(exact)
    sizes = np.pad(sizes, (0, 6 - len(sizes)))
    left = forms[sizes <= _INVARIANT * max(float(sizes[0]), 1.0)]
    if params.known_arm or len(left) <= 1:
        return params
    v = params.H_hat[params.prismatic, :3, 3]
    steps = np.stack([_steps(board, params, detections) for board in boards])
    rows = np.concatenate([differences_of_lengths(v), distortions_of_boards(steps).reshape(-1, 6)])
    _, sizes, coefficients = np.linalg.svd(rows @ left.T)
    sizes = np.pad(sizes, (0, len(left) - len(sizes)))
    form = form_of(coefficients[-1] @ left)
    values, vectors = np.linalg.eigh(form)
    if sizes[-2] <= _DETERMINED * sizes[0] or values[0] <= 0.0:
        return params
    scale = np.sqrt(v[0] @ form @ v[0]) / np.linalg.norm(v[0]) if len(v) else np.sqrt(values.mean())
    G = np.eye(4)
    G[:3, :3] = (vectors * np.sqrt(values)) @ vectors.T / scale
    back = np.linalg.inv(G)
    H_hat = G @ params.H_hat @ back
    for i in np.flatnonzero(params.prismatic):
        H_hat[i, :3, 3] *= np.linalg.norm(params.H_hat[i, :3, 3]) / np.linalg.norm(H_hat[i, :3, 3])
    return dataclasses.replace(params, P=params.P @ back, H_hat=H_hat, M=params.M @ G.T)


def _steps(board: StatedBoard, params: Parameters, detections: Detections) -> FloatArray:
    """Steps (2, 3) from a corner of a board to the next, along its rows and its columns."""
    corners = board.positions_of(detections.marker)
    on = np.isfinite(corners[:, 0])
    return board_steps(corners[on], params.M[on, :3])


def chance(fixed: Solution, free: Solution) -> float:
    """Probability that noise alone raises the squares of a fit as much by what is known of its parameters."""
    both = fixed.used & free.used
    of_held, of_free = (
        float((one.residual[both] ** 2).sum()) + one.problem.prior_squares(one.params)
        for one in (fixed, free)
    )
    more = free.problem.free - fixed.problem.free
    return float(fdtrc(more, free.dof, max(of_held / of_free - 1.0, 0.0) * free.dof / more))


def _other_pitches(fixed: Solution, boards: Sequence[StatedBoard]) -> Iterator[Finding]:
    """Yield a finding for each board whose pitch by readings in metres is not as stated."""
    params, problem = fixed.params, fixed.problem
    if not (params.known_arm or params.prismatic.any()) or all(board.pitch_m is None for board in boards):
        return
    sizes = fixed.sigma_px * np.linalg.norm(
        fixed.errors().shared[problem.curved.stop + BOARD - 1 :: BOARD], axis=1
    )
    speed = 1.0 if params.known_arm else float(np.linalg.norm(params.H_hat[params.prismatic][0, :3, 3]))
    for board, relative in zip(boards, sizes, strict=True):
        pitch = float(np.linalg.norm(_steps(board, params, problem.detections)[0])) / speed
        if board.pitch_m is not None and abs(pitch - board.pitch_m) > _OTHER_PITCH * relative * pitch:
            subject = Subject(name=f"{board.columns}x{board.rows}", markers=(board.first,))
            yield Finding("other_pitch", LIMITS, subject, pitch, float(relative) * pitch, board.pitch_m, "m")


def _contradicted(board: StatedBoard, free: Solution) -> Finding:
    """Tell how the corners of a board lie, where this is not as stated: longer one way, or bent."""
    params, detections = _upgraded(free, [board]), free.problem.detections
    a, b = _steps(board, params, detections)
    longer = float(np.linalg.norm(a) / np.linalg.norm(b) - 1.0)
    on = np.flatnonzero(np.isfinite(board.positions_of(detections.marker)[:, 0]))
    shaped = _with_shapes(params, _on_boards(detections, [board]), [board]).M[on, :3]
    off = np.linalg.norm(params.M[on, :3] - shaped, axis=1) / np.sqrt(np.linalg.norm(a) * np.linalg.norm(b))
    subject = Subject(name=f"{board.columns}x{board.rows}", markers=(board.first,))
    rms, stretch = float(np.sqrt(np.mean(off**2))), Finding("board_stretch", amount=longer, unit="1")
    return Finding("unused_shape", LIMITS, subject, rms, unit="1", others=(stretch,))
