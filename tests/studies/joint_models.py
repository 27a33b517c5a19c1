"""Whether fitted curves of joints predict as well as a model that knows which joints err, and how.

    python -m tests.studies.joint_models [--faults NAME ...] [--arms ...] [--seeds 20] [--jobs 2]
        [--output FILE.csv]

Tables are those of ``faulty_arms``, at 0.3 px, calibrated with joint_model auto and without. The error of a
run is that of its predictions at random poses within the ranges of the joints, rms of marker and view. The
bound is that of Cramér and Rao for a model with the very parameters of the fault: a gear of one joint or of
each, sine and cosine of one, one coupling, a deflection of each joint under the true load. Sound tables come
in each design. Ratios are of root mean squares over seeds: with auto over the bound, and over that without.
"""

import os
import warnings
from functools import partial
from typing import NamedTuple

import numpy as np

import projservo_cli as projservo
from projservo_cli.calibration import predict
from tests.studies.common import in_two_processes, parser_of, quantiles, written
from tests.studies.faulty_arms import ARMS, IMAGE, coupling, curve, harmonic, sag
from tests.studies.model_errors import BEHIND_PX, NOISE_PX, Setting, inside, seeded, with_corners

SEEDS, FIRST = 20, 2000  # seeds of no other study
GEAR, WAVE, COUPLED, SAG = -0.03, np.radians(0.5), 0.05, np.radians(1.0)
DESIGNS = ("trials", "random", "singles")
FAULTS = ("gear", "gear all", "harmonic", "coupling", "sag")


def fault_of(arm, name):
    """What puts a fault into a world, its amplitude, and what puts in each parameter of the true model."""
    s, e, j = arm.joints
    turning = tuple(i + 1 for i, kind in enumerate(arm.types) if kind == "R")
    phases = [partial(harmonic, joint=s, phase=p) for p in (0.0, 0.5 * np.pi)]
    return {
        "gear": (partial(curve, joints=(e,)), GEAR, [partial(curve, joints=(e,))]),
        "gear all": (partial(curve, joints=turning), GEAR, [partial(curve, joints=(i,)) for i in turning]),
        "harmonic": (partial(harmonic, joint=s), WAVE, phases),
        "coupling": (partial(coupling, joint=j - 1, to=j), COUPLED, [partial(coupling, joint=j - 1, to=j)]),
        "sag": (partial(sag, joints=turning), SAG, [partial(sag, joints=(i,)) for i in turning]),
        "none": (partial(sag, joints=()), 0.0, []),
    }[name]


class Job(NamedTuple):
    """A table."""

    fault: str
    arm: str
    design: str
    seed: int


def bound_px(setting, parameters, step=1e-5):
    """Bound of errors ahead, rms of marker and view, px, with parameters beside those of the model."""
    J, ahead = setting.derivative(), setting.derivative(held=True)
    for put in parameters:
        J = np.column_stack([J, setting.change(put, step) / step])
        ahead = np.column_stack([ahead, setting.change(put, step, held=True) / step])
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-9)
    _, s, Vt = np.linalg.svd(J / scale, full_matrices=False)
    kept = s > 1e-7 * s[0]
    factor = (ahead / scale) @ (Vt[kept].T / s[kept])
    return NOISE_PX * float(np.sqrt(2.0 * np.square(factor).sum() / len(factor)))


def judged(job):
    """Errors of both calibrations of a table, px: a row."""
    warnings.simplefilter("ignore")
    setting = Setting(job.arm, job.seed, design=job.design)
    put, amplitude, parameters = fault_of(setting.arm, job.fault)
    pixels, _ = with_corners(
        setting.arm, setting.q, setting.images(put, amplitude), "white", seeded(job.arm, job.seed, 1)
    )
    truth = setting.images(put, amplitude, held=True)
    seen = projservo.Observations.from_arrays(
        setting.q, pixels, joint_types=setting.arm.types, joint_unit="rad", image_size=IMAGE
    )
    row = job._asdict() | {"bound_px": bound_px(setting, parameters)}
    for name, asked in (("auto", "auto"), ("without", None)):
        try:
            found = projservo.calibrate(seen, joint_model=asked, progress=False)
        except (projservo.InputError, projservo.WorkFailed) as refused:
            row |= {f"{name}_refused": str(refused)}
            continue
        visible = inside(truth)[:, :, found.marker]
        error = (predict(found, setting.ahead) - truth[:, :, found.marker])[visible]
        row[f"{name}_px"] = float(np.sqrt(np.mean(np.nan_to_num((error**2).sum(axis=1), nan=BEHIND_PX**2))))
        row[f"{name}_stated_px"] = found.predicted_rms_px
        if asked is not None and found.joint_curve is not None:
            terms = found.joint_curve[:, :5].tolist()
            row["terms"] = "; ".join(
                f"{int(f)} {int(i)} {int(by)} {c:.3g} ± {d:.2g}" for f, i, by, c, d in terms
            )
    return row


def rms(rows, name):
    return float(np.sqrt(np.mean([row[name] ** 2 for row in rows])))


def tell(rows):
    """Print ratios by fault and arm."""
    for fault in dict.fromkeys(row["fault"] for row in rows):
        of_fault = [row for row in rows if row["fault"] == fault]
        for arm in ["all", *dict.fromkeys(row["arm"] for row in of_fault)]:
            every = [row for row in of_fault if arm in ("all", row["arm"])]
            some = [row for row in every if np.isfinite([row["auto_px"], row["without_px"]]).all()]
            lost = sum(bool(row["auto_refused"]) for row in every)
            # Each table in units of its bound, so that none outweighs the others.
            over = float(np.sqrt(np.mean([(r["auto_px"] / r["bound_px"]) ** 2 for r in some])))
            plain = float(np.sqrt(np.mean([(r["without_px"] / r["bound_px"]) ** 2 for r in some])))
            stated = quantiles([r["auto_px"] / r["auto_stated_px"] for r in some])
            more = rms(some, "auto_px") / rms(some, "without_px")
            print(
                f"{fault:9} {arm:6} {len(every):3d} tables, refused {lost}: over the bound {over:.3f}, "
                f"without {plain:.3f}, over that without {more:.3f}; curves in "
                f"{sum(bool(r['terms']) for r in some)}; true over stated {stated}"
            )


COLUMNS = (
    *(*Job._fields, "bound_px", "auto_px", "auto_stated_px", "without_px", "without_stated_px", "terms"),
    *("auto_refused", "without_refused"),
)


def main():
    """Calibrate the tables and print ratios."""
    numbers = [("seeds", SEEDS, "of each fault and arm"), ("jobs", 2, "number of processes")]
    parser = parser_of("joint_models_study", __doc__, numbers, faults=[*FAULTS, "none"], arms=ARMS)
    given = parser.parse_args()
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # of the processes to come
    jobs = [
        Job(fault, arm, design, FIRST + seed)
        for seed in range(given.seeds)
        for fault in given.faults
        for arm in given.arms
        for design in (DESIGNS if fault == "none" else [ARMS[arm].design])
    ]
    empty = dict.fromkeys(COLUMNS, np.nan) | {"terms": "", "auto_refused": "", "without_refused": ""}
    made = in_two_processes(judged, jobs, "tables", given.jobs)
    tell(written(given.output, COLUMNS, ([empty | row] for row in made)))


if __name__ == "__main__":
    main()
