"""Stereo pairs: which two images belong to which joint readings, and what both show of the tags."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from projservo_cli.detection.tags import TagFinder
from projservo_cli.records import FloatArray, InputError, Observation, WorkFailed
from projservo_cli.tables import JointList

_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"})


class Pair(NamedTuple):
    """Both images of one pose."""

    pose: int
    left: Path
    right: Path


def pair_images(left: str, right: str, joints: JointList, where: str) -> list[Pair]:
    """Both images of every pose.

    left, right : a folder, or a pattern such as ``left/*.png``.
    joints : the poses. Named images are looked up by name; with pose numbers, the image of a pose is the one
        whose name ends in its number; else the images are taken in the order of their names.
    where : the file of the poses, for messages.
    Raises InputError when there are no images, or one of a pose is missing or not the only one.
    """
    if joints.left is not None and joints.right is not None:
        sides = [_named(left, joints.left, where), _named(right, joints.right, where)]
    else:
        find = _by_number if joints.numbered else _by_order
        found = [(side, _images(side)) for side in (left, right)]
        sides = [find(side, files, joints.pose.tolist(), where) for side, files in found]
    return [Pair(*row) for row in zip(joints.pose.tolist(), *sides, strict=True)]


def _images(source: str) -> list[Path]:
    """Images of a folder or pattern, in the order of their names, 2 before 10."""
    folder = Path(source)
    if folder.is_dir():
        candidates = list(folder.iterdir())
    else:
        candidates = list(folder.parent.glob(folder.name)) if folder.parent.is_dir() else []
    files = [file for file in candidates if file.is_file() and file.suffix.lower() in _SUFFIXES]
    if not files:
        kinds = " ".join(sorted(suffix[1:] for suffix in _SUFFIXES))
        raise InputError(f"{source}: no images there; give a folder or a quoted pattern of files ({kinds})")
    return sorted(files, key=_natural)


def _natural(file: Path) -> tuple[list[tuple[int, str]], str]:
    parts = re.findall(r"\d+|\D+", file.stem)
    return [(int(part), "") if part.isdecimal() else (-1, part.lower()) for part in parts], file.name


def _named(source: str, names: Sequence[str], where: str) -> list[Path]:
    folder = Path(source) if Path(source).is_dir() else Path(source).parent
    files = [folder / name for name in names]
    for file in files:
        if not file.is_file():
            raise InputError(f"{file}: there is no such image, though {where} names it")
    return files


def _by_order(source: str, files: list[Path], poses: list[int], where: str) -> list[Path]:
    if len(files) != len(poses):
        raise InputError(
            f"{source}: {len(files)} images for the {len(poses)} rows of {where}; name the images in "
            "columns left and right, or number the rows in a column pose"
        )
    return files


def _by_number(source: str, files: list[Path], poses: list[int], where: str) -> list[Path]:
    numbered: dict[int, list[Path]] = {}
    for file in files:
        for number in re.findall(r"\d+", file.stem)[-1:]:
            numbered.setdefault(int(number), []).append(file)
    chosen = []
    for pose in poses:
        fitting = numbered.get(pose, [])
        if len(fitting) != 1:
            names = ", ".join(file.name for file in fitting)
            found = f"the names of {names} end" if fitting else "no image has a name that ends"
            raise InputError(
                f"{source}: {found} in {pose}, the pose of {where}; name the images in columns left and "
                "right, or leave the column pose out to take them in the order of their names"
            )
        chosen.append(fitting[0])
    return chosen


@dataclass
class Findings:
    """What was found in all images."""

    # pixels (4 or 1, 2) of each tag, by pose, view and number of the tag
    images: dict[tuple[int, int, int], FloatArray] = field(default_factory=dict)
    ambiguous: int = 0  # tags left out because they were in an image more than once
    unrefined: int = 0  # corners (or centres) left out because an edge of their tag is not clean
    empty: int = 0  # images without a tag

    @property
    def tags(self) -> list[int]:
        """Numbers of all tags, rising."""
        return sorted({tag for _, _, tag in self.images})


def observe(
    pairs: Sequence[Pair],
    q: FloatArray,
    finder: TagFinder,
    points: str,
    progress: Callable[[str, int, int], None],
) -> tuple[Observation, Findings]:
    """Find tags in pairs of images.

    pairs : both images of each pose.
    q : (K, n) joint readings of the poses.
    finder : of the tags.
    points : ``corners``: corner k of tag t is marker 4 t + k; ``centers``: tag t is marker t.
    progress : told after each pose.
    Raises InputError if an image cannot be read, or has another size than those before it from the same
    camera; WorkFailed if there is no tag in any image, or none that both views saw at a pose.
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
                pixels = corners if points == "corners" else crossing(corners)[None]
                found.unrefined += int(np.isnan(pixels[:, 0]).sum())
                found.images[k, view, tag] = pixels
        progress("detect", k + 1, len(pairs))
    if not found.images:
        raise WorkFailed(
            f"no tag in any of {2 * len(pairs)} images: look whether --dictionary is that of your tags, "
            "and whether a bright margin of one cell surrounds each"
        )
    observation = _observation([pair.pose for pair in pairs], q, found, 4 if points == "corners" else 1)
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
