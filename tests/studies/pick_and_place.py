"""Pick a part wherever it lies with an emulated SO-101, lift and place it; and kill the command in each step.

    python -m tests.studies.pick_and_place [RUNS] [--fps 30] [--rate 0.25] [--killed | --disturbed]

Bench, recording and mechanics are those of ``so101_goals``; a part with two tags of 30 mm lies beside the
tool where somebody teaches once how it is gripped: the middle of the face and the direction of its upright
edge; the turn about that follows, as five joints have it. For each run somebody teaches where the part is to
be placed, and puts it elsewhere, up to 150 mm and 60 degrees away. One call of ``servo`` then opens the
gripper, approaches along the normal, grips, lifts, goes over the place and down to it, opens and retreats.
The part is gripped where the gripper closes within 5 mm and 5 degrees of how it was taught, moves with the
tool before the cameras, and is dropped where the gripper opens or loses torque. The truth is that of the
emulator. With ``--killed`` run k is interrupted half a second after step k mod 9 began; with ``--disturbed``
the part is pushed by 20 mm (k even) or taken away, out of the gripper as well, half a second after step
k // 2 mod 7 began, the last in which the gripper may hold it. The run is right where the part is named, and
where the gripper was not closed after the part had gone before.
"""

import argparse
import json
import os
import signal
import tempfile
import threading
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from projservo_cli.config import load_config, shipped
from projservo_cli.config.settings_and_rules import truth_of
from projservo_cli.geometry.displacements import rigid
from projservo_cli.records import InputError
from projservo_cli.robots.session import Session
from projservo_cli.settings.objects import ObjectSettings
from projservo_cli.stages import servo
from tests.documentation.blocks import PAGES, blocks_of
from tests.emulated.arm import TAGS
from tests.studies.carried_goals import seen
from tests.studies.common import quantiles
from tests.studies.so101_goals import goals, prepared, said
from tests.studies.so101_tutorial import START, benched, by_hand

RUNS = 20
OPENED, CLOSED, PART = 2600, 1200, 1500  # counts of the gripper, and that at which the part stops it
STEPS, PUSHED, BEFORE_GRIP = 7, rigid(Rotation.identity(), [0.0, 0.02, 0.0]), 3
REACH_M, REACH_DEG, IN_PLACE_MM, IN_PLACE_DEG = 0.005, 5.0, 2.0, 2.0
SEED, FARTHEST_M, MOST_DEG, APART_PX = 8_400, 0.15, 60.0, 12.0
GRIP = (16.0, 8.0, -22.0, 14.0, 0.0)  # joints where the grip is taught, deg
SIDE_M = 0.03
# Both tags of the part in the frame of the tool that grips it, m; their normals open by 50 degrees.
TAGS_AT = [
    rigid(Rotation.from_euler("x", turn, degrees=True), [x, 0.145, 0.02])
    for x, turn in ((-0.022, -25.0), (0.022, 25.0))
]
NUMBERS = (10, 11)
TEACH = ("teach", "-c", "arm.yaml", "--force", "-o")
AWAY = rigid(Rotation.identity(), [-5.0, 0.0, 0.0])


def part_of(G):
    """Settings of the part that a tool at a pose (4, 4) grips."""
    tags = [
        {"number": number, "size_m": SIDE_M, "pose": (G @ T).tolist()}
        for number, T in zip(NUMBERS, TAGS_AT, strict=True)
    ]
    return ObjectSettings.model_validate({"tags": tags})


class Part:
    """A part on the bench, which the gripper takes along; ``dropped`` where it was let go of elsewhere.

    grip : (4, 4) pose of the tool that grips it right where it lay when that was taught, m.
    ``bench.arm.displacement``: (4, 4) its motion since then.
    """

    def __init__(self, bench, truth, grip):
        self.bench, self.truth, self.grip, self.held, self.dropped = bench, truth, grip, None, False
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stopping.set()
        self._thread.join()

    def off(self, tool):
        """Distance, mm, and angle, deg, of a tool (4, 4) from one that grips the part, but for its turn."""
        return off(self.truth, self.bench.arm.displacement @ self.grip, tool)

    def _watch(self):
        while not self._stopping.is_set():
            self.look()
            self.bench.arm.clock.sleep(0.02)

    def look(self):
        """Grip, carry or let go of the part, as the gripper stands now."""
        arm, gripper = self.bench.arm, self.bench.bus.servos[6]
        tool = self.truth.robot.pose(arm.link)
        mm, deg = self.off(tool)
        near = mm < 1e3 * REACH_M and deg < REACH_DEG
        gripper.between = PART if near or self.held is not None else None
        grips = gripper.on and gripper.present <= PART + 20
        if self.held is not None:
            arm.displacement = tool @ self.held
            if not (grips and arm.torque_on.all()):
                self.dropped, self.held = not gripper.on or self.dropped, None
        elif grips and near:
            self.held = np.linalg.inv(tool) @ arm.displacement


