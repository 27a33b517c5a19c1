"""Simulated robots: ground truth, the ideal plant, faults, and cameras that MuJoCo renders."""
