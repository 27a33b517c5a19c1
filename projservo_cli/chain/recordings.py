"""The recording before a calibration: the pending part of its table, and its making."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from projservo_cli.chain.progress import Listener
from projservo_cli.config import Config
from projservo_cli.config.inputs import joints_of, recording_inputs
from projservo_cli.records import InputError, JointList, WorkFailed
from projservo_cli.result_hashes import digest
from projservo_cli.store.run_file import Run


def data_table(config: Config) -> Path:
    """Return the table of a configuration as one to be recorded; an InputError without."""
    if config.data is None:
        raise InputError("record needs a table to write: -o TABLE, or data.table in the configuration")
    if config.data.joint_unit == "deg":
        raise InputError("data.joint_unit: record writes rad; leave it out")
    return Path(config.data.table)


def pending_recording(config: Config, run: Run, motions: JointList | None, *, force: bool) -> Any:
    """Return the pending recording of the table of a calibration.

    motions : further poses after the trial motions.
    """
    from projservo_cli.stages.record import new_recording

    path, stored, inputs = data_table(config), run.results.get("calibrate"), recording_inputs(config)
    before = {} if stored is None else stored.inputs
    if before.get("table", str(path)) != str(path) and config.plant.simulated and not force:
        raise InputError(
            f"{run.path}: its calibration comes from {before['table']} and would be replaced by a simulated "
            "one; choose another folder, or use --force (force=True)"
        )
    found = new_recording(inputs, path, motions=motions, force=force, redo=True)
    contradicted = run.refuted and not found.why
    if not contradicted or before.get("table_sha256") != digest(path.read_bytes()):
        return found
    begun = new_recording(inputs, path, motions=motions, force=True)
    return replace(begun, why=f"the recording was contradicted: {run.refuted}")


def recording_made(listener: Listener, config: Config, recording: Any, *, confirm: bool) -> WorkFailed | None:
    """Record the pending poses, and report its progress on an interrupt; return a failure."""
    from projservo_cli.stages.record import record_poses

    if recording.pending and confirm:
        listener.confirm("record", config.plant)
    total, units = len(recording.targets), joints_of(config).joints().units

    def progress(what: str, done: int, whole: int) -> None:
        listener.progress(what, done, whole, recording.note(units))

    if recording.found and recording.pending:
        listener.say(f"{recording.path}: continued after {recording.found} of {total} poses")
    try:
        record_poses(recording_inputs(config), recording, progress=progress)
    except WorkFailed as error:
        return WorkFailed(" ".join(error.reason.split()), findings=error.findings)
    except KeyboardInterrupt:
        listener.say(f"{recording.path}: {len(recording.done)} of {total} poses; run again to continue")
        raise
    return None
