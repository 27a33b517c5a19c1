"""Claims of the paper about its method against the runs; no verdict is fixed beforehand."""

import math
from collections.abc import Callable, Iterable, Iterator
from types import SimpleNamespace as Numbers
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.displacements import displacements, normalize_displacement, tangent_operator
from projservo_cli.geometry.kinematics import forward_kinematics, joint_operators
from projservo_cli.laws import title_of
from projservo_cli.loop.verdicts import plateau_stretch
from projservo_cli.messages.placeholders import joined
from projservo_cli.messages.verdict_causes import arrived
from projservo_cli.records import FloatArray, Trace
from projservo_cli.report.figure_inputs import (
    DIRECT,
    Composition,
    ReportData,
    Studies,
    along_line,
    curve_difference,
    percent,
)
from projservo_cli.report.figures.path_deviation import study_numbers


class _Claim(NamedTuple):
    """One claim of the paper, its source, its measure in words, its criterion, and whether it holds.

    ``holds`` is None if it could not be measured.
    """

    claim: str
    source: str
    measured: str
    criterion: str
    holds: bool | None


class _Row(NamedTuple):
    """A claim before it is measured: its texts, with places for the numbers, and its bound on them."""

    claim: str
    source: str
    measured: str
    criterion: str
    holds: Callable[[Any], bool | None]


class _Subject(NamedTuple):
    """Data for measures of claims; a measure yields numbers for each law or run that it applies to."""

    data: ReportData
    composition: Composition | None  # composition of the parts of the task; None if it could not be computed

    @property
    def studies(self) -> Studies:
        """The extra runs, for claims that are judged only if there are some."""
        return self.data.extra

    @property
    def drift(self) -> FloatArray:
        """Drift by law, operators, limit and gain, mm."""
        return np.asarray(study_numbers(self.data.studies)["path_deviation_mm"])


_Measure = Callable[[_Subject], Iterator[Numbers]]


class _Table:
    """Claims with their measures, in the order of the paper."""

    def __init__(self) -> None:
        self._rows: dict[_Measure, list[_Row]] = {}

    def claim(self, *row: Any) -> Callable[[_Measure], _Measure]:
        """Decorator of a measure that adds a claim judged by it; arguments as of ``_Row``."""

        def measured_by(measure: _Measure) -> _Measure:
            self._rows.setdefault(measure, []).insert(0, _Row(*row))  # the last decorator comes first
            return measure

        return measured_by

    def judged(self, subject: _Subject, unknown: str = "") -> Iterator[_Claim]:
        """Measure, word and judge all claims; ``unknown`` says why none of them can be measured."""
        for measure, rows in self._rows.items():
            for numbers in measure(subject):
                values_of = vars(numbers)
                why = unknown or values_of.get("unknown", "")
                for claim, source, measured, criterion, holds in rows:
                    holds_here = None if why else holds(numbers)
                    yield _Claim(
                        claim.format(**values_of),
                        source,
                        why or measured.format(**values_of),
                        criterion.format(**values_of),
                        None if holds_here is None else bool(holds_here),
                    )


_RUNS, _DRIFT, _CURES, _CONTROL, _EQUATION = (_Table() for _ in range(5))


def _listed(values: FloatArray) -> str:
    """Numbers as a list in words, three digits each, large ones whole."""
    return ", ".join(f"{value:.0f}" if value >= 100 else f"{value:.3g}" for value in np.atleast_1d(values))


def _short(values: Iterable[float]) -> str:
    """Numbers as a list in words, without zeros at their ends."""
    return ", ".join(f"{value:g}" for value in values)


def _cameras(views: int, two: str, more: str) -> str:
    """Cameras of a rig by its number of views, with a word for two and another for more."""
    return "the camera" if views == 1 else f"{two if views == 2 else more} camera{'s' * (two == 'both')}"


