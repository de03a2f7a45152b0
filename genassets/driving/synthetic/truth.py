"""What the synthetic city knows beyond the log: masks, depths, meshes and turns, in a directory beside it.

Layout of truth/<name>/ beside the log <name>/:
    actors.json                       one entry an actor: actor_id, instance, label, actor_class, size, ...
    instances/<camera>/<frame>.png    16-bit, the instance seen at each pixel's centre, 0 none
    depth/<camera>/<frame>.png        16-bit, depth along the camera's axis in units of DEPTH_STEP, 0 sky
    meshes/<actor_id>.ply             box frame, metres, vertex colours
    turns/<actor_id>/<azimuth>.png    256 x 256 RGBA, seen by geometry.turntable_camera
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from genassets.driving.synthetic.mesh import Mesh
from genassets.errors import LogError

DEPTH_STEP = 1.0 / 128.0
"""Metres a unit of the depth files; depths beyond 511 m are clipped."""


@dataclass(frozen=True)
class Truth:
    """The truth beside one synthetic log; files are read when asked for.

    instance_of: actor_id to the number in the instance masks. actors: the entries of actors.json.
    """

    root: Path
    instance_of: dict[str, int]
    actors: dict[str, dict[str, Any]]
    digits: int

    def instances(self, camera: str, frame: int) -> NDArray[np.uint16]:
        """The instance (H, W) seen at each pixel's centre, 0 where no actor is; LogError where missing."""
        return np.asarray(_read_png(self.root / "instances" / camera / self._name(frame)), dtype=np.uint16)

    def depth(self, camera: str, frame: int) -> NDArray[np.float32]:
        """Depth (H, W) along the camera's axis in metres, 0 for the sky; LogError where missing."""
        stored = _read_png(self.root / "depth" / camera / self._name(frame))
        return np.asarray(stored.astype(np.float32) * np.float32(DEPTH_STEP))

    def mesh(self, actor_id: str) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
        """Vertices (V, 3) in the box frame, triangles (T, 3), vertex colours (V, 3) as sRGB in [0, 1]."""
        self._entry(actor_id)
        return read_ply(self.root / "meshes" / f"{actor_id}.ply")

    def turns(self, actor_id: str) -> dict[int, NDArray[np.uint8]]:
        """The actor's renders (256, 256, 4) RGBA by azimuth in degrees."""
        self._entry(actor_id)
        folder = self.root / "turns" / actor_id
        files = sorted(folder.glob("*.png"), key=lambda path: int(path.stem))
        if not files:
            raise LogError(f"{folder}: has no renders; the log was made without them, make it again.")
        return {int(path.stem): cv2.cvtColor(_read_png(path), cv2.COLOR_BGRA2RGBA) for path in files}  # type: ignore[misc]

    def _entry(self, actor_id: str) -> dict[str, Any]:
        if actor_id not in self.actors:
            raise KeyError(f"{self.root} knows no actor {actor_id}")
        return self.actors[actor_id]

    def _name(self, frame: int) -> str:
        return f"{frame:0{self.digits}d}.png"


def open_truth(log_root: Path) -> Truth | None:
    """The truth beside a log, or None where there is none (a real log).

    Raises LogError where the truth's table is there but malformed.
    """
    log_root = Path(log_root)
    root = log_root.parent / "truth" / log_root.name
    table = root / "actors.json"
    if not table.is_file():
        return None
    try:
        content = json.loads(table.read_text())
        actors = {entry["actor_id"]: entry for entry in content["actors"]}
        instance_of = {actor_id: int(entry["instance"]) for actor_id, entry in actors.items()}
        return Truth(root, instance_of, actors, int(content["digits"]))
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise LogError(
            f"{table}: is not a truth table ({error!r}); expected actors with actor_id and instance, "
            "and digits. Make the synthetic log again."
        ) from error


def _read_png(path: Path) -> NDArray[Any]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    if image is None:
        raise LogError(f"{path}: is missing or no PNG; make the synthetic log again.")
    return np.asarray(image)