def off(truth, wanted, tool):
    """Distance, mm, of the middle of the face from that of a tool (4, 4), and angle, deg, of its edge."""
    middle = truth.M_face.mean(axis=0) @ np.linalg.inv(truth.robot.base_tool).T
    cosine = wanted[:3, 0] @ tool[:3, 0]
    return 1e3 * np.linalg.norm((wanted - tool) @ middle), float(np.degrees(np.arccos(min(cosine, 1.0))))


def displacements(truth, grip, count):
    """Motions (4, 4) of the part after which the arm can grip it, and sees it from the start."""
    rng, part, found = np.random.default_rng(SEED), part_of(grip), []
    at_start = truth.images(np.radians(START), truth.M)
    for q in goals(truth, 100 * count):
        turn = rigid(Rotation.from_euler("x", rng.uniform(-15.0, 15.0), degrees=True), np.zeros(3))
        T = truth.robot.pose(np.radians(q)) @ turn @ np.linalg.inv(grip)
        X, R = part.points @ T.T, Rotation.from_matrix(T[:3, :3])
        far = np.linalg.norm((X - part.points)[:, :3].mean(axis=0)) > FARTHEST_M
        if far or np.degrees(R.magnitude()) > MOST_DEG or not seen(truth, X, R.apply(part.normals[::4])):
            continue
        s = np.array([(X @ P.T)[:, :2] / (X @ P.T)[:, 2:] for P in truth.P])
        beside = (s.min(axis=1) > at_start.max(axis=1) + APART_PX) | (
            s.max(axis=1) < at_start.min(axis=1) - APART_PX
        )
        inside = np.minimum(s, truth.image_size[:, None] - s).min() > 2.0 * APART_PX
        if inside and beside.any(axis=1).all():  # the tool hides it from neither camera
            found.append(T)
        if len(found) == count:
            return found
    raise ValueError(f"{len(found)} of {count} places of the part are seen")


def written(bench):
    """Put the parts of a configuration that the tutorial shows into arm.yaml."""
    file, page = bench.folder / "arm.yaml", PAGES["pick-a-part"]
    named, task, options = (block.text for block in blocks_of(page) if block.language == "yaml")
    text = file.read_text()
    for before, after in (
        ("  goal: goal.yaml    # projservo teach writes it\n", task),
        ("options: {port: auto, ids: [1, 2, 3, 4, 5], gripper: 6}\n", options),
    ):
        assert before in text
        text = text.replace(before, after)
    file.write_text(f"{text}\n{named}")


def interrupted(patch, step, act=None, wait_s=0.5):
    """Call, by default SIGINT to this process, half a second after a step, counted from 0, began."""
    begun, act = [], act or (lambda: os.kill(os.getpid(), signal.SIGINT))

    def counted(call):
        def wrapped(*given, **more):
            begun.append(None)
            if len(begun) == step + 1:
                threading.Timer(wait_s, act).start()
            return call(*given, **more)

        return wrapped

    patch.setattr(servo, "run", counted(servo.run))
    patch.setattr(Session, "act", counted(Session.act))


def lost(bench, part, k):
    """Push the part, or take it away, whatever holds it."""
    with bench.arm.lock:
        T = AWAY if k % 2 else PUSHED @ bench.arm.displacement
        part.held, bench.arm.displacement = None, T


def pictures(bench, patch):
    """JPEGs of the right camera before each action, as they are taken."""
    taken, act = [], Session.act

    def pictured(*given, **more):
        taken.append(bench.cameras.picture(1))
        return act(*given, **more)

    patch.setattr(Session, "act", pictured)
    return taken


@contextmanager
def with_part(rate, fps):
    """An emulated arm on its bench with a part, its true geometry, and the pose (4, 4) taught to grip it."""
    truth = truth_of(load_config(shipped("hobby"), TAGS))
    grip = truth.robot.pose(np.radians(GRIP))
    settings = (f"objects={json.dumps({'part': {'tags': part_of(grip).model_dump(mode='json')['tags']}})}",)
    with (
        tempfile.TemporaryDirectory() as folder,
        pytest.MonkeyPatch.context() as patch,
        benched(Path(folder), patch, rate, fps, settings) as bench,
    ):
        bench.arm.displacement = AWAY
        yield bench, truth, grip


@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="plans and drives")
def test_the_commands_of_the_tutorial_pick_a_part_and_place_it():
    try:
        with with_part(0.25, 15.0) as (bench, truth, grip):
            assert prepared(bench)
            written(bench)
            text = "\n".join(block.text for block in blocks_of(PAGES["pick-a-part"]))
            by_name, at = {"grip.yaml": GRIP, "place.yaml": goals(truth, 1)[0]}, {}
            for line in (line for line in text.splitlines() if line.startswith("projservo ")):
                words = line.split()[1:]
                if words[0] == "teach":
                    name = words[-1]
                    bench.arm.displacement = np.eye(4) if name == "grip.yaml" else AWAY
                    at[name] = taught(bench, words, by_name[name])
                    assert at[name] is not None
                    continue
                if words[0] == "servo":
                    grip = truth.robot.pose(at["grip.yaml"])
                    put_at_start(bench, displacements(truth, grip, 1)[0])
                    with Part(bench, truth, grip) as part:
                        code, printed = said(words)
                        bench.arm.clock.sleep(1.0)
                else:
                    code, printed = said(words)
                print(line, printed)
                assert code == 0
            mm, deg = part.off(truth.robot.pose(at["place.yaml"]))
            assert mm < IN_PLACE_MM
            assert deg < IN_PLACE_DEG
    except InputError as error:
        pytest.skip(str(error))


