"""Values of which words for findings consist, by the names that the texts of rows have for them."""

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from projservo_cli.findings import NOTE, Finding, Subject
from projservo_cli.messages.rows_by_code import Setup, row_of
from projservo_cli.messages.verdict_causes import because
from projservo_cli.records import CORNERS, LIMITS_MISSING, TOOL

# Digits of a value that is compared with a limit, which may be close.
_DIGITS = 6
# Maximum number of names in a list of examples, and of runs of poses.
_EXAMPLES, _MAX_RUNS = 3, 4
_UNITS = {
    "px": (1.0, " px"),
    "rad": (float(np.degrees(1.0)), "°"),
    "m": (1e3, " mm"),
    "s": (1.0, " s"),
    "m/s": (1e3, " mm/s"),
    "px/s": (1.0, " px/s"),
    "N": (1.0, " N"),
    "V": (1.0, " V"),
    "°C": (1.0, " °C"),
    "1": (1.0, ""),
    "": (1.0, ""),
}
_ORIGINS = {
    "given": "that were given",
    "stated": "that the sigmas of the markers state",
    "views": "that the epipolar geometry shows",
    "body": "that a rigid body shows",
    "stated, by views": "that the sigmas of the markers state, times {amount:.3g} as both views show",
    "stated, by body": "that the sigmas of the markers state, times {amount:.3g} as a rigid body shows",
}

# Markers that a look at an object needs, and why, by their number; what fewer leave open, by theirs.
_NEEDED = {
    3.0: "3 off one line",
    4.0: "4 off one plane, as the joints leave the metric open: 12 coordinates instead of 6",
}
_FREEDOMS = {
    0.0: "it is hidden or turned away",
    1.0: "all its turns are open",
    2.0: "its turn about their line is open",
    3.0: "its stretch across them is open",
}


class Wording:
    """Findings that share one line, the first for all; values are looked up as in a dictionary."""

    def __init__(self, alike: Sequence[Finding], setup: Setup) -> None:
        self.alike, self.setup, self.one = alike, setup, alike[0]
        self.joints = [joint for each in alike for joint in each.subject.joints]

    def __getitem__(self, name: str) -> object:
        return VALUES[name](self)

    def text(self, part: str) -> str:
        """Return a text of the row, by its name."""
        text: str = getattr(row_of(self.one, self.setup), part)
        return text.format_map(self)

    def others(self, part: str) -> list[str]:
        """Return the same of each of those that the first consists of."""
        return [Wording([one], self.setup).text(part) for one in self.one.others]

    @property
    def subject(self) -> Subject:
        """Of the first."""
        return self.one.subject

    @property
    def single(self) -> bool:
        """Whether it is about one joint."""
        return len(self.joints) == 1

    @property
    def alone(self) -> bool:
        """Whether the arm has one joint."""
        return self.setup.joints == 1

    @property
    def many(self) -> bool:
        """Whether the amount, a count, is not one."""
        return self.one.amount != 1.0

    @property
    def rest(self) -> Finding:
        """First part of the finding, or the finding itself."""
        return self.one.others[0] if self.one.others else self.one


def quantity(value: float, unit: str, digits: int = 3) -> str:
    """Format a number of a unit, angles in degrees and lengths below 1 m in mm."""
    factor, name = (1.0, " m") if unit == "m" and abs(value) >= 1.0 else _UNITS[unit]
    return f"{factor * value:.{digits}g}{name}"


def joined(words: Iterable[object]) -> str:
    """Join words by commas, the last by "and"."""
    line = [*map(str, words)]
    return " and ".join(filter(None, (", ".join(line[:-1]), *line[-1:])))


def _joints(told: Wording) -> str:
    everything = (told.one.code == "scale" and not told.single) or not told.joints
    if names := told.setup.coordinates:
        return "the flange" if everything else f"{joined(names[i - 1] for i in told.joints)} of the flange"
    return "all joints" if everything else numbered("joint", told.joints)


def _leads(line: Wording) -> str:
    """Say why a start was not used."""
    if math.isnan(line.one.amount):
        cameras = "both cameras" if len(line.setup.view) == 2 else line["all_cameras"]
        return f"does not put the markers in front of {cameras}"
    return f"leads to residuals of {line['amount']} instead of {line['limit']}"


