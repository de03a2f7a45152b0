"""A reconstruction from prepared logs to the library, as one process does it or several do together."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import pandas as pd
from pydantic import BaseModel, ConfigDict

from genassets.reconstruction.actor_colour import with_colours
from genassets.reconstruction.adaptation import adapted_model, check_new_logs, extended, unknown_classes
from genassets.reconstruction.latent_prior import LatentPull
from genassets.reconstruction.library import load_library, make_library, save_library
from genassets.reconstruction.model import AssetModel
from genassets.reconstruction.pages import Pages
from genassets.reconstruction.processes import Processes
from genassets.reconstruction.settings import ComputeSettings, ReconstructionSettings
from genassets.reconstruction.training import Curve, Progress, build_model, train
from genassets.reconstruction.training_log import PreparedLogs


class Job(BaseModel):
    """Where the prepared logs lie, where checkpoints and the library go, and how to learn.

    library: that which is adapted, if any, from codes of `start`; extend: the result holds its actors too.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    prepared: Path
    work_dir: Path
    out: Path
    settings: ReconstructionSettings
    seed: int
    library: Path | None
    start: Literal["random", "class_mean", "nearest"]
    extend: bool = False
    compute: ComputeSettings

    def run(
        self,
        processes: Processes,
        progress: Progress,
        curve: Curve,
        pull_of: Callable[[AssetModel, pd.DataFrame], LatentPull] | None = None,
    ) -> dict[str, int]:
        """Learn, from the last checkpoint where there is one; returns what was counted.

        pull_of: the pull of a prior at the codes of a model and its table of assets, if one pulls.

        Every one of several processes calls this; the first writes the library into `out`.
        """
        data = PreparedLogs(self.prepared)
        known = None if self.library is None else load_library(self.library)
        if known is not None and self.extend:
            check_new_logs(known, [log.scene.log_name for log in data])
        assets = with_colours(data.assets, data)
        names, counts = [log.scene.log_name for log in data], {"actors": len(assets)}
        pages = self._pages(processes)
        if known is None:
            place = [] if pages is None else [pages.place]
            model = build_model(assets, names, self.settings, self.seed, *place)
        else:
            model = adapted_model(known, assets, names, self.settings, self.start, self.seed)
            unknown = assets["actor_class"].isin(unknown_classes(known.assets, assets))
            counts["actors_of_classes_that_the_library_lacks"] = int(unknown.sum())
        model.to(processes.device)
        train(
            model,
            data,
            self.settings,
            self.seed,
            self.work_dir,
            progress,
            curve,
            None if pull_of is None else pull_of(model, assets),
            pages=pages,
            processes=processes,
        )
        if not processes.rank:
            library = make_library(
                assets, model, self.settings, [d.scene for d in data], [d.occupancy for d in data]
            )
            if known is not None and self.extend:
                library = extended(known, library)
            save_library(library, self.out, *([] if pages is None else [pages.release]))
        counts["views"] = sum(len(d.views) for d in data)
        counts["parameters"] = sum(p.numel() for p in model.parameters())
        counts["learned_parameters"] = sum(p.numel() for p in model.parameters() if p.requires_grad)
        return counts

    def _pages(self, processes: Processes) -> Pages | None:
        """A process's own pages; a GPU computes with what is in its memory, so everything is there."""
        if processes.device.type != "cpu":
            return None
        return Pages(self.work_dir / (f"pages.{processes.rank}.bin" if processes.rank else "pages.bin"))
