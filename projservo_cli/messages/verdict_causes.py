"""Verdicts of runs, and words for their reasons."""

from typing import NamedTuple

from projservo_cli.messages.row_form import Row


class Verdict(NamedTuple):
    """One way in which a run ends."""

    when: str  # cause
    remedy: str
    origin: str = "projservo"  # origin of the term, as the glossary names it
    names: tuple[str, ...] = ()  # related keys of the configuration and values
    arrived: bool = False  # the goal is reached
    stopped: str = ""  # cause that stopped a law, so that another path is searched
    ends: bool = False  # no further motion in this call
    refutes: bool = False  # images contradict the calibration
    retried: bool = False  # a stored run is made again


# Codes of the loop are the places; the last two are of sweeps.
VERDICTS = {
    "behind camera": Verdict(
        "a marker is not in front of a camera", "choose another goal or start", origin="field"
    ),
    "out of view": Verdict(
        "a marker is outside an image, and plant.image_border is stop",
        "plan a path that keeps it inside",
        origin="field",
        names=("image_border", "first_outside_image"),
    ),
    "markers lost": Verdict(
        "the law needs a marker that was not seen for too many periods",
        "look what covers it, and at light and exposure",
        names=("max_lost_periods",),
    ),
    "converged": Verdict(
        "the image error is within the tolerance", "", origin="field", names=("stop",), arrived=True
    ),
    "diverged": Verdict(
        "the image error or the distance of the face grew by a factor, or the command is not finite",
        "follow a plan, or take another law",
        origin="field",
        names=("diverged_factor",),
        stopped="growing errors",
    ),
    "singular": Verdict(
        "the joint motion of the law is not unique",
        "follow a plan around it",
        origin="field",
        stopped="a singularity",
    ),
    "no progress": Verdict(
        "the error fell by less than 1 % in the last window, or the robot is stalled",
        "follow a plan, or raise speeds",
        origin="field",
        names=("stall_periods",),
    ),
    "max steps": Verdict(
        "no step is left", "raise stop.max_steps, or control.gain", origin="field", names=("max_steps",)
    ),
    "joint limit": Verdict(
        "a joint stands at its limit, the command would take it beyond, and plant.joint_limits is stop",
        "follow a plan that keeps the limits",
        origin="field",
        names=("joint_limits", "first_beyond_limit"),
        stopped="a joint limit",
    ),
    "fault detected": Verdict(
        "images contradict the calibration, or the tool presses too hard",
        "put back what moved, or calibrate again",
        origin="field (Isermann)",
        refutes=True,
    ),
    "failed": Verdict(
        "law, robot or cameras raised an error, were late, or gave an unusable answer",
        "mend what failed",
        ends=True,
        retried=True,
    ),
    "following error": Verdict(
        "a joint stays too far off its set-point", "look whether it is blocked", origin="field (drives)"
    ),
    "object moved": Verdict(
        "the object that carries the goal moved",
        "let it lie still, and plan again",
        names=("object_moved",),
        ends=True,
    ),
    "interrupted": Verdict(
        "the user ended it, as with Ctrl-C; its trace up to there is kept", "", ends=True, retried=True
    ),
    "followed": Verdict(
        "the image error to a goal that moves stayed within three times its stated deviation, rms over "
        "stop.follow_s",
        "",
        names=("follow", "follow_s"),
        arrived=True,
    ),
    "lost goal": Verdict(
        "no camera shows the object that carries the goal for too long to predict where it is",
        "look what hides it, and at light and exposure, or raise objects.NAME.lost_s",
        names=("lost_s", "approach_mm"),
    ),
    "out of reach": Verdict(
        "a goal that moves is about to leave the images or the reach of the arm, or goes away faster than it",
        "begin earlier, slow the object down, or turn the cameras and the arm to where it goes",
        names=("follow",),
    ),
    "too fast": Verdict(
        "the object that carries the goal is faster than its limit",
        "slow it down, or raise objects.NAME.max_speed_mm_s",
        names=("max_speed_mm_s",),
    ),
    "not calibrated": Verdict("a run of a sweep has no calibration", "look why it is refused"),
    "not started": Verdict("a run of a sweep could not begin", "read its reason"),
}
# Why another path is searched, except causes that stopped the law.
_REPLANNED = {
    "face_back": "the face was lost, and seen again on the path backwards",
    "ahead": "the path ahead would leave an image",
    "goal_hidden": "the face is hidden at the end of the path",
    "goal_elsewhere": "the goal will be elsewhere than the plan had it",
}
REASONS = {
    "converged": Row("{name} {amount} is within {limit}"),
    "no_progress": Row("the {name} stays at {amount}: {causes}"),
    "max_steps": Row("no step left; {name} {amount} was still changing"),
    "error_grew": Row("{name} {amount} is more than {part} times that at first, {limit}"),
    "face_left": Row("the face is {amount} from the cameras, over {part} times the {limit} at first"),
    "not_finite": Row("the command at step {count} is not finite"),
    "out_of_view": Row("a face marker left an image at step {count}"),
    "joint_passed": Row("{joints} passed its limit at step {count}"),
    "face_hidden": Row("the {view} camera was behind the face at {count} steps"),
    "behind_camera": Row("a face marker passed behind a camera at step {count}"),
    "markers_lost": Row("the law could not measure the face at step {count}: {causes}"),
    "marker_unseen": Row("a marker was not seen{for_long}"),
    "marker_flickers": Row(
        "a marker was not seen in {count} of the last {total} periods, with the robot held meanwhile",
        "look at light and exposure there, or at what covers it",
    ),
    "joint_limit": Row("{joints} stands at its limit, {amount}, and the task would take it beyond"),
    "singular": Row("the joint motion was not unique at step {count}: the robot is near a singularity"),
    "interrupted": Row("interrupted at step {count}"),
    "remaining": Row("{left}an {name} of {amount} is left"),
    "vague_markers": Row("markers there state {amount} times the noise", "look what covers them"),
    "face_apart": Row(
        "the face itself is seen {amount} off ({limit} by noise): it moved on the tool since the goal was "
        "taught",
        "teach it again",
    ),
    "blind_camera": Row("the {view} camera has shown no marker of the face since step {count}", "check it"),
    "followed": Row("{name} {amount} rms over stop.follow_s is within {limit}"),
    "followed_short": Row("the goal was followed for {amount} of {limit}", "raise stop.max_steps"),
    "goal_unseen": Row("no camera has shown its object for {amount} ({limit} at most)"),
    "goal_fast": Row("its object moves at {amount} ({limit} at most)"),
    "goal_leaves_view": Row("in {amount} the goal leaves the image of the {view} camera"),
    "goal_leaves_reach": Row("in {amount} the goal takes {joints} beyond its limit"),
    "goal_beyond_reach": Row("in {amount} the goal is farther than the joints reach"),
    "goal_recedes": Row(
        "the goal goes away faster than the arm follows: its image error grew from {limit} to {amount}"
    ),
    "replanned": Row("replanned at step {count} ({because})"),
    "replanned_in_vain": Row("replanned at step {count} ({because}) in vain"),
    "passed_over": Row("passed over where the face is lost to step {count}"),
    "local_minimum": Row("the law asks for no motion there, a local minimum"),
    "slow_commands": Row(
        "commands are too slow, {percent} % of the way in a period",
        "raise plant.speed_scale, the limits of joint speeds, control.period_s, or stop.stall_periods",
    ),
    "coarse_motion": Row(
        "set-points moved by no more than {amount}: backlash, coarse set-points or coarse readings hide the "
        "rest"
    ),
    "joint_stays": Row(
        "{joints} stands at {amount}, {limit} off its set-point",
        "look whether it is blocked, braked or in a protective stop, or raise "
        "plant.max_steady_state_error_deg or plant.max_relative_target_deg",
    ),
    "small_steps": Row(
        "set-points of {joints} moved by {amount}, its readings by {limit}: it does not follow such small "
        "steps; coarse set-points, or friction"
    ),
    "no_gain": Row(
        "set-points of {joints} moved by {amount}, its readings by {limit}, and images show no gain: "
        "backlash, or coarse set-points"
    ),
    "pressed": Row(
        "the tool is pressed with {amount}, beyond the {limit} of stop.max_force_n", "check its contacts"
    ),
    "moved_object": Row(
        "the object {name}, markers {ends}, has moved since the motion was planned, by {amount} in "
        "{the_images} ({limit} at most)",
        "let it lie still, and plan again",
    ),
    "covered_object": Row(
        "the object {name}, markers {ends}, is covered in {the_images}: they show no motion of it, or "
        "another than the others",
        "keep the view of it free",
    ),
    "pushed_object": Row(
        "the object {name}, markers {ends}, is {amount} from where its motion would have taken it ({limit} "
        "at most)",
        "look what pushed it, raise its max_acceleration, or check the latency of the cameras",
    ),
    "unseen_markers": Row("{dark} of the calibration"),
}


def because(name: str) -> str:
    """Return why another path was searched, by the verdict that stopped the law or another cause."""
    return _REPLANNED[name] if name in _REPLANNED else VERDICTS[name].stopped or name


def meaning(verdict: str) -> Verdict:
    """Return a verdict by its name, which may be of a run file of another version."""
    return VERDICTS.get(verdict, Verdict("unknown here", "update projservo"))


def arrived(verdict: str) -> bool:
    """Whether a run that ended in a verdict reached the goal."""
    return meaning(verdict).arrived
