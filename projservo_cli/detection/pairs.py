"""Which two images belong to which joint readings."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from projservo_cli.records import InputError
from projservo_cli.tables import JointList

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"})


@dataclass(frozen=True)
class Pair:
    """Both images of one pose."""

    pose: int
    left: Path
    right: Path


def pair_images(left: str, right: str, joints: JointList, where: str) -> list[Pair]:
    """Both images of every pose.

    Parameters
    ----------
    left, right : a folder, or a pattern such as ``left/*.png``.
    joints : the poses. Named images are looked up by name; with pose numbers, the image of a pose is
        the one whose name ends in its number; else the images are taken in the order of their names.
    where : the file of the poses, for messages.

    Raises
    ------
    InputError
        When there are no images, or one of a pose is missing or not the only one.
    """
    if joints.left is not None and joints.right is not None:
        sides = [_named(left, joints.left, where), _named(right, joints.right, where)]
    else:
        found = [(side, _images(side)) for side in (left, right)]
        find = _by_number if joints.numbered else _by_order
        sides = [find(side, files, joints, where) for side, files in found]
    poses = joints.pose.tolist()
    return [Pair(pose, *both) for pose, *both in zip(poses, *sides, strict=True)]


def _images(source: str) -> list[Path]:
    """Images of a folder or pattern, in the order of their names, 2 before 10."""
    folder = Path(source)
    if folder.is_dir():
        candidates = list(folder.iterdir())
    else:
        candidates = list(folder.parent.glob(folder.name)) if folder.parent.is_dir() else []
    files = [file for file in candidates if file.is_file() and file.suffix.lower() in SUFFIXES]
    if not files:
        kinds = " ".join(sorted(suffix[1:] for suffix in SUFFIXES))
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


def _by_order(source: str, files: list[Path], joints: JointList, where: str) -> list[Path]:
    if len(files) != len(joints.pose):
        raise InputError(
            f"{source}: {len(files)} images for the {len(joints.pose)} rows of {where}; name the images in "
            "columns left and right, or number the rows in a column pose"
        )
    return files


def _by_number(source: str, files: list[Path], joints: JointList, where: str) -> list[Path]:
    numbered: dict[int, list[Path]] = {}
    for file in files:
        numbers = re.findall(r"\d+", file.stem)
        if numbers:
            numbered.setdefault(int(numbers[-1]), []).append(file)
    chosen = []
    for pose in joints.pose.tolist():
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
