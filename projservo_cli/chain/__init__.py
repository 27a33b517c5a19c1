"""Stages in their order: outdated, made, kept and dropped results."""