def put_at_start(bench, T):
    """Have somebody put the arm to its start, and the part to where it has moved by T (4, 4)."""
    said(["release", "-c", "arm.yaml"])
    by_hand(bench.arm, START)()
    bench.arm.displacement = T


def main():
    """Print what became of the part in each run, and a summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="?", type=int, default=RUNS)
    parser.add_argument("--fps", type=float, default=30.0, help="frames a second of both cameras")
    parser.add_argument("--rate", type=float, default=0.25, help="of the emulated clock; slower is safer")
    parser.add_argument("--killed", action="store_true", help="interrupt each run in another step")
    parser.add_argument("--disturbed", action="store_true", help="push or take the part in each step")
    parser.add_argument(
        "--pictures", type=Path, help="folder of a PNG a run: taught, elsewhere, gripped, placed"
    )
    given = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background of a shell
    with with_part(given.rate, given.fps) as (bench, truth, _):
        if prepared(bench, "-o", "run"):
            written(bench)
            _driven(bench, truth, given)


def draw(path, jpegs):
    """Write four frames in two rows: taught, elsewhere, gripped, placed."""
    parts = [cv2.imdecode(np.frombuffer(one, np.uint8), 0)[90:430, 130:590] for one in jpegs]
    parts = [cv2.copyMakeBorder(one, 3, 3, 3, 3, cv2.BORDER_CONSTANT, value=255) for one in parts]
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.block([parts[:2], parts[2:]]))


def taught(bench, words, q):
    """Have somebody put the arm to joints (n,), deg, and teach; joints where that was, or None."""
    there = []
    bench.script[:] = [None, by_hand(bench.arm, q), lambda: there.append(bench.arm.link.copy())]
    code, line = said(words)
    if code != 0:
        print(f"{' '.join(words)}: exit {code}: {line[-300:]}", flush=True)
    return there[0] if code == 0 else None


def _driven(bench, truth, given):
    arm, runs, errors, kept, right = bench.arm, given.runs, [], 0, 0
    arm.displacement = np.eye(4)
    if (q := taught(bench, [*TEACH, "grip.yaml"], GRIP)) is None:
        return
    grip, at_grip = truth.robot.pose(q), bench.cameras.picture(1)
    moved = displacements(truth, grip, runs)
    for k, (T, at) in enumerate(zip(moved, goals(truth, runs), strict=True)):
        arm.displacement = AWAY
        if (q := taught(bench, [*TEACH, "place.yaml"], at)) is None:
            continue
        put_at_start(bench, T)
        with Part(bench, truth, grip) as part, pytest.MonkeyPatch.context() as patch:
            if given.killed:
                interrupted(patch, k % 9)
            step, closed = k // 2 % STEPS, len(bench.bus.writes)
            if given.disturbed:
                interrupted(patch, step, lambda part=part, k=k: lost(bench, part, k), 0.5 / arm.clock.rate)
            taken = pictures(bench, patch)
            code, line = said(["servo", "-c", "arm.yaml", "-o", "run"])
            arm.clock.sleep(1.0)
            part.look()
        if given.pictures and len(taken) == 3:
            draw(given.pictures / f"{k}.png", (at_grip, *taken))
        if given.disturbed:
            sent = [row[3][:2] for row in bench.bus.writes[closed:] if row[1:3] == (6, 42)]
            named = code == 1 and ("object part" in line or "the part" in line)
            right += (good := named and (step >= BEFORE_GRIP or CLOSED.to_bytes(2, "little") not in sent))
            what = "taken" if k % 2 else "pushed"
            print(
                f"{k:3} {what} in step {step + 1}: {'right' if good else 'WRONG'}, exit {code}  {line[-400:]}"
            )
            continue
        mm, deg = part.off(truth.robot.pose(q))
        gripper = bench.bus.servos[6]
        holds = not part.dropped and gripper.on and arm.torque_on.all()
        kept += bool(holds)
        if code == 0:
            errors.append((mm, deg))
        how = f"part {mm:.2f} mm, {deg:.2f}° off, {'' if holds else 'NOT '}kept"
        print(f"{k:3} exit {code}: {how}  {line[-300:]}", flush=True)
    if given.disturbed:
        print(f"{right} of {runs} named, and nothing gripped at")
        return
    found = np.array(errors).reshape(-1, 2)
    placed = int(((found[:, 0] <= IN_PLACE_MM) & (found[:, 1] <= IN_PLACE_DEG)).sum())
    within = f"within {IN_PLACE_MM:g} mm and {IN_PLACE_DEG:g}°"
    print(f"{placed} of {runs} parts {within}; torque and grip kept in {kept}")
    if len(found):
        print(f"mm {quantiles(found[:, 0])}; deg {quantiles(found[:, 1])}")


if __name__ == "__main__":
    main()
