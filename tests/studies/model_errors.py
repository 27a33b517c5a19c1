"""Whether a stated error holds where arm or rig are not as the model says, and whether the cause is named.

    python -m tests.studies.model_errors [--faults NAME ...] [--arms ...] [--sizes ...] [--seeds N]
        [--sound N] [--jobs 2] [--output FILE.csv]

Tables are those of ``faulty_arms``, at 0.3 px. A fault of size s alone makes a least-squares fit of the model
err by s times the error that a calibration of the same arm without faults states: rms over seeds and random
poses within the ranges of the joints, as arm and rig are at the end of the recording, without what changes at
random from pose to pose (joint noise, backlash). ``--amplitudes`` remakes these amplitudes, in
model_errors.csv. The true error of a run is that of its predictions at such poses. A named cause is right if
it is that of ``faults_of``, equivalent if the images of the table do not tell it from the fault, else wrong;
of several the one with the largest effect counts. ``--sound`` adds tables without faults, with corners of the
six kinds of ``tests.studies.monitoring``; ``--seeds 0`` leaves faults out.
"""

import csv
import itertools
import os
import time
import warnings
from collections import Counter
from functools import cached_property, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

import projservo_cli as projservo
from projservo_cli.calibration import predict, prediction_variance
from tests.monitoring.corners import CornerMap
from tests.monitoring.stand_in import KINDS
from tests.studies.common import in_two_processes, parser_of, quantiles, rate, written
from tests.studies.faulty_arms import ARMS, FAULTS, IMAGE, WITH_LENS, World, alternatives, chain, faults_of

AMPLITUDES = Path(__file__).with_suffix(".csv")
SEED, NOISE_PX = 47, 0.3
BARREL = -0.3  # k1 of rigs that are calibrated with a lens
COMBINED, FRAMES, RANDOM, HELD_OUT = 12, 7, 56, 100  # numbers of poses; of frames of each joint
SIZES, SEEDS, REALISATIONS = (0.3, 1.0, 3.0, 10.0), 10, 5
BEHIND_PX = 1e4  # error of a point that is predicted behind a camera
# Noncentrality and share of a fault's images that a named cause may leave, if images do not tell them apart.
TELLS, LEAVES = 9.0, 0.5
# A tag is found up to this tilt, rad, in this share of images; a finder errs by this share of what it states.
MOST_TILT, LEAST_FOUND, STATES = np.radians(66.0), 0.5, 0.85
SHARED_PX = 0.2  # errors that the corners of an image share: rms of a shift, and of a stretch at their border


def seeded(arm, seed, *more):
    return np.random.default_rng([SEED, list(ARMS).index(arm), seed, *more])


def poses_of(arm, design, rng):
    """Readings (K, n) in the order of a recording."""
    n = len(arm.home)
    shares = [np.zeros((1, n)), *(np.linspace(-1.0, 1.0, FRAMES)[:, None] * np.eye(n)[i] for i in range(n))]
    free = rng.uniform(-1.0, 1.0, (RANDOM if design == "random" else COMBINED, n))
    shares = {"random": [free], "trials": [*shares, free], "singles": shares}[design]
    return arm.home + arm.reach * np.concatenate(shares)