@_RUNS.claim(
    "The block-wise law does not converge",
    "section 6, Fig. 4",
    "{verdict} after {steps} steps: {reason}",
    "verdict other than converged",
    lambda n: not arrived(n.verdict),
)
@_RUNS.claim(
    "The block-wise law diverges towards infinity",
    "section 6",
    "{verdict}{grown}",
    "verdict diverged",
    lambda n: n.verdict == "diverged",
)
def _blockwise(subject: _Subject) -> Iterator[Numbers]:
    """Verdict of the block-wise law, and the distance of the centre if it is known, mm."""
    trace, grown = subject.data.traces.get("blockwise"), ""
    if trace is None:
        return
    distance = 1e3 * subject.data.center_distance(trace)
    if np.isfinite(distance).all():
        grown = f"; centre {distance[-1]:.0f} mm from the goal, {distance[0]:.0f} at the start"
    yield Numbers(verdict=trace.verdict, steps=trace.steps, reason=trace.reason, grown=grown)


@_RUNS.claim(
    "{law}: runs through self-occlusion, then converges",
    "section 6, Fig. 4",
    "{hidden} self-occluded steps in the {views} camera; {verdict}",
    "steps in {cameras}, verdict converged",
    lambda n: n.least_hidden > 0 and arrived(n.verdict),
)
@_RUNS.claim(
    "{law}: stands still in a local minimum before it converges",
    "section 6, Fig. 4",
    "{plateau}; {verdict}",
    "image error falls < 1 % in {window} steps, verdict converged",
    lambda n: n.plateau != "none" and arrived(n.verdict),
)
def _escapes(subject: _Subject) -> Iterator[Numbers]:
    """Hidden steps and plateau of the classical laws that control images of points."""
    window = subject.data.stall_periods
    for law in ("stacked", "euclidean_points"):
        if (trace := subject.data.traces.get(law)) is None:
            continue
        hidden, still = trace.self_occluded_steps, plateau_stretch(trace.convergence_error, window)
        plateau = "none"
        if still is not None:
            level = float(trace.convergence_error[still[0]])
            plateau = f"{still[1] - still[0]} steps from step {still[0]} at {level:.0f} px"
        yield Numbers(
            law=title_of(law),
            hidden=joined(hidden),
            views=joined(trace.view),
            verdict=trace.verdict,
            cameras=_cameras(len(hidden), "both", "all"),
            least_hidden=min(hidden),
            plateau=plateau,
            window=window,
        )


@_RUNS.claim(
    "The planned trajectory avoids self-occlusion",
    "sections 4.3 and 6, Figs. 5 and 6",
    "minimum margin {margin:.3f} (1 at the start); ends {miss:.2g} px from the goal images",
    "margin positive in {cameras} all along",
    lambda n: n.margin > 0,
)
def _planned(subject: _Subject) -> Iterator[Numbers]:
    """Smallest margin of the planned motion, and how far from the goal images it ends, px."""
    plan = subject.data.plan
    yield Numbers(
        margin=plan.margin.min(),
        miss=np.linalg.norm(plan.s[-1] - plan.s_star, axis=-1).max(),
        cameras=_cameras(len(plan.view), "both", "all"),
    )


@_RUNS.claim(
    "No self-occlusion under direct control",
    "sections 4.2 and 7",
    "self-occluded steps: {counts}",
    "no step in {cameras}",
    lambda n: n.total == 0,
)
def _hidden_steps(subject: _Subject) -> Iterator[Numbers]:
    """Steps of each direct law in which the face is hidden, by camera."""
    traces = [(law, subject.data.traces[law]) for law in DIRECT if law in subject.data.traces]
    counts = [
        f"{title_of(law)} "
        + ", ".join(f"{n} {view}" for n, view in zip(trace.self_occluded_steps, trace.view, strict=True))
        for law, trace in traces
    ]
    if traces:
        yield Numbers(
            counts="; ".join(counts),
            total=sum(sum(trace.self_occluded_steps) for _, trace in traces),
            cameras=_cameras(len(subject.data.view), "either", "any"),
        )


_SMALL_SHARE = 0.01  # share of the diagonal of an image that counts as very little


