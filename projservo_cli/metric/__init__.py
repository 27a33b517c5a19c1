"""Metric of a calibrated arm: its frame, deviations from a model, and errors of measured positions."""