class Setting:
    """An arm where it is recorded, and where it is judged; what its parameters do to the images."""

    def __init__(self, name, seed, lens=False, design=None):
        self.name, self.seed, self.lens, arm = name, seed, lens, ARMS[name]
        self.arm = arm._replace(k=np.array([[BARREL, 0.0]] * 2)) if lens else arm
        self.q = poses_of(arm, design or arm.design, seeded(name, seed))
        ends = self.q.min(axis=0), self.q.max(axis=0)
        self.ahead = seeded(name, seed, 3).uniform(*ends, (HELD_OUT, len(arm.home)))
        self.sound = self.images(), self.images(held=True)

    def images(self, put=None, amplitude=0.0, fault=0, held=False, arm=None):
        """Pixels (K, 2, m, 2) with a fault, where it is recorded, or ahead at the end of the recording."""
        q = self.ahead if held else self.q
        w = World(arm or self.arm, q, np.ones(len(q)) if held else np.linspace(0.0, 1.0, len(q)), held)
        if put is not None:
            put(w, amplitude, seeded(self.name, self.seed, 4, fault))
        return w.images()

    def change(self, put, amplitude, fault=0, held=False):
        """Change of all pixels in the images by a fault, ravelled."""
        return (self.images(put, amplitude, fault, held) - self.sound[held])[inside(self.sound[held])].ravel()

    def derivative(self, held=False, step=1e-5):
        """Derivative of all pixels in the images, ravelled, by the parameters of the model."""
        columns = []
        for field in ("cameras", "axes", "at", "markers", *(("k",) if self.lens else ())):
            values = getattr(self.arm, field)
            for index in np.ndindex(values.shape):
                by = np.zeros(values.shape)
                by[index] = step
                arms = [self.arm._replace(**{field: values + sign * by}) for sign in (1.0, -1.0)]
                ends = [self.images(held=held, arm=arm)[inside(self.sound[held])].ravel() for arm in arms]
                columns.append((ends[0] - ends[1]) / (2.0 * step))
        return np.stack(columns, axis=1)

    @cached_property
    def fit(self):
        """Orthonormal changes of images that parameters make, and changes ahead by each of them."""
        U, s, Vt = np.linalg.svd(self.derivative(), full_matrices=False)
        kept = s > 1e-7 * s[0]
        return U[:, kept], self.derivative(held=True) @ (Vt[kept].T / s[kept])

    def effect_px(self, put, amplitude, fault):
        """Error ahead of a least-squares fit to images with a fault, rms of marker and view, px."""
        U, ahead = self.fit
        error = ahead @ (U.T @ self.change(put, amplitude, fault)) - self.change(put, amplitude, fault, True)
        return float(np.sqrt(2.0 * np.mean(error**2)))

    def left_by(self, change, directions=()):
        """Noncentrality of a change of images that parameters and directions leave."""
        U = self.fit[0]
        rest = change - U @ (U.T @ change)
        if directions:
            N = np.stack([self.change(put, 1e-4) for put in directions], axis=1)
            N -= U @ (U.T @ N)
            N /= np.maximum(np.linalg.norm(N, axis=0), 1e-12)
            rest = rest - N @ np.linalg.lstsq(N, rest, rcond=1e-6)[0]
        return float(rest @ rest) / NOISE_PX**2

    def same_images(self, put_in, cause):
        """Whether the images do not tell a fault from a named cause."""
        change = self.change(*put_in)
        left = min((self.left_by(change, some) for some in alternatives(self.arm, *cause)), default=np.inf)
        return left <= min(TELLS, LEAVES * self.left_by(change))


def inside(pixels):
    """Whether points are in the images (K, 2, m)."""
    return ((pixels >= 0.0) & (pixels <= np.array(IMAGE) - 1.0)).all(axis=-1)


@lru_cache
def corner_map(finder):
    return CornerMap(finder)


def with_corners(arm, q, pixels, kind, rng):
    """Pixels as they are found, NaN where unseen, and their deviations, stated (K, 2, m) or None.

    Of normal noise (white), with a shift and a stretch that each image has (shared), or of a finder of tags.
    """
    shape, finder = pixels.shape, KINDS.get(kind, ("", None))
    if not finder[0]:
        errors, sigma = NOISE_PX * rng.standard_normal(shape), None
        if kind == "shared":
            place = pixels - pixels.mean(axis=2, keepdims=True)
            place /= np.abs(place).max(axis=2, keepdims=True)
            errors += SHARED_PX * rng.standard_normal((*shape[:2], 1, 2))
            errors += SHARED_PX * place @ rng.standard_normal((*shape[:2], 2, 2))
    else:
        corners, errors, sigma = arm.markers.reshape(3, 4, 3), np.empty(shape), np.empty(shape[:3])
        x, y = corners[:, 1] - corners[:, 0], corners[:, 0] - corners[:, 3]
        tag = np.stack([x, y, np.cross(x, y)], axis=2)
        tag /= np.linalg.norm(tag, axis=1, keepdims=True)
        R, t = chain(arm, q)[-1]
        for k, v in np.ndindex(shape[:2]):
            P = arm.cameras[v]
            there = (corners.mean(axis=1) @ R[k].T + t[k]) @ P[:, :3].T + P[:, 3]
            turn, distance = P[:, :3] @ R[k] @ tag, np.linalg.norm(there, axis=1)
            side, four = arm.focal * np.linalg.norm(x, axis=1) / distance, pixels[k, v].reshape(3, 4, 2)
            off, stated, fresh, share = corner_map(finder[0]).at(turn, there, side, four, v)
            off += fresh[..., None] * rng.standard_normal(off.shape)
            tilt = np.arccos(-(turn[..., 2] * there).sum(axis=1) / distance)
            found = (tilt < MOST_TILT) & (share >= LEAST_FOUND)
            errors[k, v] = np.where(found[:, None, None], off, np.nan).reshape(-1, 2)
            sigma[k, v] = ((finder[1] or 1.0) * STATES * stated).ravel()
        sigma = None if finder[1] is None else sigma
    seen = pixels + errors
    seen[~inside(seen)] = np.nan
    return seen, sigma


