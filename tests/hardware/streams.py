"""Cameras as MJPEG streams on the loopback address, which tests draw, stop and resume."""

import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np


class Stream:
    """One camera: ``draw()`` gives each image; ``paused`` is a cable that is drawn."""

    def __init__(self, draw, rate_hz=30.0, quality=95):
        self.draw, self.rate_hz, self.quality = draw, rate_hz, quality
        self.paused, self.served = threading.Event(), 0
        stream = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                if stream.paused.is_set():
                    self.send_error(503)
                    return
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                due = time.monotonic()
                try:
                    while not stream.paused.is_set():
                        data = stream.jpeg()
                        head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                        self.wfile.write(head.encode() + data + b"\r\n")
                        due += 1.0 / stream.rate_hz
                        time.sleep(max(0.0, due - time.monotonic()))
                except OSError:
                    pass

            def log_message(self, *_):
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        threading.Thread(
            target=self.server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True
        ).start()
        self.url = f"http://127.0.0.1:{self.server.server_port}/left.mjpg"

    def jpeg(self):
        self.served += 1
        return cv2.imencode(".jpg", self.draw(), [cv2.IMWRITE_JPEG_QUALITY, self.quality])[1].tobytes()

    def close(self):
        self.paused.set()
        self.server.shutdown()
        self.server.server_close()


_TAGS = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)


def picture(
    at=(200.0, 150.0), side=60.0, numbers=(0,), size=(320, 240), tags=_TAGS, blur=0.7, light=1.0, step=90.0
):
    """Image of upright tags in a row, the first one's upper left corner at a pixel, like that of a webcam."""
    over = 4
    image = np.full((size[1] * over, size[0] * over), 150, np.uint8)
    for i, number in enumerate(numbers):
        cells = tags.markerSize + 4
        drawn = cv2.aruco.generateImageMarker(tags, number, (tags.markerSize + 2) * 16)
        drawn = cv2.copyMakeBorder(drawn, 16, 16, 16, 16, cv2.BORDER_CONSTANT, value=230)
        scale = over * side / ((tags.markerSize + 2) * 16)
        cell = over * side / (tags.markerSize + 2)
        x, y = over * (at[0] + step * i + 0.5) - cell, over * (at[1] + 0.5) - cell
        A = np.array([[scale, 0, x + 0.5 * scale - 0.5], [0, scale, y + 0.5 * scale - 0.5]])
        mask = cv2.warpAffine(np.full_like(drawn, 255), A, image.shape[::-1])
        warped = cv2.warpAffine(drawn, A, image.shape[::-1], flags=cv2.INTER_LINEAR)
        image[mask > 127] = warped[mask > 127]
        assert cells
    grey = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.convertScaleAbs(cv2.GaussianBlur(grey, (0, 0), blur), alpha=light)
