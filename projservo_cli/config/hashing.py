"""A configuration as text: resolved YAML to store, canonical JSON to hash."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

import yaml
from pydantic import BaseModel

from projservo_cli.config.models import Config


def to_yaml(config: Config) -> str:
    """The whole configuration, defaults written out, as YAML that loads to an equal one."""
    values = _without_unset(config)
    return yaml.dump(
        values, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100
    )


def digest(
    config: Config,
    keys: Sequence[str],
    *,
    without: Sequence[str] = (),
    extra: Mapping[str, Any] | None = None,
) -> str:
    """SHA-256 of parts of a configuration, in hexadecimal.

    ``keys`` are sections such as ``control``, or values in them such as ``noise.servo_px``, in any order,
    less the values ``without``, such as ``control.laws``; ``extra`` are further JSON values.
    """
    values = config.model_dump(mode="json")
    for section, key in (dotted.split(".") for dotted in without):
        (values[section] or {}).pop(key, None)
    parts = {dotted: _part(values, dotted.split(".")) for dotted in keys}
    text = json.dumps([parts, extra or {}], sort_keys=True, allow_nan=False, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _part(values: Any, path: Sequence[str]) -> Any:
    """The value at a path; None in a section that is absent."""
    for key in path:
        values = None if values is None else values[key]
    return values


def _without_unset(value: Any) -> Any:
    """Plain values, less those that are absent by default; a null that overrides a default stays."""
    if isinstance(value, BaseModel):
        fields = type(value).model_fields
        return {
            key: _without_unset(inner)
            for key, inner in value
            if inner is not None or key not in fields or fields[key].default is not None
        }
    return [_without_unset(inner) for inner in value] if isinstance(value, tuple) else value


class _Dumper(yaml.SafeDumper):
    """Dumps without aliases, so that every value stands where it is read."""

    def ignore_aliases(self, data: Any) -> bool:
        return True
