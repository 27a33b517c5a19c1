"""Worlds that plans and runs are made in: simulated ones, whose truth is known, and a calibrated one.

A world shows start and goal of a task and objects, drives its robot, and reports the end of a run, as far as
it knows. Plans and laws are given its calibration; the truth stays inside a simulated one.
"""
