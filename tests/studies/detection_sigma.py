"""Whether corners of tags err as they say, on drawn images: ``python -m tests.studies.detection_sigma``.

Tags of 20 to 120 px, tilted by up to 75°, in images blurred by 0.5 to 3 px with noise of 1 to 5 grey levels.
"""

from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.detection import TagFinder
from projservo_cli.records import BoolArray, FloatArray
from tests.detection.rendering import render

SEED, IMAGES = 17, 400
SIDES, TILT, BLURS = (20.0, 120.0), 75.0, (0.5, 3.0)  # px, deg, px
SIZE = (640, 480)
PLACES = [(u, v) for u in (107, 320, 533) for v in (120, 360)]
FAR = 10.0  # of the camera from a tag, in its own lengths
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


def main():
    """Print what is stated against the truth, corners with clean edges and those without."""
    found = errors(IMAGES)
    print(f"{len(found.sigma)} corners, {100 * found.clean.mean():.1f} % with clean edges, seed {SEED}")
    for name, which in (("clean", found.clean), ("others", ~found.clean)):
        some = Errors(*(column[which] for column in found))
        print(f"{name}: mean {some.error.mean(axis=0).round(4)} px")
        for decade, count, ratio in some.by_decade(20):
            print(f"  {decade:g} to {10 * decade:g} px: {count} corners, error over stated {ratio:.2f}")


if __name__ == "__main__":
    main()