@_RUNS.claim(
    "The image paths of directTHREE and directTWO differ very little",
    "section 6, Fig. 7",
    "largest distance between both paths {gap:.1f} px; the face is {tilt:.0f}° off the image planes",
    f"at most {_SMALL_SHARE:.0%} of the image diagonal, {{bound:.1f}} px",
    lambda n: n.gap <= n.bound,
)
def _gap(subject: _Subject) -> Iterator[Numbers]:
    """Distance of the image paths of both direct laws, and the tilt of the face."""
    paths = [trace.s.reshape(len(trace.s), -1, 2) for trace in map(subject.data.traces.get, DIRECT) if trace]
    if len(paths) == len(DIRECT):
        diagonal = float(np.linalg.norm(subject.data.plant.image_size, axis=1).min())
        yield Numbers(gap=path_gap(*paths), tilt=_tilt(subject.data), bound=_SMALL_SHARE * diagonal)


def _tilt(report_data: ReportData) -> float:
    """Angle of the face at the start to the image planes, deg."""
    model, M = report_data.plant.model, report_data.plant.M
    points = (M @ forward_kinematics(model, report_data.plan.q_start).T)[:, :3]
    normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
    axes = model.P[:, 2, :3] / np.linalg.norm(model.P[:, 2, :3], axis=1, keepdims=True)
    axis = axes.mean(axis=0)
    return math.degrees(math.acos(min(1.0, abs(float(normal @ axis)) / float(np.linalg.norm(axis)))))


def path_gap(first: FloatArray, second: FloatArray) -> float:
    """Largest distance of a vertex of either path from the other, px, of paths (k, p, 2) and (l, p, 2)."""
    orders = ((first, second), (second, first))
    return max(float(_to_polyline(a[:, i], b[:, i]).max()) for a, b in orders for i in range(a.shape[1]))


def _to_polyline(points: FloatArray, path: FloatArray) -> FloatArray:
    """Distance (k,) of points (k, 2) from a polyline (l, 2)."""
    start, distance = path[:-1], np.diff(path, axis=0)
    if not len(distance):
        return np.asarray(np.linalg.norm(points - path[0], axis=1))
    square = np.maximum((distance**2).sum(axis=1), np.finfo(float).tiny)
    offset = points[:, None] - start
    share = np.clip((offset * distance).sum(axis=2) / square, 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - share[..., None] * distance, axis=2).min(axis=1))


_LEVEL_SHARE = 0.02  # variation of the ordinate of a level motion, over that of its abscissa


@_RUNS.claim(
    "The centre moves horizontally in the images: its ordinate stays constant",
    "section 6, Fig. 11",
    "ordinate varies by {variation} px while the abscissa travels {travel} px ({views})",
    f"variation at most {_LEVEL_SHARE:.0%} of the travel",
    lambda n: n.level,
)
def _level(subject: _Subject) -> Iterator[Numbers]:
    """Variation of abscissa and ordinate of the centre in the images under directTHREE, px."""
    if (trace := subject.data.traces.get(DIRECT[0])) is not None:
        travel, variation = np.ptp(subject.data.center_image(trace), axis=0).T
        yield Numbers(
            variation=joined([f"{v:.1f}" for v in variation]),
            travel=joined([f"{u:.0f}" for u in travel]),
            views=", ".join(subject.data.view),
            level=(variation <= _LEVEL_SHARE * travel).all(),
        )


# Off its line by less than this, mm, the centre does not drift: round-off.
_NO_DRIFT_MM = 1e-6
# A limit that bends the first step alone moves the phase at which the largest deviation is sampled.
_SAMPLING = 1e-3


