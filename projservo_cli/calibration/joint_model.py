"""Joints that are not ideal: curves of readings, coupling and deflection, fitted with all other parameters.

Each hypothesis is a row of ``DEVIATIONS`` with functions that add terms to the curve of true joints by
readings; sag is a deflection of each revolute joint that follows the torque of weights at the tool, or along
the arm. Automatic choice takes one by one the terms that the score tests name, and that explain the images
about as well. It keeps the hypothesis that predicts left-out poses best, if by more than chance, and stops
if none does.
"""

import dataclasses
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from projservo_cli.calibration.bundle_adjustment import LeastSquares
from projservo_cli.calibration.checks.model_errors import suspected
from projservo_cli.calibration.detections import MAX_JUDGED, per_rad
from projservo_cli.calibration.initial.epipolar import ImageGeometry
from projservo_cli.calibration.joint_noise import NO_JOINT_NOISE, SIGNIFICANT
from projservo_cli.calibration.prediction import Parameters
from projservo_cli.calibration.robust_fit import (
    Expected,
    Solution,
    by_usual_noise,
    fit_from,
    fit_inliers,
    fit_joint_noise,
    left_out_errors,
    left_out_px,
)
from projservo_cli.deviations import ARGUMENTS, BASIS, CURVES, DEVIATIONS, PAIR
from projservo_cli.findings import LIMITS, Finding
from projservo_cli.geometry.joint_curve import basis, slopes, torques
from projservo_cli.messages.placeholders import quantity
from projservo_cli.records import (
    NO_CURVE,
    TOOL,
    Calibration,
    FloatArray,
    InputError,
    JointCurve,
    WorkFailed,
)

AUTO = "auto"
# Standard deviations of chance by which squared errors at left-out poses must fall.
_SURE = 2.0
# Share of the largest decrease from which a hypothesis of fewer terms is preferred.
_AS_MUCH = 0.95
# Maximum numbers of hypotheses that are chosen, and of those that are tried for each.
_MAX_CHOSEN, _TRIED = 6, 4
# Number of the likeliest hypotheses among which a kind that several joints have may be one of all.
_NAMED = 12
# Maximum deviation, rad (prismatic × 0.3 m/rad), of a joint within its range by a term that is determined.
_OPEN = np.radians(5.0)
# Deviations from zero below which a term of one joint of many is left out: H. Akaike's criterion of 1974, by
# which a parameter is worth a gain of two in χ².
_APART = 1.41
# Deflection by the largest torque, rad, beyond the deflection of any joint.
_BENDS = np.radians(5.0)
# Minimum determinant of the derivatives of true joints by readings, within the recorded poses.
_FOLDS = 0.2
# Rounds of the search for the direction of gravity, and the usual deflection, rad, which keeps it finite.
_ROUNDS, _USUAL_SAG = 20, np.radians(0.5)
# Least and largest deviation of terms by which positions of the flange err with its place.
_LEAST, _WIDE = 1e-5, 0.02
# Deviation above which such terms are a fault of the table, that score tests name: a scale of 2 % has 0.6 %.
_FAULT = 5e-3

_Term = tuple[int, int, int]  # index of the function, joint moved and joint read


class Hypothesis(NamedTuple):
    """A kind of curve, and its joint from 1, none for all; of a coupling the one read, then the one moved."""

    kind: str
    joints: tuple[int, ...]

    @property
    def words(self) -> str:
        """Name as configured, such as scale:2 or coupling:4-5."""
        return ":".join(filter(None, (self.kind, "-".join(map(str, self.joints)))))


