"""The same stages through a real Prefect: each a task, retried where that helps, results from the store."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]

# One Prefect start for all that is asked of it; a process of its own, for Prefect reads its settings once.
SCRIPT = """
    import json, sys
    from pathlib import Path
    from genassets.pipeline.home import Home
    from flows.start import prepare_environment

    home = Path(sys.argv[1])
    prepare_environment(Home(home))
    from prefect import flow
    from prefect.client.orchestration import get_client
    from prefect.exceptions import TerminationSignal
    from flows.tasks import run_as_task
    from genassets.errors import StageError
    from tests.toy_pipeline import run_toy, states

    tries = {"busy": 0, "wrong": 0, "absent": 0, "stopped": 0}

    def broken(kind, error):
        def work():
            tries[kind] += 1
            raise error
        return work

    @flow(name="toy")
    def toys():
        results = []
        for _ in range(2):
            code, record = run_toy(home, engine=run_as_task)
            results.append([code, states(record)])
        return results

    @flow(name="errors")
    def errors():
        seen = {}
        import flows.tasks
        flows.tasks.RETRY_SECONDS = [0, 0]
        for kind, error in (("busy", TimeoutError("slow disk")), ("wrong", ValueError("bad number")),
                            ("absent", FileNotFoundError("no file")), ("stopped", TerminationSignal(15))):
            try:
                run_as_task(kind, {}, broken(kind, error))
            except BaseException as caught:
                seen[kind] = type(caught).__name__
        return seen

    results = toys()
    seen = errors()
    with get_client(sync_client=True) as client:
        names = sorted(run.name for run in client.read_task_runs())
    print(json.dumps({"results": results, "seen": seen, "tries": tries, "tasks": names}))
"""


@pytest.mark.slow
def test_flow_through_prefect(tmp_path: Path) -> None:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(SCRIPT), str(tmp_path)],
        cwd=REPOSITORY,
        env=kept,
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout.strip().splitlines()[-1])
    keys = ["numbers[one]", "numbers[two]", "total", "report"]
    assert answer["results"] == [[0, dict.fromkeys(keys, "completed")], [0, dict.fromkeys(keys, "cached")]]
    assert answer["tasks"] == sorted([*keys, *keys, "absent", "busy", "stopped", "wrong"])
    seen = {"busy": "TimeoutError", "wrong": "ValueError", "absent": "FileNotFoundError"}
    assert answer["seen"] == {**seen, "stopped": "KeyboardInterrupt"}, "a cancelled run ends as by Ctrl-C"
    tries = {"busy": 3, "wrong": 1, "absent": 1, "stopped": 1}
    assert answer["tries"] == tries, "only what may pass is tried again"
    assert (tmp_path / "prefect/prefect.log").is_file()
    assert "prefect" not in done.stderr.lower(), "its logs go to the file"


def test_the_environment_keeps_what_the_user_has_set(tmp_path: Path) -> None:
    code = (
        "import os, sys; from pathlib import Path\n"
        "from genassets.pipeline.home import Home; from flows.start import prepare_environment\n"
        "prepare_environment(Home(Path(sys.argv[1])))\n"
        "assert 'prefect' not in sys.modules\n"
        "names = ('PREFECT_HOME', 'PREFECT_SERVER_ANALYTICS_ENABLED', 'DO_NOT_TRACK')\n"
        "print([os.environ[name] for name in names])\n"
    )
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}
    environment = {**kept, "DO_NOT_TRACK": "true"}
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)],
        cwd=REPOSITORY,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == str([str(tmp_path / "prefect"), "false", "true"])
