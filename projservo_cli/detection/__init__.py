"""Markers found in stereo images: ArUco and AprilTag corners to a fraction of a pixel."""

from projservo_cli.detection.pairs import Findings, Pair, observe, pair_images

__all__ = ["Findings", "Pair", "observe", "pair_images"]
