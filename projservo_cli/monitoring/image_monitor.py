"""Monitor of a run: tests each observation, holds the arm while they disagree, and names the fault."""

from collections import deque
from typing import NamedTuple

import numpy as np

from projservo_cli.calibration.detections import even_choice
from projservo_cli.calibration.prediction import CAMERA
from projservo_cli.deviations import MARKERS
from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.monitoring.arrival_accuracy import Posture
from projservo_cli.monitoring.fault_findings import finding_of, group_of, is_slight, misplaced_tags
from projservo_cli.monitoring.frame_pairs import FramePair, Pairing, TimedImage, mean_image
from projservo_cli.monitoring.hypotheses import (
    Evidence,
    Explanation,
    causes_of,
    contains,
    is_possible,
    together,
)
from projservo_cli.monitoring.innovation_tests import (
    LEAST_ERROR,
    WINDOW,
    Detector,
    ErrorModel,
    MemoryState,
    Residual,
    Sums,
    is_same_view,
)
from projservo_cli.records import BoolArray, Calibration, FloatArray, IntArray, Observation

# Markers that are tested, at most.
_MOST_TESTED = 40
# A corner with this many times the deviation of most is not tested: its error is the finder's, and lasts.
_VAGUE = 10.0
# Causes are fitted after these numbers of observations that disagree, since blur passes. From the fourth on
# two are named that are as likely; after the last the fault has no name: a hand passes in two seconds.
NAMED_AT = (5, 7, 10, 15, 25, 40, 60)
_TWO_AT = 15
# Advantage over the next cause, twice the logarithm of odds, at which one is named alone.
_CLEAR = 2.0 * np.log(100.0)
# Share of the image errors that a cause may leave.
_LEFT = 0.15
# Minimum share of the image errors, px, by which a cause changes images: backlash that is
# more than the calibration found is no turn of a camera by the rest.
_LEAST_PART = 0.2
# A corner that errs by less, px, from one side of the tool may be an edge that the finder took for another;
# one that a single camera watches may also be pulled by an object that covers its edge, by a few pixels.
LEAST_MOVED_PX, _LEAST_MOVED_ALONE_PX = 1.0, 8.0
# Share of the markers that a view saw shortly before: one that sees less is covered by something.
_COVERED = 0.5
# Share of the detections of a view that may not err singly for long: then the view does.
_MOST_FOR_LONG = 0.25
# Share of a slip that the set-point of a joint went without its reading: then the reading is frozen.
_UNANSWERED = 0.5
# Observations in which a hand comes or goes.
_COMES = 10
# Views whose agreement is evidence if one is covered. With fewer views, one covered view counts as all
# covered.
_SUFFICE = 2
# Number of causes that are named together, by several views and by one, which separates fewer.
_MOST_NAMED, _MOST_NAMED_BY_ONE = 2, 3
# Observations that are remembered one by one.
_REMEMBERED = 80
# Joints that differ by no more since the first observation have not moved, rad or m.
_AT_REST = 1e-3


class _Kept(NamedTuple):
    """An observation as it was tested."""

    pair: FramePair
    residual: Residual
    aside: BoolArray  # (V, m) inconsistent detections
    stated: FloatArray | None  # (V, m) deviations of the pixels, px, as the finder states them
    view: int  # number of the view that it is of
    views: int  # views that agreed up to it
    covered: bool  # whether something passes before the views


class _Recent(NamedTuple):
    """One of the last observations, as a hand that comes or goes shows in it."""

    whole: BoolArray  # (V,) whether a view shows all markers that it did, and none is off by itself
    hidden: BoolArray  # (V,) whether it shows less than half of them
    covered: BoolArray  # (V,) whether something passes before it
    state: MemoryState  # observations that agreed before it


def _columns_of_marker(errors: ErrorModel, marker: int) -> IntArray:
    """Columns of the displacement of a marker among the directions of faults."""
    first = errors.fixed + len(errors.calibration.P) * (CAMERA - 1)
    return np.asarray(first + 3 * marker + np.arange(3))


