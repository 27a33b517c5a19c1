"""Which configuration and which run file a call is about."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from projservo_cli.config import Config, Override, load_config, to_yaml
from projservo_cli.files import require_inside
from projservo_cli.records import InputError
from projservo_cli.store import Run, load, run_path

_RESULTS = Path("results")
_KEYS = {  # that options stand for
    "data": ("data", "table"),
    "joints": ("data", "joints"),
    "joint_unit": ("data", "joint_unit"),
    "noise_px": ("data", "noise_px"),
    "init": ("calibration", "init"),
    "cross_validate": ("calibration", "cross_validate"),
    "lens": ("calibration", "lens"),
}


def resolve(options: Mapping[str, Any]) -> tuple[Config, Run]:
    """The configuration with all overrides, and the run as stored so far.

    Raises InputError when either cannot be read or makes no sense.
    """
    overrides = given_overrides(options)
    if options.get("origin") is not None:
        return _from_sweep(options["origin"], options, overrides)
    stored = _stored(options["output"]) if options["output"] else None
    if options["config"]:
        config = load_config(options["config"], overrides)
    elif stored is not None and stored.configuration:
        config = load_config(stored.path, overrides, text=stored.configuration)
    elif options["data"]:
        config = load_config(None, overrides)
    else:
        config = load_config(shipped(), overrides)
    target = _target(options, config)
    return config, stored or _stored(target) or Run(target)


def _from_sweep(origin: str, options: Mapping[str, Any], overrides: list[Override]) -> tuple[Config, Run]:
    """Configuration of a run of a sweep, and a run that holds the calibration it was made with."""
    if options["config"]:
        raise InputError("-c and --from: the configuration is that of the sweep; leave -c out")
    from projservo_cli.sweep.folder import run_of

    config, calibration = run_of(origin)
    if overrides:
        config = load_config(config.name, overrides, text=to_yaml(config))
    target = _target(options, config)
    run = _stored(target) or Run(target)
    stored = run.results.get("calibrate")
    if calibration is not None and (stored is None or stored.key != calibration.key):
        run = Run(target, run.configuration, {"calibrate": calibration})
    return config, run


def _target(options: Mapping[str, Any], config: Config) -> Path:
    """The run file: where the user says, else in the folder of the configuration's name."""
    if options["output"]:
        return run_path(options["output"])
    folder = _RESULTS / config.name
    require_inside(folder, _RESULTS)
    return run_path(folder)


def _stored(target: str | Path) -> Run | None:
    """The run in a folder or file; None where there is none yet."""
    return load(target) if run_path(target).exists() else None


def shipped(name: str = "paper.yaml") -> Path:
    """A configuration that comes with projservo, in a checkout as in an installed package.

    Raises InputError when the installation lacks it.
    """
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / name).is_file():
            return folder / name
    raise InputError(f"{name}: this installation lacks it; give a configuration with -c")


def given_overrides(options: Mapping[str, Any]) -> list[Override]:
    """Options that stand for keys of the configuration, then ``--set``, then ``--speed-scale``."""
    found = []
    for name, key in _KEYS.items():
        given = options.get(name)
        if given is None or given is False:
            continue
        flag = f"--{name.replace('_', '-')}" + ("" if given is True else f" {given}")
        value = os.path.abspath(given) if key[1] in ("table", "init") else given
        found.append(Override(flag, key, value))
    if (size := options.get("image_size")) is not None:  # such as 1280x1024
        sides = size.lower().replace("x", ", ")
        found.append(Override.parse(f"data.image_size_px=[{sides}]", f"--image-size {size}"))
    found += map(Override.parse, options["sets"])
    if (scale := options.get("speed_scale")) is not None:  # --set plant=… would else undo it
        found.append(Override(f"--speed-scale {scale}", ("plant", "speed_scale"), scale))
    return found
