"""Configurations to start from for arms that people build."""

from projservo_cli.records import InputError

_SO101 = """\
# yaml-language-server: $schema=projservo.schema.json

# An SO-101, or an SO-100, before two webcams: docs/tutorials/so101.md leads through it.
# Keys name their units.
name: arm

plant:
  use: so101
  # port: auto takes the only port on which all servos answer; else /dev/ttyACM0, COM3, ...
  # ids: servos of the joints, base to tool. gripper: its servo, which holds; null for an arm without.
  options: {port: auto, ids: [1, 2, 3, 4, 5], gripper: 6}
  # How far a joint at rest may stay from its set-point: such arms sag by 2 degrees under load.
  max_steady_state_error_deg: 4
  # Images of each pose that record averages.
  averaged_frames: 5

# projservo limits writes robot.limits here. Nothing moves without.

cameras:
  # An index, a device that keeps its name (/dev/v4l/by-path/...), or a URL. Two webcams want two USB ports.
  left: {source: 0, size_px: [640, 480]}
  right: {source: 2, size_px: [640, 480]}

markers:
  # projservo tags --kind roof --size-mm 30 prints them. The face is tag 0, in the middle.
  tags: roof
  tag_size_m: 0.03

data: {table: trials.csv, joints: RRRRR}

calibration:
  # Each joint goes this far to either side of the start, where both cameras must still see tags.
  amplitude_deg: 20
  frames_per_joint: 6

task:
  start: start.yaml  # projservo teach --start writes it
  goal: goal.yaml    # projservo teach writes it

trajectory: {profile: auto}

control:
  laws: [exact]
  mode: track
  period_s: 0.05
  joint_speed_limit_deg_s: 40

# Steps of a count, 0.09 degrees, make half a pixel. A joint with a degree of hysteresis answers late.
stop: {image_error_px: 0.5, stall_periods: 100}
"""
_ARMS = {"so101": _SO101}


def starter_for(arm: str) -> str:
    """Return the text of a configuration for a kind of arm; an InputError where there is none of its name."""
    if arm not in _ARMS:
        raise InputError(f"--arm {arm}: is none of {', '.join(_ARMS)}")
    return _ARMS[arm]
