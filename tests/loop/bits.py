"""Hash of short closed loops of every law, to compare compiled and interpreted machine code.

Run as ``python -m tests.loop.bits``: prints one JSON object.
"""

import hashlib
import json

import numpy as np

from projservo_cli.records import LAWS
from tests.samples import frame
from tests.scene import GAINS, Run, limits, scene


def hashes():
    """Hash of everything logged, by law and joint types: noise, a speed limit, projective models."""
    found = {}
    noise = 0.5 * np.random.default_rng(7).standard_normal((16, 2, 4, 2))
    for types in ("RRRRRR", "RRPRRR"):
        for law in LAWS:
            G = None if law == "euclidean_points" else frame(1)
            bounds = limits(speed=np.full(6, 0.8), max_steps=15)
            run = Run(scene(types=types), law, GAINS._replace(ratio_rp=2.0), bounds, noise, G)
            digest = hashlib.sha256(f"{run.verdict} {run.steps}".encode())
            for rows in run.full:
                digest.update(rows.tobytes())
            found[f"{law} {types}"] = digest.hexdigest()
    return found


if __name__ == "__main__":
    print(json.dumps(hashes()))
