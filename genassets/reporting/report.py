"""The report of a run: one folder of HTML, pictures and plots that opens without a network."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from genassets.pipeline.run_record import METRICS_FILE, SPEC_FILE, RunRecord, StepRecord, read_metrics
from genassets.pipeline.store import CURVES, MANIFEST, PICTURES
from genassets.reporting.gallery import GALLERY_PAGE, GalleryTitle, write_gallery
from genassets.reporting.metric_tables import MetricTable, stage_tables
from genassets.reporting.pages import fill_page

REPORT_FOLDER = "report"
PAGE = "index.html"
TEMPLATE = "report.html.j2"
STYLE = "report.css"
GALLERY_FOLDER = "gallery"
EXPORT_STAGE = "export"
PACKAGES = (
    "genassets",
    "torch",
    "numpy",
    "opencv-contrib-python-headless",
    "open3d-cpu",
    "open3d",
    "onnxruntime",
    "pandas",
    "pyarrow",
    "scikit-image",
    "prefect",
    "mlflow",
)


@dataclass(frozen=True)
class Picture:
    """One picture of a stage, its file relative to the page."""

    file: str
    title: str
    caption: str


@dataclass(frozen=True)
class StageLine:
    """One line of the stage table. `seconds` are those of the making, also where the output came from the
    store.
    """

    name: str
    status: str
    cached: bool
    seconds: float | None
    share: float
    fingerprint: str
    path: str
    error: str | None


@dataclass(frozen=True)
class StageSection:
    """What one stage has to show: tables of its metrics, plots of its curves, pictures."""

    name: str
    tables: tuple[MetricTable, ...]
    plots: tuple[Picture, ...]
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class Headline:
    """One figure at the top of the page."""

    value: str
    label: str


def write_report(run_dir: Path) -> Path:
    """Write runs/<id>/report/index.html from run.json, metrics.parquet and the stages' outputs; returns its
    path.

    Everything shown is copied into the folder, so it can be moved or sent. An older report is replaced.
    Outputs that are gone from the store are named on the page. Raises OSError or ValueError where run.json
    cannot be read.
    """
    record = RunRecord.load(run_dir)
    folder = run_dir / REPORT_FOLDER
    partial = run_dir / f".{REPORT_FOLDER}-partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    metrics = read_metrics(run_dir / METRICS_FILE)
    page = fill_page(
        TEMPLATE,
        run=record,
        started=time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(record.started)),
        duration=duration_text((record.finished or time.time()) - record.started),
        headlines=_headlines(metrics),
        lines=_stage_lines(record),
        sections=_sections(record, metrics, partial),
        gallery=_gallery(record, partial),
        missing=[step.path for step in record.stages if step.path and not Path(step.path).is_dir()],
        spec=_spec_text(run_dir),
        machine=_machine(),
    )
    (partial / PAGE).write_text(page, encoding="utf-8")
    shutil.copyfile(Path(__file__).with_name(STYLE), partial / STYLE)
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)
    return folder / PAGE


def _stage_lines(record: RunRecord) -> list[StageLine]:
    seconds = [making_seconds(step) for step in record.stages]
    longest = max([value for value in seconds if value is not None], default=0.0) or 1.0
    return [
        StageLine(
            name=step.key,
            status=step.status,
            cached=step.cached,
            seconds=made,
            share=100.0 * (made or 0.0) / longest,
            fingerprint=(step.fingerprint or "")[:12],
            path=step.path or "",
            error=step.error,
        )
        for step, made in zip(record.stages, seconds, strict=True)
    ]


def making_seconds(step: StepRecord) -> float | None:
    """Seconds that the output took to make, from its manifest; of a step without output, what it ran."""
    if step.path is None:
        return step.seconds or None
    try:
        return float(json.loads((Path(step.path) / MANIFEST).read_text(encoding="utf-8"))["seconds"])
    except (OSError, ValueError, KeyError):
        return step.seconds or None


def _sections(record: RunRecord, metrics: list[dict[str, Any]], folder: Path) -> list[StageSection]:
    """One section a stage, its shards together, in the order of the run; stages with nothing to show are left
    out.
    """
    sections = []
    for name in dict.fromkeys(step.name for step in record.stages):
        steps = [step for step in record.stages if step.name == name and step.path is not None]
        rows = [row for row in metrics if row["stage"] == name]
        section = StageSection(
            name=name,
            tables=tuple(stage_tables(name, rows)),
            plots=tuple(plot for step in steps for plot in _plots(step, folder)),
            pictures=tuple(picture for step in steps for picture in _pictures(step, folder)),
        )
        if section.tables or section.plots or section.pictures:
            sections.append(section)
    return sections


def _plots(step: StepRecord, folder: Path) -> list[Picture]:
    path = Path(step.path or "") / CURVES
    if not path.is_file():
        return []
    from genassets.reporting.curve_plot import read_curves, write_curve_plot

    file = f"curves/{_file_name(step)}.svg"
    write_curve_plot(read_curves(path), folder / file)
    return [Picture(file, f"Curves of {step.key}", "Each value pale, its running mean dark.")]


def _pictures(step: StepRecord, folder: Path) -> list[Picture]:
    """Copy the pictures that an output lists in pictures.json."""
    source = Path(step.path or "")
    listing = source / f"{PICTURES}.json"
    if not listing.is_file():
        return []
    pictures = []
    for entry in json.loads(listing.read_text(encoding="utf-8")):
        original = source / entry["file"]
        if not original.resolve().is_relative_to(source.resolve()) or not original.is_file():
            raise ValueError(
                f"{listing}: {entry['file']!r} is not a file of this output; run: genassets verify"
            )
        file = f"pictures/{_file_name(step)}/{original.name}"
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(original, folder / file)
        pictures.append(Picture(file, entry["title"], entry["caption"]))
    return pictures


def _file_name(step: StepRecord) -> str:
    return step.name if step.shard is None else f"{step.name}-{step.shard}"


def _gallery(record: RunRecord, folder: Path) -> str | None:
    """The gallery of what the run exported, relative to the page; None where it exported nothing."""
    for step in record.stages:
        if step.name == EXPORT_STAGE and step.path and (Path(step.path) / "actors").is_dir():
            title = GalleryTitle(record.experiment, record.run_id, f"../{PAGE}#{EXPORT_STAGE}")
            write_gallery(Path(step.path), folder / GALLERY_FOLDER, title)
            return f"{GALLERY_FOLDER}/{GALLERY_PAGE}"
    return None


def _headlines(metrics: list[dict[str, Any]]) -> list[Headline]:
    """The figures that a reader looks for first: held-out PSNR beside both baselines, for moved views where
    there are any, else for all.
    """
    settings = {row["setting"] for row in metrics if row["metric"] == "psnr"}
    setting = next((s for end in ("/moved", "/all") for s in sorted(settings) if s.endswith(end)), None)
    if setting is None:
        return []
    seen = "moved views" if setting.endswith("moved") else "all views"
    shown = []
    for predictor, label in (
        ("model", f"PSNR over held-out {seen}"),
        ("nearest_crop", "nearest training crop"),
        ("mean_colour", "mean colour"),
    ):
        for row in metrics:
            whole = row["class"] == "all" and row["split"] == "test" and row["setting"] == setting
            if whole and row["metric"] == "psnr" and row["method"].split(";")[0] == predictor:
                shown.append(Headline(f"{row['value']:.2f} dB", f"{label} (n = {row['n']:,})"))
    return shown


def _spec_text(run_dir: Path) -> str:
    path = run_dir / SPEC_FILE
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def _machine() -> list[tuple[str, str]]:
    """Name and value of what the numbers depend on, as found by the process that writes the report."""
    values = [
        ("Python", platform.python_version()),
        ("System", platform.platform()),
        ("Processor", f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"),
    ]
    for package in PACKAGES:
        try:
            values.append((package, importlib.metadata.version(package)))
        except importlib.metadata.PackageNotFoundError:
            continue  # of the two names of open3d one is installed
    return values


def duration_text(seconds: float) -> str:
    minutes, rest = divmod(max(seconds, 0.0), 60.0)
    return f"{int(minutes)} min {rest:.0f} s" if minutes else f"{rest:.1f} s"
