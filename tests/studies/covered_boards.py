"""Chessboards that are partly covered: how many are found, and whether their corners err as they say.

    python -m tests.studies.covered_boards [--draws 60] [--sides 20] [-o covered_boards.csv]

Draw k has a board of 7x5 to 11x8 inner corners, tilted by up to 60°, in an image blurred by 0.5 to 2 px,
with noise of 1 to 3 grey levels. One or two things cover 3 to 40 % of the corners: a convex polygon with
hard edges, or a smooth ellipse shaded like a finger, of any grey level, plain or textured. Two corners on
each side of the board show. In as many draws as ``--sides`` says, a whole side is covered: its numbers are
not known, and nothing may be found.
"""

import time

import cv2
import numpy as np

from projservo_cli.detection.finders import Board, BoardFinder
from tests.detection.boards import SIZE, drawn, view_of
from tests.studies.common import in_two_processes, parser_of, quantiles, rate, write_rows

SEED, FINE = 91, 12  # samples a pixel along a coordinate: 4 leave edges along a row of pixels off by 0.02 px
SQUARES, EDGE = (16.0, 36.0), 12.0  # px: sides before the tilt, and the distance of corners from the border
HIDDEN, SHOWN = (0.03, 0.4), 2  # shares of corners, and corners that show on a side
BLUR, NOISE = (0.5, 2.0), (1.0, 3.0)  # px, grey levels
REACH = (0.6, 2.6)  # of a cover from its middle, in squares
NEAR = 4  # px of a cover within which no corner counts as shown
FAR = 5.0  # deviations


def cover(middle, reach, rng):
    """Share (height, width) of pixels that a cover hides, and its grey values."""
    v, u = np.indices(SIZE[::-1]).astype(float)
    kind = ("polygon", "ellipse")[rng.integers(2)]
    grey = np.full(u.shape, rng.uniform(0.0, 255.0))
    large = np.zeros((SIZE[1] * FINE, SIZE[0] * FINE), dtype=np.uint8)
    if kind == "polygon":
        angle = rng.uniform(0.0, 2.0 * np.pi, rng.integers(5, 9))
        points = middle + reach * rng.uniform(0.7, 1.0, (len(angle), 1)) * np.c_[np.cos(angle), np.sin(angle)]
        hull = cv2.convexHull(((points + 0.5) * FINE - 0.5).astype(np.float32))
        cv2.fillConvexPoly(large, np.rint(hull).astype(np.int32), 255)
    else:
        turn, axes = rng.uniform(0.0, 180.0), reach * np.array([1.0, rng.uniform(0.4, 1.0)])
        center, size = np.rint((middle + 0.5) * FINE - 0.5), np.rint(axes * FINE)
        cv2.ellipse(large, center.astype(int).tolist(), size.astype(int).tolist(), turn, 0, 360, 255, -1)
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        x, y = (c * (u - middle[0]) + s * (v - middle[1])), (c * (v - middle[1]) - s * (u - middle[0]))
        round_off = np.sqrt(np.clip(1.0 - (x / axes[0]) ** 2 - (y / axes[1]) ** 2, 0.0, 1.0))
        grey *= 0.6 + 0.4 * round_off
    if rng.uniform() < 0.5:
        texture = cv2.GaussianBlur(rng.standard_normal(u.shape), (0, 0), rng.uniform(0.7, 6.0))
        grey += rng.uniform(5.0, 60.0) * texture / texture.std()
    share = large.reshape(SIZE[1], FINE, SIZE[0], FINE).mean(axis=(1, 3)) / 255.0
    return share, np.clip(grey, 0.0, 255.0)


def covered(draw, whole_side=False):
    """Board, image, its true corners, and masks of corners that are hidden and that show."""
    rng = np.random.default_rng([SEED, draw, int(whole_side)])
    while True:
        board = Board("chessboard", int(rng.integers(5, 9)), int(rng.integers(7, 12)))
        H = view_of(rng, rng.uniform(*SQUARES))
        true = (
            np.c_[board.grid_points - board.grid_points.mean(axis=0), np.ones(len(board.grid_points))] @ H.T
        )
        true = true[:, :2] / true[:, 2:]
        if (true < EDGE).any() or (true > np.array(SIZE) - 1 - EDGE).any():
            continue
        image, _ = drawn(board, H, 0.0, 0.0, np.random.default_rng(0), factor=FINE)
        square = np.sqrt(abs(np.linalg.det(H[:2, :2])))
        share = np.zeros(image.shape)
        image = image.astype(float)
        for _ in range(rng.integers(1, 3)):
            middle = true[rng.integers(len(true))] + rng.uniform(-0.5, 0.5, 2) * square
            reach = rng.uniform(*REACH) * square * (2.0 if whole_side else 1.0)
            part, grey = cover(middle, reach, rng)
            share, image = np.maximum(share, part), part * grey + (1.0 - part) * image
        u, v = np.rint(true).astype(int).T
        hidden = share[v, u] > 0.5
        near = cv2.dilate((share > 0.0).astype(np.uint8), np.ones((2 * NEAR + 1, 2 * NEAR + 1)))
        shows = near[v, u] == 0
        grid = np.where(whole_side, ~hidden, shows).reshape(board.shape)
        least = min(side.sum() for side in (grid[0], grid[-1], grid[:, 0], grid[:, -1]))
        fits = least == 0 if whole_side else least >= SHOWN
        if fits and HIDDEN[0] <= hidden.mean() <= (0.6 if whole_side else HIDDEN[1]):
            break
    image = cv2.GaussianBlur(image, (0, 0), rng.uniform(*BLUR))
    image = image + rng.uniform(*NOISE) * rng.standard_normal(image.shape)
    return board, np.clip(np.round(image), 0, 255).astype(np.uint8), true, hidden, shows