class Job(NamedTuple):
    """A table."""

    fault: str
    arm: str
    design: str
    corners: str
    size: float
    seed: int
    amplitude: float


def calibrated(setting, pixels, sigma=None):
    """The calibration of a table, as the command line makes it."""
    known = {"joint_types": setting.arm.types, "joint_unit": "rad", "image_size": IMAGE, "sigma": sigma}
    seen = projservo.Observations.from_arrays(setting.q, pixels, **known)
    return projservo.calibrate(seen, lens=setting.lens, progress=False)


def judged(job):
    """What came of the calibration of a table, against the truth: a row."""
    warnings.simplefilter("ignore")
    setting = Setting(job.arm, job.seed, job.fault in WITH_LENS, job.design)
    put, right = faults_of(setting.arm).get(job.fault, (None, set()))
    put_in = put, job.amplitude, FAULTS.index(job.fault) if put else -1
    row = job._asdict() | {"effect_px": setting.effect_px(*put_in) if put else 0.0}
    rng = seeded(job.arm, job.seed, 1)
    pixels, sigma = with_corners(setting.arm, setting.q, setting.images(*put_in), job.corners, rng)
    begun = time.process_time()
    try:
        found = calibrated(setting, pixels, sigma)
    except (projservo.InputError, projservo.WorkFailed) as refused:
        code = 2 if isinstance(refused, projservo.InputError) else 1
        return row | {"exit": code, "seconds": time.process_time() - begun, "reason": str(refused)}
    row |= {"exit": int(not found.usable), "seconds": time.process_time() - begun, "reason": found.reason}
    truth, images = setting.images(*put_in, held=True), predict(found, setting.ahead)
    error, variance = images - truth[:, :, found.marker], prediction_variance(found, setting.ahead)
    visible = inside(truth)[:, :, found.marker]
    rms = float(np.sqrt(np.mean(np.nan_to_num((error[visible] ** 2).sum(axis=1), nan=BEHIND_PX**2))))
    stated, worst = found.predicted_rms_px or np.nan, getattr(found, "predicted_worst_px", None)
    row |= {
        "predicted_rms_px": stated,
        "predicted_p99_px": found.predicted_p99_px,
        "predicted_worst_px": worst,
    }
    row |= {"true_rms_px": rms, "ratio": rms / stated, "ratio_worst": rms / np.fmax(stated, worst or 0.0)}
    # Predictions of the true images, and of what is found in them.
    seen, noise = with_corners(setting.arm, setting.ahead, truth, job.corners, rng)
    scale = 1.0 if sigma is None else np.median(sigma[np.isfinite(pixels[..., 0])])
    of_images = max(found.sigma_px, found.sigma_fitted_px) / scale
    noise = of_images * (np.ones(seen.shape[:3]) if sigma is None else noise)
    spread = np.sqrt(variance + noise[:, :, found.marker, None] ** 2)
    each = {"true": error[visible] / np.sqrt(variance[visible])}
    each["seen"] = ((images - seen[:, :, found.marker]) / spread)[visible]
    for name, z in each.items():
        z = np.abs(z[np.isfinite(z)])
        row |= {f"{name}_68": np.mean(z < 1.0), f"{name}_95": np.mean(z < 1.96)}
    causes, verdicts = sorted(getattr(found, "model_errors", ()), key=lambda one: -abs(one.effect_px)), [""]
    for one in causes:
        alike = [other.subject.views for other in causes if other.code == one.code]
        both = {("left",), ("right",)} <= {*alike}
        what = one.code, one.subject.joints, "" if both else "".join(one.subject.views)
        said = any(all(a in (None, b) for a, b in zip(some, what, strict=True)) for some in right)
        same = said or (put is not None and setting.same_images(put_in, what))
        verdicts.append("right" if said else "equivalent" if same else "wrong")
    words = (
        f"{c.code} {c.subject.joints} {''.join(c.subject.views)} {c.amount:.3g} ± {c.deviation:.2g}, "
        f"{c.effect_px:.3g} px"
        for c in causes
    )
    judgement = {"judged": verdicts[min(1, len(causes))], "others_wrong": verdicts[2:].count("wrong")}
    return row | judgement | {"named": "; ".join(words)}


