"""Paths through joint space that keep the face in sight: goals, validity, search, timing."""
