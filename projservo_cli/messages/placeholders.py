"""Values of which words for findings consist, by the names that the texts of rows have for them."""

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from projservo_cli.findings import NOTE, Finding, Subject
from projservo_cli.messages.rows_by_code import Setup, row_of
from projservo_cli.messages.verdicts import because
from projservo_cli.records import CORNERS, LIMITS_MISSING, TOOL

# Digits of what is compared with a limit, which may be close.
_DIGITS = 6
# Maximum number of names in a list of examples, and of runs of poses.
_EXAMPLES, _MAX_RUNS = 3, 4
_UNITS = {
    "px": (1.0, " px"),
    "rad": (float(np.degrees(1.0)), "°"),
    "m": (1e3, " mm"),
    "s": (1.0, " s"),
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

# Coordinates of a pose of the flange, as joints in their order.
COORDINATES = "x", "y", "z", "the first turn", "the second turn", "the third turn"
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
    """Findings that one line tells, the first for all; values are looked up as in a dictionary."""

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
        """What the first consists of, else itself."""
        return self.one.others[0] if self.one.others else self.one


def quantity(value: float, unit: str, digits: int = 3) -> str:
    """Format a number of a unit, angles in degrees and lengths below 1 m in mm."""
    factor, name = (1.0, " m") if unit == "m" and abs(value) >= 1.0 else _UNITS[unit]
    return f"{factor * value:.{digits}g}{name}"


def joined(words: Iterable[object]) -> str:
    """Join words by commas, the last by "and"."""
    told = [*map(str, words)]
    return " and ".join(filter(None, (", ".join(told[:-1]), *told[-1:])))


def _joints(told: Wording) -> str:
    everything = (told.one.code == "scale" and not told.single) or not told.joints
    if told.setup.flange:
        return (
            "the flange" if everything else f"{joined(COORDINATES[i - 1] for i in told.joints)} of the flange"
        )
    return "all joints" if everything else numbered("joint", told.joints)


def _leads(told: Wording) -> str:
    """Say what a start leads to that was not used."""
    if math.isnan(told.one.amount):
        cameras = "both cameras" if len(told.setup.view) == 2 else told["all_cameras"]
        return f"does not put the markers in front of {cameras}"
    return f"leads to residuals of {told['amount']} instead of {told['limit']}"


def _stands(alike: Sequence[Finding]) -> str:
    """Say in how many rows numbers stand that no camera saw, the most frequent first."""
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


def _cameras(told: Wording) -> str:
    """Name the cameras of some of the views."""
    views, names = told.subject.views, told.setup.view
    if 1 < len(views) == len(names) and told.one.code != "exchanged_cameras":
        return "both cameras" if len(views) == 2 else "all cameras"
    if told.one.code == "exchanged_cameras":
        return f"{joined(f'the {view}' for view in views)} camera"
    return f"the {joined(views)} camera{'s' * (len(views) > 1)}"


def _alike(told: Wording) -> str:
    """Say what looks like a joint that slipped: motions of what it ends at, and a link that flexes."""
    first, last = (
        ("the base or the scene turned likewise", "what holds the cameras turned likewise on the tool")
        if told.setup.mount == TOOL
        else ("the base turned likewise", "the tool turned likewise in its holder")
    )
    ends = [first] * (told.joints == [1]) + [last] * (told.joints == [told.setup.joints])
    return "".join(f" or {what}" for what in ends + ["its link flexes"] * bool(told.one.others))


def _left(told: Wording) -> str:
    """Say what is left of the translation, a share, and of the rotation, beside the error."""
    each = [
        f"{quantity(one.amount, one.unit)} of rotation"
        if one.unit == "rad"
        else f"{one.amount:.1%} of the translation"
        for one in told.one.others
    ]
    return "".join(f"{text} and " for text in each)


def _dark(told: Wording) -> str:
    """Say which cameras show no marker."""
    dark, views = told.subject.views, told.setup.view
    if len(dark) == 1:
        return f"the {dark[0]} camera shows no marker"
    if len(dark) == len(views):
        return f"{'neither' if len(views) == 2 else 'no'} camera shows a marker"
    return f"none of the cameras {', '.join(dark)} shows a marker"


def _enough_see(told: Wording) -> str:
    """Say how many cameras see the face that are to; ``limit`` is their number."""
    least, cameras = told.one.limit, len(told.setup.view)
    if least < cameras:
        return f"{least:.0f} of {cameras} cameras see"
    return {1: "the camera sees", 2: "both cameras see"}.get(cameras, f"all {cameras} cameras see")


def _fixed(one: Finding, sign: str = "") -> str:
    """Format an amount with its deviation to hundredths, of tilts to thousandths."""
    (factor, unit), digits = _UNITS[one.unit], 3 if one.code == "axis_tilt" else 2
    amount = round(factor * one.amount, digits) + 0.0
    return f"{amount:{sign}.{digits}f}{unit} ± {factor * one.deviation:.{digits}f}{unit}"


def _shifted(told: Wording) -> str:
    """Say how an image is shifted against the other, or the others."""
    if not told.one.others:
        return ""
    by = ", ".join(f"{one.amount:.2g}" for one in told.one.others)
    others = f"{told.setup.view[-1]} one" if len(told.setup.view) == 2 else "others"
    return f", as if the {told['view']} image were shifted by ({by}) px against the {others}"


def _about_line(told: Wording) -> str:
    """Say about which line of markers an object may be turned."""
    return "".join(
        f" about the line of {numbered('marker', one.subject.markers)}" for one in told.one.others[:1]
    )


def servo_name(subject: Subject) -> str:
    """Name a servo by its joint."""
    return f"{numbered('joint', subject.joints)} ({subject.name})" if subject.joints else subject.name


def all_of(views: Sequence[str]) -> str:
    """Name all cameras in a message."""
    return {1: f"the {views[0]} camera", 2: "both cameras"}.get(len(views), "the cameras")


def sharing(views: Sequence[str]) -> str:
    """Begin a message on what two cameras see together, or one by itself."""
    return {1: f"the {views[0]} camera sees", 2: "both cameras see"}.get(len(views), "two cameras see")


def _looked(told: Wording) -> str:
    """Say where a recording looked: in the poses of a joint, or where the robot stands."""
    poses = len(told.subject.poses)
    return (
        f" in the {poses} poses of {numbered('joint', told.joints)}" if poses else " where the robot stands"
    )


def _by_views(told: Wording, one: str, two: str, more: str) -> str:
    """Choose words by the number of the cameras."""
    return {1: one, 2: two}.get(len(told.setup.view), more)


def _play(one: Finding) -> str:
    """Tell the hysteresis, sag or backlash of a joint, to a tenth; that is hidden if it has no amount."""
    factor, unit = _UNITS[one.unit]
    size = "hidden by gravity" if math.isnan(one.amount) else f"{round(factor * one.amount, 1):g}{unit}"
    return f"{one.subject.name} {size}"


def _within(told: Wording) -> str:
    """Say how far images and joints agree on the tool, where its size is known."""
    if math.isnan(told.one.amount):
        return ""
    return f", which show the tool within {quantity(told.one.amount, 'm', 2)} of where its joints put it"


def _model_errors(told: Wording) -> str:
    """Join what is off in a model, and what else it may be."""
    *words, last = told.others("sentence")
    undecided = told.one.others[-1].code == "undecided_model"
    return f"{' and '.join(words)} {last}" if undecided else " and ".join((*words, last))


VALUES: dict[str, Callable[[Wording], object]] = {
    # Of the subject.
    "of": lambda told: told.subject.joints,
    "name": lambda told: told.subject.name,
    "joints": _joints,
    "one_of": lambda told: told["joints"] if told.single else f"one of {told['joints']}",
    "it": lambda told: "it" if told.single else "each",
    "moves": lambda told: "moves" if told.single else "move",
    "reads": lambda told: "it reads" if told.single else "they read",
    "all_cameras": lambda told: "the camera" if len(told.setup.view) == 1 else "all cameras",
    "view": lambda told: told.subject.views[0] if told.subject.views else "",
    "other_view": lambda told: told.subject.views[-1] if told.subject.views else "",
    "in_view": lambda told: f" in the {told.subject.views[0]} view" if told.subject.views else "",
    "markers": lambda told: "the markers" if told.subject.tag is None else f"tag {told.subject.tag}",
    "numbers": lambda told: examples(told.subject.markers),
    "begin": lambda told: f" at pose {told.subject.poses[0]}" if told.subject.poses else "",
    "poses": lambda told: examples(told.subject.poses),
    "shown_poses": lambda told: (
        f"pose {examples(told.rest.subject.poses)}" if told.rest.subject.poses else "another pose"
    ),
    "runs": lambda told: _runs(told.subject.poses),
    "s": lambda told: "s" if len(set(told.subject.poses)) > 1 else "",
    "there": lambda told: "on the tool" if told.subject.name == TOOL else "fixed",
    # Of amounts.
    "more": lambda told: "less" if told.one.amount < 0.0 else "more" if told.single else "more or less",
    "size": lambda told: _size(told.one),
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
    "ticks": lambda told: " (ticks that were counted)" if told.subject.name == "ticks" else "",
    # Of counts.
    "count": lambda told: f"{told.one.amount:.0f}",
    "total": lambda told: f"{told.one.limit:.0f}",
    "observations": lambda told: "observations were" if told.many else "observation was",
    "outliers": lambda told: "outliers" if told.many else "an outlier",
    "disagree": lambda told: "readings disagree" if told.many else "reading disagrees",
    "times": lambda told: f"{told.one.amount:.0f} times" if told.many else "once",
    "stands": lambda told: _stands(told.alike),
    "shared": lambda told: _shared(told.one.others),
    "of_images": lambda told: _of_images(told.one.others),
    # Of what it consists of.
    "unshown": lambda told: ", ".join(told.others("sentence")),
    "rest": lambda told: f"{told.rest.amount:.0f}",
    "of_rest": lambda told: f"{told.rest.limit:.0f}",
    "part": lambda told: quantity(told.rest.amount, told.rest.unit),
    "of_part": lambda told: quantity(told.rest.limit, told.rest.unit),
    "of_rest_s": lambda told: quantity(told.rest.limit, "s"),
    "exact": lambda told: quantity(told.one.amount, told.one.unit, _DIGITS),
    "exact_limit": lambda told: quantity(told.one.limit, told.one.unit, _DIGITS),
    "obstructions": lambda told: "; ".join(told.others("sentence")[1:]),
    "between": lambda told: " to ".join(
        quantity(end, told.rest.unit, _DIGITS) for end in (told.rest.amount, told.rest.limit)
    ),
    # Of plans.
    "nearest": lambda told: "all constraints hold; nearest is " if told.one.severity == NOTE else "",
    "fails": lambda told: "" if told.one.severity == NOTE else " fails first",
    "at": lambda told: (
        "at "
        + ", ".join(f"{one.subject.name} {one.amount:.2f}" for one in told.one.others if one.code == "share")
    ),
    "enough_see": _enough_see,
    "enough": lambda told: _by_views(told, "enough cameras", "both cameras", "enough cameras"),
    "both": lambda told: "both" if len(told.setup.view) == 2 else "all",
    "since": lambda told: ", ".join(
        f"{one.subject.views[0]} from path parameter {one.amount:.2f}" for one in told.one.others
    ),
    "stops": lambda told: ", ".join(told.others("limit")),
    "speed_limit": lambda told: {"m": "prismatic_speed_limit_m_s"}.get(
        told.one.unit, "joint_speed_limit_deg_s"
    ),
    "set_limits": lambda _: LIMITS_MISSING,
    "of_percent": lambda told: f"{100.0 * told.one.limit:g}",
    "sizes": lambda told: joined(
        f"{one.amount:.0f}x{one.limit:.0f} {one.subject.views[0]}" for one in told.one.others
    ),
    "which": lambda told: f"marker{'s' * (len(told.subject.markers) > 1)} {told['all_numbers'] or 'none'}",
    "needed": lambda told: _NEEDED.get(told.one.limit, ""),
    "freedom": lambda told: _FREEDOMS.get(told.one.amount, ""),
    "about": _about_line,
    "signed": lambda told: _fixed(told.one, "+").replace("-", "\N{MINUS SIGN}"),
    "fixed": lambda told: _fixed(told.one),
    "amount_m": lambda told: f"{told.one.amount:.4g}",
    "deviation_m": lambda told: f"{told.one.deviation:.1g}",
    "full": lambda told: f"{100.0 * told.one.amount:+.0f} %".replace("-", "\N{MINUS SIGN}"),
    "times_as": lambda told: "half" if told.one.amount == 0.5 else f"{told.one.amount:.3g} times",
    "stand": lambda told: "stands" if len(told.subject.markers) == 1 else "stand",
    "do": lambda told: "does" if told.single else "do",
    "period": lambda told: quantity(told.one.period, told.one.unit),
    "number_of_last": lambda told: f"{told.one.others[-1].amount:g}",
    "postures": lambda told: (
        f"postures of joints {told.joints[0]} to {told.joints[-1]}" if told.joints else "poses"
    ),
    "count_others": lambda told: len(told.one.others) - 1,
    "there_read": lambda told: ", ".join(quantity(one.amount, one.unit, 4) for one in told.one.others[1:]),
    "shifted": _shifted,
    "key": lambda told: {"m": "max_displacement_m"}.get(told.one.unit, "max_rotation_deg"),
    # Of faults, and of reasons of runs.
    "causes": lambda told: "; or ".join(
        "; ".join(filter(None, parts))
        for parts in zip(told.others("sentence"), told.others("remedy"), strict=True)
    ),
    "each": lambda told: joined(told.others("sentence")),
    "place": lambda told: "in the scene" if told.setup.mount == TOOL else "on the tool",
    "tag": lambda told: told.subject.tag,
    "all_numbers": lambda told: ", ".join(map(str, told.subject.markers)),
    "numbered": lambda told: numbered("marker", told.subject.markers),
    "ends": lambda told: f"{told.subject.markers[0]} to {told.subject.markers[-1]}",
    "covered": lambda told: ", or is covered in part" if len(told.setup.view) == 1 else "",
    "cameras": _cameras,
    "were": lambda told: "was" if len(told.subject.views) == 1 else "were",
    "them": lambda told: "it" if len(told.subject.views) == 1 else "them",
    "alike": _alike,
    "ms": lambda told: " and ".join(f"{1e3 * one.amount:+.3g}" for one in told.one.others),
    "larger": lambda told: "larger" if told.one.amount > 0.0 else "smaller",
    "for_long": lambda told: (
        f", {told.one.amount:.0f} periods after the last that was" if told.one.amount else ""
    ),
    "left": _left,
    "because": lambda told: because(told.subject.name),
    "dark": _dark,
    # Of robots and cameras.
    "tags": lambda told: numbered("tag", sorted({number // CORNERS for number in told.subject.markers})),
    "are": lambda told: "are" if len({number // CORNERS for number in told.subject.markers}) > 1 else "is",
    "rate": lambda told: "fewer than 3" if math.isnan(told.one.amount) else f"{told.one.amount:.1f}",
    "stamped": lambda told: told.subject.name or "when they arrive",
    "frame_ms": lambda told: f"{1e3 / told.one.limit:.0f}",
    "in_ms": lambda told: f"{1e3 * told.one.amount:.0f}",
    "of_name": lambda told: told.rest.subject.name,
    "sent": lambda told: (
        f"{told['joints']} was sent to {told['exact_limit']} and stands at "
        f"{quantity(told.rest.amount, told.rest.unit, _DIGITS)}, {told['amount']} short"
    ),
    "instead": lambda told: "" if math.isnan(told.one.amount) else f", it has {told.one.amount:.3g}",
    "devices": lambda told: (
        ", ".join(one.subject.name for one in told.one.others) or "none: look at the cable"
    ),
    "other_device": lambda told: told.rest.subject.name if told.one.others else "another device",
    "each_frame": lambda told: "each of its frames " if told.subject.views else "",
    "any_image": lambda told: "it" if math.isnan(told.one.amount) else f"any of {told['count']} images",
    "as_board": lambda told: told.one.others[-1].subject.name,
    "two": lambda told: "both" if len(told.setup.view) == 2 else "two",
    "white": lambda told: f"{told.rest.amount:.1%}",
    "blur": lambda told: "".join(f", edges blurred by {one.amount:.1f} px" for one in told.one.others[1:]),
    "widths": lambda told: ", ".join(f"{one.subject.tag} ({one.amount:.0f} px)" for one in told.one.others),
    "corners": lambda told: "" if math.isnan(told.one.amount) else f"; corners to {told.one.amount:.2g} px",
    "share": lambda told: _by_views(told, "shows", "share", "two or more show"),
    "lack": lambda told: _by_views(told, "does not show", "do not both show", "fewer than two show"),
    "the_images": lambda told: (
        f"the {told.subject.views[0]} image"
        if len(told.subject.views) == 1
        else f"the images of {joined(told.subject.views)}"
    ),
    "images": lambda told: _by_views(told, "image", "both images", "images"),
    "towards": lambda told: all_of(told.setup.view),
    "sharing": lambda told: sharing(told.setup.view),
    "looked": _looked,
    "half": lambda told: ", half of them or more" if told.subject.poses else "",
    "seen": lambda told: "".join(f"; {one.subject.views[0]} {one.amount:.0f}" for one in told.one.others[1:]),
    "counts": lambda told: "|".join(f"{one.amount:.0f}" for one in told.one.others),
    "no": lambda told: "neither" if len(told.setup.view) == 2 else "no",
    "here": lambda told: f", which is {told.subject.name} here" if told.subject.name else "",
    "some": lambda told: examples(told.subject.markers) or "none",
    "readings": lambda told: ", ".join(quantity(one.amount, one.unit, 4) for one in told.one.others),
    "amounts": lambda told: ", ".join(map(_play, told.one.others)),
    "servo": lambda told: servo_name(told.subject),
    "servos": lambda told: joined(servo_name(one.subject) for one in told.one.others),
    "after": lambda told: f", after {told['part']}" if told.one.others else "",
    "carried": lambda told: "cameras" if told.setup.mount == TOOL else "tags",
    "of_poses": lambda told: len(told.subject.poses),
    "within": _within,
    "found": lambda told: "; ".join(told.others("sentence")),
    "views_off": lambda told: "".join(f"; {said}" for said in told.others("sentence")),
    # Of two views that number differently, and of a model.
    "part_of_cameras": lambda told: {1: "one camera alone"}.get(len(told.subject.views), "some cameras"),
    "of_all": lambda told: f"median {told['amount']}, " if told.rest.code == "median_limit" else "",
    "of_markers": lambda told: told.subject.markers,
    "pairs": lambda told: "; ".join(told.others("sentence")[:_EXAMPLES]),
    "begins": lambda told: (
        f": its corners begin {told.one.amount:.0f} further in the right view" if told.one.amount else ""
    ),
    "turns": lambda told: "slides" if told.one.unit == "m" else "turns",
    "model_errors": _model_errors,
    # Of arms of one joint, and of several.
    "elsewhere": lambda told: "markers farther from its axis" if told.alone else "trials of every joint",
    "by_itself": lambda told: "" if told.alone else f" in which {told['it']} moves alone",
    "only": lambda told: "" if told.alone else " alone",
}
