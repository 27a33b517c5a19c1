"""Which configuration and which run file a call is about."""

import os
from pathlib import Path
from typing import Any

from projservo_cli.config import Config, Override, load_config, to_yaml
from projservo_cli.files import require_inside
from projservo_cli.records import InputError
from projservo_cli.store import Run, load, run_path

SHIPPED = "paper.yaml"
RESULTS = Path("results")


def resolve(options: dict[str, Any]) -> tuple[Config, Run]:
    """The configuration with all overrides, and the run as stored so far.

    Raises
    ------
    InputError
        When either cannot be read or makes no sense.
    """
    overrides = given_overrides(options)
    if options["origin"] is not None:
        return _from_sweep(options["origin"], options, overrides)
    stored = stored_run(options["output"]) if options["output"] else None
    if options["config"]:
        config = load_config(options["config"], overrides)
    elif stored is not None and stored.configuration:
        config = load_config(stored.path, overrides, text=stored.configuration)
    elif options["data"]:
        config = load_config(None, overrides)
    else:
        config = load_config(shipped(SHIPPED), overrides)
    target = _target(options, config)
    return config, stored or stored_run(target) or Run(target)


def _from_sweep(origin: str, options: dict[str, Any], overrides: list[Override]) -> tuple[Config, Run]:
    """Configuration of a run of a sweep, and a run that holds the calibration it was made with."""
    if options["config"]:
        raise InputError("-c and --from: the configuration is that of the sweep; leave -c out")
    from projservo_cli.sweep.folder import run_of

    config, calibration = run_of(origin)
    if overrides:
        config = load_config(config.name, overrides, text=to_yaml(config))
    target = _target(options, config)
    run = stored_run(target) or Run(target)
    stored = run.results.get("calibrate")
    if calibration is not None and (stored is None or stored.key != calibration.key):
        run = Run(target, run.configuration, {"calibrate": calibration})
    return config, run


def _target(options: dict[str, Any], config: Config) -> Path:
    """The run file: where the user says, else in the folder of the configuration's name."""
    if options["output"]:
        return run_path(options["output"])
    folder = RESULTS / config.name
    require_inside(folder, RESULTS)
    return run_path(folder)


def stored_run(target: str | Path) -> Run | None:
    """The run in a folder or file; None where there is none yet."""
    return load(target) if run_path(target).exists() else None


def shipped(name: str) -> Path:
    """A configuration that comes with projservo, in a checkout as in an installed package.

    Raises
    ------
    InputError
        When the installation lacks it.
    """
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "configs", package.parent / "configs"):
        if (folder / name).is_file():
            return folder / name
    raise InputError(f"{name}: this installation lacks it; give a configuration with -c")


def given_overrides(options: dict[str, Any]) -> list[Override]:
    """Options that stand for values of the configuration, then ``--set``, then ``--speed-scale``."""
    found = []
    if options["data"] is not None:
        table = os.path.abspath(options["data"])
        found.append(Override(f"--data {options['data']}", ("data", "table"), table))
    if options["joints"] is not None:
        found.append(Override(f"--joints {options['joints']}", ("data", "joints"), options["joints"]))
    if options["joint_unit"] is not None:
        unit = options["joint_unit"]
        found.append(Override(f"--joint-unit {unit}", ("data", "joint_unit"), unit))
    if options["noise_px"] is not None:
        found.append(
            Override.parse(f"data.noise_px={options['noise_px']}", f"--noise-px {options['noise_px']}")
        )
    if options["cross_validate"] is not None:
        folds = options["cross_validate"]
        found.append(Override.parse(f"calibration.cross_validate={folds}", f"--cross-validate {folds}"))
    if options["init"] is not None:
        path = os.path.abspath(options["init"])
        found.append(Override(f"--init {options['init']}", ("calibration", "init"), path))
    if options["lens"]:
        found.append(Override("--lens", ("calibration", "lens"), True))
    if options["image_size"] is not None:
        found.append(_image_size(options["image_size"]))
    found += map(Override.parse, options["sets"])
    if options["speed_scale"] is not None:  # after --set plant=…, which would else make a robot faster again
        scale = options["speed_scale"]
        found.append(Override.parse(f"plant.speed_scale={scale}", f"--speed-scale {scale}"))
    return found


def _image_size(text: str) -> Override:
    """``--image-size 1280x1024``."""
    flag = f"--image-size {text}"
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(side.isascii() and side.isdigit() for side in sides):
        raise InputError(f"{flag}: expected width and height in px, such as 1280x1024")
    return Override(flag, ("data", "image_size_px"), [int(side) for side in sides])