def hypotheses_of(asked: str | Iterable[str], joint_types: str, mount: str) -> list[Hypothesis]:
    """Return the hypotheses of words such as scale, scale:2, coupling:4-5 or sag, for joints R or P.

    Raises InputError for an unknown word, or a term that no image shows.
    """
    found, n = list[Hypothesis](), len(joint_types)
    asked = asked.split(",") if isinstance(asked, str) else asked
    slides = [i for i, kind in enumerate(joint_types, 1) if kind.upper() == "P"]
    for word in asked:
        kind, _, which = word.partition(":")
        if kind not in CURVES or (which and kind == "sag"):
            raise InputError(f"joint model {word!r}: choose auto, or of {', '.join(CURVES)}, such as scale:2")
        row = DEVIATIONS[kind]
        try:
            joints = tuple(int(number) for number in which.split("-") if number)
        except ValueError:
            joints = (0,)
        count = 2 if row.part == PAIR else 1
        if any(not 1 <= j <= n for j in joints) or (joints and len(set(joints)) != count):
            example = "coupling:1-2, joint read and joint moved" if count == 2 else f"{kind}:1"
            raise InputError(f"joint model {word!r}: joints are 1 to {n}; write {kind}, or {example}")
        if kind == "sag" and mount == TOOL:
            raise InputError(
                "joint model 'sag': no image shows the weight at a tool with cameras; leave it out"
            )
        if kind == "scale" and slides and joints == (slides[0],):
            raise InputError(
                f"joint model {word!r}: images do not show the scale of prismatic joint {slides[0]}, which "
                "sets that of the frame: leave it out; metric --scale takes it from a known length"
            )
        if row.turns and set(joints) & set(slides):
            raise InputError(f"joint model {word!r}: prismatic joint {joints[0]} has no turn; leave it out")
        # A coupling needs two joints, a prismatic joint has no turn, and the first one no scale; if none
        # turns, the load of each is constant.
        others = {"coupling": n - 1, "scale": n - bool(slides)}
        if not others.get(kind, n - len(slides) if row.turns else n):
            raise InputError(f"joint model {word!r}: no joint of {joint_types} can have it; leave it out")
        pairs = [(i, j) for i in range(1, n + 1) for j in range(1, n + 1) if i != j]
        found += [Hypothesis(kind, one) for one in (pairs if count == 2 and not joints else [joints])]
    return list(dict.fromkeys(found))


@dataclasses.dataclass(frozen=True, eq=False)
class JointModelFit:
    """A fit with a curve of the joints."""

    solution: Solution
    gains: FloatArray  # (T, 2) typical error at left-out poses, px, without and with each term
    findings: tuple[Finding, ...] = ()


def fit_joint_model(
    start: Solution, asked: Sequence[Hypothesis] | None, epipolar: ImageGeometry
) -> JointModelFit | None:
    """Fit the curve of the hypotheses asked for, or for None of those that the data show.

    None if they show none. Raises WorkFailed naming a hypothesis that the data do not determine.
    """
    exact = start
    if start.problem.tau is not None:
        params = dataclasses.replace(start.params, offsets=None)
        again = fit_from(start.problem.with_noise(None), params, epipolar)
        exact = dataclasses.replace(start, joint_noise=None) if again is None else again
    search = _Search(exact, epipolar)
    if asked is None:
        chosen, best = search.automatic()
        if not chosen:
            return None
        found: Solution | None = search.pruned(best, chosen)
    else:
        chosen, found = list(asked), search.with_curve(asked)
    if found is None:
        names = ", ".join(one.words for one in chosen)
        raise WorkFailed(f"no fit with the joint model {names} explains the images: leave some of it out")
    if asked is not None:
        search.require_known(found, chosen)
    if found.params.curve is None:
        return None
    before = search.gains
    now = left_out_px(found)
    owners = _terms(chosen, exact)
    without = {key: before.get(one, left_out_px(exact)) for one in chosen for key in owners[one]}
    return JointModelFit(found, np.array([[without[key], now] for key in _keys(found.params.curve)]))


def fit_errors_of_place(start: Solution, expected: Expected) -> JointModelFit | None:
    """Fit errors of positions of the flange that are a linear map of its place, with a normal prior.

    The deviation of the nine terms is that of maximum marginal likelihood. Noise of poses that contradicts
    images, as such errors do, is estimated with the terms. None if the images do not show them, by the test
    of the noise of joints, if they are a fault, or if the noise of poses is given or none.
    """
    detections, noise = start.problem.detections, start.joint_noise
    given_or_none = noise is None or (noise.sigma_q > 0.0) != (noise.interval is not None)
    if detections.chart is None or start.params.curve is not None or given_or_none:
        return None
    near = by_usual_noise(start, expected) if start.problem.tau is None else start
    slides = np.flatnonzero(start.params.prismatic)
    terms = np.array([(BASIS.index("linear"), i, j, 0.0) for i in slides for j in slides])
    bare = LeastSquares.of(detections, start.problem.q_reference, start.problem.lens_terms, len(terms))
    params = dataclasses.replace(near.params, curve=NO_CURVE._replace(terms=terms))

    def fitted(near: Solution, params: Parameters, size: float) -> Solution | None:
        """Fit with terms of a size, at the noise of poses of a fit near it."""
        spread = size / max(near.sigma_px, 1e-9)
        problem = dataclasses.replace(bare, tau=near.problem.tau, term_spread=spread)
        return fit_inliers(problem, params, near.sigma_px, min_px=expected.min_px)

    if (wide := fitted(near, params, _WIDE)) is None:
        return None
    wide = fit_joint_noise(wide, expected, None)
    if wide.joint_noise is NO_JOINT_NOISE:
        return None
    size, gain = _size_of_terms(wide)
    found = fitted(wide, wide.params, size) if gain > SIGNIFICANT and size < _FAULT else None
    if found is None:
        return None
    found = dataclasses.replace(found, joint_noise=wide.joint_noise)
    gains = np.tile([left_out_px(start), left_out_px(found)], (len(terms), 1))
    return JointModelFit(found, gains, (Finding("errors_of_place", LIMITS, amount=size, unit="m"),))


