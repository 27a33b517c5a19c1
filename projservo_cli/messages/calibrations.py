"""Words for errors in a calibration, its data and its fit."""

from projservo_cli.messages.row_form import Row

# Deviations of an arm or a rig from the model, by the score tests.
_CURVE, _AGAIN = "fit it (--joint-model auto), or mend the joint", "fix what moved, and record again"
OF_MODEL = {
    "scale": Row("{joints} {moves} {size} {more} than {reads}", _CURVE, limit="gear of {joints}"),
    **dict.fromkeys(
        ("quadratic", "cubic"),
        Row(
            "readings of {joints} follow a curve, off by {size} at the ends",
            _CURVE,
            limit="curve of {joints}",
        ),
    ),
    "harmonic": Row(
        "readings of {joints} swing by {size} once a turn", _CURVE, limit="eccentric encoder of {joints}"
    ),
    "second_harmonic": Row(
        "readings of {joints} swing by {size} twice a turn", _CURVE, limit="oval gear of {joints}"
    ),
    "coupling": Row(
        "joint {of[0]} turns joint {of[1]} by {size} of its motion", _CURVE, limit="coupling of {joints}"
    ),
    "sag": Row("{joints} sags under load, by up to {size}", _CURVE, limit="sag of {joints}"),
    "joint_drift": Row(
        "the zero of {joints} drifts by {size} over the recording",
        "home the arm, and record again",
        limit="drift of {joints}",
    ),
    "joint_step": Row(
        "the zero of {joints} jumps by {size}{begin}",
        "home the arm, and record again",
        limit="step of {joints}",
    ),
    "camera_drift": Row(
        "the {view} camera drifts, by {size} over the recording", _AGAIN, limit="drift of the {view} camera"
    ),
    "camera_step": Row(
        "the {view} camera moved{begin}, by {size}", _AGAIN, limit="motion of the {view} camera"
    ),
    "base": Row(
        "the base of the arm or {all_cameras} moved{begin}, by {size}",
        _AGAIN,
        limit="motion of the base or the cameras",
    ),
    "tool": Row("{markers} moved {place}{begin}, by {size}", _AGAIN, limit="markers that moved {place}"),
    "lens": Row(
        "the lens of the {view} camera distorts, by {size}",
        "calibrate with --lens",
        limit="lens of the {view} camera",
    ),
    "lens_center": Row(
        "the {view} lens is decentred, by {size}", "calibrate with --lens", limit="lens of the {view} camera"
    ),
    "cyclic": Row(
        "readings of {joints} err by {size} again and again, every {period}",
        "look at its screw or gear; its errors between poses are stated",
        limit="cyclic errors of {joints}",
    ),
    "memory": Row(
        "images keep {size} of those before",
        "switch the filter of the tracker off, or let each pose settle for longer",
        limit="a tracker that lags",
    ),
    "focus": Row(
        "the {view} image is scaled with depth, by {size}",
        "fix the focus, switch autofocus off, and record again",
        limit="focus of the {view} camera",
    ),
}
# A calibration: its fit, and the data that it took or left out.
CALIBRATION = {
    "deviations": Row("all of them move predictions by {effect}; {number} px are allowed"),
    "unshown": Row("these poses do not show whether {unshown}; predictions would move by {effect}"),
    "noise": Row("residuals of {amount} a coordinate agree with the {limit} {origin}", limit="noise"),
    "residuals": Row(
        "more than pixel noise is left: residuals of {amount} a coordinate are {ratio} times the {limit} "
        "{origin}",
        limit="more than pixel noise",
    ),
    "joint_noise": Row("joint readings off by {amount} rms{ticks}", limit="noise"),
    "coarse_joints": Row(
        "errors of joint readings move images by {effect}, more than pixel noise",
        "finer or stiffer joints would help",
        limit="joint readings, which move images by {effect}",
    ),
    "lagging_joints": Row("look for joint readings that lag behind the images", limit="joint readings"),
    "unmodelled_lens": Row(
        "lens distortion would explain {percent} % of the squared residuals", "try --lens", limit="lens"
    ),
    "other_intrinsics": Row(
        "the {name} of the {view} camera is {amount} by the images, and {limit} by its file, which is not "
        "used as a prior",
        "look whether the file is of this camera, and of this zoom, focus and size of images",
        limit="the {view} camera, which is not as its file",
    ),
    "errors_of_place": Row(
        "positions of the flange err by {amount} a metre of place, which is taken into account",
        "calibrate the kinematics of the arm where predictions are to be more exact",
        limit="positions of the flange, which err with its place",
    ),
    "other_pitch": Row(
        "squares of the board {name} are {pitches}",
        "measure the board, and look at the unit and the scale of the readings",
    ),
    "unplaced_board": Row(
        "{amount} corners of the board {name} from marker {numbers} are known; its shape takes {limit}",
        "mend its first marker, columns and rows, or show it in more images",
    ),
    "unused_shape": Row(
        "the board {name} is not as stated: its corners lie {amount} squares off, and squares are {stretch} "
        "along its rows than across; its shape is not used",
        "print it again, mount it flat, or mend its first marker, columns and rows",
    ),
    "no_lens": Row("the images show no lens distortion", "omit --lens", limit="lens"),
    "lens_off_center": Row(
        "the lens distortion is centred on the region where markers were seen",
        "give --image-size to centre it on the image",
        limit="lens",
    ),
    "outliers": Row(
        "{count} {observations} rejected as {outliers}{shared}",
        "check the detection of markers",
        limit="outliers: {count} of {total}{shared}",
    ),
    "suspect_readings": Row(
        "{count} joint {disagree} with the images", "check how poses and images are paired"
    ),
    "id_switches": Row("{times} a marker was seen under the number of another", "check the numbering"),
    "hopeless_joint": Row(
        "{joints} moved {amount}", "no motion of {it}{only} would do: record {elsewhere}", limit="{name}"
    ),
    "joint_together": Row(
        "{joints} moved {amount} but hardly apart from the other joints",
        "move {it} alone, by {limit} or more",
        limit="{name}",
    ),
    "joint_in_few_poses": Row(
        "{joints} moved {amount}, in too few poses",
        "record further ones{by_itself}, by {limit} or more",
        limit="{name}",
    ),
    "little_motion": Row("{joints} moved only {amount}", "move {it} at least {limit}", limit="{name}"),
    "noisy_view": Row(
        "the {view} camera is {ratio} times as noisy as the {other_view} one ({amount} and {limit}), "
        "and counts less",
        "check its focus, light and mount",
    ),
    "exact_images": Row(
        "the images have no noise ({amount}): they were made from poses, whose errors no two markers "
        "show apart",
        "give the noise of these (--noise-px)",
        limit="exact images",
    ),
    "unsettled_camera": Row(
        "the {view} camera settled over poses {runs}: images that disagree are rejected",
        "fix the camera",
        limit="motion of the {view} camera",
    ),
    "moved_camera": Row(
        "the {view} camera moved at pose{s} {runs}: images that disagree are rejected",
        "fix the camera",
        limit="motion of the {view} camera",
    ),
    "other_pose": Row(
        "the {view} camera shows {shown_poses} at pose {poses}: these images are rejected",
        "take the newest frame of each camera once the arm stands",
        limit="images of other poses",
    ),
    "seldom_fitting": Row(
        "hardly any detection of marker {numbers} fits: rejected", "record it in more poses"
    ),
    "unused_start": Row(
        "{name} was not used as a start: it {leads}; the calibration comes from the images alone",
        "check whether the file describes this robot and rig",
    ),
    "undecided_order": Row(
        "these poses cannot confirm the order of {joints}; the table's order is used",
        "add poses in which several move",
    ),
    "unseen_poses": Row(
        "poses that no camera saw: {count} ({poses}), dropped", "look why they show no marker"
    ),
    "circular_readings": Row(
        "readings of {joints} pass {part} to {of_part}: taken as a range of {amount}, as given {limit}"
    ),
    "few_postures": Row(
        "{count} {postures} show {rest} numbers of the arm, less than the {of_rest} required: several arms "
        "fit them, and no residual decides",
        "record {total} or more, better twice as many, in which every joint moves",
    ),
    "joint_undetermined": Row(
        "{joints} is not determined: near the reference its predicted images err by {amount} times the pixel "
        "noise"
    ),
    "placeholders": Row("{stands}: no camera saw that, so it was taken as unseen", "empty these cells"),
    "turned_board": Row(
        "the board looks the same turned by {amount}: {of_images}, and were turned right",
        "a ChArUco board, or one with an odd and an even side, needs no turn",
    ),
    "told": Row("{name}"),  # an earlier version stored sentences alone
    "whole_seconds": Row(
        "{name} of poses in motion are whole seconds, so no latency of the images was estimated",
        "record their fractions",
    ),
    "refitted_camera": Row(
        "the {view} camera, fitted again from {rest} poses, errs by {amount} within the joint ranges, "
        "{limit} before it moved",
        "add poses that spread farther",
        limit="the {view} camera",
    ),
    "refit_too_coarse": Row(
        "the {view} camera, fitted again from {rest} poses, errs by {amount} within the joint ranges, more "
        "than calibration.max_predicted_px = {number}",
        "add poses that spread farther",
        limit="the {view} camera, which errs by {amount}, more than calibration.max_predicted_px = {number}",
    ),
    "images_before_readings": Row(
        "each image shows the pose before its reading",
        "let each pose settle for longer (plant.settle_s), and take the newest frame",
        limit="readings of other poses",
    ),
    "images_after_readings": Row(
        "each image shows the pose after its reading",
        "store readings with the image of the same pose, and take the newest frame",
        limit="readings of other poses",
    ),
    "images_late_from": Row(
        "from pose {poses} on each image shows the pose before its reading",
        "pair images and readings by their times from there on, or remove these {count} poses",
        limit="readings of other poses",
    ),
    "tracker_memory": Row(
        "by the images each keeps {percent} % of the one before",
        "switch the filter of the tracker off, or let each pose settle for longer",
        limit="a tracker that lags",
    ),
    "images_early_from": Row(
        "from pose {poses} on each image shows the pose after its reading",
        "pair images and readings by their times from there on, or remove these {count} poses",
        limit="readings of other poses",
    ),
    "other_mount": Row(
        "by the images the cameras are {there}", "give --mount {name} (data.mount)", limit="the mount"
    ),
    "joint_type": Row(
        "by the images {joints} is {fits}, not {given}",
        "check the types of joints, --joints or joint_types ({name} would fit)",
        limit="joint types",
    ),
    "exchanged_joints": Row(
        "by the images {joints} have the readings of each other",
        "list joints in their order along the arm, from its base",
        limit="the order of joints",
    ),
    "full_coupling": Row(
        "by the images joint {of[0]} turns joint {of[1]} by {full}, as a parallelogram or a belt does",
        "calibrate with --joint-model coupling:{of[0]}-{of[1]}",
        limit="a coupling of joints",
    ),
    "level_hand": Row(
        "by the images joint {of[0]} turns joint {of[1]} by {full}, a parallelogram, and a joint without a "
        "reading keeps the hand level",
        "calibrate an arm of which all joints read: no joint model has such a hand",
        limit="a parallelogram",
    ),
    "joint_unit": Row(
        "by the images readings of {joints} are {name}",
        "give all joints in one unit, --joint-unit (data.joint_unit)",
        limit="the unit of joints",
    ),
    "inverse_poses": Row(
        "these look like poses of the base in the flange, or the cameras are {there}: images are alike",
        "invert the poses (p_base = T p_flange), or give --mount {name} (data.mount)",
        limit="inverse poses",
    ),
    "transposed_rotations": Row(
        "the rotations of the poses look transposed",
        "give the 3×4 matrices row by row, T11, T12, T13, T14, T21, …",
        limit="transposed rotations",
    ),
    "scalar_first": Row(
        "the quaternions look like qw, qx, qy, qz",
        "name the columns in their order; projservo reads qx, qy, qz, qw by name",
        limit="the order of quaternions",
    ),
    "image_size_changed": Row(
        "from pose {poses} on images are {times_as} as large as before",
        "record again at one resolution, or remove the poses before or after",
        limit="images of two sizes",
    ),
    "standing_markers": Row(
        "{numbered} {stand} still while the others move: left out",
        "remove markers that are not on the tool",
        limit="markers that stand still",
    ),
    "marker_on_link": Row(
        "{joints} {do} not move {numbered}, as if it sat before: left out",
        "remove it, or put it on the tool",
        limit="a marker on another body",
    ),
    "marker_drift": Row(
        "{numbered} creeps by {amount} in the images over the recording: left out",
        "glue it, and record again",
        limit="a marker that creeps",
    ),
    "marker_step": Row(
        "{numbered} moved at pose {poses} by {amount} in the images: left out",
        "glue it, and record again",
        limit="a marker that moved",
    ),
    "standing_joint": Row(
        "by the images {joints} stands still while its readings move",
        "check that they are its own",
        limit="joint readings",
    ),
}
# A fit that does not pass, and possible explanations.
_READINGS = "check the joint readings and types (R or P)"
_MISFIT = "the fit does not describe the data: "
_NO_FIT = _MISFIT + "{percent} % of the detections do not fit it, and "
REFUSALS = {
    "misfit": Row(
        _MISFIT + "residuals of {amount} a coordinate are {ratio} times the {limit} {origin}",
        "check the joint readings, their units and types, and the marker numbers",
        limit="the model",
    ),
    "chi2": Row(_MISFIT + "χ² per degree of freedom is {chi} at {chi2}", "{check_noise}", limit="the model"),
    "no_start": Row(
        "the data contradict the joint readings from the start",
        "check that they belong to their poses, their units (rad, m) and types (R or P), and that rows of "
        "one pose belong together",
        limit="the joint readings",
    ),
    "no_turn": Row("residuals of {amount} show no turn of it", limit="joint types"),
    "rejects_most": Row(
        _NO_FIT + "that is most of them",
        "remove markers that are not on the robot, and check the joint readings",
        limit="outliers",
    ),
    "rest_is_off": Row(_NO_FIT + "the rest errs {part} times as much as noise", _READINGS, limit="the model"),
    "rest_predicts_nothing": Row(
        _NO_FIT + "the rest does not predict held-out poses",
        "record more poses and more markers",
        limit="the data",
    ),
    "cameras_agree": Row(
        _MISFIT
        + "in {count} of {total} observations both cameras agree with each other but not with the robot",
        _READINGS,
        limit="the model",
    ),
    "other_joints": Row(
        _MISFIT + "{count} of {total} observations, at {rest} of {of_rest} poses, show other joints than "
        "those read",
        "check how poses and images are paired, and the joint readings and types (R or P)",
        limit="joint readings",
    ),
    "rejected_motion": Row(
        "the fit rejects most motion of {joints}",
        "check its readings and its type (R or P)",
        limit="joint readings",
    ),
    "rejected_poses": Row(
        "the fit rejects nearly all of the {name} {count} poses{in_view}: the base, a camera, the tool "
        "or the readings of joints changed there",
        "record again, or remove these poses",
        limit="poses",
    ),
    "several_joints": Row(
        "the fit rejects {count} of the {total} poses in which several joints move, and {rest} of the "
        "{of_rest} others: no other order of joints explains them, so joints err by more than trials show",
        "record poses in which all joints move (calibration.random_poses), which show periodic errors",
        limit="errors of joints",
    ),
    "erring_joint": Row(
        "{one_of} is off its readings by {amount} rms at {rest} of the {of_rest} poses in which several "
        "joints move, and not in trials of single joints",
        "look at its gear and its encoder, and record poses in which all joints move "
        "(calibration.random_poses), which show errors that repeat",
        limit="errors of {joints}",
    ),
    "joint_order": Row(
        "the fit rejects {count} of the {total} poses in which several joints move, and {rest} of the "
        "{of_rest} others",
        "check the order of the joints (q1, q2, ...) and the readings of these poses",
        limit="the order of joints",
    ),
}
# If cameras are on the tool, the chain ends at them, and the markers are in the scene.
ON_THE_TOOL = {
    "base": Row(
        "the cameras moved on the tool{begin}, by {size}", _AGAIN, limit="motion of the cameras on the tool"
    ),
}
_POSES = "check the poses of the flange and their images, and the marker numbers"
# By poses of the flange instead of joint readings.
BY_FLANGE = {
    "scale": Row("{joints} {moves} {size} {more} than {reads}", "check the units", limit="scale of {joints}"),
    "joint_noise": Row("poses of the flange off by {amount} and {reach} rms", limit="noise"),
    "coarse_joints": Row(
        "errors of poses of the flange move images by {effect}, more than pixel noise",
        "a finer or better calibrated arm would help",
        limit="poses of the flange, which move images by {effect}",
    ),
    "lagging_joints": Row(
        "look for poses of the flange that lag behind the images", limit="poses of the flange"
    ),
    "suspect_readings": Row(
        "poses of the flange that disagree with the images: {count}", "check how poses and images are paired"
    ),
    "misfit": Row(
        _MISFIT + "residuals of {amount} a coordinate are {ratio} times the {limit} {origin}",
        _POSES,
        limit="the model",
    ),
    "no_start": Row(
        "the data contradict the poses of the flange from the start",
        "check that they belong to their images, their units (m, rad) and their sense, flange in base",
        limit="the poses of the flange",
    ),
    "rejects_most": Row(_NO_FIT + "that is most of them", _POSES, limit="the poses of the flange"),
    "rejected_motion": Row(
        "the fit rejects most motion along or about {joints}", _POSES, limit="poses of the flange"
    ),
    "other_joints": Row(
        _MISFIT
        + "{count} of {total} observations, at {rest} of {of_rest} poses, show other poses than given",
        "check how poses and images are paired",
        limit="poses of the flange",
    ),
    "images_before_readings": Row(
        "each image shows the pose before its own",
        "let each pose settle for longer, and take the newest frame",
        limit="poses of other images",
    ),
    "images_after_readings": Row(
        "each image shows the pose after its own",
        "store poses with the image of the same moment, and take the newest frame",
        limit="poses of other images",
    ),
}
