"""Words for errors in a plan, its motion and its goal."""

from projservo_cli.messages.row_form import Row

_OTHER_PROFILE = "choose another trajectory.profile"
# Constraints of a motion, the one nearest to failing.
OF_MOTION = {
    "motion_visibility": Row(
        "{nearest}visibility{fails}: visibility from the {view} camera is {amount} of the start's {at}"
    ),
    "motion_border": Row(
        "{nearest}image{fails}: a marker of the face is {amount} from the border of the {view} image "
        "({limit} asked for) {at}"
    ),
    "outside_image": Row("image fails first: a marker of the face is {amount} outside the {view} image {at}"),
    "motion_behind": Row("image fails first: a marker of the face is behind the {view} camera {at}"),
    "motion_joints": Row(
        "{nearest}joints{fails}: {joints} is at {amount}, its limits are {part} to {of_part}, {at}"
    ),
    "motion_conditioning": Row(
        "{nearest}conditioning{fails}: the reciprocal condition of the image Jacobian is {amount} "
        "({limit} allowed) {at}"
    ),
    "dependent_operators": Row("the joints cannot follow: the operators become dependent {at}"),
}
# Constraints that stop a search through joint space, and their relaxation at the ends of a path.
_AWAY = "{amount} ({limit} required)"
OF_SEARCH = {
    "margin_limits": Row("a joint limit", limit="a joint limit"),
    "margin_joints": Row(
        "limit of {joints} {amount} away ({limit} required)", limit="the limits of {joints}"
    ),
    "margin_front": Row("depth before the {view} camera " + _AWAY, limit="a marker behind the {view} camera"),
    "margin_visibility": Row(
        "visibility from the {view} camera " + _AWAY, limit="the face edge-on to the {view} camera"
    ),
    "margin_width": Row(
        "width of the face in the {view} image " + _AWAY, limit="the width of the face in the {view} image"
    ),
    "margin_image": Row("border in the {view} image " + _AWAY, limit="the border of the {view} image"),
    "margin_clear": Row("distance from regions " + _AWAY, limit="a region that is kept out of"),
}
OF_PLAN = {
    "face_seen": Row(
        "{enough_see} the face all along; minimum margin {amount} (1 at the start), {view} camera at path "
        "parameter {part}"
    ),
    "face_turned": Row("the profile {name} turns the face away from a camera ({since})", _OTHER_PROFILE),
    "no_coupled_path": Row("no path was found that keeps all constraints"),
    "rejected_profile": Row("{name}: {unshown}"),
    "half_turn": Row("neither sense of the half turn arrived when rehearsed"),
    "relaxed": Row("relaxed at the {name}: {unshown}"),
    "joint_path": Row(
        "a path with {rest} waypoints in joint space leads to number {count} of {total} joint "
        "vectors that show the goal"
    ),
    "within_region": Row("the {name} is within region {count} of trajectory.keep_out"),
    "enters_region": Row("the body enters region {count} of trajectory.keep_out at path parameter {part}"),
    "not_followed": Row("no joints can follow the motion, so that it cannot be kept out of regions"),
    "no_goal_joints": Row(
        "no joints were found that show the goal: the arm may not reach it, or its images are of other "
        "markers or in another order"
    ),
    "goals_hidden": Row(
        "of {count} joint vectors that show the goal, whole turns apart, {total} lie beyond the joint limits "
        "or do not show the face to {enough}, and {rest} are within a region that is kept out of"
    ),
    "start_beyond": Row("the start is already at or beyond {stops}"),
    "no_path": Row(
        "no path to any of {count} goal configurations was found, in {total} samples; what stopped most: "
        "{stops}"
    ),
    "no_speed_limit": Row("{joints} has no speed limit", "set control.{speed_limit}"),
    "unknown_limits": Row("the limits of some joints are unknown", "{set_limits}"),
    "no_search": Row("no search was given"),
    "unknown_image_size": Row(
        "the size of the images is not known: they are taken to reach to the last pixels seen, {sizes}",
        "give it: --image-size, or size_px of {both} cameras",
    ),
    "uneven_face": Row(
        "the face is not plane: its markers are {percent} % of its size off ({of_percent} % are allowed), "
        "and visibility is that of a plane between them",
        "name others in markers.face",
    ),
    "no_image_test": Row("stop.innovation_threshold is 0"),
    "no_covariance": Row("the calibration has no covariance"),
    "object_far": Row(
        "objects.{name} has moved by {amount}, more than {limit}",
        "look whether the goal is free there, then confirm it (--confirm), or raise objects.{key}",
    ),
}
_CHECK = "check which image is of which camera, and the marker numbers; then take them again"
# A goal that no joints, or no pose of the tool, show.
OF_GOAL = {
    "beyond_joints": Row(
        "the task does not lie in what {rest} joints can do: the nearest they bring the face is {amount} rms "
        "from its goal images, more than the {limit} that noise may leave",
        "choose a goal by joint readings, or one that moves the face as these joints do",
    ),
    "incidence": Row("{name} {amount}"),
    "incidence_name": Row("{name}"),
    "contradictory_incidences": Row(
        "{each} contradict each other: wherever the tool is, its images are {amount} from meeting them, and "
        "noise explains {limit}",
        "leave one out, or change one",
    ),
    "unmet_incidences": Row(
        "no joints within their limits meet all incidences; the nearest leave {unshown}",
        "leave one out, or teach the goal elsewhere",
    ),
    "goal_out_of_reach": Row(
        "the goal images fit no pose of the arm: the nearest leaves {amount} rms a marker", _CHECK
    ),
    "goal_marker_off": Row(
        "the goal images fit no pose of the arm: marker {numbers} is {amount} off in the {view} one, {limit} "
        "are allowed",
        _CHECK,
    ),
    "goal_unreached": Row(
        "the goal is a pose that {count_others} joints do not reach: the nearest, at joints {there_read}, is "
        "{part} and {amount} rms a marker off",
        "move the arm to the goal by hand and teach it, or set task.goal.joints to these readings",
    ),
    "goal_not_rigid": Row(
        "the goal images fit no pose of the tool: the nearest leaves {amount} rms a coordinate, their "
        "deviations explain {limit}{shifted}"
    ),
}
_NEARER = "show more of its markers, off one line, or show them from nearer"
# An object that carries a goal; names refer to the frames of it.
OF_OBJECT = {
    "object_open_infinity": Row(
        "the joints do not determine the plane at infinity, so the displacement of an object is open",
        "record motions of two joints whose axes are not parallel",
    ),
    "object_without_size": Row(
        "one camera cannot separate size and distance of an object in any number of frames, so its "
        "displacement is open",
        "watch it with a second camera",
    ),
    "object_without_shape": Row(
        "two cameras together see {which} at best (look {poses}), and its shape needs {needed}",
        "turn it towards both cameras",
    ),
    "object_hidden": Row("of known shape is seen {name}: {which}; {freedom}", "show {needed}"),
    "object_unplaced": Row(
        "{which} fit no place before the cameras {name}",
        "look whether they are numbered otherwise or the cameras have moved, and look again",
    ),
    "object_in_two_places": Row(
        "the images {name} fit two places of the object, χ² {amount} apart ({limit} decide): {which} do not "
        "show which way it is tilted",
        "show it to a second camera, nearer, or more of its markers off one plane",
    ),
    "object_stretched": Row(
        "{which} do not show {name} how the object is stretched (± {amount}, {limit} at most)",
        "show 4 off one plane, as the joints leave the metric open",
    ),
    "object_turned": Row(
        "{which} do not show {name} how the object is turned{about} (± {amount}, {limit} at most)", _NEARER
    ),
    "object_deformed": Row(
        "markers do not lie on the object as they did: residuals {amount} times the noise ({limit} at most), "
        "most at {which}",
        "look whether it has come off or slipped, the object is another one, or it moved while images were "
        "taken",
    ),
    "carried_behind": Row(
        "with the object, the goal of the tool has moved behind a camera",
        "put the object nearer to its place",
    ),
    "carried_inexact": Row(
        "the carried goal is known to {amount} only ({limit} at most)",
        "show more of its markers, nearer to the goal and to the cameras, average more frames, or raise "
        "objects.{name}",
    ),
    "goal_few_markers": Row(
        "the goal shows {count} markers of the tool, and its pose needs {total}",
        "teach it where the cameras see more",
    ),
    "goal_unplaced": Row("the images of the goal fit no pose of the tool before the cameras", "teach again"),
    "goal_turned": Row(
        "the goal does not show how the tool is turned (± {amount}, {limit} at most)",
        "teach it where the cameras see more markers, off one line",
    ),
    "goal_in_two_poses": Row(
        "the images of the goal fit two poses of the tool, χ² {amount} apart ({limit} decide)",
        "teach it where two cameras see it, or more markers off one plane",
    ),
}
PLANS = OF_MOTION | OF_SEARCH | OF_PLAN | OF_GOAL | OF_OBJECT
