"""Which stages of a run need a GPU, so that a server can limit how many do at once."""

from __future__ import annotations

from pathlib import Path

from genassets.pipeline.plan import Workflow

GPU_TAG = "gpu"
NVIDIA_DEVICE = Path("/dev/nvidiactl")


def stages_on_gpu(workflow: Workflow) -> frozenset[str]:
    """Stages whose config puts them on a GPU: by name, or by "auto" where the machine has one."""
    wanted = {"cuda", "auto"} if NVIDIA_DEVICE.exists() else {"cuda"}
    return frozenset(
        step.stage.name
        for step in workflow.steps()
        if getattr(workflow.experiment.config(step.stage.name, step.shard), "device", None) in wanted
    )
