"""Files of calibrated cameras, as OpenCV and ROS write them: intrinsics and lens of one camera."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from scipy.optimize import least_squares

from projservo_cli.geometry.lens import distort
from projservo_cli.metric.opencv import opencv_terms
from projservo_cli.records import FloatArray, InputError

# A lens is fitted over the raw image, which one that bends inwards fills from beyond the image of a pinhole:
# by how much on each side, in sides; points along one, radii to find a fold, and maximum rms error, px.
_BEYOND, _GRID, _RADII, _MAX_OFF_PX = 0.5, 41, 400, 0.3
_MODELS = {
    "plumb_bob": "plumb_bob",
    "rational_polynomial": "plumb_bob",
    "radtan": "plumb_bob",
} | dict.fromkeys(("fisheye", "equidistant"), "fisheye")


class Intrinsics(NamedTuple):
    """A camera as a file states it."""

    K: FloatArray  # (3, 3) px, of the raw image
    lens: FloatArray  # (5,) nearest lens of the calibration: u, v, radius, px, k1, k2
    size: tuple[int, int] | None  # width and height, px, if stated
    off_px: float  # rms distance of both lenses over the image, px


def read_intrinsics(path: Path | str) -> Intrinsics:
    """Read a camera of a YAML file of OpenCV (``camera_matrix``) or of ROS's ``camera_info``.

    Raises InputError if the file is none of these, or if its lens is beyond two radial terms.
    """
    values = _document(path)
    names = ("camera_matrix", "cameraMatrix", "K", "k")
    K = _matrix(path, values, names, (3, 3))
    if not (K[0, 0] > 0.0 and K[1, 1] > 0.0):
        raise InputError(
            f"{path}: {names[0]} has the focal lengths {K[0, 0]:g} and {K[1, 1]:g}: both must be positive"
        )
    given = str(values.get("distortion_model", "plumb_bob"))
    if given not in _MODELS:
        raise InputError(f"{path}: distortion_model {given}: choose among {', '.join(_MODELS)}")
    coefficients = _matrix(path, values, ("distortion_coefficients", "distCoeffs", "D", "d"), None).ravel()
    if coefficients[8:].any():
        raise InputError(
            f"{path}: its lens has coefficients of a thin prism or a tilted sensor, of which none is here: "
            "leave the file out, and calibrate with --lens, or undistort the images"
        )
    width, height = (values.get(name) for name in ("image_width", "image_height"))
    size = (int(width), int(height)) if width and height else None
    extent = np.array(size or (2.0 * K[0, 2], 2.0 * K[1, 2]))
    lens, off = _nearest_lens(K, coefficients, _MODELS[given], extent)
    if not off < _MAX_OFF_PX:
        raise InputError(
            f"{path}: two radial terms miss its lens by {off:.2g} px rms over the image, {_MAX_OFF_PX:g} at "
            "most: leave it out, and calibrate with --lens, or undistort the images"
        )
    return Intrinsics(K, lens, size, off)


def camera_info(name: str, K: FloatArray, coefficients: FloatArray, model: str, size: tuple[int, int]) -> str:
    """File of a camera for ROS's camera_info_manager, as its calibration writes it."""
    rows = {
        "camera_matrix": K,
        "distortion_coefficients": coefficients[None],
        "rectification_matrix": np.eye(3),
        "projection_matrix": np.column_stack([K, np.zeros(3)]),
    }
    values = {
        key: {"rows": len(M), "cols": M.shape[1], "data": M.ravel().tolist()} for key, M in rows.items()
    }
    about = {"image_width": size[0], "image_height": size[1], "camera_name": name, "distortion_model": model}
    return yaml.safe_dump(about | values, sort_keys=False, default_flow_style=None)