def _stands(alike: Sequence[Finding]) -> str:
    """Say how many rows have numbers that no camera saw, by decreasing frequency."""
    several = "several markers and poses", "several poses of one marker"
    each = [
        f"{one.subject.name} stands in {one.amount:.0f} rows of {several[len(one.subject.markers) == 1]}"
        for one in alike[:_EXAMPLES]
    ]
    more = [f"{len(alike) - _EXAMPLES} further numbers"] * (len(alike) > _EXAMPLES)
    return "; ".join([*each, *more])


def _scale(one: Finding) -> float:
    """Factor of stated deviations that the images show."""
    return next((other.amount for other in one.others), 1.0)


def _of_images(others: Sequence[Finding]) -> str:
    """Say how many images of all, and of each view, were numbered from another end."""
    each = ", ".join(
        f"{one.subject.views[0]} {one.amount:.0f} of {one.limit:.0f}" for one in others if one.limit
    )
    turned, seen = (sum(getattr(one, name) or 0.0 for one in others) for name in ("amount", "limit"))
    return f"{turned:.0f} of {seen:.0f} images number it from another end ({each})"


def _band(others: Sequence[Finding]) -> str:
    """Noise of images and joints, and the band in which χ² per degree of freedom is expected."""
    noise, band, *joints = others
    of_joints = "".join(f" and {quantity(one.amount, 'rad')} rms of joint noise" for one in joints)
    within = f"expected within {band.amount:.4g} and {band.limit:.4g}"
    return f"{quantity(noise.amount, 'px', 6)} of noise{of_joints}, {within}"


def _size(one: Finding) -> str:
    """Format an amount with its deviation, shares in %."""
    factor, unit = (100.0, " %") if one.unit == "1" else _UNITS[one.unit]
    spread = f" ± {factor * one.deviation:.1g}{unit}" if one.deviation > 0.0 else ""
    return f"{factor * abs(one.amount):.2g}{unit}{spread}"


def _stretch(one: Finding) -> str:
    """Say how much longer, or shorter, the squares of a board are along its rows than across."""
    longer = one.others[0].amount
    return f"{100.0 * abs(longer):.2g} % {'longer' if longer > 0.0 else 'shorter'}"


def _pitches(one: Finding) -> str:
    """Compare squares of a board by readings in metres with those stated."""
    share = 100.0 * (one.amount / one.limit - 1.0)
    readings, board = ("long", "printed large") if share > 0.0 else ("short", "printed small")
    stated = quantity(one.limit, one.unit, 5)
    ends = f"readings are {abs(share):.2g} % {readings}, or the board is {board}"
    found = f"{1e3 * one.amount:.3f} ± {1e3 * one.deviation:.3f} mm"
    return f"{found} by the readings, and {stated} as stated: {ends}"


def numbered(kind: str, numbers: Sequence[int]) -> str:
    """Name things of a kind by their numbers."""
    return f"{kind}{'s' * (len(numbers) > 1)} {joined(numbers)}"


def examples(numbers: Sequence[int]) -> str:
    """List the first of some numbers, and say how many more there are."""
    more = f" and {len(numbers) - _EXAMPLES} more" if len(numbers) > _EXAMPLES else ""
    return ", ".join(map(str, numbers[:_EXAMPLES])) + more


def _runs(ends: Sequence[int]) -> str:
    """List runs of poses by the first and the last of each."""
    runs = [" to ".join(map(str, dict.fromkeys(ends[i : i + 2]))) for i in range(0, len(ends), 2)]
    return ", ".join(runs[:_MAX_RUNS]) + (
        f" and {len(runs) - _MAX_RUNS} more" if len(runs) > _MAX_RUNS else ""
    )


def _shared(others: Sequence[Finding]) -> str:
    """Say which marker, pose or view most outliers share."""
    for one in others:
        subject, most = one.subject, "all" if one.limit == one.amount else f"{one.amount:.0f}"
        for kind, values in (("marker", subject.markers), ("pose", subject.poses), ("view", subject.views)):
            if values:
                return f", {most} of {kind} {values[0]}"
    return ""


def _cameras(line: Wording) -> str:
    """Name the cameras of some of the views."""
    views, names = line.subject.views, line.setup.view
    if 1 < len(views) == len(names) and line.one.code != "exchanged_cameras":
        return "both cameras" if len(views) == 2 else "all cameras"
    if line.one.code == "exchanged_cameras":
        return f"{joined(f'the {view}' for view in views)} camera"
    return f"the {joined(views)} camera{'s' * (len(views) > 1)}"


