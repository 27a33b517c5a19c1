"""The configuration of a run: YAML into frozen models, with errors that say where."""

from projservo_cli.config.loading import (
    Config,
    Override,
    checked_values,
    load_config,
    load_sweep,
    overridden,
    plain_yaml,
    shipped,
    stored_yaml,
    to_goals,
    to_yaml,
)

__all__ = [
    "Config",
    "Override",
    "checked_values",
    "load_config",
    "load_sweep",
    "overridden",
    "plain_yaml",
    "shipped",
    "stored_yaml",
    "to_goals",
    "to_yaml",
]
