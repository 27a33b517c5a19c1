"""Fault detection in the loop: images that disagree with the calibration, and their explanations."""