def amplitudes():
    """Rows of amplitudes of faults by size, and of the errors that sound tables state."""
    for name, lens in itertools.product(ARMS, (False, True)):
        settings = [Setting(name, seed, lens) for seed in range(REALISATIONS)]
        tables = [with_corners(s.arm, s.q, s.sound[0], "white", seeded(name, s.seed, 1))[0] for s in settings]
        found = [calibrated(*pair).predicted_rms_px for pair in zip(settings, tables, strict=True)]
        stated, amplitude = float(np.sqrt(np.mean(np.square(found)))), 1e-3
        chosen = [fault for fault in FAULTS if (fault in WITH_LENS) == lens]
        for fault, size in itertools.product(chosen, SIZES):
            put, number = faults_of(settings[0].arm)[fault][0], FAULTS.index(fault)
            amplitude = 1e-3 if size == SIZES[0] else amplitude
            for _ in range(3):
                effects = [one.effect_px(put, amplitude, number) for one in settings]
                amplitude *= size * stated / float(np.sqrt(np.mean(np.square(effects))))
            yield fault, name, size, f"{stated:.4f}", f"{amplitude:.6g}"


def tables(given):
    """Tables of a study."""
    with open(AMPLITUDES, encoding="utf-8", newline="") as file:
        known = {
            (r["fault"], r["arm"], float(r["size"])): float(r["amplitude"]) for r in csv.DictReader(file)
        }
    design = itertools.product(range(given.seeds), given.faults, given.arms, given.sizes)
    for seed, fault, arm, size in design:
        yield Job(fault, arm, ARMS[arm].design, "white", size, seed, known[fault, arm, size])
    kinds = list(itertools.product(given.corners, ("trials", "random", "singles"), given.arms))
    for i in range(given.sound):
        kind, design, arm = kinds[i % len(kinds)]
        yield Job("none", arm, design, kind, 0.0, 1000 + i, 0.0)


def tell_faults(rows):
    """Print the three bars of tables with faults, and a line of each fault."""
    accepted, named = [r for r in rows if r["exit"] == 0], [r for r in rows if r["judged"]]
    for key, what in (("ratio", "stated"), ("ratio_worst", "stated, or what it may be up to")):
        held = sum(r["exit"] != 0 or r[key] <= 2.0 for r in rows)
        print(f"true <= 2 x {what}, or exit code not 0: {rate(held, len(rows))} % (99)")
    honest = sum(r["ratio"] >= 1.0 / 3.0 for r in accepted)
    print(f"stated <= 3 x true: {rate(honest, len(accepted))} % of {len(accepted)} accepted (90)")
    good, count = sum(r["judged"] != "wrong" for r in named), Counter(r["judged"] for r in named)
    others = sum(r["others_wrong"] > 0 for r in named)
    print(
        f"named right: {rate(good, len(named))} % of {len(named)} (90): {dict(count)}; others wrong {others}"
    )
    print(
        f"{'fault':17}{'held %':>7}{'exit 1':>7}  true over stated by size (median)   right equiv. wrong none"
    )
    for fault in dict.fromkeys(r["fault"] for r in rows):
        some = [r for r in rows if r["fault"] == fault]
        held = 100.0 * np.mean([r["exit"] != 0 or r["ratio"] <= 2.0 for r in some])
        sizes = [[r["ratio"] for r in some if r["size"] == size and r["exit"] == 0] for size in SIZES]
        medians = " ".join(f"{np.median(ratios) if ratios else np.nan:8.2f}" for ratios in sizes)
        count = Counter(r["judged"] for r in some)
        judgements = " ".join(f"{count[one]:6d}" for one in ("right", "equivalent", "wrong", ""))
        print(f"{fault:17}{held:7.1f}{sum(r['exit'] != 0 for r in some):7d} {medians} {judgements}")