def numberings(board):
    """Numbers of the corners as they are drawn, in each order in which the first square is bright, if any."""
    drawn_as = np.arange(len(board.grid_points)).reshape(board.shape)
    dark = np.indices(board.shape).sum(axis=0)[:-1, :-1] % 2 == 0
    turns = [k for k in range(4) if np.rot90(drawn_as, k).shape == board.shape]
    bright = [k for k in turns if not np.rot90(dark, k)[0, 0]]
    return [np.rot90(drawn_as, k).ravel() for k in bright or turns]


def judged(job):
    """A row of the table."""
    draw, whole_side = job
    board, image, true, hidden, shows = covered(draw, whole_side)
    finder, began = BoardFinder(board, "4X4_50"), time.perf_counter()
    found = finder.find(image.astype(float))[0].get(0)
    row = {
        "draw": draw,
        "whole_side": whole_side,
        "board": str(board),
        "hidden": float(hidden.mean()),
        "shown": int(shows.sum()),
        "seconds": time.perf_counter() - began,
        "found": found is not None and bool(np.isfinite(found.sigma).any()),
    }
    if not row["found"]:
        return row | {"accepted": 0, "of_shown": 0, "misnumbered": False, "far": 0, "rms": "", "worst": ""}
    known = np.isfinite(found.sigma)
    off, end = min(
        ((np.linalg.norm(found.pixels - true[end], axis=1), end) for end in numberings(board)),
        key=lambda one: np.median(one[0][known]),
    )
    ratio = off[known] / found.sigma[known]
    near = np.linalg.norm(true[:, None] - true, axis=2) + np.diag(np.full(len(true), np.inf))
    return row | {
        "accepted": int(known.sum()),
        "of_shown": int((known & shows[end]).sum()),
        "misnumbered": bool((off > 0.5 * near.min(axis=1)[end])[known].any()),
        "far": int((ratio > FAR).sum()),
        "rms": float(np.sqrt(np.mean(ratio**2) / 2.0)),
        "worst": float(ratio.max()),
    }


def main():
    """Judge all draws and print shares."""
    numbers = [("draws", 60, "of boards of which all sides show"), ("sides", 20, "with a covered side")]
    asked = parser_of("covered_boards", __doc__, numbers).parse_args()
    jobs = [(draw, False) for draw in range(asked.draws)] + [(draw, True) for draw in range(asked.sides)]
    rows = list(in_two_processes(judged, jobs, "boards"))
    write_rows(asked.output, rows)
    for whole_side, name in ((False, "all sides show"), (True, "a side is covered")):
        some = [row for row in rows if row["whole_side"] is whole_side]
        found = [row for row in some if row["found"]]
        accepted, far = (sum(row[key] for row in some) for key in ("accepted", "far"))
        rms = quantiles([row["rms"] for row in found])
        seconds = quantiles([row["seconds"] for row in some])
        print(
            f"{name}: found {rate(len(found), len(some))} % of {len(some)}, wrongly numbered "
            f"{sum(row['misnumbered'] for row in some)}; {accepted} corners accepted, farther off than "
            f"{FAR:g} deviations {far}; error over stated, median / 95 % / most of the boards: "
            f"{rms}; seconds: {seconds}"
        )
        if found:
            shown = sum(row["shown"] for row in found)
            print(f"  corners that show and are accepted: {rate(sum(r['of_shown'] for r in found), shown)} %")
        for row in some:
            if row["far"] or row["misnumbered"] or row["found"] is whole_side:
                print(
                    "  {draw}: {board}, hidden {hidden:.2f}, found {found}, far {far}, {worst}".format(**row)
                )


if __name__ == "__main__":
    main()
