"""The configuration of a run: YAML into frozen models, with errors that say where."""

from projservo_cli.config.loading import (
    Override,
    digest,
    load_config,
    load_sweep,
    overrides_of,
    plain_yaml,
    shipped,
    sweep_of,
    to_yaml,
)
from projservo_cli.config.models import Config

__all__ = [
    "Config",
    "Override",
    "digest",
    "load_config",
    "load_sweep",
    "overrides_of",
    "plain_yaml",
    "shipped",
    "sweep_of",
    "to_yaml",
]
