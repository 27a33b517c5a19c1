"""Words for predictions held against further images: parts left out, a camera fitted again, two views."""

from projservo_cli.messages.row_form import Row

_MORE = "record more poses"
_CHECK = "check the joint readings and the marker numbers"
_LENGTH = "check the known length, in m, and its ends, or the model"
VALIDATIONS = {
    "held_out": Row("held-out images err {ratio} times as much as the covariance predicts"),
    "poses_disagree": Row("the poses disagree by more than noise, as from joint readings or a lens"),
    "parts_lost": Row("{count} parts could not be predicted from the others", _MORE),
    "nothing_held_out": Row("no part could be predicted from the others", _MORE),
    "posture_blocks": Row("in blocks of posture {amount} times: the model errs between postures"),
    "time_blocks": Row("in blocks of time {amount} times: something changed over the recording"),
    "spoiling_camera": Row(
        "the others err {amount} rms with the {view} camera, {limit} without", "leave it out"
    ),
    "no_spoiling_camera": Row("no camera spoils the others: without {view} they err {amount} times as much"),
    "contradicted": Row(
        "the images contradict the calibration: {of_all}{found}",
        "check that these are the same robot, rig and markers, with joints in the same units; if so, "
        "calibrate again with such poses among the others",
    ),
    "contradicted_in_part": Row(
        "the images contradict the calibration in {part_of_cameras}: {unshown}",
        "if it moved, fit it again: {name}",
    ),
    "median_limit": Row(
        "{limit} allowed: {number_of_last} times the stated error of {part} and the noise of these images, "
        "{of_part}, together"
    ),
    "poses_open": Row("the other poses do not determine the robot"),
    "open_camera": Row(
        "{count} detections of the {view} camera at {rest} poses determine no camera ({total} required, not "
        "in one plane)",
        "add poses in which several joints move, and markers",
    ),
    "contradicted_view": Row("{view} camera: median {amount}, {limit} allowed"),
    "length_by_joint": Row("{joints} moves {amount_m} ± {deviation_m} m for each m of its readings", _LENGTH),
    "length_short": Row("the known length is {size} too short for the links of the model", _LENGTH),
    "length_long": Row("the known length is {size} too long for the links of the model", _LENGTH),
    "far_camera": Row("the {view} camera is {amount} from the {name}, {limit} allowed", _LENGTH),
    "far_hand": Row("the {name} at readings of zero is {amount} from the base, {limit} allowed", _LENGTH),
    "zero_off": Row("{joints}: zero off by {signed}"),
    "axis_off": Row("{joints}: axis off by {fixed}, {unshown}"),
    "axis_tilt": Row("{fixed}"),
    "refit_outliers": Row(
        "{count} of {total} detections of the {view} camera do not fit ({rest} allowed)", _CHECK
    ),
    "refit_slip": Row(
        "by the images, {joints} is {size} off its readings, which moves images by {part} times their noise "
        "({of_part} allowed)",
        "home it, or calibrate again",
    ),
    "refit_misfit": Row(
        "the images are {amount} times as far off as noise and covariance explain ({limit} allowed)", _CHECK
    ),
    "refit_unnoticed": Row(
        "an error of {joints} by {amount} could pass into the {view} camera unnoticed ({limit} allowed)",
        "add poses that spread farther, or images of a camera that did not move",
    ),
    "late_view": Row(
        "each {view} image shows the pose before that of the {other_view} one, by the epipolar geometry",
        "let each pose settle for longer (plant.settle_s), and take the newest frame of both cameras",
    ),
    "camera_amid": Row(
        "one camera moved at pose {poses}, by the epipolar geometry",
        "record again, or remove the {name} {count} poses",
    ),
    "other_numbers": Row(
        "both views number {count} markers differently at all poses, by the epipolar geometry: {pairs}",
        "number them alike in both views (the images do not show which view is right), or remove them",
    ),
    "exchanged_numbers": Row("marker {of_markers[0]} left is marker {of_markers[1]} right"),
    "exchanged_tag": Row("tag {of_markers[0]} left is tag {of_markers[1]} right{begins}"),
    "begun_tag": Row("tag {of_markers[0]}{begins}"),
    "exchanged_in_model": Row("{joints} have each other's place in the model"),
    "other_sense": Row("{joints} {turns} the other way in the model"),
    "far_zero": Row("the zero of {joints} is off by {amount}"),
    "far_axis": Row("the axis of {joints} is off by {amount}, {limit} allowed"),
    "other_model": Row(
        "the model does not describe the arm: {model_errors}", "mend it, or check --tip and the known length"
    ),
    "undecided_model": Row("(or, as the axes do not show, {model_errors})"),
}
