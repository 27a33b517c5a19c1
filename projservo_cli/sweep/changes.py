"""Values of a sweep put into a configuration."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from projservo_cli.config import Config, Override, load_config, to_yaml
from projservo_cli.config.sweep import LAW
from projservo_cli.modes import law_and_mode


def changed(config: Config, values: Mapping[str, Any], what: str) -> Config:
    """A configuration with other values.

    Raises
    ------
    InputError
        If a value is not one that its key takes.
    """
    resolved = config.model_dump(mode="json")
    try:
        for key, value in values.items():
            _put(resolved, key.split("."), value)
        return Config.model_validate(resolved)
    except (ValueError, KeyError, IndexError, TypeError):
        given = [override(what, key, value) for key, value in values.items()]
        load_config(config.name, given, text=to_yaml(config))  # says what is wrong in the user's words
        raise


def _put(values: Any, path: Sequence[str], value: Any) -> None:
    for step in path[:-1]:
        values = values[int(step)] if isinstance(values, list) else values[step]
    if isinstance(values, list):
        values[int(path[-1])] = value
    else:
        values[path[-1]] = value


def override(what: str, key: str, value: Any) -> Override:
    """A value as an override, which messages call by what it is of."""
    path = tuple(int(step) if step.isdecimal() and i else step for i, step in enumerate(key.split(".")))
    return Override(f"{what}: {key}={json.dumps(value)}", path, value)


def overrides(what: str, key: str, value: Any) -> list[Override]:
    """A value as overrides; that of a law sets its mode too where its name tells one."""
    if key != LAW:
        return [override(what, key, value)]
    flag = f"{what}: {key}={json.dumps(value)}"
    law, mode = law_and_mode(value)
    found = [Override(flag, ("control", "laws"), [law])]
    return found if law == value else [*found, Override(flag, ("control", "mode"), [mode])]
