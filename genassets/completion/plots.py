"""Plots of completion against truth: over views with and without the prior, and speed against error."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

AXES = {"psnr": "PSNR all around, dB", "chamfer": "Chamfer distance, m"}
NAMES = {"prior": "with the prior", "alone": "without, equal seconds", "class_mean": "mean of the class"}


def view_curves(table: pd.DataFrame) -> NDArray[np.uint8]:
    """Means by source, views and contender (`measure.means`) as an image (h, w, 3): a column a source."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    sources = list(dict.fromkeys(table["source"]))
    figure = Figure(figsize=(4.6 * len(sources), 6.4), dpi=110, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(len(AXES), len(sources), squeeze=False, sharex=True, sharey="row")
    for column, source in enumerate(sources):
        for row, (measure, label) in enumerate(AXES.items()):
            axes = panels[row][column]
            for name, title in NAMES.items():
                part = table[(table["source"] == source) & (table["contender"] == name)].sort_values("views")
                axes.plot(part["views"], part[measure], "o-", markersize=4, label=title)
            axes.set_xscale("log", base=2)
            axes.set_xticks(
                sorted(set(table["views"])), [str(views) for views in sorted(set(table["views"]))]
            )
            axes.grid(True, linewidth=0.3)
            if column == 0:
                axes.set_ylabel(label)
        panels[0][column].set_title(f"from {source}")
        panels[-1][column].set_xlabel(
            "images" if source == "image" else "sweeps" if source == "lidar" else "frames"
        )
    panels[0][0].legend(fontsize=8)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def sweep_plot(table: pd.DataFrame) -> NDArray[np.uint8]:
    """Means by contender (a variant of guidance) and steps as an image (h, w, 3): seconds to the right."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.2), dpi=110, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    for axes, (measure, label) in zip(figure.subplots(1, len(AXES)), AXES.items(), strict=True):
        for variant, part in table.groupby("contender", sort=False):
            ordered = part.sort_values("steps")
            axes.plot(ordered["seconds"], ordered[measure], "o-", markersize=4, label=variant)
            for seconds, value, steps in zip(
                ordered["seconds"], ordered[measure], ordered["steps"], strict=True
            ):
                axes.annotate(
                    str(steps), (seconds, value), textcoords="offset points", xytext=(4, 3), fontsize=7
                )
        axes.set_xscale("log")
        axes.set_xlabel("seconds an actor")
        axes.set_ylabel(label)
        axes.grid(True, which="both", linewidth=0.3)
        axes.legend(fontsize=8)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
