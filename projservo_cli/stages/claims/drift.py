"""Claims about the centre's drift from its straight line, and about equation (22)."""

from collections.abc import Iterator

import numpy as np

from projservo_cli.figures import measures
from projservo_cli.figures.drift import table
from projservo_cli.figures.material import DIRECT, TITLES, Material, Studies
from projservo_cli.geometry.kinematics import joint_operators
from projservo_cli.records import PRISMATIC, BoolArray, FloatArray, Trace
from projservo_cli.stages.claims.claim import Claim, listed

# Both sides of (22) agree where the centre is moved to within this of the same place, m.
EQUAL_M = 1e-9
# A limit that bends the first step alone moves the phase at which the largest deviation is sampled.
SAMPLING = 1e-3


def drift_claims(material: Material, studies: Studies) -> Iterator[Claim]:
    """Claims of sections 5.2, 6 and 7 about drift; none where the goal pose is unknown."""
    drift = table(studies)
    if not np.isfinite(drift).all():
        return
    gains = ", ".join(f"{gain:g}" for gain in studies.gains)
    for i, law in enumerate(DIRECT):
        free, limited = drift[i, 0]
        yield Claim(
            f"{TITLES[law]}: the drift falls with the gain",
            "section 6, Fig. 8",
            f"{listed(free)} mm at gains {gains} per step; calibrated {listed(drift[i, 1, 0])} mm",
            "strictly, with true operators and no limit",
            bool((np.diff(free[np.argsort(studies.gains)]) > 0).all()),
        )
        yield Claim(
            f"{TITLES[law]}: the drift falls with a limit of {studies.step_limit_deg:g}° per step",
            "section 6, Fig. 8",
            f"{listed(limited)} mm at the same gains; calibrated {listed(drift[i, 1, 1])} mm",
            f"nowhere larger than without the limit by more than {SAMPLING:.1%}, smaller at the highest gain",
            bool((limited <= free * (1 + SAMPLING)).all() and limited[0] < free[0]),
        )
    own = [float(studies.own[law, "true", False].center_deviation_mm or 0.0) for law in DIRECT]
    yield Claim(
        "directTWO is free of the bias of directTHREE: it drifts less",
        "section 5.2",
        f"at the configured gains without limit directTHREE {own[0]:.3g} mm, directTWO {own[1]:.3g} mm",
        "smaller largest deviation, true operators",
        own[1] < own[0],
    )
    yield from _rate(studies, material.robot.joint_types != PRISMATIC)
    yield _joints(material, studies.own[DIRECT[0], "true", False])


def _rate(studies: Studies, revolute: BoolArray) -> Iterator[Claim]:
    """Drift over the period; the longest turn in a step says how far apart the samples can be."""
    periods = np.array(studies.periods)
    for law in DIRECT:
        values = np.array(
            [studies.rate[law, period].center_deviation_mm for period in studies.periods], float
        )
        if len(periods) < 2 or not (values > 0).all():
            continue
        order = np.polyfit(np.log(periods), np.log(values), 1)[0]
        sweep = ", ".join(f"{1e3 * period:g}" for period in periods)
        steps = np.diff(studies.rate[law, max(studies.periods)].q[:, revolute], axis=0)
        turn = np.degrees(np.abs(steps).max(initial=0.0))
        yield Claim(
            f"{TITLES[law]}: the drift is typical of low control rates",
            "section 7",
            f"{listed(values)} mm at periods of {sweep} ms and a fixed gain in 1/s; "
            f"drift ∝ period^{order:.2f}; a joint turns by up to {turn:.0f}° in a step of the longest period",
            "falls strictly with the period, true operators and no limit",
            bool((np.diff(values[np.argsort(periods)]) > 0).all()),
        )


def _joints(material: Material, trace: Trace) -> Claim:
    """Second-order share of each joint in the deviation of the first step."""
    line = material.goal_center(trace) - trace.center[0]
    line = line / max(float(np.linalg.norm(line)), np.finfo(float).tiny)
    H_hat = joint_operators(material.plant.model, trace.q[0])
    joint_step = trace.q[1] - trace.q[0]
    parts = measures.second_order_drift(H_hat, joint_step, np.append(trace.center[0], 1.0), line)
    first = 1e3 * measures.along_line(trace.center[1:2], trace.center[0], trace.center[0] + line)[1][0]
    ranking = np.argsort(-np.abs(parts))
    shares = ", ".join(f"q{i + 1} {1e3 * parts[i]:+.2f}" for i in ranking)
    fastest = ", ".join(f"q{i + 1}" for i in np.argsort(-np.abs(joint_step))[:2])
    return Claim(
        "The initially high velocities of q1 and q3 cause the drift",
        "section 6, Fig. 12",
        f"second-order contributions to the first step's deviation of {first:.2f} mm: {shares} mm; "
        f"fastest at first {fastest}",
        "q1 and q3 contribute most (directTHREE, true operators, no limit)",
        {int(i) for i in ranking[:2]} == {0, 2},
    )


def composition_claim(lambdas: FloatArray, distance: FloatArray) -> Claim:
    """Whether both sides of [RH00] eq. (22) agree, and to which order they do.

    Parameters
    ----------
    lambdas : (k,) shares of the task.
    distance : (k,) of the centre between both sides, m.
    """
    small = np.argsort(lambdas)[:3]
    order = ""
    if (distance[small] > 0).all():
        slope = np.polyfit(np.log(lambdas[small]), np.log(distance[small]), 1)[0]
        order = f"; difference ∝ λ^{slope:.2f}"
    shares = ", ".join(f"{share:g}" for share in lambdas)
    return Claim(
        "exp(λτ Ĥ_t) exp(λθ Ĥ_s) = exp(λτ Ĥ_t + λθ Ĥ_s)",
        "eq. (22), section 5.2",
        f"the centre differs by {listed(1e3 * distance)} mm at λ = {shares}{order}",
        "equal to round-off; to first order only where the difference is ∝ λ²",
        bool((distance <= EQUAL_M).all()),
    )
