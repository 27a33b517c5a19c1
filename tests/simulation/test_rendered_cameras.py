"""What rendered cameras show, against the projection of the true corners."""

import hashlib
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from projservo_cli.config import to_yaml
from projservo_cli.config.inputs import objects_of, scene_of
from projservo_cli.records import InputError
from projservo_cli.simulation.rendering import Frames, rendered_model
from tests.configured import truth_of
from tests.simulation.conftest import eyes_of

POSTURES = np.array([[0.1 * a, 0.25 * b] for a in (-2, 0, 1, 3) for b in (-1, 0, 1)])


def misses(truth, eyes, postures, seed=0):
    """By how much corners (k, 2, m, 2) that are found are off the true ones, px; NaN where none is."""
    found = []
    for i, q in enumerate(postures):
        rngs = [np.random.default_rng((seed, i, view)) for view in range(2)]
        seen = np.array([eyes.capture(view, q[None], None, rng)[0] for view, rng in enumerate(rngs)])
        found.append(seen - truth.images(q, truth.M))
    return np.array(found)


@pytest.mark.parametrize("k1", [0.0, -0.25, 0.15])
def test_corners_are_where_the_cameras_project_them(small, drawn, k1):
    """Both cameras; one has skew, and with a lens both bend."""
    truth, eyes = drawn(small(f"plant.options.k1={k1}"))
    off = misses(truth, eyes, POSTURES)
    assert np.isfinite(off).mean() > 0.75
    assert np.abs(np.nanmean(off, axis=(0, 2))).max() < 0.02
    assert np.nanstd(off) < 0.06


def test_noise_and_blur_are_as_they_were_asked_for(small, drawn):
    truth, eyes = drawn(small("plant.options.grey_noise=3", "plant.options.blur_px=1.2"))
    shots = []
    for seed in range(2):
        misses(truth, eyes, POSTURES[:1], seed)
        shots.append(eyes.last.astype(float))
    assert np.std(shots[1] - shots[0]) == pytest.approx(3.0 * np.sqrt(2.0), rel=0.03)
    sharp_truth, sharp = drawn(small())
    misses(sharp_truth, sharp, POSTURES[:1])
    steepest = [np.abs(np.diff(image, axis=1)).max() for image in (sharp.last[1].astype(float), shots[0][1])]
    assert steepest[1] < 0.6 * steepest[0]


HASHED = """
import hashlib, sys
import numpy as np
from projservo_cli.config import load_config
from projservo_cli.config.inputs import scene_of
from projservo_cli.simulation.rendering import Frames, rendered_model
config = load_config("small.yaml", ["plant.options={k1: -0.1}"], text=sys.stdin.read())
eyes = Frames(rendered_model(scene_of(config)))
eyes.open()
seen = [eyes.capture(view, np.array([[0.1, 0.2]]), None, np.random.default_rng(view))[0] for view in range(2)]
print(hashlib.sha256(eyes.last.tobytes() + np.array(seen).tobytes()).hexdigest())
eyes.close()
"""


def drawn_elsewhere(config, gl):
    """What another process prints that draws by OpenGL of a kind."""
    return subprocess.run(
        [sys.executable, "-c", HASHED],
        input=to_yaml(config),
        env={**os.environ, "MUJOCO_GL": gl, "PYOPENGL_PLATFORM": gl},
        capture_output=True,
        text=True,
        check=False,
    )


def test_processes_draw_the_same_to_the_bit(small, drawn):
    """By another kind of OpenGL where there is one."""
    config = small("plant.options={k1: -0.1}")
    _, eyes = drawn(config)
    seen = [
        eyes.capture(view, np.array([[0.1, 0.2]]), None, np.random.default_rng(view))[0] for view in range(2)
    ]
    here = hashlib.sha256(eyes.last.tobytes() + np.array(seen).tobytes()).hexdigest()
    there = drawn_elsewhere(config, "osmesa")
    if "finds no OpenGL" in there.stderr:
        there = drawn_elsewhere(config, "egl")
    assert there.stdout.strip() == here


@pytest.mark.usefixtures("needs_mujoco")
def test_what_lacks_gl_is_told_what_to_install(small):
    done = drawn_elsewhere(small(), "disable")
    assert done.returncode == 1
    assert "InputError: MuJoCo finds no OpenGL to draw with: apt-get install libegl1" in done.stderr


@pytest.mark.usefixtures("needs_mujoco")
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["plant.options.k1=-0.9", "rig.right.focal_px=[150, 150]"],
            "plant.options.k1: a lens that bends so much",
        ),
        (["markers={tags: roof, dictionary: 5X5_9}"], "dictionary 5X5_9: unknown; valid: "),
        (["markers={tags: [TAG]}"], "there is no tag 50 in the dictionary, which has tags 0 to 49"),
    ],
)
def test_a_scene_that_cannot_be_is_said_in_a_line(small, overrides, message):
    tag = "{number: 50, size_m: 0.1, pose: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}"
    config = small(*(text.replace("TAG", tag) for text in overrides))
    with pytest.raises(InputError, match=message):
        eyes_of(config)


def test_an_object_moves_before_the_cameras(small, needs_mujoco):
    """A tag that goes along and turns is found where the cameras project it then."""
    pose = [[0, 0, 1, 0.5], [1, 0, 0, 0.2], [0, 1, 0, 0.2], [0, 0, 0, 1]]
    tag = {"number": 20, "size_m": 0.1, "pose": pose}
    velocity = {"translation_mm_s": [0.0, 30.0, 10.0], "rotation_deg_s": [10.0, 0.0, 0.0]}
    config = small(f"objects.part.tags={json.dumps([tag])}", f"objects.part.velocity={json.dumps(velocity)}")
    (one,), truth = objects_of(config), truth_of(config)
    eyes = Frames(rendered_model(scene_of(config, None, config.objects.named)))
    eyes.open()
    found = 0
    for time in (0.0, 1.0, 2.0):
        s, at = one.images(truth, one.at(time)), np.array([time])
        for view in range(2):
            seen, _ = eyes.capture(view, np.array([[0.1, 0.2]]), None, np.random.default_rng(0), at)
            off = seen[-4:] - s[view]
            found += np.isfinite(off[:, 0]).sum()
            assert (np.abs(off[np.isfinite(off)]) < 0.2).all()
    eyes.close()
    assert found > 12  # of 24 corners
