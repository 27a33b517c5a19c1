"""How the time of a calibration grows with the number of points.

python -m tests.calibration.scale_study [file.csv] writes a row a number of points: seconds of the processor
and peak memory of a process of its own, and prints the slope of log time by log points.
"""

import csv
import multiprocessing
import resource
import sys
import time

import numpy as np

from projservo_cli.calibration import calibrate
from tests.calibration.mistakes import table

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


def main(path="/dev/stdout", most=POINTS[-1]):
    """Measure each number of points in a process of its own."""
    rows = []
    for points in (points for points in POINTS if points <= int(most)):
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            rows.append(pool.apply(measured, (points,)))
            print(*rows[-1], file=sys.stderr, flush=True)
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["points", "sightings", "seconds", "memory_mb"])
        writer.writerows(rows)
    logs = np.log(np.array(rows, dtype=float))
    print(f"slope {np.polyfit(logs[:, 0], logs[:, 2], 1)[0]:.2f}", file=sys.stderr)


if __name__ == "__main__":
    main(*sys.argv[1:])
