"""Images of boards in perspective, each pixel the mean of many samples, and the corners that they show."""

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install '.[detect]'")

SIZE, CELL, FACTOR = (640, 480), 60, 4  # px; samples a square of the picture and a pixel
RADIUS = 0.32  # of a circle, in squares
DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)


def picture(board):
    """Grey values of a board with a margin of one square, and its corners (N, 2) in samples, row by row."""
    if board.kind == "charuco":
        tags = board.first + np.arange(board.columns * board.rows // 2)
        printed = cv2.aruco.CharucoBoard((board.columns, board.rows), 1.0, 0.7, DICTIONARY, tags)
        size = [CELL * (n + 2) for n in (board.columns, board.rows)]
        grey = printed.generateImage(size, marginSize=CELL)
    elif "circles" in board.kind:
        corners = CELL * (board.grid_points + 2) - 0.5
        grey = np.full((np.ceil(corners.max(axis=0)[::-1]) + 2 * CELL).astype(int), 255.0)
        at = np.indices(grey.shape)[::-1]
        for corner in corners:
            grey[np.linalg.norm(at - corner[:, None, None], axis=0) < RADIUS * CELL] = 0.0
    else:
        squares = np.indices((board.rows + 1, board.columns + 1)).sum(axis=0) % 2
        grey = np.pad(np.kron(255 * squares, np.ones((CELL, CELL))), CELL, constant_values=255)
    return grey.astype(np.uint8), CELL * (board.grid_points + 2) - 0.5


def drawn(board, H, blur, noise, rng, size=SIZE):
    """Image of a board, of which a homography takes squares from its middle to pixels, and its corners."""
    grey, corners = picture(board)
    middle = board.grid_points.mean(axis=0)
    places = np.diag([1.0 / CELL, 1.0 / CELL, 1.0])
    places[:2, 2] = board.grid_points[0] - middle - corners[0] / CELL
    fine = np.array([[FACTOR, 0.0, (FACTOR - 1) / 2], [0.0, FACTOR, (FACTOR - 1) / 2], [0.0, 0.0, 1.0]])
    large = (size[0] * FACTOR, size[1] * FACTOR)
    image = cv2.warpPerspective(grey, fine @ H @ places, large, borderValue=200)
    image = image.reshape(size[1], FACTOR, size[0], FACTOR).mean(axis=(1, 3))
    image = cv2.GaussianBlur(image, (0, 0), blur) if blur else image
    image = 20 + 0.8 * image + noise * rng.standard_normal(image.shape)
    true = np.c_[board.grid_points - middle, np.ones(len(corners))] @ H.T
    return np.clip(np.round(image), 0, 255).astype(np.uint8), true[:, :2] / true[:, 2:]


def view_of(rng, side):
    """Homography of squares to pixels: of any turn, tilted by up to 60°, squares of so many px."""
    turn, tilt = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.5, 1.0)
    c, s = np.cos(turn), np.sin(turn)
    H = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.diag([side, tilt * side, 1.0])
    H[2, :2] = rng.uniform(-0.03, 0.03, 2)
    return np.array([[1.0, 0.0, 320.0], [0.0, 1.0, 240.0], [0.0, 0.0, 1.0]]) @ H
