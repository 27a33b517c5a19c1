"""Words for what is off in a calibration, its data and its fit."""

from projservo_cli.words.rows import Row

# Deviations of an arm or a rig from the model, by the score tests.
_CURVE, _AGAIN = "fit it (--joint-model auto), or mend the joint", "fix what moved, and record again"
OF_MODEL = {
    "scale": Row("gear of {joints}", "{joints} {moves} {size} {more} than {reads}", _CURVE),
    **dict.fromkeys(
        ("quadratic", "cubic"),
        Row("curve of {joints}", "readings of {joints} follow a curve, off by {size} at the ends", _CURVE),
    ),
    "harmonic": Row(
        "eccentric encoder of {joints}", "readings of {joints} swing by {size} once a turn", _CURVE
    ),
    "coupling": Row(
        "coupling of {joints}", "joint {of[0]} turns joint {of[1]} by {size} of its motion", _CURVE
    ),
    "sag": Row("sag of {joints}", "{joints} sags under load, by up to {size}", _CURVE),
    "joint_drift": Row(
        "drift of {joints}",
        "the zero of {joints} drifts by {size} over the recording",
        "home the arm, and record again",
    ),
    "joint_step": Row(
        "step of {joints}", "the zero of {joints} jumps by {size}{begin}", "home the arm, and record again"
    ),
    "camera_drift": Row(
        "drift of the {view} camera", "the {view} camera drifts, by {size} over the recording", _AGAIN
    ),
    "camera_step": Row("motion of the {view} camera", "the {view} camera moved{begin}, by {size}", _AGAIN),
    "base": Row(
        "motion of the base or the cameras",
        "the base of the arm or {all_cameras} moved{begin}, by {size}",
        _AGAIN,
    ),
    "tool": Row("markers that moved {place}", "{markers} moved {place}{begin}, by {size}", _AGAIN),
    "lens": Row(
        "lens of the {view} camera",
        "the lens of the {view} camera distorts, by {size}",
        "calibrate with --lens",
    ),
    "lens_center": Row(
        "lens of the {view} camera", "the {view} lens is decentred, by {size}", "calibrate with --lens"
    ),
    "focus": Row(
        "focus of the {view} camera",
        "the {view} image is scaled with depth, by {size}",
        "fix the focus, switch autofocus off, and record again",
    ),
}
# A calibration: its fit, and the data that it took or left out.
CALIBRATION = {
    "deviations": Row("", "all of them move predictions by {effect}; {number} px are allowed"),
    "unshown": Row("", "these poses do not show whether {unshown}; predictions would move by {effect}"),
    "noise": Row("noise", "residuals of {amount} a coordinate agree with the {limit} {origin}"),
    "residuals": Row(
        "more than pixel noise",
        "more than pixel noise is left: residuals of {amount} a coordinate are {ratio} times the {limit} "
        "{origin}",
    ),
    "closed_form": Row(
        "the method",
        "the closed_form method explains the images only to {amount} a coordinate, {ratio} times the {limit} "
        "{origin}",
        "use bundle_adjustment",
    ),
    "joint_noise": Row("noise", "joint readings off by {amount} rms{ticks}"),
    "coarse_joints": Row(
        "joint readings, which move images by {effect}",
        "errors of joint readings move images by {effect}, more than pixel noise",
        "finer or stiffer joints would help",
    ),
    "lagging_joints": Row("joint readings", "look for joint readings that lag behind the images"),
    "unmodelled_lens": Row(
        "lens",
        "lens distortion would explain {percent} % of the squared residuals",
        "try --lens",
    ),
    "no_lens": Row("lens", "the images show no lens distortion", "omit --lens"),
    "lens_off_center": Row(
        "lens",
        "the lens distortion is centred on the region where markers were seen",
        "give --image-size to centre it on the image",
    ),
    "outliers": Row(
        "outliers: {count} of {total}{shared}",
        "{count} {observations} rejected as {outliers}{shared}",
        "check the detection of markers",
    ),
    "suspect_readings": Row(
        "",
        "{count} joint {disagree} with the images",
        "check how poses and images are paired",
    ),
    "id_switches": Row(
        "",
        "{times} a marker was seen under the number of another",
        "check the numbering",
    ),
    "hopeless_joint": Row(
        "{name}", "{joints} moved {amount}", "no motion of {it}{only} would do: record {elsewhere}"
    ),
    "joint_together": Row(
        "{name}",
        "{joints} moved {amount} but hardly apart from the other joints",
        "move {it} alone, by {limit} or more",
    ),
    "joint_in_few_poses": Row(
        "{name}",
        "{joints} moved {amount}, in too few poses",
        "record further ones{by_itself}, by {limit} or more",
    ),
    "little_motion": Row("{name}", "{joints} moved only {amount}", "move {it} at least {limit}"),
    "noisy_view": Row(
        "",
        "the {view} camera is {ratio} times as noisy as the {other_view} one ({amount} and {limit}), "
        "and counts less",
        "check its focus, light and mount",
    ),
    "exact_images": Row(
        "exact images",
        "the images have no noise ({amount}): they were made from poses, whose errors no two markers "
        "show apart",
        "give the noise of these (--noise-px)",
    ),
    "unsettled_camera": Row(
        "motion of the {view} camera",
        "the {view} camera settled over poses {runs}: images that disagree are rejected",
        "fix the camera",
    ),
    "moved_camera": Row(
        "motion of the {view} camera",
        "the {view} camera moved at pose{s} {runs}: images that disagree are rejected",
        "fix the camera",
    ),
    "seldom_fitting": Row(
        "", "hardly any detection of marker {numbers} fits: rejected", "record it in more poses"
    ),
    "unused_start": Row(
        "",
        "{name} was not used as a start: it {leads}; the calibration comes from the images alone",
        "check whether the file describes this robot and rig",
    ),
    "undecided_order": Row(
        "",
        "the order of {joints} is taken from the table; no pose shows it",
        "add poses in which several move",
    ),
    "unseen_poses": Row(
        "", "poses that no camera saw: {count} ({poses}), dropped", "look why they show no marker"
    ),
    "circular_readings": Row(
        "",
        "readings of {joints} pass {part} to {of_part}: taken as a range of {amount}, as given {limit}",
    ),
    "placeholders": Row("", "{stands}: no camera saw that, so it was taken as unseen", "empty these cells"),
    "turned_board": Row(
        "",
        "the board looks the same turned by {amount}: {of_images}, and were turned right",
        "a ChArUco board, or one with an odd and an even side, needs no turn",
    ),
    "told": Row("", "{name}"),  # by an earlier version, which stored sentences alone
    "whole_seconds": Row(
        "",
        "{name} of poses in motion are whole seconds, so no latency of the images was estimated",
        "record their fractions",
    ),
    "refitted_camera": Row(
        "the {view} camera",
        "the {view} camera, fitted again from {rest} poses, errs by {amount} within the joint ranges, "
        "{limit} before it moved",
        "add poses that spread farther",
    ),
    "refit_too_coarse": Row(
        "the {view} camera, which errs by {amount}, more than calibration.max_predicted_px = {number}",
        "the {view} camera, fitted again from {rest} poses, errs by {amount} within the joint ranges, more "
        "than calibration.max_predicted_px = {number}",
        "add poses that spread farther",
    ),
    "images_before_readings": Row(
        "readings of other poses",
        "each image shows the pose before its reading",
        "let each pose settle for longer (plant.settle_s), and take the newest frame",
    ),
    "images_after_readings": Row(
        "readings of other poses",
        "each image shows the pose after its reading",
        "store readings with the image of the same pose, and take the newest frame",
    ),
    "other_mount": Row(
        "the mount", "by the images the cameras are {there}", "give --mount {mount} (data.mount)"
    ),
    "joint_type": Row(
        "joint types",
        "by the images {joints} is {fits}, not {given}",
        "check the types of joints, --joints or joint_types ({name} would fit)",
    ),
    "standing_joint": Row(
        "joint readings",
        "by the images {joints} stands still while its readings move",
        "check that they are its own",
    ),
}
# A fit that does not pass, and what would explain it.
_READINGS = "check the joint readings and types (R or P)"
_MISFIT = "the fit does not describe the data: "
_NO_FIT = _MISFIT + "{percent} % of the detections do not fit it, and "
REFUSALS = {
    "misfit": Row(
        "the model",
        _MISFIT + "residuals of {amount} a coordinate are {ratio} times the {limit} {origin}",
        "check the joint readings, their units and types, and the marker numbers",
    ),
    "chi2": Row("the model", _MISFIT + "χ² per degree of freedom is {chi} at {chi2}", "{check_noise}"),
    "no_start": Row(
        "the joint readings",
        "the data contradict the joint readings from the start",
        "check that they belong to their poses, their units (rad, m) and types (R or P), and that rows of "
        "one pose belong together",
    ),
    "no_turn": Row("joint types", "residuals of {amount} show no turn of it"),
    "rejects_most": Row(
        "outliers",
        _NO_FIT + "that is most of them",
        "remove markers that are not on the robot, and check the joint readings",
    ),
    "rest_is_off": Row("the model", _NO_FIT + "the rest errs {part} times as much as noise", _READINGS),
    "rest_predicts_nothing": Row(
        "the data",
        _NO_FIT + "the rest does not predict held-out poses",
        "record more poses and more markers",
    ),
    "cameras_agree": Row(
        "the model",
        _MISFIT
        + "in {count} of {total} observations both cameras agree with each other but not with the robot",
        _READINGS,
    ),
    "other_joints": Row(
        "joint readings",
        _MISFIT + "{count} of {total} observations, at {rest} of {of_rest} poses, show other joints than "
        "those read",
        "check how poses and images are paired, and the joint readings and types (R or P)",
    ),
    "rejected_motion": Row(
        "joint readings",
        "the fit rejects most motion of {joints}",
        "check its readings and its type (R or P)",
    ),
    "rejected_poses": Row(
        "poses",
        "the fit rejects nearly all of the {name} {count} poses{in_view}: the base, a camera, the tool "
        "or the readings of joints changed there",
        "record again, or remove these poses",
    ),
    "joint_order": Row(
        "the order of joints",
        "the fit rejects {count} of the {total} poses in which several joints move, and {rest} of the "
        "{of_rest} others",
        "check the order of the joints (q1, q2, ...) and the readings of these poses",
    ),
}
# With cameras on the tool the chain ends at them, and the markers are in the scene.
ON_THE_TOOL = {
    "base": Row(
        "motion of the cameras on the tool", "the cameras moved on the tool{begin}, by {size}", _AGAIN
    ),
}
