"""Data sets as LeRobot writes them, of version 2.1 and 3.0, by Parquet and MP4."""

import dataclasses
import json
from fractions import Fraction
from itertools import pairwise

import numpy as np

FPS = 30
HOLD = 6  # frames for which the arm rests at each pose
BETWEEN = 4  # frames of the motion to the next
DELAY = 2  # frames by which images are late


def frames_of(poses):
    """States (F, n) of an episode that rests at poses (K, n)."""
    q = [poses[0]] * HOLD
    for a, b in pairwise(poses):
        q += [a + (b - a) * i / (BETWEEN + 1) for i in range(1, BETWEEN + 1)] + [b] * HOLD
    return np.array(q)


def write_video(path, images):
    """Write grey images as an MP4 at 30 Hz, without loss that matters to corners."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(
            "libx264", rate=FPS, options={"crf": "10", "g": "2", "preset": "ultrafast"}
        )
        stream.height, stream.width = images[0].shape
        stream.pix_fmt, stream.time_base = "yuv420p", Fraction(1, FPS)
        for k, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="gray")
            frame.pts, frame.time_base = k, Fraction(1, FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_dataset(folder, version, episodes, names, *, as_images=False, **state):
    """Write episodes, each its states (F, n) and its images by camera (F of each).

    state : more of the description of the states, such as ``units``.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    (folder / "meta").mkdir(parents=True)
    new = version == "v3.0"
    cameras = list(episodes[0][1])
    keys = {name: f"observation.images.{name}" for name in cameras}
    place = "chunk-{chunk_index:03d}/file-{file_index:03d}" if new else ""
    old = "episode_{episode_index:06d}"
    info = {
        "codebase_version": version,
        "fps": FPS,
        "chunks_size": 1000,
        "data_path": f"data/{place}.parquet" if new else f"data/chunk-{{episode_chunk:03d}}/{old}.parquet",
        "video_path": f"videos/{{video_key}}/{place}.mp4"
        if new
        else f"videos/chunk-{{episode_chunk:03d}}/{{video_key}}/{old}.mp4",
        "features": {
            "observation.state": {"dtype": "float32", "shape": [len(names or ())], "names": names, **state},
            **{key: {"dtype": "image" if as_images else "video", "names": None} for key in keys.values()},
        },
    }
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    tables, rows, first = [], [], 0.0
    for e, (q, images) in enumerate(episodes):
        table = {
            "observation.state": pa.array(np.float32(q).tolist(), type=pa.list_(pa.float32())),
            "timestamp": pa.array(np.float32(np.arange(len(q)) / FPS)),
            "frame_index": pa.array(np.arange(len(q))),
            "episode_index": pa.array(np.full(len(q), e)),
        }
        if as_images:
            import cv2

            for name, key in keys.items():
                cells = [
                    {"bytes": cv2.imencode(".png", one)[1].tobytes(), "path": None} for one in images[name]
                ]
                table[key] = pa.array(cells)
        tables.append(pa.table(table))
        row = {"episode_index": e, "length": len(q), "data/chunk_index": 0, "data/file_index": 0}
        for key in keys.values():
            row |= {f"videos/{key}/{part}_index": 0 for part in ("chunk", "file")}
            row |= {f"videos/{key}/from_timestamp": first, f"videos/{key}/to_timestamp": first + len(q) / FPS}
        rows.append(row)
        first += len(q) / FPS
    if new:
        (folder / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
        pq.write_table(
            pa.Table.from_pylist(rows), folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
        )
        (folder / "data" / "chunk-000").mkdir(parents=True)
        pq.write_table(pa.concat_tables(tables), folder / "data" / "chunk-000" / "file-000.parquet")
    else:
        lines = [json.dumps({"episode_index": row["episode_index"], "length": row["length"]}) for row in rows]
        (folder / "meta" / "episodes.jsonl").write_text("\n".join(lines) + "\n")
        (folder / "data" / "chunk-000").mkdir(parents=True)
        for e, table in enumerate(tables):
            pq.write_table(table, folder / "data" / "chunk-000" / f"episode_{e:06d}.parquet")
    if as_images:
        return
    for name, key in keys.items():
        if new:
            every = [image for _, images in episodes for image in images[name]]
            write_video(folder / "videos" / key / "chunk-000" / "file-000.mp4", every)
        else:
            for e, (_, images) in enumerate(episodes):
                write_video(folder / "videos" / "chunk-000" / key / f"episode_{e:06d}.mp4", images[name])


# Centres of three tags on the tool, m, their side, and images.
FACES, SIDE, SIZE = {0: (-0.12, 0.0, 0.0), 5: (0.12, 0.02, 0.05), 9: (0.0, 0.14, -0.03)}, 0.1, (640, 512)
AMPLITUDE_DEG = 25.0


def make_episodes(rng, count, moved, poses=5):
    """Episodes of an arm of three joints and a gripper, in degrees, before cameras top and side.

    Camera top turns before episode ``moved``. Returns the episodes, and by how much its images move, px.
    """
    import cv2
    from scipy.linalg import expm

    from tests.calibration.simulated_robot import Robot, rig
    from tests.detection.rendering import render
    from tests.samples import revolute

    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * SIDE / 2
    points = np.concatenate([corners + place for place in FACES.values()])
    axes = [
        ((0.1, 0.3, 0.0), (0.0, 0.1, 1.0)),
        ((0.0, 0.0, 0.3), (0.1, 1.0, 0.0)),
        ((0.0, 0.2, 0.1), (1.0, 0.0, 0.1)),
    ]
    twists = np.array([revolute(np.array(point), np.array(axis)) for point, axis in axes])
    cameras = np.diag([0.5, 0.5, 1.0]) @ rig(baseline=0.25)
    arm = Robot("RRR", twists, cameras, np.c_[points, np.ones(len(points))], np.zeros(3))
    turn = expm(np.cross(np.eye(3), [0.0, 0.02, 0.01]))
    K = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 256.0], [0.0, 0.0, 1.0]])
    other = cameras.copy()
    other[0] = K @ turn @ np.linalg.solve(K, cameras[0])
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    found, by_px = [], []
    for e in range(count):
        q = frames_of(np.c_[AMPLITUDE_DEG * rng.uniform(-1, 1, (poses, 3)), np.full(poses, 40.0)])
        shown = np.radians(q[np.maximum(np.arange(len(q)) - DELAY, 0), :3])
        plain = arm.images(shown)
        pixels = dataclasses.replace(arm, cameras=other).images(shown) if e >= moved else plain
        by_px.append(np.square(pixels[:, 0] - plain[:, 0]).sum(axis=-1).mean())
        images = {"top": [], "side": []}
        for k, row in enumerate(shown):
            for each, s in zip(images.values(), pixels[k], strict=True):
                quads = zip(FACES, s.reshape(3, 4, 2), strict=True)
                same = k and (row == shown[k - 1]).all()
                each.append(
                    each[-1] if same else render(cv2, tags, SIZE, [*quads], blur=0.7, noise=2, rng=rng)
                )
        found.append((q, images))
    return found, float(np.sqrt(np.mean(by_px[moved:])))