def _alike(line: Wording) -> str:
    """Name causes that look like a slipped joint: motions at both ends, and a link that flexes."""
    first, last = (
        ("the base or the scene turned likewise", "what holds the cameras turned likewise on the tool")
        if line.setup.mount == TOOL
        else ("the base turned likewise", "the tool turned likewise in its holder")
    )
    ends = [first] * (line.joints == [1]) + [last] * (line.joints == [line.setup.joints])
    return "".join(f" or {what}" for what in ends + ["its link flexes"] * bool(line.one.others))


def _left(line: Wording) -> str:
    """State the remaining translation, a share, and rotation, with the error."""
    each = [
        f"{quantity(one.amount, one.unit)} of rotation"
        if one.unit == "rad"
        else f"{one.amount:.1%} of the translation"
        for one in line.one.others
    ]
    return "".join(f"{text} and " for text in each)


def _dark(line: Wording) -> str:
    """Say which cameras show no marker."""
    dark, views = line.subject.views, line.setup.view
    if len(dark) == 1:
        return f"the {dark[0]} camera shows no marker"
    if len(dark) == len(views):
        return f"{'neither' if len(views) == 2 else 'no'} camera shows a marker"
    return f"none of the cameras {', '.join(dark)} shows a marker"


def _enough_see(line: Wording) -> str:
    """Say how many cameras see the face that are to; ``limit`` is their number."""
    least, cameras = line.one.limit, len(line.setup.view)
    if least < cameras:
        return f"{least:.0f} of {cameras} cameras see"
    return {1: "the camera sees", 2: "both cameras see"}.get(cameras, f"all {cameras} cameras see")


def _fixed(one: Finding, sign: str = "") -> str:
    """Format an amount with its deviation to hundredths, of tilts to thousandths."""
    (factor, unit), digits = _UNITS[one.unit], 3 if one.code == "axis_tilt" else 2
    amount = round(factor * one.amount, digits) + 0.0
    return f"{amount:{sign}.{digits}f}{unit} ± {factor * one.deviation:.{digits}f}{unit}"


def _shifted(line: Wording) -> str:
    """Say how an image is shifted against the other, or the others."""
    if not line.one.others:
        return ""
    by = ", ".join(f"{one.amount:.2g}" for one in line.one.others)
    others = f"{line.setup.view[-1]} one" if len(line.setup.view) == 2 else "others"
    return f", as if the {line['view']} image were shifted by ({by}) px against the {others}"


def _about_line(line: Wording) -> str:
    """Say about which line of markers an object may be turned."""
    return "".join(
        f" about the line of {numbered('marker', one.subject.markers)}" for one in line.one.others[:1]
    )


def servo_name(subject: Subject) -> str:
    """Name a servo by its joint."""
    return f"{numbered('joint', subject.joints)} ({subject.name})" if subject.joints else subject.name


def all_of(views: Sequence[str]) -> str:
    """Name all cameras in a message."""
    return {1: f"the {views[0]} camera", 2: "both cameras"}.get(len(views), "the cameras")


def sharing(views: Sequence[str]) -> str:
    """Begin a message on a view of two cameras together, or of one alone."""
    return {1: f"the {views[0]} camera sees", 2: "both cameras see"}.get(len(views), "two cameras see")


def _looked(line: Wording) -> str:
    """Say where a recording looked: in the poses of a joint, or where the robot is."""
    poses = len(line.subject.poses)
    return (
        f" in the {poses} poses of {numbered('joint', line.joints)}" if poses else " where the robot stands"
    )


def _by_views(line: Wording, one: str, two: str, more: str) -> str:
    """Choose words by the number of the cameras."""
    return {1: one, 2: two}.get(len(line.setup.view), more)


def _play(one: Finding) -> str:
    """Tell the hysteresis, sag or backlash of a joint, to a tenth; that is hidden if it has no amount."""
    factor, unit = _UNITS[one.unit]
    size = "hidden by gravity" if math.isnan(one.amount) else f"{round(factor * one.amount, 1):g}{unit}"
    return f"{one.subject.name} {size}"


def _within(line: Wording) -> str:
    """Say how far images and joints agree on the tool, if its size is known."""
    if math.isnan(line.one.amount):
        return ""
    return f", which show the tool within {quantity(line.one.amount, 'm', 2)} of where its joints put it"


def _model_errors(line: Wording) -> str:
    """Join the errors in a model, and their alternatives."""
    *words, last = line.others("sentence")
    undecided = line.one.others[-1].code == "undecided_model"
    return f"{' and '.join(words)} {last}" if undecided else " and ".join((*words, last))


