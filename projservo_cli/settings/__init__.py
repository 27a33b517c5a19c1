"""Sections of a configuration, below the stages that take them: checked values, and their units resolved."""
