"""Faults of poses of the flange, named or held.

    python -m tests.studies.flange_faults [--seeds N] [--kinds KIND ...] [-o flange_faults.csv]

Poses of the flange by tables, 25 a draw, by a fixed camera in even draws, on the flange in odd ones, of a
board of 8×6 corners and known shape; 0.3 px. A fault is named where the table is refused, or a finding has
one of its codes. Else the rms error of images at new poses, without the fault, is to be within twice the
stated one; poses of the camera stay such. Prints for each kind how many are named, held, neither, and named
otherwise.
"""

import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from projservo_cli.calibration.pipeline import calibrate
from projservo_cli.calibration.prediction import predict
from projservo_cli.geometry.displacements import rigid, rigid_inverse
from projservo_cli.geometry.flange import FLANGE_TYPES, FlangeChart
from projservo_cli.records import TOOL, WORLD, InputError, Observation, StatedBoard, WorkFailed
from projservo_cli.store.flange_poses import pose_columns, poses_of
from projservo_cli.store.observation_tables import read_joint_list, to_csv
from tests.calibration import flange
from tests.studies.common import in_two_processes, parser_of, write_rows

SEED, POSES, NEW, NOISE_PX = 730_000, 25, 20, 0.3
BOARD = StatedBoard(0, 8, 6, flange.PITCH)
# Of a robot between two poses: the time from one to the next, s, and how far its readings lag behind, s.
BETWEEN_S, LAG_S = 2.0, 0.05


def columns_of(T, **other):
    """Columns of a table of poses, some replaced."""
    return {**pose_columns(T), **other}


def quaternions(T, order):
    """Columns of positions and quaternions, whose numbers are read in an order."""
    numbers = Rotation.from_matrix(T[:, :3, :3]).as_quat()[:, order].T
    return dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), (*T[:, :3, 3].T, *numbers), strict=True))


def vectors(T, factor):
    """Columns of positions and rotation vectors times a factor."""
    numbers = factor * Rotation.from_matrix(T[:, :3, :3]).as_rotvec().T
    return dict(zip(("x", "y", "z", "rx", "ry", "rz"), (*T[:, :3, 3].T, *numbers), strict=True))


def matrices(T):
    """Columns of the rows of matrices."""
    return {f"T{i + 1}{j + 1}": T[:, i, j] for i in range(3) for j in range(4)}


def camera_poses(T, rng, mount):
    """Poses of the camera in the frame of the board, as a detector tells them."""
    del rng
    board = flange.BOARD_ON_FLANGE if mount == WORLD else flange.BOARD_ON_TABLE
    seen = (
        rigid_inverse(T @ board) @ flange.CAMERAS[0]
        if mount == WORLD
        else rigid_inverse(board) @ T @ flange.HAND
    )
    return pose_columns(seen)


def flange_of(columns):
    """Poses (K, 4, 4) of the columns of a table."""
    return poses_of(tuple(name.lower() for name in columns), np.column_stack([*columns.values()]), [""] * 99)


def lagging(T):
    """Poses of a robot that moves from each to the next, read too late by a lag."""
    K, share = len(T), 1.0 - LAG_S / BETWEEN_S
    turns = Slerp(np.arange(K), Rotation.from_matrix(T[:, :3, :3]))
    at = np.maximum(np.arange(K) - (1.0 - share), 0.0)
    places = np.stack([np.interp(at, np.arange(K), T[:, i, 3]) for i in range(3)], axis=1)
    return np.array([rigid(R, t) for R, t in zip(turns(at), places, strict=True)])


def rounded(T):
    """Poses rounded to 1 mm and 0.1° of their rotation vectors."""
    vector, step = Rotation.from_matrix(T[:, :3, :3]).as_rotvec(), np.radians(0.1)
    turns = Rotation.from_rotvec(step * np.rint(vector / step))
    return np.array([rigid(R, t) for R, t in zip(turns, np.round(T[:, :3, 3], 3), strict=True)])


def from_half(T, motion, side):
    """Poses of which the second half is moved: the base before them, or the tool behind."""
    other, half = T.copy(), len(T) // 2
    other[half:] = motion @ T[half:] if side == "base" else T[half:] @ motion
    return other


def motion(rng, shift_m, angle_deg):
    """A rigid motion in a random direction."""
    turn, t = (
        size * v / np.linalg.norm(v)
        for size, v in zip((np.radians(angle_deg), shift_m), rng.normal(size=(2, 3)), strict=True)
    )
    return rigid(Rotation.from_rotvec(turn), t)


def transposed(T):
    """Poses whose rotations are read by columns."""
    other = T.copy()
    other[:, :3, :3] = T[:, :3, :3].swapaxes(1, 2)
    return other