@_DRIFT.claim(
    "{law}: the drift falls with the gain",
    "section 6, Fig. 8",
    "{free} mm at gains {gains} per step; calibrated {free_calibrated} mm",
    "strictly, with true operators and no limit",
    lambda n: n.falls,
)
@_DRIFT.claim(
    "{law}: the drift falls with a limit of {limit:g}° per step",
    "section 6, Fig. 8",
    "{limited} mm at the same gains; calibrated {limited_calibrated} mm",
    f"nowhere larger than without the limit by more than {_SAMPLING:.1%}, smaller at the highest gain",
    lambda n: n.falls_with_limit,
)
def _drift_of_laws(subject: _Subject) -> Iterator[Numbers]:
    """Drift of each direct law by gain, without and with the limit of the joint motion, mm."""
    rising = np.argsort(subject.studies.gains)
    for law, (true, calibrated) in zip(DIRECT, subject.drift, strict=True):
        free, limited = true
        yield Numbers(
            law=title_of(law),
            gains=_short(subject.studies.gains),
            limit=subject.studies.step_limit_deg,
            free=_listed(free),
            limited=_listed(limited),
            free_calibrated=_listed(calibrated[0]),
            limited_calibrated=_listed(calibrated[1]),
            falls=(np.diff(free[rising]) > 0).all(),
            falls_with_limit=(limited <= free * (1 + _SAMPLING)).all() and limited[0] < free[0],
        )


@_DRIFT.claim(
    "The path with joint velocities limited to {limit:g}° per step is the innermost",
    "section 6, Fig. 8",
    "{limited:.3g} mm with the limit, {free} mm without at gains {gains}; at gain {min_gain:g} "
    "no joint turns by more than {turn:.2g}° in a step",
    "smaller than without the limit at every gain (directTHREE, true operators)",
    lambda n: n.limited < n.min_free,
)
def _innermost(subject: _Subject) -> Iterator[Numbers]:
    """Drift of directTHREE with true operators, mm, and the longest turn of a joint in a slow step, deg."""
    (free, limited), low_gain = subject.drift[0, 0], min(subject.studies.gains)
    yield Numbers(
        limit=subject.studies.step_limit_deg,
        limited=float(limited.max()),
        free=_listed(free),
        gains=_short(subject.studies.gains),
        min_gain=low_gain,
        turn=_longest_turn(subject, subject.studies.sweep[DIRECT[0], "true", False, low_gain]),
        min_free=free.min(),
    )


def _longest_turn(subject: _Subject, trace: Trace) -> float:
    """Longest turn of a revolute joint in one step of a run, deg."""
    steps = np.diff(trace.q[:, ~subject.data.robot.prismatic], axis=0)
    return float(np.degrees(np.abs(steps).max(initial=0.0)))


@_DRIFT.claim(
    "{law}: the drift is typical of low control rates",
    "section 7",
    "{drift} mm at periods of {periods} ms and a fixed gain in 1/s; drift ∝ period^{order:.2f}; "
    "a joint turns by up to {turn:.0f}° in a step of the longest period",
    "falls strictly with the period, true operators and no limit",
    lambda n: n.falls,
)
def _rate(subject: _Subject) -> Iterator[Numbers]:
    """Drift over the period; the longest turn in a step says how far apart the samples can be."""
    studies, periods = subject.studies, np.array(subject.studies.periods)
    for law, drift in zip(DIRECT, study_numbers(studies)["period_path_deviation_mm"], strict=True):
        if len(periods) > 1 and (drift > 0).all():
            yield Numbers(
                law=title_of(law),
                drift=_listed(drift),
                periods=_short(1e3 * periods),
                order=np.polyfit(np.log(periods), np.log(drift), 1)[0],
                turn=_longest_turn(subject, studies.rate[law, max(studies.periods)]),
                falls=(np.diff(drift[np.argsort(periods)]) > 0).all(),
            )


@_DRIFT.claim(
    "The initially high velocities of q1 and q3 cause the drift",
    "section 6, Fig. 12",
    "second-order contributions to the first step's deviation of {first:.2f} mm: {shares} mm; "
    "fastest at first {fastest}",
    "q1 and q3 contribute most (directTHREE, true operators, no limit)",
    lambda n: n.most == {0, 2},
)
def _shares_of_joints(subject: _Subject) -> Iterator[Numbers]:
    """Second-order share of each joint in the deviation of the first step, mm."""
    model, trace = subject.data.plant.model, subject.studies.own[DIRECT[0], "true", False]
    distance = subject.data.goal_center(trace) - trace.center[0]
    line = distance / max(float(np.linalg.norm(distance)), np.finfo(float).tiny)
    H_hat, joint_step = joint_operators(model, trace.q[0]), trace.q[1] - trace.q[0]
    order = slice(None, None, -1 if model.on_tool else 1)
    center = np.append(trace.center[0], 1.0)
    parts = _second_order_drift(H_hat[order], joint_step[order], center, line)[order]
    ranking = np.argsort(-np.abs(parts))
    yield Numbers(
        first=1e3 * along_line(trace.center[1:2], trace.center[0], trace.center[0] + line)[1][0],
        shares=", ".join(f"q{i + 1} {1e3 * parts[i]:+.2f}" for i in ranking),
        fastest=", ".join(f"q{i + 1}" for i in np.argsort(-np.abs(joint_step))[:2]),
        most={int(i) for i in ranking[:2]},
    )


