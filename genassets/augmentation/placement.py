"""Where a placed asset stands: on the ground contact and with the heading of the actor that it replaces, or along its
path.
"""

from __future__ import annotations

import uuid
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from genassets.driving.classes import class_of
from genassets.driving.log import Log, Track
from genassets.geometry.transforms import heading_of, interpolate_pose, yaw_pose

Array = NDArray[np.float64]

LONGEST_PICKUP = 6.6
"""Metres; a longer truck is labelled as a medium-sized one."""

_LABELS = {
    "Car": "Car",
    "Truck": "Medium-sized Truck",
    "Bus": "Bus",
    "Construction Vehicle": "Other Vehicle - Construction Vehicle",
    "Emergency Vehicle": "Emergency Vehicle",
    "Bicycle": "Bicycle",
    "Motorcycle": "Motorcycle",
    "Pedestrian": "Pedestrian",
}


def label_of(actor_class: str, size: Array) -> str:
    """PandaSet's label of an asset; assets know their class alone, so a truck's goes by its length."""
    label = "Pickup Truck" if actor_class == "Truck" and size[0] <= LONGEST_PICKUP else _LABELS[actor_class]
    assert class_of(label) == actor_class
    return label


def new_id(*parts: object) -> str:
    """An annotation id that is the same for the same parts, and no other's."""
    return str(uuid.uuid5(uuid.NAMESPACE_URL, "genassets:" + "/".join(map(str, parts))))


def in_place_of(track: Track, actor_class: str, size: Array, identity: str, degrees: float = 0.0) -> Track:
    """The track of an asset that stands where an actor stood: same ground contact, centre and heading.

    size (3,): at which the asset is drawn. identity: what tells this change from others; ids follow from it.
    degrees: by which it is turned about its vertical axis. Its uuids are in the order of the actor's.
    """
    poses = yaw_pose(heading_of(track.world_from_box) + np.radians(degrees), track.world_from_box[:, :3, 3])
    poses[:, 2, 3] += (size[2] - track.size[2]) / 2
    return replace(
        track,
        actor_id=new_id(identity, track.actor_id),
        label=label_of(actor_class, size) if actor_class != track.actor_class else track.label,
        actor_class=actor_class,
        size=np.array(size, dtype=np.float64),
        world_from_box=poses,
        uuids=tuple(new_id(identity, old) for old in track.uuids),
    )


def ahead_of(track: Track, metres: float, slope: Array) -> Track:
    """An actor's track moved along its own path, back where metres are negative.

    Beyond an end of its path, and if it stands, it goes straight on as its box heads. slope (2,): rise of the road
    there over world x and y.
    """
    poses = track.world_from_box
    steps = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)
    gone = np.concatenate([[0.0], np.cumsum(steps)])
    wanted = gone + metres
    on_path = np.clip(wanted, 0.0, gone[-1])
    moved = np.stack(
        [interpolate_pose(track.times, poses, time) for time in np.interp(on_path, gone, track.times)]
    )
    along = moved[:, :2, 0] / np.linalg.norm(moved[:, :2, 0], axis=1, keepdims=True)
    beyond = (wanted - on_path)[:, None] * along
    moved[:, :2, 3] += beyond
    moved[:, 2, 3] += beyond @ slope
    return replace(track, world_from_box=moved)


def standing_at(
    log: Log, actor_class: str, size: Array, contact: Array, heading: float, frames: range, identity: str
) -> Track:
    """The track of an asset that stands on a point of the ground (3,), world metres, in some frames of a log."""
    number = np.array(frames, dtype=np.int64)
    centre = np.asarray(contact, dtype=np.float64) + [0.0, 0.0, size[2] / 2]
    actor_id = new_id(identity)
    return Track(
        actor_id=actor_id,
        label=label_of(actor_class, size),
        actor_class=actor_class,
        size=np.array(size, dtype=np.float64),
        frames=number,
        times=log.frame_times[number].copy(),
        world_from_box=np.broadcast_to(yaw_pose(heading, centre), (len(number), 4, 4)).copy(),
        stationary=True,
        uuids=(actor_id,),
        twinned=False,
        sensor=None,
    )
