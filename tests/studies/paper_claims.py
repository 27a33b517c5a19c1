"""Why claims of [RH00] hold on one benchmark and not on another, measured.

    python -m tests.studies.paper_claims

With the true model: how far apart the image paths of both direct laws are by the tilt of the face, on the
gantry; how far the block-wise law carries a face that nothing holds; and where the minimum of the points lies
for a PUMA 560.
"""

import json

import numpy as np

from projservo_cli.loop.verdicts import plateau_stretch
from projservo_cli.report.claims import path_gap
from projservo_cli.simulation.arm import SerialArm
from tests.configured import truth_of
from tests.known import configured, driven, known_scenario, planned

SEED, A_BAND = 52, 12
BANDS_DEG = ((8, 20), (20, 30), (30, 40), (40, 50), (50, 60))
FACE_M = 0.05  # of the face before the tool
# Wrist centre behind the face plate of the PUMA of paper.yaml: d6 and the tool.
WRIST_M = 0.05625 + 0.05
LEAST_FALL = 20  # steps in which an error that stands still falls by less than 1 %


def runs(config, *laws, **limits):
    """Traces of laws with the true model."""
    scenario = known_scenario(config)
    model = scenario.simulated.truth.model
    plan = planned(scenario, model)
    return [driven(scenario, plan, law, model, **limits) for law in laws]


def tilted(rng, low, high):
    """Pose of the tool with the face in the gantry's place, turned so far off the image planes, deg."""
    tilt, azimuth, spin = np.radians(rng.uniform(low, high)), *rng.uniform(-np.pi, np.pi, 2)
    z = np.array([np.cos(tilt), np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth)])
    x = np.cross(z, [0.3, -0.5, 0.8])
    x /= np.linalg.norm(x)
    x = np.cos(spin) * x + np.sin(spin) * np.cross(z, x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.c_[x, np.cross(z, x), z], [0.58, 0.0, 0.63] - FACE_M * z
    return json.dumps(T.tolist())


def main():
    rng = np.random.default_rng(SEED)
    for low, high in BANDS_DEG:
        gaps = []
        for _ in range(A_BAND):
            config = configured("paper_gantry", f"robot.screws.base_tool={tilted(rng, low, high)}")
            three, two = runs(config, "direct_three", "direct_two")
            gaps.append(path_gap(*(trace.s.reshape(len(trace.s), -1, 2) for trace in (three, two))))
        print(f"face {low} to {high} deg off the image planes: paths {np.median(gaps):.1f} px apart (median)")
    for limit, speed in (("the speed limit", {}), ("no limit", {"speed": np.full(6, np.inf)})):
        free = {"diverged_factor": 1e9, "max_steps": 7, **speed}
        (trace,) = runs(configured("paper_gantry"), "blockwise", **free)
        way = np.linalg.norm(trace.center[-1] - trace.center[0])
        print(f"block-wise, {limit}: a free face is {way:.0f} m away after 7 steps")
    for name in ("paper", "paper_reach", "paper_gantry"):
        (trace,) = runs(configured(name), "stacked")
        stretch = plateau_stretch(trace.convergence_error, LEAST_FALL)
        print(f"stacked on {name}, no error of a calibration: {trace.verdict}, stands still {stretch}")
    (trace,) = runs(configured("paper_gantry"), "euclidean_points")
    first, last = plateau_stretch(trace.convergence_error, LEAST_FALL)
    wrist = trace.pose[first:last] @ [0.0, 0.0, -WRIST_M, 1.0]
    arm: SerialArm = truth_of(configured("paper")).robot
    away = np.linalg.norm(wrist[:, :3], axis=1).mean()
    reach = {
        name: max(
            np.linalg.norm(arm.pose(q)[:3] @ [0, 0, -WRIST_M, 1])
            for q in np.outer(np.linspace(*elbow, 2000), np.eye(6)[2])  # the elbow alone sets that distance
        )
        for name, elbow in (("limits", (arm.limits.lower[2], arm.limits.upper[2])), ("all", (0, 2 * np.pi)))
    }
    print(f"points stand still with the wrist {away:.3f} m from the shoulder of a PUMA 560, which reaches")
    print(f"{reach['limits']:.3f} m within the limits of its elbow, {reach['all']:.3f} m stretched")


if __name__ == "__main__":
    main()
