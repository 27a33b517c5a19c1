"""What the page shows of a run: plain values, in the order in which they are shown."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from projservo_cli.config import Config, load_config
from projservo_cli.figures.drift import drift_rows
from projservo_cli.figures.material import VIEWS, title
from projservo_cli.modes import name_of
from projservo_cli.page.pictures import SECTIONS, Picture, pictures
from projservo_cli.page.words import calibration_words, held_out_words, law_words
from projservo_cli.records import Calibration, Plan, Report, Trace
from projservo_cli.store import Run

VIEW_FILE, ANIMATION_FILE = "view.html", "animation.gif"
# What may lie beside the page, and what the page calls it.
_EXTRAS = {VIEW_FILE: "3D view with a time slider", ANIMATION_FILE: "animation of both camera images (GIF)"}
# What made a run: key in the provenance, and what the page calls it.
_MADE = {
    "date": "date",
    "argv": "command",
    "projservo": "projservo",
    "git_commit": "commit",
    "host": "host",
    "system": "system",
    "cpu": "processor",
}
_VERSIONS = ("python", "numpy", "scipy", "numba", "llvmlite", "h5py", "matplotlib")


@dataclass(frozen=True)
class View:
    """One run as the page shows it; what it lacks is empty or None.

    Attributes
    ----------
    name : of its configuration.
    folder : of the run, relative to the page.
    config : settings, and ``configuration`` the same as YAML with all defaults.
    made : (property, value) of what the run was made with.
    calibration, plan, laws : of each stage.
    claims, drift, left_out : of the report; what was left out for each reason.
    pictures : the figures by section.
    extras : (label, path) of what lies beside the page.
    """

    name: str
    folder: str
    config: Config
    configuration: str
    made: list[tuple[str, str]]
    calibration: dict[str, Any] | None = None
    plan: dict[str, Any] | None = None
    laws: list[dict[str, Any]] = field(default_factory=list)
    claims: tuple[dict[str, Any], ...] = ()
    drift: dict[str, Any] | None = None
    left_out: dict[str, list[str]] = field(default_factory=dict)
    reported: bool = False
    pictures: dict[str, list[Picture]] = field(default_factory=lambda: {name: [] for name in SECTIONS})
    extras: tuple[tuple[str, str], ...] = ()


def view_of(run: Run, *, folder: str = "", prefix: str = "") -> View:
    """What the page shows of a run.

    Parameters
    ----------
    run : the run; its figures are read from its folder.
    folder : of the run as seen from the page, empty or ending in a slash.
    prefix : of all names within the page, where it shows several runs.

    Raises
    ------
    InputError
        If the stored configuration cannot be read.
    """
    config = load_config(run.path, text=run.configuration)
    report: Report | None = run.results["report"].records[""] if "report" in run.results else None
    shown = View(
        config.name,
        folder,
        config,
        run.configuration,
        list(_made(run, config)),
        calibration=_calibration(run, config) if "calibrate" in run.results else None,
        plan=_plan(run.plan) if "plan" in run.results else None,
        laws=[_law(trace, config) for trace in run.traces.values()],
        extras=tuple(
            (label, folder + name) for name, label in _EXTRAS.items() if (run.path.parent / name).is_file()
        ),
    )
    if report is None:
        return shown
    return replace(
        shown,
        claims=report.claims,
        drift=_drift(report),
        left_out=_by_reason(report.left_out),
        reported=True,
        pictures=pictures(run.path.parent, report.figures, folder, prefix),
    )


def _by_reason(left_out: Sequence[Mapping[str, str]]) -> dict[str, list[str]]:
    """What was left out, gathered for each reason."""
    gathered: dict[str, list[str]] = {}
    for entry in left_out:
        gathered.setdefault(entry["reason"], []).append(entry["what"])
    return gathered


def _made(run: Run, config: Config) -> Iterator[tuple[str, str]]:
    """What was run, from what and with what; a value that stages differ in stands with its stages."""
    yield "configuration", f"{config.name}, {'recorded' if config.recorded else 'simulated'}"
    yield "seed", str(config.seed)
    inputs = {key: text for result in run.results.values() for key, text in result.inputs.items()}
    for key, text in inputs.items():
        yield key.replace("_", " "), text
    stages = {name: result.provenance for name, result in run.results.items()}
    for key, label in _MADE.items():
        yield from _values(label, {name: _told(key, made) for name, made in stages.items()})
    versions = {
        name: ", ".join(f"{package} {made[package]}" for package in _VERSIONS if made.get(package))
        for name, made in stages.items()
    }
    yield from _values("versions", versions)


def _told(key: str, made: Any) -> str:
    value = made.get(key)
    if value is None:
        return ""
    if key == "argv":
        return " ".join(["projservo", *value[1:]])
    if key == "date":
        moment = datetime.fromisoformat(value)
        return f"{moment.astimezone(UTC):%Y-%m-%d %H:%M} UTC" if moment.tzinfo else str(value)
    if key == "git_commit":
        return f"{value}{', with changes' if made.get('git_dirty') else ''}"
    return str(value)


def _values(label: str, told: dict[str, str]) -> Iterator[tuple[str, str]]:
    by_value: dict[str, list[str]] = {}
    for name, value in told.items():
        if value:
            by_value.setdefault(value, []).append(name.split("/")[0])
    for value, names in by_value.items():
        yield label, value if len(by_value) == 1 else f"{value} ({', '.join(dict.fromkeys(names))})"


def _calibration(run: Run, config: Config) -> dict[str, Any]:
    calibration, held_out = run.calibration, run.cross_validation
    words = calibration_words(calibration, estimated=config.data is not None and config.data.noise_px is None)
    given = config.robot.joints if config.robot is not None else ()
    joints = []
    for i, letter in enumerate(calibration.joint_types):
        span = float(calibration.excitation[i])
        joints.append(
            {
                "name": (given[i].name if i < len(given) else None) or f"q{i + 1}",
                "type": "prismatic" if letter == "P" else "revolute",
                "excitation": 1e3 * span if letter == "P" else math.degrees(span),
                "unit": " mm" if letter == "P" else "°",
                "noise": float(calibration.prediction_noise[i]),
                "defect": float(calibration.operator_defect[i]),
                "weak": bool(calibration.weak[i]),
            }
        )
    return {
        "usable": calibration.usable,
        "words": words if held_out is None else [*words, held_out_words(held_out)],
        "advice": calibration.advice,
        "numbers": [
            ("method", calibration.method, ""),
            ("source", calibration.source, ""),
            ("residual, rms per marker and view", calibration.rms_px, "px"),
            ("noise per coordinate, as taken", calibration.sigma_px, "px"),
            ("noise per coordinate, from the residuals", calibration.sigma_fitted_px, "px"),
            ("χ² per degree of freedom", calibration.chi2_per_dof, ""),
            ("degrees of freedom", calibration.dof, ""),
            ("poses", calibration.merged_poses, ""),
            ("markers", calibration.merged_markers, ""),
            *_lens(calibration),
            ("time", calibration.seconds, "s"),
        ],
        "joints": joints,
    }


def _lens(calibration: Calibration) -> Iterator[tuple[str, float, str]]:
    """Coefficients of radial distortion, where they were estimated."""
    for name, lens in zip(VIEWS, [] if calibration.lens is None else calibration.lens, strict=False):
        for k in (1, 2):
            yield f"lens of the {name} camera, k{k}", float(lens[2 + k]), ""


def _plan(plan: Plan) -> dict[str, Any]:
    views = []
    for v, name in enumerate(VIEWS):
        least = int(np.argmin(plan.margin[:, v]))
        views.append(
            {
                "name": name,
                "margin": float(plan.margin[least, v]),
                "sigma": float(plan.sigma[least]),
                "tau_0": float(plan.tau_0[v] / plan.tau) if plan.tau > 0 else None,
                "theta_0": [math.degrees(angle) for angle in plan.theta_0[v]],
            }
        )
    senses = [
        {"theta": math.degrees(angle), "margins": [float(value) for value in margins]}
        for angle, margins in zip(plan.sense, plan.sense_margin, strict=True)
    ]
    return {
        "feasible": plan.feasible,
        "profile": plan.profile.replace("_", " "),
        "reason": plan.reason,
        "theta_r": math.degrees(plan.theta_r),
        "theta_p": math.degrees(plan.theta_p),
        "theta_s": math.degrees(plan.theta_s),
        "views": views,
        "senses": senses,
    }


def _law(trace: Trace, config: Config) -> dict[str, Any]:
    return {
        "title": title(name_of(trace.law, trace.mode)),
        "words": law_words(trace),
        "trace": trace,
        "converged": trace.verdict == "converged",
        "must": trace.law in config.control.must_converge,
    }


def _drift(report: Report) -> dict[str, Any] | None:
    """The drift table: a row for law, operators and limit, a column for each gain."""
    if not report.drift_mm.size:
        return None
    rows: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in drift_rows(report):
        rows.setdefault((row["law"], row["operators"], row["limit_deg_per_step"]), []).append(row)
    return {
        "gains": [float(gain) for gain in report.gain_per_step],
        "rows": [
            {"law": title(law), "operators": operators, "limit": limit, "cells": cells}
            for (law, operators, limit), cells in rows.items()
        ],
    }


def differences(views: list[View]) -> list[tuple[str, list[str]]]:
    """Settings in which runs differ: the key, and what each run has; empty where it lacks the key."""
    flat = [dict(_leaves("", view.config.model_dump(mode="json", exclude_none=True))) for view in views]
    keys = dict.fromkeys(key for settings in flat for key in settings)
    rows = [(key, [settings.get(key, "") for settings in flat]) for key in keys]
    return [(key, values) for key, values in rows if len(set(values)) > 1]


def _leaves(path: str, value: Any) -> Iterator[tuple[str, str]]:
    """Every value by its key, with positions for lists of mappings; other lists stay whole."""
    if isinstance(value, list) and any(isinstance(inner, dict) for inner in value):
        value = {str(position): inner for position, inner in enumerate(value)}
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(f"{path}.{key}" if path else key, inner)
    else:
        yield path, value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def picture_rows(views: list[View]) -> dict[str, list[list[Picture | None]]]:
    """Figures by section, a row for each, an entry for each run; None where a run lacks it."""
    rows: dict[str, list[list[Picture | None]]] = {}
    for section in SECTIONS:
        numbered = [{picture.number: picture for picture in view.pictures[section]} for view in views]
        names = sorted({number for own in numbered for number in own}, key=int)
        rows[section] = [[own.get(number) for own in numbered] for number in names]
    return rows


def claim_rows(views: list[View]) -> list[dict[str, Any]]:
    """Claims of all runs: what is claimed, where, when it holds, and what each run measured."""
    rows: dict[tuple[str, str, str], dict[str, Any]] = {}
    for v, view in enumerate(views):
        for claim in view.claims:
            key = (claim["claim"], claim["source"], claim["criterion"])
            row = rows.setdefault(key, {**claim, "runs": [None] * len(views)})
            row["runs"][v] = claim
    return list(rows.values())
