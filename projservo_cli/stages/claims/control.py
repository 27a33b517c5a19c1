"""Claims about the control errors: exponential decay, model, scale, and the image errors they leave."""

import math
from collections.abc import Iterator

import numpy as np

from projservo_cli.figures import measures
from projservo_cli.figures.errors import percent
from projservo_cli.figures.material import DIRECT, TITLES, Material, Studies
from projservo_cli.records import Trace
from projservo_cli.stages.claims.claim import Claim

# A curve follows an exponential where each step's factor is within this share of 1 - gain·period.
FACTOR_TOLERANCE = 0.01
LEAST_STEPS = 10  # settled steps needed to say so
MODEL_TOLERANCE_DEG = 1e-6
START_TOLERANCE_DEG = 0.5
# A coordinate rises, or leaves the exponential, by more than this, px.
VISIBLE_PX = 1.0
# τ agrees with the true distance within this, % of the start.
SCALE_TOLERANCE = 2.0


def control_claims(material: Material, studies: Studies) -> Iterator[Claim]:
    """Claims of section 6 about Figs. 9 to 11."""
    for law in DIRECT:
        yield from _exponential(material, studies, law)
    metric, twin, calibrated = (
        studies.own[DIRECT[0], kind, False] for kind in ("true", "twin", "calibrated")
    )
    same, also = _model_difference(twin, metric), _model_difference(calibrated, metric)
    yield Claim(
        "Projective and Euclidean models give the same θ_r and θ_p",
        "section 6, Fig. 10",
        f"largest difference {same:.2g}° with true operators, {also:.2g}° with calibrated ones",
        f"at most {MODEL_TOLERANCE_DEG:g}° with true operators",
        same <= MODEL_TOLERANCE_DEG,
    )
    yield from _scale(material, calibrated)
    trace = studies.own[DIRECT[1], "calibrated", False]
    start, task = math.degrees(trace.theta_s[0]), math.degrees(measures.true_rotation(trace))
    yield Claim(
        "θ_s starts at the overall rotation of the task, 180° in the paper",
        "section 6, Fig. 9",
        f"{start:.3f}°; true rotation " + ("unknown" if math.isnan(task) else f"{task:.3f}°"),
        f"within {START_TOLERANCE_DEG:g}° of the true rotation",
        None if math.isnan(task) else abs(start - task) <= START_TOLERANCE_DEG,
    )
    factor = 1.0 - studies.gains_of_laws.gain_t * calibrated.period
    yield from _image_error(calibrated, factor)


def decay_ranges(material: Material, trace: Trace) -> dict[str, tuple[float, float, int]]:
    """Least and largest factor a step, and their number, of the centre's distance and of θ_s.

    Counted are the steps 20 after the last speed-limited one, down to 0.1 mm and 0.05°.
    """
    first = measures.settled_at(trace)
    ratios = {
        "distance": measures.decay_factors(
            measures.center_distance(material, trace), first, measures.LEAST_DISTANCE
        ),
        "theta_s": measures.decay_factors(trace.theta_s, first, float(measures.LEAST_ANGLE)),
    }
    return {name: (float(r.min()), float(r.max()), len(r)) for name, r in ratios.items() if len(r)}


def _exponential(material: Material, studies: Studies, law: str) -> Iterator[Claim]:
    trace = studies.own[law, "calibrated", True]
    if not np.isfinite(trace.goal_pose).all():
        return
    first = measures.settled_at(trace)
    rates = [
        measures.fitted_rate(
            measures.center_distance(material, trace), first, measures.LEAST_DISTANCE, trace.period
        ),
        measures.fitted_rate(trace.theta_s, first, float(measures.LEAST_ANGLE), trace.period),
    ]
    ranges = decay_ranges(material, trace)
    gains = _gains(studies, law)
    expected = {"distance": 1 - gains[0] * trace.period, "theta_s": 1 - gains[1] * trace.period}
    off = [
        max(abs(low / expected[name] - 1), abs(high / expected[name] - 1))
        for name, (low, high, _) in ranges.items()
    ]
    enough = len(ranges) == 2 and min(count for _, _, count in ranges.values()) >= LEAST_STEPS
    measured = (
        "too few settled steps"
        if not enough
        else (
            f"fitted rates {rates[0]:.3f} (centre) and {rates[1]:.3f} (θ_s) per s for gains {gains[0]:g} and "
            f"{gains[1]:g}; each step's factor within {max(off):.2%} of 1 - gain·period over "
            f"{ranges['distance'][2]} and {ranges['theta_s'][2]} steps"
        )
    )
    yield Claim(
        f"{TITLES[law]}: the control errors decay exponentially",
        "section 6, Figs. 9 and 10",
        measured,
        f"factor of every settled step within {FACTOR_TOLERANCE:.0%} of 1 - gain·period",
        max(off) <= FACTOR_TOLERANCE if enough else None,
    )


def _gains(studies: Studies, law: str) -> tuple[float, float]:
    """Gains, 1/s, of the translation and of the slowest rotation."""
    gains = studies.gains_of_laws
    return gains.gain_t, gains.gain_s if law == "direct_two" else min(gains.gain_r, gains.gain_p)


def _model_difference(trace: Trace, metric: Trace) -> float:
    """Largest difference of θ_r and θ_p between two runs, deg."""
    return max(
        math.degrees(measures.curve_difference(getattr(trace, name), getattr(metric, name))[0].max())
        for name in ("theta_r", "theta_p")
    )


def _scale(material: Material, trace: Trace) -> Iterator[Claim]:
    if not np.isfinite(trace.goal_pose).all() or trace.tau[0] == 0:
        return
    distance = percent(measures.center_distance(material, trace))
    off = float(np.abs(percent(trace.tau) - distance).max())
    affine = float(np.abs(percent(trace.tau_affine) - distance).max())
    yield Claim(
        "The difference of τ from its Euclidean truth is only apparent, a matter of scale",
        "section 6, Fig. 10",
        f"largest difference {off:.3g} % of the start with the unit-norm kernel of (8), {affine:.2g} % "
        "with the scale fixed through a_inf",
        f"at most {SCALE_TOLERANCE:g} % with the scale fixed",
        affine <= SCALE_TOLERANCE,
    )


def _image_error(trace: Trace, factor: float) -> Iterator[Claim]:
    e = trace.s - trace.s_star
    rise, off = measures.coordinate_rise(e), measures.off_exponential(e, factor)
    yield Claim(
        "The image error does not decay exponentially",
        "section 6, Fig. 11",
        f"a marker coordinate is up to {off.max():.0f} px away from an exponential decay",
        f"more than {VISIBLE_PX:g} px (directTHREE, no limit)",
        bool(off.max() > VISIBLE_PX),
    )
    rising = int((rise > VISIBLE_PX).sum())
    yield Claim(
        "The image error does not even decay monotonically",
        "section 6, Fig. 11",
        f"{rising} of {rise.size} marker coordinates rise again, by up to {rise.max():.0f} px",
        f"one by more than {VISIBLE_PX:g} px (directTHREE, no limit)",
        rising > 0,
    )
