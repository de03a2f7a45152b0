"""What a run needs from the machine and from other runs, checked before any of its work."""

from __future__ import annotations

from genassets import weights
from genassets.errors import WeightsError
from genassets.pipeline.plan import Workflow, make_plan


def check_needs(workflow: Workflow) -> None:
    """Check outputs of other runs and pretrained files.

    Raises:
        SpecError, WeightsError: something is missing.
    """
    check_borrowed_outputs(workflow)
    check_pretrained_files(workflow)


def check_borrowed_outputs(workflow: Workflow) -> None:
    """Find every output of another run that a stage reads.

    Raises:
        SpecError: one is not there.
    """
    for step in workflow.steps():
        workflow.borrowed(step)


def check_pretrained_files(workflow: Workflow) -> None:
    """Check the pretrained files of all stages that have to run.

    Raises:
        WeightsError: one is missing or altered; names file, digest, stage and the setting that does without.
    """
    lacking = {
        stage.name: [
            f"stage {stage.name}: {found.problem()} To run without it: --set {setting}"
            for name, setting in stage.pretrained(config).items()
            if (found := weights.status(name)).state != "valid"
        ]
        for stage in workflow.stages
        for config in [workflow.experiment.config(stage.name, workflow.shards[0])]
    }
    if not any(lacking.values()):
        return  # so that the plan, which reads every file of a new log, is made once
    only = workflow.selection.only
    running = {item.step.stage.name for item in make_plan(workflow) if item.action == "run"}
    problems = [
        problem
        for stage, found in lacking.items()
        if stage in running and only in (None, stage)
        for problem in found
    ]
    if problems:
        raise WeightsError("\n".join(problems))
