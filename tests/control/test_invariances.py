"""What a command must not depend on: the frame, cameras' scale and order, numbers of markers, joints' zeros.

Held against each other over random arms, motions and instants, for every built-in law.
"""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, reject
from hypothesis import strategies as st

from projservo_cli.control.law import OK
from projservo_cli.laws import CODES, LAW_SPECS
from projservo_cli.loop.python_loop import BuiltInLaw
from projservo_cli.records import FloatArray, Model, WorkFailed
from projservo_cli.task.target import TargetGoal, TaskImages
from tests.samples import frame, in_frame
from tests.scene import FACE_LAWS, GAINS, scene


class Instant(NamedTuple):
    """What a law is given."""

    model: Model
    task: TaskImages
    s: FloatArray
    q: FloatArray

    def command(self, law) -> FloatArray:
        status, q_dot = BuiltInLaw(CODES[law], self.model, self.task.task(self.model), GAINS)(self.s, self.q)
        assert status == OK
        return q_dot

    def seen(self, change) -> "Instant":
        """The same with all images changed alike."""
        s_start, s_star, s = (change(images) for images in (self.task.s_start, self.task.s_star, self.s))
        return self._replace(task=self.task._replace(s_start=s_start).to(s_star), s=s)


def instant(types, markers, rng) -> Instant:
    """Somewhere on the way of a random motion by up to 0.3 rad or m of each joint."""
    step = rng.uniform(-0.3, 0.3, len(types))
    sc = scene(step, types, markers)
    q = sc.q_start + rng.uniform(0.0, 0.8) * step
    return Instant(
        sc.model,
        TaskImages(sc.q_start, sc.s_start, TargetGoal.at(sc.s_star), sc.plant.center),
        sc.images(q),
        q,
    )


def other_frame(at, rng):
    G = frame(int(rng.integers(1000)), mirrored=bool(rng.integers(2)))
    return at._replace(model=in_frame(at.model, G)), 1.0


def other_camera_scale(at, rng):
    scale = rng.choice([-1.0, 1.0], 2) * np.exp(rng.uniform(-5.0, 5.0, 2))
    return at._replace(model=at.model._replace(P=at.model.P * scale[:, None, None])), 1.0


def other_pixels(at, rng):
    """Pixels of another size in both cameras, and another corner of each image to count from."""
    size, corner = np.exp(rng.uniform(-2.0, 2.0)), rng.uniform(-500.0, 500.0, (2, 1, 2))
    K = np.array([[[size, 0.0, u], [0.0, size, v], [0.0, 0.0, 1.0]] for u, v in corner[:, 0]])
    return at._replace(model=at.model._replace(P=K @ at.model.P)).seen(lambda s: size * s + corner), 1.0


def other_numbers(at, rng):
    order = rng.permutation(at.s.shape[1])
    return at.seen(lambda s: np.ascontiguousarray(s[:, order])), 1.0


def left_and_right(at, rng):
    P = np.ascontiguousarray(at.model.P[::-1])
    return at._replace(model=at.model._replace(P=P)).seen(lambda s: np.ascontiguousarray(s[::-1])), 1.0


def other_zeros_and_senses(at, rng):
    sense, zero = rng.choice([-1.0, 1.0], len(at.q)), rng.uniform(-1.0, 1.0, len(at.q))
    H_hat_0 = at.model.H_hat_0 * sense[:, None, None]
    model = at.model._replace(H_hat_0=H_hat_0, q_reference=sense * at.model.q_reference + zero)
    task = at.task._replace(q_start=sense * at.task.q_start + zero)
    return Instant(model, task, at.s, sense * at.q + zero), sense


CHANGES = (
    *(other_frame, other_camera_scale, other_pixels, other_numbers, left_and_right, other_zeros_and_senses),
)


@pytest.mark.parametrize("law", FACE_LAWS)
@given(
    st.sampled_from(["RRRRRR", "RRPRRR"]),
    st.integers(4, 6),
    st.sets(st.sampled_from(CHANGES), min_size=1),
    st.integers(0, 10**6),
)
def test_a_command_does_not_depend_on_how_the_scene_is_described(law, types, markers, changes, seed):
    """One change or several at once; the one law that is given its metric model keeps its frame."""
    rng = np.random.default_rng(seed)
    at = instant(types, markers, rng)
    described, senses = at, 1.0
    for change in CHANGES:
        if change in changes and not (LAW_SPECS[law].metric and change is other_frame):
            described, sense = change(described, rng)
            senses = senses * sense
    try:
        wanted = senses * at.command(law)
    except WorkFailed:  # the face is seen from both sides, so no law is asked
        reject()
    # Round-off of a triangulation, times the condition of the joints' motions.
    np.testing.assert_allclose(described.command(law), wanted, atol=1e-7 * np.abs(wanted).max())