def _second_order_drift(
    H_hat: FloatArray, joint_step: FloatArray, center: FloatArray, line: FloatArray
) -> FloatArray:
    """Contribution of each joint to the centre's second-order deviation from its line in one step, m.

    Under the product of exponentials of [RH00] eq. (6) a point M has the second derivatives
    Ĥ_i Ĥ_j M, i ≤ j. Joint i is given its own term and half of each term it shares with another
    joint; contributions (n,) are counted along the direction of their sum, so that they add up to its
    length. With metric operators (n, 4, 4) at the current joints, a step (n,), rad or m, the centre (4,), m,
    and the unit direction (3,) of the line.
    """
    acceleration = np.einsum("iab,jbc,c->ija", H_hat, H_hat, center)[..., :3]
    ordered = np.tri(len(H_hat), dtype=np.bool_).T[..., None]
    acceleration = np.where(ordered, acceleration, acceleration.swapaxes(0, 1))
    parts = 0.5 * np.einsum("i,j,ija->ia", joint_step, joint_step, acceleration)
    parts -= np.outer(parts @ line, line)
    total = parts.sum(axis=0)
    return np.asarray(parts @ total / max(float(np.linalg.norm(total)), np.finfo(float).tiny))


_EXACT_DEG = 1e-3  # a rotation is the planned one to within this


def _drift_of(trace: Trace) -> float:
    return float(trace.center_deviation_mm or 0.0)


@_CURES.claim(
    "directTWO is free of the bias of directTHREE, whose rotations do not commute",
    "eq. (21), section 5.2",
    "exact steps turn the face off its planned rotation by {three:.3g}° (directTHREE) and "
    "{two:.3f}° (directTWO); joint steps move the centre by {drift_three:.3g} and {drift_two:.3g} mm",
    f"directTWO by at most {_EXACT_DEG:g}°, directTHREE by more",
    lambda n: n.two <= _EXACT_DEG < n.three,
)
def _bias(subject: _Subject) -> Iterator[Numbers]:
    """Deviation, deg, of exact steps of the direct laws from the planned rotation; their drift, mm."""
    if subject.composition is not None:
        three, two = np.degrees(subject.composition.bias)
        drift = [_drift_of(subject.studies.own[law, "true", False]) for law in DIRECT]
        yield Numbers(three=three, two=two, drift_three=drift[0], drift_two=drift[1])


@_CURES.claim(
    "λ_t can be set as high as visibility permits",
    "section 5.2",
    "{verdict}, {hidden} self-occluded steps; drift {fast:.3g} mm "
    "where a step takes 0.9 of the translation, {three:.3g} mm where it takes {share:g}",
    "converges, no self-occlusion, and the drift is no larger (directTHREE, true operators, no limit)",
    lambda n: (
        arrived(n.verdict) and not n.ever_hidden and n.fast <= n.three * (1.0 + _SAMPLING) + _NO_DRIFT_MM
    ),
)
def _fast(subject: _Subject) -> Iterator[Numbers]:
    """End of a run that takes most of the translation in a step, and drifts of it and the configured one."""
    trace, gains = subject.studies.further["fast"], subject.studies.gains_of_laws
    yield Numbers(
        verdict=trace.verdict,
        hidden=joined(trace.self_occluded_steps),
        ever_hidden=any(trace.self_occluded_steps),
        fast=_drift_of(trace),
        three=_drift_of(subject.studies.own[DIRECT[0], "true", False]),
        share=gains.gain_t * gains.period,
    )


