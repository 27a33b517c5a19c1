"""Pages of images: of a preflight, of a recording, and live in a browser of this machine."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np

from projservo_cli.detection.images import opencv
from projservo_cli.records import CORNERS, ByteArray, FloatArray
from projservo_cli.report.html import embedded, html_page

# Grey values are drawn over in BGR: found tags, and the goal.
_TAG, _GOAL = (60, 200, 0), (255, 140, 0)
# Longest pause between two images of a live page, s.
_PAUSE_S = 0.1


def annotated(grey: ByteArray, marker: Sequence[int], pixels: FloatArray, goal: FloatArray) -> bytes:
    """JPEG of an image with outlines and numbers of the tags found in it, and circles at goal pixels.

    marker : numbers (m,) of the markers; pixels (m, 2), goal (g, 2) : px, NaN where unseen.
    """
    cv = opencv()
    image = cv.cvtColor(grey, cv.COLOR_GRAY2BGR)
    corners: dict[int, list[FloatArray]] = {}
    for number, at in zip(marker, pixels, strict=True):
        if np.isfinite(at).all():
            corners.setdefault(number // CORNERS, []).append(at)
    for tag, points in corners.items():
        outline = np.rint(points).astype(np.int32)
        cv.polylines(image, [outline], True, _TAG, 2, cv.LINE_AA)
        center = tuple(np.rint(np.mean(points, axis=0)).astype(int).tolist())
        cv.putText(image, str(tag), center, cv.FONT_HERSHEY_SIMPLEX, 0.6, _TAG, 2, cv.LINE_AA)
    for at in goal[np.isfinite(goal).all(axis=1)]:
        cv.circle(image, tuple(np.rint(at).astype(int).tolist()), 5, _GOAL, 2, cv.LINE_AA)
    return bytes(cv.imencode(".jpg", image, [cv.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())


def preflight_page(name: str, findings: Sequence[Mapping[str, Any]], pictures: Mapping[str, bytes]) -> str:
    """One file of HTML with the findings of a preflight, as rows, and a picture of each view, JPEG."""
    title = f"Preflight of {name}"
    return html_page("cameras.html", title=title, images=_within(pictures), findings=findings)


def recording_page(name: str, done: str, pictures: Mapping[str, bytes], *, whole: bool) -> str:
    """One file of HTML that shows how far a recording is, and loads itself again until it is whole."""
    title = f"Recording {name}"
    return html_page("cameras.html", title=title, images=_within(pictures), text=done, reloads=not whole)


def _within(pictures: Mapping[str, bytes]) -> dict[str, str]:
    """Addresses of the pictures, JPEG, of all views within a page."""
    return {view: embedded(picture, "image/jpeg") for view, picture in pictures.items()}


class LivePage:
    """The images of all views on a page that this machine alone can open, at ``url``, until it is closed.

    name : of the configuration. view : names of the views. port : 0 for any that is free.
    """

    def __init__(self, name: str, view: Sequence[str], port: int = 0) -> None:
        images = {name: f"/{name}.mjpg" for name in view}
        title, note = f"Live images of {name}", "Ctrl-C in the terminal ends it."
        text = html_page("cameras.html", title=title, images=images, text=note)
        self.pictures: dict[str, bytes] = {}
        live = self

        class Handler(BaseHTTPRequestHandler):
            """Serve the page, and each image as multipart JPEGs."""

            def do_GET(self) -> None:
                """Answer a browser."""
                asked = self.path.strip("/").removesuffix(".mjpg")
                self.send_response(200 if self.path == "/" or asked in view else 404)
                if asked not in view:
                    self.send_header("Content-Type", "text/html; charset=utf-8")
                    self.end_headers()
                    self.wfile.write(text.encode() if self.path == "/" else b"not found")
                    return
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                live.stream(asked, self.wfile.write)

            def log_message(self, *_: Any) -> None:
                """Keep the terminal quiet."""

        self._ended = threading.Event()
        self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True).start()
        self.url = f"http://127.0.0.1:{self._server.server_port}/"

    def stream(self, view: str, write: Callable[[bytes], Any]) -> None:
        """Write the images of a view as they come, until the browser leaves or the page is closed."""
        last = None
        while not self._ended.is_set():
            picture = self.pictures.get(view)
            if picture is None or picture is last:
                time.sleep(0.2 * _PAUSE_S)
                continue
            last = picture
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n\r\n"
            try:
                write(head.encode() + picture + b"\r\n")
            except OSError:
                return
            self._ended.wait(_PAUSE_S)

    def close(self) -> None:
        """Serve nothing any more."""
        self._ended.set()
        self._server.shutdown()
        self._server.server_close()
