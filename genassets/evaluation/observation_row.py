"""Views and observations of actors from rows of the object table."""

from __future__ import annotations

from functools import partial
from typing import Any

from genassets.curation.object_table import bounds_of, box_from_camera_of, mask_of
from genassets.evaluation.sparse_view import Observation, View
from genassets.evaluation.viewpoint import viewpoint_of


def view_of(row: Any) -> View:
    """From where a row's actor is seen; a row is a tuple of itertuples."""
    return View(
        log=str(row.log),
        frame=int(row.frame),
        camera=str(row.camera),
        actor_id=str(row.actor_id),
        actor_class=str(row.actor_class),
        viewpoint=viewpoint_of(box_from_camera_of(row)),
    )


def observation_of(row: Any) -> Observation:
    """The observation of a row that has a mask."""
    return Observation(
        **vars(view_of(row)),
        bounds=bounds_of(row),
        mask=partial(mask_of, row),
        segmenter=str(row.segmenter),
    )
