"""A report as one page of HTML that needs nothing else: no network, no scripts, no other file."""

import json
import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from projservo_cli.calibration.checks.observability_and_verdict import WEAK_NOISE
from projservo_cli.calibration.robust_fit import chi2_band
from projservo_cli.findings import REACH_M, REACH_RAD
from projservo_cli.laws import must_converge, run_name
from projservo_cli.messages.verdict_causes import arrived
from projservo_cli.records import Plan, Report
from projservo_cli.report.figure_inputs import ANIMATION_FILE, PAGE_FILE, VIEW_FILE, FigureSpec, title
from projservo_cli.report.figures import FIGURES
from projservo_cli.report.figures.path_deviation import drift_rows
from projservo_cli.report.html import embedded, html_page, short
from projservo_cli.report.json_objects import stage_object
from projservo_cli.report.style import FORMATS
from projservo_cli.store.display import About
from projservo_cli.store.files_and_locks import lies_inside, write_whole
from projservo_cli.store.run_file import Run


def _calibration_words(values: Mapping[str, Any], *, estimated: bool) -> Iterator[str]:
    """Whether a calibration is good, why, and which joint is known worst, a sentence each.

    ``estimated`` says that the noise was estimated from the same images, so that χ² alone decides nothing.
    """
    yield f"{'Usable' if values['usable'] else 'Not usable'}: {values['reason']}."
    if math.isfinite(values["chi2_per_dof"]) and values["dof"] > 0:
        low, high = (short(bound) for bound in chi2_band(values["dof"]))
        chi2, sigma = short(values["chi2_per_dof"]), short(values["sigma_px"])
        yield (
            f"χ² per degree of freedom is {chi2} at {sigma} px of noise per coordinate, with {values['dof']} "
            f"degrees of freedom; where model and noise are true it stays within {low} and {high}."
            + (" The noise is itself an estimate from these images." if estimated else "")
        )
    if values["joints"]:
        yield _worst_joint(values)
    if "cross_validation" in values:
        held_out = values["cross_validation"]
        names = ("rms_px", "predicted_rms_px", "median_px", "p95_px")
        rms, predicted, median, p95 = (short(held_out[name]) for name in names)
        yield (
            f"Held out, in {held_out['folds']} parts of {held_out['unit']}: rms {rms} px where noise and "
            f"covariance predict {predicted} px, median {median} px, 95th percentile {p95} px. "
            f"{held_out['reason'][:1].upper()}{held_out['reason'][1:].rstrip('.')}."
        )


def _worst_joint(values: Mapping[str, Any]) -> str:
    """Name the joint that adds most to predicted images, and whether it is well observable."""
    joints = values["joints"]
    noise, worst = max((joint["noise"], i) for i, joint in enumerate(joints))
    reach = f"{REACH_M:g} m" if joints[worst]["type"] == "P" else f"{REACH_RAD:g} rad"
    return (
        f"Joint {worst + 1} is known worst: {reach} from the reference it adds {short(noise)} times the "
        f"pixel noise to predicted images; a joint is poorly observable above {WEAK_NOISE:g}, so this one is "
        f"{'poorly observable' if noise > WEAK_NOISE else 'well observable'}."
    )


def _law_words(trace: Mapping[str, Any]) -> str:
    """Verdict of a law and its reason, in one sentence."""
    steps, reason = trace["steps"], trace["reason"]
    took = f"{steps} step{'s' * (steps != 1)} ({short(steps * trace['period'])} s)"
    why = f": {reason}" if reason else ""
    return f"{title(run_name(trace['law'], trace['mode']))}: {trace['verdict']} after {took}{why}."


_SECTIONS = ("calibration", "metric", "plan", "control")
_MOST_BYTES = 20_000_000  # limit of a file; figures have about 100,000
_TYPES = {"svg": "image/svg+xml", "png": "image/png"}  # that a page can show, the best first


class _Picture(NamedTuple):
    """One figure, and the (label, path) of its files; no drawing if there is no file a page can show."""

    anchor: str  # its name within the page
    number: str  # as in the names of its files
    spec: FigureSpec
    drawing: str | None  # its address
    links: tuple[tuple[str, str], ...]


