"""Stages in their order: what is outdated, made, kept and dropped."""