def _size_of_terms(wide: Solution) -> tuple[float, float]:
    """Deviation of terms by marginal likelihood from a fit with a wide prior, and the deviance that it saves.

    A direction that the images leave open, as the scale of all positions, has no information.
    """
    problem, px = wide.problem, wide.sigma_px
    rows, terms = wide.errors().shared[problem.curved], (wide.params.curve or NO_CURVE).terms[:, 3]
    inverse = np.linalg.inv(px**2 * rows @ rows.T)
    by_prior = np.eye(len(rows)) / (px * (problem.term_spread or np.inf)) ** 2
    information, V = np.linalg.eigh(inverse - by_prior)
    information, square = np.maximum(information, 0.0), (V.T @ inverse @ terms) ** 2

    def deviance(log_size: float) -> float:
        """Deviance of a size, less that of none."""
        s = np.exp(2.0 * log_size)
        return float((np.log1p(s * information) - square * s / (1.0 + s * information)).sum())

    best = minimize_scalar(deviance, bounds=(np.log(_LEAST), np.log(_WIDE)), method="bounded")
    return float(np.exp(best.x)), -float(best.fun)


def _keys(curve: JointCurve) -> list[_Term]:
    """Terms of a curve without their coefficients."""
    return [(f, i, by) for f, i, by in curve.terms[:, :3].astype(int).tolist()]


def _deviations(found: Solution) -> FloatArray:
    """Standard deviations (T,) of the coefficients of a curve."""
    rows = found.problem.curved
    return np.asarray(found.sigma_px * np.linalg.norm(found.errors().shared[rows], axis=1))


def _terms(chosen: Iterable[Hypothesis], solution: Solution) -> dict[Hypothesis, list[_Term]]:
    """Terms of each hypothesis, its joints in the order of a fit."""
    prismatic, numbers = solution.params.prismatic, solution.problem.detections.numbers.tolist()
    found = {}
    for one in chosen:
        joints, row = [numbers.index(j) for j in one.joints], DEVIATIONS[one.kind]
        pairs = [(joints[-1], joints[0])] if joints else [(i, i) for i in range(len(numbers))]
        if row.turns:
            pairs = [(i, by) for i, by in pairs if not prismatic[i]]
        # The first prismatic joint of the arm sets the scale of the frame.
        first = min((number for number, slides in zip(numbers, prismatic, strict=True) if slides), default=0)
        unknown = [(BASIS.index("linear"), i, i) for i, number in enumerate(numbers) if number == first]
        terms = [(BASIS.index(f), i, by) for f in row.curve for i, by in pairs]
        found[one] = [term for term in terms if term not in unknown]
    return found


def describe_curve(calibration: Calibration) -> list[dict[str, Any]]:
    """Return the terms of a curve, none without: function, joints from 1, coefficient, deviation, words.

    And typical errors at left-out poses, px, without the hypothesis that a term belongs to, and with all.
    """
    found, rows = [], [] if calibration.joint_curve is None else calibration.joint_curve.tolist()
    for index, moved, read, c, deviation, before, after in rows:
        function, slides = BASIS[int(index)], bool(calibration.prismatic[int(moved) - 1])
        factor, unit = (1e3, " mm") if slides else (float(np.degrees(1.0)), "°")
        if function in ("linear", "square", "cube"):
            factor, unit = (100.0, " %") if function == "linear" else (1.0, "")
        argument = ARGUMENTS[function].format(int(read))
        text = f"joint {int(moved)}: {factor * c:.2g}{unit} ± {factor * deviation:.1g}{unit} × {argument}"
        numbers = {"joint": int(moved), "by": int(read), "coefficient": c, "deviation": deviation}
        errors = {"left_out_without_px": before, "left_out_px": after}
        found.append({"function": function, **numbers, **errors, "text": text})
    return found


