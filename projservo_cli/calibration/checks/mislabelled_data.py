"""Relabellings of data: each reads a row as another one, and the model may fit with it.

A row says which discrete thing is as given and may not be: where the cameras are, the order of joints and of
images, the type of a joint, a joint that rests or turns with another, its unit, the size of images
from a pose on. All are tried in one way, before a deviation from the model absorbs them: a rough fit compares
them, and the best are fitted completely.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from itertools import combinations, islice, permutations
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.calibration.bundle_adjustment import LeastSquares, minimize
from projservo_cli.calibration.checks.image_contradictions import size_changes
from projservo_cli.calibration.checks.outliers import Outliers
from projservo_cli.calibration.checks.unusable_fit import unexplained
from projservo_cli.calibration.detections import Detections, even_choice, in_chain_order
from projservo_cli.calibration.initial.initialization import Search, bodies, starting_markers, starts
from projservo_cli.calibration.robust_fit import Solution, fit_from
from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.geometry.displacements import rigid_inverse
from projservo_cli.geometry.flange import FlangeChart
from projservo_cli.records import TOOL, WORLD, FloatArray, WorkFailed, letters_of

# Number of relabellings of a kind that are fitted completely, and minimum share of detections that fit them.
_FOLLOWED, _KEPT = 3, 0.8
# Images that come one pose late, or early, from a pose on; number of poses that are tried if none is known.
_SHIFTED, _ONSETS = ("images_late_from", "images_early_from"), 8
# Shares of the image before that a tracker keeps, of those tried, and maximum share.
_SHARES, _MOST_KEPT = (0.03, 0.07, 0.15), 0.5
# Number of adjustment steps of the screws by which they are compared before.
_SCREW_STEPS = 8
# Log residual added to a joint of the other type, which explains more: a joint at rest is simpler.
_SIMPLER = 0.1
# Readings, rad, that are degrees if they range over more, or may be if they range over less.
_TURN, _HARDLY = 2.0 * np.pi, 0.2


class Relabelling(NamedTuple):
    """One thing that is not as given, and the data as they then are."""

    finding: Finding
    detections: Detections
    q_reference: FloatArray  # (n,) rad or m
    noise_px: float = np.nan  # that a complete fit leaves
    unread: int | None = None  # row of the pose that is left without a reading of its own

    @property
    def problem(self) -> LeastSquares:
        """Problem of the data as they then are."""
        return LeastSquares.of(self.detections, self.q_reference)


class _Data(NamedTuple):
    """Data as given."""

    detections: Detections
    q_reference: FloatArray
    onset: int | None = None  # row of the pose from which on a fit rejects nearly all

    def with_(
        self, code: str, subject: Subject, unit: str = "", amount: float = np.nan, **changed: Any
    ) -> Relabelling:
        """Return the relabelling by a finding of a code, which changes fields of the detections."""
        q_0 = changed.pop("q_0", self.q_reference)
        finding = Finding(code, REFUSES, subject, amount, unit=unit)
        return Relabelling(finding, dataclasses.replace(self.detections, **changed), q_0)

    def shifted(self, code: str, at: int) -> Relabelling:
        """Return the relabelling by which images come one pose late, or early, from a row of a pose on."""
        q, subject = self.detections.q, Subject(poses=(int(self.detections.pose[at]),))
        later = q[at - 1 : -1] if code == _SHIFTED[0] else np.vstack([q[at + 1 :], q[-1:]])
        one = self.with_(code, subject, "1", len(later), q=np.vstack([q[:at], later]))
        return one if code == _SHIFTED[0] else one._replace(unread=len(q) - 1)

    def dated(self, one: Relabelling, found: Solution) -> Relabelling:
        """Return delayed or early images, from the pose on at which a fit shows it."""
        d, K, problem = self.detections, len(self.detections.q), found.problem
        levels = []
        for q in (d.q, self.shifted(one.finding.code, 1).detections.q):
            there = dataclasses.replace(problem, q=q - problem.q_reference)
            off = np.linalg.norm(there.residual(dataclasses.replace(found.params, offsets=None)), axis=2)
            square = np.log(np.square(off / found.sigma_px).sum(axis=0) + 1.0)
            levels.append(np.bincount(d.pose_of, square, K))
        left = np.cumsum(levels[0]) + np.cumsum(levels[1][::-1])[::-1]  # around each onset
        at = 1 + int(np.argmin(left[:-1] - levels[1][:-1]))
        return self.shifted(one.finding.code, min(at, K - 2))

    def remembered(self, share: float) -> Relabelling:
        """Return the images of a tracker without the share that it keeps of the image before."""
        d, images = self.detections, self.detections.dense()
        before = images[:, d.pose_of - 1, d.marker_of]
        known = np.isfinite(before[..., :1]) & (d.pose_of > 0)[:, None]
        pixels = np.where(known, (d.pixels - share * np.nan_to_num(before)) / (1.0 - share), d.pixels)
        return self.with_("tracker_memory", Subject(), "1", share, pixels=pixels)

    def sharper(self, one: Relabelling, found: Solution) -> Relabelling:
        """Return the images of a tracker without the share that a fit says it keeps."""
        share, used = one.finding.amount, found.used[..., None]
        predicted = found.problem.with_noise(None).pixels(dataclasses.replace(found.params, offsets=None))[0]
        # Without one half they change by as much as they differ from those before.
        apart = np.where(used, self.remembered(0.5).detections.pixels - self.detections.pixels, 0.0)
        off = np.where(used, predicted - one.detections.pixels, 0.0)
        step = (1.0 - share) ** 2 * float((off * apart).sum()) / max(float(np.square(apart).sum()), 1e-300)
        # Beyond, images show no other pose before, or another fault.
        return self.remembered(share + step) if 0.0 < share + step < _MOST_KEPT else one

    def of_joint(self, *joints: int, name: str = "") -> Subject:
        """Return joints, by their columns, as the subject of a finding."""
        return Subject(joints=tuple(int(self.detections.numbers[i]) for i in joints), name=name)


def _mounts(data: _Data) -> Iterator[Relabelling]:
    """Cameras on the tool that are given as fixed, or the other way round."""
    d = data.detections
    other, q = TOOL if d.mount == WORLD else WORLD, in_chain_order(TOOL, d.q)
    q_0 = in_chain_order(TOOL, data.q_reference)
    yield data.with_(
        "other_mount", Subject(name=other), q_0=q_0, mount=other, q=q, prismatic=d.prismatic[::-1]
    )


def _orders_of_images(data: _Data) -> Iterator[Relabelling]:
    """Images that come one pose late or early, against their readings."""
    q = data.detections.q
    for code, moved, unread in (
        ("images_before_readings", np.vstack([q[:1], q[:-1]]), 0),
        ("images_after_readings", np.vstack([q[1:], q[-1:]]), len(q) - 1),
    ):
        yield data.with_(code, Subject(), q=moved)._replace(unread=unread)


def _types(data: _Data) -> Iterator[Relabelling]:
    """A joint of the other type."""
    d = data.detections
    for i, slides in enumerate(d.prismatic):
        flipped = d.prismatic.copy()
        flipped[i] = not slides
        subject = data.of_joint(i, name=letters_of(flipped[d.numbers.argsort()]))
        yield data.with_("joint_type", subject, "rad" if slides else "m", prismatic=flipped)


def _stationary(data: _Data) -> Iterator[Relabelling]:
    """A joint at rest while its readings move."""
    d = data.detections
    for i in range(d.prismatic.size if d.prismatic.size > 1 else 0):
        fewer: dict[str, Any] = {"q": np.delete(d.q, i, axis=1), "prismatic": np.delete(d.prismatic, i)}
        yield data.with_("standing_joint", data.of_joint(i), q_0=np.delete(data.q_reference, i), **fewer)


def _exchanged(data: _Data) -> Iterator[Relabelling]:
    """Two joints of one type of which each has the readings of the other."""
    d = data.detections
    for i, j in combinations(range(d.prismatic.size), 2):
        if d.prismatic[i] == d.prismatic[j]:
            order = np.arange(d.prismatic.size)
            order[[i, j]] = j, i
            q_0 = data.q_reference[order]
            yield data.with_("exchanged_joints", data.of_joint(i, j), q=d.q[:, order], q_0=q_0)


def _couplings(data: _Data) -> Iterator[Relabelling]:
    """A joint that its neighbour turns as far as itself: a parallelogram, or a belt."""
    d = data.detections
    for read, moved in permutations(range(d.prismatic.size), 2):
        if abs(read - moved) > 1 or d.prismatic[[read, moved]].any():
            continue
        for share in (-1.0, 1.0):
            q, q_0 = d.q.copy(), data.q_reference.copy()
            q[:, moved] += share * q[:, read]
            q_0[moved] += share * q_0[read]
            yield data.with_("full_coupling", data.of_joint(read, moved), "1", share, q=q, q_0=q_0)


def _parallelograms(data: _Data) -> Iterator[Relabelling]:
    """A joint whose link keeps its direction as the one before turns, and a hand that stays level with it.

    The hand turns against the link, by a joint that has no reading.
    """
    d = data.detections
    for i in range(d.prismatic.size - 1):
        if d.prismatic[[i, i + 1]].any():
            continue
        for sense in (1.0, -1.0):

            def linked(q: FloatArray, i: int = i, sense: float = sense) -> FloatArray:
                """Readings (…, n + 1) with the joint without one, from those given."""
                link, before = sense * q[..., i + 1], q[..., i]
                q = np.insert(q, i + 2, -link, axis=-1)
                q[..., i + 1] = link - before
                return q

            prismatic = np.insert(d.prismatic, i + 2, values=False)
            changed = {"q": linked(d.q), "q_0": linked(data.q_reference), "prismatic": prismatic}
            yield data.with_("level_hand", data.of_joint(i, i + 1), "1", -1.0, **changed)


def _units(data: _Data) -> Iterator[Relabelling]:
    """A joint that is read in degrees where rad are given, or in rad where degrees are."""
    d = data.detections
    for i in np.flatnonzero(~d.prismatic).tolist():
        span = float(np.ptp(d.q[:, i]))
        if _HARDLY < span < _TURN:
            continue
        q, q_0, factor = (
            d.q.copy(),
            data.q_reference.copy(),
            np.radians(1.0) if span > _TURN else np.degrees(1.0),
        )
        q[:, i], q_0[i] = factor * q[:, i], factor * q_0[i]
        name = "degrees" if span > _TURN else "rad"
        yield data.with_("joint_unit", data.of_joint(i, name=name), q=q, q_0=q_0)


def _images_shifted_from(data: _Data) -> Iterator[Relabelling]:
    """Images that come one pose late or early against their readings, from a pose on."""
    K = len(data.detections.q)
    tried = even_choice(K, _ONSETS + 2)[1:-1].tolist() if data.onset is None else [data.onset]
    for at in tried if K > 2 else ():
        if 0 < at < K - 1:
            yield from (data.shifted(code, at) for code in _SHIFTED)


def _memories(data: _Data) -> Iterator[Relabelling]:
    """Images of which each keeps a share of the one before."""
    yield from map(data.remembered, _SHARES)


def _sizes(data: _Data) -> Iterator[Relabelling]:
    """Images of another size from the pose on at which their extent changes most."""
    d = data.detections
    for onset, factor in size_changes(d)[:1]:
        pixels, subject = d.resized(onset, 1.0 / factor).pixels, Subject(poses=(int(d.pose[onset]),))
        yield data.with_("image_size_changed", subject, "1", factor, pixels=pixels)


def _poses(data: _Data) -> Iterator[Relabelling]:
    """Poses of the base in the flange, rotations by columns, or quaternions with w first."""
    d = data.detections
    if d.chart is None:
        return
    T = d.chart.poses(in_chain_order(d.mount, d.q))
    R = Rotation.from_matrix(T[:, :3, :3])
    # A camera on the tool sees by poses what a fixed one sees by their inverses.
    subject = Subject(name=TOOL if d.mount == WORLD else WORLD)
    for code, other in (
        ("inverse_poses", rigid_inverse(T)),
        ("transposed_rotations", _with_rotations(T, R.inv())),
        ("scalar_first", _with_rotations(T, Rotation.from_quat(np.roll(R.as_quat(), -1, axis=1)))),
    ):
        there = FlangeChart.of(other)
        q = in_chain_order(d.mount, there.coordinates(other))
        yield data.with_(code, subject if code == "inverse_poses" else Subject(), q=q, chart=there)


def _with_rotations(T: FloatArray, R: Rotation) -> FloatArray:
    """Poses (K, 4, 4) with other rotations."""
    other = T.copy()
    other[:, :3, :3] = R.as_matrix()
    return other


# What makes a relabelling exact that was tried with one of many numbers, by a fit with it.
_NEARER = dict.fromkeys(_SHIFTED, (_Data.dated,)) | {"tracker_memory": (_Data.sharper,) * 3}
# All relabellings by which the same images may fit: the simple ones first, then those by which more would.
SIMPLE = (_mounts, _orders_of_images, _types, _stationary)
OTHERS = (_exchanged, _couplings, _parallelograms, _units, _sizes, _images_shifted_from, _memories)
# Those of poses of the flange, which are no joints.
OF_POSES = ((_orders_of_images, _poses), (_sizes, _images_shifted_from, _memories))


def relabelled(
    search: Search, max_px: float, straight: Sequence[int] | None = None, onset: int | None = None
) -> Relabelling | None:
    """Find the one thing that is not as given with which the model fits.

    A rough fit compares all of a kind. The best are fitted completely and accepted only if the fit passes as
    a calibration does, with a noise of at most ``max_px``.

    straight : joints that alone may be of the other type; onset : row of the pose from which on a fit rejects
        nearly all.
    """
    detections = search.problem.detections
    few = detections.of_markers(starting_markers(detections, search.epipolar, search.rng))
    data = _Data(few, search.problem.q_reference, onset)
    if straight is not None:
        types = list(_types(data))
        return _best(data, search, max_px, [types[i] for i in straight])
    for kinds in (SIMPLE, OTHERS) if detections.chart is None else OF_POSES:
        found = _best(data, search, max_px, [one for kind in kinds for one in kind(data)])
        if found is not None:
            return found
    return None


def _best(data: _Data, search: Search, max_px: float, tried: Sequence[Relabelling]) -> Relabelling | None:
    """Return the best of some relabellings by which the model fits, and the noise that it leaves, or None."""
    candidates = []
    try:
        known = [*islice(bodies(search, data.detections), 1)]
        for done, one in enumerate(tried):
            search.progress("calibration, other readings", done, len(tried))
            problem, seen = one.problem, one.detections.seen
            same = known if one.detections.pixels is data.detections.pixels else None
            there = dataclasses.replace(search, problem=problem)
            for start in islice(starts(there, one.detections, known=same), 1):
                params = minimize(
                    problem, start, seen, robust=True, cameras=start.known_arm, max_steps=_SCREW_STEPS
                ).params
                # Logarithms: neither a few gross errors nor many small ones outweigh the rest.
                level = np.mean(np.log(np.linalg.norm(problem.residual(params)[seen], axis=1) + 1e-9))
                simpler = _SIMPLER if one.finding.code == "joint_type" else 0.0
                candidates.append((float(level) + simpler, one, problem, params))
    except WorkFailed:
        return None
    candidates.sort(key=lambda candidate: candidate[0])
    for _, one, problem, params in candidates[:_FOLLOWED]:
        found = fit_from(problem, params, search.epipolar)
        for nearer in _NEARER.get(one.finding.code, ()):
            if found is not None:
                one = nearer(data, one, found)
                found = fit_from(one.problem, found.params, search.epipolar)
        if found is None or found.sigma_px > max_px or found.used.sum() < _KEPT * one.detections.seen.sum():
            continue
        out = Outliers.empty(one.detections)
        if one.unread is not None:
            out.explained[:, one.detections.pose_of == one.unread] = True
        if unexplained(found, out, search.epipolar) is None:
            return one._replace(noise_px=found.sigma_px)
    return None
