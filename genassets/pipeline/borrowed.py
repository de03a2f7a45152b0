"""Outputs of other runs: found by directory, run id or experiment, and known by their content."""

from __future__ import annotations

import os
from pathlib import Path

from genassets.errors import SpecError
from genassets.pipeline.file_digests import FileMemory, sha256_of
from genassets.pipeline.run_record import RunRecord, list_runs
from genassets.pipeline.store import MANIFEST, content_digest
from genassets.stages.stage import Borrowed


def find_output(borrowed: Borrowed, runs: Path) -> Path:
    """The directory of another run's output; ``runs`` holds all runs. What has a slash is a directory.

    Raises:
        SpecError: there is none.
    """
    stage, where = borrowed.stage, borrowed.where
    named_so = f"{borrowed.setting} is {where!r}"
    if os.sep in where:
        path = Path(where).expanduser().resolve()
        if not path.is_dir():
            raise SpecError(f"{named_so}: no such directory; expected the output of stage {stage}")
        return path
    records = [RunRecord.load(path) for path in list_runs(runs)]
    named = [record for record in records if where in (record.run_id, record.experiment)]
    for record in reversed(named):
        for step in record.stages:
            if step.name == stage and step.status == "completed" and step.path and Path(step.path).is_dir():
                return Path(step.path)
    if named:
        raise SpecError(
            f"{named_so}: none of its runs has a finished {stage} (newest: {named[-1].run_id}, "
            f"{named[-1].status}); finish it with: genassets resume {named[-1].run_id}"
        )
    known = ", ".join(dict.fromkeys(record.experiment for record in reversed(records))) or "none"
    raise SpecError(
        f"{named_so}: no run of this id and no run of this experiment below {runs} (experiments that ran: "
        f"{known}); run it first (genassets run {where}), or give a directory, with a slash in it"
    )


def output_digest(path: Path, memory: FileMemory) -> str:
    """Content digest of a stage's output, as in the store, wherever it lies."""
    files = {
        file.relative_to(path).as_posix(): {"sha256": memory.of(file, sha256_of)}
        for file in path.rglob("*")
        if file.is_file() and file.name != MANIFEST
    }
    return content_digest(files)
