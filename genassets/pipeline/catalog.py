"""The stages there are, in an order in which each comes after what it needs."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from pydantic import BaseModel

from genassets.stages import (
    augment,
    evaluate_completion,
    evaluate_detector,
    evaluate_generation,
    evaluate_reconstruction,
    evaluate_sampling,
    evaluate_speed_error,
    evaluate_turns,
    export,
    filter_occlusion,
    generate,
    ingest,
    prepare_masks,
    reconstruct,
    train_detector,
    train_prior,
    turntables,
    write_dataset,
)
from genassets.stages.stage import Stage

CATALOG: tuple[Stage, ...] = (
    ingest.STAGE,
    prepare_masks.STAGE,
    filter_occlusion.STAGE,
    reconstruct.STAGE,
    evaluate_reconstruction.STAGE,
    evaluate_turns.STAGE,
    turntables.STAGE,
    train_prior.STAGE,
    generate.STAGE,
    export.STAGE,
    evaluate_generation.STAGE,
    evaluate_sampling.STAGE,
    evaluate_completion.STAGE,
    evaluate_speed_error.STAGE,
    augment.STAGE,
    write_dataset.STAGE,
    train_detector.STAGE,
    evaluate_detector.STAGE,
)


def configs(catalog: Iterable[Stage]) -> dict[str, type[BaseModel]]:
    """Config model of each stage, by name."""
    return {stage.name: stage.config for stage in catalog}


def wanted_stages(
    catalog: Iterable[Stage], names: Iterable[str] | None, planned: Collection[str] = ()
) -> tuple[Stage, ...]:
    """The named stages and all that they need, in the catalog's order; for None all that don't wait to be named.

    Of what they use only stages in ``planned`` come along.
    """
    ordered = tuple(catalog)
    by_name: Mapping[str, Stage] = {stage.name: stage for stage in ordered}
    if names is None:
        names = [stage.name for stage in ordered if not stage.on_request]
    wanted: set[str] = set()
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        if name not in wanted:
            wanted.add(name)
            waiting.extend(by_name[name].needs)
            waiting.extend(used for used in by_name[name].uses if used in planned)
    return tuple(stage for stage in ordered if stage.name in wanted)


def dependents(stages: Iterable[Stage], name: str) -> set[str]:
    """A stage and all that hang on it, directly or not."""
    found = {name}
    for stage in stages:  # in order, so one pass is enough
        if found.intersection((*stage.needs, *stage.uses)):
            found.add(stage.name)
    return found
