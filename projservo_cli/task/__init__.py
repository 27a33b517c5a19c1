"""The reaching task as a translation and two rotations that keep the face visible: [RH00] section 4."""