def _pictures(directory: Path, files: Sequence[str], folder: str, prefix: str) -> dict[str, list[_Picture]]:
    """Figures by section, of the files that the report wrote; ``prefix`` is of all names within the page."""
    by_section: dict[str, list[_Picture]] = {section: [] for section in _SECTIONS}
    for spec in FIGURES:
        paths = {kind: f"figures/{spec.name}.{kind}" for kind in ("csv", *FORMATS)}
        kinds = [kind for kind in FORMATS if paths[kind] in files]
        if not kinds:
            continue
        images = (_drawing(directory / paths[kind], kind) for kind in _TYPES if kind in kinds)
        drawing = next((image for image in images if image is not None), None)
        links = [(kind.upper(), folder + paths[kind]) for kind in kinds]
        if (directory / paths["csv"]).is_file():
            links.insert(0, ("numbers (CSV)", folder + paths["csv"]))
        number = str(int(spec.name[3:5]))
        by_section[spec.section].append(_Picture(prefix + spec.name, number, spec, drawing, tuple(links)))
    return by_section


def _drawing(path: Path, kind: str) -> str | None:
    """Address of a figure within the page; None if there is no file in the folder of the run."""
    try:
        content = path.read_bytes() if lies_inside(path, path.parents[1]) else None
    except OSError:
        content = None
    if content is None or len(content) > _MOST_BYTES:
        return None
    return embedded(content, _TYPES[kind])


# Files next to the page, and their labels.
_EXTRAS = {VIEW_FILE: "3D view with a time slider", ANIMATION_FILE: "animation of both camera images (GIF)"}
# Key in the provenance, and its label on the page.
_MADE = {"date": "date", "argv": "command", "projservo": "projservo", "git_commit": "commit"}
_MADE |= {"host": "host", "system": "system", "cpu": "processor"}
_VERSIONS = ("python", "numpy", "scipy", "numba", "llvmlite", "h5py", "matplotlib")


def _view(run: Run, about: About, *, folder: str = "", prefix: str = "") -> dict[str, Any]:
    """Return the page's data of a run in a ``folder``, relative to the page; ``prefix`` precedes its names.

    Parts that are missing are empty or None.
    """
    run_folder = run.path.parent
    stages = {name.split("/")[0] for name in run.results}
    values = {stage: stage_object(stage, run, about.joints, list(run.traces)) for stage in stages}
    report: Report | None = run.results["report"].records[""] if "report" in stages else None
    left_out: dict[str, list[str]] = {}
    for entry in report.omitted if report else ():
        left_out.setdefault(entry["reason"], []).append(entry["what"])
    return {
        "name": about.name,
        "folder": folder,
        "configuration": about.configuration,
        "made": list(_made(run, about)),
        "extras": [
            (label, folder + name) for name, label in _EXTRAS.items() if (run_folder / name).is_file()
        ],
        "calibration": _calibration(values["calibrate"], about) if "calibrate" in values else None,
        "plan": values["plan"] | _visibility(run.plan) if "plan" in run.results else None,
        "laws": [_law(trace, about) for trace in values["servo"]["laws"]] if "servo" in values else [],
        "reported": report is not None,
        "claims": report.claims if report else (),
        "metric": report.metric if report else (),
        "drift": _drift(report) if report else None,
        "left_out": left_out,
        "pictures": _pictures(run_folder, report.figures if report else (), folder, prefix),
    }


def _made(run: Run, about: About) -> Iterator[tuple[str, str]]:
    """Return the provenance of a run; a value that differs between stages is listed with its stages."""
    yield "configuration", f"{about.name}, {'recorded' if about.recorded else 'simulated'}"
    yield "seed", str(about.seed)
    inputs = {key: text for result in run.results.values() for key, text in result.inputs.items()}
    for key, text in inputs.items():
        yield key.replace("_sha256", " sha256"), text
    for key, label in (*_MADE.items(), ("", "versions")):
        by_value: dict[str, list[str]] = {}
        for name, result in run.results.items():
            if value := _provenance_text(key, result.provenance):
                by_value.setdefault(value, []).append(name.split("/")[0])
        for value, names in by_value.items():
            yield label, value if len(by_value) == 1 else f"{value} ({', '.join(dict.fromkeys(names))})"


def _provenance_text(key: str, provenance: Mapping[str, Any]) -> str:
    """One property of the origin of a result, in words; the versions if there is no key."""
    if not key:
        return ", ".join(
            f"{package} {provenance[package]}" for package in _VERSIONS if provenance.get(package)
        )
    value = provenance.get(key)
    if key == "argv" and value:
        return " ".join(["projservo", *value[1:]])
    if key == "date" and value:
        moment = datetime.fromisoformat(value)
        return f"{moment.astimezone(UTC):%Y-%m-%d %H:%M} UTC" if moment.tzinfo else str(value)
    if key == "git_commit" and value:
        return f"{value}{', with changes' if provenance.get('git_dirty') else ''}"
    return "" if value is None else str(value)


