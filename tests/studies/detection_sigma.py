"""Whether corners err as they say, on drawn images: ``python -m tests.studies.detection_sigma``.

Tags of 20 to 120 px, tilted by up to 75°, in images blurred by 0.5 to 3 px with noise of 1 to 5 grey levels;
boards with squares of 12 to 40 px, tilted by up to 60°, in images of several kinds.
"""

from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.detection.finders import Board, BoardFinder, TagFinder
from projservo_cli.records import BoolArray, FloatArray
from tests.detection.boards import drawn, view_of
from tests.detection.rendering import render

SEED, IMAGES = 17, 400
SIDES, TILT, BLURS = (20.0, 120.0), 75.0, (0.5, 3.0)  # px, deg, px
SIZE = (640, 480)
PLACES = [(u, v) for u in (107, 320, 533) for v in (120, 360)]
FAR = 10.0  # of the camera from a tag, in its own lengths
BOARDS, IMAGES_OF_BOARDS, SQUARES = ("chessboard:9x6", "charuco:10x7"), 24, (12.0, 40.0)  # px
# Blur, px, and noise, grey levels, of a kind of image, from least to most.
KINDS = {
    "sharp": ((0.0, 0.0), (0.0, 2.0)),
    "nearly sharp": ((0.2, 0.5), (0.5, 3.0)),
    "blurred": ((0.5, 1.5), (0.5, 3.0)),
    "much blurred": ((1.5, 3.0), (0.5, 3.0)),
    "noisy": ((0.0, 1.5), (8.0, 25.0)),
}
SPECKLED = "speckled"  # light in half of the pixels, by chance, as of a projector of infrared dots
TAGS = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)


class Errors(NamedTuple):
    """Corners that were found in all images."""

    error: FloatArray  # (n, 2) px
    sigma: FloatArray  # (n,) as stated, px
    clean: BoolArray  # (n,)

    def by_decade(self, least=60):
        """Root mean square error over root mean square of what is stated, by decade that has so many."""
        decade = np.floor(np.log10(self.sigma)).astype(int)
        for k in np.unique(decade):
            here = decade == k
            if here.sum() >= least:
                square = np.mean(self.error[here] ** 2) / np.mean(self.sigma[here] ** 2)
                yield 10.0**k, int(here.sum()), float(np.sqrt(square))


def seen(side, tilt, center, rng):
    """Corners (4, 2) of a tag in perspective, px."""
    about, across = rng.uniform(0.0, 2.0 * np.pi, 2)
    square = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
    X = Rotation.from_euler("ZXZ", [across, tilt, about]).apply(square)
    return center + side * X[:, :2] / (1.0 + X[:, 2:] / FAR)


def errors(images, seed=SEED, sides=SIDES, tilt=TILT, blurs=BLURS):
    """What is found in so many images, beside the truth.

    sides : of tags, px; tilt : at most, deg; blurs : of images, px.
    """
    finder, rng, found = TagFinder("4X4_50"), np.random.default_rng(seed), []
    for _ in range(images):
        tags = {
            10 * k: seen(np.exp(rng.uniform(*np.log(sides))), np.radians(rng.uniform(0.0, tilt)), at, rng)
            for k, at in enumerate(rng.permutation(PLACES)[:5] + rng.uniform(-3.0, 3.0, (5, 2)))
        }
        blur, noise = rng.uniform(*blurs), rng.uniform(1.0, 5.0)
        image = render(cv2, TAGS, SIZE, list(tags.items()), blur=blur, noise=noise, rng=rng)
        for number, tag in finder.find(image.astype(np.float64))[0].items():
            known = np.isfinite(tag.sigma)
            off = tag.pixels - tags[number]
            found += zip(off[known], tag.sigma[known], tag.clean[known], strict=True)
    return Errors(*(np.array(column) for column in zip(*found, strict=True)))


def speckled(image, rng):
    """Image that is lit in half of its pixels, and four tenths as bright in the others."""
    return np.round(image * np.where(rng.random(image.shape) < 0.5, 1.0, 0.4)).astype(np.uint8)


def errors_of_boards(board, kind, images, seed=SEED):
    """Corners found in so many images of a board, beside the truth, and the number of images without one."""
    board, rng, found, lost = Board.of(board), np.random.default_rng(seed), [], 0
    finder, (blurs, noises) = BoardFinder(board, "4X4_250"), KINDS.get(kind, ((0.0, 1.0), (0.0, 2.0)))
    for _ in range(images):
        H = view_of(rng, np.exp(rng.uniform(*np.log(SQUARES))))
        image, true = drawn(board, H, rng.uniform(*blurs), rng.uniform(*noises), rng)
        image = speckled(image, rng) if kind == SPECKLED else image
        corners = finder.find(image.astype(np.float64))[0].get(0)
        known = np.zeros(len(true), dtype=bool) if corners is None else np.isfinite(corners.sigma)
        lost += not known.any()
        if known.any():
            ends = [true, true[::-1]]  # a board is numbered from either end
            true = min(ends, key=lambda end: np.linalg.norm(corners.pixels - end, axis=1)[known].max())
            found += zip(
                (corners.pixels - true)[known], corners.sigma[known], corners.clean[known], strict=True
            )
    return Errors(*(np.array(column) for column in zip(*found, strict=True))) if found else None, lost


def main():
    """Print what is stated against the truth, corners with clean edges and those without."""
    found = errors(IMAGES)
    print(f"{len(found.sigma)} corners, {100 * found.clean.mean():.1f} % with clean edges, seed {SEED}")
    for name, which in (("clean", found.clean), ("others", ~found.clean)):
        some = Errors(*(column[which] for column in found))
        print(f"{name}: mean {some.error.mean(axis=0).round(4)} px")
        for decade, count, ratio in some.by_decade(20):
            print(f"  {decade:g} to {10 * decade:g} px: {count} corners, error over stated {ratio:.2f}")
    for board in BOARDS:
        for kind in (*KINDS, SPECKLED):
            off, lost = errors_of_boards(board, kind, IMAGES_OF_BOARDS)
            if off is None:
                print(f"{board}, {kind}: no corners in any image")
                continue
            rms, stated = (np.sqrt(np.mean(of**2)) for of in (off.error, off.sigma))
            print(
                f"{board}, {kind}: {len(off.sigma)} corners, {lost} of {IMAGES_OF_BOARDS} images without, "
                f"error {rms:.4f} px, over stated {rms / stated:.2f}"
            )


if __name__ == "__main__":
    main()
