"""Markers found in stereo images: ArUco and AprilTag corners to a fraction of a pixel.

Which two images belong to which joint readings, tags in one image by OpenCV, and what all images show.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares
from scipy.special import ndtr

from projservo_cli.records import ByteArray, FloatArray, InputError, Observation, WorkFailed
from projservo_cli.tables import JointList

_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"})


def pair_images(left: str, right: str, joints: JointList, where: str) -> list[tuple[int, Path, Path]]:
    """Number of the pose and both images, of every pose.

    left, right : a folder, or a pattern such as ``left/*.png``.
    joints : the poses. Named images are looked up by name; with pose numbers, the image of a pose is the one
        whose name ends in its number; else the images are taken in the order of their names.
    where : the file of the poses, for messages.
    Raises InputError when there are no images, or one of a pose is missing or not the only one.
    """
    poses = joints.pose.tolist()
    if joints.left is not None and joints.right is not None:
        sides = [_named(left, joints.left, where), _named(right, joints.right, where)]
    elif joints.numbered:
        sides = [_by_number(side, poses, where) for side in (left, right)]
    else:
        sides = [_images(left), _images(right)]
        for side, files in zip((left, right), sides, strict=True):
            if len(files) != len(poses):
                raise InputError(
                    f"{side}: {len(files)} images for the {len(poses)} rows of {where}; name the images in "
                    "columns left and right, or number the rows in a column pose"
                )
    return list(zip(poses, *sides, strict=True))


def _images(source: str) -> list[Path]:
    """Images of a folder or pattern, in the order of their names, 2 before 10."""
    pattern = Path(source, "*") if Path(source).is_dir() else Path(source)
    files = [file for file in pattern.parent.glob(pattern.name) if file.suffix.lower() in _SUFFIXES]
    files = [file for file in files if file.is_file()]
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


def _by_number(source: str, poses: list[int], where: str) -> list[Path]:
    files, chosen = _images(source), []
    for pose in poses:
        fitting = [file for file in files if [*map(int, re.findall(r"\d+", file.stem))][-1:] == [pose]]
        if len(fitting) != 1:
            names = ", ".join(file.name for file in fitting)
            found = f"the names of {names} end" if fitting else "no image has a name that ends"
            raise InputError(
                f"{source}: {found} in {pose}, the pose of {where}; name the images in columns left and "
                "right, or leave the column pose out to take them in the order of their names"
            )
        chosen += fitting
    return chosen


_ROUNDS = 3  # samples are taken anew around the sides that were found
_LEAST_REACH = 1.5  # px on either side of an edge: less is no profile
_MOST_REACH = 6.0
_LEAST_BLUR = 0.2  # px: a sharper edge cannot be told
_SPOILT = 0.2  # of the contrast: rms residual of a profile that something covers
_BORDER = 2  # cells of border along a side of a tag, besides those of its code
_SPOILT_SHARE = 0.25  # of the profiles of a side that may be covered


def refine_corners(image: FloatArray, corners: FloatArray, cells: int) -> FloatArray:
    """Corners of a tag from the edges between its black border and the bright ground around it.

    image : (height, width) grey values; pixel centres have whole coordinates.
    corners : (4, 2) u, v of a first guess within about two pixels, px, in order around the tag.
    cells : of the tag along a side, border included; the border is one cell wide.
    Returns (4, 2) px; NaN where one of the two sides of a corner has no clean edge.
    """
    guess = np.asarray(corners, dtype=np.float64)
    for _ in range(_ROUNDS):
        lines = [_fit_side(image, guess, side, cells) for side in range(4)]
        crossings = np.array([np.cross(lines[k - 1], lines[k]) for k in range(4)])
        with np.errstate(divide="ignore", invalid="ignore"):
            refined = np.asarray(crossings[:, :2] / crossings[:, 2:])
        guess = np.where(np.isfinite(refined), refined, corners)
    farthest = 2.0 + 0.05 * float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).max())
    refined[~(np.linalg.norm(refined - corners, axis=1) <= farthest)] = np.nan
    return refined


def _fit_side(image: FloatArray, corners: FloatArray, side: int, cells: int) -> FloatArray:
    """Line (3,) of the edge from corner ``side`` to the next, l·(u, v, 1) = 0; NaN without a clean edge.

    Profiles across the edge are fitted together by b + a Φ((n − n_0 − k t)/σ), Φ the normal
    distribution: an edge straight in t and blurred by σ.
    """
    none = np.full(3, np.nan)
    start, end = corners[side], corners[(side + 1) % 4]
    length = float(np.linalg.norm(end - start))
    if not length > 4.0 * _LEAST_REACH:
        return none
    along = (end - start) / length
    normal = np.array([along[1], -along[0]])
    depth = float(normal @ (start - corners.mean(axis=0)))
    if depth < 0.0:
        normal, depth = -normal, -depth
    reach = min(0.65 * 2.0 * depth / cells, _MOST_REACH)
    if reach < _LEAST_REACH:
        return none
    margin = 0.12 * length + 1.0
    t = np.linspace(margin, length - margin, max(8, min(64, int(length))))
    n = np.linspace(-reach, reach, 2 * int(np.ceil(2.0 * reach)) + 1)
    place = start[:, None, None] + along[:, None, None] * t[:, None] + normal[:, None, None] * n
    size = np.array(image.shape[::-1])[:, None, None]
    if ((place < 0.0) | (place > size - 1.0)).any():
        return none
    grey = map_coordinates(image, place[::-1], order=1)
    fit = _fit_edge(grey, t / length - 0.5, n, reach)
    if fit is None:
        return none
    offset, slope = fit
    middle = start + along * (0.5 * length) + normal * offset
    direction = along * length + normal * slope
    return np.asarray(np.cross(np.append(middle, 1.0), np.append(direction, 0.0)))


def _fit_edge(grey: FloatArray, t: FloatArray, n: FloatArray, reach: float) -> tuple[float, float] | None:
    """Offset n_0 and slope k of an edge in its profiles (T, N); None where they show no clean edge.

    Profiles that something covers are left out and the rest fitted again, if few are.
    """
    noise = float(np.median(np.abs(np.diff(grey, axis=0))))  # about the standard deviation of a pixel
    clean = np.ones(len(t), dtype=bool)
    while clean.mean() >= 1.0 - _SPOILT_SHARE:
        x = _least_squares(grey[clean], t[clean], n, reach)
        if x is None:
            return None
        residual, _ = _edge_model(x, grey, t, n)
        spoilt = np.sqrt(np.mean(residual**2, axis=1)) > max(_SPOILT * x[1], 3.0 * noise)
        if not (spoilt & clean).any():
            return float(x[2]), float(x[3])
        clean &= ~spoilt
    return None


def _least_squares(grey: FloatArray, t: FloatArray, n: FloatArray, reach: float) -> FloatArray | None:
    """Edge (b, a, n_0, k, σ) through all profiles; None where it is not one from dark to bright."""
    low, high = float(grey[:, : len(n) // 4].mean()), float(grey[:, -(len(n) // 4) :].mean())
    if not high > low:
        return None
    found = least_squares(
        lambda x, *profiles: _edge_model(x, *profiles)[0].ravel(),
        [low, high - low, 0.0, 0.0, 1.0],
        lambda x, *profiles: _edge_model(x, *profiles)[1],
        method="lm",
        x_scale=[1.0, 1.0, reach, reach, reach],
        args=(grey, t, n),
    )
    x = found.x
    return x if x[1] > 0.0 and abs(x[2]) + 0.5 * abs(x[3]) < reach else None


def _edge_model(
    x: FloatArray, grey: FloatArray, t: FloatArray, n: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residual (T, N) of an edge x = (b, a, n_0, k, σ) and its derivative (T N, 5)."""
    b, a, n_0, k, sigma = *x[:4], max(x[4], _LEAST_BLUR)
    z = (n - n_0 - k * t[:, None]) / sigma
    phi = ndtr(z)
    bell = -a * np.exp(-0.5 * z * z) / (np.sqrt(2.0 * np.pi) * sigma)
    J = np.stack([np.ones_like(z), phi, bell, bell * t[:, None], bell * z], axis=-1)
    return b + a * phi - grey, J.reshape(-1, 5)


class TagFinder:
    """Finds the tags of one dictionary.

    dictionary : name as OpenCV has it, with or without ``DICT_``, any case: ``4X4_50``, ``APRILTAG_36H11``.
    ``cv``: the module of OpenCV.
    Raises InputError when OpenCV is not installed or does not know the dictionary.
    """

    def __init__(self, dictionary: str) -> None:
        self.cv = _opencv()
        aruco = self.cv.aruco
        known = {name.upper().removeprefix("DICT_"): name for name in dir(aruco) if name.startswith("DICT_")}
        name = known.get(dictionary.upper().removeprefix("DICT_"))
        if name is None:
            raise InputError(f"--dictionary {dictionary}: unknown; valid: {', '.join(sorted(known))}")
        self._tags = tags = aruco.getPredefinedDictionary(getattr(aruco, name))
        parameters = aruco.DetectorParameters()
        parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
        self._detector = aruco.ArucoDetector(tags, parameters)
        self._cells = int(tags.markerSize) + _BORDER

    def read(self, path: Path) -> FloatArray:
        """Grey values (height, width) of an image as the camera took it, unturned.

        Raises InputError when the file is not an image.
        """
        try:
            content = np.frombuffer(path.read_bytes(), dtype=np.uint8)
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
        flags = self.cv.IMREAD_GRAYSCALE | self.cv.IMREAD_IGNORE_ORIENTATION
        image = self.cv.imdecode(content, flags) if content.size else None
        if image is None:
            raise InputError(f"{path}: not an image that OpenCV can read; save it again, as PNG for example")
        return np.asarray(image, dtype=np.float64)

    def picture(self, number: int, cell_px: int) -> ByteArray:
        """Grey values of a tag with its bright margin of one cell, in cells of so many px.

        Raises InputError where the dictionary has no such tag.
        """
        known = len(self._tags.bytesList)
        if number >= known:
            raise InputError(f"there is no tag {number} in the dictionary, which has tags 0 to {known - 1}")
        tag = self.cv.aruco.generateImageMarker(self._tags, number, self._cells * cell_px)
        return np.pad(tag, cell_px, constant_values=255)

    def find(self, image: FloatArray) -> tuple[dict[int, FloatArray], int]:
        """Corners (4, 2), px, of each tag in an image, and how many tags were there more than once.

        A corner without clean edges is NaN. A tag that is there more than once is left out, since
        which of them is meant cannot be told.

        image : (height, width) grey values from 0 to 255.
        """
        corners, numbers, _ = self._detector.detectMarkers(image.astype(np.uint8))
        if numbers is None:
            return {}, 0
        found = [int(number) for number in np.ravel(numbers)]
        ambiguous = {number for number in found if found.count(number) > 1}
        tags = {
            number: refine_corners(image, np.reshape(quad, (4, 2)).astype(np.float64), self._cells)
            for number, quad in zip(found, corners, strict=True)
            if number not in ambiguous
        }
        return tags, len(ambiguous)


def _opencv() -> Any:
    try:
        import cv2
    except ImportError as error:
        raise InputError("detect needs OpenCV: pip install 'projservo[detect]'") from error
    if not hasattr(getattr(cv2, "aruco", None), "ArucoDetector"):
        raise InputError(
            f"detect needs OpenCV 4.7 or newer, not {cv2.__version__}: pip install 'projservo[detect]'"
        )
    return cv2


@dataclass
class _Findings:
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


def observe_tags(
    pairs: Sequence[tuple[int, Path, Path]],
    q: FloatArray,
    finder: TagFinder,
    points: str,
    progress: Callable[[str, int, int], None],
) -> tuple[Observation, _Findings]:
    """Find tags in pairs of images.

    pairs : number and both images of each pose.
    q : (K, n) joint readings of the poses.
    finder : of the tags.
    points : ``corners``: corner k of tag t is marker 4 t + k; ``centers``: tag t is marker t.
    progress : told after each pose.
    Raises InputError if an image cannot be read, or has another size than those before it from the same
    camera; WorkFailed if there is no tag in any image, or none that both views saw at a pose.
    """
    found = _Findings()
    shapes: dict[int, tuple[int, ...]] = {}
    for k, (_, *views) in enumerate(pairs):
        for view, path in enumerate(views):
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
                pixels = corners if points == "corners" else _crossing(corners)[None]
                found.unrefined += int(np.isnan(pixels[:, 0]).sum())
                found.images[k, view, tag] = pixels
        progress("detect", k + 1, len(pairs))
    if not found.images:
        raise WorkFailed(
            f"no tag in any of {2 * len(pairs)} images: look whether --dictionary is that of your tags, "
            "and whether a bright margin of one cell surrounds each"
        )
    numbers, each = found.tags, 4 if points == "corners" else 1
    images = np.full((len(pairs), 2, len(numbers), each, 2), np.nan)
    for (k, view, tag), pixels in found.images.items():
        images[k, view, numbers.index(tag)] = pixels
    marker = (each * np.array(numbers, dtype=np.int64)[:, None] + np.arange(each)).ravel()
    pose = np.array([number for number, *_ in pairs], dtype=np.int64)
    observation = Observation(pose, marker, q, images.reshape(len(pairs), 2, len(marker), 2))
    if not np.isfinite(observation.images[..., 0]).all(axis=1).any():
        raise WorkFailed("no tag was seen by both cameras at the same pose: look whether the images pair up")
    return observation, found


def _crossing(corners: FloatArray) -> FloatArray:
    """Crossing (2,) of the diagonals of a quadrilateral (4, 2): the image of the centre of a square."""
    a, b, c, d = np.c_[corners, np.ones(4)]
    u, v, w = np.cross(np.cross(a, c), np.cross(b, d))
    return np.array([u / w, v / w])