def _calibration(values: dict[str, Any], about: About) -> dict[str, Any]:
    """Plain values of a calibration with its sentences."""
    return values | {"words": list(_calibration_words(values, estimated=about.estimates_noise))}


def _visibility(plan: Plan) -> dict[str, Any]:
    """Return the minimum visibility of each camera and its changes; both senses of the rotation."""
    lowest = plan.margin.argmin(axis=0)
    views = [
        {
            "name": name,
            "margin": float(plan.margin[lowest[v], v]),
            "sigma": float(plan.path_parameter[lowest[v]]),
            "tau_0": float(plan.tau_0[v] / plan.tau) if plan.tau > 0 else None,
            "theta_0": np.degrees(plan.theta_0[v]).tolist(),
            "sense_margins": plan.sense_margin[:, v].tolist(),
        }
        for v, name in enumerate(plan.view)
    ]
    return {"views": views, "senses": np.degrees(plan.sense).tolist()}


def _law(trace: dict[str, Any], about: About) -> dict[str, Any]:
    """Plain values of the run of a law, with its title, words on it, and whether it was to converge."""
    return trace | {
        "title": title("/".join(filter(None, (trace.get("step"), run_name(trace["law"], trace["mode"]))))),
        "words": _law_words(trace),
        "converged": arrived(trace["verdict"]),
        "must": must_converge(trace["law"], about.required),
        "hidden": tuple(trace[f"self_occluded_steps_{view}"] for view in trace["view"]),
    }


def _drift(report: Report) -> dict[str, Any] | None:
    """The drift table: a row for law, operators and limit, a column for each gain."""
    if not report.path_deviation_mm.size:
        return None
    rows: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in drift_rows(report):
        rows.setdefault((title(row["law"]), row["operators"], row["limit_deg_per_step"]), []).append(row)
    return {"gains": report.gain_per_step.tolist(), "rows": rows}


def _differences(settings: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[str]]]:
    """Settings in which runs differ: the key, and the value of each run; empty if it lacks the key."""
    flat = [dict(_leaves("", of_run)) for of_run in settings]
    keys = dict.fromkeys(key for of_run in flat for key in of_run)
    rows = [(key, [of_run.get(key, "") for of_run in flat]) for key in keys]
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


def _side_by_side(columns: Iterable[Iterable[Any]], key: Callable[[Any], Any]) -> dict[Any, list[Any]]:
    """Return the entries of several runs by a key: one for each run, None if it has none."""
    columns = list(columns)
    rows: dict[Any, list[Any]] = {}
    for k, column in enumerate(columns):
        for item in column:
            rows.setdefault(key(item), [None] * len(columns))[k] = item
    return rows


def write_page(run: Run, about: About) -> Path:
    """Write the page of a run into its folder, from the run and the figures that lie there.

    Raises InputError if the page cannot be written.
    """
    path = run.path.parent / PAGE_FILE
    _write(path, [_view(run, about)], [])
    return path


def write_comparison(
    runs: Sequence[tuple[Run, About]], settings: Sequence[Mapping[str, Any]], path: Path
) -> None:
    """Write one page that shows runs side by side; their figures are read from their folders.

    settings : of the configuration of each run.
    Raises InputError if the page cannot be written.
    """
    base, views = path.parent.resolve(), []
    for k, (run, about) in enumerate(runs, 1):
        folder = Path(os.path.relpath(run.path.parent.resolve(), base)).as_posix()
        views.append(_view(run, about, folder=f"{folder}/", prefix=f"run{k}-"))
    shared = Counter(view["name"] for view in views)
    for view in views:
        if shared[view["name"]] > 1:
            view["name"] += f" ({view['folder'][:-1]})"
    _write(path, views, settings)


def _write(path: Path, views: list[dict[str, Any]], settings: Sequence[Mapping[str, Any]]) -> None:
    """Write a page of runs, with their claims and figures side by side."""
    claims = _side_by_side((view["claims"] for view in views), itemgetter("claim", "source", "criterion"))
    pictures = {}
    for section in _SECTIONS:
        numbered = _side_by_side((view["pictures"][section] for view in views), attrgetter("number"))
        pictures[section] = [numbered[number] for number in sorted(numbered, key=int)]
    text = html_page(
        "page.html", views=views, claims=claims, differences=_differences(settings), pictures=pictures
    )
    write_whole(path, text)
