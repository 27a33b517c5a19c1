"""Words for errors of a robot, its cameras and a recording."""

from projservo_cli.messages.row_form import Row

# A number of a tag or a marker that occurs twice in an image, and servos that are left alone.
_UNIQUE = "a number must be unique: print another one, or cover the tag that is not on the tool"
_HANDS = "take the hands away when asked to, and check whether the arm holds its load"
_SINKS = "; it is sent nothing more, and may sink"


def _about(where: str, **texts: tuple[str, ...]) -> dict[str, Row]:
    """Return rows of sentences, and their remedies if any, on a part of a robot."""
    return {code: Row(told[0], "".join(told[1:]), where=where) for code, told in texts.items()}


ROBOTS: dict[str, Row] = (
    _about(
        "{view} camera",
        slow_camera=(
            "{rest} x {of_rest} px, {rate} frames a second instead of {number}",
            "webcams expose longer in the dark: add light, or set exposure_ms below {frame_ms}; on one "
            "hub with another camera, set fourcc: MJPG",
        ),
        camera_rate=("{rest} x {of_rest} px, {rate} frames a second, stamped {stamped}",),
        other_format=(
            "sends {name}, not the {of_name} of fourcc",
            "set fourcc: {name}, or take another camera",
        ),
        autofocus=(
            "autofocus is on, and its driver does not switch it off",
            "take another camera, or its own program: a camera that refocuses is another one",
        ),
        unset_focus=(
            "its driver does not set the focus to {number}{instead}",
            "take another camera, or keep it from changing",
        ),
        free_exposure=("its exposure is automatic", "fix it with exposure_ms, below a frame's time"),
        kept_exposure=(
            "its exposure stays automatic, against exposure_ms",
            "add light, or take another camera",
        ),
        unset_exposure=(
            "its driver does not fix the exposure at {number} ms{instead}",
            "set an exposure_ms that it takes",
        ),
        unstable_device=(
            "its device may get another number when it is plugged in again",
            "set cameras.{view}.source: {name}",
        ),
        black_image=("the {view} image is black", "take the cap off, or look whether its shutter is closed"),
        dark_image=(
            "the {view} image is dark (grey {count} of 255 on average)",
            "add light, or raise exposure_ms",
        ),
        saturated_image=(
            "the {view} image is saturated, {percent} % of it white",
            "lower exposure_ms, or the light",
        ),
        blurred_image=("the {view} image is blurred by {amount} ({limit} at most)", "focus it on the tags"),
        frameless=("it has given none yet",),
        stopped_frames=("it stopped giving frames",),
        no_frame=(
            "gives no frame within {amount}",
            "look at cable and hub; two webcams on one USB 2 hub need cameras.{view}.fourcc: MJPG or a "
            "smaller size_px",
        ),
        lost_camera=(
            "no frame for {amount} ({limit} at most, cameras.reconnect_s): {unshown}",
            "look at its cable and hub",
        ),
        unopened=("{name} cannot be opened", "look at its name, cable and power"),
        no_device=("there is no {name}; devices: {devices}",),
        unreadable_device=("{name} may not be read", "sudo usermod -aG video $USER, then log in again"),
        second_node=(
            "{name} gives no pictures: it is the second node of a webcam, for metadata",
            "take {other_device}",
        ),
        held_device=("{name} is in use by {of_name} (process {rest})", "close that"),
        deep_pixels=("{each_frame}has {count} bits a pixel", "save it with 8, the brightest part near 255"),
        mosaic=(
            "{each_frame}is the mosaic of a colour sensor (Bayer)",
            "turn it into grey values or colours first",
        ),
        other_size=(
            "gives frames of {count} x {total} px, not the {rest} x {of_rest} of cameras.{view}.size_px",
            "set a size that it has",
        ),
        changed_size=(
            "changed its frames from {rest} x {of_rest} px to {count} x {total}",
            "set cameras.{view}.size_px",
        ),
        exposure=("mean grey {count} of 255, {white} white{blur}",),
        still_image=(
            "its tags moved by {amount} with the joints ({limit} at least)",
            "look whether its image is live, and of this arm",
        ),
        latency=("latency {in_ms} ms",),
        long_latency=("latency {in_ms} ms", "look for what queues frames: a hub, a network, a slow machine"),
    )
    | _about(
        "{view} image",
        repeated_tag=("{markers} is there twice", _UNIQUE),
        no_board=(
            "no {name} in {any_image}",
            "check its kind and that it is counted in inner corners (chessboard), circles, or "
            "squares (charuco), columns before rows, and show each side of a chessboard",
        ),
        mirrored_image=(
            "the {view} camera's image is mirrored: it shows no tag, its mirror image {tags}",
            "switch off mirror or flip of the {view} camera",
        ),
        other_dictionary=(
            "{count} tags are of {name}, none of {of_name}",
            "set markers.dictionary: {name}, or print tags of {of_name}",
        ),
        unknown_tags=(
            "{tags} {are} there, and markers has none of them",
            "name the corners of the tags on the tool (4 t + k) in markers.numbers",
        ),
        no_tag=(
            "there is no tag of {name}",
            "turn the tool towards it; look at light, focus and white margins; tags below {limit} "
            "({amount} a cell) are too small: print larger ones, or move the camera nearer",
        ),
        small_tag=(
            "{markers} is {part} wide, {amount} a cell ({limit} at least)",
            "print larger tags, move the camera nearer, or raise its size_px",
        ),
        tags_seen=("tags {widths}{corners}",),
        board_seen=("{name} with {rest} of {of_rest} corners, to {amount}",),
    )
    | _about(
        "",
        all_repeated=("each tag is more than once in its image, {count} in all, and rejected", _UNIQUE),
        no_tags=(
            "no tag in any of {count} images",
            "check that --dictionary is that of your tags, and that a bright margin of one cell "
            "surrounds each",
        ),
        other_board=(
            "no {name} in {any_image}, but tags {rest} to {of_rest} of its dictionary, and the board has"
            " {ends}",
            "name its first tag, --board {as_board} or markers.board.first: {rest}",
        ),
        mirrored_files=(
            "the {view} images are mirrored: {count} of {total} show tags in the mirror, and none as "
            "they are",
            "switch mirroring off in the driver, or mirror the files",
        ),
        rejected_markers=(
            "all {count} markers that were found are rejected, since their edges are not clean",
            "look for occlusion, blur, or cells of few pixels",
        ),
        unpaired_images=(
            "no tag was seen by {two} cameras at the same pose",
            "check the pairing of the images",
        ),
        unmoved_camera=("the {view} camera has not moved, and its calibration is kept{views_off}",),
        other_view_off=(
            "{unshown} at these joint readings: they are wrong, or that camera moved as well",
            "home the joints, or calibrate again",
        ),
        view_off=("the {view} images are {amount} off ({limit} allowed)",),
        servo_supply=("{servo} has {amount} of supply ({part} to {of_part})", "look at the supply" + _SINKS),
        servo_sensor=("the angle sensor of {servo} fails", "replace it" + _SINKS),
        servo_heat=("{servo} is too hot, {amount}", "let it cool" + _SINKS),
        servo_current=("the current of {servo} is too high", "free it" + _SINKS),
        servo_overload=(
            "{servo} is overloaded, and pushes with a fifth of its torque",
            "free it from its obstacle, then start again" + _SINKS,
        ),
        impossible_reading=(
            "{servo} reads {amount}{after}: no joint turns so fast",
            "look at its gear and its cable",
        ),
        lost_port=("{name}; servos with power go on to their last set-points, and hold there",),
        silent_arm=("no servo answers any more: all joints may fall", "hold the arm, and look at its supply"),
        silent_servos=("{servos}: no answer any more: it may fall with its load", "check the cable to it"),
        unreleased_servos=("no answer from {servos}", "look at the cable to it, or switch the supply off"),
        set_point_beyond=("{servo}: {count} counts are beyond {rest} to {of_rest}",),
        torque_leap=(
            "{servo} turned by {amount} when its torque came on ({limit} at most)",
            "look what pulls at it",
        ),
        stands_beyond=(
            "nothing was moved: {servo} stands at {exact}, beyond its limits {between}",
            "move it there by hand. If others do too, this is another arm (is it the leader's port?), or"
            " it was homed since: projservo limits",
        ),
        torque_unknown=("whether torque is on is not known, since servos do not answer", "hold the arm"),
        torque_off=("torque is off: nothing holds the arm",),
        torque_in_part=("torque is on in {servos} alone", "hold the arm"),
        torque_on=("torque is on: the arm holds where it is", "projservo release lets go of it"),
        kept_range=(
            "{servo} stores other limits, {rest} to {of_rest} counts (registers 9 and 11), and was "
            "moved from {count} to {total}",
            "set them to 0 and 4095 with the tool of its maker, and run projservo limits again",
        ),
        short_range=(
            "{servo} was moved by {amount} ({limit} at least)",
            "move each joint through all that is allowed, and run projservo limits again",
        ),
        whole_turn=("{servo} was moved by {amount}, a whole turn or more", "its limits must be within one"),
        crossed_turn=(
            "{servo} was moved over the end of its turn, where servos go the long way round",
            "leave that place out, or run projservo limits --shift {of[0]}, which stores an offset in "
            "its servo",
        ),
        farthest_off=("markers {counts}, {joints} {size} off",),
        no_markers=(
            "{no} camera sees one of the {total} markers{looked}",
            "look whether they stand before {towards}, at light and focus, and whether the dictionary of "
            "the tags is right{here}",
        ),
        narrow_tags=(
            "tags are {part} wide in the {view} image{looked}, {amount} a cell ({limit} at least)",
            "take larger tags, nearer cameras, or more pixels",
        ),
        unseeing_camera=(
            "the {view} camera sees none of the {total} markers{looked}, the {other_view} one {count}",
            "turn it towards them, and look at its light and focus",
        ),
        faceless=("{sharing} marker {numbers} of the face at none of {count} poses", "turn it to them"),
        hidden_face=(
            "the {view} camera does not see marker {numbers} of the face",
            "turn the face towards {towards}",
        ),
        hidden_object=(
            "of the object {name}, {sharing} marker {some} ({total} at least)",
            "turn it towards {towards}, or leave it out of objects; --force teaches again",
        ),
        moved_in_images=("{joints} moved by {amount} while images were taken ({limit} at most)", _HANDS),
        moved_since_held=(
            "{joints} moved by {amount} since the arm was held again ({limit} at most)",
            _HANDS,
        ),
        limit_passed=("{joints} would be at {exact}, beyond its limits {between}",),
        not_read=("nothing was read before",),
        not_finite_command=("a set-point, its speed or its time is not finite",),
        reading_far=(
            "{joints} reads {exact}, its set-point is {exact_limit}",
            "check its unit and its encoder",
        ),
        set_point_ahead=(
            "the set-point of {joints}, {exact}, leads the reading too far: allowed is {between}",
        ),
        set_point_far=("the set-point of {joints}, {exact}, is too far from its last: allowed is {between}",),
        set_point_passed=("the set-point of {joints}, {exact}, is beyond its limits: allowed is {between}",),
        speed_passed=("the speed of {joints}, {exact}/s, is beyond its limit of {exact_limit}/s",),
        reading_leapt=(
            "{joints} read {part} and {amount} within {of_rest_s}",
            "check its encoder and unit, or what moved it",
        ),
        restless=(
            "{name} does not come to rest within {limit}",
            "look for what vibrates, creeps or flickers",
        ),
        stands_short=(
            "{sent}",
            "free the robot, or check its sag and backlash (plant.max_steady_state_error_deg)",
        ),
        moved_away=(
            "{sent}: it moved away from there, from {of_part}",
            "check its sign and unit, and whether it can hold its load",
        ),
        obstructed=("{sent}: {obstructions}", "take joints that it can reach and hold"),
        arm_touches=("the arm touches: {name}",),
        servos_at_end=("at the end of what their servos can do: {joints}",),
        dropped=("the {name} holds nothing, and should hold the object {of_name}", "look where that lies"),
        stays=("the {name} stays at {amount}",),
    )
    | _about(
        "{images}",
        few_shared=(
            "{sharing} only {count} of {total} markers{looked}{half} ({rest} at least{seen})",
            "turn the tool towards {towards}, and look at light, focus and what occludes it",
        ),
        shared_markers=("{share} {count} of {total} markers",),
        unshared_face=(
            "{lack} marker {numbers} of the face, {tags}",
            "turn the tool towards {towards}, or name another markers.face",
        ),
        flicker=(
            "corners scatter by {amount} at rest, {ratio} times their noise",
            "look for lamps that flicker, tables that shake, and autofocus",
        ),
    )
    | _about(
        "{towards}",
        alike_views=(
            "the cameras see the tags from directions {size} apart ({limit} at least)",
            "move them apart, by a third of their distance from the tool: depth shows in their difference",
        ),
        directions=("see the tags from directions {size} apart",),
    )
    | _about(
        "joints",
        joint_readings=("read {readings}",),
        not_moved=("were not moved: something above is a fault", "mend it first"),
    )
    | _about(
        "{joints}",
        joint_without_limits=("has no limits", "set robot.limits.joints, or run projservo limits"),
        joint_beyond_limits=(
            "reads {exact}, beyond its limits {between}",
            "move it back by hand; a reading far off has another unit or zero than the limits",
        ),
        joint_at_limit=(
            "reads {exact}, at its limits {between}",
            "move it away from there by hand",
        ),
        joint_without_room=("it has no room for {amount}", "move it away from its limit by hand"),
        held_joint=(
            "went {amount} of {limit}: it is held or too weak",
            "free it, and check the supply; if its sag or backlash is that large, raise "
            "plant.max_steady_state_error_deg",
        ),
        play=("{amounts}",),
        wide_play=(
            "{amounts}",
            "teach goals by images, which backlash does not move; look for a loose horn or screw",
        ),
        still_tags=(
            "turned, and no tag moved",
            "look whether the {carried} are on this arm, and that the images are live",
        ),
        still_joint=("turned, and no tag moved", "look at the order of the joints, and at their horns"),
        early_link=(
            "turned, and no tag moved: the {carried} sit on the link before joint {of[0]}",
            "mount them behind the last joint, on the fixed part of the tool and not on a moving jaw",
        ),
    )
    | _about(
        "arm",
        health=("{name}",),
    )
    | _about(
        "tags",
        loose_tag=(
            "{markers} moved by {amount} against the others",
            "glue it flat on a stiff part, all tags on the same one",
        ),
        fast_tags=("sit fast {place}",),
    )
    | _about(
        "calibration",
        agrees=("agrees with the images{within}",),
        unusable_calibration=("is not usable", "record and calibrate again"),
        uncompared=("was not compared: no marker of it is seen", "show the tags"),
        refuted=("{found}", "put that back, or record and calibrate again"),
        refit_poses=(
            "the {view} camera alone is off",
            "put the {view} camera back, or fit it again from {of_poses} poses, after which it errs by "
            "{amount} ({limit} before it moved)",
        ),
    )
)
