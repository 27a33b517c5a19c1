"""Incidences: what each kind leaves free, in any projective frame, and what pixels it takes."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from projservo_cli.control import command, make_law
from projservo_cli.control.law import OK, UNLIMITED, Gains, new_state
from projservo_cli.findings import LIMITS, REFUSES
from projservo_cli.geometry.algebra import as_array, mat
from projservo_cli.laws import CODES
from projservo_cli.records import (
    ANGLE,
    MEET,
    PARALLEL,
    PERPENDICULAR,
    InputError,
    WorkFailed,
    position_limits,
)
from projservo_cli.task.body_pose import SETTLED, fit_body, make_body
from projservo_cli.task.face import MIDPOINT, center_of, cyclic_order, face_plane
from projservo_cli.task.incidence_contradictions import contradicting_incidences
from projservo_cli.task.incidence_errors import angle_off
from projservo_cli.task.incidences import (
    Incidence,
    errors_px,
    image_error_at,
    image_velocities,
    incidences_of,
    linearized,
    nearest_goal,
    points_of,
    weighted,
    whole_pose,
)
from tests.samples import arm, displacement, face, frame, hat, in_frame, operators, pixels, poe, prismatic
from tests.task.cases import make_task

# Markers 4 to 7 are the corner of a box, and along its edges.
POINT, LINE, PLANE = ((4,),), ((4,), (5,)), ((4,), (5,), (6,))
ACROSS, WALL, SLANT = ((4,), (7,)), ((4,), (5,), (7,)), ((5,), (6,))
# Two features, their relation, and the freedoms that it takes, counted by hand.
KINDS = [
    (POINT, POINT, MEET, 3),
    (POINT, LINE, MEET, 2),
    (POINT, PLANE, MEET, 1),
    (LINE, POINT, MEET, 2),
    (LINE, LINE, MEET, 4),
    (LINE, PLANE, MEET, 2),
    (PLANE, POINT, MEET, 1),
    (PLANE, LINE, MEET, 2),
    (PLANE, PLANE, MEET, 3),
    (LINE, LINE, PARALLEL, 2),
    (LINE, PLANE, PARALLEL, 1),
    (PLANE, LINE, PARALLEL, 1),
    (PLANE, PLANE, PARALLEL, 2),
    (LINE, ACROSS, PERPENDICULAR, 1),
    (ACROSS, PLANE, PERPENDICULAR, 2),
    (PLANE, ACROSS, PERPENDICULAR, 2),
    (PLANE, WALL, PERPENDICULAR, 1),
    (LINE, ACROSS, ANGLE, 1),
    (SLANT, WALL, ANGLE, 1),
    (PLANE, WALL, ANGLE, 1),
]
ANGLE_DEG = 60.0  # 15° to 30° from that of the features
GAINS = Gains(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.9)  # every step is one of Newton


def random_arm(generator):
    """An arm like that of the samples, with axes and markers moved at random."""
    model = arm()
    moved = [
        np.linalg.multi_dot([g := expm(hat(*0.1 * generator.normal(size=(2, 3)))), H, np.linalg.inv(g)])
        for H in model.H_hat_0
    ]
    box = 0.08 * np.vstack([np.zeros(3), np.eye(3)]) + 0.003 * generator.normal(size=(4, 3))
    pins = np.c_[box, np.ones(4)] @ displacement(generator.normal(size=3), [0.03, 0.02, 1.4]).T
    return model._replace(H_hat_0=np.array(moved)), np.concatenate([face(), pins])


def scenes(body, H, asked):
    """Points that span features of the scene, by incidences that were taught at H (4, 4)."""
    return [points_of(body.M, one.scene) @ H.T for one in asked]


class Case:
    """A list of incidences on a body, in the frame G, taught at joints ``q_star``, or displaced (4, 4)."""

    def __init__(self, model, M, asked, q_star, G=None):
        G = np.eye(4) if G is None else G
        self.model, self.M = in_frame(model, G), M @ G.T
        self.body = make_body(self.model, self.M)
        self.H = poe(self.model, q_star) if q_star.ndim == 1 else q_star
        rows = incidences_of(self.model, self.body, scenes(self.body, self.H, asked), asked)
        shows = np.ones((2, len(M)), dtype=bool)
        a = face_of(self.body.M[:4])
        goal = nearest_goal(rows, self.body, self.H, image_velocities(self.model, shows))
        self.rows = weighted(rows, self.model, self.body, goal, shows, a)

    def law(self, q, gains=GAINS):
        """Law at joints q, and its state."""
        A = self.body.M[:4]
        task = make_task(self.model, A @ poe(self.model, q).T, A @ self.H.T)
        task = task._replace(body=self.body, incidences=self.rows)
        state = new_state(len(q), 4, len(self.M))
        return make_law(CODES["incidences"], self.model, task, gains), state

    def drive(self, q, gain=1.0, limits=UNLIMITED):
        """Joints (n,) where the law ends."""
        law, state = self.law(q, GAINS._replace(gain=gain, limits=limits))
        for _ in range(math.ceil(40 / gain)):
            q_dot = step(law, state, self, q)
            q = q + np.clip(q_dot, -0.3, 0.3)
            if np.abs(q_dot).max() < 1e-14:
                break
        return q


def face_of(A):
    """Plane of a face (4, 4)."""
    return np.array(face_plane(np.ascontiguousarray(A), cyclic_order(A), center_of(A, MIDPOINT)))


def step(law, state, case, q):
    """Joint velocity of the law at joints q."""
    s = pixels(case.model.P, case.body.M @ poe(case.model, q).T)
    assert command(law, s, q, state) == OK
    return state.q_dot.copy()


def asked_of(kind):
    tool, scene, relation, _ = kind
    return [Incidence("a on b", tool, scene, relation, ANGLE_DEG if relation == ANGLE else np.nan)]


def deviating(generator, n=6, size=0.2):
    return generator.uniform(-size, size, n)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_met_with_the_same_joints_in_any_frame_and_leaves_free_what_it_should(kind):
    for seed in range(3):
        generator = np.random.default_rng([seed, KINDS.index(kind)])
        model, M = random_arm(generator)
        q_star = model.q_reference + deviating(generator)
        q = q_star + deviating(generator)
        cases = [Case(model, M, asked_of(kind), q_star, G) for G in (None, frame(seed))]
        ends = np.array([case.drive(q) for case in cases])
        assert np.abs(ends - ends[0]).max() <= 1e-10, seed
        for case, end in zip(cases, ends, strict=True):
            rank = kind[3]
            assert len(case.rows.weight) == rank
            H = poe(case.model, end)
            assert np.allclose(errors_px(case.rows, H[None]), 0.0, atol=1e-7)
            law, state = case.law(end)
            step(law, state, case, end)
            _, J = linearized(case.rows, H, operators(case.model, end))
            assert np.linalg.matrix_rank(J, 1e-6) == rank


def test_the_rows_of_a_whole_pose_give_its_image_error_and_overlap_without_harm():
    """To first order the least motion of all images is that of the pose; nine rows are six."""
    for seed in range(5):
        generator = np.random.default_rng([7, seed])
        model, M = random_arm(generator)
        q_star = model.q_reference + deviating(generator)
        case = Case(model, M, whole_pose(make_body(model, M).M[:4]), q_star, frame(seed))
        assert case.rows.weight.shape == (6, 9)
        H = poe(case.model, q_star + 1e-6 * deviating(generator))
        off = pixels(case.model.P, case.body.M @ H.T) - pixels(case.model.P, case.body.M @ case.H.T)
        rms = np.sqrt(np.sum(off**2) / (2 * len(M)))
        assert image_error_at(case.rows, H) == pytest.approx(rms, rel=1e-4)


def test_errors_are_as_large_as_the_noise_of_pixels_that_makes_them():
    """Over fits of a body to noisy images at the goal, each incidence has the rms that it is told in."""
    generator = np.random.default_rng(3)
    model, M = random_arm(generator)
    asked = [Incidence("pin on hole", LINE, LINE), Incidence("wall", WALL, WALL, PARALLEL)]
    case = Case(model, M, asked, model.q_reference + 0.1)
    shown, sigma, normal = pixels(case.model.P, case.body.M @ case.H.T), 0.05, np.zeros((6, 7))
    squares = []
    for _ in range(400):
        s = shown + sigma * generator.standard_normal(shown.shape)
        fit = fit_body(case.model.P, case.body, s, mat(case.H), SETTLED, normal)
        squares.append(errors_px(case.rows, as_array(fit.H)[None])[0] ** 2)
    # 400 draws of 4 and 2 freedoms: the deviation of an rms is 1.8 and 2.5 %.
    assert np.sqrt(np.mean(squares, axis=0)) == pytest.approx(sigma, rel=0.1)


@pytest.mark.parametrize(("flat", "axis"), [(LINE, ACROSS), (PLANE, LINE)])
def test_what_points_the_other_way_is_not_met(flat, axis):
    """A line or a plane turned by half a turn onto itself has no error of its rows, but one as told."""
    model, M = random_arm(np.random.default_rng(5))
    case = Case(model, M, [Incidence("a on b", flat, flat)], model.q_reference)
    at, way = M[4, :3], M[axis[1][0], :3] - M[4, :3]
    if flat == LINE:  # about an axis across it
        along = M[5, :3] - at
        way = way - along * (way @ along) / (along @ along)
    half = expm(np.pi * hat(way / np.linalg.norm(way), np.cross(at, way / np.linalg.norm(way))))
    assert np.abs(linearized(case.rows, half, np.zeros((0, 4, 4)))[0]).max() < 1e-6
    assert image_error_at(case.rows, half) > 50.0
    assert image_error_at(case.rows, np.eye(4)) < 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_the_sense_of_parallel_planes_does_not_depend_on_where_they_are(seed):
    """Moved apart, to either side, they are alike; half a turn about a direction in them is told."""
    model, M = random_arm(np.random.default_rng(5))
    G = frame(seed)
    case = Case(model, M, [Incidence("a on b", PLANE, PLANE, PARALLEL)], model.q_reference, G)
    along = M[5, :3] - M[4, :3]
    half = expm(np.pi * hat(along / np.linalg.norm(along), np.cross(M[4, :3], along / np.linalg.norm(along))))
    for by in 5.0 * np.random.default_rng(seed).normal(size=(20, 3)):
        apart = G @ displacement(np.zeros(3), by) @ np.linalg.inv(G)
        assert image_error_at(case.rows, apart) < 1e-6
        assert image_error_at(case.rows, apart @ G @ half @ np.linalg.inv(G)) > 50.0


@pytest.mark.volume
@pytest.mark.parametrize("kind", [(LINE, LINE, MEET), (PLANE, PLANE, MEET), (LINE, LINE, PARALLEL)])
def test_the_nearest_goal_has_its_features_in_their_sense(kind):
    """From wherever the body is turned to, and in any frame; the errors of the other sense are told."""
    for seed in range(4):
        rng = np.random.default_rng([29, seed])
        model, M = random_arm(rng)
        case = Case(model, M, [Incidence("a on b", *kind)], model.q_reference, frame(seed))
        moved = image_velocities(case.model, np.ones((2, len(M)), dtype=bool))
        for turn in 3.0 * rng.normal(size=(10, 3)):
            G = frame(seed)
            about = M[4, :3]
            H = displacement(turn, about - displacement(turn, np.zeros(3))[:3, :3] @ about)
            goal = nearest_goal(case.rows, case.body, G @ H @ np.linalg.inv(G), moved)
            assert image_error_at(case.rows, goal) < 1e-4
            assert errors_px(case.rows, goal[None]).max() < 1e-4


def contradicting(asked, seed, sigma_px, G=None):
    """Contradictions of a list that is taught somewhere."""
    rng = np.random.default_rng([31, seed])
    model, M = random_arm(rng)
    G = np.eye(4) if G is None else G
    there = in_frame(model, G)
    H = poe(there, model.q_reference + deviating(rng))
    shows = np.ones((2, len(M)), dtype=bool)
    body, pairs = make_body(there, M @ G.T), asked(M)
    return list(contradicting_incidences(there, body, H, scenes(body, H, pairs), pairs, shows, sigma_px))


def apart(asked, seed=0, sigma_px=0.1, G=None):
    """Their severity and the names of the incidences."""
    found = contradicting(asked, seed, sigma_px, G)
    return [(one.severity, tuple(other.subject.name for other in one.others)) for one in found]


CONTRADICTORY = [
    [Incidence("a", LINE, WALL[:2], ANGLE, 30.0), Incidence("b", LINE, WALL[:2], ANGLE, 60.0)],
    [Incidence("a", PLANE, WALL, ANGLE, 20.0), Incidence("b", PLANE, WALL, ANGLE, 70.0)],
    [Incidence("a", POINT, POINT), Incidence("b", POINT, ((5,),))],
    [Incidence("a", LINE, LINE), Incidence("b", LINE, LINE[::-1], PARALLEL)],
    [Incidence("a", LINE, LINE), Incidence("b", ((7,),), LINE)],
]


@pytest.mark.volume
@pytest.mark.parametrize("pair", CONTRADICTORY)
def test_incidences_that_no_place_meets_are_named(pair):
    """The two of them, alone and among others that they agree with, in any frame."""
    between = [pair[0], Incidence("other", ((6,),), PLANE), pair[1]]
    for seed in range(3):
        for asked in (pair, between):
            assert apart(lambda _, asked=asked: asked, seed, G=frame(seed)) == [(REFUSES, ("a", "b"))]


def test_a_list_that_holds_where_it_was_taught_agrees_however_many_rows_it_has():
    def asked(M):
        return [Incidence("wall", WALL, WALL), *whole_pose(M[:4])]

    for seed in range(3):
        assert apart(asked, seed, 1e-3, frame(seed)) == []


def _angle(X, Y, tool, scene):
    """Angle, deg, of features of metric points X (m, 3) and Y (m, 3)."""
    axes = []
    for points, flat in ((X, tool), (Y, scene)):
        A = points[[one for (one,) in flat]]
        axes.append(A[1] - A[0] if len(A) == 2 else np.cross(A[1] - A[0], A[2] - A[0]))
    cosine = axes[0] @ axes[1] / np.prod(np.linalg.norm(axes, axis=1))
    return math.degrees(math.acos(np.clip(cosine, -1.0, 1.0)))


@pytest.mark.volume
def test_angles_that_some_turn_has_together_agree():
    """Of up to three pairs of lines or of planes, as a random turn of the tool makes them."""
    for seed in range(40):
        rng = np.random.default_rng([43, seed])
        turn = displacement(3.0 * rng.normal(size=3), np.zeros(3))[:3, :3]
        kinds = [(LINE, ACROSS, SLANT), (PLANE, WALL)]
        alike = [kinds[k] for k in rng.integers(0, 2, 1 + seed % 3)]
        pairs = [tuple(flats[k] for k in rng.integers(0, len(flats), 2)) for flats in alike]

        def asked(M, pairs=pairs, turn=turn):
            return [
                Incidence(f"{k}", tool, scene, ANGLE, _angle(M[:, :3] @ turn.T, M[:, :3], tool, scene))
                for k, (tool, scene) in enumerate(pairs)
            ]

        assert apart(asked, seed, 1e-3) == [], seed


def test_a_contradiction_within_the_noise_is_told_or_none():
    """Two angles that differ by 0.2° are as far apart as the images of the line that is turned by as much."""

    def asked(M, by=0.2):
        axes = [M[j, :3] - M[4, :3] for j in (5, 7)]
        taught = math.degrees(math.acos(axes[0] @ axes[1] / np.prod(np.linalg.norm(axes, axis=1))))
        return [Incidence("a", LINE, ACROSS, ANGLE, taught), Incidence("b", LINE, ACROSS, ANGLE, taught + by)]

    (one,) = contradicting(asked, 0, 1e-3)
    (twice,) = contradicting(lambda M: asked(M, 0.4), 0, 1e-3)
    assert twice.amount == pytest.approx(2.0 * one.amount, rel=0.02)
    for sigmas, severity in ((6.0, REFUSES), (4.0, LIMITS), (1.0, None)):
        found = apart(asked, sigma_px=one.amount / sigmas)
        assert found == ([] if severity is None else [(severity, ("a", "b"))])


def test_angles_need_axes_that_are_not_parallel():
    model, M = random_arm(np.random.default_rng(2))
    slides = model._replace(H_hat_0=np.array([*map(prismatic, np.eye(3))]), prismatic=np.ones(3, bool))
    asked = [Incidence("pin upright", LINE, WALL, PERPENDICULAR)]
    body = make_body(model, M)
    with pytest.raises(InputError, match="pin upright needs the metric form"):
        incidences_of(slides, body, scenes(body, np.eye(4), asked), asked)


@pytest.mark.parametrize(("flat", "kind"), [(((4,), (4,)), "line"), (((4,), (5,), (4, 5)), "plane")])
def test_points_that_span_no_line_or_plane_are_refused(flat, kind):
    model, M = random_arm(np.random.default_rng(2))
    for tool, scene in ((flat, PLANE), (PLANE, flat)):
        body, asked = make_body(model, M), [Incidence("pin", tool, scene)]
        with pytest.raises(WorkFailed, match=f"incidence pin: its points span no {kind}: name others"):
            incidences_of(model, body, scenes(body, np.eye(4), asked), asked)


def test_a_feature_of_markers_that_nothing_has_shown_is_refused():
    model, M = random_arm(np.random.default_rng(2))
    asked = [Incidence("pin", POINT, POINT)]
    with pytest.raises(WorkFailed, match="incidence pin: fewer than two cameras see all markers"):
        incidences_of(model, make_body(model, M), [np.full((1, 4), np.nan)], asked)


def test_a_goal_whose_images_show_too_little_is_refused():
    model, M = random_arm(np.random.default_rng(2))
    body = make_body(model, M)
    asked = [Incidence("pin", LINE, LINE)]
    rows = incidences_of(model, body, scenes(body, np.eye(4), asked), asked)
    shows = np.zeros((2, len(M)), dtype=bool)
    shows[:, 0] = True
    with pytest.raises(WorkFailed, match="do not determine the pose of the body: show more markers"):
        weighted(rows, model, body, np.eye(4), shows, face_of(body.M[:4]))


def test_a_line_is_turned_across_itself_although_no_first_step_lowers_the_error():
    for seed in range(3):
        generator = np.random.default_rng([23, seed])
        model, M = random_arm(generator)
        case = Case(model, M, [Incidence("pin", LINE, LINE, PERPENDICULAR)], model.q_reference)
        assert case.rows.weight.shape == (1, 1)
        end = case.drive(model.q_reference + deviating(generator), gain=0.2)
        assert errors_px(case.rows, poe(model, end)[None]).max() < 1e-6
        pins = [(M[[4, 5]] @ H.T)[:, :3] for H in (poe(model, end), np.eye(4))]
        assert angle_off(Incidence("pin", LINE, LINE, PERPENDICULAR), *pins) < 1e-8


@pytest.mark.volume
def test_free_motions_lead_away_from_limits_and_do_not_disturb_the_task():
    """A joint that a task drives over a limit goes less far where the law knows it; most stay within."""
    better = 0
    for seed in range(10):
        generator = np.random.default_rng([17, seed])
        model, M = random_arm(generator)
        q_star = model.q_reference + deviating(generator)
        q = q_star + deviating(generator)
        case = Case(model, M, [Incidence("tip", POINT, POINT)], q_star)
        plain = case.drive(q, gain=0.2)
        joint = int(np.argmax(np.abs(plain - q)))
        way = np.sign(plain[joint] - q[joint])
        upper, lower = np.full((2, 6), q + 3.0), np.full((2, 6), q - 3.0)
        bound = q[joint] + 0.7 * (plain[joint] - q[joint])
        (upper if way > 0 else lower)[0, joint] = bound
        led = case.drive(q, gain=0.2, limits=position_limits(lower[0], upper[0]))
        assert errors_px(case.rows, poe(model, led)[None]).max() < 0.05  # px, of steps that curve
        over, over_plain = (way * (end[joint] - bound) for end in (led, plain))
        assert over < over_plain
        better += over <= 0.0
    assert better >= 7


@pytest.mark.volume
@pytest.mark.parametrize("flat", [LINE, WALL])
def test_the_law_leaves_where_a_feature_points_the_other_way(flat):
    """Taught turned by nearly half a turn, or by all of it, about any axis across the feature."""
    for seed in range(6):
        generator = np.random.default_rng([29, seed])
        model, M = random_arm(generator)
        X = M[[i for (i,) in flat], :3]
        along = X[1] - X[0] if len(X) == 2 else np.cross(X[1] - X[0], X[2] - X[0])
        axis = np.cross(along, generator.normal(size=3))
        turn = (np.pi - generator.uniform(0.0, 0.4) * (seed > 0)) * axis / np.linalg.norm(axis)
        case = Case(model, M, [Incidence("other way", flat, flat, PARALLEL)], displacement(turn, np.zeros(3)))
        begun, end = (poe(model, q) for q in (model.q_reference, case.drive(model.q_reference, gain=0.5)))
        assert image_error_at(case.rows, begun) > 10.0
        assert image_error_at(case.rows, end) < 0.01  # px; the free motion goes on, and disturbs that much


@pytest.mark.volume
def test_independent_errors_that_vanish_far_from_the_goal_are_no_arrival():
    """Of three points on points six errors are independent, and vanish in other places than the goal too."""
    elsewhere = 0
    for seed in range(7, 13):
        generator = np.random.default_rng([31, seed])
        model, M = random_arm(generator)
        case = Case(model, M, whole_pose(M[:4]), model.q_reference)
        assert case.rows.rows.shape == (9, 11 + 6 + 3)
        for _ in range(5):
            H = poe(model, case.drive(model.q_reference + deviating(generator, size=1.2), gain=0.5))
            independent = np.linalg.norm(linearized(case.rows, H, np.zeros((0, 4, 4)))[0])
            left, error = errors_px(case.rows, H[None]).max(), image_error_at(case.rows, H)
            if independent < 1e-3 and left > 1.0:
                elsewhere += 1
                assert error > 1.0
            elif independent < 1e-9:
                assert error < 1e-6
    assert elsewhere > 3