def _in_all(named: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return kinds that are named for several joints, in all joints, by decreasing frequency."""
    kinds = Counter(one.kind for one in named if len(one.joints) == 1)
    return [Hypothesis(kind, ()) for kind, count in kinds.most_common() if count > 1]


class _Search:
    """Fits with curves, from one without."""

    def __init__(self, exact: Solution, epipolar: ImageGeometry) -> None:
        self.exact, self.epipolar = exact, epipolar
        self.gains = dict[Hypothesis, float]()  # typical error at left-out poses without each of those chosen

    def with_curve(
        self, chosen: Sequence[Hypothesis], near: Solution | None = None, but: Sequence[_Term] = ()
    ) -> Solution | None:
        """Fit with the curve of some hypotheses, but for some terms, from a fit near it.

        None if none is found, joints fold, or there is no term.
        """
        near = near or self.exact
        before = near.params.curve or NO_CURVE
        known = dict(zip(_keys(before), before.terms[:, 3].tolist(), strict=True))
        every = (key for terms in _terms(chosen, near).values() for key in terms if key not in but)
        if not (keys := list(dict.fromkeys(every))):
            return None
        terms = np.array([[*key, known.get(key, 0.0)] for key in keys]).reshape(-1, 4)
        arms = [before.arm]
        if any(one.kind == "sag" for one in chosen) and not len(before.arm):
            arms = [_arm(near, spread) for spread in (False, True)]
        problem, detections = near.problem, near.problem.detections
        with_curves = LeastSquares.of(detections, problem.q_reference, problem.lens_terms, len(terms))
        fits = list[Solution]()
        for arm in arms:
            params = dataclasses.replace(near.params, curve=JointCurve(terms, arm), offsets=None)
            found = fit_from(with_curves, params, self.epipolar)
            if found is None or found.params.curve is None:
                continue
            F = slopes(
                found.params.curve, found.params.prismatic, with_curves.q[np.unique(detections.pose_of)]
            )
            fits += [found] if np.linalg.det(F).min() >= _FOLDS else []
        return min(fits, key=lambda fit: fit.sigma_px) if fits else None

    def automatic(self) -> tuple[list[Hypothesis], Solution]:
        """Choose hypotheses that score tests name while left-out poses err less; and their fit."""
        chosen, best, refused = list[Hypothesis](), self.exact, set[Hypothesis]()
        while len(chosen) < _MAX_CHOSEN:
            named = [one for one in self._named(best) if one not in refused and one not in chosen][:_TRIED]
            trials = [(one, self.with_curve([*chosen, one], best)) for one in named]
            better = [(_gain(best, fit), one, fit) for one, fit in trials if fit is not None]
            better = [trial for trial in better if trial[0][1] > _SURE]
            if not better:
                break
            refused.update(set(named) - {one for _, one, _ in better})
            max_gain = max(gain for (gain, _), _, _ in better)
            alike = [trial for trial in better if trial[0][0] >= _AS_MUCH * max_gain]
            _, one, fit = min(alike, key=lambda trial: (trial[2].problem.curve_terms, -trial[0][0]))
            self.gains[one], best = left_out_px(best), fit
            chosen.append(one)
        for one in chosen[:-1]:  # a later one may say all that it did
            others = [other for other in chosen if other != one]
            fewer = self.with_curve(others)
            if fewer is not None and _gain(fewer, best)[1] <= _SURE:
                chosen, best = others, fewer
        return chosen, best

    def _named(self, solution: Solution) -> list[Hypothesis]:
        """Hypotheses by which score tests of a fit explain images better than none, likeliest first."""
        found = list[Hypothesis]()
        for kind, joints in suspected(solution.thinned(MAX_JUDGED)):
            if kind == "sag":
                found += [] if solution.problem.detections.mount == TOOL else [Hypothesis("sag", ())]
            elif kind in CURVES:
                found.append(Hypothesis(kind, () if kind == "scale" and len(joints) > 1 else joints))
        found = list(dict.fromkeys(found))
        return [*_in_all(found[:_NAMED]), *found]

    def pruned(self, found: Solution, chosen: Sequence[Hypothesis]) -> Solution:
        """Fit without terms of hypotheses of all joints that differ from zero by chance, or bend too far."""
        curve, deviation = found.params.curve or NO_CURVE, _deviations(found)
        size, groups = np.abs(curve.terms[:, 3]), [one for one in chosen if not one.joints]
        weak = (size < _APART * deviation) | ((curve.terms[:, 0] == BASIS.index("torque")) & (size > _BENDS))
        own = {key for keys in _terms(groups, found).values() for key in keys}
        but = [key for key, out in zip(_keys(curve), weak, strict=True) if out and key in own]
        fewer = self.with_curve(chosen, found, but) if 0 < len(but) < len(size) else None
        return fewer or found

    def require_known(self, found: Solution, chosen: Sequence[Hypothesis]) -> None:
        """Refuse a curve with a term that the data leave open, by the motion of its joint in its range."""
        params, problem = found.params, found.problem
        curve = params.curve or NO_CURVE
        deviation = _deviations(found)
        max_gain = np.abs(basis(curve, params.prismatic, problem.q)).max(axis=0)
        joint = curve.terms[:, 1].astype(int)
        off = deviation * max_gain / per_rad(params.prismatic)[joint]
        t = int(np.argmax(off))
        if off[t] <= _OPEN:
            return
        key = _keys(curve)[t]
        name = next(one.words for one, keys in _terms(chosen, found).items() if key in keys)
        i = joint[t]
        a_rad, slides = per_rad(params.prismatic)[i], bool(params.prismatic[i])
        amount, most_allowed = (quantity(x * a_rad, "m" if slides else "rad") for x in (off[t], _OPEN))
        raise WorkFailed(
            f"joint model {name}: the data do not determine it, joint {problem.detections.numbers[i]} may be "
            f"off by {amount}, more than {most_allowed} within its range: leave it out, or record more poses "
            "in which the joint moves farther"
        )


def _gain(before: Solution, after: Solution) -> tuple[float, float]:
    """Decrease of squared errors at left-out poses, px², and that over its deviation by chance.

    By detections that count in both fits. The squares of errors e + δ exceed the squares of e by 2 e·δ + δ²,
    where e is noise if the later fit is right: sums of 2 e·δ over poses have mean zero, and show their
    deviation.
    """
    before, after = before.thinned(MAX_JUDGED), after.thinned(MAX_JUDGED)
    first, e = left_out_errors(before), left_out_errors(after)
    both = (before.used & after.used)[..., None]
    gain = (both * (first**2 - e**2)).sum()
    by_chance = after.problem.at_poses((both * 2.0 * e * (first - e)).sum(axis=(0, 2)))
    return float(gain), float(gain / max(float(np.linalg.norm(by_chance)), 1e-300))


def _arm(solution: Solution, spread: bool) -> FloatArray:
    """Arm by which torques are known (n + 1, 5, 4), with a weight at the tool, or as much at each joint.

    That of a joint is where its axis is nearest to the tool. Gravity is the direction g of the deflections
    s_i g · load_i that explain most of the residuals, with a stiffness of each joint; both alternate, from
    each axis.
    """
    few = solution.thinned(MAX_JUDGED)
    problem, params, used = few.problem, few.params, few.used
    center = np.append(params.M[:, :3].mean(axis=0), 1.0)
    velocity = params.H_hat @ center
    on_axis = center + (params.H_hat @ velocity[..., None])[..., 0]
    weights = np.vstack([on_axis * (spread & ~params.prismatic)[:, None], center])
    x = np.vstack([problem.q, np.zeros((1, problem.q.shape[1]))])
    loads = torques(params.H_hat, params.prismatic, weights, x)
    weights /= np.linalg.norm(loads, axis=2).max()
    loads = (loads[:-1] - loads[-1]) / np.linalg.norm(loads, axis=2).max()
    turning = np.flatnonzero(~params.prismatic)
    at_pose = loads[problem.detections.pose_of][:, None, turning]
    G = problem.joint_derivative(params)[..., turning, None] * at_pose
    columns = np.where(used[..., None, None, None], G, 0.0).reshape(2 * used.size, -1)
    rows = np.hstack([columns, few.raw.reshape(-1, 1)])
    U = problem.dense(problem.derivative(params), used) @ few.errors().dense()
    R = np.asarray(np.linalg.qr(rows - U @ (U.T @ rows), mode="r"))
    Z, r = R[:, :-1].reshape(len(R), -1, 3), -R[:, -1]
    best = np.inf, np.eye(3)[2]
    for g in np.eye(3):
        for _ in range(_ROUNDS):
            s = _ridge(Z @ g, r, few.sigma_px / _USUAL_SAG)
            g = _ridge(np.einsum("lis,i->ls", Z, s), r, 0.0)
            g = g / max(float(np.linalg.norm(g)), 1e-300)
        left = float(np.square(r - Z @ g @ s).sum())
        best = min(best, (left, g), key=lambda one: one[0])
    arm = np.zeros((len(weights), 5, 4))
    arm[:-1, :4], arm[:, 4], arm[-1, 0, :3] = params.H_hat, weights, best[1]
    return arm


def _ridge(Z: FloatArray, r: FloatArray, weight: float) -> FloatArray:
    """Least-squares amplitudes (d,) of columns (L, d), shrunk by a weight."""
    A = Z.T @ Z
    return np.asarray(np.linalg.solve(A + (weight**2 + 1e-9 * np.trace(A)) * np.eye(len(A)), Z.T @ r))
