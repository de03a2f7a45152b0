"""The eight classes of the paper and PandaSet's labels, night logs and cameras."""

from __future__ import annotations

CLASSES = (
    "Car",
    "Truck",
    "Bus",
    "Construction Vehicle",
    "Emergency Vehicle",
    "Bicycle",
    "Motorcycle",
    "Pedestrian",
)
VEHICLE_CLASSES = CLASSES[:5]

_CLASS_OF_LABEL = {
    "Car": "Car",
    "Pickup Truck": "Truck",
    "Medium-sized Truck": "Truck",
    "Semi-truck": "Truck",
    "Bus": "Bus",
    "Other Vehicle - Construction Vehicle": "Construction Vehicle",
    "Emergency Vehicle": "Emergency Vehicle",
    "Bicycle": "Bicycle",
    "Motorcycle": "Motorcycle",
    "Motorized Scooter": "Motorcycle",
    "Pedestrian": "Pedestrian",
    "Pedestrian with Object": "Pedestrian",
}

CAMERA_NAMES = (
    "front_camera",
    "front_left_camera",
    "front_right_camera",
    "left_camera",
    "right_camera",
    "back_camera",
)

NIGHT_LOGS = frozenset(
    [f"{number:03d}" for number in (57, 58, 59, *range(62, 75), 77, 78, 79, 149)]
)  # PandaSet's night sequences


def class_of(label: str) -> str | None:
    """The paper's class of a PandaSet label; None for labels that are no actor of it (cones, signs, ...)."""
    return _CLASS_OF_LABEL.get(label)
