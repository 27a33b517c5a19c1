"""The configuration of a run: YAML into frozen models, with errors that say where."""

from projservo_cli.config.loading import (
    Config,
    Override,
    load_config,
    load_sweep,
    overrides_of,
    plain_yaml,
    shipped,
    stored_yaml,
    sweep_of,
    to_goals,
    to_yaml,
)

__all__ = [
    "Config",
    "Override",
    "load_config",
    "load_sweep",
    "overrides_of",
    "plain_yaml",
    "shipped",
    "stored_yaml",
    "sweep_of",
    "to_goals",
    "to_yaml",
]
