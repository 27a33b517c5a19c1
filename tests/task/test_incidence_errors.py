"""Errors of incidences in mm and degrees: closed forms, invariance, and deviations against refits."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.displacements import generators
from projservo_cli.metric.frame import changes_of
from projservo_cli.monitoring.arrival_accuracy import metres_by
from projservo_cli.records import ANGLE, MEET, PARALLEL, PERPENDICULAR
from projservo_cli.task.incidence_errors import (
    Separation,
    TaughtAndNow,
    angle_off,
    incidence_errors,
    metric_rig,
    placed_by,
)
from projservo_cli.task.incidences import Incidence
from projservo_cli.task.objects.object_bundle_adjustment import BundleFit, ObjectView
from tests.configured import calibrate, truth_of
from tests.known import configured

POINT, LINE, PLANE = ((4,),), ((4,), (5,)), ((4,), (5,), (6,))
ASKED = [
    Incidence("tip", POINT, POINT),
    Incidence("pin", LINE, LINE),
    Incidence("wall", PLANE, PLANE, PARALLEL),
    Incidence("edge", LINE, PLANE),
    Incidence("slant", LINE, PLANE, ANGLE, 30.0),
    Incidence("across", LINE, LINE, PERPENDICULAR),
    Incidence("normal", LINE, PLANE, PERPENDICULAR),
]


def spanned(k, X):
    """An incidence of which features are spanned by so many of the first points."""
    return tuple((i,) for i in range(k)), X[..., :k, :]


@pytest.mark.parametrize("seed", range(5))
def test_distances_and_angles_are_closed_forms(seed):
    X, Y = np.random.default_rng(seed).normal(size=(2, 3, 3))
    x, y = X[1] - X[0], Y[1] - Y[0]
    normal = np.cross(*(Y[1:] - Y[0]))
    cosine = x @ y / np.linalg.norm(x) / np.linalg.norm(y)

    def off(tool, scene, relation=MEET, deg=np.nan):
        (flat, A), (there, B) = spanned(tool, X), spanned(scene, Y)
        one = Incidence("a on b", flat, there, relation, deg)
        at = Separation.of(one, A, B)
        return np.linalg.norm(at.apart, axis=1), angle_off(one, A, B) if at.turned.size else None

    assert off(1, 1)[0] == pytest.approx(np.linalg.norm(X[0] - Y[0]))
    assert off(1, 2)[0] == pytest.approx(np.linalg.norm(np.cross(X[0] - Y[0], y)) / np.linalg.norm(y))
    distance = abs((X[:2] - Y[0]) @ normal) / np.linalg.norm(normal)
    assert off(2, 3)[0] == pytest.approx(distance)
    assert off(2, 2)[1] == pytest.approx(np.arccos(cosine))
    assert off(2, 2, ANGLE, 40.0)[1] == pytest.approx(abs(np.arccos(cosine) - np.radians(40.0)))
    lift = np.arcsin(abs(x @ normal) / np.linalg.norm(x) / np.linalg.norm(normal))
    assert off(2, 3)[1] == pytest.approx(lift)
    assert off(2, 3, PERPENDICULAR)[1] == pytest.approx(0.5 * np.pi - lift)
    assert off(2, 2, PARALLEL)[0].size == 0


@pytest.fixture(scope="module")
def placed():
    """A tool that was displaced by some millimetres and degrees, and all that an error is computed of."""
    config = configured("ur5", "noise.calibration_px=0.5")
    calibration, truth = calibrate.run(config)[1], truth_of(config)
    q = config.task.start.values(config.joint_types)
    taught, now = (truth.images(at, truth.M) for at in (q, q + 0.02))
    H = truth.displacement(q), truth.displacement(q + 0.02)
    sigma = np.full(taught.shape[:2], 0.3)
    # Displacements of the truth are near those of the calibration once they are in its frame.
    markers = calibration.indices_of(truth.number)
    G = np.linalg.lstsq(truth.M, calibration.M[markers], rcond=None)[0].T
    H_taught, H_now = (G @ one @ np.linalg.inv(G) for one in H)
    ends = TaughtAndNow(ObjectView(taught, sigma), ObjectView(now, sigma), H_taught, H_now)
    return calibration, markers, ends, config.markers.lengths(config.face_numbers), truth, H


def test_errors_are_those_of_the_truth_within_their_deviation(placed):
    calibration, markers, ends, lengths, truth, (H_taught, H_now) = placed
    found = incidence_errors(calibration, markers, ASKED, ends, lengths)
    for k, one in enumerate(ASKED):
        A, B = (
            (np.array([truth.M[list(at)].mean(axis=0) for at in flat]) @ H.T)[:, :3]
            for flat, H in ((one.tool, H_now), (one.scene, H_taught))
        )
        at = Separation.of(one, A, B)
        if at.apart.size:
            mm = 1e3 * np.linalg.norm(at.apart, axis=1).max()
            assert abs(found.mm[k] - mm) < 4.0 * found.deviation_mm[k] < 40.0
        else:
            assert np.isnan(found.mm[k])
        if at.turned.size:
            assert abs(np.radians(found.deg[k]) - angle_off(one, A, B)) < 4.0 * np.radians(
                found.deviation_deg[k]
            )
        else:
            assert np.isnan(found.deg[k])
    nowhere = ends._replace(H=np.full((4, 4), np.nan))
    assert np.isnan(incidence_errors(calibration, markers, ASKED, nowhere, lengths)).all()
    unknown = incidence_errors(calibration, markers, ASKED, ends, np.full_like(lengths, np.nan))
    assert np.isnan(unknown.mm).all()
    assert unknown.deg == pytest.approx(found.deg, nan_ok=True)


def test_changes_are_those_of_poses_fitted_again_with_a_calibration_that_is_off(placed):
    """Of images without residuals, whose product with second derivatives first order leaves out."""
    calibration, markers, ends, lengths, *_ = placed
    rig = metric_rig(calibration)
    shown = [rig.pixels(rig.M[0, markers] @ (rig.G @ H @ np.linalg.inv(rig.G)).T)[0] for H in ends[2:4]]
    ends = ends._replace(taught=ends.taught._replace(s=shown[0]), now=ends.now._replace(s=shown[1]))
    unit = 1e3 * metres_by(rig.M[:, markers, :3], lengths)
    whole = placed_by(rig, markers, ends, unit)
    again = []
    for b in range(len(rig.M)):
        own = rig._replace(P=rig.P[b : b + 1], lens=rig.lens[b : b + 1])
        M = rig.M[b, markers]
        fits = [
            BundleFit.settled(own.bundle([look], whole.E), M, T[None])
            for look, T in ((ends.taught, whole.T[0]), (ends.now, whole.T[1]))
        ]
        again.append(np.concatenate([fit.T for fit in fits]))
    for one in ASKED:
        shared = changes_of(whole.vectors(one, whole.unit_mm, M=whole.M, T=np.array(again))).T
        c = shared.shape[1]
        assert whole.changes(one)[:, :c] == pytest.approx(shared, abs=1e-3 * np.abs(shared).max())


def test_points_of_an_object_change_as_those_fitted_again_do(placed):
    """By a calibration that is off, and by each pixel; then distances to them, in closed form."""
    calibration, markers, ends, lengths, *_ = placed
    rig, rng = metric_rig(calibration), np.random.default_rng(6)
    middle, size = rig.M[0, :, :3].mean(axis=0), np.ptp(rig.M[0, :, :3], axis=0).max()
    X = np.c_[middle + 0.5 * size * rng.normal(size=(5, 3)), np.ones(5)]
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(0.2 * rng.normal(size=3)).as_matrix()
    T[:3, 3] = middle - T[:3, :3] @ middle + 0.1 * size * rng.normal(size=3)
    looks = [ObjectView(rig.pixels(X @ at.T)[0], np.full((len(rig.P[0]), 5), 0.3)) for at in (np.eye(4), T)]
    E = generators(rig.linear, X[:, :3].mean(axis=0))

    def fitted(rig, s):
        given = [look._replace(s=shown) for look, shown in zip(looks, s, strict=True)]
        return BundleFit.settled(rig.bundle(given, E, 0), X, np.array([np.eye(4), T]))

    s = np.array([look.s for look in looks])
    found = fitted(rig, s).points_at(1, rig)
    each = [
        fitted(rig._replace(P=P[None], lens=lens[None]), s) for P, lens in zip(rig.P, rig.lens, strict=True)
    ]
    shared = np.moveaxis(changes_of(np.array([one.X @ one.T[1].T for one in each]))[..., :3], 0, -1)
    assert found.by_calibration == pytest.approx(shared, abs=1e-3 * np.abs(shared).max())
    for n in (0, 7, 22, 39):
        moved = s.ravel().copy()
        moved[n] += 3e-3
        there = fitted(rig, moved.reshape(s.shape))
        by = ((there.X @ there.T[1].T) - found.X)[:, :3] / 1e-2  # of a deviation of 0.3 px
        assert found.by_images[..., n] == pytest.approx(by, abs=2e-3 * np.abs(by).max())
    asked = [Incidence("tip", POINT, ((len(markers) + 1,), (len(markers) + 3,)))]
    (mm,), *_ = incidence_errors(calibration, markers, asked, ends._replace(of_object=found), lengths)
    unit = 1e3 * metres_by(rig.M[:, markers, :3], lengths)
    tip = placed_by(rig, markers, ends, unit).features(Incidence("tip", POINT, POINT))[0][0]
    a, b = found.X[[1, 3], :3]
    assert mm == pytest.approx(unit[0] * np.linalg.norm(np.cross(tip - a, b - a)) / np.linalg.norm(b - a))


def test_vectors_turn_with_the_frame_and_their_lengths_do_not():
    X, Y = np.random.default_rng(2).normal(size=(2, 4, 3, 3))
    R = Rotation.random(rng=3).as_matrix()
    for one in ASKED:
        (_, A), (_, B) = spanned(len(one.tool), X), spanned(len(one.scene), Y)
        here, there = Separation.of(one, A, B), Separation.of(one, A @ R.T, B @ R.T)
        for before, after in zip(here, there, strict=True):
            assert np.linalg.norm(after, axis=-1) == pytest.approx(np.linalg.norm(before, axis=-1))
        singly = Separation.of(one, A[1], B[1])
        assert here.apart[1] == pytest.approx(singly.apart)
        assert here.turned[1] == pytest.approx(singly.turned)
