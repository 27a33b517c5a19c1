"""Words for changes since a calibration, by images of a robot at work."""

from projservo_cli.messages.row_form import Row

_OFF = "images are {amount} rms off their prediction by the calibration"
_PUT_BACK = "put {them} back, or recalibrate"
FAULTS = {
    "images_off": Row(_OFF + ": {causes}"),
    "unexplained_images": Row(
        _OFF + ", most in the {view} image, at marker {numbers}, and no single cause explains it",
        "recalibrate",
    ),
    "misplaced_tags": Row("{each} {place}", "put them back as they were, or recalibrate"),
    "turned_tag": Row("tag {tag} is turned by {amount}"),
    "exchanged_tags": Row("tags {numbers} are exchanged"),
    "exchanged_cameras": Row("{cameras} are exchanged", "exchange their sources or cables"),
    "mirrored_joint": Row(
        "{joints} has the other sign than when it was calibrated", "restore its sign, or recalibrate"
    ),
    "slipped_joint": Row("{joints} slipped by {amount}{alike}", "home it again, or recalibrate"),
    "flexing_links": Row("links flex, or several joints slipped, by {amount}", "less load, or recalibrate"),
    "frozen_reading": Row(
        "the reading of {joints} stands still while the arm moves", "look at its encoder and cable"
    ),
    "late_images": Row(
        "images of {cameras} come {ms} ms later than was taken", "give plant.time_offset_s, or recalibrate"
    ),
    "resized_images": Row(
        "the image size of {cameras} is {ratio} times that of the calibration",
        "set the size of before, or recalibrate",
    ),
    "refocused_camera": Row(
        "{cameras} was moved along its optical axis, or its focal length changed by {size} (focus or zoom)",
        "put it back and lock focus and zoom, or recalibrate",
    ),
    "displaced_camera": Row("{cameras} {were} moved, by {amount}", _PUT_BACK),
    "cropped_images": Row(
        "images are cropped otherwise, or {cameras} were moved alike, by {amount}",
        "put it back, or recalibrate",
    ),
    "displaced_rig": Row(
        "{cameras} were moved alike, or the base was, by {amount}", "put it back, or recalibrate"
    ),
    "larger_tags": Row(
        "all tags are {size} {larger} than those of the calibration",
        "print them in their size, or recalibrate",
    ),
    "displaced_tool": Row("the tool was moved in its holder, by {amount}", "put it back, or recalibrate"),
    "displaced_tag": Row(
        "tag {tag} (markers {all_numbers}) moved {place}, by {amount}{covered}", "put it back, or recalibrate"
    ),
    "displaced_markers": Row(
        "{numbered} moved {place}, by {amount}{covered}", "put back what moved, or recalibrate"
    ),
}
# One camera cannot separate its own motion from a motion of the base.
BY_ONE = {"displaced_camera": Row("{cameras} was moved, or the base was, by {amount}", _PUT_BACK)}
ON_THE_TOOL = {
    "displaced_camera": Row("{cameras} slipped on the tool, by {amount}", _PUT_BACK),
    "cropped_images": Row(
        "images are cropped otherwise, or {cameras} slipped alike on the tool, by {amount}",
        "put it back, or recalibrate",
    ),
    "displaced_rig": Row("{cameras} slipped alike on the tool, by {amount}", _PUT_BACK),
    "displaced_tool": Row("the scene was moved, or the base was, by {amount}", "put it back, or recalibrate"),
}
