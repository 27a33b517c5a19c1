"""Projective geometry of a robot seen by a stereo rig: [RH00] sections 2 and 3."""
