"""Tags in one image, by OpenCV."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.special import ndtr

from projservo_cli.records import FloatArray, InputError

_ROUNDS = 3  # samples are taken anew around the sides that were found
_ITERATIONS = 20
_LEAST_REACH = 1.5  # px on either side of an edge: less is no profile
_MOST_REACH = 6.0
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
    x = np.array([low, high - low, 0.0, 0.0, 1.0])
    scale = np.array([1.0, 1.0, reach, reach, reach])
    if not x[1] > 0.0:
        return None
    for _ in range(_ITERATIONS):
        residual, J = _edge_model(x, grey, t, n)
        step = np.linalg.lstsq(J, -residual.ravel(), rcond=None)[0]
        # A start two pixels off is far outside a sharp edge: no step may leap over the profile.
        step *= min(1.0, 0.3 * reach / max(float(np.abs(step[2:]).max()), 1e-12))
        x = x + step
        x[4] = min(max(x[4], 0.2), reach)
        if float(np.abs(step[2:] / scale[2:]).max()) < 1e-6:
            break
    found = np.isfinite(x).all() and x[1] > 0.0 and abs(x[2]) + 0.5 * abs(x[3]) < reach
    return x if found else None


def _edge_model(
    x: FloatArray, grey: FloatArray, t: FloatArray, n: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residual (T, N) of an edge x = (b, a, n_0, k, σ) and its derivative (T N, 5)."""
    b, a, n_0, k, sigma = x
    z = (n - n_0 - k * t[:, None]) / sigma
    phi = ndtr(z)
    bell = -a * np.exp(-0.5 * z * z) / (np.sqrt(2.0 * np.pi) * sigma)
    J = np.stack([np.ones_like(z), phi, bell, bell * t[:, None], bell * z], axis=-1)
    return b + a * phi - grey, J.reshape(-1, 5)


class TagFinder:
    """Finds the tags of one dictionary.

    dictionary : name as OpenCV has it, with or without ``DICT_``, any case: ``4X4_50``, ``APRILTAG_36H11``.
    Raises InputError when OpenCV is not installed or does not know the dictionary.
    """

    def __init__(self, dictionary: str) -> None:
        self._cv = _opencv()
        aruco = self._cv.aruco
        known = {name.upper().removeprefix("DICT_"): name for name in dir(aruco) if name.startswith("DICT_")}
        name = known.get(dictionary.upper().removeprefix("DICT_"))
        if name is None:
            raise InputError(f"--dictionary {dictionary}: unknown; valid: {', '.join(sorted(known))}")
        tags = aruco.getPredefinedDictionary(getattr(aruco, name))
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
        flags = self._cv.IMREAD_GRAYSCALE | self._cv.IMREAD_IGNORE_ORIENTATION
        image = self._cv.imdecode(content, flags) if content.size else None
        if image is None:
            raise InputError(f"{path}: not an image that OpenCV can read; save it again, as PNG for example")
        found: FloatArray = np.asarray(image, dtype=np.float64)
        return found

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
