"""The command line as a person meets it: doctor, errors, exit codes, and how fast it starts."""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from genassets.cli import app as cli
from genassets.cli import doctor
from genassets.errors import EnvironmentProblem, SpecError

HEAVY = ("torch", "prefect", "mlflow", "open3d", "cv2", "pandas", "scipy", "pyarrow", "onnxruntime")


def run_main(*arguments: str) -> subprocess.CompletedProcess[str]:
    program = "from genassets.cli.app import main; main()"
    return subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True)


def test_the_command_starts_without_anything_heavy() -> None:
    # A heavy import at the top of any command's file would slow every command down by a second or more.
    program = "import sys, genassets.cli.app; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert not set(HEAVY) & set(loaded.stdout.split())


def test_version() -> None:
    finished = run_main("--version")
    assert finished.stdout.startswith("genassets 0.")
    assert finished.returncode == 0


def test_an_unknown_command_ends_with_2() -> None:
    assert run_main("no-such-command").returncode == 2


def test_an_error_is_one_message_and_its_exit_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise SpecError("demo.yaml, line 3: no such key.")

    monkeypatch.setattr(cli, "app", fail)
    monkeypatch.delenv("GENASSETS_TRACEBACK", raising=False)
    with pytest.raises(SystemExit) as caught:
        cli.main()
    assert caught.value.code == 2
    assert capsys.readouterr().err == "genassets: demo.yaml, line 3: no such key.\n"


def test_a_traceback_is_shown_when_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise SpecError("demo.yaml, line 3: no such key.")

    monkeypatch.setattr(cli, "app", fail)
    monkeypatch.setenv("GENASSETS_TRACEBACK", "1")
    with pytest.raises(SystemExit):
        cli.main()
    assert "Traceback" in capsys.readouterr().err


def test_a_missing_file_at_the_command_line_ends_with_6(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GENASSETS_WEIGHTS", str(tmp_path))
    finished = run_main("weights", "verify", "sam-encoder")
    assert finished.returncode == 6
    assert "genassets: pretrained file 'sam-encoder' is missing" in finished.stderr
    assert "Traceback" not in finished.stderr


def test_the_list_of_weights_is_one_json_document(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENASSETS_WEIGHTS", str(tmp_path))
    listed = json.loads(CliRunner().invoke(cli.app, ["weights", "list", "--json"]).stdout)
    assert {entry["name"] for entry in listed} >= {"sam-encoder", "lpips-alexnet", "inception"}
    assert {entry["state"] for entry in listed} == {"missing"}


def test_doctor_tells_what_missing_weights_cost_and_is_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GENASSETS_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(doctor, "IMPORTED", ())  # importing them all takes seconds
    result = CliRunner().invoke(cli.app, ["doctor", "--json"])
    document = json.loads(result.stdout)
    assert document["ok"]
    assert result.exit_code == 0
    findings = {finding["subject"]: finding for finding in document["findings"]}
    assert findings["weights sam-encoder"]["state"] == "note"
    assert "GrabCut" in findings["weights sam-encoder"]["cost"]
    assert findings["npm"]["state"] == "note"
    assert findings["torch"]["state"] == "ok"


def test_doctor_shows_why_a_package_does_not_load(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "IMPORTED", ("json", "no_such_package"))
    (finding,) = doctor._loading()
    assert finding.subject == "import no_such_package"
    assert finding.state == "missing"
    assert "No module named" in finding.found


def test_doctor_ends_with_6_when_something_needed_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    needed = doctor.Finding("libGL.so.1", "missing", "not found", "open3d cannot be imported")
    monkeypatch.setattr(doctor, "examine", lambda: iter([needed]))
    with pytest.raises(EnvironmentProblem, match=r"libGL\.so\.1"):
        doctor.doctor()


def test_doctor_names_a_package_outside_its_bounds_and_one_that_was_not_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    installed = {"pyarrow": "26.0.0", "numpy": "2.3.0"}

    def version(name: str) -> str:
        if name not in installed:
            raise importlib.metadata.PackageNotFoundError(name)
        return installed[name]

    monkeypatch.setattr(
        importlib.metadata, "requires", lambda _: ["pyarrow>=18,<26", "numpy>=2.0", "mlflow>=3.17"]
    )
    monkeypatch.setattr(importlib.metadata, "version", version)
    found = {finding.subject: finding for finding in doctor._requirements()}
    assert found["pyarrow"].state == "missing" and "<26" in found["pyarrow"].cost
    assert found["numpy"].state == "note" and "constraints.txt" in found["numpy"].cost
    assert found["mlflow"].state == "missing"


def test_doctor_looks_at_the_home_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("not a directory")
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path / "file" / "home"))
    assert doctor._home().state == "missing"
    monkeypatch.setenv("GENASSETS_HOME", str(tmp_path / "deep" / "home"))
    assert doctor._home().state == "ok"
    assert not (tmp_path / "deep").exists(), "looking must not create anything"


def test_doctor_counts_the_logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PANDASET_ROOT", str(tmp_path))
    assert doctor._pandaset().state == "note"
    (tmp_path / "002" / "annotations").mkdir(parents=True)
    assert doctor._pandaset().found.endswith("1 logs")
