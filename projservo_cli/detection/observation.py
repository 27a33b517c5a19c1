"""From pairs of images to an observation, with a count of all that is not in it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from projservo_cli.detection.pairs import Pair
from projservo_cli.detection.tags import TagFinder
from projservo_cli.records import FloatArray, InputError, Observation, WorkFailed

CORNERS, CENTERS = "corners", "centers"


@dataclass
class Findings:
    """What was found in all images.

    Attributes
    ----------
    images : pixels (4 or 1, 2) of each tag, by pose, view and number of the tag.
    ambiguous : tags left out because they were in an image more than once.
    unrefined : corners (or centres) left out because an edge of their tag is not clean.
    empty : images without a tag.
    """

    images: dict[tuple[int, int, int], FloatArray] = field(default_factory=dict)
    ambiguous: int = 0
    unrefined: int = 0
    empty: int = 0

    @property
    def tags(self) -> list[int]:
        """Numbers of all tags, rising."""
        return sorted({tag for _, _, tag in self.images})


def observe(
    pairs: Sequence[Pair],
    q: FloatArray,
    finder: TagFinder,
    points: str = CORNERS,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> tuple[Observation, Findings]:
    """Find tags in pairs of images.

    Parameters
    ----------
    pairs : both images of each pose.
    q : (K, n) joint readings of the poses.
    finder : of the tags.
    points : ``corners``: corner k of tag t is marker 4 t + k; ``centers``: tag t is marker t.
    progress : told after each pose.

    Raises
    ------
    InputError
        If an image cannot be read, or has another size than those before it from the same camera.
    WorkFailed
        If there is no tag in any image, or none that both views saw at a pose.
    """
    found = Findings()
    shapes: dict[int, tuple[int, ...]] = {}
    for k, pair in enumerate(pairs):
        for view, path in enumerate((pair.left, pair.right)):
            image = finder.read(path)
            if shapes.setdefault(view, image.shape) != image.shape:
                height, width = shapes[view]
                raise InputError(
                    f"{path}: {image.shape[1]}×{image.shape[0]} pixels, the images before it "
                    f"{width}×{height}; one camera takes images of one size"
                )
            tags, ambiguous = finder.find(image)
            found.ambiguous += ambiguous
            found.empty += not tags
            for tag, corners in tags.items():
                pixels = corners if points == CORNERS else crossing(corners)[None]
                found.unrefined += int(np.isnan(pixels[:, 0]).sum())
                found.images[k, view, tag] = pixels
        progress("detect", k + 1, len(pairs))
    if not found.images:
        raise WorkFailed(
            f"no tag in any of {2 * len(pairs)} images: look whether --dictionary is that of your tags, "
            "and whether a bright margin of one cell surrounds each"
        )
    observation = _observation([pair.pose for pair in pairs], q, found, 4 if points == CORNERS else 1)
    if not np.isfinite(observation.images[..., 0]).all(axis=1).any():
        raise WorkFailed("no tag was seen by both cameras at the same pose: look whether the images pair up")
    return observation, found


def crossing(corners: FloatArray) -> FloatArray:
    """Crossing (2,) of the diagonals of a quadrilateral (4, 2): the image of the centre of a square."""
    a, b, c, d = np.c_[corners, np.ones(4)]
    u, v, w = np.cross(np.cross(a, c), np.cross(b, d))
    return np.array([u / w, v / w])


def _observation(pose: Sequence[int], q: FloatArray, found: Findings, each: int) -> Observation:
    tags = found.tags
    images = np.full((len(pose), 2, len(tags), each, 2), np.nan)
    for (k, view, tag), pixels in found.images.items():
        images[k, view, tags.index(tag)] = pixels
    marker = np.array([each * tag + corner for tag in tags for corner in range(each)], dtype=np.int64)
    return Observation(
        np.array(pose, dtype=np.int64), marker, q, images.reshape(len(pose), 2, len(marker), 2)
    )
