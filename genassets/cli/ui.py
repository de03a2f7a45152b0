"""`genassets ui`: MLflow's and Prefect's pages of this home, on loopback, until Ctrl-C."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from genassets.cli.local_server import LocalServer
    from genassets.pipeline.home import Home

Port = Annotated[int, typer.Option(min=1, max=65535, help="Port on 127.0.0.1.")]


def ui(mlflow_port: Port = 5000, prefect_port: Port = 4200) -> None:
    """Start MLflow and Prefect on this machine alone, print where they are, and stop both on Ctrl-C."""
    import signal
    import time
    from contextlib import ExitStack

    from genassets.errors import SpecError
    from genassets.pipeline.home import Home

    if mlflow_port == prefect_port:
        raise SpecError(f"--mlflow-port and --prefect-port are both {mlflow_port}; give two")
    home = Home.from_environment()
    servers = (mlflow_server(home, mlflow_port), prefect_server(home, prefect_port))
    for server in servers:
        server.check_port()
    # A service manager ends it as Ctrl-C does; a shell script that starts it in the background has SIGINT ignored.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.default_int_handler)
    try:
        with ExitStack() as stack:
            typer.echo(f"genassets: starting MLflow and Prefect for {home.root} ...", err=True)
            started = [(server, stack.enter_context(server.started())) for server in servers]
            for server, process in started:
                server.wait_until_ready(process)
            for server in servers:
                typer.echo(f"{server.name:<8} {server.page}")
            typer.echo(
                "runs of other shells show here with:\n"
                f"  export PREFECT_API_URL={servers[1].page}/api GENASSETS_MLFLOW_PAGE={servers[0].page}\n"
                "Ctrl-C stops both"
            )
            while True:
                for server, process in started:
                    server.check_alive(process)
                time.sleep(0.5)
    except KeyboardInterrupt:
        typer.echo("genassets: MLflow and Prefect are stopped", err=True)


def mlflow_server(home: Home, port: int) -> LocalServer:
    """MLflow over the home's own database, answering only to names of this machine."""
    import sys

    from genassets.cli.local_server import LOOPBACK, LocalServer

    names = ",".join(f"{name}:{port}" for name in (LOOPBACK, "localhost"))
    options = {
        "--host": LOOPBACK,
        "--port": str(port),
        "--workers": "1",
        "--backend-store-uri": f"sqlite:///{home.mlflow / 'mlflow.db'}",
        "--artifacts-destination": str(home.mlflow / "artifacts"),
        "--allowed-hosts": names,
    }
    environment = {"MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "1"}
    return LocalServer(
        "MLflow",
        (sys.executable, "-m", "mlflow", "server", *(word for option in options.items() for word in option)),
        environment,
        port,
        "/health",
        home.mlflow / "server.log",
        "--mlflow-port",
    )


def prefect_server(home: Home, port: int) -> LocalServer:
    """Prefect over the home's own database; pages of other sites may not call it."""
    import sys

    from genassets.cli.local_server import LOOPBACK, LocalServer

    environment = {
        "PREFECT_HOME": str(home.prefect),
        # The page calls the API at this address, which is right for port 4200 alone by default.
        "PREFECT_UI_API_URL": f"http://{LOOPBACK}:{port}/api",
        "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": f"http://{LOOPBACK}:{port},http://localhost:{port}",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
        "DO_NOT_TRACK": "1",
    }
    return LocalServer(
        "Prefect",
        (sys.executable, "-m", "prefect", "server", "start", "--host", LOOPBACK, "--port", str(port)),
        environment,
        port,
        "/api/health",
        home.prefect / "server.log",
        "--prefect-port",
    )