class ImageMonitor:
    """Monitor of the images of a run against a calibration.

    Detection and isolation are two things. The monitor tests each observation: whether it disagrees needs no
    cause. While observations disagree they are ``pending``; after ``WINDOW`` of them the arm ``holds``;
    ``WINDOW`` in a row that agree clear them. Meanwhile the monitor fits causes by the images that they
    predict, and names one that explains them clearly better than others. Where observations since the onset
    agree by themselves and no cause explains them better than none, what disagreed has passed. After sixty
    observations the fault has no name.

    Sources: R. Isermann, "Fault-Diagnosis Systems", Springer 2006, chapters 2 and 16; D. J. C. MacKay,
    "Bayesian interpolation", Neural Computation 4 (1992) 415–447, for the odds of causes.

    calibration : what predicts the pixels, with its covariance.
    sigma_px : pixel noise per coordinate.
    max_observations : length of the longest sequence, which sets the thresholds.
    shown : indices of the markers that images may show, None all; of many, some stand for all.
    image_size : (V, 2) px, of each image; None or infinite if it is not known.
    ``fault``: the fault in words; empty without one, or while its cause is not clear.
    ``observations``: number of those that showed a marker and were tested. ``agreeing``: number of those of
    one view in a row that agree. ``rejected``: (V, m) detections of the last observation that are off by
    themselves, of all markers of the calibration. ``unanswered``: (n,) path of each set-point since the
    reading of its joint last changed, rad or m; the client of the robot sets it.
    """

    def __init__(
        self,
        calibration: Calibration,
        sigma_px: float,
        max_observations: int,
        visible: IntArray | None = None,
        image_size: FloatArray | None = None,
    ) -> None:
        views, self._all = len(calibration.P), len(calibration.M)
        # Views (V, V) that are covered together.
        self._together = np.eye(views, dtype=np.bool_) | (views <= _SUFFICE)
        visible = np.arange(self._all) if visible is None else visible
        self._shown = visible[even_choice(len(visible), _MOST_TESTED)]
        self.calibration = calibration.with_markers(self._shown)
        has_size = image_size is not None and bool(np.isfinite(image_size).all())
        self.image_size, self.sigma_px = image_size if has_size else None, sigma_px
        self._centre = 0.5 * (np.asarray(image_size) - 1.0) if has_size else None
        self._errors = ErrorModel(self.calibration, sigma_px)
        self._detector = Detector(self._errors, max_observations)
        self._pairing = Pairing(views)
        self._first: FloatArray | None = None  # (n,) joints of the first observation, rad or m
        self._kept: list[_Kept] = []
        self._recent: deque[_Recent] = deque(maxlen=_COMES)
        self.observations = self._view = 0
        self._at_view: FloatArray | None = None  # (V, m, 2) px predicted where the view began
        # Observations that disagree, the number of the first of them, and observations in a row that agree.
        self._off = self._onset = self._agreed = 0
        self._sound = 0  # observations in a row that agree by themselves
        self._before = self._detector.memory.total  # sums up to the onset
        self._unit = 1.0  # of χ², by the remainder of the best cause
        self._asides = np.zeros((views, len(self._shown)), dtype=np.int64)  # observations in a row
        self._crowded = 0  # observations in a row of which many detections are off by themselves
        self._forgiven: list[int] = []
        self._stated: FloatArray | None = None  # with the last frames
        self.fault: Finding | None = None
        self.agreeing = 0
        self.unanswered = np.zeros(len(calibration.q_reference))
        self.rejected = np.zeros((views, self._all), dtype=np.bool_)

    @property
    def pending(self) -> bool:
        """Whether observations disagreed that are neither cleared nor explained."""
        return self._off > 0

    @property
    def holds(self) -> bool:
        """Whether enough observations disagreed to keep the arm still."""
        return self._off >= WINDOW

    def observe(
        self,
        t: FloatArray,
        q: FloatArray,
        q_dot: FloatArray,
        sigma_t: FloatArray,
        images: FloatArray,
        fresh: BoolArray,
        *,
        stated: FloatArray | None = None,
    ) -> Finding | None:
        """Take in the newest frames of all views, and return the fault, if there is one.

        t : (V,) instants of the frames, s.
        q : (V, n) joint readings then, rad or m; q_dot : (V, n) their velocities, rad/s or m/s.
        sigma_t : (V,) standard deviation of these instants, of the delay and its jitter together, s.
        images : (V, m, 2) raw pixels of the markers of the calibration, NaN where unseen.
        fresh : (V,) whether the frame of a view is new; one that comes twice is no second measurement.
        stated : (V, m) standard deviations of the pixels, px, if the finder states them.
        """
        images, stated = images[:, self._shown], None if stated is None else stated[:, self._shown]
        detected, self._stated = np.isfinite(images[..., 0]), stated
        noise = self._errors.noise(detected, stated)
        if stated is not None and detected.any():
            images = np.where((noise > _VAGUE * np.median(noise[detected]))[..., None], np.nan, images)
        self._first = q[0].copy() if self._first is None else self._first
        at_rest = bool(np.abs(q - self._first).max() <= _AT_REST)
        for v in np.flatnonzero(fresh):
            uncertain = max(float(sigma_t[v]), LEAST_ERROR)
            self._pairing.add(
                int(v),
                TimedImage(
                    t=float(t[v]), q=q[v], q_dot=q_dot[v], sigma_t=uncertain, image=images[v], noise=noise[v]
                ),
            )
        self._pairing.reach(t)
        while not self.fault and (pair := self._pairing.next(at_rest)) is not None:
            self._take(pair)
        return self.fault

    def mean_at_rest(self) -> Observation | None:
        """Return the mean of the last observations of one posture, as one; None if there is none.

        It has the deviations of its frames, if the finder states them: errors of a finder that stay do not
        average away.
        """
        # A hand that covers a part of a view may pull the corners next to it.
        last = [tested for tested in self._kept if tested.view == self._view and not tested.covered]
        last = [tested for tested in last if np.abs(tested.pair.q - last[-1].pair.q).max() <= _AT_REST]
        if not last:
            return None
        seen = [np.where(tested.residual.seen[..., None], tested.pair.images, np.nan) for tested in last]
        sigma = [tested.stated[..., None] for tested in last if tested.stated is not None]
        q, images = np.mean([tested.pair.q for tested in last], axis=(0, 1)), mean_image(np.array(seen))
        stated = self._errors.raised(mean_image(np.array(sigma))[..., 0]) if sigma else None
        return Observation.of_one(self.calibration.marker, q, images, self.calibration.view, stated)

    def undetected_mm(self, q: FloatArray, used: BoolArray, posture: Posture) -> float:
        """Return the largest position error of the face at joints (n,) that the tests could miss, mm.

        used : (V, m) markers of the calibration by which a law measures it, all of them; posture : at q.
        """
        if not self._kept:
            return 0.0
        used = used[:, self._shown]
        pair = FramePair.at_rest(q, np.where(used[..., None], np.zeros(2), np.nan), np.ones(used.shape))
        carry = posture.carry(self.calibration.M, used)
        return self._detector.undetected(carry, self._errors.residual(pair), self._kept[-1].pair.sigma_t)

    def give_up(self) -> Finding | None:
        """Return the fault that is pending, by the observations until now."""
        if self.pending and not self.fault:
            self.fault = self._finding(self._explanations(self._since_onset(), self._before))
        return self.fault

    def _take(self, pair: FramePair) -> None:
        """Test an observation, and judge all of them."""
        memory = self._detector.memory
        pair = pair._replace(noise=memory.noise(pair.noise))
        residual = self._errors.residual(pair)
        if not residual.seen.any():
            return
        self.observations += 1
        lasts = self._at_view is not None and is_same_view(self._at_view, residual.predicted)
        if not lasts:
            self._view, self._at_view = self._view + 1, residual.predicted
        tested = self._detector.tested(residual)
        hidden = self._covered(residual, tested.aside)
        covered = bool(hidden.any() and (residual.seen.any(axis=1) & ~hidden).sum() < _SUFFICE)
        if hidden.any() and not covered:  # the rest of a covered view is no evidence: the others are
            residual = residual.without(residual.seen & hidden[:, None])
            tested = self._detector.tested(residual)
        self._asides = np.where(tested.aside, self._asides + 1, self._asides * ~residual.seen)
        self.rejected[:, self._shown] = tested.aside
        self.rejected[:, self._shown[self._forgiven]] = True
        since, clean = None, residual.without(tested.aside)
        memory.learn(residual, tested.aside, tested.disagrees)
        kept, self._sound = self._kept[-_REMEMBERED:], (self._sound + 1) * (not tested.disagrees)
        # The rest of covered views is no evidence, nor are observations between those that disagree.
        if self._sound > WINDOW * self.holds and not covered:
            memory.keep(clean, float(pair.t.mean()), not tested.aside.any())
        self._kept = [
            *kept,
            _Kept(
                pair=pair,
                residual=residual,
                aside=tested.aside,
                stated=self._stated,
                view=self._view,
                views=memory.state.views,
                covered=covered,
            ),
        ]
        crowd = tested.aside.sum(axis=1) >= _MOST_FOR_LONG * residual.seen.sum(axis=1)
        crowd &= residual.seen.any(axis=1)
        self._crowded = (self._crowded + 1) * bool(crowd.any() and not covered)
        disagrees = tested.disagrees or self._crowd_is_fault()
        if not disagrees:
            free = [_columns_of_marker(self._errors, j) for j in self._forgiven]
            since = self._detector.significant(self.observations, pair.sigma_t, free, self.pending)
        if not disagrees and since is None:
            self.agreeing = 1 + self.agreeing * lasts
            self._agreed += 1
            self._clear()
        else:
            self._disagree(since)
        if not self.fault:
            self._judge_markers()

    def _disagree(self, since: Sums | None) -> None:
        """Count an observation that disagrees, and name the fault if that can be done."""
        if since is not None:  # the likeliest onset, as far as observations are remembered
            after = [tested for tested in self._kept if tested.views > since.views]
            self._onset, self._before = self.observations - max(1, len(after)), since
        elif not self._off:
            self._onset, self._before = self.observations - 1, self._detector.memory.total
        self._off += 1
        self.agreeing = self._agreed = 0
        if self._off not in NAMED_AT:
            return
        kept = self._since_onset()
        if self._has_passed(kept[len(kept) // 2 :]):
            self._detector.accept()
            self._off = 0
            return
        fits = self._explanations(kept, self._before)
        best = fits[0]
        explains, unforgiven = self._explains(best), not set(best.cause.markers) <= set(self._forgiven)
        if explains and unforgiven and self._is_edge(best, self._since_onset()):
            self._forgiven += best.cause.markers
            self._off = 0
            return
        clear = self._off >= _TWO_AT or len(_rivals(fits)) == 1
        if (explains and clear and not self._kept[-1].covered) or self._off == NAMED_AT[-1]:
            self.fault = self._finding(fits)

    def _crowd_is_fault(self) -> bool:
        """Whether many detections are aside for long, and these observations together are beyond chance."""
        if self._crowded < _TWO_AT or self.pending:
            return self._crowded >= _TWO_AT
        evidence = self._evidence(self._kept[-_TWO_AT:], self._detector.memory.total)
        if evidence.before > self._by_chance(evidence):
            return True
        self._crowded = 0
        return False

    def _covered(self, residual: Residual, aside: BoolArray) -> BoolArray:
        """Views (V,) that a hand or so covers: they show less than half of their markers, or did just now.

        A hand pulls the corners next to it before it hides them, by less than one observation shows. Those in
        which it came are forgotten, and those in which it goes are not kept.
        """
        count, memory = residual.seen.sum(axis=1), self._detector.memory
        peak = np.max(
            [count, *(past.residual.seen.sum(axis=1) for past in self._kept[-_REMEMBERED:])], axis=0
        )
        hidden = (self._together & (count < _COVERED * peak)).any(axis=1)
        whole = (~self._together | ((count >= peak) & ~aside.any(axis=1))).all(axis=1)
        was = self._recent[-1].covered if self._recent else np.zeros_like(hidden)
        goes = was & ~whole & np.any([past.hidden for past in self._recent], axis=0)
        if (comes := hidden & ~was).any():
            for past in reversed(self._recent):
                if past.whole[comes].all():
                    break
                memory.return_to(past.state)
        covered: BoolArray = hidden | goes
        self._recent.append(_Recent(whole=whole, hidden=hidden, covered=covered, state=memory.state))
        return covered

    def _clear(self) -> None:
        """Clear pending observations where new ones agree; name a fault that shows in motion alone."""
        if not self.pending or self._agreed < WINDOW:
            return
        if self.holds:
            kept = self._since_onset()
            if any(pair.q_dot.any() for pair, *_ in kept):
                best = self._explanations(kept, self._before)[0]
                likely = best.score > _CLEAR and self._explains(best)
                if likely and best.cause.kind in ("late", "frozen"):
                    self.fault = self._finding([best])
        self._off = 0

    def _since_onset(self) -> list[_Kept]:
        """Observations since the onset of the pending fault, but for the first, which may show half of it.

        Frames of the views that come one after the other may make that two.
        """
        kept = self._kept[-max(1, self.observations - self._onset) :]
        return kept[1 + (self._off > NAMED_AT[0]) :] if len(kept) >= NAMED_AT[0] else kept

    def _explanations(
        self, kept: list[_Kept], before: Sums, markers: list[int] | None = None
    ) -> list[Explanation]:
        """Causes fitted to observations, the likeliest first; displacements of markers alone, if given.

        before : sums of the observations before them.
        """
        evidence = self._evidence_now = self._evidence(kept, before)
        causes = causes_of(evidence, self.calibration.marker, self._centre)
        if markers is not None:
            causes = (cause for cause in causes if cause.kind == "marker" and cause.which in markers)
        fits = [self._frozen(fit) for fit in evidence.explanations(causes) if is_possible(fit)]
        if not fits:  # markers that the chosen observations do not show
            return fits
        # Where even the best leaves more than chance does, its residual is the unit.
        minimum = min(fits, key=lambda fit: fit.left)
        self._unit = max(1.0, minimum.left / max(1.0, evidence.rows - minimum.theta.size))
        fits = [fit._replace(gain=fit.gain / self._unit, left=fit.left / self._unit) for fit in fits]
        # For causes without a parameter the unit is not known: corners err otherwise from the other side.
        discrete = [not fit.theta.size and self._explains(fit) for fit in fits]
        fits = [
            self._by_any_unit(fit, minimum) if alone else fit
            for fit, alone in zip(fits, discrete, strict=True)
        ]
        fits.sort(key=lambda fit: -fit.score)
        if fits[0].cause.kind != "marker":
            return fits
        moved = [fit for fit in fits if fit.cause.kind == "marker" and fit.score > _CLEAR] or fits[:1]
        return [together(moved), *(fit for fit in fits if fit.cause.kind != "marker")]

    def _by_any_unit(self, fit: Explanation, minimum: Explanation) -> Explanation:
        """Return a cause with its odds against the best fit, if both have their own unit.

        Source: [MacKay 1992], with the unit integrated out.
        """
        min_left = max(minimum.left / self._unit, 1e-9)  # rounding remains for exact images
        more = self._evidence_now.rows * np.log(max(fit.left / min_left, 1.0))
        return fit._replace(gain=max(fit.gain, float(minimum.gain / self._unit - more)))

    def _frozen(self, fit: Explanation) -> Explanation:
        """Turn a slip by as far as the set-point went without the reading into a frozen reading."""
        cause = fit.cause
        if cause.kind == "slipped":
            slip = float(fit.theta[0])
            if self.unanswered[cause.which] * slip > _UNANSWERED * slip**2:
                return fit._replace(cause=cause._replace(kind="frozen"))
        return fit

    def _evidence(self, kept: list[_Kept], before: Sums) -> Evidence:
        """Observations to be explained, all of one view with their common weight."""
        memory = self._detector.memory
        views = np.array([tested.view for tested in kept])
        count = np.array([(views == view).sum() for view in views], dtype=np.float64)
        weights = np.array([memory.worth(c) / c for c in count])
        pairs, residuals = [tested.pair for tested in kept], [tested.residual for tested in kept]
        return Evidence(self._errors, pairs, residuals, weights, before)

    def _explains(self, fit: Explanation) -> bool:
        """Whether a cause explains most of the residual, with joints in error, and changes images enough."""
        left, allowed = self._unit * fit.left, self._by_chance(self._evidence_now)
        minimum = 0.0 if fit.cause.markers else _LEAST_PART * self._evidence_now.off_px
        explains = fit.score > 0.0 and left <= allowed + _LEFT * self._unit * fit.gain
        return bool(explains and fit.changed_px >= minimum)

    def _has_passed(self, kept: list[_Kept]) -> bool:
        """Whether the last observations agree, alone and together, and no cause explains them better.

        Then windows show the past, blur or a hand: a fault stays.
        """
        if self._sound < WINDOW:
            return False
        kept = [tested._replace(residual=tested.residual.without(tested.aside)) for tested in kept]
        fits = self._explanations(kept, self._before)
        gained = max(self._unit * fit.gain - fit.cost for fit in fits)
        return gained <= 0.0 and self._evidence_now.before <= self._by_chance(self._evidence_now)

    def _by_chance(self, evidence: Evidence) -> float:
        """χ² of evidence that chance, lasting errors of corners and errors of the model may leave."""
        rows, lasting = evidence.rows, 1.0 - self._detector.memory.fresh
        return float((1.0 + lasting) * rows + 3.0 * np.sqrt(2.0 * rows) + evidence.bias)

    def _is_edge(self, fit: Explanation, kept: list[_Kept]) -> bool:
        """Whether a seeming motion may be an edge that a finder took for the edge of a marker.

        An edge errs alike as long as the tag is seen from one side.
        kept : observations that showed it.
        """
        if not fit.cause.markers:
            return False
        detected = self._evidence_now.seen[:, :, list(fit.cause.markers)]
        one = detected.shape[1] == 1
        alone = not one and (detected.sum(axis=1) > 1).sum() <= 0.5 * detected.any(axis=1).sum()
        if alone or fit.min_px >= (_LEAST_MOVED_ALONE_PX if one else LEAST_MOVED_PX):
            return bool(alone)
        return self._errors.slants(np.array([tested.pair.q.mean(axis=0) for tested in kept])) < WINDOW

    def _judge_markers(self) -> None:
        """Name markers that two views show as inconsistent for long."""
        in_both, in_either = np.sort([np.zeros_like(self._asides[0]), *self._asides], axis=0)[-2:]
        # A cover of an edge shows in one view, and passes; one camera is believed after a hand has passed.
        long = in_either >= (NAMED_AT[-1] if len(self._asides) == 1 else np.inf)
        due = (in_both == NAMED_AT[0]) | (in_either == _TWO_AT) | (long & (in_either == NAMED_AT[-1]))
        if self.pending or not due.any():
            return
        before, moved = self._detector.memory.total, []
        for j in np.flatnonzero(in_either).tolist():
            kept = [
                tested._replace(residual=tested.residual.without(_all_but(tested.residual.seen, j)))
                for tested in self._kept[-max(NAMED_AT[0], int(in_either[j])) :]
            ]
            fits = self._explanations(kept, before, [j])
            if not fits:
                continue
            best, views = fits[0], len({tested.view for tested in kept})
            lasts = (in_both[j] or views >= WINDOW or long[j]) and not self._is_edge(best, kept)
            if lasts and best.score > _CLEAR and self._explains(best):
                moved.append(best)
        if moved:
            self.fault = self._finding([together(moved)])

    def _finding(self, fits: list[Explanation]) -> Finding:
        """Return the fault with the likeliest of causes."""
        pair, residual = self._kept[-1][:2]
        explained, numbers = self._explains(fits[0]), self.calibration.marker
        # A motion of all images may show a tag where another one was.
        by_itself = not explained or fits[0].cause.row.part == MARKERS
        if by_itself and (misplaced := misplaced_tags(pair.images, residual.predicted, numbers)):
            return Finding("misplaced_tags", REFUSES, others=misplaced)
        square = np.square(residual.r).reshape(len(residual.seen), -1).sum(axis=1)
        # for the view with the largest errors
        rms = np.sqrt(square / np.maximum(residual.seen.sum(axis=1), 1)).max()
        if not explained:
            off, where = float(rms), self._where(residual)
            return Finding("unexplained_images", REFUSES, where, off, unit="px")
        # A mirrored reading near zero is a small slip: with backlash, images do not separate them.
        maximum = self._by_chance(self._evidence_now) / self._unit
        simpler = (fit for fit in fits if not fit.theta.size and contains(fits[0].cause, fit.cause))
        said = [fits[0], *(fit for fit in simpler if fit.left <= maximum), *_rivals(fits)[1:]]
        if len({tested.view for tested in self._since_onset()}) == 1:
            said += _as_rigid(fits)
        max_named = _MOST_NAMED_BY_ONE if len(residual.seen) == 1 else _MOST_NAMED
        causes = tuple(finding_of(fit, self.calibration) for fit in said[:max_named])
        return Finding("images_off", REFUSES, amount=float(rms), unit="px", others=causes)

    def _where(self, residual: Residual) -> Subject:
        """Return the place of the largest residuals: a view, and a marker."""
        square = np.square(residual.r.reshape(*residual.seen.shape, 2)).sum(axis=-1)
        view, j = np.unravel_index(int(np.argmax(square)), square.shape)
        return Subject(views=(self.calibration.view[view],), markers=(int(self.calibration.marker[j]),))


def _rivals(fits: list[Explanation]) -> list[Explanation]:
    """The likeliest cause and causes of other names that are nearly as likely."""
    rivals: list[Explanation] = []
    for fit in fits:
        near = fits[0].score - fit.score < _CLEAR and not contains(fit.cause, fits[0].cause)
        if near and group_of(fit) not in [group_of(other) for other in rivals]:
            rivals.append(fit)
    return rivals


def _as_rigid(fits: list[Explanation]) -> list[Explanation]:
    """Links that flex by a little, where a rigid motion of all cameras is the likeliest cause.

    In one posture deflections of six joints are any rigid motion: their parameters cost more, and show less
    in one posture than in several.
    """
    if group_of(fits[0])[0] != "rig":
        return []
    flexible = [fit for fit in fits if fit.cause.kind == "flexible" and is_slight(fit.theta)]
    return [fit for fit in flexible if fit.gain >= fits[0].gain]


def _all_but(detections: BoolArray, marker: int) -> BoolArray:
    """Detections (V, m) of all markers but one."""
    aside = np.ones_like(detections)
    aside[:, marker] = False
    return aside
