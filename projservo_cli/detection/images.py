"""Images of poses: files paired with joint readings, and their grey values, read when they are looked at."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from projservo_cli import messages
from projservo_cli.findings import REFUSES, Finding
from projservo_cli.image_size import natural
from projservo_cli.records import FloatArray, InputError, IntArray, JointList

_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"})
# Share of the mean grey value by which the values of the four pixels of a cell of a Bayer mosaic differ at
# least.
_MOSAIC = 0.04


class StoredImage(Protocol):
    """Image that is read when it is looked at. Its text names it in messages."""

    def grey(self) -> FloatArray:
        """Grey values (height, width) from 0 to 255. Raises InputError if it holds none."""


class ImageSeries(NamedTuple):
    """Images of poses."""

    view: tuple[str, ...]  # names of the cameras
    joints: JointList  # numbers of the poses and their readings
    images: Sequence[tuple[StoredImage | None, ...]]  # of each pose, one of each camera, None without one
    moving: IntArray | None = None  # (K,) number of the motion of each pose, 0 at rest
    t_q: FloatArray | None = None  # (K,) time of the readings, s
    t_view: FloatArray | None = None  # (K, V) stamps of the images, s


@dataclass(frozen=True)
class ImageFile:
    """Image of a file."""

    path: Path

    def __str__(self) -> str:
        return str(self.path)

    def grey(self) -> FloatArray:
        """Grey values (height, width), ignoring an orientation tag. Raises InputError if it is no image."""
        try:
            content = self.path.read_bytes()
        except OSError as error:
            raise InputError(f"{self}: cannot be read: {error.strerror or error}") from error
        return decoded(content, str(self))


def decoded(content: bytes, where: str) -> FloatArray:
    """Grey values (height, width) of an image in the form of a file, ignoring its orientation tag.

    Raises InputError that begins with ``where`` if it is no image.
    """
    cv, data = opencv(), np.frombuffer(content, dtype=np.uint8)
    image = cv.imdecode(data, cv.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        raise InputError(f"{where}: not an image that OpenCV can read; save it again, as PNG for example")
    if wrong := unfit(image):
        raise InputError(f"{where}: {messages.sentence_and_remedy(wrong)}")
    if image.ndim > 2:
        image = cv.imdecode(data, cv.IMREAD_GRAYSCALE | cv.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(image, dtype=np.float64)


def pair_images(sources: Mapping[str, str], joints: JointList, where: str) -> ImageSeries:
    """Pair images of files with poses.

    sources : by the name of each view, a folder, or a pattern such as ``left/*.png``.
    joints : the poses. Images are found by their names in the list, otherwise by the pose number at the end
        of their names, or in the order of their names.
    where : file of the poses, for messages.
    Raises InputError if there are no images, or the image of a pose is missing or ambiguous.
    """
    poses = joints.pose.tolist()
    columns = f"column{'s' * (len(sources) > 1)} {' and '.join(sources)}"
    if joints.images is not None:
        sides = [_named(side, joints.images[name], where) for name, side in sources.items()]
    elif joints.numbered:
        sides = [_by_number(side, poses, where, columns) for side in sources.values()]
    else:
        sides = [_images(side) for side in sources.values()]
        for side, files in zip(sources.values(), sides, strict=True):
            if len(files) != len(poses):
                raise InputError(
                    f"{side}: {len(files)} images for the {len(poses)} rows of {where}; name the images in "
                    f"{columns}, or number the rows in a column pose"
                )
    images = [tuple(map(ImageFile, files)) for files in zip(*sides, strict=True)]
    return ImageSeries(tuple(sources), joints, images)


def _images(source: str) -> list[Path]:
    """Images of a folder or pattern, in the order of their names, 2 before 10."""
    files = [file for file in _images_or_not(source) if not file.name.startswith(".")]
    if not files:
        kinds = " ".join(sorted(suffix[1:] for suffix in _SUFFIXES))
        raise InputError(f"{source}: no images there; give a folder or a quoted pattern of files ({kinds})")
    return sorted(files, key=lambda file: (natural(file.stem), file.name))


def hidden_images(source: str) -> list[Path]:
    """Hidden files of a folder or pattern with names of images, as macOS writes next to each; no images."""
    return [file for file in _images_or_not(source) if file.name.startswith(".")]


def _images_or_not(source: str) -> list[Path]:
    """Files of a folder or pattern with names of images."""
    pattern = Path(source, "*") if Path(source).is_dir() else Path(source)
    named = [file for file in pattern.parent.glob(pattern.name) if file.suffix.lower() in _SUFFIXES]
    return [file for file in named if file.is_file()]


def unfit(image: Any) -> Finding | None:
    """Tell why an image as it was read shows no grey values of a scene; None if it does."""
    if image.dtype != np.uint8:
        return Finding("deep_pixels", REFUSES, amount=8 * image.dtype.itemsize, limit=8)
    if image.ndim > 2 or min(image.shape) < 2:
        return None
    even = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
    cells = even.reshape(len(even) // 2, 2, -1, 2).mean(axis=(0, 2), dtype=np.float64)
    if np.ptp(cells) > max(1.0, _MOSAIC * cells.mean()):
        return Finding("mosaic", REFUSES)
    return None


def _named(source: str, names: Sequence[str], where: str) -> list[Path]:
    folder = Path(source) if Path(source).is_dir() else Path(source).parent
    files = [folder / name for name in names]
    for file in files:
        if not file.is_file():
            raise InputError(f"{file}: there is no such image, though {where} names it")
        if files.count(file) > 1:
            raise InputError(f"{file}: {where} names it in {files.count(file)} rows; an image shows one pose")
    return files


def _by_number(source: str, poses: list[int], where: str, columns: str) -> list[Path]:
    files, chosen = _images(source), []
    for pose in poses:
        fitting = [file for file in files if [*map(int, re.findall(r"\d+", file.stem))][-1:] == [pose]]
        if len(fitting) != 1:
            names = ", ".join(file.name for file in fitting)
            ending = f"the names of {names} end" if fitting else "no image has a name that ends"
            raise InputError(
                f"{source}: {ending} in {pose}, the pose of {where}; name the images in {columns}, "
                "or leave the column pose out to take them in the order of their names"
            )
        chosen += fitting
    return chosen


def opencv() -> Any:
    """Return the module of OpenCV; an InputError names the package to install."""
    try:
        import cv2
    except ImportError as error:
        raise InputError("tags and cameras need OpenCV: pip install '.[detect]'") from error
    if not hasattr(getattr(cv2, "aruco", None), "ArucoDetector"):
        raise InputError(f"tags need OpenCV 4.7 or newer, not {cv2.__version__}: pip install '.[detect]'")
    return cv2
