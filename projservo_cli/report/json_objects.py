"""Objects of ``--json``: plain values of each stage, which the terminal and the page use too."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from projservo_cli.calibration.joint_model import describe_curve
from projservo_cli.findings import REFUSES, Finding, from_text, named, of_readings
from projservo_cli.messages import sentence, sentence_and_remedy, setup_of
from projservo_cli.planning.motion_margins import CONSTRAINTS, OF_MOTION
from projservo_cli.records import WHY_LOST, Calibration, CarriedByObject, StatedBoard, Trace, scalars_of
from projservo_cli.report.figure_inputs import PAGE_FILE
from projservo_cli.store.run_file import Run

# Names of the constraints whose smallest values along the planned motion are reported.
NEAREST = tuple(CONSTRAINTS[constraint].value for constraint in OF_MOTION)
# Lists of misfits: observations, and deviations from the model.
_LISTS = (
    *("outliers", "suspect_joint_readings", "id_switches", "moved_images", "turned_images"),
    *("model_errors", "refits"),
)
_COUNTS = ("poses_used", "markers_used")
_NUMBERS = (
    *("rms_px", "sigma_px", "chi2_per_dof", "seconds", "predicted_rms_px", "predicted_p99_px"),
    *("predicted_recorded_px", "predicted_worst_px"),
)

# Arrays of a calibration that are few numbers.
_SHORT_ARRAYS = (
    *("circular_joints", "undecided_order", "sigma_q_interval", "sigma_scale_interval", "sigma_view_px"),
    *("time_offset_s", "time_offset_interval_s", "time_offset_jitter_s"),
)


def stage_object(stage: str, run: Run, names: Sequence[str | None], laws: Sequence[str]) -> dict[str, Any]:
    """The JSON object of a stage that was made or is up to date.

    names : of the joints, if they have any; laws : names of their runs.
    """
    path = {"run": run.path.resolve()}
    if stage == "calibrate":
        return path | _calibration(run, names)
    if stage == "plan":
        parts = [name.removeprefix("plan/") for name in run.results if name.startswith("plan/")]
        if not parts:
            return path | _plan(run)
        plans = [{"step": part} | _plan(run.at_step(part)) for part in parts]
        wrong = [f"{plan['step']}: {plan['reason']}" for plan in plans if not plan["feasible"]]
        return path | {"feasible": not wrong, "reason": "; ".join(wrong), "plans": plans}
    if stage == "servo":
        return path | _laws(run, laws)
    page = run.path.parent / PAGE_FILE
    report = run.results["report"].records[""]
    return path | {"page": page.resolve() if page.is_file() else None} | scalars_of(report)


def failed_object(
    stage: str, run: Run, why: tuple[str, Iterable[Finding]], at: str, laws: Sequence[str]
) -> dict[str, Any]:
    """Return the JSON object of a stage that failed, or lacks its inputs; why : its reason and findings."""
    failure: dict[str, Any] = {"run": run.path.resolve(), "reason": why[0], "failed": at}
    failure["findings"] = list(why[1]) or [from_text(why[0], REFUSES)]
    if stage == "calibrate":
        lists: dict[str, Any] = {name: [] for name in ("advice", "joints", *_LISTS)}
        numbers = dict.fromkeys(_NUMBERS) | dict.fromkeys(_COUNTS, 0)
        return failure | {"usable": False, "lens": None, "rejected": None, "unshown": None} | numbers | lists
    if stage == "servo":
        return failure | _laws(run, laws)
    return failure | {"feasible": False} if stage == "plan" else failure


# Values of a trace that the list of steps repeats.
_OF_STEPS = ("verdict", "reason", "steps", "position_error_mm", "rotation_error_deg", "image_error_px")


def _laws(run: Run, laws: Sequence[str]) -> dict[str, Any]:
    """Plain values of runs of laws, of a sequence with its steps that were done or failed."""
    values = {law: _law(run.traces[law]) for law in laws}
    steps = []
    for name, result in run.results.items():
        stage, *of_step = name.split("/")
        if stage == "servo" and (action := result.records.get("action")) is not None:
            done = dict.fromkeys(_OF_STEPS) | {"verdict": "done", "reason": action.text, "steps": 0}
            steps.append({"name": of_step[0], "kind": action.kind, "seconds": action.seconds} | done)
        elif stage == "servo" and (law := "/".join(of_step)) in values and len(of_step) > 1:
            of_trace, trace = values[law], run.traces[law]
            seconds = trace.steps * trace.period
            at = {key: of_trace.get(key) for key in _OF_STEPS}
            steps.append({"name": of_step[0], "kind": "move", "seconds": seconds} | at)
            of_trace["step"] = of_step[0]
    return {"laws": list(values.values())} | ({"steps": steps} if steps else {})


# Numbers of a goal that was followed.
_FOLLOWED = (
    *("rms_px", "rms_mm", "max_mm", "rms_deg", "seconds", "speed_mm_s"),
    *("deviation_mm", "deviation_deg", "motion"),
)


def _law(trace: Trace) -> dict[str, Any]:
    """Plain values of the run of a law, with the errors of its incidences at the end."""
    values, found = scalars_of(trace), trace.of_incidences
    followed = {name: values.pop(f"followed_{name}") for name in _FOLLOWED}
    if trace.of_goal is not None:
        values["following"] = followed
    if found is None:
        return values
    units = "mm", "deg", "deviation_mm", "deviation_deg"
    left = [getattr(found, f"incidence_{unit}") for unit in units]
    known = [np.full(len(found.incidences), np.nan) if errors is None else errors for errors in left]
    rows = zip(
        found.incidences, found.incidence_px[-1].tolist(), *(one.tolist() for one in known), strict=True
    )
    keys = ("name", "error_px", "error_mm", "error_deg", "deviation_mm", "deviation_deg")
    return values | {"incidences": [dict(zip(keys, row, strict=True)) for row in rows]}


def _calibration(run: Run, names: Sequence[str | None]) -> dict[str, Any]:
    calibration, by_flange = run.calibration, run.calibration.flange_chart is not None
    joints = [
        {
            "name": (names[i] if i < len(names) else None) or f"q{i + 1}",
            "type": letter,
            "excitation": float(calibration.excitation[i]),
            "noise": float(calibration.prediction_noise[i]),
            "defect": float(calibration.operator_defect[i]),
            "poorly_observable": bool(calibration.poorly_observable[i]),
        }
        for i, letter in enumerate(calibration.joint_types)
    ]
    lens = None  # not estimated
    if calibration.lens is not None:
        terms = zip(calibration.view, calibration.lens.tolist(), strict=True)
        lens = {
            view: {"center_px": [u, v], "radius_px": r, "k1": k1, "k2": k2}
            for view, (u, v, r, k1, k2) in terms
        }
    held_out = {"cross_validation": scalars_of(run.cross_validation)} if run.cross_validation else {}
    values = scalars_of(calibration) | {name: getattr(calibration, name) for name in _SHORT_ARRAYS}
    del values["model_error"], values["unshown_error"]
    setup = setup_of(calibration)
    values["findings"] = [
        one.plain() | {"text": sentence_and_remedy(one, setup)} for one in calibration.findings
    ]
    of_refits = zip(
        values.pop("refit"),
        () if calibration.refits is None else calibration.refits.refit_numbers.tolist(),
        strict=True,
    )
    boards = () if calibration.boards is None else map(StatedBoard.of, calibration.boards.tolist())
    used = [(f"{one.columns}x{one.rows}", one.first) for one in boards]
    refuted = [one.subject for one in calibration.findings if one.code in ("unused_shape", "unplaced_board")]
    order, unshown = calibration.undecided_order, calibration.unshown
    values |= {
        "boards": [{"board": name, "first": first, "used": True} for name, first in used]
        + [{"board": one.name, "first": one.markers[0], "used": False} for one in refuted],
        "order_determined": None if order is None else not order.size,
        "model_errors": [_in_words(error, calibration) for error in calibration.model_errors],
        "unshown": None if unshown is None else _in_words(unshown, calibration),
        "refits": [
            {"view": view, "poses": round(poses), "error_px": now, "before_px": before}
            for view, (poses, now, before) in of_refits
        ],
    }
    if calibration.joint_curve is not None:
        values["joint_model"] = describe_curve(calibration)
    values |= {"readings": "flange" if by_flange else "joints", "joints": [] if by_flange else joints}
    return values | {"lens": lens} | findings(calibration) | held_out


def _in_words(one: Finding, calibration: Calibration) -> dict[str, Any]:
    """Fields of a deviation from the model, and a sentence; readings in rad (prismatic × 0.3 m/rad)."""
    estimate, deviation = of_readings(one)
    return {
        "kind": one.code,
        "joints": one.subject.joints,
        "view": "".join(one.subject.views),
        "estimate": estimate,
        "deviation": deviation,
        "effect_px": one.effect_px,
        "first": next(iter(one.subject.poses), None),
        "others": [named(other) for other in one.others],
        "text": sentence(one, setup_of(calibration)),
    }


# Name and numbers of an object that carries the goal of a plan.
_OF_CARRIER = [field.name for field in fields(CarriedByObject) if "dims" not in field.metadata]


def _plan(run: Run) -> dict[str, Any]:
    """Plain values of a plan, angles in deg, and the smallest margins along it."""
    plan, values = run.plan, scalars_of(run.plan)
    angles = {f"{name}_deg": math.degrees(values.pop(name)) for name in ("theta_r", "theta_p", "theta_s")}
    objects = {}
    for carried in plan.carried:
        of_object = {name.removeprefix("object_"): getattr(carried, name) for name in _OF_CARRIER[1:]}
        about = {"markers": carried.object_marker, "reason": carried.object_words}
        objects[carried.object_name] = of_object | about
    values = {name: value for name, value in values.items() if name not in _OF_CARRIER}
    nearest = zip(NEAREST, plan.min_margin, plan.min_margin_mu, strict=True)
    return (
        values
        | angles
        | {
            "objects": objects,
            "tau_0": plan.tau_0,
            "smallest_margin": plan.margin.min(axis=0),
            "margins": {name: {"min": lowest, "mu": mu} for name, lowest, mu in nearest},
        }
    )


def findings(calibration: Calibration) -> dict[str, Any]:
    """Single observations that do not fit, and how many do, as plain lists for people and JSON.

    calibration : the record.
    Returns ``outliers``, ``suspect_joint_readings``, ``id_switches``, ``moved_images``, ``turned_images``,
    ``poses_used``, ``markers_used``, and ``rejected`` by kind: counts of ``observations`` and of
    ``id_switches``, numbers of the ``tracks`` (markers) that are rejected as a whole by reason, of the
    ``poses`` and of ``unseen_poses``, and the count of ``placeholders``.
    """

    def rows(name: str) -> list[Any]:
        """Rows of an array of the calibration; none where it has none."""
        array = getattr(calibration, name)
        return [] if array is None else array.tolist()

    view = calibration.view
    of = (*view, "both" if len(view) == 2 else "all")
    outliers, suspects, swaps = rows("outlier"), rows("suspect"), rows("id_switches")
    lost = rows("rejected_markers")
    tracks = {why: [marker for marker, reason in lost if reason == code] for code, why in enumerate(WHY_LOST)}
    whole = {marker for marker, _ in lost}
    return {
        "outliers": [{"pose": p, "marker": m, "view": of[v]} for p, m, v in outliers],
        "suspect_joint_readings": [{"pose": p, "joint": j} for p, j in suspects],
        "id_switches": [{"pose": p, "markers": [a, b]} for p, a, b in swaps],
        "moved_images": [{"pose": p, "view": view[v]} for p, v in rows("moved_images")],
        "turned_images": [{"pose": p, "view": view[v]} for p, v in rows("turned_images")],
        "poses_used": calibration.poses_used,
        "markers_used": calibration.markers_used,
        "rejected": {
            "observations": sum(marker not in whole for _, marker, _ in outliers),
            "id_switches": len(swaps),
            "tracks": tracks,
            "poses": sorted({p for p, _ in suspects} | set(rows("rejected_poses"))),
            "unseen_poses": rows("unseen_poses"),
            "placeholders": calibration.placeholders,
        },
    }