@_CURES.claim(
    "Tracking a trajectory once calculated cures the drift of calculating it anew",
    "section 7",
    "{drift:.3g} mm along the plan, {three:.3g} (directTHREE) and {two:.3g} mm (directTWO) anew in "
    "each step, calibrated operators and the limit",
    "smaller than either, verdict converged",
    lambda n: None if n.still else arrived(n.verdict) and n.drift < min(n.three, n.two),
)
def _tracked(subject: _Subject) -> Iterator[Numbers]:
    """Drift along the plan, and of both direct laws that recalculate it, mm."""
    tracked = subject.studies.further.get("tracked")
    if tracked is not None and tracked.center_deviation_mm is not None:
        three, two = (_drift_of(subject.studies.own[law, "calibrated", True]) for law in DIRECT)
        drift, still = tracked.center_deviation_mm, _still(subject)
        yield Numbers(drift=drift, three=three, two=two, verdict=tracked.verdict, still=still)


def _still(subject: _Subject) -> bool:
    """Whether the joints carry the centre straight."""
    return bool(subject.drift[:, 0].max() < _NO_DRIFT_MM)


# A curve follows an exponential if each step's factor is within this share of 1 - gain·period, over enough
# steps that are this long after the last one at the joint-speed limit, and down to errors that only
# the calibration explains, m and rad.
_FACTOR_TOLERANCE = 0.01
_LEAST_STEPS, _SETTLING_STEPS = 10, 20
_LEAST_DISTANCE, _LEAST_ANGLE = 1e-4, math.radians(0.05)


@_CONTROL.claim(
    "{law}: the control errors decay exponentially",
    "section 6, Figs. 9 and 10",
    "fitted rates {rate_t:.3f} (centre) and {rate_r:.3f} (θ_s) per s for gains {gain_t:g} and "
    "{gain_r:g}; each step's factor within {off:.2%} of 1 - gain·period over {steps_t} and {steps_r} "
    "steps",
    f"factor of every settled step within {_FACTOR_TOLERANCE:.0%} of 1 - gain·period",
    lambda n: n.off <= _FACTOR_TOLERANCE,
)
def _decay(subject: _Subject) -> Iterator[Numbers]:
    """Whether the distance of the centre and the rotation decay at the gains of both, of the slowest turn.

    A loop that takes the share λ T of an error in each period T has the rate λ, 1/s.
    """
    gains = subject.studies.gains_of_laws
    slowest = {"direct_two": gains.gain_s, "direct_three": min(gains.gain_r, gains.gain_p)}
    for law in DIRECT:
        trace = subject.studies.own[law, "calibrated", True]
        if not np.isfinite(trace.goal_pose).all():
            continue
        first = _SETTLING_STEPS + int(np.flatnonzero(trace.speed_factor < 1.0).max(initial=0))
        distance = _settled(subject.data.center_distance(trace)[first:], _LEAST_DISTANCE)
        angle = _settled(trace.theta_s[first:], _LEAST_ANGLE)
        numbers = Numbers(law=title_of(law), gain_t=gains.gain_t, gain_r=slowest[law])
        if min(len(distance), len(angle)) > _LEAST_STEPS:
            numbers.rate_t, off_t = _rate_of_decay(distance, gains.gain_t, trace.period)
            numbers.rate_r, off_r = _rate_of_decay(angle, slowest[law], trace.period)
            numbers.off = max(off_t, off_r)
            numbers.steps_t, numbers.steps_r = len(distance) - 1, len(angle) - 1
        else:
            numbers.unknown = "too few settled steps"
        yield numbers


def _settled(error: FloatArray, floor: float) -> FloatArray:
    """Errors before the first that is no larger than the floor."""
    return error[np.logical_and.accumulate(error > floor)]


def _rate_of_decay(error: FloatArray, gain: float, period: float) -> tuple[float, float]:
    """Fitted rate of an error (k,), 1/s, and the difference of the factor of a step from that of a gain."""
    slope = np.polyfit(np.arange(len(error)), np.log(error), 1)[0]
    off = np.abs(error[1:] / error[:-1] / (1.0 - gain * period) - 1.0).max()
    return (1.0 - math.exp(slope)) / period, float(off)


