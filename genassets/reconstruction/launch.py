"""Several processes for one job: torchrun starts them, and what they say comes back through a pipe.

    python -m torch.distributed.run --standalone --nproc-per-node 2 -m genassets.reconstruction.launch job.json

Each line on standard output is a JSON list: ["curve", name, step, value], ["progress", done, total, message],
["done", counts] of the first process, or ["failed", exit code, message] of any. Standard input says nothing; where it
ends, whoever started the processes is gone, and they end too.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import traceback
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import torch
from filelock import FileLock

from genassets.errors import StageError
from genassets.reconstruction.job import Job
from genassets.reconstruction.processes import connect
from genassets.reconstruction.training import Curve, Progress

LOG = "processes.log"
"""What the processes write to standard error, in the job's work_dir."""

LOG_LINES = 20
"""Last lines of it that are told where a process ended without a word."""

SECONDS_TO_END = 60.0
"""How long processes have that are told to end, and those of a run that was killed until the next one is refused."""


def run_together(job: Job, progress: Progress, curve: Curve) -> dict[str, int]:
    """Run a job in as many processes as it asks for; returns what was counted.

    Raises:
        StageError: a process failed; what it said, or the end of its log. All others are ended.
    """
    description = job.work_dir / "job.json"
    description.write_text(job.model_dump_json(indent=1), encoding="utf-8")
    count = job.compute.processes
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count)]
    command += ["-m", "genassets.reconstruction.launch", str(description)]
    threads = str(max(torch.get_num_threads() // count, 1))
    log = job.work_dir / LOG
    with (
        log.open("wb") as errors,
        subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            env={**os.environ, "OMP_NUM_THREADS": threads},
            text=True,
        ) as started,
    ):
        try:
            said = _listen(started, progress, curve)
        finally:
            _end(started)
    if isinstance(said, StageError):
        raise said
    if said is None or started.returncode:
        raise StageError(_silent_end(log, started.returncode))
    return said


def _listen(
    started: subprocess.Popen[str], progress: Progress, curve: Curve
) -> dict[str, int] | StageError | None:
    """Pass on what the processes say until all have ended; what was counted, or the first error."""
    heard: dict[str, int] | StageError | None = None
    assert started.stdout is not None
    for line in started.stdout:
        try:
            kind, *values = json.loads(line)
        except ValueError:
            continue  # what a library printed
        if kind == "curve":
            curve(*values)
        elif kind == "progress":
            progress(*values)
        elif kind == "done":
            heard = values[0]
        elif kind == "failed" and not isinstance(heard, StageError):
            heard = StageError(values[0])
    return heard


def _end(started: subprocess.Popen[str]) -> None:
    """End the processes, which end with their standard input, and torchrun with them."""
    assert started.stdin is not None
    started.stdin.close()
    try:
        started.wait(SECONDS_TO_END)
    except subprocess.TimeoutExpired:
        started.kill()


def _silent_end(log: Path, code: int) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()[-LOG_LINES:]
    return (
        f"reconstruct: the processes of this training ended with code {code} and said nothing; one may have been "
        "killed for its memory. The last checkpoint is kept: run again, or with reconstruct.processes=1. "
        f"The end of {log}:\n" + "\n".join(lines)
    )


def main() -> None:
    """One of the processes."""
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)  # what libraries print goes to the log

    def say(*words: object) -> None:
        channel.write(json.dumps(words) + "\n")

    threading.Thread(target=_end_with_standard_input, daemon=True).start()
    job = Job.model_validate_json(Path(sys.argv[1]).read_text(encoding="utf-8"))
    try:
        processes = connect(job.compute)
        # One that the last run left behind may be about to end, but must not write a checkpoint any more.
        with nullcontext() if processes.rank else FileLock(job.work_dir / "training.lock", SECONDS_TO_END):
            counts = job.run(processes, partial(say, "progress"), partial(say, "curve"))
    except Exception as error:
        traceback.print_exc()
        say("failed", str(error) if isinstance(error, StageError) else f"{type(error).__name__}: {error}")
        channel.close()
        os._exit(1)  # the others wait for this one; torchrun ends them
    if not processes.rank:
        say("done", counts)


def _end_with_standard_input() -> None:
    while os.read(0, 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