def _document(path: Path | str) -> dict[str, Any]:
    """Values of a YAML file; matrices of OpenCV are as those of ROS."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}; expected the YAML file of a camera") from error
    text = re.sub(r"^%YAML[^\n]*\n", "", text).replace("!!opencv-matrix", "")
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InputError(f"{path}: not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(values, dict):
        raise InputError(f"{path}: holds no camera: expected camera_matrix and distortion_coefficients")
    return values


def _matrix(
    path: Path | str, values: dict[str, Any], names: tuple[str, ...], shape: tuple[int, int] | None
) -> FloatArray:
    """A matrix by one of its names, of a shape, or any."""
    name = next((name for name in names if name in values), None)
    if name is None:
        raise InputError(f"{path}: has no {names[0]}: expected a YAML file of a camera by OpenCV or ROS")
    given = values[name]
    try:
        found = np.array(given["data"] if isinstance(given, dict) else given, dtype=np.float64)
        found = found if shape is None else found.reshape(shape)
    except (TypeError, ValueError, KeyError) as error:
        raise InputError(f"{path}: {name} is no matrix of numbers") from error
    if not np.isfinite(found).all():
        raise InputError(f"{path}: {name} holds a number that is not finite")
    return found


def _distorted(K: FloatArray, coefficients: FloatArray, model: str, x: FloatArray) -> FloatArray:
    """Pixels (N, 2) of normalized points (N, 2) by the lens of OpenCV, of its plain or its fisheye module."""
    square = (x**2).sum(axis=1, keepdims=True)
    if model == "fisheye":
        r = np.sqrt(square)
        theta = np.arctan(r)
        k = np.pad(coefficients, (0, 4))[:4]
        distorted = theta * (1.0 + sum(k[i] * theta ** (2 * i + 2) for i in range(4)))
        y = x * np.where(r > 1e-9, distorted / np.maximum(r, 1e-9), 1.0)
    else:
        c = np.pad(coefficients, (0, 8))[:8]  # k1, k2, p1, p2, k3, then k4, k5, k6 of a divisor
        shifts, radial = opencv_terms(x) * c[:5], [0, 1, 4]
        divisor = 1.0 + square * (c[5] + square * (c[6] + square * c[7]))
        y = (x + shifts[..., radial].sum(axis=-1)) / divisor + shifts[..., [2, 3]].sum(axis=-1)
    return np.asarray(y * np.diag(K)[:2] + K[:2, 2])


def _nearest_lens(
    K: FloatArray, coefficients: FloatArray, model: str, extent: FloatArray
) -> tuple[FloatArray, float]:
    """Lens (5,) of two radial terms nearest to that of a file over an image (2,), and its rms error, px."""
    radius = 0.5 * float(extent.max())
    lens = np.array([K[0, 2], K[1, 2], radius, 0.0, 0.0])
    if not coefficients.any() and model != "fisheye":
        return lens, 0.0
    sides = (np.linspace(-_BEYOND * side, (1.0 + _BEYOND) * side, _GRID) for side in extent)
    straight = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    x = (straight - K[:2, 2]) / np.diag(K)[:2]
    seen = _distorted(K, coefficients, model, x)
    # Beyond a fold, points far off would be seen a second time.
    r = np.linspace(0.0, np.linalg.norm(x, axis=1).max(), _RADII)
    back = np.diff(_distorted(K, coefficients, model, np.stack([r, 0.0 * r], axis=1))[:, 0]) <= 0.0
    fold = r[np.argmax(back)] if back.any() else np.inf
    within = ((seen >= 0.0) & (seen <= extent)).all(axis=1) & (np.linalg.norm(x, axis=1) < fold)
    straight, seen = straight[within], seen[within]
    free = [0, 1, 3, 4]

    def off_by(values: FloatArray) -> FloatArray:
        lens[free] = values
        return np.asarray((distort(lens, straight) - seen).ravel())

    lens[free] = least_squares(off_by, lens[free], x_scale=[1.0, 1.0, 1e-3, 1e-3]).x
    off = distort(lens, straight) - seen
    return lens, float(np.sqrt((off**2).sum(axis=1).mean()))