def scaled(T, axis, factor):
    """Poses of which one coordinate has another scale."""
    other = T.copy()
    other[:, axis, 3] *= factor
    return other


# Tables of poses with a fault, by poses, a generator and the mount; and codes that name it.
KINDS = {
    "inverse": (lambda T, rng, mount: pose_columns(rigid_inverse(T)), {"inverse_poses"}),
    "camera": (camera_poses, {"inverse_poses"}),
    "columns": (lambda T, rng, mount: matrices(transposed(T)), {"transposed_rotations"}),
    "quaternion": (lambda T, rng, mount: quaternions(T, [3, 0, 1, 2]), {"scalar_first"}),
    "degrees": (lambda T, rng, mount: vectors(T, np.degrees(1.0)), set()),
    "millimetres": (
        lambda T, rng, mount: pose_columns(np.where(np.eye(4)[3] * [[1], [1], [1], [0]] > 0, 1e3 * T, T)),
        {"other_pitch"},
    ),
    "tool amid": (
        lambda T, rng, mount: pose_columns(from_half(T, motion(rng, 0.03, 0.0), "tool")),
        {"tool", "base", "camera_step", "joint_step"},
    ),
    "lag": (lambda T, rng, mount: pose_columns(lagging(T)), {"lagging_joints"}),
    "rounding": (lambda T, rng, mount: pose_columns(rounded(T)), set()),
    "one scale": (
        lambda T, rng, mount: pose_columns(scaled(T, rng.integers(3), 1.02)),
        {"scale", "other_pitch", "errors_of_place"},
    ),
    "shifted": (None, {"images_after_readings", "images_before_readings"}),
    "base moved": (
        lambda T, rng, mount: pose_columns(from_half(T, motion(rng, 0.01, 1.0), "base")),
        {"base", "tool", "camera_step", "joint_step"},
    ),
}


def judge(job):
    """How one draw of a kind ends, and what was said."""
    kind, number = job
    fault, codes = KINDS[kind]
    mount = TOOL if number % 2 else WORLD
    rng = np.random.default_rng([SEED, list(KINDS).index(kind), number])
    T = flange.poses(rng, POSES + (fault is None))
    written = pose_columns(T[:-1]) if fault is None else fault(T, rng, mount)
    T = T[-POSES:]  # the pairing is shifted by the first pose, of which there is no image
    seen = flange.images(T, mount, rng, NOISE_PX)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "poses.csv")
        path.write_text(to_csv({"pose": np.arange(POSES), **written}))
        try:
            joints = read_joint_list(path, flange=True)
        except InputError as error:
            return row(kind, number, "named", "refused table", error)
    observation = Observation(
        *(np.arange(POSES), np.arange(48), joints.q, seen), view=("eye",), flange_chart=joints.flange_chart
    )
    try:
        found = calibrate(
            observation, FLANGE_TYPES, boards=(BOARD,), source="recorded", joint_noise=None, mount=mount
        )
    except WorkFailed as error:
        said = {one.code for one in error.findings}
        return row(kind, number, "named" if said & codes else "otherwise", " ".join(sorted(said)), error)
    said = {one.code for one in found.findings} | {one.code for f in found.findings for one in f.others}
    if said & codes or not found.usable:
        return row(
            kind, number, "named" if said & codes else "otherwise", " ".join(sorted(said)), found.reason
        )
    there = flange.poses(rng, NEW)
    read = flange_of(camera_poses(there, rng, mount)) if kind == "camera" else there
    q = FlangeChart.from_record(found.flange_chart).coordinates(read)
    error = predict(found, q) - flange.images(there, mount, rng, 0.0)
    ratio = np.sqrt((error**2).sum(axis=-1).mean()) / found.predicted_rms_px
    return row(
        kind,
        number,
        "held" if ratio < 2.0 else "neither",
        f"{ratio:.2f} " + " ".join(sorted(said)),
        found.reason,
    )


def row(kind, number, end, code, words):
    """A row of the table."""
    return {"kind": kind, "number": number, "end": end, "codes": code, "words": str(words)}


def main():
    """Print a row for each kind."""
    asked = parser_of(
        "flange_faults", __doc__, [("seeds", 20, "of each kind")], kinds=tuple(KINDS)
    ).parse_args()
    every, ends = [], ("named", "held", "otherwise", "neither")
    print(f"{'kind':14}" + "".join(f"{end:>11}" for end in ends))
    for kind in asked.kinds:
        rows = list(in_two_processes(judge, [(kind, k) for k in range(asked.seeds)], kind))
        every += rows
        write_rows(asked.output, every)
        print(
            f"{kind:14}" + "".join(f"{sum(one['end'] == end for one in rows):11}" for end in ends), flush=True
        )


if __name__ == "__main__":
    main()
