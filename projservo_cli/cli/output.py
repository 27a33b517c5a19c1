"""Data on standard output, in JSON or in words; messages and progress on standard error."""

import json
import math
import re
import sys
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import click

from projservo_cli.chain.progress import Listener
from projservo_cli.passwords import masked

_UNSEEN = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_MEASURED = {  # words for the image features of runs
    "body": "all markers",
    "points": "those of the face alone",
}
_NOTES = {  # on runs, and their reasons
    "unplanned": "driven without a plan",
    "untested": "images were not tested against the calibration",
}


def wrapped(text: str, indent: str = "") -> str:
    """Text in lines of at most 80 columns; words longer than that stay whole."""
    return textwrap.fill(
        text,
        80,
        initial_indent=indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def visible(text: str) -> str:
    """Text without passwords, whose control characters and changes of direction are written out.

    Texts come from files of others too; a terminal that is sent them must not obey them.
    """
    return _UNSEEN.sub(lambda found: f"\\u{ord(found[0]):04x}", masked(text))


class Console(Listener):
    """Messages at the level of the user, and a progress bar in a terminal."""

    def __init__(self, *, quiet: bool = False, verbose: bool = False, as_json: bool = False) -> None:
        super().__init__()
        self.quiet = quiet
        self.verbose = verbose
        self.as_json = as_json
        self._data = sys.stdout  # output of other code during a command goes elsewhere

    def report(self, value: dict[str, Any], lines: Iterable[str]) -> None:
        """Data on standard output: one object of strict JSON in UTF-8 in any locale, or words."""
        if self.as_json:
            from projservo_cli.store.display import plain

            text = visible(
                json.dumps(plain(value, finite=True), ensure_ascii=False, allow_nan=False, indent=2)
            )
            self._data.buffer.write(f"{text}\n".encode())
        elif not self.quiet:
            for line in lines:
                click.echo(visible(line), file=self._data)

    def say(self, text: str) -> None:
        """A message on standard error."""
        if not self.quiet:
            self._bar.say(wrapped(visible(text)))

    def detail(self, text: str) -> None:
        """A message that only -v shows."""
        if self.verbose:
            self.say(text)

    def confirm(self, command: str, plant: Any) -> None:
        """Ask before the first motion of a ``plant``; a KeyboardInterrupt if the answer is not yes."""
        driven = plant.use or "the simulated robot"
        if not self.agreed(f"{command} will move {driven}, speeds times {plant.speed_scale:g}. Go?"):
            self.say("not confirmed: nothing was moved")
            raise KeyboardInterrupt

    def agreed(self, question: str) -> bool:
        """Ask the user at the terminal, and return whether the answer is yes."""
        self._bar.close()
        try:
            return click.confirm(question, err=True)
        except click.Abort:
            return False

    def wait(self, text: str) -> None:
        """Ask the user to act, and wait for the Enter key. Raises InputError if there is no terminal."""
        self._bar.close()
        click.echo(wrapped(f"{text}, then press Enter"), err=True)
        if sys.stdin.readline() == "":
            from projservo_cli.records import InputError

            raise InputError("standard input ended before Enter was pressed: run this at a terminal")

    def progress(self, what: str, done: int, total: int, note: str = "") -> None:
        """Move a progress bar; a line a minute where standard error is not a terminal."""
        if not self.quiet:
            self._bar(what, done, total, note)


def words_of(stage: str, value: dict[str, Any], *, detailed: bool = False) -> Iterator[str]:
    """Lines on the object of a stage or the report of a ``sweep``; ``detailed`` with claims and margins."""
    if "failed" in value:  # the reason is printed with the exit code
        yield f"{stage}: {'failed' if value['failed'].split('/')[0] == stage else 'not made'}"
        return
    of_stage = {
        "record": _of_recording,
        "calibrate": _of_calibration,
        "plan": _of_plan,
        "servo": _of_laws,
        "sweep": _of_sweep,
        "report": _of_report,
    }
    yield from of_stage[stage](value, detailed)


def _of_recording(value: dict[str, Any], _: bool) -> Iterator[str]:
    yield (
        "record: {recorded} poses recorded, {found} there before, {pending} to be recorded; "
        "{markers} markers".format_map(value)
    )
    yield "  unseen: {unseen} marker-view pairs; {commands} commands sent".format_map(value)
    if value["spread_px"] is not None:
        yield "  spread of the images of a pose: {spread_px:.3g} px per coordinate".format_map(value)


def _of_calibration(value: dict[str, Any], detailed: bool) -> Iterator[str]:
    px, bound = (_number(value[f"predicted_{name}_px"]) for name in ("rms", "p99"))
    asked = (
        detailed
        or value["lens"]
        or (value.get("joint_model") and value["readings"] != "flange")
        or value.get("cross_validation")
        or len(value["joints"]) == 1
        or value["predicted_rms_px"] is None
    )
    if asked:
        yield from _in_detail(value)
    else:
        notes = len(value["notes"]) + (value["unshown"] is not None)
        more = f"{notes} note{'s' * (notes > 1)} and more: -v" if notes else "more: -v"
        found = f"predicts images to {px} px rms, 99 % below {bound}; {more}"
        usable = value["usable"]
        yield wrapped(f"calibrate: {f'usable: {found}' if usable else 'NOT usable: ' + value['reason']}")
        limits = [one["text"] for one in value["findings"][:1] if usable and one["severity"] == "limits"]
        refusing = [one["text"] for one in value["findings"] if one["severity"] == "refuses"]
        for text in limits + [text for text in value["advice"] if text not in value["notes"]]:
            yield wrapped(f"{'refused' if text in refusing else 'limits'}: {text}", "  ")
        if value["time_offset_s"] is not None:
            yield wrapped(f"time offset {', '.join(_time_offsets(value))}", "  ")
    where = " on the tool" if value["mount"] == "tool" else ""
    if where or list(value["view"]) != ["left", "right"]:
        views = value["view"]
        count = "one camera" if len(views) == 1 else f"{len(views)} cameras"
        yield wrapped(f"by {count}{where}: {', '.join(views)}", "  ")
    for one in value["refits"]:
        yield wrapped(
            "{view} fitted again by {poses} poses: errs by {error_px:.3g} px within the joint ranges, "
            "{before_px:.3g} px before it moved".format_map(one),
            "  ",
        )
    yield from _of_suggestions(value)


def _in_detail(value: dict[str, Any]) -> Iterator[str]:
    yield wrapped(f"calibrate: {'usable' if value['usable'] else 'NOT usable'}: {value['reason']}")
    for text in value["advice"]:
        yield wrapped(f"advice: {text}", "  ")
    yield (
        f"  residual {value['rms_px']:.4g} px per point, sigma {value['sigma_px']:.4g} px per coordinate, "
        f"chi2/dof {value['chi2_per_dof']:.4g}, {value['seconds']:.1f} s"
    )
    if value["sigma_view_px"] is not None:
        each = zip(value["view"], value["sigma_view_px"], strict=True)
        yield wrapped(f"noise px: {', '.join(f'{view} {_number(sigma)}' for view, sigma in each)}", "  ")
    for view, terms in (value["lens"] or {}).items():  # at the radius of the view, half the image size
        yield (
            f"  lens {view}: k1 {terms['k1']:.3g}, k2 {terms['k2']:.3g} at {terms['radius_px']:.4g} px from "
            f"({terms['center_px'][0]:.4g}, {terms['center_px'][1]:.4g})"
        )
    for term in value.get("joint_model", ()):
        yield wrapped(f"joint model: {term['text']}", "  ")
    for term in value.get("joint_model", ())[:1]:
        errors = _number(term["left_out_without_px"]), _number(term["left_out_px"])
        yield "  left-out poses: {} px without, {} px with it".format(*errors)
    if value["sigma_q"] is not None:
        of_what = "poses of the flange" if value["readings"] == "flange" else "joint readings"
        yield wrapped(f"{of_what}: {_joint_noise(value)}", "  ")
    if value["time_offset_s"] is not None:
        yield wrapped(f"time offset {', '.join(_time_offsets(value))}", "  ")
    poorly = ", ".join(joint["name"] for joint in value["joints"] if joint["poorly_observable"])
    if poorly:
        yield wrapped(f"poorly observable joints: {poorly}", "  ")
    for text in _rejected(value):
        yield wrapped(f"rejected: {text}", "  ")
    if len(value["joints"]) == 1:
        yield wrapped(_ONE_JOINT, "  ")
    if value["predicted_rms_px"] is not None:
        rms, bound = _number(value["predicted_rms_px"]), _number(value["predicted_p99_px"])
        text = f"predicted error within the ranges of the joints: {rms} px rms, 99 % below {bound} px"
        if value["unshown"]:
            worst, cause = _number(value["predicted_worst_px"]), value["unshown"]["text"]
            text += f"; up to {worst} px if {cause}, which these poses do not show"
        if value["predicted_recorded_px"] is not None:
            text += f"; at poses like those recorded {_number(value['predicted_recorded_px'])} px rms"
        yield wrapped(text, "  ")
    if held_out := value.get("cross_validation"):
        numbers = ("rms_px", "median_px", "p95_px", "predicted_rms_px")
        rms, median, p95, predicted = (_number(held_out[name]) for name in numbers)
        text = f"held out, {held_out['folds']} parts of {held_out['unit']}: rms {rms} px"
        yield wrapped(f"{text} (predicted {predicted}), median {median}, p95 {p95}", "  ")
        parts = []
        for name in ("posture", "time"):
            rms, predicted = (_number(held_out[f"{name}_{key}_px"]) for key in ("rms", "predicted"))
            parts.append(f"of {name} rms {rms} px (predicted {predicted})")
        yield wrapped(f"in blocks {', '.join(parts)}", "  ")
        yield wrapped(held_out["reason"], "  ")


_ONE_JOINT = "one joint: how it moves images is known; directions and lengths in space take more joints"
_NO_LIMITS = (
    "no joint limits are known here: give them with -c or robot.limits, or leave out what your robot cannot "
    "reach"
)
_EXAMPLES = 3  # number of examples for each kind of rejected observations


def _rejected(value: dict[str, Any]) -> Iterator[str]:
    """Rejected observations of a calibration: of each kind how many, and the first of them."""
    counts = value["rejected"]
    whole = {number for numbers in counts["tracks"].values() for number in numbers}
    single = [
        f"marker {one['marker']} at pose {one['pose']}"
        + ("" if one["view"] in ("both", "all") else f" {one['view']}")
        for one in value["outliers"]
        if one["marker"] not in whole
    ]
    if single:
        yield _counted(single, "outlier")
    for why, numbers in counts["tracks"].items():
        if numbers:
            yield _counted([str(number) for number in numbers], "marker", f", {why}")
    if value["id_switches"]:
        swaps = [
            "{} under the number of {} at pose {}".format(*reversed(one["markers"]), one["pose"])
            for one in value["id_switches"]
        ]
        yield _counted(swaps, "ID switch")
    suspect = {one["pose"]: one["joint"] for one in value["suspect_joint_readings"]}
    if poses := counts["poses"]:
        named = [f"{pose} by joint {suspect[pose]}" if pose in suspect else str(pose) for pose in poses]
        yield _counted(named, "pose", " with joint readings that disagree")


def _counted(found: Sequence[str], kind: str, what: str = "") -> str:
    """Count a kind, with its first examples."""
    more = ", …" if len(found) > _EXAMPLES else ""
    return f"{len(found)} {kind}{'s' * (len(found) > 1)}{what} ({', '.join(found[:_EXAMPLES])}{more})"


def _joint_noise(value: dict[str, Any]) -> str:
    """Describe the noise of joint readings, in degrees (prismatic joints × 0.3 m/rad)."""
    sigma, interval = math.degrees(value["sigma_q"]), value["sigma_q_interval"]
    if interval is None:
        return f"off by {sigma:.3g}° rms, as given" if sigma else "their noise explains none of the residual"
    low, high = (math.degrees(end) for end in interval)
    if sigma == 0.0:
        return f"no noise shows (95 %: below {high:.2g}°)"
    places = value["sigma_flange_m"]
    and_places = "" if places is None else f" and {1e3 * places:.3g} mm"
    return f"off by {sigma:.3g}°{and_places} rms (95 %: {low:.3g}° to {high:.3g}°)"


def _time_offsets(value: dict[str, Any]) -> Iterator[str]:
    """Time offset of each view, with its interval and its jitter, ms."""
    for i, view in enumerate(value["view"]):
        offset = (
            value["time_offset_s"][i],
            *value["time_offset_interval_s"][i],
            value["time_offset_jitter_s"][i],
        )
        delay, low, high, jitter = (round(1e3 * seconds, 1) + 0.0 for seconds in offset)  # no -0.0
        yield f"{delay:.1f} ms {view} (95 %: {low:.1f} to {high:.1f}; jitter {jitter:.1f})"


def _of_suggestions(value: dict[str, Any]) -> Iterator[str]:
    """The suggestions of a calibration's object as a table, deltas in deg and mm."""
    rows = value.get("suggestions")
    if not rows:
        return
    revolute = [joint["type"] == "R" for joint in value["joints"]]
    titles = [f"q{i}" for i in range(1, len(revolute) + 1)]
    if value["readings"] == "flange":
        revolute, titles = [False] * 3 + [True] * 3, ["x", "y", "z", "turn", "turn", "turn"]
    units = ["deg" if turns else "mm" for turns in revolute]
    names = "".join(f"{f'{title} {unit}':>9}" for title, unit in zip(titles, units, strict=True))
    now = math.sqrt(rows[0]["variance_before"])
    yield f"  poses to add, as offsets from a recorded one; predicted error {now:.3g} px now"
    yield f"  {'from pose':>9}{names}{'then px':>9}"
    for row in rows:
        steps = (
            math.degrees(d) if turns else 1e3 * d for d, turns in zip(row["delta"], revolute, strict=True)
        )
        then = math.sqrt(row["variance_after"])
        yield f"  {row['from_pose']:>9}" + "".join(f"{d:>+9.1f}" for d in steps) + f"{then:>9.3g}"
    if value["readings"] == "flange":
        yield f"  these poses of the flange: {value['suggestions_file']} (m)"
        return
    yield f"  joints of these poses: {value['suggestions_file']} ({value['suggestions_unit']}, m)"
    if not value["suggestions_limited"]:
        yield wrapped(_NO_LIMITS, "  ")


def _of_plan(value: dict[str, Any], detailed: bool) -> Iterator[str]:
    from projservo_cli.report.json_objects import NEAREST

    if "plans" in value:
        for plan in value["plans"]:
            yield f"plan of {plan['step']}:"
            yield from _of_plan(plan, detailed)
        return
    feasible = "feasible" if value["feasible"] else "NOT feasible"
    yield wrapped(f"plan: {value['profile']}, {feasible}: {value['reason']}")
    for one in value["objects"].values():
        yield wrapped(one["reason"], "  ")
    rejected = [one.subject.name for one in value["findings"] if one.code == "rejected_profile"]
    if rejected and not detailed:
        yield wrapped(f"not {', '.join(rejected)}; why: -v", "  ")
    else:  # a plan of an earlier version has their texts alone
        for text in value["rejected_profiles"]:
            yield wrapped(f"not {text}", "  ")
    for text in value["relaxed_constraints"]:
        yield wrapped(text, "  ")
    if detailed:
        yield (
            "  rotation {theta_s_deg:.2f} deg = {theta_r_deg:.2f} deg onto the plane, "
            "{theta_p_deg:.2f} deg within it".format_map(value)
        )
        lowest = (f"{name} {_number(value['margins'][name]['min'])}" for name in NEAREST)
        yield f"  minimum: {', '.join(lowest)}"
        if value["duration"]:
            yield f"  duration {value['duration']:.3g} s"
        if value["n_goal_configurations"] is not None:
            yield wrapped(
                "search: {n_goal_configurations} goal configurations, {n_goals_tried} tried; "
                "{n_search_samples} samples of seed {seed}, {tree_nodes} nodes of both trees".format_map(
                    value
                ),
                "  ",
            )


def _of_laws(value: dict[str, Any], _: bool) -> Iterator[str]:
    from projservo_cli.laws import run_name

    def named(trace: dict[str, Any]) -> str:
        """Name of a run by its step or its law."""
        return str(trace.get("step") or run_name(trace["law"], trace["mode"]))

    known = any(trace["position_error_mm"] is not None for trace in value["laws"])
    keys = ("position_error_mm", "rotation_error_deg", "center_deviation_mm")
    words, units = ("position", "rotation", "path deviation"), ("mm", "deg", "mm")
    if not known:
        keys = "image_error_px", "estimated_position_error_mm", ""
        words, units = ("image", "within", ""), ("px", "mm", "")
    views = next((trace["view"] for trace in value["laws"]), ("left", "right"))
    errors = "true errors" if known else "image errors"
    yield f"servo: {errors} at the end, self-occluded steps {'/'.join(views)}"
    first, second, last = words
    yield f"{'':<42}{first:>9}{second:>9}{last:>19}".rstrip()
    first, second, last = units
    head = "step" if "steps" in value else "law"
    yield f"  {head:<20}{'verdict':<15}{'steps':>5}{first:>9}{second:>9}{'occluded':>9}{last:>10}".rstrip()
    for trace in value["laws"]:
        first, second, last = (_number(trace[key]) if key else "" for key in keys)
        hidden, *others = (trace[f"self_occluded_steps_{view}"] for view in trace["view"])
        yield (
            f"  {named(trace):<20}{trace['verdict']:<15}{trace['steps']:>5}"
            f"{first:>9}{second:>9}"
            f"{hidden:>5}{''.join(f'/{steps}' for steps in others):<4}{last:>10}"
        ).rstrip()
    by = {kind: [named(one) for one in value["laws"] if one["features"] == kind] for kind in _MEASURED}
    if all(by.values()):
        parts = (f"{said} by {', '.join(by[kind])}" for kind, said in _MEASURED.items())
        yield wrapped(f"measured: {'; '.join(parts)}", "  ")
    for trace in value["laws"]:
        if trace["incidences"]:
            rest = ", ".join(map(_incidence, trace["incidences"]))
            name, free = named(trace), trace["free_dof"]
            yield wrapped(f"{name}: {rest}; {'no' if free == 0 else free} joint motion free", "  ")
        if "following" in trace:
            yield wrapped(f"{named(trace)}: {_following(trace['following'])}", "  ")
    if acts := [step for step in value.get("steps", ()) if step["kind"] != "move"]:
        yield wrapped(", ".join(f"{step['name']}: {step['reason']}" for step in acts), "  ")
    for name, said in _NOTES.items():
        for reason in dict.fromkeys(trace[name] for trace in value["laws"] if trace[name]):
            yield wrapped(f"{said}: {reason}", "  ")


def _incidence(row: dict[str, Any]) -> str:
    """Name of an incidence, the error within which it is met, and the error of its images."""
    parts = ((row["error_mm"], "mm"), (row["error_deg"], "deg"))
    said = [f"{number:.2g} {unit}" for number, unit in parts if number is not None and number == number]
    within = f"within {', '.join(said)}, " if said else ""
    return f"{row['name']} {within}{row['error_px']:.2g} px as seen"


# Motions of an object that a goal is followed on.
_MOVES = {
    "still": "stood still",
    "belt": "moved along a line",
    "turntable": "turned about an axis",
    "free": "moved freely",
}


def _following(found: dict[str, Any]) -> str:
    """Motion of an object, distance of the tool from its goal, and deviation of that."""
    speed, known = found["speed_mm_s"], found["deviation_mm"]
    said = f"the object {_MOVES.get(found['motion'], 'moved')}"
    if speed is not None and found["motion"] in ("belt", "free"):  # else its middle is at rest
        said += f", at {_digits(speed)} mm/s on average"
    rms = [(found[f"rms_{unit}"], unit) for unit in ("mm", "deg") if found[f"rms_{unit}"] is not None]
    if rms:
        off = " and ".join(f"{_digits(value)} {unit}" for value, unit in rms)
        said += f"; for {found['seconds']:.2g} s the tool was {off} rms off its goal"
    return said + ("" if known is None else f"; the goal is known to {_digits(known)} mm")


def _digits(value: float) -> str:
    """Return a number with two digits, and no exponent for large ones."""
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def _of_report(value: dict[str, Any], detailed: bool) -> Iterator[str]:
    claims = value["claims"]
    explained = [claim for claim in claims if detailed or claim["holds"] is False]
    found = [claim["holds"] for claim in claims]
    judged, left = len(found) - found.count(None), found.count(None)
    verdict_text = f"; {found.count(True)} of {judged} judged claims hold" if claims else ""
    verdict_text += f", {left} not judged" if left else ""
    but = "; it does not hold that" if explained and not detailed else ""
    count = len(value["figures"])
    yield wrapped(f"report: {count} file{'s' * (count != 1)} of figures{verdict_text}{but}")
    words = {True: "holds", False: "does not hold", None: "not judged"}
    for claim in explained:
        if detailed:
            yield wrapped(f"{words[claim['holds']]}: {claim['claim']}: {claim['measured']}", "  ")
        else:
            yield f"  - {textwrap.shorten(claim['claim'], 76, placeholder='…')}"
    reasons: dict[str, list[str]] = {}
    for row in value["omitted"]:
        reasons.setdefault(row["reason"], []).append(row["what"])
    for reason, what in reasons.items():
        omitted = f"omitted: {', '.join(what)}" if detailed else f"{len(what)} omitted"
        yield wrapped(f"{omitted}: {reason}", "  ")
    for name in ("page", "view", "animation"):
        if value.get(name):
            yield f"{name}: {value[name]}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _of_sweep(found: dict[str, Any], _: bool) -> Iterator[str]:
    """The table of cells, and the table of pairs of laws on the same tasks."""
    yield (
        f"report: {found['runs']} of {found['total']} runs; shares in %, 95 % interval; medians of successes"
    )
    cells, pairs = found["cells"], found["paired"]
    known = ("cell", "runs", "converged", "successes", "success_interval", "verdicts", "quantiles")
    axes = [name for name in cells[0] if name not in known and not name.endswith("_rate")]
    widths = [max(len(name), *(len(str(cell[name])) for cell in cells)) + 2 for name in axes]
    head = "".join(f"{name:<{width}}" for name, width in zip(axes, widths, strict=True))
    shares = f"{'success %':>15}{'converged':>10}{'hidden':>7}{'outside':>8}"
    yield f"  {head}{shares}{'steps':>6}{'mm':>8}{'path':>7}"
    for cell in cells:
        low, high = (100.0 * value for value in cell["success_interval"])
        rate = f"{100.0 * cell['success_rate']:.1f} ({low:.0f}-{high:.0f})"
        quantiles = (("steps", 6), ("position_error_mm", 8), ("path_length_ratio", 7))
        medians = ((cell["quantiles"][name]["0.5"], width) for name, width in quantiles)
        numbers = "".join(f" {_number(median):>{width - 1}}" for median, width in medians)
        text = "".join(f"{cell[name]!s:<{width}}" for name, width in zip(axes, widths, strict=True))
        converged = 100.0 * cell["converged"] / cell["runs"]
        hidden, outside = 100.0 * cell["self_occluded_rate"], 100.0 * cell["left_image_rate"]
        yield f"  {text}{rate:>15}{converged:>10.1f}{hidden:>7.1f}{outside:>8.1f}{numbers}"
    if pairs:
        yield "paired on the same tasks: both succeed, only the first, only the second,"
        yield "neither; p: chance if alike"
    measured = ("laws", "pairs", "both", "only", "neither", "p_success", "median_difference", "p_difference")
    for pair in pairs:
        where = ", ".join(f"{name} {value}" for name, value in pair.items() if name not in measured)
        counts = f"{pair['both']}, {pair['only'][0]}, {pair['only'][1]}, {pair['neither']}"
        laws = " : ".join(pair["laws"]) + (f" ({where})" if where else "")
        yield f"  {laws}: {counts}; p {pair['p_success']:.2g}"
