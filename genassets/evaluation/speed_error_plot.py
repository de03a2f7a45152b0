"""The plot of rendering's speed against its error."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from genassets.evaluation.speed_error import EXACT


def speed_error_plot(
    points: pd.DataFrame,
    seconds: str = "seconds for all crops",
    quality: str = "PSNR to the exact mode, dB",
) -> NDArray[np.uint8]:
    """Every point of `evaluation.speed_error.measure`, with its columns pareto and knee, as an image (h, w, 3).

    Seconds run to the right, dB to the exact mode upwards: good is up and to the left. The exact mode itself has
    no error and is left out.

    Args:
        seconds, quality: what is written along the axes.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 5.5), dpi=110, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    shown = points[points["lever"] != EXACT].dropna(subset=["psnr_to_exact"])
    for lever, part in shown.groupby("lever", sort=False):
        axes.plot(part["seconds"], part["psnr_to_exact"], "o", markersize=5, label=lever)
    rows: Iterable[Any] = shown.itertuples()
    for row in rows:
        axes.annotate(
            row.value,
            (row.seconds, row.psnr_to_exact),
            textcoords="offset points",
            xytext=(4, 3),
            fontsize=6.5,
            color="#555555",
        )
    front = shown[shown["pareto"]].sort_values("seconds")
    axes.step(front["seconds"], front["psnr_to_exact"], where="post", color="#888888", linewidth=1)
    best = shown[shown["knee"]]
    axes.plot(
        best["seconds"],
        best["psnr_to_exact"],
        "o",
        markersize=13,
        markerfacecolor="none",
        color="black",
        label="knee",
    )
    axes.set_xscale("log")
    axes.set_xlabel(seconds)
    axes.set_ylabel(quality)
    axes.grid(True, which="both", linewidth=0.3)
    axes.legend(fontsize=7, ncols=2)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