class TruthWriter:
    """Writes the truth into a directory that is there already."""

    def __init__(self, root: Path, frame_count: int) -> None:
        """Write below `root` for a log of `frame_count` frames."""
        self._root = root
        self._digits = max(2, len(str(frame_count - 1)))

    def add_picture(
        self, camera: str, frame: int, instances: NDArray[np.uint16], depth: NDArray[np.float32]
    ) -> None:
        """Write a camera frame's instances (H, W) and depths (H, W) in metres."""
        name = f"{frame:0{self._digits}d}.png"
        self._write_png(f"instances/{camera}/{name}", instances)
        steps = np.clip(np.round(depth / DEPTH_STEP), 0, 65535).astype(np.uint16)
        # A surface nearer than half a step would read as sky.
        self._write_png(
            f"depth/{camera}/{name}", np.where((depth > 0) & (steps == 0), 1, steps).astype(np.uint16)
        )

    def add_mesh(self, actor_id: str, mesh: Mesh) -> None:
        """Write an actor's mesh, its triangles' colours put on vertices of their own."""
        self._write(f"meshes/{actor_id}.ply", ply_bytes(mesh))

    def add_turn(self, actor_id: str, azimuth: int, rgba: NDArray[np.uint8]) -> None:
        """Write one render (256, 256, 4) of an actor's turn."""
        self._write_png(f"turns/{actor_id}/{azimuth:03d}.png", cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))

    def add_actors(self, actors: list[dict[str, Any]]) -> None:
        """Write the table that open_truth looks for."""
        content = {"digits": self._digits, "depth_step": DEPTH_STEP, "actors": actors}
        self._write("actors.json", json.dumps(content, indent=1).encode())

    def _write_png(self, name: str, image: NDArray[Any]) -> None:
        ok, content = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 2])
        if not ok:
            raise ValueError(f"{name}: an image {image.shape} of {image.dtype} cannot be a PNG")
        self._write(name, content.tobytes())

    def _write(self, name: str, content: bytes) -> None:
        path = self._root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


_PLY_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
_PLY_FACE = np.dtype([("count", "u1"), ("index", "<i4", 3)])


def ply_bytes(mesh: Mesh) -> bytes:
    """A binary PLY of a mesh: float32 positions, 8-bit sRGB vertex colours."""
    vertices = np.zeros(3 * len(mesh.triangles), dtype=_PLY_VERTEX)
    vertices["xyz"] = mesh.vertices[mesh.triangles].reshape(-1, 3)
    encoded = np.clip(np.repeat(mesh.colours, 3, axis=0), 0.0, 1.0)
    encoded = np.where(encoded <= 0.0031308, 12.92 * encoded, 1.055 * encoded ** (1 / 2.4) - 0.055)
    vertices["rgb"] = np.round(255 * encoded)
    faces = np.zeros(len(mesh.triangles), dtype=_PLY_FACE)
    faces["count"] = 3
    faces["index"] = np.arange(3 * len(mesh.triangles)).reshape(-1, 3)
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return header.encode() + vertices.tobytes() + faces.tobytes()


def read_ply(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Vertices, triangles and vertex colours in [0, 1] of a file of ply_bytes; LogError where it is none."""
    content = path.read_bytes() if path.is_file() else b""
    end = content.find(b"end_header\n")
    if end < 0:
        raise LogError(f"{path}: is missing or no PLY; make the synthetic log again.")
    counts = [
        int(line.split()[2]) for line in content[:end].decode().splitlines() if line.startswith("element")
    ]
    start = end + len(b"end_header\n")
    vertices = np.frombuffer(content, _PLY_VERTEX, counts[0], start)
    faces = np.frombuffer(content, _PLY_FACE, counts[1], start + vertices.nbytes)
    return vertices["xyz"].astype(np.float64), faces["index"].astype(np.int64), vertices["rgb"] / 255.0
