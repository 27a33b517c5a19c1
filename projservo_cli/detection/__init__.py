"""Markers in images: files and grey values, corners of tags and boards, and the table of all images."""