VALUES: dict[str, Callable[[Wording], object]] = {
    # Values of the subject.
    "of": lambda line: line.subject.joints,
    "name": lambda line: line.subject.name,
    "joints": _joints,
    "one_of": lambda line: line["joints"] if line.single else f"one of {line['joints']}",
    "it": lambda line: "it" if line.single else "each",
    "moves": lambda line: "moves" if line.single else "move",
    "reads": lambda line: "it reads" if line.single else "they read",
    "all_cameras": lambda line: "the camera" if len(line.setup.view) == 1 else "all cameras",
    "view": lambda line: line.subject.views[0] if line.subject.views else "",
    "other_view": lambda line: line.subject.views[-1] if line.subject.views else "",
    "in_view": lambda line: f" in the {line.subject.views[0]} view" if line.subject.views else "",
    "markers": lambda line: "the markers" if line.subject.tag is None else f"tag {line.subject.tag}",
    "numbers": lambda line: examples(line.subject.markers),
    "begin": lambda line: f" at pose {line.subject.poses[0]}" if line.subject.poses else "",
    "poses": lambda line: examples(line.subject.poses),
    "shown_poses": lambda line: (
        f"pose {examples(line.rest.subject.poses)}" if line.rest.subject.poses else "another pose"
    ),
    "runs": lambda told: _runs(told.subject.poses),
    "s": lambda told: "s" if len(set(told.subject.poses)) > 1 else "",
    "there": lambda told: "on the tool" if told.subject.name == TOOL else "fixed",
    # Of amounts.
    "more": lambda told: "less" if told.one.amount < 0.0 else "more" if told.single else "more or less",
    "size": lambda told: _size(told.one),
    "pitches": lambda told: _pitches(told.one),
    "stretch": lambda told: _stretch(told.one),
    "amount": lambda told: joined([quantity(each.amount, each.unit) for each in told.alike]),
    "limit": lambda told: joined([quantity(each.limit, each.unit) for each in told.alike]),
    "number": lambda told: f"{told.one.limit:.3g}",
    "ratio": lambda told: f"{told.one.amount / told.one.limit:.3g}" if told.one.limit else "",
    "percent": lambda told: f"{100.0 * told.one.amount:.0f}",
    "reach": lambda told: quantity(told.one.limit, "m"),
    "effect": lambda told: quantity(told.one.effect_px, "px"),
    "fits": lambda told: "prismatic" if told.one.unit == "m" else "revolute",
    "given": lambda told: "revolute" if told.one.unit == "m" else "prismatic",
    "origin": lambda told: _ORIGINS.get(told.subject.name, "").format(amount=_scale(told.one)),
    "chi": lambda told: f"{told.one.amount:.4g}",
    "chi2": lambda told: _band(told.one.others),
    "check_noise": lambda told: "check joint_noise_deg" if len(told.one.others) > 2 else "",
    "leads": _leads,
    "ticks": lambda line: " (ticks that were counted)" if line.subject.name == "ticks" else "",
    # Counts.
    "count": lambda line: f"{line.one.amount:.0f}",
    "total": lambda line: f"{line.one.limit:.0f}",
    "observations": lambda line: "observations were" if line.many else "observation was",
    "outliers": lambda line: "outliers" if line.many else "an outlier",
    "disagree": lambda line: "readings disagree" if line.many else "reading disagrees",
    "times": lambda line: f"{line.one.amount:.0f} times" if line.many else "once",
    "stands": lambda line: _stands(line.alike),
    "shared": lambda line: _shared(line.one.others),
    "of_images": lambda line: _of_images(line.one.others),
    # Parts of the finding.
    "unshown": lambda line: ", ".join(line.others("sentence")),
    "rest": lambda line: f"{line.rest.amount:.0f}",
    "of_rest": lambda line: f"{line.rest.limit:.0f}",
    "part": lambda line: quantity(line.rest.amount, line.rest.unit),
    "of_part": lambda line: quantity(line.rest.limit, line.rest.unit),
    "of_rest_s": lambda line: quantity(line.rest.limit, "s"),
    "exact": lambda line: quantity(line.one.amount, line.one.unit, _DIGITS),
    "exact_limit": lambda line: quantity(line.one.limit, line.one.unit, _DIGITS),
    "obstructions": lambda line: "; ".join(line.others("sentence")[1:]),
    "between": lambda line: " to ".join(
        quantity(end, line.rest.unit, _DIGITS) for end in (line.rest.amount, line.rest.limit)
    ),
    # Plans.
    "nearest": lambda line: "all constraints hold; nearest is " if line.one.severity == NOTE else "",
    "fails": lambda line: "" if line.one.severity == NOTE else " fails first",
    "at": lambda line: (
        "at "
        + ", ".join(f"{one.subject.name} {one.amount:.2f}" for one in line.one.others if one.code == "share")
    ),
    "enough_see": _enough_see,
    "enough": lambda line: _by_views(line, "enough cameras", "both cameras", "enough cameras"),
    "both": lambda line: "both" if len(line.setup.view) == 2 else "all",
    "since": lambda line: ", ".join(
        f"{one.subject.views[0]} from path parameter {one.amount:.2f}" for one in line.one.others
    ),
    "stops": lambda line: ", ".join(line.others("limit")),
    "speed_limit": lambda line: {"m": "prismatic_speed_limit_m_s"}.get(
        line.one.unit, "joint_speed_limit_deg_s"
    ),
    "set_limits": lambda _: LIMITS_MISSING,
    "of_percent": lambda line: f"{100.0 * line.one.limit:g}",
    "sizes": lambda line: joined(
        f"{one.amount:.0f}x{one.limit:.0f} {one.subject.views[0]}" for one in line.one.others
    ),
    "which": lambda line: f"marker{'s' * (len(line.subject.markers) > 1)} {line['all_numbers'] or 'none'}",
    "needed": lambda line: _NEEDED.get(line.one.limit, ""),
    "freedom": lambda line: _FREEDOMS.get(line.one.amount, ""),
    "about": _about_line,
    "signed": lambda line: _fixed(line.one, "+").replace("-", "\N{MINUS SIGN}"),
    "fixed": lambda line: _fixed(line.one),
    "amount_m": lambda line: f"{line.one.amount:.4g}",
    "deviation_m": lambda line: f"{line.one.deviation:.1g}",
    "full": lambda line: f"{100.0 * line.one.amount:+.0f} %".replace("-", "\N{MINUS SIGN}"),
    "times_as": lambda line: "half" if line.one.amount == 0.5 else f"{line.one.amount:.3g} times",
    "stand": lambda line: "stands" if len(line.subject.markers) == 1 else "stand",
    "do": lambda line: "does" if line.single else "do",
    "period": lambda line: quantity(line.one.period, line.one.unit),
    "number_of_last": lambda line: f"{line.one.others[-1].amount:g}",
    "postures": lambda line: (
        f"postures of joints {line.joints[0]} to {line.joints[-1]}" if line.joints else "poses"
    ),
    "count_others": lambda line: len(line.one.others) - 1,
    "there_read": lambda line: ", ".join(quantity(one.amount, one.unit, 4) for one in line.one.others[1:]),
    "shifted": _shifted,
    "key": lambda line: {"m": "max_displacement_m"}.get(line.one.unit, "max_rotation_deg"),
    # Faults, and reasons of runs.
    "causes": lambda line: "; or ".join(
        "; ".join(filter(None, parts))
        for parts in zip(line.others("sentence"), line.others("remedy"), strict=True)
    ),
    "each": lambda line: joined(line.others("sentence")),
    "place": lambda line: "in the scene" if line.setup.mount == TOOL else "on the tool",
    "tag": lambda line: line.subject.tag,
    "all_numbers": lambda line: ", ".join(map(str, line.subject.markers)),
    "numbered": lambda line: numbered("marker", line.subject.markers),
    "ends": lambda line: f"{line.subject.markers[0]} to {line.subject.markers[-1]}",
    "covered": lambda line: ", or is covered in part" if len(line.setup.view) == 1 else "",
    "cameras": _cameras,
    "were": lambda line: "was" if len(line.subject.views) == 1 else "were",
    "them": lambda line: "it" if len(line.subject.views) == 1 else "them",
    "alike": _alike,
    "ms": lambda line: " and ".join(f"{1e3 * one.amount:+.3g}" for one in line.one.others),
    "larger": lambda line: "larger" if line.one.amount > 0.0 else "smaller",
    "for_long": lambda line: (
        f", {line.one.amount:.0f} periods after the last that was" if line.one.amount else ""
    ),
    "left": _left,
    "because": lambda line: because(line.subject.name),
    "dark": _dark,
    # Robots and cameras.
    "tags": lambda line: numbered("tag", sorted({number // CORNERS for number in line.subject.markers})),
    "are": lambda line: "are" if len({number // CORNERS for number in line.subject.markers}) > 1 else "is",
    "rate": lambda line: "fewer than 3" if math.isnan(line.one.amount) else f"{line.one.amount:.1f}",
    "stamped": lambda line: line.subject.name or "when they arrive",
    "frame_ms": lambda line: f"{1e3 / line.one.limit:.0f}",
    "in_ms": lambda line: f"{1e3 * line.one.amount:.0f}",
    "of_name": lambda line: line.rest.subject.name,
    "sent": lambda line: (
        f"{line['joints']} was sent to {line['exact_limit']} and stands at "
        f"{quantity(line.rest.amount, line.rest.unit, _DIGITS)}, {line['amount']} short"
    ),
    "instead": lambda line: "" if math.isnan(line.one.amount) else f", it has {line.one.amount:.3g}",
    "devices": lambda line: (
        ", ".join(one.subject.name for one in line.one.others) or "none: look at the cable"
    ),
    "other_device": lambda line: line.rest.subject.name if line.one.others else "another device",
    "each_frame": lambda line: "each of its frames " if line.subject.views else "",
    "any_image": lambda line: "it" if math.isnan(line.one.amount) else f"any of {line['count']} images",
    "as_board": lambda line: line.one.others[-1].subject.name,
    "two": lambda line: "both" if len(line.setup.view) == 2 else "two",
    "white": lambda line: f"{line.rest.amount:.1%}",
    "blur": lambda line: "".join(f", edges blurred by {one.amount:.1f} px" for one in line.one.others[1:]),
    "widths": lambda line: ", ".join(f"{one.subject.tag} ({one.amount:.0f} px)" for one in line.one.others),
    "corners": lambda line: "" if math.isnan(line.one.amount) else f"; corners to {line.one.amount:.2g} px",
    "share": lambda line: _by_views(line, "shows", "share", "two or more show"),
    "lack": lambda line: _by_views(line, "does not show", "do not both show", "fewer than two show"),
    "the_images": lambda line: (
        f"the {line.subject.views[0]} image"
        if len(line.subject.views) == 1
        else f"the images of {joined(line.subject.views)}"
    ),
    "images": lambda line: _by_views(line, "image", "both images", "images"),
    "towards": lambda line: all_of(line.setup.view),
    "sharing": lambda line: sharing(line.setup.view),
    "looked": _looked,
    "half": lambda line: ", half of them or more" if line.subject.poses else "",
    "seen": lambda line: "".join(f"; {one.subject.views[0]} {one.amount:.0f}" for one in line.one.others[1:]),
    "counts": lambda line: "|".join(f"{one.amount:.0f}" for one in line.one.others),
    "no": lambda line: "neither" if len(line.setup.view) == 2 else "no",
    "here": lambda line: f", which is {line.subject.name} here" if line.subject.name else "",
    "some": lambda line: examples(line.subject.markers) or "none",
    "readings": lambda line: ", ".join(quantity(one.amount, one.unit, 4) for one in line.one.others),
    "amounts": lambda line: ", ".join(map(_play, line.one.others)),
    "servo": lambda line: servo_name(line.subject),
    "servos": lambda line: joined(servo_name(one.subject) for one in line.one.others),
    "after": lambda line: f", after {line['part']}" if line.one.others else "",
    "carried": lambda line: "cameras" if line.setup.mount == TOOL else "tags",
    "of_poses": lambda line: len(line.subject.poses),
    "within": _within,
    "found": lambda line: "; ".join(line.others("sentence")),
    "views_off": lambda line: "".join(f"; {said}" for said in line.others("sentence")),
    # Two views that number differently, and a model.
    "part_of_cameras": lambda line: {1: "one camera alone"}.get(len(line.subject.views), "some cameras"),
    "of_all": lambda line: f"median {line['amount']}, " if line.rest.code == "median_limit" else "",
    "of_markers": lambda line: line.subject.markers,
    "pairs": lambda line: "; ".join(line.others("sentence")[:_EXAMPLES]),
    "begins": lambda line: (
        f": its corners begin {line.one.amount:.0f} further in the right view" if line.one.amount else ""
    ),
    "turns": lambda line: "slides" if line.one.unit == "m" else "turns",
    "model_errors": _model_errors,
    # Arms of one joint, and of several.
    "elsewhere": lambda line: "markers farther from its axis" if line.alone else "trials of every joint",
    "by_itself": lambda line: "" if line.alone else f" in which {line['it']} moves alone",
    "only": lambda line: "" if line.alone else " alone",
}