_MODEL_TOLERANCE_DEG = 1e-6
_START_TOLERANCE_DEG = 0.5
_VISIBLE_PX = 1.0  # change by which a coordinate rises, or leaves the exponential
_SCALE_TOLERANCE = 2.0  # within this τ agrees with the true distance, % of the start


@_CONTROL.claim(
    "Projective and Euclidean models give the same θ_r and θ_p",
    "section 6, Fig. 10",
    "largest difference {exact:.2g}° with true operators, {estimated:.2g}° with calibrated ones",
    f"at most {_MODEL_TOLERANCE_DEG:g}° with true operators",
    lambda n: n.exact <= _MODEL_TOLERANCE_DEG,
)
def _models(subject: _Subject) -> Iterator[Numbers]:
    """Largest difference of θ_r and θ_p between projective models and the Euclidean one, deg."""
    metric, twin, calibrated = (
        subject.studies.own[DIRECT[0], kind, False] for kind in ("true", "twin", "calibrated")
    )

    def difference(trace: Trace) -> float:
        angles = [(getattr(trace, name), getattr(metric, name)) for name in ("theta_r", "theta_p")]
        return max(math.degrees(curve_difference(*both).max()) for both in angles)

    yield Numbers(exact=difference(twin), estimated=difference(calibrated))


@_CONTROL.claim(
    "The difference of τ from its Euclidean truth is only apparent, a matter of scale",
    "section 6, Fig. 10",
    "largest difference {off:.3g} % of the start with the unit-norm kernel of (8), {affine:.2g} % "
    "with the scale fixed through a_inf",
    f"at most {_SCALE_TOLERANCE:g} % with the scale fixed",
    lambda n: n.affine <= _SCALE_TOLERANCE,
)
def _scale(subject: _Subject) -> Iterator[Numbers]:
    """Largest difference of τ from the true distance in both scales, % of the start."""
    trace = subject.studies.own[DIRECT[0], "calibrated", False]
    if np.isfinite(trace.goal_pose).all() and trace.tau[0] != 0:
        distance = percent(subject.data.center_distance(trace))
        off, affine = (np.abs(percent(tau) - distance).max() for tau in (trace.tau, trace.tau_affine))
        yield Numbers(off=off, affine=affine)


@_CONTROL.claim(
    "θ_s starts at the overall rotation of the task, 180° in the paper",
    "section 6, Fig. 9",
    "{start:.3f}°; true rotation {stated}",
    f"within {_START_TOLERANCE_DEG:g}° of the true rotation",
    lambda n: None if math.isnan(n.off) else n.off <= _START_TOLERANCE_DEG,
)
def _rotation(subject: _Subject) -> Iterator[Numbers]:
    """θ_s at the start and the rotation of the task, NaN if that is unknown, deg."""
    trace = subject.studies.own[DIRECT[1], "calibrated", False]
    start, task, stated = math.degrees(trace.theta_s[0]), math.nan, "unknown"
    if np.isfinite(trace.goal_pose).all():
        R = trace.pose[0, :3, :3].T @ trace.goal_pose[:3, :3]
        task = math.degrees(Rotation.from_matrix(R).magnitude())
        stated = f"{task:.3f}°"
    yield Numbers(start=start, stated=stated, off=abs(start - task))


