"""Errors of the corners of tags, measured on rendered tags for ``tests.monitoring.corners``.

    python -m tests.studies.corners

takes a few minutes and writes the table beside that module. Tags are drawn over a grid of sides, tilts,
azimuths of the tilt, rolls in the image and blurs, at ten sub-pixel phases each.
"""

import itertools

import numpy as np
from scipy.ndimage import distance_transform_edt

from tests.monitoring.corners import (
    AZIMUTHS,
    CORNERS,
    FINDERS,
    FOCAL,
    FOUND,
    FRESH,
    LASTING,
    LEFT,
    ROLLS,
    SEED,
    SIDES,
    SIZE,
    STATED,
    TABLE,
    TILTS,
    harmonics,
    pose_of,
)
from tests.studies.common import in_two_processes

BLURS = (0.7, 1.8)  # px: a lens in focus, and a frame that is blurred
PHASES, REPEATS = 10, 2
GREYS, NOISE = (35, 215, 120), 2.0  # of black, white and ground; deviation of a pixel
WINDOW = 4  # px to each side of a corner that cornerSubPix looks at
GROSS = 2.0  # px; what is farther off is another corner


def rendered(R, t, shift, blur, number, dictionary):
    """Grey values of a tag before noise, and its true corners (4, 2), px."""
    import cv2

    black, white, ground = GREYS
    n, cell, fine = dictionary.markerSize + 2, 30, 6
    texture = cv2.aruco.generateImageMarker(dictionary, number, n * cell)
    texture = np.where(np.pad(texture, cell, constant_values=255) > 127, white, black).astype(np.uint8)

    def seen(points):
        p = SIZE * points @ R.T + t
        return FOCAL * p[:, :2] / p[:, 2:]

    outer = seen(CORNERS * (n + 2) / n)
    corner = shift + 25.0 - outer.min(axis=0)
    width, height = np.ceil(np.ptp(outer, axis=0) + 2 * 25.0 + 9.0).astype(int).tolist()
    m = texture.shape[0]
    ends = np.array([[-0.5, -0.5], [m - 0.5, -0.5], [m - 0.5, m - 0.5], [-0.5, m - 0.5]])
    there = (outer + corner + 0.5) * fine - 0.5
    H = cv2.getPerspectiveTransform(ends.astype(np.float32), there.astype(np.float32))
    size = width * fine, height * fine
    image = cv2.warpPerspective(texture, H, size, borderMode=cv2.BORDER_CONSTANT, borderValue=ground)
    image = cv2.resize(image.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(image, (0, 0), blur), seen(CORNERS) + corner


def finders():
    """What each finder makes of an image: corners (4, 2) and stated deviations (4,), or None."""
    import cv2

    from projservo_cli.detection.finders import TagFinder

    fine, dictionary = TagFinder("4X4_50"), cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    rough = cv2.aruco.ArucoDetector(dictionary)
    until = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01

    def finder(image, number):
        tag = fine.find(image.astype(float))[0].get(number)
        return None if tag is None else (tag.pixels, tag.sigma)

    def subpix(image, number):
        quads, numbers, _ = rough.detectMarkers(image)
        if numbers is None or number not in numbers:
            return None
        quad = np.reshape(quads[np.ravel(numbers).tolist().index(number)], (4, 1, 2)).copy()
        return cv2.cornerSubPix(image, quad, (WINDOW, WINDOW), (-1, -1), until)[:, 0], np.zeros(4)

    def jpeg(image, number):
        sharp = cv2.addWeighted(image, 2.0, cv2.GaussianBlur(image, (0, 0), 1.2), -1.0, 0.0)
        return subpix(cv2.imdecode(cv2.imencode(".jpg", sharp, [cv2.IMWRITE_JPEG_QUALITY, 80])[1], 0), number)

    return dictionary, (finder, subpix, jpeg)


def measured(job):
    """Rows (finder, corner, column) of one view: a place on the grid, and a seed."""
    (blur, side, tilt, azimuth, roll), seed = job
    rng, (dictionary, all_finders) = np.random.default_rng([SEED, seed]), finders()
    R, t = pose_of(SIDES[side], TILTS[tilt], 2.0 * np.pi * azimuth / AZIMUTHS, 2.0 * np.pi * roll / ROLLS)
    errors = np.full((3, PHASES, REPEATS, 4, 3), np.nan)
    true = np.empty((PHASES, 4, 2))
    for k in range(PHASES):
        phase = (k * np.array([0.7548777, 0.5698403]) + rng.uniform()) % 1.0  # evenly spread
        number = int(rng.integers(50))
        shift = phase + rng.integers(8, size=2)
        clean, true[k] = rendered(R, t, shift, BLURS[blur], number, dictionary)
        for r in range(REPEATS):
            noisy = clean + NOISE * rng.standard_normal(clean.shape)
            noisy = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
            for i, find in enumerate(all_finders):
                if (tag := find(noisy, number)) is not None:
                    errors[i, k, r] = np.column_stack([tag[0] - true[k], tag[1]])
    errors[(np.abs(errors[..., :2]) > GROSS).any(axis=-1)] = np.nan
    rows = np.full((3, 4, FOUND + 1), np.nan)
    for i, corner in np.ndindex(3, 4):
        e = errors[i, :, :, corner]
        both = np.isfinite(e).all(axis=(1, 2))
        rows[i, corner, FOUND] = both.mean()
        if both.sum() < 6:
            continue
        mean, basis = e[both, :, :2].mean(axis=1), harmonics(true[both, corner])
        fresh = np.sqrt(np.mean(np.var(e[both, :, :2], axis=1, ddof=1)))
        solved = np.linalg.solve(basis.T @ basis + 0.3 * np.eye(5), basis.T @ mean)
        left = np.sum((mean - basis @ solved) ** 2) / (2 * (both.sum() - 4)) - fresh**2 / REPEATS
        stated = np.sqrt(np.mean(e[both, :, 2] ** 2))
        rows[i, corner] = [*solved.T.ravel(), np.sqrt(max(left, 0.0)), stated, fresh, both.mean()]
    return rows


def main():
    """Measure the whole table."""
    grid = itertools.product(range(len(BLURS)), range(len(SIDES)), range(len(TILTS)), (0, 1), range(ROLLS))
    jobs = [(place, seed) for seed, place in enumerate(grid)]
    table = np.full((3, len(BLURS), len(SIDES), len(TILTS), AZIMUTHS, ROLLS, FOUND + 1), np.nan)
    for (place, _), rows in zip(jobs, in_two_processes(measured, jobs, "views"), strict=True):
        blur, side, tilt, azimuth, roll = place
        for corner in range(4):  # a corner is another one of the tag turned by a quarter
            around = (azimuth + corner * AZIMUTHS // 4) % AZIMUTHS, (roll - corner * ROLLS // 4) % ROLLS
            table[:, blur, side, tilt, *around] = rows[:, corner]
    known = np.isfinite(table[..., LEFT])
    print("share of views found:", known.mean(axis=(2, 3, 4, 5)).round(3).tolist())
    for i, blur in np.ndindex(known.shape[:2]):  # what was not found errs like the nearest place that was
        near = distance_transform_edt(~known[i, blur], return_distances=False, return_indices=True)
        found = table[i, blur, ..., FOUND].copy()
        table[i, blur] = table[i, blur][tuple(near)]
        table[i, blur, ..., FOUND] = found
    np.savez_compressed(TABLE, **dict(zip(FINDERS, table.astype(np.float16), strict=True)))
    for name, rows in zip(FINDERS, table, strict=True):
        lasting = np.sqrt(np.mean(rows[..., LASTING] ** 2, axis=(-1, -2, -3, -4, -5)) * 5.0)
        rms = [np.sqrt(np.mean(rows[..., i] ** 2, axis=(1, 2, 3, 4))).round(4) for i in (LEFT, STATED, FRESH)]
        print(name, "lasting, left, stated, fresh at both blurs, px:", lasting.round(4), *rms)


if __name__ == "__main__":
    main()
