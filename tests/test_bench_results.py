"""Results of benchmarks: what is written by hand stays, and the tables go between their markers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from genassets.bench.results import BEGIN, END, default_results, read_results, write_results
from genassets.errors import SpecError


def results(seconds: float) -> dict[str, Any]:
    entry = {"summary": "What it measures", "date": "2026-01-01", "machine": "a machine"}
    return {"masks": {**entry, "command": "genassets bench masks", "rows": [{"seconds": seconds}]}}


def test_a_first_file_gets_a_heading_and_json_beside_it(tmp_path: Path) -> None:
    table = write_results(tmp_path / "measured.json", results(1.5))
    text = table.read_text()
    assert table == tmp_path / "measured.md" and text.startswith("# Benchmarks\n")
    assert text.index(BEGIN) < text.index("| seconds |\n|---|\n| 1.5 |\n") < text.index(END)
    assert read_results(tmp_path / "measured.json") == results(1.5)


def test_text_around_the_markers_stays(tmp_path: Path) -> None:
    table = tmp_path / "benchmarks.md"
    table.write_text(f"# By hand\n\nBefore.\n\n{BEGIN}\nold\n{END}\n\nAfter.\n")
    write_results(tmp_path / "benchmarks.json", results(1.5))
    write_results(tmp_path / "benchmarks.json", results(2.5))
    text = table.read_text()
    assert text.startswith(f"# By hand\n\nBefore.\n\n{BEGIN}\n") and text.endswith(f"{END}\n\nAfter.\n")
    assert "| 2.5 |" in text and "old" not in text and "1.5" not in text


@pytest.mark.parametrize(
    "text", ["# By hand\n", f"{BEGIN}\n", f"{END}\n{BEGIN}\n", f"{BEGIN}{END}{BEGIN}{END}"]
)
def test_a_file_without_its_markers_is_left_alone(tmp_path: Path, text: str) -> None:
    table = tmp_path / "benchmarks.md"
    table.write_text(text)
    with pytest.raises(SpecError, match=r"benchmarks\.md: expected one line"):
        write_results(tmp_path / "benchmarks.json", results(1.0))
    assert table.read_text() == text and not (tmp_path / "benchmarks.json").exists()


def test_docs_is_the_default_in_the_checkout_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert default_results() == Path("benchmarks.json")
    monkeypatch.chdir(Path(__file__).resolve().parents[1])
    assert default_results() == Path("docs/benchmarks.json")