@_CONTROL.claim(
    "The image error does not decay exponentially",
    "section 6, Fig. 11",
    "a marker coordinate is up to {off:.0f} px away from an exponential decay",
    f"more than {_VISIBLE_PX:g} px (directTHREE, no limit)",
    lambda n: n.off > _VISIBLE_PX,
)
@_CONTROL.claim(
    "The image error does not even decay monotonically",
    "section 6, Fig. 11",
    "{rising} of {count} marker coordinates rise again, by up to {rise:.0f} px",
    f"one by more than {_VISIBLE_PX:g} px (directTHREE, no limit)",
    lambda n: n.rising > 0,
)
def _image_error(subject: _Subject) -> Iterator[Numbers]:
    """Differences of image errors from a decay by a factor per step, and rise above their minimum, px."""
    trace = subject.studies.own[DIRECT[0], "calibrated", False]
    e = trace.s - trace.s_star
    decay = (1.0 - subject.studies.gains_of_laws.gain_t * trace.period) ** np.arange(len(e))
    size = np.abs(e)
    rise = (size - np.minimum.accumulate(size, axis=0)).max(axis=0)
    yield Numbers(
        off=np.abs(e - e[0] * decay[:, None, None, None]).max(),
        rising=int((rise > _VISIBLE_PX).sum()),
        count=rise.size,
        rise=rise.max(),
    )


_TRIAL = 0.5  # rad or m, of a trial motion of one joint
_SAME_OPERATOR = 1e-9  # share of an operator within which another is the same


@_EQUATION.claim(
    "A trial motion of a joint defines its operator",
    "section 2, eqs. (2), (4), (5)",
    "by homographies of trials by {trial:g} rad or m, operators are within {off:.1g} of those calibrated",
    "equal to round-off",
    lambda n: n.off <= _SAME_OPERATOR,
)
def _group_to_algebra(subject: _Subject) -> Iterator[Numbers]:
    """Largest share by which operators of trial motions, known up to scale, err."""
    model, A = subject.data.calibrated, subject.data.plan.A
    off = 0.0
    for H_hat, slides in zip(model.H_hat_0, model.prismatic, strict=True):
        H = displacements(H_hat[None], np.array([slides]), np.array([[_TRIAL]]))[0, 0]
        up_to_scale = normalize_displacement(-2.0 * H, A, model.a_inf)
        found = tangent_operator(up_to_scale, _TRIAL, prismatic=bool(slides))
        off = max(off, float(np.linalg.norm(found - H_hat) / np.linalg.norm(H_hat)))
    yield Numbers(trial=_TRIAL, off=off)


_EQUAL_M = 1e-9  # both sides of (22) agree if the centre is moved to within this of the same place


@_EQUATION.claim(
    "exp(λτ Ĥ_t) exp(λθ Ĥ_s) = exp(λτ Ĥ_t + λθ Ĥ_s)",
    "eq. (22), section 5.2",
    "the centre differs by {distance} mm at λ = {shares}{order}; the translation is {angle:.1f}° "
    "from the axis of the turn",
    "equal to round-off; to first order only if the difference is ∝ λ²",
    lambda n: n.largest <= _EQUAL_M,
)
def _equation_22(subject: _Subject) -> Iterator[Numbers]:
    """Differences of both sides of [RH00] eq. (22) at shares of the task, and their order."""
    if subject.composition is None:
        return
    lambdas, distance, angle, _ = subject.composition
    small, order = np.argsort(lambdas)[:3], ""
    if (distance[small] > 0).all():
        slope = np.polyfit(np.log(lambdas[small]), np.log(distance[small]), 1)[0]
        order = f"; difference ∝ λ^{slope:.2f}"
    yield Numbers(
        distance=_listed(1e3 * distance),
        shares=_short(lambdas),
        order=order,
        angle=math.degrees(angle),
        largest=distance.max(),
    )


def claims_of(report_data: ReportData, composition: Composition | None) -> list[_Claim]:
    """All claims that this run can speak about, in the order of the paper.

    report_data : records, truth and extra runs.
    composition : of the parts of the task; None if it could not be computed.
    """
    subject = _Subject(report_data, composition)
    claims, studies = [*_RUNS.judged(subject)], report_data.studies
    if studies is not None and all(trace.steps for trace in studies.own.values()):  # a start off the goal
        if np.isfinite(subject.drift).all():  # else the goal pose is unknown
            no_drift = "the joints carry the centre straight, within {:.1g} mm: there is no drift"
            unknown = no_drift.format(subject.drift[:, 0].max()) if _still(subject) else ""
            claims += [*_DRIFT.judged(subject, unknown), *_CURES.judged(subject)]
        claims += _CONTROL.judged(subject)
    return [*claims, *_EQUATION.judged(subject)]
