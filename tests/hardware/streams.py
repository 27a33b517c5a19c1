"""Cameras that tests draw, stop and resume."""

import time

import cv2
import numpy as np

from tests.emulated.streams import Served


class Stream(Served):
    """One camera: ``draw()`` gives each image."""

    def __init__(self, draw, rate_hz=30.0):
        self.draw, self.rate_hz, self.served = draw, rate_hz, 0
        super().__init__()

    def frames(self):
        due = time.monotonic()
        while not self.paused.is_set():
            self.served += 1
            yield cv2.imencode(".jpg", self.draw(), [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
            due += 1.0 / self.rate_hz
            time.sleep(max(0.0, due - time.monotonic()))


_TAGS = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)


def picture(
    at=(200.0, 150.0), side=60.0, numbers=(0,), size=(320, 240), tags=_TAGS, blur=0.7, light=1.0, step=90.0
):
    """Image of upright tags in a row, the first one's upper left corner at a pixel, like that of a webcam."""
    over = 4
    image = np.full((size[1] * over, size[0] * over), 150, np.uint8)
    for i, number in enumerate(numbers):
        drawn = cv2.aruco.generateImageMarker(tags, number, (tags.markerSize + 2) * 16)
        drawn = cv2.copyMakeBorder(drawn, 16, 16, 16, 16, cv2.BORDER_CONSTANT, value=230)
        scale = over * side / ((tags.markerSize + 2) * 16)
        cell = over * side / (tags.markerSize + 2)
        x, y = over * (at[0] + step * i + 0.5) - cell, over * (at[1] + 0.5) - cell
        A = np.array([[scale, 0, x + 0.5 * scale - 0.5], [0, scale, y + 0.5 * scale - 0.5]])
        mask = cv2.warpAffine(np.full_like(drawn, 255), A, image.shape[::-1])
        warped = cv2.warpAffine(drawn, A, image.shape[::-1], flags=cv2.INTER_LINEAR)
        image[mask > 127] = warped[mask > 127]
    grey = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.convertScaleAbs(cv2.GaussianBlur(grey, (0, 0), blur), alpha=light)
