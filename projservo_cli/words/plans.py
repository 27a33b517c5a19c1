"""Words for what is off in a plan, its motion and its goal."""

from projservo_cli.words.rows import Row

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
# What stops a search through joint space, and by how much the ends of a path relax it.
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
    "object_far": Row(
        "objects.{name} has moved by {amount}, more than {limit}",
        "look whether the goal is free there, then confirm it (--confirm), or raise objects.{key}",
    ),
}
PLANS = OF_MOTION | OF_SEARCH | OF_PLAN
