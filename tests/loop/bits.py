"""Hash of short closed loops of every law, to compare compiled and interpreted machine code.

Run as ``python -m tests.loop.bits``: prints one JSON object.
"""

import hashlib
import json

import numpy as np

from projservo_cli.laws import LAW_SPECS, LAWS
from tests.control.following import Followed
from tests.samples import frame
from tests.scene import GAINS, Run, limits, scene, with_pins

# Laws that can follow a plan.
FOLLOWING = tuple(law for law, spec in LAW_SPECS.items() if len(spec.modes) > 1)
# Pixel noise of four markers on the face and five pins.
WHOLE_NOISE = 0.5 * np.random.default_rng(8).standard_normal((11, 2, 9, 2))


def hash_of(run):
    """Hash of everything a run logged."""
    digest = hashlib.sha256(f"{run.verdict} {run.steps}".encode())
    for rows in run.full:
        digest.update(rows.tobytes())
    return digest.hexdigest()


def hashes():
    """Hash of everything logged, by law and joint types: noise, a speed limit, projective models."""
    found = {}
    noise = 0.5 * np.random.default_rng(7).standard_normal((11, 2, 4, 2))
    for types, laws in (("RRRRRR", LAWS), ("RRPRRR", ("direct_three", "stacked"))):
        for law in laws:
            G = None if LAW_SPECS[law].metric else frame(1)
            bounds = limits(speed=np.full(6, 0.8), max_steps=10)
            run = Run(scene(types=types), law, GAINS._replace(ratio_rp=2.0), bounds, noise, G)
            found[f"{law} {types}"] = hash_of(run)
        sc = with_pins(scene(types=types))
        run = Run(
            sc, "exact", GAINS, limits(max_steps=10), WHOLE_NOISE, frame(1), task=sc.body_task(frame(1))
        )
        found[f"exact, body, {types}"] = hash_of(run)
    # Without JIT planning takes minutes; a plan that is followed is compared on one arm alone.
    sc = scene()
    for law in FOLLOWING:
        bounds = limits(speed=np.full(6, 0.8), max_steps=10)
        found[f"{law}, following"] = hash_of(Followed(sc, law, frame(1), bounds=bounds, noise=noise))
    return found


if __name__ == "__main__":
    print(json.dumps(hashes()))
