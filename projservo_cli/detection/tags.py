"""Tags in one image, by OpenCV."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from projservo_cli.detection.edges import refine_corners
from projservo_cli.records import FloatArray, InputError

BORDER = 2  # cells of border along a side of a tag, besides those of its code


class TagFinder:
    """Finds the tags of one dictionary.

    Parameters
    ----------
    dictionary : name as OpenCV has it, with or without ``DICT_``, any case: ``4X4_50``, ``APRILTAG_36H11``.

    Raises
    ------
    InputError
        When OpenCV is not installed or does not know the dictionary.
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
        self._cells = int(tags.markerSize) + BORDER

    def read(self, path: Path) -> FloatArray:
        """Grey values (height, width) of an image as the camera took it, unturned.

        Raises
        ------
        InputError
            When the file is not an image.
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

        Parameters
        ----------
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
        module = importlib.import_module("cv2")
    except ImportError as error:
        raise InputError("detect needs OpenCV: pip install 'projservo[detect]'") from error
    if not hasattr(getattr(module, "aruco", None), "ArucoDetector"):
        raise InputError(
            f"detect needs OpenCV 4.7 or newer, not {module.__version__}: pip install 'projservo[detect]'"
        )
    return module
