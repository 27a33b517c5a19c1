"""How the time of a calibration grows with its points: ``python -m tests.studies.calibration_scale``.

Writes docs/images/scale.csv, a row a number of points: seconds of the processor and peak memory of a process
of its own, draws docs/images/scale.svg and prints the slope of log time by log points.
"""

import csv
import multiprocessing
import resource
import sys
import time

import numpy as np
from matplotlib.figure import Figure

from projservo_cli.calibration import calibrate
from tests.calibration.mistakes import table
from tests.conftest import ROOT

IMAGES = ROOT / "docs" / "images"
POINTS = (10, 30, 100, 300, 1000, 3000, 10000)


def measured(points):
    """Points, sightings, seconds of the processor, and peak memory, MB; ten points are seen everywhere."""
    length = 24 if points < 100 else 5
    calibrate(table("right", 0, 10, length=24).observation, "RRRRRR", source="recorded")
    mistaken = table("right", 1, points, length=length)
    begin = time.process_time()
    calibrate(mistaken.observation, "RRRRRR", source="recorded", image_size=(1280, 1024))
    seconds = time.process_time() - begin
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return points, int((mistaken.kind >= 0).sum()), round(seconds, 3), round(memory)


def main(most=POINTS[-1]):
    """Measure each number of points in a process of its own."""
    rows = []
    for points in (points for points in POINTS if points <= int(most)):
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            rows.append(pool.apply(measured, (points,)))
            print(*rows[-1], flush=True)
    with open(IMAGES / "scale.csv", "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["points", "sightings", "seconds", "memory_mb"])
        writer.writerows(rows)
    values = np.array(rows, dtype=float)
    print(
        f"slope {np.polyfit(*np.log(values[:, [0, 2]]).T, 1)[0]:.2f}, in the last decade "
        f"{np.polyfit(*np.log(values[-3:, [0, 2]]).T, 1)[0]:.2f}"
    )
    drawn(values)


def drawn(values):
    """The picture of rows of points, sightings, seconds and memory."""
    figure = Figure(figsize=(6.0, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.loglog(values[:, 0], values[:, 2], "o-", label="calibrate, one processor")
    last = values[-1]
    axes.loglog(
        values[:, 0], last[2] * values[:, 0] / last[0], ":", color="0.5", label="in proportion to the points"
    )
    axes.set_xlabel("points on the tool")
    axes.set_ylabel("time (s)")
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    figure.savefig(IMAGES / "scale.svg", metadata={"Date": None})


if __name__ == "__main__":
    main(*sys.argv[1:])