def tell(rows):
    """Print what tables with faults, and without, show against the bars."""
    faulty, sound = ([r for r in rows if (r["fault"] == "none") == one] for one in (False, True))
    print(f"{len(faulty)} tables with faults, {len(sound)} without")
    if faulty:
        tell_faults(faulty)
    for kind in dict.fromkeys(["all", *(r["corners"] for r in sound)]) if sound else ():
        some = [r for r in sound if kind in ("all", r["corners"])]
        usable = [r for r in some if r["exit"] == 0]
        shares = ", ".join(
            f"{name} {100.0 * np.mean([r[f'{name}_68'] for r in usable]):.1f} "
            f"{100.0 * np.mean([r[f'{name}_95'] for r in usable]):.1f} %"
            for name in ("true", "seen")
        )
        print(
            f"sound, {kind}: refused {len(some) - len(usable)} of {len(some)}; within 1 and 1.96 deviations "
            f"{shares}; named {sum(r['judged'] != '' for r in some)}; true over stated "
            f"{quantiles([r['ratio'] for r in usable])}"
        )
    for (*what, why), count in Counter(
        (r["corners"], r["arm"], r["design"], r["reason"][:150]) for r in sound if r["exit"] != 0
    ).items():
        print(f"    refused {count} of {', '.join(what)}: {why}")
    print(f"seconds of the processor for a calibration: {quantiles([r['seconds'] for r in rows])}")


WORDS = ("fault", "arm", "design", "corners", "judged", "named", "reason")
COLUMNS = (
    *(*Job._fields, "effect_px", "exit", "seconds", "predicted_rms_px", "predicted_p99_px"),
    *("predicted_worst_px", "true_rms_px", "ratio", "ratio_worst", "true_68", "true_95", "seen_68"),
    *("seen_95", "judged", "others_wrong", "named", "reason"),
)


def read_rows(path):
    """Rows of a study that was made before."""
    with open(path, encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            yield {name: text if name in WORDS else float(text or "nan") for name, text in row.items()}


def main():
    """Calibrate the tables of the study and print a summary."""
    numbers = [
        ("seeds", SEEDS, "of each fault, arm and size"),
        ("sound", 0, "number of tables without faults"),
        ("jobs", 2, "number of processes"),
    ]
    corners = ["white", "shared", *KINDS], list(KINDS)
    parser = parser_of("model_errors_study", __doc__, numbers, faults=[*FAULTS], arms=ARMS, corners=corners)
    parser.add_argument("--sizes", nargs="+", type=float, choices=SIZES, default=SIZES)
    parser.add_argument("--amplitudes", action="store_true", help=f"remake {AMPLITUDES.name}")
    parser.add_argument("--read", type=Path, nargs="+", help="tables of earlier runs, to print their summary")
    given = parser.parse_args()
    if given.read:
        tell([row for path in given.read for row in read_rows(path)])
        return
    if given.amplitudes:
        with open(AMPLITUDES, "w", encoding="utf-8", newline="") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerows([("fault", "arm", "size", "stated_px", "amplitude"), *amplitudes()])
        return
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # of the processes to come
    jobs = list(tables(given))
    empty = dict.fromkeys(COLUMNS, np.nan) | {"judged": "", "others_wrong": 0}
    made = in_two_processes(judged, jobs, "tables", given.jobs)
    tell(written(given.output, COLUMNS, ([empty | row] for row in made)))


if __name__ == "__main__":
    main()
