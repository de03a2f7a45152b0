"""The script that sets everything up: what it hands on, and when it sets up again."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
LIBRARIES = "genassets/system_libraries.py"

pytestmark = pytest.mark.skipif(os.name != "posix", reason="run is a POSIX shell script")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout, a space in its path, whose environment is a stand-in that says how it is called."""
    root = tmp_path / "my checkout"
    (root / ".venv" / "bin").mkdir(parents=True)
    (root / "genassets").mkdir()
    for name in ("run", "pyproject.toml", "constraints.txt", LIBRARIES):
        shutil.copy(REPOSITORY / name, root / name)
    for name in ("genassets", "python"):
        program = root / ".venv" / "bin" / name
        program.write_text(f'#!/bin/sh\necho "{name} $*"\n')
        program.chmod(0o755)
    # What `run` writes when it has set everything up: it must then leave the environment alone.
    stamp = subprocess.run(
        [
            "sh",
            "-c",
            f'{{ echo "$0 cpu"; cat pyproject.toml constraints.txt run {LIBRARIES}; }} | cksum',
            str(root),
        ],
        cwd=root,
        capture_output=True,
        text=True,
        check=True,
    )
    (root / ".venv" / ".set-up").write_text(stamp.stdout)
    return root


def call(checkout: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("GENASSETS_")}
    return subprocess.run(
        [str(checkout / "run"), *arguments],
        cwd=checkout.parent,
        env=kept | environment,
        capture_output=True,
        text=True,
    )


def test_help_needs_no_environment(checkout: Path) -> None:
    shutil.rmtree(checkout / ".venv")
    for arguments in ((), ("help",), ("--help",)):
        finished = call(checkout, *arguments)
        assert finished.returncode == 0
        assert "./run demo" in finished.stdout
    assert not (checkout / ".venv").exists()


def test_commands_are_handed_on_with_their_arguments(checkout: Path) -> None:
    assert call(checkout, "inspect", "a log").stdout == "genassets inspect a log\n"
    assert call(checkout, "bench", "--json").stdout == "genassets bench --json\n"
    demo = call(checkout, "demo", "--set", "seed=1").stdout.splitlines()
    assert demo == [
        "genassets weights fetch --quiet sam-encoder sam-decoder lpips-alexnet inception",
        "genassets run demo --set seed=1",
    ]


def test_test_checks_style_and_types_before_it_runs_the_tests(checkout: Path) -> None:
    lines = call(checkout, "test", "tests/test_weights.py").stdout.splitlines()
    tools = [line.split()[2] for line in lines if line.startswith("python -m")]
    assert tools == ["ruff", "ruff", "mypy", "pytest"]
    assert lines[-1].endswith("-m not slow tests/test_weights.py")


def test_all_tests_want_a_browser_and_go_on_without_it(checkout: Path, tmp_path: Path) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    # A user who is not root, and a path without a browser.
    (programs / "id").write_text("#!/bin/sh\necho 1000\n")
    (programs / "id").chmod(0o755)
    for name in ("sh", "cat", "cksum", "dirname"):
        (programs / name).symlink_to(shutil.which(name) or name)
    without = call(checkout, "test", "--all", PATH=str(programs))
    assert "apt-get install -y chromium" in without.stderr
    assert without.stdout.splitlines()[-1].startswith("python -m pytest")
    assert "not slow" not in without.stdout
    (programs / "chromium").write_text("#!/bin/sh\n")
    (programs / "chromium").chmod(0o755)
    assert "chromium" not in call(checkout, "test", "--all", PATH=str(programs)).stderr


def test_a_failing_check_fails_the_command(checkout: Path) -> None:
    python = checkout / ".venv" / "bin" / "python"
    python.write_text('#!/bin/sh\n[ "$2" != mypy ]\n')
    assert call(checkout, "test").returncode != 0


def test_a_changed_requirement_sets_up_again(checkout: Path) -> None:
    with (checkout / "constraints.txt").open("a") as file:
        file.write("# another line\n")
    finished = call(checkout, "--version", GENASSETS_PYTHON="no-such-python")
    assert finished.returncode == 6
    assert "setting up" in finished.stderr
    assert "needs Python 3.11" in finished.stderr
    assert not (checkout / ".venv" / ".set-up").exists()


def test_without_the_right_to_install_the_line_to_type_is_printed(checkout: Path, tmp_path: Path) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    # Debian's python without its package for virtual environments, and a user who is not root.
    python = 'case "$2" in "import ensurepip") exit 1 ;; *print*) echo python3.11-venv ;; esac'
    for name, script in {"bare-python": python, "id": "echo 1000"}.items():
        (programs / name).write_text(f"#!/bin/sh\n{script}\n")
        (programs / name).chmod(0o755)
    (checkout / ".venv" / ".set-up").unlink()
    path = f"{programs}:{os.environ['PATH']}"
    finished = call(checkout, "--version", GENASSETS_PYTHON="bare-python", PATH=path)
    assert finished.returncode == 6
    assert finished.stderr.splitlines()[-1].endswith("sudo apt-get install -y python3.11-venv")


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere nothing has to be installed")
def test_the_packages_of_missing_libraries_are_known_before_anything_is_installed(
    checkout: Path, tmp_path: Path
) -> None:
    file = checkout / LIBRARIES
    file.write_text(file.read_text().replace('"libGL.so.1"', '"libabsent.so.9"'))
    # -I -S: without this project, its packages and the current directory.
    finished = subprocess.run(
        [sys.executable, "-I", "-S", str(file)], cwd=tmp_path, capture_output=True, text=True
    )
    assert finished.returncode == 0, finished.stderr
    assert "libgl1" in finished.stdout.split()
    assert "setting up" in call(checkout, "--version", GENASSETS_PYTHON="no-such-python").stderr


def test_another_build_of_torch_sets_up_again(checkout: Path) -> None:
    finished = call(checkout, "--version", GENASSETS_TORCH="cuda", GENASSETS_PYTHON="no-such-python")
    assert "setting up" in finished.stderr


def test_python_may_keep_its_bytecode_so_that_an_edit_slows_only_the_next_start(checkout: Path) -> None:
    program = checkout / ".venv" / "bin" / "genassets"
    program.write_text('#!/bin/sh\necho "${PYTHONDONTWRITEBYTECODE-may write}"\n')
    assert call(checkout, "plan", PYTHONDONTWRITEBYTECODE="1").stdout == "may write\n"


def test_a_shell_finds_the_environment(checkout: Path) -> None:
    finished = call(checkout, "shell", "-c", "command -v genassets; echo $VIRTUAL_ENV", SHELL="/bin/sh")
    assert finished.stdout.splitlines() == [
        str(checkout / ".venv" / "bin" / "genassets"),
        str(checkout / ".venv"),
    ]
